"""A command's browser page: named parts that are shown, controls that viewers use, and the loop that draws the page."""

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

# Period of drawing, slightly shorter than 1/20 s, so that a busy computer still draws 20 times per second.
_PERIOD_S: Final = 0.045
# A drawing that takes longer than this, s, is considered hung.
HUNG_S: Final = 5.0
_TEXT: Final = 10_000


class Page:
    """The content of a browser page, the same for all viewers, and the actions that viewers may request."""

    def __init__(self, title: str) -> None:
        self.url = ""
        """Address of the page, with the token that the server requires."""
        self.viewers = 0
        """Number of browsers that are showing the page."""
        self._lock = threading.Lock()
        # parts by name, each with its JSON text and the page version in which it last changed
        self._parts: dict[str, tuple[Part | None, str, int]] = {}
        self._version = 0
        self._acts: dict[str, Callable[[str, Any], object]] = {}
        self._drawn_s: float | None = None
        self.put({"title": {"kind": "title", "text": title}})

    def put(self, parts: Mapping[str, Part | None]) -> None:
        """Show parts by name, all in one update; None removes a part. Unchanged parts are not sent again.

        The name up to the first slash is that of an element of `page.html`, such as `state` or `scene`.
        """
        texts = {name: json.dumps(part, allow_nan=False, separators=(",", ":")) for name, part in parts.items()}
        with self._lock:
            for name, text in texts.items():
                if text != self._parts.get(name, (None, "null", 0))[1]:
                    self._version += 1
                    self._parts[name] = parts[name], text, self._version

    def on(self, name: str, act: Callable[[str, Any], object]) -> None:
        """From now on, call `act` with the viewer's name and the new value when a viewer uses the control `name`.

        `act` runs in the server thread and must not wait. The viewer sees the message of a `ValueError` from it.
        """
        self._acts[name] = act

    def add_stop(self, stop: Callable[[str], object]) -> None:
        """Show a Stop button; when it is pressed, `stop` is called in the server thread with the viewer's name."""
        self.put({"stop": controls(button("stop", "Stop", key="q"), note="Stops the arm. No emergency stop.")})
        self.on("stop", lambda viewer, _: stop(viewer))

    def act(self, viewer: str, name: object, value: object) -> None:
        """Use the control `name` for a viewer. Raises `ValueError` if it is not shown or the value is invalid."""
        with self._lock:
            shown = [part["controls"] for part, _, _ in self._parts.values() if part and part["kind"] == "controls"]
        found = next((one for part in shown for one in part if one["name"] == name and not one.get("disabled")), None)
        if found is None or found["name"] not in self._acts:
            raise ValueError("this page does not have this control now")
        self._acts[found["name"]](viewer, _valid_value(found, value))

    def since(self, version: int) -> tuple[int, str]:
        """Return the page's current version, and as JSON the parts that changed after `version`; "" for no change."""
        with self._lock:
            newer = [f"{json.dumps(name)}:{text}" for name, (_, text, at) in self._parts.items() if at > version]
            return self._version, f"{{{','.join(newer)}}}" if newer else ""

    def beat(self) -> None:
        """Mark the page as drawn now. From now on, it counts as stale after a while without the next `beat`."""
        self._drawn_s = monotonic()

    def rest(self) -> None:
        """Mark the page as drawn only at changes, as it is before the first `beat`, so that it never becomes stale."""
        self._drawn_s = None

    @property
    def stale_s(self) -> float:
        """Time since the last `beat`, s; 0 for a page that is drawn only at changes."""
        return 0.0 if self._drawn_s is None else monotonic() - self._drawn_s


def _valid_value(control: Part, value: object) -> object:
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
    """Draw a page 22 times per second in a thread while the block runs. An error ends this; `say` receives it."""
    ended = threading.Event()

    def run() -> None:
        due_s = monotonic()
        try:
            # drawings that were missed while the computer was paused are skipped
            while not ended.wait(max(0.0, due_s - monotonic())):
                due_s = max(due_s + _PERIOD_S, monotonic())
                draw()
                page.beat()
        except Exception as error:  # the command goes on without its page
            log.debug("the drawing has failed", exc_info=True)
            say(f"The page is no longer updated, the command continues: {error!r}")
            ended.set()

    def watch() -> None:
        while not ended.wait(1.0):
            if page.stale_s > HUNG_S:
                say(f"The page has not been updated for {HUNG_S:.0f} s, the command continues.")
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
