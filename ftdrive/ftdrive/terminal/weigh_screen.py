"""The screen of `ftdrive weigh`: one large number."""

from collections.abc import Iterable, Iterator
from itertools import takewhile
from textwrap import wrap

from ftcalib.rounding import counted, to_place_of
from ftdrive.stream.weighing import Weighing, format_scale
from ftdrive.terminal.canvas import Canvas
from ftdrive.terminal.lines import STRONG, Line
from ftdrive.words.stream import NO_MASS, name_devices, worth_of, zero_in_words

_FIGURES = "0123456789-"
# The digits and the minus sign in block characters: three rows, three characters wide.
_ROWS = (
    "█▀█ ▀█  ▀▀█ ▀▀█ █ █ █▀▀ █▀▀ ▀▀█ █▀█ █▀█",
    "█ █  █  █▀▀ ▀▀█ ▀▀█ ▀▀█ █▀█   █ █▀█ ▀▀█ ▀▀▀",
    "▀▀▀ ▀▀▀ ▀▀▀ ▀▀▀   ▀ ▀▀▀ ▀▀▀   ▀ ▀▀▀ ▀▀▀",
)


class WeighScreen(Canvas):
    """Screen of `ftdrive weigh`; an error of a device or in the replayed recording ends it.

    Iterating `turns` reads the stream, see `pump`; `address` is that of the browser page, or empty.
    """

    def __init__(self, weighing: Weighing, turns: Iterable[object], address: str = "") -> None:
        super().__init__(address)
        self._weighing, self._turns = weighing, turns

    def draw(self, width: int, height: int) -> list[Line]:
        """Return the lines that show the current mass, or why there is none."""
        info, shown = self._weighing.stream.info, self._weighing.shown
        mass, beside = NO_MASS, list[str]()
        if (weight := shown.measured) is not None:
            mass = f"{to_place_of(weight.mass_kg, weight.mass_sigma_kg, ' z')} kg"
            beside = [worth_of(weight)] if shown.count is None else [counted(shown.count, "part"), worth_of(weight)]
            if self._weighing.joins:
                beside.append(f"{counted(weight.poses, 'pose')} combined, turn the tool for more")
            zero, helps = zero_in_words(self._weighing)
            beside += [zero] if helps else []
        keys = "" if self._weighing.moving else "z zero the empty gripper   p combine poses of one load   "
        title = "   ".join(["ftdrive weigh", name_devices(info), *info.marks])
        lines = [Line(f"  {title}"), self.page() or Line(), Line()]
        lines += [Line(f"  {row}", STRONG) for row in large_figures(mass)]
        for text in ("", "   ".join(beside), format_scale(shown), self._weighing.note):
            lines += [Line(f"  {line}") for line in wrap(text, max(width - 4, 1)) or [""]]
        return [*lines, *[Line()] * (height - 1 - len(lines)), Line(f"  {keys}q quit")]

    def turns(self) -> Iterator[object]:
        """Read the stream, which also weighs, until the screen is over."""
        return takewhile(lambda _: not self.is_over, self._turns)

    def act(self, key: str) -> None:
        """Tare the empty gripper, or start or stop combining the poses of one load."""
        if key == "z" and not self._weighing.moving:
            self._weighing.request_zero()
        elif key == "p" and not self._weighing.moving:
            self._weighing.joins = not self._weighing.joins


def large_figures(text: str) -> list[str]:
    """Return a text as three rows: digits in block characters, other characters in the last row."""
    rows = ["", "", ""]
    for one in text:
        at = 4 * _FIGURES.find(one)
        small = "▀ " if one == "." else one
        for i, row in enumerate(_ROWS):
            rows[i] += f"{row[at : at + 4]:4}" if at >= 0 else small if i == 2 else " " * len(small)
    return rows
