"""The recent past of a stream as smallest and largest values, in memory of fixed size."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ftdrivers.interfaces import Array

SPANS_S = (2, 10, 60, 600)
"""Time spans that a plot can show."""
_BINS = 1024
"""Bins of one span; twice as many are kept, because whole columns of a plot can be longer than its span."""


@dataclass(frozen=True, slots=True, eq=False)
class Columns:
    """A span cut into columns of equal duration, oldest first."""

    low: Array
    """(6, n) smallest value; NaN where there is no sample."""
    high: Array
    """(6, n) largest value; NaN where there is no sample."""
    in_contact: NDArray[np.bool_]
    """(n,)"""
    start_ns: int
    column_ns: int

    @property
    def span_s(self) -> float:
        """Duration of all columns."""
        return len(self.in_contact) * self.column_ns * 1e-9

    @property
    def contact_cells(self) -> NDArray[np.bool_]:
        """(n / 2,) in_contact, for characters of two columns."""
        return self.in_contact[::2] | self.in_contact[1::2]

    def column_of(self, t_ns: int) -> int | None:
        """Return the column of a time; None outside."""
        column = (t_ns - self.start_ns) // self.column_ns
        return int(column) if 0 <= column < len(self.in_contact) else None


class History:
    """Smallest and largest wrench of each bin of time, for one span.

    The bins are aligned to the clock, so that a plot moves by whole columns and a column never changes afterwards.

    Parameters
    ----------
    span_s : float
    """

    def __init__(self, span_s: float) -> None:
        self._bin_ns = round(span_s * 1e9 / _BINS)
        self._size = 2 * _BINS
        self._bin = np.empty(self._size, np.int64)
        self._low = np.empty((self._size, 6))
        self._high = np.empty((self._size, 6))
        self._in_contact = np.empty(self._size, np.bool_)
        self.clear()

    def clear(self) -> None:
        """Forget everything."""
        self._bin.fill(-1)

    def add(self, t_ns: NDArray[np.int64], wrench: Array, in_contact: NDArray[np.bool_]) -> None:
        """Add samples in the order of time.

        Parameters
        ----------
        t_ns : array, shape (n,)
        wrench : array, shape (n, 6)
        in_contact : array, shape (n,)
        """
        bins = t_ns // self._bin_ns
        starts = np.flatnonzero(np.diff(bins, prepend=bins[0] - 1))
        bins = bins[starts]
        low, high = np.minimum.reduceat(wrench, starts), np.maximum.reduceat(wrench, starts)
        contact = np.logical_or.reduceat(in_contact, starts)
        if self._bin[at := bins[0] % self._size] == bins[0]:  # only the first bin can have samples already
            np.minimum(low[0], self._low[at], out=low[0])
            np.maximum(high[0], self._high[at], out=high[0])
            contact[0] |= self._in_contact[at]
        slots = bins % self._size
        self._bin[slots], self._low[slots], self._high[slots], self._in_contact[slots] = bins, low, high, contact

    def columns(self, end_ns: int, n: int) -> Columns:
        """Return n columns of which the last contains `end_ns`."""
        each = max(1, round(_BINS / n))
        first = (end_ns // self._bin_ns // each - n + 1) * each
        bins = np.arange(first, first + n * each)
        slots = bins % self._size
        missing = self._bin[slots] != bins
        low, high = self._low[slots], self._high[slots]
        low[missing], high[missing] = np.inf, -np.inf
        low, high = low.reshape(n, each, 6).min(axis=1).T, high.reshape(n, each, 6).max(axis=1).T
        empty = low > high
        low[empty], high[empty] = np.nan, np.nan
        contact = (self._in_contact[slots] & ~missing).reshape(n, each).any(axis=1)
        return Columns(low, high, contact, int(first * self._bin_ns), each * self._bin_ns)
