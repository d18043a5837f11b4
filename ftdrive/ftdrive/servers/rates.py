"""Samples of blocks at a lower rate: picked, or averaged."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ftdrive.live.samples import Block
from ftdrivers.interfaces import Array


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


class Means(NamedTuple):
    """n means of one frame, in the order of measurement."""

    t_host_ns: NDArray[np.int64]
    """(n,) mean of the times of measurement."""
    raw: Array
    """(n, 6)"""
    wrench: Array
    """(n, 6)"""
    in_contact: NDArray[np.bool_]
    """(n,) whether one of the samples is."""


class Averaged:
    """Means over as many consecutive sample numbers as give at most `rate_Hz`; a single sample stays as it is.

    A lost sample leaves the mean of the others. Samples of an interval that an interruption cut are dropped, because
    their mean would come late.
    """

    def __init__(self, sensor_rate_Hz: float, rate_Hz: float) -> None:
        # a rate is known to about 0.3 %
        self.count = max(1, int(np.ceil(0.99 * sensor_rate_Hz / rate_Hz)))
        """Samples of one mean."""
        self._longest_ns = 2e9 * self.count / sensor_rate_Hz
        self._waiting: Block | None = None

    def restart(self) -> None:
        """Drop the samples of an interval that is not complete."""
        self._waiting = None

    def add(self, block: Block) -> Means:
        """Return the means that are complete with this block."""
        if self.count == 1:
            return Means(block.t_host_ns, block.raw, block.wrench, block.in_contact)
        waiting, self._waiting = self._waiting, None
        if waiting is not None and self._continues(waiting, block):
            block = Block.concatenate([waiting, block])
        interval = block.seq // self.count
        begins = np.flatnonzero(np.diff(interval, prepend=interval[0] - 1))
        # more of the last interval are to come
        if (block.seq[-1] + 1) % self.count:
            last = int(begins[-1])
            self._waiting = block.rows(slice(last, None))
            block, begins = block.rows(slice(last)), begins[:-1]
        if not len(begins):
            return Means(block.t_host_ns, block.raw, block.wrench, block.in_contact)
        n = np.diff(begins, append=len(block))
        t_ns = block.t_host_ns[begins] + np.rint(
            np.add.reduceat(block.t_host_ns - np.repeat(block.t_host_ns[begins], n), begins) / n
        ).astype(np.int64)
        raw, wrench = (np.add.reduceat(values, begins) / n[:, None] for values in (block.raw, block.wrench))
        return Means(t_ns, raw, wrench, np.logical_or.reduceat(block.in_contact, begins))

    def _continues(self, waiting: Block, block: Block) -> bool:
        is_alike = waiting.frame == block.frame and waiting.stages == block.stages
        return bool(is_alike and block.t_host_ns[0] - waiting.t_host_ns[-1] < self._longest_ns)
