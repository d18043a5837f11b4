"""What screens are drawn with: lines of styled text, and plots of Braille characters."""

from collections.abc import Sequence
from itertools import groupby
from typing import NamedTuple, Self

import numpy as np
from numpy.typing import NDArray
from rich.cells import cell_len, set_cell_size
from rich.text import Text

from ftdrive.terminal.text import visible
from ftdrivers.interfaces import Array

BAD, WARNING, GOOD = "red bold", "bold black on yellow", "green"
TRACE, CONTACT, FAINT, STRONG = "green", "magenta", "dim", "bold"


class Part(NamedTuple):
    """A piece of a line."""

    text: str
    style: str = ""


class Line:
    """A line under construction."""

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
        """Append blanks up to a column."""
        return self.add(" " * (column - self.width))

    def join(self, other: "Line") -> Self:
        """Append another line."""
        self.parts += other.parts
        self.width += other.width
        return self

    def fit(self, width: int) -> "Line":
        """Return this line padded to `width` cells, or the words that fit and an ellipsis."""
        if self.width <= width:
            return self.to(width)
        fitted = Line()
        for part in self.parts:
            room = width - 1 - fitted.width
            if cell_len(part.text) > room:
                text = set_cell_size(part.text, max(room, 0))
                # a whole word or none of it
                if not part.text.startswith(" ", len(text)):
                    text = text[: text.rfind(" ") + 1]
                fitted.add(text, part.style)
                break
            fitted.add(*part)
        return fitted.add("…"[:width]).to(width)

    @classmethod
    def of_cells(cls, text: Sequence[str], styles: Sequence[str]) -> Self:
        """Build a line of characters, each with its own style."""
        line, start = cls(), 0
        for style, alike in groupby(styles):
            end = start + sum(1 for _ in alike)
            line.add("".join(text[start:end]), style)
            start = end
        return line

    def as_text(self) -> Text:
        """Return this line for rich."""
        return Text.assemble(*self.parts, no_wrap=True)

    def __str__(self) -> str:
        return "".join(part.text for part in self.parts)


Dots = NDArray[np.bool_]
Codes = NDArray[np.uint8]
"""Packed characters: the bits of their dots."""

# Bit of each dot in a character, by row and column (Unicode block U+2800).
_BITS = np.array([[0x01, 0x08], [0x02, 0x10], [0x04, 0x20], [0x40, 0x80]], np.uint8)


def envelope(low: Array, high: Array, rows: int, full: float) -> Dots:
    """Draw the range from `low` to `high` (n,) in each column of dots, without a gap between neighbours.

    A column with a NaN stays empty.

    Parameters
    ----------
    rows : int
        Rows of characters.
    full : float
        Value at the upper edge; minus this at the lower one. Larger values are drawn on the edge.

    Returns
    -------
    array, shape (4 rows, n)
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


def level(value: float, rows: int, full: float) -> int | None:
    """Return the row of dots of a value; None outside the plot."""
    dot = int(_dot(np.array(value), rows, full))
    return dot if 0 <= dot < 4 * rows else None


def characters(dots: Dots) -> Codes:
    """Pack dots (4 m, 2 n) into characters (m, n)."""
    rows, columns = len(dots) // 4, dots.shape[1] // 2
    cells = dots.reshape(rows, 4, columns, 2).astype(np.uint8)
    return np.asarray(np.einsum("ribj,ij->rb", cells, _BITS), np.uint8)


def row_text(row: Codes) -> str:
    """Return one row of packed characters as text, with a blank for an empty one."""
    return np.where(row, 0x2800 + row.astype("<u4"), ord(" ")).astype("<u4").tobytes().decode("utf-32-le")


def _dot(value: Array, rows: int, full: float) -> Array:
    """Return the row of dots of values, from 0 at the top; values about zero share the row below the middle."""
    return np.floor((1 - value / full) * 2 * rows + 0.5)
