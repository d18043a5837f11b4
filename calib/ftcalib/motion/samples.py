"""Samples of sensor and arm in motion: their measurement times, and their reduction to the rows of the estimator.

A sample is received some time after it was measured, and never before. `SampleClock` and `measured_s` therefore fit a
straight line below the times of receipt, as a function of the device's own count. The device's clock may drift slowly.

Two steps reduce a recording while it is read. `Means` averages each stream over 10 ms, so memory per second of
recording is constant. `motion_rows` converts both streams to one clock, differentiates the poses, and applies the same
zero-phase filter to wrench and motion, which gives 8 rows per second.

The wrench is linear in the orientation R, the acceleration a of the flange origin and `Omega` = [alpha]x + [omega]x²
(all in flange axes). Products of poses are formed before filtering, so the filter affects both sides equally.
"""

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise, permutations
from typing import Self

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from ftcalib.data.dataset import LARGEST
from ftcalib.errors import BadDataset
from ftcalib.model import Array, skew

MEAN_S = 0.01
# Rows whose filter window contains a longer gap (or, in a slower stream, a gap of three periods) are left out.
GAP_S = 0.06

# Longest gap in the times of a recording, s. Longer ones mean two recordings or wrong times, and are rejected.
LONGEST_GAP_S = 86400.0
# A typical step longer than this, s, means that the times are in another unit. Each unit has a longest step.
LONGEST_STEP_S = 0.25
_TIME_UNITS = (("ms", 300.0), ("µs", 3e5), ("ns", np.inf))
# Largest time, s: the number of 10 ms intervals must fit in 64 bits.
LATEST_S = 1e11

# (11, 3) value and first two derivatives of a quartic fitted to 110 ms of poses; the response is flat over the band.
_FIT = np.linalg.pinv(np.vander(MEAN_S * np.arange(-5, 6), 5, increasing=True))[:3].T * [1.0, 1.0, 2.0]
# A 10 ms mean is discarded if the total weight of its samples is below this.
_LEAST_WEIGHT = 1e-3
# Number of rows filtered at once.
_CHUNK = 600
# Lever that converts a translational speed to an angular speed, m.
_LEVER_M = 0.5

_BUCKET_S, _BUCKETS = 0.25, 40
_LEAST_SCATTER_NS = 1e4
CLOCK_TOLERANCE, RATE_TOLERANCE = 2e-4, 3e-3
"""Relative error of a device's clock, and of the nominal rate of a sensor without one, one sigma."""
_IMPLAUSIBLE = 4.0
# Time stamps never jump or go back: they approach a better estimate at this fraction of the elapsed time.
_SLEW = 0.05
# Beyond this distance (ns) from a better estimate the times approach it faster, up to this fraction.
_FAR_NS, _FASTEST_SLEW = 2e8, 0.9
# If so many successive buckets are later than the line by similar amounts above this limit (ns), samples were lost
# without being counted, and the line is discarded.
_STEP_BUCKETS, _STEP_NS = 8, 5e6
# A device whose count deviates from the line by more than this time has restarted.
_LOST_S = 1.0
# Number of parts of a recording; of each part only the least delayed sample is used.
_PARTS = 200

# Interval between rows, a multiple of `MEAN_S`. The bandwidth of 4.7 Hz is below gear ripple and arm vibration, and
# above the motion of the arm. A contact affects only a few such rows.
WIDE_S = 0.12
# Interval for a bandwidth of 2 Hz: gears of slowly rotating joints shake the tool at 2 to 5 Hz.
NARROW_S = 0.28


class SampleClock:
    """Measurement times of the samples of one device: a line below the times of receipt, updated while samples arrive.

    Each quarter of a second contributes its least delayed sample. The line lies below those of the last ten seconds.

    Parameters
    ----------
    period_s : float
        Nominal duration of one count: 1 for a clock in seconds, 1 / rate for a sample number.
    tolerance : float
        Relative error of that duration, one standard deviation. The nominal duration is used as long as the times of
        receipt scatter too much to show the rate, for example on a busy computer.
    """

    def __init__(self, period_s: float = 1.0, tolerance: float = CLOCK_TOLERANCE) -> None:
        self.shift_s = 0.0
        """Offset that is subtracted from every time stamp, s; a change takes effect gradually."""
        self._nominal_ns = period_s * 1e9
        self._tolerance = tolerance
        self.restart()

    def restart(self) -> None:
        """Discard the fitted clock line after an interruption, during which the device may not have counted."""
        self._points: deque[tuple[float, float]] = deque(maxlen=_BUCKETS)
        self._origin: tuple[float, int] | None = None
        self._slope, self._offset = self._nominal_ns, 0.0
        self._last: tuple[float, float] | None = None

    def stamp(self, count: Array, t_host_ns: NDArray[np.int64]) -> NDArray[np.int64]:
        """Return the measurement times (n,), ns, of samples with counts (n,) and times of receipt (n,) in ns."""
        if self._origin is None:
            self._origin = float(count[0]), int(t_host_ns[0])
        x, y = count - self._origin[0], (t_host_ns - self._origin[1]).astype(np.float64)
        behind_ns = y - self._slope * x
        k = int(np.argmin(behind_ns))
        if self._last is not None and (
            # the device has restarted
            x[0] < self._last[0] or abs(behind_ns[k] - self._offset) > _LOST_S * 1e9
        ):
            self.restart()
            return self.stamp(count, t_host_ns)
        self._note(float(x[k]), float(y[k]))
        end = self._slope * x[-1] + self._offset - self.shift_s * 1e9
        if self._last is None:
            times = self._slope * (x - x[-1]) + end
        else:
            x_0, y_0 = self._last
            # the device's clock has coarse steps
            if x[-1] <= x_0:
                return np.full(len(x), self._origin[1] + round(y_0), np.int64)
            due = self._slope * (x[-1] - x_0)
            slew = min(max(_SLEW, abs(end - y_0 - due) / _FAR_NS), _FASTEST_SLEW)
            end = min(max(end, y_0 + (1 - slew) * due), y_0 + (1 + slew) * due)
            times = y_0 + (x - x_0) * ((end - y_0) / (x[-1] - x_0))
        self._last = float(x[-1]), float(end)
        return np.asarray(self._origin[1] + np.rint(times).astype(np.int64))

    def _note(self, x: float, y: float) -> None:
        """Keep the least delayed sample of each quarter of a second, and fit the line below these samples."""
        width = _BUCKET_S * 1e9 / self._slope
        if not self._points or x // width > self._points[-1][0] // width:
            self._points.append((x, y))
            late = list(self._points)[-_STEP_BUCKETS - 1 : -1]
            by_ns = [b - self._slope * a - self._offset for a, b in late]
            if len(late) == _STEP_BUCKETS and min(by_ns) > max(_STEP_NS, 0.7 * max(by_ns)):
                # samples were lost without being counted
                self._points = deque([*late, (x, y)], maxlen=_BUCKETS)
        elif y - self._slope * x < self._points[-1][1] - self._slope * self._points[-1][0]:
            self._points[-1] = x, y
        elif len(self._points) > 1:
            return
        if len(self._points) > 1:
            x_0, y_0, slope = _line_below(self._points)
            above_ns = sum(b - y_0 - slope * (a - x_0) for a, b in self._points) / len(self._points)
            error = (above_ns + _LEAST_SCATTER_NS) / ((self._points[-1][0] - self._points[0][0]) * self._nominal_ns)
            weight = 1 / (1 + (error / self._tolerance) ** 2)
            if abs(slope / self._nominal_ns - 1) > _IMPLAUSIBLE * self._tolerance:
                # too fast for a drift of the clock: the transmission delay grows
                weight = 0.0
            self._slope = weight * slope + (1 - weight) * self._nominal_ns
        self._offset = min(b - self._slope * a for a, b in self._points)


def measured_s(count: Array, t_host_ns: NDArray[np.int64], start_ns: int) -> Array:
    """Return the measurement times (n,) of a recording, s after `start_ns`: one line below all times of receipt.

    An overloaded computer may receive samples late for several seconds, but never early.
    """
    x, y = count - float(count[0]), (t_host_ns - start_ns) * 1e-9
    rough = (y[-1] - y[0]) / max(x[-1], 1.0)
    late_s = y - rough * x
    parts = [part for part in np.array_split(np.arange(len(x)), _PARTS) if len(part)]
    soonest = [part[np.argmin(late_s[part])] for part in parts]
    x_0, y_0, slope = _line_below(list(zip(x[soonest].tolist(), late_s[soonest].tolist(), strict=True)))
    return np.asarray(rough * x + y_0 + slope * (x - x_0))


def _line_below(points: Sequence[tuple[float, float]]) -> tuple[float, float, float]:
    """Return a point (x, y) and the slope of the line below all points with the smallest mean distance to them.

    The line is the edge of the lower convex hull at the mean x of the points: the clock skew estimator of Moon,
    Skelly, Towsley, "Estimation and removal of clock skew from network delay measurements", INFOCOM 1999.
    """
    hull: list[tuple[float, float]] = []
    for point in sorted(points):
        while len(hull) > 1 and _cross_of_edges(hull[-2], hull[-1], point) <= 0:
            hull.pop()
        hull.append(point)
    middle = sum(x for x, _ in points) / len(points)
    edges = (edge for edge in pairwise(hull) if edge[1][0] >= middle and edge[1][0] > edge[0][0])
    (x_0, y_0), (x_1, y_1) = next(edges, (hull[0], hull[0]))
    return x_0, y_0, (y_1 - y_0) / (x_1 - x_0) if x_1 > x_0 else 0.0


def _cross_of_edges(a: tuple[float, float], b: tuple[float, float], c: tuple[float, float]) -> float:
    return (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])


def row_filter(row_s: float) -> Array:
    """Return the weights (2 k + 1,), with sum 1, of the zero-phase filter that turns means over 10 ms into rows.

    White noise of the means stays white in the rows. The amplitude is halved at 0.56 times the row rate.
    """
    step = round(row_s / MEAN_S)
    half = round(3.36 * step)
    kernel = np.sinc(1.12 / step * np.arange(-half, half + 1)) * np.kaiser(2 * half + 1, 6.0)
    return np.asarray(kernel / kernel.sum())


class Means:
    """Weighted means of one stream at every multiple of 10 ms, accumulated piece by piece.

    The weights of samples fall linearly to 0 within 10 ms, so frequencies above 50 Hz are attenuated alike.
    """

    def __init__(self) -> None:
        self._parts: list[tuple[NDArray[np.int64], Array]] = []
        self._last_s = -np.inf
        self.samples = 0

    def add(self, t_s: Array, values: Array) -> None:
        """Add samples.

        Parameters
        ----------
        t_s : array, shape (n,)
            Times in ascending order, not before the samples added earlier.
        values : array, shape (n, k)

        Raises
        ------
        BadDataset
            The time goes back or jumps by more than a day, or a number is not finite or too large for a sensor.
        """
        if not len(t_s):
            return
        if t_s[0] < self._last_s or (np.diff(t_s) < 0).any():
            raise BadDataset("the times decrease: sort the samples by time")
        if not (np.isfinite(t_s).all() and np.isfinite(values).all()):
            raise BadDataset("a time or a value is not a finite number: remove these samples")
        if (bad := np.flatnonzero((np.abs(t_s) > LATEST_S) | (np.abs(values) > LARGEST).any(axis=1))).size:
            raise BadDataset(
                f"sample {self.samples + bad[0] + 1} at {t_s[bad[0]]:.6g} s has the value "
                f"{np.abs(values[bad[0]]).max():.3g}, more than any device reports: remove this sample"
            )
        steps = np.diff(t_s, prepend=self._last_s if self.samples else t_s[0])
        if steps[longest := int(steps.argmax())] > LONGEST_GAP_S:
            require_seconds(t_s, "the times")
            raise BadDataset(
                f"no sample for {steps[longest]:.3g} s before sample {self.samples + longest + 1} at "
                f"{t_s[longest]:.6g} s: split the recording there, or correct the times"
            )
        self._last_s, self.samples = float(t_s[-1]), self.samples + len(t_s)
        before = np.floor(t_s / MEAN_S)
        share = (t_s / MEAN_S - before)[:, None]
        first = np.flatnonzero(np.diff(before, prepend=-np.inf))
        rows = np.column_stack([np.ones(len(t_s)), t_s, values])
        after_sums = np.add.reduceat(rows * share, first)
        sums = np.concatenate([np.add.reduceat(rows, first) - after_sums, after_sums])
        cell = before[first].astype(np.int64)
        self._parts.append(_sum_cells(np.concatenate([cell, cell + 1]), sums))

    def result(self) -> tuple[Array, Array]:
        """Return the mean times (m,) and the means (m, k) of all 10 ms intervals that contain samples."""
        if not self._parts:
            raise BadDataset("the recording has no samples: record again")
        _, sums = _sum_cells(*(np.concatenate(each) for each in zip(*self._parts, strict=True)))
        # A mean with almost no weight, from samples at the edge of its interval, carries no information.
        sums = sums[sums[:, 0] > _LEAST_WEIGHT]
        t_s = sums[:, 1] / sums[:, 0]
        new = np.diff(t_s, prepend=-np.inf) > MEAN_S / 10  # two means of a slow stream may hold one sample
        return t_s[new], sums[new, 2:] / sums[new, :1]


def require_seconds(t_s: Array, name: str) -> None:
    """Raise `BadDataset` if the steps between the times (n,) of a stream are too long for times in seconds."""
    step = float(np.quantile(np.diff(t_s), 0.25, method="lower")) if len(t_s) > 1 else 0.0
    if step > LONGEST_STEP_S:
        unit = next(unit for unit, longest in _TIME_UNITS if step < longest)
        raise BadDataset(f"{name} increase in steps of {step:.3g} s and look like {unit}: give them in seconds")


def _sum_cells(cell: NDArray[np.int64], sums: Array) -> tuple[NDArray[np.int64], Array]:
    """Add up the sums of each 10 ms interval; return the interval numbers in ascending order, and their sums."""
    order = np.argsort(cell, kind="stable")
    cell = cell[order]
    first = np.flatnonzero(np.diff(cell, prepend=cell[0] - 1))
    return cell[first], np.add.reduceat(sums[order], first)


@dataclass(frozen=True, slots=True, eq=False)
class Motion:
    """Motion of the flange, n rows: the 21 numbers on which the wrench of a load depends linearly."""

    R_base_flange: Array
    """(n, 3, 3) filtered orientations."""
    acceleration_m_s2: Array
    """(n, 3) acceleration of the flange origin in flange axes, without gravity."""
    Omega_rad2_s2: Array
    """(n, 3, 3) skew(angular acceleration) + skew(angular velocity)², in flange axes."""

    def __getitem__(self, rows: slice | NDArray[np.intp] | NDArray[np.bool_]) -> Self:
        """Return the selected rows."""
        return type(self)(self.R_base_flange[rows], self.acceleration_m_s2[rows], self.Omega_rad2_s2[rows])

    def earlier(self, by_s: float, rate: "Motion") -> "Motion":
        """Return the motion `by_s` seconds earlier, to first order, from its rate of change."""
        return Motion(
            self.R_base_flange - by_s * rate.R_base_flange,
            self.acceleration_m_s2 - by_s * rate.acceleration_m_s2,
            self.Omega_rad2_s2 - by_s * rate.Omega_rad2_s2,
        )

    def columns(self) -> Array:
        """Return the 21 numbers of each row as an array (n, 21)."""
        n = len(self.acceleration_m_s2)
        return np.hstack([self.R_base_flange.reshape(n, 9), self.acceleration_m_s2, self.Omega_rad2_s2.reshape(n, 9)])

    @classmethod
    def of_columns(cls, columns: Array) -> Self:
        """Return the motion from the array (n, 21) that `columns` returns."""
        return cls(columns[:, :9].reshape(-1, 3, 3), columns[:, 9:12], columns[:, 12:].reshape(-1, 3, 3))


@dataclass(frozen=True, slots=True, eq=False)
class MotionRows:
    """Wrench and motion on one clock, with the same filter, wherever both have no gap."""

    t_s: Array
    wrench: Array
    """(n, 6) filtered wrench in the sensor frame, N and N·m."""
    motion: Motion
    rate: Motion
    """Rate of change of the 21 numbers of `motion`, per second."""
    speed_rad_s: Array
    """(n,) angular speed, plus the speed of the flange origin divided by 0.5 m."""
    delay_s: float
    """Assumed delay of the wrench relative to the poses, s."""
    row_s: float
    """Interval between rows, s."""

    def __len__(self) -> int:
        return len(self.t_s)

    def __getitem__(self, rows: slice | NDArray[np.intp] | NDArray[np.bool_]) -> Self:
        """Return the selected rows."""
        parts = self.t_s[rows], self.wrench[rows], self.motion[rows], self.rate[rows], self.speed_rad_s[rows]
        return type(self)(*parts, self.delay_s, self.row_s)


def motion_rows(
    wrench: tuple[Array, Array], poses: tuple[Array, Array], delay_s: float = 0.0, row_s: float = WIDE_S
) -> MotionRows:
    """Return wrench and motion as filtered rows on one clock.

    Parameters
    ----------
    wrench : tuple of array, shapes (n,) and (n, 6)
        Times and wrenches, from `Means.result`.
    poses : tuple of array, shapes (m,) and (m, 9) or (m, 12)
        Times, R_base_flange row by row, and the position of the flange if it is known. Without positions the
        acceleration is taken as 0.
    delay_s : float
        Delay of the wrench relative to the poses.
    row_s : float
        Interval between rows.

    Raises
    ------
    BadDataset
        Wrench and poses overlap by less than a second.
    """
    t_w, t_p = wrench[0], poses[0] + delay_s
    first, last = MEAN_S * np.ceil(max(t_w[0], t_p[0]) / MEAN_S), min(t_w[-1], t_p[-1])  # where the means are
    kernel, step = row_filter(row_s), round(row_s / MEAN_S)
    reach = len(kernel) // 2 + 1 + len(_FIT) // 2
    count = int((last - first) / MEAN_S) - 2 * reach
    if count < 1 / MEAN_S:
        raise BadDataset(
            f"wrench and poses overlap by only {max(last - first, 0):.1f} s: give files of one recording, on one clock"
        )
    poses = t_p, np.hstack([_continuous_quaternions(poses[1]), poses[1][:, 9:]])
    parts = [
        _chunk((t_w, wrench[1]), poses, first + MEAN_S * np.arange(start * step, end * step + 2 * reach), kernel, step)
        for start in range(0, count // step, _CHUNK)
        for end in [min(start + _CHUNK, count // step)]
        if start == 0 or _has_samples(t_w, first + MEAN_S * start * step, first + MEAN_S * (end * step + 2 * reach))
    ]
    t, y, columns, rates, speed = (np.concatenate(each) for each in zip(*parts, strict=True))
    return MotionRows(t, y, Motion.of_columns(columns), Motion.of_columns(rates), speed, delay_s, row_s)


def interpolation_error_rad(poses: tuple[Array, Array]) -> float:
    """Return the rms error, rad, of every second orientation when it is interpolated from the others.

    The error is large if the pose rate is too low for the motion, or if the times do not belong to the samples.
    """
    if len(poses[0]) < 9:
        return 0.0
    t_s, quaternion = poses[0], _continuous_quaternions(poses[1])
    inner = slice(1, len(t_s) - 1 - len(t_s) % 2, 2)
    between = _interpolate(t_s[inner], t_s[::2], quaternion[::2])[0]
    between /= np.linalg.norm(between, axis=1, keepdims=True)
    return float(np.sqrt(np.mean(np.sum((2 * _conjugate_product(between, quaternion[inner])) ** 2, axis=1))))


def _continuous_quaternions(values: Array) -> Array:
    """Return the quaternions (m, 4) of rotation matrices (m, 9); neighbours have consistent signs."""
    quaternion = Rotation.from_matrix(values[:, :9].reshape(-1, 3, 3)).as_quat()
    # q and -q are the same rotation, but interpolation needs neighbours of equal sign.
    turned = np.sum(quaternion[1:] * quaternion[:-1], axis=1) < 0
    quaternion[1:] *= np.where(np.cumsum(turned) % 2, -1.0, 1.0)[:, None]
    return np.asarray(quaternion)


def _has_samples(t_s: Array, start_s: float, end_s: float) -> bool:
    """Whether a sample lies between two times; if not, this part of the recording is a gap and is skipped."""
    before, after = np.searchsorted(t_s, [start_s, end_s])
    return bool(after > before)


def _chunk(
    wrench: tuple[Array, Array], poses: tuple[Array, Array], grid: Array, kernel: Array, step: int
) -> tuple[Array, ...]:
    """Return times, wrenches, motion columns, their rates and speeds of the rows without a gap in the filter window."""
    rate_kernel = np.convolve(kernel, [-0.5 / MEAN_S, 0.0, 0.5 / MEAN_S])  # filters and differentiates at once
    kernel = np.pad(kernel, 1)
    (y, whole_w), (pose, whole_p) = _interpolate(grid, *wrench), _interpolate(grid, *poses)
    fits = np.einsum("nkw,wd->dnk", sliding_window_view(pose, len(_FIT), axis=0), _FIT)
    length = np.linalg.norm(fits[0, :, :4], axis=1, keepdims=True)
    unit = fits[:, :, :4] / length
    R = Rotation.from_quat(unit[0]).as_matrix()
    omega, alpha = (2 * _conjugate_product(unit[0], unit[k]) for k in (1, 2))
    velocity, acceleration = (fits[k, :, 4:] if pose.shape[1] > 4 else np.zeros((len(R), 3)) for k in (1, 2))
    W = skew(omega)
    Omega = skew(alpha) + W @ W
    a = np.einsum("nji,nj->ni", R, acceleration)
    motion = Motion(R + MEAN_S**2 / 12 * R @ Omega, a, Omega)  # R becomes its mean over 10 ms, like the wrench
    speed = np.linalg.norm(omega, axis=1) + np.linalg.norm(velocity, axis=1) / _LEVER_M
    inner = slice(len(_FIT) // 2, len(grid) - len(_FIT) // 2)
    windows = sliding_window_view(motion.columns(), len(kernel), axis=0)[::step]
    whole = np.all(sliding_window_view((whole_w & whole_p)[inner], len(kernel))[::step], axis=1)
    first = len(kernel) // 2 + len(_FIT) // 2
    return (
        grid[first::step][: len(whole)][whole],
        (sliding_window_view(y[inner], len(kernel), axis=0)[::step] @ kernel)[whole],
        (windows @ kernel)[whole],
        (windows @ rate_kernel)[whole],
        sliding_window_view(speed, len(kernel))[::step].mean(axis=1)[whole],
    )


def _interpolate(grid: Array, t_s: Array, values: Array) -> tuple[Array, NDArray[np.bool_]]:
    """Interpolate with a cubic through the four samples around each time; also return where there is no gap (n,)."""
    steps = np.diff(t_s)
    after = np.clip(np.searchsorted(t_s, grid), 1, len(t_s) - 1)
    whole = steps[after - 1] < max(GAP_S, 3 * float(np.median(steps)))
    around = np.clip(after, 2, len(t_s) - 2)[:, None] + [-2, -1, 0, 1]
    x = grid[:, None] - t_s[around]
    weights = np.ones_like(x)
    for i, j in permutations(range(4), 2):
        weights[:, i] *= x[:, j] / (t_s[around[:, j]] - t_s[around[:, i]]) * -1
    return np.einsum("nk,nkc->nc", weights, values[around]), whole


def _conjugate_product(q: Array, r: Array) -> Array:
    """Return the vector part (n, 3) of conj(q) r for quaternions (x, y, z, w)."""
    v, w = q[:, :3], q[:, 3:]
    return np.asarray(w * r[:, :3] - r[:, 3:] * v - np.cross(v, r[:, :3]))
