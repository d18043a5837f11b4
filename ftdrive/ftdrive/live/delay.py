"""Delay of the wrench after the pose, found from the force of a moving tool."""

from collections import deque
from collections.abc import Iterable
from itertools import pairwise

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from ftcalib import CalibrationResult
from ftcalib.after.inertia import inertial_wrench, motion_of_poses
from ftcalib.model import jacobian, skew
from ftdrive.live.samples import Paired
from ftdrivers.interfaces import Array

MOST_DELAY_S = 0.1

PERIOD_S = 0.024
"""Samples are averaged over this time: over a shorter one, noise of the poses passes for acceleration."""
_BATCH_S = 1.0
_REACH = 2
"""Neighbours on each side from which the acceleration comes."""
_SAME = np.convolve([2, 3, 2], [1, 10, 1]) / 84
"""What means of an acceleration keep of it when it comes from means of the poses: a parabola through five of them."""
_USABLE_S = 3e-3
"""The estimate is applied from this sigma on."""
_SLOWEST_RAD_S = 0.02
"""Slower, a tool does not show the delay."""
_PRIOR_S, _SAME_LINKS_S = 0.05, 0.005
"""Of the delay before the first estimate, one sigma: without and with that of a calibration in motion."""
_BIAS_N = 0.5
"""Change of the bias since the calibration, one standard deviation."""
_HELD = 0.05
"""Weight of what the tool may hold, relative to its own, one standard deviation."""
_LEVER_M = 0.005
"""Error of the configured origin of the sensor; without one, `_ANY_LEVER_M`."""
_ANY_LEVER_M = 0.1
_FLOOR_N = 1e-3
_NOTICED_S = 2e-4
"""After a larger change the samples of the next second are not used, because times follow it slowly."""


class DelayEstimator:
    """Recursive weighted least squares of the force on the time derivative of its prediction.

    With d the delay that is left, the force of a free tool is

        force = prediction - d * derivative of the prediction + errors of calibration, bias and lever + noise

    and the prediction holds weight, bias and inertia. The errors are estimated beside d, with the covariance of the
    calibration as prior, so that they are not taken for a delay. Every second has the weight of its own residual,
    reduced where residuals are correlated in time, so that a touched tool counts little.

    Parameters
    ----------
    calibration : CalibrationResult
    p_flange_sensor_m : array, shape (3,)
        NaN where unknown.
    window : int
        The last so many seconds of motion count.
    """

    def __init__(self, calibration: CalibrationResult, p_flange_sensor_m: Array, window: int = 30) -> None:
        known = bool(np.isfinite(p_flange_sensor_m).all())
        self._calibration = calibration
        self._p_flange_sensor_m = p_flange_sensor_m if known else np.array([0.0, 0.0, 0.05])
        self._scale = np.zeros((13, 13))  # maps 13 numbers of sigma 1 to delay, errors of the calibration, lever
        self._scale[0, 0] = _PRIOR_S
        change = np.repeat([0.0, _HELD * calibration.weight_N, _BIAS_N], 3)
        errors = calibration.covariance[:9, :9] + np.diag(change**2)
        eigenvalues, V = np.linalg.eigh(errors)
        self._scale[1:10, 1:10] = V * np.sqrt(np.maximum(eigenvalues, 0.0))
        self._scale[10:, 10:] = (_LEVER_M if known else _ANY_LEVER_M) * np.eye(3)
        self._seconds: deque[tuple[Array, Array]] = deque(maxlen=window)
        self._pending: list[Paired] = []
        self._settling = False
        motion = calibration.motion
        self.delay_s = 0.0 if motion is None else min(max(motion.delay_s, -MOST_DELAY_S), MOST_DELAY_S)
        """That of the calibration, then the estimate as soon as it is good enough; samples are paired with it."""
        self.sigma_s = _PRIOR_S if motion is None else _SAME_LINKS_S
        """One standard deviation of the estimate."""

    def add(self, paired: Paired) -> None:
        """Learn from samples that were paired with `delay_s`, and improve it."""
        pieces = self._whole_seconds(paired)
        if pieces and self._settling:  # part of it was paired with another delay
            self._settling = False
        elif sum(map(self._learn, pieces)):
            self._apply()

    def learn(self, recording: Iterable[Paired]) -> None:
        """Forget what was learnt; improve the delay once, from blocks of a recording that were paired with it."""
        self._seconds.clear()
        self._pending = []
        if sum(self._learn(piece) for paired in recording for piece in self._whole_seconds(paired)):
            self._apply()

    def _whole_seconds(self, paired: Paired) -> list[Paired]:
        """Add samples; return the seconds that are complete."""
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
        """Add the information of one second; return whether it has any."""
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
        if not (np.diff(t_s) > 0).all():
            return False
        found = self._linearised(t_s, force, R, p)
        if found is None:
            return False
        H, y = found
        A, b = H.T @ H, H.T @ y
        variance = float(y @ y) / len(y)
        for _ in range(3):
            residual = y - H @ np.linalg.solve(A / variance + np.eye(13), b / variance)
            variance = max(float(residual @ residual) / len(y), _FLOOR_N**2)
        rows = residual.reshape(-1, 3)
        correlation = min(max(float((rows[1:] * rows[:-1]).sum() / (rows**2).sum()), 0.0), 0.95)
        weight = (1 - correlation) / (1 + correlation) / variance
        self._seconds.append((weight * A, weight * b))
        return True

    def _linearised(self, t_s: Array, force: Array, R: Array, p: Array) -> tuple[Array, Array] | None:
        """Return derivative and residual of the force of a free tool; None while the tool does not turn."""
        parameters, compensator = self._calibration.parameters, self._calibration.compensator
        p = np.where(np.isfinite(p), p, 0.0)
        motion = motion_of_poses(
            t_s,
            R,
            p,
            R_flange_sensor=parameters.R_flange_sensor,
            p_flange_sensor_m=self._p_flange_sensor_m,
            reach=_REACH,
        )
        W = skew(motion.angular_velocity_rad_s)
        if np.sqrt((motion.angular_velocity_rad_s**2).sum(axis=1).mean()) < _SLOWEST_RAD_S:
            return None
        mass_kg = self._calibration.mass_kg
        still = R.reshape(-1, 9) @ compensator.matrix[:3].T + compensator.offset[:3]
        force, prediction = (sliding_window_view(one, len(_SAME), axis=0) @ _SAME for one in (force, still))
        prediction = prediction + inertial_wrench(mass_kg, parameters.p_sensor_com_m, motion)[:, :3]
        H = np.empty((len(motion.t_s), 3, 13))
        H[..., 0] = -np.gradient(prediction, motion.t_s, axis=0)
        H[..., 1:10] = jacobian(parameters, motion.R_base_flange)[:, :3, :9]
        H[..., 10:] = -mass_kg * (skew(motion.angular_acceleration_rad_s2) + W @ W)
        return H.reshape(-1, 13) @ self._scale, (force - prediction).ravel()

    def _apply(self) -> None:
        """Solve for the delay that is left, and apply it if it is known well enough."""
        A = sum((a for a, _ in self._seconds), np.eye(13))
        b = sum((b for _, b in self._seconds), np.zeros(13))
        covariance = np.linalg.inv(A)
        left_s = _PRIOR_S * float(covariance[0] @ b)
        self.sigma_s = _PRIOR_S * float(np.sqrt(covariance[0, 0]))
        if self.sigma_s > _USABLE_S:
            return
        before_s = self.delay_s
        self.delay_s = min(max(before_s + left_s, -MOST_DELAY_S), MOST_DELAY_S)
        step = (self.delay_s - before_s) / _PRIOR_S
        self._seconds = deque(((a, c - step * a[0]) for a, c in self._seconds), maxlen=self._seconds.maxlen)
        self._settling = abs(self.delay_s - before_s) > _NOTICED_S
