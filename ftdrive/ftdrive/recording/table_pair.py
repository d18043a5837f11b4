"""Wrench and orientation of another program on one clock, each at its own rate, as a recording."""

from collections.abc import Callable, Iterator
from itertools import chain
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import minimum_filter1d

from ftcalib import CalibrationResult
from ftcalib.errors import BadDataset
from ftdrive.live.pairing import DelayEstimator, estimate_delay, pair_blocks
from ftdrive.live.samples import Paired, Stages, StreamInfo, WrenchFrame
from ftdrive.recording.recording import PIECE_ROWS, Header, Measured
from ftdrive.runs.run import versions
from ftdrive.tables.table import Table
from ftdrivers.interfaces import NOT_REPORTED, ArmStates, Array, DeviceInfo, FtSamples

T = TypeVar("T")
# Seconds: the delay is estimated from all of a recording.
_WHOLE = 10**6
_MEAN_S = 0.008
# Samples before and after a step that show whether it is a gap.
_NEAR = 100
_ROUNDS = 20
# Largest distance of regular times from multiples of their period, in periods.
_REGULAR = 0.2


class TablePair:
    """Two tables, or one with both, as one recording of any length; the devices are unknown.

    Parameters
    ----------
    wrench, orientation : Table
    calibration : CalibrationResult
    name : str
        Of the calibration.
    delay_s : float, optional
        Of the wrench after the orientation; None estimates it in a pass of its own.

    Raises
    ------
    BadDataset
        A table cannot be used, or the two have no time in common.
    """

    cut = ""

    def __init__(
        self, wrench: Table, orientation: Table, calibration: CalibrationResult, name: str, delay_s: float | None
    ) -> None:
        self._wrench, self._states = wrench, _Again(lambda: _states_of(orientation))
        rate_Hz, unknown = wrench.rate_Hz("wrench"), np.full(3, np.nan)
        info = StreamInfo(
            calibration=calibration,
            calibration_name=name,
            arm=DeviceInfo("unknown", NOT_REPORTED, NOT_REPORTED),
            sensor=DeviceInfo("unknown", NOT_REPORTED, NOT_REPORTED),
            tool="",
            utc_offset_ns=0,
            sensor_rate_Hz=rate_Hz,
            arm_rate_Hz=orientation.rate_Hz("orientation"),
            p_flange_sensor_m=unknown,
            R_flange_tcp=np.eye(3),
            p_flange_tcp_m=unknown,
            versions=versions(),
        )
        self.header = Header(info, WrenchFrame(), Stages())
        self.delay_s, self.delay_sigma_s = self._estimated_delay() if delay_s is None else (delay_s, 0.0)

    def blocks(self) -> Iterator[Measured]:
        """Give the samples in blocks, each with its pose. Raises `BadDataset` behind the last valid one."""
        # Each call reads from the beginning: a binary copy for a second pass would need 1.4 GB an hour.
        share = [0.0]

        def samples() -> Iterator[FtSamples]:
            for block, share[0] in _numbered(self._wrench):
                yield from (block.rows(slice(i, i + PIECE_ROWS)) for i in range(0, len(block), PIECE_ROWS))

        waiting: list[Paired] = []
        failure: BadDataset | None = None
        try:
            for paired in pair_blocks(samples(), self._states, self.delay_s):
                rows = Paired.concatenate([*waiting, paired])
                # as of other recordings, because the contact test goes in steps
                if len(rows) >= PIECE_ROWS:
                    yield Measured(rows.rows(slice(PIECE_ROWS)), (), share[0])
                waiting = [rows.rows(slice(PIECE_ROWS if len(rows) >= PIECE_ROWS else 0, None))]
        except BadDataset as error:
            failure = error
        if any(map(len, waiting)):
            yield Measured(waiting[0], (), share[0])
        if failure is not None:
            raise failure

    def _estimated_delay(self) -> tuple[float, float]:
        """Return the delay and its sigma, from means over `_MEAN_S`."""
        info = self.header.info
        size = max(1, round(_MEAN_S * info.sensor_rate_Hz))
        means = list(_before_a_fault(_means(self._wrench, size)))
        estimator = DelayEstimator(info.calibration, info.p_flange_sensor_m, window=_WHOLE)
        estimate_delay(means, _Again(lambda: _before_a_fault(iter(self._states))), estimator)
        return estimator.delay_s, estimator.sigma_s


class _Again:
    """What a function yields, as often as it is asked."""

    def __init__(self, states: Callable[[], Iterator[ArmStates]]) -> None:
        self._states = states

    def __iter__(self) -> Iterator[ArmStates]:
        return self._states()


def _before_a_fault(parts: Iterator[T]) -> Iterator[T]:
    """Yield the parts before a fault, if there are any; the pass that follows reports it."""
    count = 0
    try:
        for part in parts:
            yield part
            count += 1
    except BadDataset:
        if not count:
            raise


def _means(table: Table, size: int) -> Iterator[FtSamples]:
    """Yield the mean wrench of each so many samples, numbered, at their mean time."""
    t_s, wrench, count = np.empty(0), np.empty((0, 6)), 0
    for rows in table.wrenches():
        t_s, wrench = np.concatenate([t_s, rows.t_s]), np.concatenate([wrench, rows.values])
        n = len(t_s) // size
        t_ns = _ns(t_s[: n * size].reshape(n, size).mean(axis=1))
        means = wrench[: n * size].reshape(n, size, 6).mean(axis=1)
        yield FtSamples.of(t_ns, np.arange(count, count + n), means)
        t_s, wrench, count = t_s[n * size :], wrench[n * size :], count + n


def _numbered(table: Table) -> Iterator[tuple[FtSamples, float]]:
    """Give the samples, numbered by their times as in `numbers_of`, and the share of the table before the next ones."""
    known, number = 0, 0
    t_s, wrench, place = np.empty(0), np.empty((0, 6)), 0.0
    for rows in chain(table.wrenches(), [None]):
        if rows is not None:
            t_s, wrench, place = np.concatenate([t_s, rows.t_s]), np.concatenate([wrench, rows.values]), rows.place
            if len(t_s) <= known + 2 * _NEAR:
                continue
        numbers = numbers_of(t_s)
        numbers += number - numbers[max(known - 1, 0)]
        # what follows shows whether a step is a gap
        end = len(t_s) if rows is None else len(t_s) - _NEAR
        if end > known:
            yield FtSamples.of(_ns(t_s[known:end]), numbers[known:end], wrench[known:end]), place
            number = int(numbers[end - 1])
        start = max(end - 2 * _NEAR, 0)
        t_s, wrench, known = t_s[start:], wrench[start:], end - start


def numbers_of(t_s: Array) -> NDArray[np.int64]:
    """Number samples by their times (n,), so that a sample that is missing is a gap and a late one is not.

    Where each time is near a multiple of the period, a longer step is a gap. Elsewhere, as with times of receipt or of
    batches, a gap is a step after which the samples stay late by a period or more, by their median and by the earliest.
    """
    steps_s = np.diff(t_s)
    if (step_s := float(np.median(steps_s))) > 0:
        steps = np.rint(steps_s / step_s)
        if steps.min() >= 1 and np.abs(steps_s / step_s - steps).max() < _REGULAR:
            return np.concatenate([[0], np.cumsum(steps)]).astype(np.int64)
    number = np.arange(len(t_s))
    # the period is that of all samples, the missing ones included
    for _ in range(_ROUNDS):
        before, number = number, _with_gaps(t_s, float(t_s[-1] - t_s[0]) / int(number[-1]))
        if np.array_equal(number, before):
            break
    return number


def _with_gaps(t_s: Array, period_s: float) -> NDArray[np.int64]:
    number = np.arange(len(t_s))
    if period_s == 0:
        return number
    steps = np.diff(t_s) / period_s
    late = t_s / period_s - number
    # of a sample and those before
    earliest = minimum_filter1d(late, _NEAR, mode="nearest", origin=(_NEAR - 1) // 2)
    following = minimum_filter1d(late, _NEAR, mode="nearest", origin=-_NEAR // 2)  # and those after
    possible = np.flatnonzero((steps > 1.5) & (following[1:] - earliest[:-1] > 0.4))
    # where the samples beside it are less late
    for last in possible[np.argsort(-steps[possible])].tolist():
        near = slice(max(last + 1 - _NEAR, 0), last + 1), slice(last + 1, last + 1 + _NEAR)
        before, after = (t_s[rows] / period_s - number[rows] for rows in near)
        missing = min(np.median(after) - np.median(before), after.min() - before.min())
        number[last + 1 :] += max(round(float(missing)), 0)
    return number


def _states_of(table: Table) -> Iterator[ArmStates]:
    """Give the orientations of the flange; positions and joints are NaN."""
    for rows in table.poses():
        unknown = np.full((len(rows.t_s), 6), np.nan)
        R = rows.values[:, :9].reshape(-1, 3, 3)
        yield ArmStates(_ns(rows.t_s), unknown[:, 0], unknown, unknown, R, unknown[:, :3])


def _ns(t_s: Array) -> NDArray[np.int64]:
    return np.rint(t_s * 1e9).astype(np.int64)
