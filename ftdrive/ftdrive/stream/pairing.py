"""Wrench and pose on one time axis: times of measurement, the delay between the two links, and the pose at each wrench.

`Timeline` estimates when each sample was measured, except for the constant delay of its link. Only the difference of
the delays of both links matters; `DelayEstimator` estimates it from motion.
"""

import math
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from itertools import pairwise

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from ftcalib import CalibrationResult
from ftcalib.compensation import MovedLoad
from ftcalib.errors import BadDataset
from ftcalib.model import jacobian, skew
from ftcalib.motion.samples import RATE_TOLERANCE, SampleClock
from ftdrive.stream.samples import Ns, Paired, matrices, quaternions
from ftdrivers.interfaces import ArmStates, Array, FtSamples

# A device's clock does not count real seconds if its rate is off by this fraction over this time, s.
_SCALED_S, _SCALED = 0.2, 0.05
_PASSES = 4
_ROUNDS = 10
# A recording is paired again until its estimated delay changes by less than this.
_CONVERGED_S = 1e-8
# A pose is extrapolated by at most one interval of a CB3 controller plus some delay: waiting for the next pose would
# delay a block by one interval and split it.
_MOST_AHEAD_NS = 10_000_000
# Poses are kept for this time, so that samples that arrive late still find theirs.
_KEEP_NS = 2_000_000_000
MOST_DELAY_S = 0.1

PERIOD_S = 0.024
"""Samples are averaged over this time, s: over shorter times, noise of the poses looks like acceleration."""
_BATCH_S = 1.0
# The acceleration is computed from this many neighbouring mean poses on each side.
_REACH = 2
# Weights that smooth the force like the acceleration, which comes from parabolas through five mean poses.
_SAME = np.convolve([2, 3, 2], [1, 10, 1]) / 84
# The estimated delay is applied once its sigma, computed without the most informative second, is below this, s.
_USABLE_S = 3e-3
# Below this angular speed, the motion does not show the delay.
_SLOWEST_RAD_S = 0.02
# Sigma of the delay before its first estimate: without a prior delay, and with that of a calibration in motion.
_PRIOR_S, _SAME_LINKS_S = 0.05, 0.005
# Change of the force bias since the calibration, N, one standard deviation.
_BIAS_N = 0.5
# Weight of a held part relative to the weight of the tool, one standard deviation.
_HELD = 0.05
# Sigma of the sensor's origin relative to the flange if it is configured; `_ANY_LEVER_M` if it is not.
_LEVER_M = 0.005
_ANY_LEVER_M = 0.1
_FLOOR_N = 1e-3
# After a larger change of the delay the next second is not used, because the samples' times follow the change slowly.
_NOTICED_S = 2e-4


class PoseTrack:
    """Flange poses over time, interpolated between the first and the last.

    Positions and joint angles are interpolated linearly, orientations by slerp: constant angular velocity.
    """

    def __init__(self) -> None:
        self._t_ns = np.empty(0, np.int64)
        # unit quaternion x y z w, position, joint angles, half the angle to the next pose
        self._columns = np.empty((0, 14))

    @property
    def span_ns(self) -> tuple[int, int] | None:
        """Times of the first and the last pose; None while there is no pose."""
        return (int(self._t_ns[0]), int(self._t_ns[-1])) if len(self._t_ns) else None

    @property
    def ahead_ns(self) -> int:
        """Time after the last pose up to which the pose may be extrapolated with constant velocity."""
        return min(int(self._t_ns[-1] - self._t_ns[-2]), _MOST_AHEAD_NS) if len(self._t_ns) > 1 else 0

    def add(self, t_host_ns: Ns, q_rad: Array, R_base_flange: Array, p_base_flange_m: Array) -> None:
        """Append n poses; one that is not later than the pose before it is dropped."""
        newest = self._t_ns[-1] if len(self._t_ns) else np.iinfo(np.int64).min
        later = t_host_ns > np.maximum.accumulate(np.concatenate([[newest], t_host_ns[:-1]]))
        if not later.any():
            return
        new = np.zeros((int(later.sum()), 14))
        new[:, :4] = quaternions(R_base_flange[later])
        new[:, 4:7], new[:, 7:13] = p_base_flange_m[later], q_rad[later]
        start = max(0, len(self._t_ns) - 1)
        self._t_ns = np.concatenate([self._t_ns, t_host_ns[later]])
        self._columns = np.concatenate([self._columns, new])
        quat = self._columns[start:, :4]
        # q and -q are one orientation: take the sign nearer to the previous pose
        side = np.where((quat[1:] * quat[:-1]).sum(axis=1) < 0, -1.0, 1.0)
        quat[1:] *= np.cumprod(side)[:, None]
        chord = np.sqrt(np.square(quat[1:] - quat[:-1]).sum(axis=1))
        self._columns[start:-1, 13] = np.maximum(2 * np.arcsin(np.minimum(chord / 2, 1.0)), 1e-9)

    def forget(self, t_ns: int) -> None:
        """Discard the poses that are not needed for times `t_ns` and later."""
        keep = max(int(np.searchsorted(self._t_ns, t_ns, "right")) - 1, 0)
        self._t_ns, self._columns = self._t_ns[keep:], self._columns[keep:]

    def at(self, t_ns: Ns) -> tuple[Array, Array, Array]:
        """Return joint angles (n, 6), R_base_flange (n, 3, 3) and p_base_flange_m (n, 3) at times (n,).

        Times lie in `span_ns` or at most `ahead_ns` after it, where the velocity between the last two poses is kept.
        """
        if len(self._t_ns) == 1:
            i = np.zeros(len(t_ns), np.intp)
            before = after = self._columns[i]
            f = np.zeros((len(t_ns), 1))
        else:
            i = np.clip(np.searchsorted(self._t_ns, t_ns, "right") - 1, 0, len(self._t_ns) - 2)
            before, after = self._columns[i], self._columns[i + 1]
            f = ((t_ns - self._t_ns[i]) / (self._t_ns[i + 1] - self._t_ns[i]))[:, None]
        linear = before[:, 4:13] + f * (after[:, 4:13] - before[:, 4:13])
        angle = np.maximum(before[:, 13:], 1e-9)
        quat = (np.sin((1 - f) * angle) * before[:, :4] + np.sin(f * angle) * after[:, :4]) / np.sin(angle)
        return linear[:, 3:], matrices(quat), linear[:, :3]


class DelayEstimator:
    """Recursive weighted least squares of the force on the time derivative of its prediction.

    With the remaining delay d, the force of a free tool is

    force = prediction - d * derivative of the prediction + errors of calibration, bias and lever + noise

    where the prediction contains weight, bias and inertia. The errors are estimated together with d, with the
    covariance of the calibration as prior. Each second is weighted by its residual from the common estimate, less if
    its residuals are correlated in time. A second with a contact therefore has little weight, even if a different delay
    or bias would explain it.

    `p_flange_sensor_m` (3,) is NaN where unknown. The last `window` seconds of motion are used.
    """

    def __init__(self, calibration: CalibrationResult, p_flange_sensor_m: Array, window: int = 30) -> None:
        known = bool(np.isfinite(p_flange_sensor_m).all())
        self._calibration = calibration
        place_m = p_flange_sensor_m if known else np.array([0.0, 0.0, 0.05])
        self._load = MovedLoad(calibration.parameters, calibration.g_m_s2, place_m, _REACH)
        # maps 13 unit-variance numbers to delay, errors of the calibration and lever
        self._scale = np.zeros((13, 13))
        self._scale[0, 0] = _PRIOR_S
        change = np.repeat([0.0, _HELD * calibration.weight_N, _BIAS_N], 3)
        errors = calibration.covariance[:9, :9] + np.diag(change**2)
        eigenvalues, V = np.linalg.eigh(errors)
        self._scale[1:10, 1:10] = V * np.sqrt(np.maximum(eigenvalues, 0.0))
        self._scale[10:, 10:] = (_LEVER_M if known else _ANY_LEVER_M) * np.eye(3)
        # per second: products of derivatives and residual, their number, reduction, smallest variance
        self._seconds: deque[tuple[Array, int, float, float]] = deque(maxlen=window)
        self._pending: list[Paired] = []
        self._settling = False
        motion = calibration.motion
        self.delay_s = 0.0 if motion is None else min(max(motion.delay_s, -MOST_DELAY_S), MOST_DELAY_S)
        """Delay used for pairing: the delay in the calibration, then the estimate once it is accurate enough."""
        self.sigma_s = _PRIOR_S if motion is None else _SAME_LINKS_S
        """Standard deviation of `delay_s`."""

    def add(self, paired: Paired) -> None:
        """Update the estimate with samples that were paired with `delay_s`."""
        pieces = self._whole_seconds(paired)
        # some of these samples were paired with the previous delay
        if pieces and self._settling:
            self._settling = False
        elif sum(map(self._learn, pieces)):
            self._apply()

    def learn(self, samples: Iterable[FtSamples], states: Callable[[], Iterable[ArmStates]]) -> None:
        """Estimate the delay of a recording with a window of its full length, as for `pair_blocks`.

        Samples and states are read several times; each call of `states` starts again. Raises `BadDataset`.
        """
        for _ in range(_PASSES):
            before_s = self.delay_s
            self._seconds.clear()
            self._pending, self._settling = [], False
            # one-second windows do not depend on the size of the blocks, which keep few poses in memory
            self.add(Paired.concatenate(list(pair_blocks(samples, states(), before_s))))
            if abs(self.delay_s - before_s) < _CONVERGED_S:
                break

    def _whole_seconds(self, paired: Paired) -> list[Paired]:
        self._pending.append(paired)
        begin_ns = int(self._pending[0].t_host_ns[0])
        seconds = int((paired.t_host_ns[-1] - begin_ns) * 1e-9 / _BATCH_S)
        if not seconds:
            return []
        rows = Paired.concatenate(self._pending)
        cuts = np.searchsorted(rows.t_host_ns, begin_ns + np.arange(1, seconds + 1) * round(_BATCH_S * 1e9)).tolist()
        self._pending = [rows.rows(slice(cuts[-1], None))] if cuts[-1] < len(rows) else []
        return [rows.rows(slice(*piece)) for piece in pairwise([0, *cuts])]

    def _learn(self, paired: Paired) -> bool:
        if len(paired) < 2:
            return False
        seconds = (paired.t_host_ns - paired.t_host_ns[0]) * 1e-9
        size = max(1, round(PERIOD_S * (len(seconds) - 1) / max(seconds[-1], 1e-9)))
        groups = len(seconds) // size
        if groups < 4 * _REACH + 2:
            return False
        t_s, force, R, p = (
            column[: groups * size].reshape(groups, size, *column.shape[1:]).mean(axis=1)
            for column in (seconds, paired.raw[:, :3], paired.R_base_flange, paired.p_base_flange_m)
        )
        if not (np.diff(t_s) > 0).all() or (found := self._linearised(t_s, force, R, p)) is None:
            return False
        H, y = found
        columns = np.column_stack([H, y])
        products, variance = columns.T @ columns, float(y @ y) / len(y)
        for _ in range(3):
            A, b = products[:13, :13] / variance, products[:13, 13] / variance
            residual = y - H @ np.linalg.solve(A + np.eye(13), b)
            variance = max(float(residual @ residual) / len(y), _FLOOR_N**2)
        rows = residual.reshape(-1, 3)
        correlation = min(max(float((rows[1:] * rows[:-1]).sum() / (rows**2).sum()), 0.0), 0.95)
        self._seconds.append((products, len(y), (1 - correlation) / (1 + correlation), variance))
        return True

    def _linearised(self, t_s: Array, force: Array, R: Array, p: Array) -> tuple[Array, Array] | None:
        """Return Jacobian and residual of a free tool's force for the fit of the delay; None if it does not turn."""
        parameters, compensator = self._calibration.parameters, self._calibration.compensator
        motion = self._load.motion(t_s, R, p)
        W = skew(motion.angular_velocity_rad_s)
        if np.sqrt((motion.angular_velocity_rad_s**2).sum(axis=1).mean()) < _SLOWEST_RAD_S:
            return None
        still = R.reshape(-1, 9) @ compensator.matrix[:3].T + compensator.offset[:3]
        force, prediction = (sliding_window_view(one, len(_SAME), axis=0) @ _SAME for one in (force, still))
        prediction = prediction + self._load.wrench(motion)[:, :3]
        H = np.empty((len(motion.t_s), 3, 13))
        H[..., 0] = -np.gradient(prediction, motion.t_s, axis=0)
        H[..., 1:10] = jacobian(parameters, motion.R_base_flange)[:, :3, :9]
        H[..., 10:] = -self._calibration.mass_kg * (skew(motion.angular_acceleration_rad_s2) + W @ W)
        return H.reshape(-1, 13) @ self._scale, (force - prediction).ravel()

    def _apply(self) -> None:
        products, count, reduction, least = (np.array(column) for column in zip(*self._seconds, strict=True))
        variance = least
        for _ in range(_ROUNDS):
            weighted = (reduction / variance)[:, None, None] * products
            total = weighted.sum(axis=0)
            found = np.linalg.solve(total[:13, :13] + np.eye(13), total[:13, 13])
            left = np.append(-found, 1.0)
            variance = np.maximum(left @ products @ left / count, least)
        # leave out the most informative second once, because it may be a contact that looks like a delay
        both = np.array([total, total - weighted[np.argmax(weighted[:, 0, 0])]])[:, :13, :13] + np.eye(13)
        sigma_s, sigma_without_one_s = (_PRIOR_S * np.sqrt(np.linalg.inv(both)[:, 0, 0])).tolist()
        if sigma_without_one_s > _USABLE_S:
            return
        self.sigma_s = sigma_s
        before_s = self.delay_s
        self.delay_s = min(max(before_s + _PRIOR_S * float(found[0]), -MOST_DELAY_S), MOST_DELAY_S)
        change = np.eye(14)
        change[0, 13] = -(self.delay_s - before_s) / _PRIOR_S
        moved = change.T @ products @ change
        seconds = ((one, *rest) for one, (_, *rest) in zip(moved, self._seconds, strict=True))
        self._seconds = deque(seconds, maxlen=self._seconds.maxlen)
        self._settling = abs(self.delay_s - before_s) > _NOTICED_S


class Pairing:
    """Aligns the samples from the sensor and the arm in time, and finds the pose for each wrench.

    `sensor_rate_Hz` is the nominal rate of a sensor without a clock; NaN for a polled sensor, which has no fixed rate.
    `delay` is the delay of the wrench after the pose, s, or its estimator. Without an arm, position and joint angles
    are NaN, and the orientation of the flange is the identity.
    """

    def __init__(self, sensor_rate_Hz: float, delay: DelayEstimator | float, *, has_arm: bool = True) -> None:
        self._has_arm = has_arm
        self._estimator = delay if isinstance(delay, DelayEstimator) else None
        self._rate_Hz = sensor_rate_Hz
        self._sensor: SampleClock | None = None
        self._arm: SampleClock | None = None
        self._poses = PoseTrack()
        self._waiting: list[tuple[FtSamples, Ns]] = []
        self._delay_s = 0.0 if isinstance(delay, DelayEstimator) else delay

    @property
    def delay_s(self) -> float:
        """Delay of the sensor's samples after the arm's poses."""
        return self._estimator.delay_s if self._estimator else self._delay_s

    @property
    def delay_sigma_s(self) -> float:
        """Standard deviation of `delay_s`; 0 if the delay is configured."""
        return self._estimator.sigma_s if self._estimator else 0.0

    def use(self, estimator: DelayEstimator) -> None:
        """Replace the estimator by one for another calibration, but keep the current delay; keep a configured delay."""
        if self._estimator is not None:
            estimator.delay_s, estimator.sigma_s = self._estimator.delay_s, self._estimator.sigma_s
            self._estimator = estimator

    @property
    def waits_for_pose(self) -> bool:
        """Whether samples wait for a later pose, because they are too new to extrapolate it."""
        return bool(self._waiting) and self._has_arm

    def add_states(self, states: ArmStates) -> None:
        """Add states reported by the arm."""
        if not len(states.t_host_ns):
            return
        t_ns = states.t_host_ns
        if np.isfinite(states.t_device_s).all():
            if self._arm is None:
                self._arm = _clock_of(states)
            t_ns = self._arm.stamp(states.t_device_s, t_ns)
        self._poses.add(t_ns, states.q_rad, states.R_base_flange, states.p_base_flange_m)
        self._poses.forget(int(t_ns[-1]) - _KEEP_NS)

    def add_samples(self, samples: FtSamples) -> None:
        """Add samples from the sensor."""
        if not len(samples):
            return
        has_clock, counts = bool(np.isfinite(samples.t_device_s).all()), math.isfinite(self._rate_Hz)
        if has_clock:
            count = samples.t_device_s
        elif counts:
            count = samples.seq.astype(np.float64)
        else:  # a polled sensor: the time of receipt is the time of the sample
            count = np.asarray(samples.t_host_ns * 1e-9)
        if self._sensor is None:
            self._sensor = SampleClock(1 / self._rate_Hz, RATE_TOLERANCE) if counts and not has_clock else SampleClock()
        self._sensor.shift_s = self.delay_s
        self._waiting.append((samples, self._sensor.stamp(count, samples.t_host_ns)))

    def take(self) -> Paired | None:
        """Return the waiting samples whose pose is known by now; None if there is none.

        Samples before the first pose are dropped.
        """
        span_ns = self._poses.span_ns
        if not self._waiting or (span_ns is None and self._has_arm):
            return None
        samples = FtSamples.concatenate([block for block, _ in self._waiting])
        t_ns = np.concatenate([times for _, times in self._waiting])
        if span_ns is None:
            self._waiting, unknown = [], np.full((len(t_ns), 6), np.nan)
            R_base_flange = np.tile(np.eye(3), (len(t_ns), 1, 1))
            columns = samples.t_device_s, samples.seq, samples.status, samples.wrench
            return Paired(t_ns, *columns, unknown, R_base_flange, unknown[:, :3])
        first, end = np.searchsorted(t_ns, [span_ns[0], span_ns[1] + self._poses.ahead_ns + 1]).tolist()
        self._waiting = [(samples.rows(slice(end, None)), t_ns[end:])] if end < len(t_ns) else []
        if first >= end:
            return None
        paired = _paired_with(self._poses, t_ns[first:end], samples.rows(slice(first, end)))
        if self._estimator:
            self._estimator.add(paired)
        return paired

    def forget(self) -> None:
        """Discard the waiting samples after an interruption of sensor or arm."""
        self._waiting = []
        self._poses = PoseTrack()
        for line in (self._sensor, self._arm):
            if line is not None:
                line.restart()


def _clock_of(states: ArmStates) -> SampleClock:
    """Return the timeline for a controller's first states; the clock of an emulated one may run many times faster."""
    host_s = float(states.t_host_ns[-1] - states.t_host_ns[0]) * 1e-9
    device_s = float(states.t_device_s[-1] - states.t_device_s[0])
    if host_s < _SCALED_S or abs(host_s / device_s - 1) < _SCALED:
        return SampleClock()
    return SampleClock(host_s / device_s, _SCALED)


def _paired_with(poses: PoseTrack, t_ns: Ns, samples: FtSamples) -> Paired:
    return Paired(t_ns, samples.t_device_s, samples.seq, samples.status, samples.wrench, *poses.at(t_ns))


def pair_blocks(samples: Iterable[FtSamples], states: Iterable[ArmStates], delay_s: float) -> Iterator[Paired]:
    """Yield the paired samples of a recording in blocks; samples and states have times of measurement, sorted.

    Samples before the first and after the last state are dropped. `delay_s` is the delay of the wrench after the pose.
    Raises `BadDataset` if samples and states do not overlap in time.
    """
    poses, coming, found = PoseTrack(), iter(states), False
    for block in samples:
        t_ns = block.t_host_ns - round(delay_s * 1e9)
        poses.forget(int(t_ns[0]))
        while poses.span_ns is None or poses.span_ns[1] < t_ns[-1]:
            if (more := next(coming, None)) is None:
                break
            poses.add(more.t_host_ns, more.q_rad, more.R_base_flange, more.p_base_flange_m)
        span_ns = poses.span_ns or (0, -1)
        inside = slice(*np.searchsorted(t_ns, [span_ns[0], span_ns[1] + 1]).tolist())
        if len(t_ns[inside]):
            found = True
            yield _paired_with(poses, t_ns[inside], block.rows(inside))
    if not found:
        raise BadDataset("wrench and pose have no time in common: give files of the same recording, with one clock")
