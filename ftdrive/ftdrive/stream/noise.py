"""States of motion of the arm, the sensor noise in each state, and weighted means of short windows of a stream."""

from collections import deque
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import maximum_filter1d

from ftcalib import CalibrationResult
from ftcalib.compensation import Compensator, MovedLoad
from ftcalib.data.dwell_mean import RESOLUTION
from ftcalib.model import Parameters, skew
from ftdrive.stream.samples import Paired, StreamInfo, gripping_point
from ftdrivers.interfaces import Array

READING_S = 0.02
"""Duration of a reading, s: the mean of its samples. Contacts are detected from readings."""
GYRATION_M = 0.08
"""Radius of gyration of a tool or part with unknown inertia, m."""
REST = 0
SPEEDS_RAD_S = (0.15, 0.4, 0.7)
"""Limits between the speed classes of motion: angular speed plus flange speed divided by 0.5 m, rad/s."""
ACCELERATION_RAD_S2 = 1.5
"""Limit between the two acceleration classes: angular plus flange acceleration (not centripetal) / 0.5 m."""
SLOW = 2
"""Only the slow speed classes are divided by acceleration: at higher speeds ringing and ripple do not depend on it."""
STATES = 1 + len(SPEEDS_RAD_S) + 1 + SLOW
"""Number of states of motion: rest, then the classes of motion. The noise is estimated for each state."""

# Largest change of the mean pose between consecutive readings of a resting arm; joint noise is 3e-5 rad.
_STILL_RAD, _STILL_M = 2e-4, 2e-4
# Displacement of the tool's centre of mass, m, above which its inertial wrench counts, before motion is detected.
_FELT_M = 4e-5
# Rest begins the first time, s, after the last sample in motion, and a state of motion ends the second: the links ring.
_HOLD_S, _RINGS_S = 0.5, 0.4
_LEVER_M = 0.5
_SPEEDS = np.array(SPEEDS_RAD_S)

# Number of consecutive readings in a window for the noise: at rest, and in motion or in a short rest.
_WINDOW, _SHORT = 25, 8
# The last readings at rest before a detected motion, this many, are not used: the motion may have begun unseen.
_UNSEEN = 4
_WINDOWS = 60
# A window whose noise exceeds the median by this factor contains a touch or a jolt, and is not used.
_LOUD = {True: 1.5, False: 4.0}
# A step between the means of two windows of more than this counts as start or end of a contact, not as noise.
_STEP_SIGMAS = 5.0
# Noise assumed in motion until it is measured: this multiple of that at rest, plus that of an acceleration, one sigma.
_FIRST_MOTION, _FIRST_M_S2 = 10.0, 1.0
_ENOUGH_DOF = 25.0
# Degrees of freedom per reading, less than 1 because low-pass filters of sensors correlate consecutive readings.
_INDEPENDENT = 0.25


def samples_in_reading(rate_Hz: float) -> int:
    """Return the number of samples that are averaged in one reading, which takes `READING_S`."""
    return max(1, round(READING_S * rate_Hz))


class MotionTracker:
    """Classify each sample as at rest or in motion, from poses averaged over each reading of the sensor.

    Rest begins after 0.5 s without motion. The motion includes the motion of the tool's centre of mass. If the position
    of the sensor is unknown (NaN), its origin is taken to be that of the flange.
    """

    def __init__(self, rate_Hz: float, mass_kg: float, parameters: Parameters, p_flange_sensor_m: Array) -> None:
        self._size = samples_in_reading(rate_Hz)
        self._step_s = self._size / rate_Hz
        self._hold = round(_HOLD_S * rate_Hz)
        by_acceleration = wrench_by_acceleration(mass_kg, parameters.p_sensor_com_m) @ parameters.R_flange_sensor.T
        # (6, 3) inertial wrench per second difference of the centre of mass positions, flange axes, N/m and N.
        self._felt_by_change = -by_acceleration / self._step_s**2
        self._p_flange_com_m = np.nan_to_num(p_flange_sensor_m) + parameters.R_flange_sensor @ parameters.p_sensor_com_m
        self._earlier: Array | None = None
        # Number of samples since the last one in motion.
        self._since = self._hold
        self._classes = np.zeros(round(_RINGS_S * rate_Hz), np.int8)

    def follow(self, R_base_flange: Array, p_base_flange_m: Array) -> tuple[NDArray[np.int8], Array]:
        """Return states of motion (n,), `REST` or a class, and the inertial wrench (n, 6) that the poses so far show.

        The wrench is in N and N·m, sensor axes; zero if the poses show no motion. Unknown positions count as constant.
        """
        n, k = len(R_base_flange), self._size
        if not n:
            return np.zeros(0, np.int8), np.zeros((0, 6))
        turned_m = (R_base_flange.reshape(-1, 3) @ self._p_flange_com_m).reshape(n, 3)
        p_base_com_m = np.where(np.isfinite(p_base_flange_m), p_base_flange_m, 0.0) + turned_m
        # (12, n), because sums along long rows are faster
        poses = np.concatenate([R_base_flange.reshape(n, 9).T, p_base_com_m.T])
        if self._earlier is None:
            self._earlier = np.repeat(poses[:, :1], 3 * k, axis=1)
        poses = np.concatenate([self._earlier, poses], axis=1)
        self._earlier = poses[:, n:].copy()
        # use means over a reading, because the joint noise of single poses looks like motion
        sums = np.cumsum(poses, axis=1) / k
        moved = sums[:, 2 * k :] - 2 * sums[:, k:-k] + sums[:, : -2 * k]
        before, moved = moved[:, :n], moved[:, k:]
        change, far = moved - before, np.abs(moved)
        moves = (far[:9] > _STILL_RAD).any(axis=0) | (far[9:] > _STILL_M).any(axis=0)
        newest = np.maximum.accumulate(np.where(moves, np.arange(n), -1 - self._since))
        self._since = int(n - 1 - newest[-1])
        moving = np.arange(n) - newest < self._hold
        felt = self._felt(R_base_flange, moved[9:], change[9:])
        # shortcut for the usual block of a live stream, which halves the time
        if not (moving.any() or self._classes.any()):
            return np.full(n, REST, np.int8), felt
        speed = self._rate(moved) / self._step_s
        changes = self._rate(change) / self._step_s**2 > ACCELERATION_RAD_S2 + speed**2
        fast = _SPEEDS.searchsorted(speed)
        number = 1 + fast + np.minimum(fast, SLOW) + (changes & (fast < SLOW))
        present = np.where(moves, number, REST).astype(np.int8)
        classes = np.concatenate([self._classes, present])
        self._classes = classes[n:]
        w = len(classes) - n + 1
        rung = maximum_filter1d(classes, w, origin=(w - 1) // 2, mode="constant")[
            w - 1 :
        ]  # the largest class of this row and of those before
        return np.where(moving, np.maximum(rung, 1), REST).astype(np.int8), felt

    @staticmethod
    def _rate(moved: Array) -> Array:
        """Return displacements (n,) as one angle, rad: rotation plus translation divided by `_LEVER_M`."""
        squares = np.square(moved)
        return np.asarray(np.sqrt(squares[:9].sum(axis=0) / 2) + np.sqrt(squares[9:].sum(axis=0)) / _LEVER_M)

    def _felt(self, R_base_flange: Array, moved_m: Array, change_m: Array) -> Array:
        felt = np.square(moved_m).sum(axis=0) > _FELT_M**2
        wrench = np.zeros((len(felt), 6))
        if felt.any():
            change_flange_m = np.einsum("nij,in->nj", R_base_flange[felt], change_m[:, felt])
            wrench[felt] = change_flange_m @ self._felt_by_change.T
        return wrench


def wrench_by_acceleration(mass_kg: float, p_sensor_com_m: Array) -> Array:
    """Return the wrench (6, 3) of a load per acceleration of its centre of mass, N and N·m per m/s², sensor axes."""
    return mass_kg * np.concatenate([np.eye(3), skew(p_sensor_com_m)])


@dataclass(frozen=True, slots=True, eq=False)
class SensorNoise:
    """Covariances of the white and coloured sensor noise, N and N·m, sensor axes."""

    sample: Array
    """(6, 6) covariance of one sample."""
    reading: Array
    """(6, 6) covariance of a reading, the mean over `READING_S`, about the linear trend of half a second."""
    wander: Array
    """(6, 6) covariance of the slower part of the noise, which changes from one half second to the next."""
    dof: float
    """Degrees of freedom: number of independent readings in the estimate."""


class NoiseEstimator:
    """Noise covariances from the latest windows of each state of motion.

    The scatter of readings is taken about a straight line through a window. At rest, the differences between the means
    of consecutive windows are used as well. Bias, drift, a constant contact and slow errors of a calibration therefore
    have no effect. A window belongs to its fastest state of motion; readings just before motion are not used for rest,
    because the wrench changes before the motion is visible. `accelerated` (6, 3) is the wrench of the load per
    acceleration, for the assumed vibration until the noise in motion is known.
    """

    def __init__(self, rate_Hz: float, accelerated: Array) -> None:
        self._size = samples_in_reading(rate_Hz)
        self._unread = np.empty((0, 7))
        self._at_rest = True
        # Mean (6), scatter (6, 6) and state of motion per reading since the last window, or start or end of motion.
        self._open = np.empty((0, 43))
        self._mean_before: Array | None = None
        # Per window: scatter of readings, scatter of samples within readings, step from the previous window.
        self._windows: list[deque[tuple[Array, Array, Array]]] = [deque(maxlen=_WINDOWS) for _ in range(STATES)]
        self._known: dict[int, SensorNoise] = {}
        self._first = _FIRST_M_S2**2 * accelerated @ accelerated.T

    def of(self, state: int) -> SensorNoise | None:
        """Return the noise in a state of motion, assumed until measured for 1 s; None in the first half second."""
        known, rest = self._known.get(state), self._known.get(REST)
        other = rest or next(iter(self._known.values()), None)
        if state == REST or other is None:
            return other
        # A new class of motion uses the noise of a faster class for about 2 s.
        if known is None or known.dof < _ENOUGH_DOF:
            learnt = (one for k, one in sorted(self._known.items()) if k > state and one.dof >= _ENOUGH_DOF)
            if (faster := next(learnt, None)) is not None:
                return faster
            reading = _FIRST_MOTION**2 * other.reading if rest else other.reading
            return replace(other, sample=other.sample + self._first, reading=reading + self._first)
        return known if rest is None else replace(known, wander=rest.wander)

    def add(self, residual: Array, states: NDArray[np.int8]) -> None:
        """Add samples (n, 6) minus the predicted wrench of a free tool, and their states of motion (n,)."""
        rows = np.concatenate([self._unread, np.column_stack([residual, states])])
        n = len(rows) // self._size
        self._unread = rows[n * self._size :]
        if not n:
            return
        groups = rows[: n * self._size].reshape(n, self._size, 7)
        means = groups[:, :, :6].mean(axis=1)
        inside = groups[:, :, :6] - means[:, None]
        within = np.einsum("nsi,nsj->nij", inside, inside).reshape(n, 36) / self._size
        readings = np.column_stack([means, within, groups[:, :, 6].max(axis=1)])
        at_rest = readings[:, 42] == REST
        edges = np.flatnonzero(np.diff(at_rest)) + 1
        for run, rest in zip(np.split(readings, edges), np.split(at_rest, edges), strict=True):
            self._collect(run, at_rest=bool(rest[0]))

    def _collect(self, readings: Array, *, at_rest: bool) -> None:
        if at_rest is not self._at_rest:
            short = self._open[: max(len(self._open) - _UNSEEN, 0)]
            if self._at_rest and len(short) >= _SHORT:
                self._add_windows([short])
            self._at_rest, self._open, self._mean_before = at_rest, self._open[:0], None
        self._open = np.concatenate([self._open, readings])
        size, later = (_WINDOW, _UNSEEN) if at_rest else (_SHORT, 0)
        full = max(len(self._open) - later, 0) // size
        self._add_windows(list(self._open[: full * size].reshape(full, size, 43)[-_WINDOWS - 1 :]))
        self._open = self._open[full * size :]

    def _add_windows(self, windows: Sequence[Array]) -> None:
        changed = set()
        for window in windows:
            size = len(window)
            left = _about_line(size) @ window[:, :6]
            mean = window[:, :6].mean(axis=0)
            step = np.full(6, np.nan) if self._mean_before is None else mean - self._mean_before
            self._mean_before = mean
            state = int(window[:, 42].max())
            within = window[:, 6:42].mean(axis=0).reshape(6, 6)
            self._windows[state].append((left.T @ left / (size - 2), within, step))
            changed.add(state)
        for state in changed:
            self._known[state] = self._estimated(state)

    def _estimated(self, state: int) -> SensorNoise:
        at_rest = state == REST
        reading, within, steps = (np.array([window[i] for window in self._windows[state]]) for i in range(3))
        floor = RESOLUTION**2 / self._size
        variances = np.diagonal(reading, axis1=1, axis2=2)
        loudness = (variances / (np.median(variances, axis=0) + floor)).mean(axis=1)
        quiet = loudness <= _LOUD[at_rest] * np.median(loudness)
        mean = reading[quiet].mean(axis=0) + np.diag(floor)
        steps = steps[np.isfinite(steps[:, 0])]
        if len(steps):
            # 0.1015 is the 25 % quantile of chi² with one degree of freedom
            smallest = np.quantile(np.square(steps), 0.25, axis=0) / 0.1015
            usual = np.sqrt(smallest + np.diag(mean) / _WINDOW)
            steps = steps[(np.abs(steps) < _STEP_SIGMAS * usual).all(axis=1)]
        wander = steps.T @ steps / max(len(steps), 1)
        dof = _INDEPENDENT * (_WINDOW if at_rest else _SHORT) * float(quiet.sum())
        return SensorNoise(mean + within[quiet].mean(axis=0), mean, wander, dof)


@lru_cache
def _about_line(n: int) -> Array:
    """Return the matrix (n, n) that subtracts the fitted straight line from n values."""
    basis = np.stack([np.ones(n), np.linspace(-1, 1, n)], axis=1)
    return np.asarray(np.eye(n) - basis @ np.linalg.pinv(basis))


def variance_at_next_use(calibration: CalibrationResult) -> Array:
    """Return the error variance (6,) per axis that misfit and drift add to the predicted one, in any orientation."""
    excess = np.square(calibration.likely_error("workspace")) - np.square(calibration.predicted_error())
    return np.repeat(excess.clip(0.0) / 3, 3)


def unexplained_variance(calibration: CalibrationResult) -> Array:
    """Return `variance_at_next_use` (6,), or zeros if noise alone explains the residuals of the calibration."""
    return np.zeros(6) if calibration.noise_explains else variance_at_next_use(calibration)


# ------------------------------------------------------------------------------------------------------------ windows

# Ringing at 8 to 20 Hz leaves 0.06 N in plain means at the end of a move, and 0.01 N with Hann weights.
WINDOW_S = 0.3
"""Duration of a window, s; windows overlap by half. Hann weights suppress the ringing of the links."""
# The acceleration is computed from poses at this spacing, s, with this many neighbours on each side.
_KNOT_S, _REACH = 0.004, 5
# Assumed error of a calibrated inertia tensor of the tool, as a fraction of that of an unknown one.
_TENSOR = 0.5
# A window whose duration exceeds the usual one by this factor has lost samples, and is dropped.
_LATE = 1.2
# Windows are dropped until the noise estimate has these degrees of freedom: the first half second may contain a push.
_LEAST_DOF = 10.0
_ROW = np.dtype(
    [
        ("state", "i1"),
        ("t_host_ns", "i8"),
        ("raw", "f8", 6),
        ("R_base_flange", "f8", (3, 3)),
        ("p_base_flange_m", "f8", 3),
    ],
    align=True,
)
# A larger change between the poses of two consecutive samples means that samples were lost.
_JUMP = 0.1
# Sigma of the acceleration, m/s², assumed in motion for an arm that reports no positions.
_UNKNOWN_M_S2 = 1.0
# Ratio of the variances of a window's mean and of a reading for white noise; for vibration the ratio is smaller.
_LIKE_WHITE = 1.5 * READING_S / WINDOW_S


@dataclass(frozen=True, slots=True, eq=False)
class Window:
    """Weighted mean of the samples of `WINDOW_S`, the measurement of the free-tool filter."""

    t_s: float
    residual: Array
    """(6,) measured wrench minus that predicted for the tool without a held part, N and N·m, sensor axes."""
    felt_m_s2: Array
    """(3,) gravity minus acceleration of the sensor origin, sensor axes."""
    lever_s2: Array
    """(3, 3) acceleration of a point per unit of its position relative to the sensor origin, as the sensor turns."""
    p_sensor_near_m: Array
    """(3,) point at which the gripper holds parts, sensor frame."""
    noise: Array
    """(6, 6) noise covariance of the window, used until it is estimated from windows."""
    state: int
    """Fastest state of motion among the samples, as `MotionTracker.follow` returns it."""
    systematic: Array
    """(6, 6) covariance of the wrench predicted for the tool in this orientation."""
    turning_rad_s2: float
    """Mean angular acceleration of the tool."""
    tensor_Nm: float
    """Sigma of the torque exerted by the unknown part of the tool's inertia."""
    R_base_flange: Array
    p_base_flange_m: Array
    as_read: Array
    """(6, 6) matrix from the true wrench of a held part to the wrench that the sensor reads."""


class Windows:
    """Forms overlapping windows from the samples of a stream."""

    def __init__(self, info: StreamInfo) -> None:
        calibration = info.calibration
        self._calibration, self._tool = calibration, calibration.parameters
        self._compensator = Compensator(self._tool, response=calibration.response)
        self._inertia = None if calibration.motion is None else calibration.motion.inertia_kg_m2
        self._near_m = gripping_point(info)
        self._load = MovedLoad(self._tool, calibration.g_m_s2, np.nan_to_num(info.p_flange_sensor_m), _REACH)
        contact = calibration.known_contact
        # the bias is added to the raw reading, while the weight of a part is a true wrench
        self._as_read = np.eye(6) if contact is None else np.asarray(np.linalg.inv(contact.decode(np.eye(6)).T))
        self._size = round(WINDOW_S * info.sensor_rate_Hz)
        self._stride = max(1, round(_KNOT_S * info.sensor_rate_Hz))
        self._weights = np.hanning(self._size + 2)[1:-1] / (np.hanning(self._size + 2).sum())
        self._unknown = wrench_by_acceleration(calibration.mass_kg, self._tool.p_sensor_com_m) * _UNKNOWN_M_S2
        # Samples of one window and its margins, copied as they arrive, to avoid one long copy at its end.
        self._rows = np.empty(self._size + 2 * self._stride * _REACH, _ROW)
        self.restart()

    def restart(self) -> None:
        """Discard the samples before an interruption."""
        self._filled = 0

    def steps(self, n: int) -> NDArray[np.int64]:
        """Return, for each of the next n samples, the index of the window that it completes or belongs to."""
        return (np.arange(n) + self._filled - len(self._rows)) // (self._size // 2)

    def add(self, rows: Paired, states: NDArray[np.int8], noise: NoiseEstimator, systematic: Array) -> Iterator[Window]:
        """Add samples with their states of motion; yield the windows that are complete."""
        n, start, step = len(rows), 0, self._size // 2
        while start < n:
            stop = min(n, start + len(self._rows) - self._filled)
            into, part = self._rows[self._filled : self._filled + stop - start], slice(start, stop)
            into["state"] = states[part]
            for name in (_ROW.names or ())[1:]:
                into[name] = getattr(rows, name)[part]
            self._filled, start = self._filled + stop - start, stop
            if self._filled == len(self._rows):
                window = self._window(self._rows, noise, systematic)
                self._rows[:-step] = self._rows[step:]
                self._filled -= step
                if window is not None:
                    yield window

    def _window(self, rows: NDArray[np.void], noise: NoiseEstimator, systematic: Array) -> Window | None:
        margin = self._stride * _REACH
        inner = rows[margin : margin + self._size]
        state = int(inner["state"].max())
        known = noise.of(state)
        t_s = (rows["t_host_ns"] - rows["t_host_ns"][0]) * 1e-9
        knots = np.arange(0, len(rows), self._stride)
        R_base_flange, p_base_flange_m = rows["R_base_flange"][knots], rows["p_base_flange_m"][knots]
        jump = np.abs(np.diff(R_base_flange, axis=0)).max()
        if known is None or known.dof < _LEAST_DOF or jump > _JUMP:
            return None
        if t_s[-1] > _LATE * WINDOW_S * len(rows) / self._size or (np.diff(t_s[knots]) <= 0).any():
            return None
        tool, mass_kg = self._tool, self._calibration.mass_kg
        # the wrench of a free tool is linear in R, so the mean of R can be used as a rotation
        R_mean = np.einsum("n,nij->ij", self._weights, inner["R_base_flange"])
        residual = np.asarray(self._compensator.sample(self._weights @ inner["raw"], R_mean), float)
        felt = tool.gravity_force_base_N / mass_kg @ R_mean @ tool.R_flange_sensor
        covariance, lever, turning = _LIKE_WHITE * known.reading, np.zeros((3, 3)), 0.0
        # at rest, joint noise would only look like motion
        if state != REST:
            motion = self._load.motion(t_s[knots], R_base_flange, p_base_flange_m)
            weights = np.interp(motion.t_s, t_s[margin : margin + self._size], self._weights)
            weights /= weights.sum()
            residual -= weights @ self._load.wrench(motion, self._inertia)
            omega, alpha = motion.angular_velocity_rad_s, motion.angular_acceleration_rad_s2
            lever = np.einsum("n,nij->ij", weights, skew(alpha) + skew(omega) @ skew(omega))
            felt = felt - weights @ motion.linear_acceleration_m_s2
            turning = float(weights @ np.linalg.norm(alpha, axis=1))
            if not np.isfinite(p_base_flange_m).all():
                covariance = covariance + self._unknown @ self._unknown.T
        middle = inner[self._size // 2].copy()
        return Window(
            t_s=float(middle["t_host_ns"]) * 1e-9,
            residual=residual,
            felt_m_s2=felt,
            lever_s2=lever,
            p_sensor_near_m=self._near_m,
            noise=covariance,
            state=state,
            systematic=systematic,
            turning_rad_s2=turning,
            tensor_Nm=(1.0 if self._inertia is None else _TENSOR) * mass_kg * GYRATION_M**2 * turning,
            R_base_flange=middle["R_base_flange"],
            p_base_flange_m=middle["p_base_flange_m"],
            as_read=self._as_read,
        )
