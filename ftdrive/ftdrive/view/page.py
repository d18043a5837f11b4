"""A page of a command: named parts that browsers show, controls that they use, and the loop that draws it."""

import json
import logging
import threading
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from math import isfinite
from time import monotonic
from typing import Any, Final

from ftdrive.view.parts import Part, button, controls

log = logging.getLogger(__name__)

# A busy computer, which is late at times, still draws 20 times a second.
_PERIOD_S: Final = 0.045
# Drawing that takes longer hangs.
HUNG_S: Final = 5.0
_TEXT: Final = 10_000


class Page:
    """What all browsers that show the page see, and what they may ask for."""

    def __init__(self, title: str) -> None:
        self.url = ""
        """With the token, without which nothing is served."""
        self.viewers = 0
        """Number of browsers that show the page."""
        self._lock = threading.Lock()
        # A part with its text and the version of the page that brought it.
        self._parts: dict[str, tuple[Part | None, str, int]] = {}
        self._version = 0
        self._acts: dict[str, Callable[[str, Any], object]] = {}
        self._drawn_s: float | None = None
        self.put({"title": {"kind": "title", "text": title}})

    def put(self, parts: Mapping[str, Part | None]) -> None:
        """Show parts, all together, by their names; None takes one away. What has not changed is not sent again.

        The name before a slash is that of a place in `page.html`, such as `state`, or `scene`.
        """
        texts = {name: json.dumps(part, allow_nan=False, separators=(",", ":")) for name, part in parts.items()}
        with self._lock:
            for name, text in texts.items():
                if text != self._parts.get(name, (None, "null", 0))[1]:
                    self._version += 1
                    self._parts[name] = parts[name], text, self._version

    def on(self, name: str, act: Callable[[str, Any], object]) -> None:
        """Call `act` when a viewer uses the control of this name that is shown, with viewer and valid value.

        It is called in the thread of the server, so it must not wait; a `ValueError` is shown to the viewer.
        """
        self._acts[name] = act

    def add_stop(self, stop: Callable[[str], object]) -> None:
        """Show a Stop button; `stop` is called in another thread, with the name of the viewer who pressed it."""
        self.put({"stop": controls(button("stop", "Stop", key="q"), note="Stops the arm. It is no emergency stop.")})
        self.on("stop", lambda viewer, _: stop(viewer))

    def act(self, viewer: str, name: object, value: object) -> None:
        """Use a control for a viewer; raises `ValueError` if it is not shown or the value is not one of its values."""
        with self._lock:
            shown = [part["controls"] for part, _, _ in self._parts.values() if part and part["kind"] == "controls"]
        found = next((one for part in shown for one in part if one["name"] == name and not one.get("disabled")), None)
        if found is None or found["name"] not in self._acts:
            raise ValueError("this page has no such control now")
        self._acts[found["name"]](viewer, _valid(found, value))

    def since(self, version: int) -> tuple[int, str]:
        """Return the present version, and as JSON the parts that are newer than another one; empty if none is."""
        with self._lock:
            newer = [f"{json.dumps(name)}:{text}" for name, (_, text, at) in self._parts.items() if at > version]
            return self._version, f"{{{','.join(newer)}}}" if newer else ""

    def beat(self) -> None:
        """Say that the page is drawn; from then on it counts as stale whenever it is not drawn again."""
        self._drawn_s = monotonic()

    def rest(self) -> None:
        """Say that the page is drawn only when something happens from now on, as before the first `beat`."""
        self._drawn_s = None

    @property
    def stale_s(self) -> float:
        """Seconds since the page was drawn; 0 of a page that is drawn when something happens."""
        return 0.0 if self._drawn_s is None else monotonic() - self._drawn_s


def _valid(control: Part, value: object) -> object:
    match control["type"]:
        case "button" if value is None:
            return value
        case "check" if isinstance(value, bool):
            return value
        case "select" if isinstance(value, str) and value in control["options"]:
            return value
        case "range" if isinstance(value, int | float) and not isinstance(value, bool) and isfinite(value):
            if 0 <= value <= control["max"]:
                return float(value)
        case "text" if isinstance(value, str) and len(value) <= _TEXT and (value.isprintable() or not value):
            return value
    raise ValueError(f"{control['label']} cannot have this value")


@contextmanager
def drawing(page: Page, draw: Callable[[], None], say: Callable[[str], object] = log.error) -> Iterator[None]:
    """Call `draw` 22 times a second in a thread of its own while the block runs; `say` takes what ends it."""
    ended = threading.Event()

    def run() -> None:
        due_s = monotonic()
        try:
            # after a pause of the computer nothing is made up for
            while not ended.wait(max(0.0, due_s - monotonic())):
                due_s = max(due_s + _PERIOD_S, monotonic())
                draw()
                page.beat()
        except Exception as error:  # only a picture: the stream goes on
            log.debug("the drawing has failed", exc_info=True)
            say(f"The page is not drawn any more, the command goes on: {error!r}")
            ended.set()

    def watch() -> None:
        while not ended.wait(1.0):
            if page.stale_s > HUNG_S:
                say(f"The page has not been drawn for {HUNG_S:.0f} s, the command goes on.")
                return

    page.beat()
    thread = threading.Thread(target=run, name="page", daemon=True)
    thread.start()
    threading.Thread(target=watch, name="page watch", daemon=True).start()
    try:
        yield
    finally:
        ended.set()
        thread.join(2.0)
