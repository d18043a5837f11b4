"""Wrench and orientation of another program, as two CSV files on one clock, each at its own rate."""

import csv
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import minimum_filter1d

from ftcalib import CalibrationResult
from ftcalib.data.dataset import ORIENTATION_FORMS, orientation_columns, rotations_of
from ftcalib.data.dwell_mean import CHANNELS
from ftcalib.errors import BadDataset
from ftdrive.live.delay import DelayEstimator
from ftdrive.live.pairing import pair_recording
from ftdrive.live.samples import Stages, StreamInfo, WrenchFrame, mean_rate_Hz
from ftdrive.recording.compensation import free_samples
from ftdrive.recording.recording import Header, Recording, rows_of
from ftdrive.runs.run import versions
from ftdrivers.interfaces import NOT_REPORTED, ArmStates, Array, DeviceInfo, FtSamples

_WHOLE = 10**6
"""Seconds: the delay is estimated from all of a recording."""
_NEAR = 100
"""Samples before and after a step that show whether it is a gap."""
_ROUNDS = 20
_REGULAR = 0.2
"""Largest distance of regular times from multiples of their period, in periods."""


def read_pair(
    wrench: Path, orientation: Path, calibration: CalibrationResult, name: str, delay_s: float | None
) -> tuple[Recording, dict[str, float]]:
    """Read and pair two files.

    Parameters
    ----------
    wrench, orientation : Path
        As `read_wrench` and `read_orientation` take them.
    calibration : CalibrationResult
    name : str
        Of the calibration.
    delay_s : float, optional
        Of the wrench after the orientation; None estimates it.

    Returns
    -------
    recording : Recording
        The devices are unknown.
    delay : dict
        `value` in s and `sigma`, one standard deviation, which is 0 if the delay was given.

    Raises
    ------
    BadDataset
        A file cannot be used, or the two have no time in common.
    """
    samples, states = read_wrench(wrench), read_orientation(orientation)
    unknown, sigma_s = np.full(3, np.nan), 0.0
    sensor_rate_Hz = mean_rate_Hz(samples.t_host_ns)
    if delay_s is None:  # from the samples without contact, which would be taken for a delay
        first = pair_recording(samples, states, 0.0)
        free = free_samples(calibration.compensate(first.raw, first.R_base_flange), sensor_rate_Hz)
        estimator = DelayEstimator(calibration, unknown, window=_WHOLE)
        pair_recording(samples.rows(np.isin(samples.seq, first.seq[free])), states, estimator)
        delay_s, sigma_s = estimator.delay_s, estimator.sigma_s
    paired = pair_recording(samples, states, delay_s)
    info = StreamInfo(
        calibration=calibration,
        calibration_name=name,
        arm=DeviceInfo("unknown", NOT_REPORTED, NOT_REPORTED),
        sensor=DeviceInfo("unknown", NOT_REPORTED, NOT_REPORTED),
        tool="",
        utc_offset_ns=0,
        sensor_rate_Hz=sensor_rate_Hz,
        arm_rate_Hz=mean_rate_Hz(states.t_host_ns),
        p_flange_sensor_m=unknown,
        R_flange_tcp=np.eye(3),
        p_flange_tcp_m=unknown,
        versions=versions(),
    )
    recording = Recording(Header(info, WrenchFrame(), Stages()), rows_of(paired), [])
    return recording, {"value": delay_s, "sigma": sigma_s}


def read_wrench(path: Path) -> FtSamples:
    """Read columns t in s, fx, fy, fz in N, tx, ty, tz in N·m. Raises `BadDataset`.

    Samples are numbered by their times, see `numbers_of`.
    """
    t_s, wrench, _ = _table(path, lambda _: CHANNELS, ", ".join(CHANNELS))
    return FtSamples.of(_ns(t_s), numbers_of(t_s), wrench)


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
    for _ in range(_ROUNDS):  # the period is that of all samples, the missing ones included
        before, number = number, _with_gaps(t_s, float(t_s[-1] - t_s[0]) / int(number[-1]))
        if np.array_equal(number, before):
            break
    return number


def _with_gaps(t_s: Array, period_s: float) -> NDArray[np.int64]:
    """Number samples (n,) of a known period."""
    number = np.arange(len(t_s))
    if period_s == 0:
        return number
    steps = np.diff(t_s) / period_s
    late = t_s / period_s - number
    earliest = minimum_filter1d(late, _NEAR, mode="nearest", origin=(_NEAR - 1) // 2)  # of a sample and those before
    following = minimum_filter1d(late, _NEAR, mode="nearest", origin=-_NEAR // 2)  # and those after
    possible = np.flatnonzero((steps > 1.5) & (following[1:] - earliest[:-1] > 0.4))
    for last in possible[np.argsort(-steps[possible])].tolist():  # where the samples beside it are less late
        near = slice(max(last + 1 - _NEAR, 0), last + 1), slice(last + 1, last + 1 + _NEAR)
        before, after = (t_s[rows] / period_s - number[rows] for rows in near)
        missing = min(np.median(after) - np.median(before), after.min() - before.min())
        number[last + 1 :] += max(round(float(missing)), 0)
    return number


def read_orientation(path: Path) -> ArmStates:
    """Read columns t in s and the orientation of the flange in base; position and joints are NaN. Raises `BadDataset`.

    The orientation is a matrix r11..r33, a quaternion qx, qy, qz, qw, or a rotation vector rx, ry, rz in rad.
    """
    t_s, numbers, columns = _table(path, orientation_columns, ORIENTATION_FORMS)
    try:
        R = rotations_of(columns, numbers)
    except BadDataset as error:
        raise BadDataset(f"{path.name}: {error}") from error
    unknown = np.full((len(t_s), 6), np.nan)
    return ArmStates(_ns(t_s), unknown[:, 0], unknown, unknown, R, unknown[:, :3])


def _ns(t_s: Array) -> NDArray[np.int64]:
    return np.rint(t_s * 1e9).astype(np.int64)


def _table(
    path: Path, columns_of: Callable[[Sequence[str]], Sequence[str]], wanted: str
) -> tuple[Array, Array, Sequence[str]]:
    """Return times (n,), the columns that are chosen by the names of all (n, k), and their names."""
    with path.open(encoding="utf-8-sig", errors="replace", newline="") as file:
        names = [name.strip() for name in next(csv.reader(file), [])]
        found = columns_of(names)
        if not {"t", *found} <= set(names):
            raise BadDataset(f"{path.name}: the first row must name t and {wanted}; it names {', '.join(names)}")
        try:
            table = np.loadtxt(file, delimiter=",", usecols=[names.index(name) for name in ("t", *found)], ndmin=2)
        except ValueError as error:
            raise BadDataset(f"{path.name}: {error}: correct this line") from error
    if len(table) < 2:
        raise BadDataset(f"{path.name}: it has {len(table)} rows: at least 2 are needed")
    wrong = ~np.isfinite(table).all(axis=1) | (np.diff(table[:, 0], prepend=table[0, 0]) < 0)
    if wrong.any():
        row = int(np.argmax(wrong))
        raise BadDataset(f"{path.name}: row {row + 1}: a number is not finite, or t = {table[row, 0]:g} goes back")
    return table[:, 0], table[:, 1:], found
