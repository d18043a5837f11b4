"""The screen of `ftdrive weigh`: one large number."""

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from textwrap import wrap

from ftcalib.after.weighing import Weight
from ftcalib.rounding import counted, to_place_of
from ftdrive.live.weighing import UNZEROED_KG, Weighing, line_of, worth_of
from ftdrive.terminal.canvas import Canvas
from ftdrive.terminal.lines import STRONG, Line

_FIGURES = "0123456789-"
# Three rows of each figure, three characters wide.
_ROWS = (
    "█▀█ ▀█  ▀▀█ ▀▀█ █ █ █▀▀ █▀▀ ▀▀█ █▀█ █▀█",
    "█ █  █  █▀▀ ▀▀█ ▀▀█ ▀▀█ █▀█   █ █▀█ ▀▀█ ▀▀▀",
    "▀▀▀ ▀▀▀ ▀▀▀ ▀▀▀   ▀ ▀▀▀ ▀▀▀   ▀ ▀▀▀ ▀▀▀",
)


class WeighScreen(Canvas):
    """The scale. What ends its reading ends the screen: an error of a device, or of the recording.

    Parameters
    ----------
    weighing : Weighing
    address : str
        Of the page in the browser, if there is one.
    """

    def __init__(self, weighing: Weighing, address: str = "") -> None:
        super().__init__(address)
        self._weighing = weighing
        self._failure: BaseException | None = None

    def draw(self, width: int, height: int) -> list[Line]:
        """Draw the present state; raises what has ended the thread that reads."""
        if self._failure is not None:
            raise self._failure
        info, shown = self._weighing.stream.info, self._weighing.shown
        weight = shown.measured
        mass = "- - -" if weight is None else f"{to_place_of(weight.mass_kg, weight.mass_sigma_kg, ' z')} kg"
        sigma = "" if weight is None else self._sigma_line(weight, shown.count)
        keys = "" if self._weighing.moving else "z zero the empty gripper   p join poses of one load   "
        title = "   ".join(["ftdrive weigh", f"tool {info.tool}", *info.marks])
        lines = [Line(f"  {title}"), self.page() or Line(), Line()]
        lines += [Line(f"  {row}", STRONG) for row in large(mass)]
        for text in ("", sigma, line_of(shown), self._weighing.note):
            lines += [Line(f"  {line}") for line in wrap(text, max(width - 4, 1)) or [""]]
        return [*lines, *[Line()] * (height - 1 - len(lines)), Line(f"  {keys}q quit")]

    @contextmanager
    def reading(self) -> Iterator[None]:
        """Read and weigh."""
        ends = threading.Event()

        def read() -> None:
            try:
                for _ in self._weighing.states():
                    if ends.is_set():
                        return
            except BaseException as error:  # the main thread raises it
                self._failure = error

        thread = threading.Thread(target=read, name="weigh screen", daemon=True)
        thread.start()
        try:
            yield
        finally:
            ends.set()
            # a zero may take seconds
            thread.join(2.0)

    def act(self, key: str) -> None:
        """Tare the empty gripper, or begin or stop to join the poses of one load."""
        if self._weighing.moving:
            return
        if key == "z":
            self._weighing.request_zero()
        elif key == "p":
            self._weighing.joins = not self._weighing.joins

    def _sigma_line(self, weight: Weight, count: int | None) -> str:
        words = [worth_of(weight)] if count is None else [counted(count, "part"), worth_of(weight)]
        if self._weighing.joins:
            words.append(f"{counted(weight.poses, 'pose')} joined, turn the tool for more")
        if weight.least_kg > UNZEROED_KG and not self._weighing.moving:
            words.append("not zeroed: press z with an empty gripper")
        return "   ".join(words)


def large(text: str) -> list[str]:
    """Return figures as three rows of block characters; letters keep their size, in the last row."""
    rows = ["", "", ""]
    for one in text:
        at = 4 * _FIGURES.find(one)
        small = "▀ " if one == "." else one
        for i, row in enumerate(_ROWS):
            rows[i] += f"{row[at : at + 4]:4}" if at >= 0 else small if i == 2 else " " * len(small)
    return rows
