"""State of motion of the arm at each sample, and the wrench of a load that it moves."""

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import maximum_filter1d

from ftcalib.compensation import SensorMotion, inertial_wrench, motion_of_poses
from ftcalib.model import Parameters, skew
from ftdrivers.interfaces import Array

READING_S = 0.02
"""A reading is the mean of the samples of this time: contact is judged by readings."""
REST = 0
SPEEDS_RAD_S = (0.15, 0.4, 0.7)
"""Limits of the classes of speed: angular speed, plus that of the flange at 0.5 m."""
ACCELERATION_RAD_S2 = 1.5
"""Limit of the two classes of acceleration, likewise, beyond that of an even turn."""
SLOW = 2
"""So many classes of speed are divided by acceleration; faster ones ring and ripple alike."""
STATES = 1 + len(SPEEDS_RAD_S) + 1 + SLOW
"""Rest, then the classes: the noise is learnt for each."""

# Largest motion at rest, from the mean of one reading to the next: beyond joint noise of 3e-5 rad.
_STILL_RAD, _STILL_M = 2e-4, 2e-4
# Motion of the centre of mass from which its wrench counts, which is felt before the motion is seen.
_FELT_M = 4e-5
# Rest begins so long after the last motion, and a state ends so long after it, because links ring behind it.
_HOLD_S, _RINGS_S = 0.5, 0.4
_LEVER_M = 0.5
_SPEEDS = np.array(SPEEDS_RAD_S)


def samples_in_reading(rate_Hz: float) -> int:
    """Return how many samples of a sensor make one reading."""
    return max(1, round(READING_S * rate_Hz))


class MotionTracker:
    """State of motion at each sample, by the mean poses of successive readings; rest begins when it has lasted 0.5 s.

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
        by_acceleration = wrench_by_acceleration(mass_kg, parameters.p_sensor_com_m) @ parameters.R_flange_sensor.T
        # (6, 3) wrench by the change of a step of the centre of mass to the next, flange axes, m.
        self._felt_by_change = -by_acceleration / self._step_s**2
        self._p_flange_com_m = np.nan_to_num(p_flange_sensor_m) + parameters.R_flange_sensor @ parameters.p_sensor_com_m
        self._earlier: Array | None = None
        # Samples since the last motion.
        self._since = self._hold
        self._classes = np.zeros(round(_RINGS_S * rate_Hz), np.int8)

    def follow(self, R_base_flange: Array, p_base_flange_m: Array) -> tuple[NDArray[np.int8], Array]:
        """Add samples with these poses; an unknown position does not move.

        Returns
        -------
        states : array, shape (n,)
            `REST` or a class of motion.
        felt : array, shape (n, 6)
            Wrench of inertia, N and N·m, sensor axes, that rest does not exclude; zero where nothing shows.
        """
        n, k = len(R_base_flange), self._size
        if not n:
            return np.zeros(0, np.int8), np.zeros((0, 6))
        turned_m = (R_base_flange.reshape(-1, 3) @ self._p_flange_com_m).reshape(n, 3)
        p_base_com_m = np.nan_to_num(p_base_flange_m) + turned_m
        # (12, n), for sums along long rows
        poses = np.concatenate([R_base_flange.reshape(n, 9).T, p_base_com_m.T])
        if self._earlier is None:
            self._earlier = np.repeat(poses[:, :1], 3 * k, axis=1)
        poses = np.concatenate([self._earlier, poses], axis=1)
        self._earlier = poses[:, n:].copy()
        # means, because joint noise in single poses looks like motion
        sums = np.cumsum(poses, axis=1) / k
        moved = sums[:, 2 * k :] - 2 * sums[:, k:-k] + sums[:, : -2 * k]
        before, moved = moved[:, :n], moved[:, k:]
        change, far = moved - before, np.abs(moved)
        moves = (far[:9] > _STILL_RAD).any(axis=0) | (far[9:] > _STILL_M).any(axis=0)
        newest = np.maximum.accumulate(np.where(moves, np.arange(n), -1 - self._since))
        self._since = int(n - 1 - newest[-1])
        moving = np.arange(n) - newest < self._hold
        felt = self._felt(R_base_flange, moved[9:], change[9:])
        # the usual block of a live stream, in half the time
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
        rung = maximum_filter1d(classes, w, origin=(w - 1) // 2, mode="constant")[w - 1 :]  # with those before
        return np.where(moving, np.maximum(rung, 1), REST).astype(np.int8), felt

    @staticmethod
    def _rate(moved: Array) -> Array:
        """Angle (n,) by which orientations, and positions at `_LEVER_M`, have moved."""
        squares = np.square(moved)
        return np.asarray(np.sqrt(squares[:9].sum(axis=0) / 2) + np.sqrt(squares[9:].sum(axis=0)) / _LEVER_M)

    def _felt(self, R_base_flange: Array, moved_m: Array, change_m: Array) -> Array:
        felt = np.square(moved_m).sum(axis=0) > _FELT_M**2
        wrench = np.zeros((len(felt), 6))
        if felt.any():
            change_flange_m = np.einsum("nij,in->nj", R_base_flange[felt], change_m[:, felt])
            wrench[felt] = change_flange_m @ self._felt_by_change.T
        return wrench


class MovedLoad:
    """A load that the arm moves: motion and inertial wrench of it, from poses.

    Parameters
    ----------
    parameters : Parameters
    g_m_s2 : float
    p_flange_sensor_m : array, shape (3,)
    reach : int
        Poses on each side that give the acceleration.
    """

    def __init__(self, parameters: Parameters, g_m_s2: float, p_flange_sensor_m: Array, reach: int) -> None:
        self._mass_kg = float(np.linalg.norm(parameters.gravity_force_base_N)) / g_m_s2
        self._parameters, self._p_flange_sensor_m, self._reach = parameters, p_flange_sensor_m, reach

    def motion(self, t_s: Array, R_base_flange: Array, p_base_flange_m: Array) -> SensorMotion:
        """Return the motion at n poses, but for those with too few neighbours; an unknown position does not move."""
        return motion_of_poses(
            t_s,
            R_base_flange,
            np.nan_to_num(p_base_flange_m),
            R_flange_sensor=self._parameters.R_flange_sensor,
            p_flange_sensor_m=self._p_flange_sensor_m,
            reach=self._reach,
        )

    def wrench(self, motion: SensorMotion, inertia_kg_m2: Array | None = None) -> Array:
        """Return the wrench (m, 6) of a motion; without the inertia the mass counts as a point."""
        return inertial_wrench(self._mass_kg, self._parameters.p_sensor_com_m, motion, inertia_kg_m2)


def wrench_by_acceleration(mass_kg: float, p_sensor_com_m: Array) -> Array:
    """Wrench (6, 3) of a load by the three axes of its acceleration, N and N·m per m/s², sensor axes."""
    return mass_kg * np.concatenate([np.eye(3), skew(p_sensor_com_m)])
