"""Plots of Braille characters: two columns and four rows of dots a character."""

import numpy as np
from numpy.typing import NDArray

from ftdrivers.interfaces import Array

Dots = NDArray[np.bool_]
Codes = NDArray[np.uint8]
"""Packed characters: the bits of their dots."""

_BITS = np.array([[0x01, 0x08], [0x02, 0x10], [0x04, 0x20], [0x40, 0x80]], np.uint8)
"""Bit of each dot in a character, by row and column (Unicode block U+2800)."""


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


def text(row: Codes) -> str:
    """Return one row of packed characters as text, with a blank for an empty one."""
    return np.where(row, 0x2800 + row.astype("<u4"), ord(" ")).astype("<u4").tobytes().decode("utf-32-le")


def _dot(value: Array, rows: int, full: float) -> Array:
    """Return the row of dots of values, from 0 at the top; values about zero share the row below the middle."""
    return np.floor((1 - value / full) * 2 * rows + 0.5)
