"""Windows of the tracker: weighted means of a third of a second of the stream, in motion too."""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from ftcalib.after.inertia import inertial_wrench, motion_of_poses
from ftcalib.compensation import Compensator
from ftcalib.likelihood.response import predicted_covariance
from ftcalib.model import BIASES, Array, skew
from ftdrive.live.contact import GYRATION_M
from ftdrive.live.frames import near
from ftdrive.live.motion import READING_S, REST, accelerated
from ftdrive.live.noise import NoiseEstimator
from ftdrive.live.samples import Paired, StreamInfo
from ftdrive.live.tracking import Window

WINDOW_S = 0.3
"""Each begins in the middle of the one before. The weights, a Hann window, suppress the ringing of the links."""
_KNOT_S, _REACH = 0.004, 5
"""Poses of this spacing give the acceleration, with so many neighbours on each side."""
_TENSOR = 0.5
"""Error of a tool's inertia that was calibrated, of what it is without."""
_LATE = 1.2
"""A window that took so many times as long has lost samples."""
_UNKNOWN_M_S2 = 1.0
"""Acceleration in motion of an arm that reports no positions, one sigma."""
_LIKE_WHITE = 1.5 * READING_S / WINDOW_S
"""Variance of such a mean over that of a reading, if the noise is white: vibration leaves less."""


class Windows:
    """Collects samples of a stream to windows.

    Parameters
    ----------
    info : StreamInfo
    """

    def __init__(self, info: StreamInfo) -> None:
        calibration = info.calibration
        self._calibration, self._tool = calibration, calibration.parameters
        self._compensator = Compensator(self._tool, response=calibration.response)
        self._inertia = None if calibration.motion is None else calibration.motion.inertia_kg_m2
        likely, predicted = calibration.likely_error(), calibration.predicted_error()
        self._beyond = np.diag(np.repeat((np.square(likely) - np.square(predicted)).clip(0.0) / 3, 3))
        self._near_m = near(info)
        self._p_flange_sensor_m = np.nan_to_num(info.p_flange_sensor_m)
        # the bias is what is tracked: its error in the calibration does not count
        self._covariance = _without_bias(calibration.covariance)
        response = calibration.response
        self._response = response and replace(response, covariance=_without_bias(response.covariance))
        self._size = round(WINDOW_S * info.sensor_rate_Hz)
        self._stride = max(1, round(_KNOT_S * info.sensor_rate_Hz))
        self._weights = np.hanning(self._size + 2)[1:-1] / (np.hanning(self._size + 2).sum())
        self._unknown = accelerated(calibration.mass_kg, self._tool.p_sensor_com_m) * _UNKNOWN_M_S2
        self.restart()

    def restart(self) -> None:
        """Forget the samples before an interruption."""
        self._rows: list[Paired] = []
        self._states: list[NDArray[np.int8]] = []

    def add(self, rows: Paired, states: NDArray[np.int8], noise: NoiseEstimator) -> Iterator[Window]:
        """Add samples with their states of motion; yield the windows that are complete."""
        if len(rows):
            self._rows.append(rows)
            self._states.append(states)
        margin = self._stride * _REACH
        needed = self._size + 2 * margin
        while sum(map(len, self._states)) >= needed:
            buffer, all_states = Paired.concatenate(self._rows), np.concatenate(self._states)
            window = self._window(buffer.rows(slice(0, needed)), all_states[margin : margin + self._size], noise)
            rest = slice(self._size // 2, None)
            self._rows, self._states = [buffer.rows(rest)], [all_states[rest]]
            if window is not None:
                yield window

    def _window(self, rows: Paired, states: NDArray[np.int8], noise: NoiseEstimator) -> Window | None:
        state = int(states.max())
        known = noise.of(state)
        t_s = (rows.t_host_ns - rows.t_host_ns[0]) * 1e-9
        knots = np.arange(0, len(rows), self._stride)
        if known is None or t_s[-1] > _LATE * WINDOW_S * len(rows) / self._size or (np.diff(t_s[knots]) <= 0).any():
            return None
        tool, mass_kg = self._tool, self._calibration.mass_kg
        motion = motion_of_poses(
            t_s[knots],
            rows.R_base_flange[knots],
            np.nan_to_num(rows.p_base_flange_m[knots]),  # an unknown position does not move
            R_flange_sensor=tool.R_flange_sensor,
            p_flange_sensor_m=self._p_flange_sensor_m,
            reach=_REACH,
        )
        margin = self._stride * _REACH
        inner = rows.rows(slice(margin, margin + self._size))
        weights = np.interp(motion.t_s, t_s[margin : margin + self._size], self._weights)
        weights /= weights.sum()
        residual = self._weights @ self._compensator.batch(inner.raw, inner.R_base_flange)
        if state != REST:
            residual -= weights @ inertial_wrench(mass_kg, tool.p_sensor_com_m, motion, self._inertia)
        R_base_sensor = np.einsum("n,nij->ij", self._weights, inner.R_base_flange) @ tool.R_flange_sensor
        omega, alpha = motion.angular_velocity_rad_s, motion.angular_acceleration_rad_s2
        lever = np.einsum("n,nij->ij", weights, skew(alpha) + skew(omega) @ skew(omega))
        felt = tool.gravity_force_base_N / mass_kg @ R_base_sensor - weights @ motion.linear_acceleration_m_s2
        covariance = _LIKE_WHITE * known.reading
        if state != REST and not np.isfinite(rows.p_base_flange_m).all():
            covariance = covariance + self._unknown @ self._unknown.T
        turning = float(weights @ np.linalg.norm(alpha, axis=1))
        R = inner.R_base_flange[self._size // 2]
        error = predicted_covariance(tool, self._covariance, self._response, R)
        return Window(
            t_s=float(inner.t_host_ns[self._size // 2]) * 1e-9,
            residual=residual,
            felt_m_s2=felt,
            lever_s2=lever,
            p_sensor_near_m=self._near_m,
            noise=covariance,
            state=state,
            systematic=error + self._beyond,
            turning_rad_s2=turning,
            tensor_Nm=(1.0 if self._inertia is None else _TENSOR) * mass_kg * GYRATION_M**2 * turning,
            p_base_flange_m=inner.p_base_flange_m[self._size // 2],
        )


def _without_bias(covariance: Array) -> Array:
    kept = np.ones(len(covariance))
    kept[BIASES] = 0.0
    return covariance * np.outer(kept, kept)
