"""Lines of styled text, and plots made of Braille characters."""

from collections.abc import Sequence
from itertools import groupby
from typing import NamedTuple, Self

import numpy as np
from numpy.typing import NDArray
from rich.cells import cell_len, set_cell_size
from rich.text import Text

from ftdrive.words.text import visible
from ftdrivers.interfaces import Array

BAD, WARNING, GOOD = "red bold", "bold black on yellow", "green"
TRACE, CONTACT, FAINT, STRONG = "green", "magenta", "dim", "bold"


class Part(NamedTuple):
    """A piece of a line of text with one style."""

    text: str
    style: str = ""


class Line:
    """A line of styled text, built piece by piece."""

    def __init__(self, text: str = "", style: str = "") -> None:
        self.parts: list[Part] = []
        self.width = 0
        self.add(text, style)

    def add(self, text: str, style: str = "") -> Self:
        """Append text."""
        text = visible(text)
        self.width += cell_len(text)
        if self.parts and self.parts[-1].style == style:
            self.parts[-1] = Part(self.parts[-1].text + text, style)
        elif text:
            self.parts.append(Part(text, style))
        return self

    def to(self, column: int) -> Self:
        """Append spaces until the line has `column` cells."""
        return self.add(" " * (column - self.width))

    def join(self, other: "Line") -> Self:
        """Append another line."""
        self.parts += other.parts
        self.width += other.width
        return self

    def fit(self, width: int) -> "Line":
        """Return this line with exactly `width` cells: padded with spaces, or cut after a word, with an ellipsis."""
        if self.width <= width:
            return self.to(width)
        fitted = Line()
        for part in self.parts:
            room = width - 1 - fitted.width
            if cell_len(part.text) > room:
                text = set_cell_size(part.text, max(room, 0))
                # cut back to whole words
                if not part.text.startswith(" ", len(text)):
                    text = text[: text.rfind(" ") + 1]
                fitted.add(text, part.style)
                break
            fitted.add(*part)
        return fitted.add("…"[:width]).to(width)

    @classmethod
    def of_cells(cls, text: Sequence[str], styles: Sequence[str]) -> Self:
        """Build a line of characters, the i-th of which has the i-th style."""
        line = cls()
        for style, alike in groupby(zip(text, styles, strict=True), key=lambda cell: cell[1]):
            line.add("".join(character for character, _ in alike), style)
        return line

    def as_text(self) -> Text:
        """Return this line as a rich `Text`."""
        return Text.assemble(*self.parts, no_wrap=True)

    def __str__(self) -> str:
        return "".join(part.text for part in self.parts)


Dots = NDArray[np.bool_]

# Bit of each dot in the code of a Braille character, by row and column (Unicode block U+2800).
_BITS = np.array([[0x01, 0x08], [0x02, 0x10], [0x04, 0x20], [0x40, 0x80]], np.uint32)


def envelope(low: Array, high: Array, rows: int, full: float) -> Dots:
    """Draw the ranges from `low` to `high` (n,) as dots (4 rows, n), without vertical gaps between neighbours.

    A column with NaN stays empty. The upper edge is the value `full`, the lower edge -`full`; values beyond an edge are
    drawn at the edge.
    """
    low, high = low.copy(), high.copy()
    joined = np.isfinite(low[1:]) & np.isfinite(low[:-1])
    low[1:], high[1:] = (
        np.where(joined, np.minimum(low[1:], high[:-1]), low[1:]),
        np.where(joined, np.maximum(high[1:], low[:-1]), high[1:]),
    )
    with np.errstate(invalid="ignore"):
        top, bottom = (np.clip(_dot(value, rows, full), 0, 4 * rows - 1) for value in (high, low))
        dot = np.arange(4 * rows)[:, None]
        return np.asarray((dot >= top) & (dot <= bottom))


def characters(dots: Dots) -> NDArray[np.str_]:
    """Pack dots (4 m, 2 n) into Braille characters (m, n); a character without dots is a space."""
    rows, columns = len(dots) // 4, dots.shape[1] // 2
    codes = np.einsum("ribj,ij->rb", dots.reshape(rows, 4, columns, 2).astype(np.uint32), _BITS)
    return np.where(codes, 0x2800 + codes, ord(" ")).astype(np.uint32).view("U1")


def plot(
    low: Array, high: Array, rows: int, full: float, in_contact: NDArray[np.bool_], under: Dots | None = None
) -> list[Line]:
    """Draw ranges (n,) as in `envelope`, over the dots `under`, as lines of n / 2 characters; contacts are coloured."""
    ink = characters(envelope(low, high, rows, full))
    drawn, cells = ink != " ", ink if under is None else np.where(ink != " ", ink, characters(under))
    styles = np.where(drawn, np.where(in_contact, CONTACT, TRACE), FAINT)
    return [Line.of_cells(*row) for row in zip(cells.tolist(), styles.tolist(), strict=True)]


def _dot(value: Array, rows: int, full: float) -> Array:
    """Return in which row of dots, 0 at the top, each value is drawn; zero is in the row below the middle."""
    return np.floor((1 - value / full) * 2 * rows + 0.5)
