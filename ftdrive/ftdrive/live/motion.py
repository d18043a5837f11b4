"""Motion of the arm at each sample, and the wrench of it that the stream does not subtract."""

from enum import Enum

import numpy as np
from numpy.typing import NDArray

from ftcalib.model import Parameters
from ftdrivers.interfaces import Array

READING_S = 0.02
"""A reading is the mean of the samples of this time: contact is judged by readings."""

_STILL_RAD, _STILL_M = 2e-4, 2e-4
"""Largest motion at rest, from the mean of one reading to the next: beyond joint noise of 3e-5 rad."""
_FELT_M = 4e-5
"""Motion of the centre of mass from which its wrench counts, which is felt before the motion is seen."""
_HOLD_S = 0.3
"""A stopped arm rings so long."""
_DELAY_S = 0.01
"""Usual error of the delay between pose and wrench."""


class Motion(Enum):
    """State of motion of the arm; the noise is learnt for each."""

    REST = "rest"
    MOVING = "moving"


def samples_in_reading(rate_Hz: float) -> int:
    """Return how many samples of a sensor make one reading."""
    return max(1, round(READING_S * rate_Hz))


class MotionTracker:
    """State of motion at each sample, by the mean poses of successive readings; rest begins when it has lasted 0.3 s.

    Parameters
    ----------
    rate_Hz : float
        Of the sensor.
    mass_kg : float
    parameters : Parameters
        Of the calibration.
    p_flange_sensor_m : array, shape (3,)
        NaN where unknown: then the centre of mass counts from the flange.
    """

    def __init__(self, rate_Hz: float, mass_kg: float, parameters: Parameters, p_flange_sensor_m: Array) -> None:
        self._size = samples_in_reading(rate_Hz)
        self._step_s = self._size / rate_Hz
        self._hold = round(_HOLD_S * rate_Hz)
        self._mass_kg, self._parameters = mass_kg, parameters
        self._p_flange_com_m = np.nan_to_num(p_flange_sensor_m) + parameters.R_flange_sensor @ parameters.p_sensor_com_m
        self._earlier: Array | None = None
        self._since = self._hold
        """Samples since the last motion."""

    def follow(self, R_base_flange: Array, p_base_flange_m: Array) -> tuple[NDArray[np.bool_], Array]:
        """Add samples with these poses; an unknown position does not move.

        Returns
        -------
        moving : array, shape (n,)
        wrenches : array, shape (2, n, 6)
            Of inertia about, and of gravity by which it may be late, N and N·m, sensor axes; zero at rest.
        """
        n, k = len(R_base_flange), self._size
        wrenches = np.zeros((2, n, 6))
        if not n:
            return np.zeros(0, np.bool_), wrenches
        p_base_com_m = np.nan_to_num(p_base_flange_m) + R_base_flange @ self._p_flange_com_m
        poses = np.concatenate([R_base_flange.reshape(n, 9), p_base_com_m], axis=1)
        if self._earlier is None:
            self._earlier = np.repeat(poses[:1], 2 * k, axis=0)
        poses = np.concatenate([self._earlier, poses])
        self._earlier = poses[n:]
        sums = np.cumsum(poses, axis=0)  # means, because joint noise in single poses looks like motion
        moved = np.abs(sums[2 * k :] - 2 * sums[k:-k] + sums[: -2 * k]) / k
        moves = (moved[:, :9] > _STILL_RAD).any(axis=1) | (moved[:, 9:] > _STILL_M).any(axis=1)
        newest = np.maximum.accumulate(np.where(moves, np.arange(n), -1 - self._since))
        self._since = int(n - 1 - newest[-1])
        moving = np.asarray(np.arange(n) - newest < self._hold)
        felt = (np.linalg.norm(moved[:, 9:], axis=1) > _FELT_M) | moving
        if felt.any():
            R = poses[:, :9].reshape(-1, 3, 3)
            second = (poses[2 * k :] - 2 * poses[k:-k] + poses[: -2 * k])[:, 9:]
            inertial_N = -self._mass_kg / self._step_s**2 * second
            late_N = (
                _DELAY_S
                / self._step_s
                * ((R[2 * k :] - R[k:-k]).swapaxes(1, 2) @ self._parameters.gravity_force_base_N)
            )
            R_base_sensor = R[2 * k :] @ self._parameters.R_flange_sensor
            wrenches[0, :, :3] = np.einsum("nij,ni->nj", R_base_sensor, inertial_N)
            wrenches[1, :, :3] = late_N @ self._parameters.R_flange_sensor
            wrenches[..., 3:] = np.cross(self._parameters.p_sensor_com_m, wrenches[..., :3])
            wrenches[:, ~felt] = 0.0
        return moving, wrenches
