"""Rows of blocks at a lower rate."""

import numpy as np
from numpy.typing import NDArray


class Picked:
    """Picks at most `rate_Hz` samples a second, also across the limits of blocks: the first of each period.

    A sample is picked, never averaged: what is sent was measured. The low-pass stage of the stream limits aliasing.
    """

    def __init__(self, rate_Hz: float) -> None:
        self._period_ns = round(1e9 / rate_Hz)
        self._last = -1

    def rows(self, t_ns: NDArray[np.int64]) -> NDArray[np.bool_]:
        """Return which samples (n,) to send, by their times in the order of measurement."""
        period = t_ns // self._period_ns
        chosen = np.empty(len(period), bool)
        if len(period):
            chosen[0] = period[0] != self._last
            chosen[1:] = period[1:] != period[:-1]
            self._last = int(period[-1])
        return chosen
