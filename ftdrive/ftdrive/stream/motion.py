"""State of motion of the arm at each sample, and the wrench of a load that it moves."""

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import maximum_filter1d

from ftcalib.after.state import Calibrated
from ftcalib.compensation import MovedLoad
from ftcalib.model import Parameters, skew
from ftdrive.stream.samples import Paired, StreamInfo
from ftdrivers.interfaces import Array

READING_S = 0.02
"""A reading is the mean of the samples of this time: contact is judged by readings."""
GYRATION_M = 0.08
"""Radius of gyration of a tool or a part, where its inertia is not known."""
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
# Poses of this spacing give the acceleration, over twice so long: longer ones lose the edges of a move, and are later.
_KNOT_S, _REACH_S = 0.002, 0.015
_SPEEDS = np.array(SPEEDS_RAD_S)


def samples_in_reading(rate_Hz: float) -> int:
    """Return how many samples of a sensor make one reading."""
    return max(1, round(READING_S * rate_Hz))


class MotionTracker:
    """State of motion at each sample, by the mean poses of successive readings; rest begins when it has lasted 0.5 s.

    Where the position of the sensor is unknown (NaN), the centre of mass counts from the flange.
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
        """Return the states (n,) at these poses, `REST` or a class of motion, and what rest does not exclude.

        That is the wrench of inertia (n, 6), N and N·m, sensor axes, zero where nothing shows. An unknown position does
        not move.
        """
        n, k = len(R_base_flange), self._size
        if not n:
            return np.zeros(0, np.int8), np.zeros((0, 6))
        turned_m = (R_base_flange.reshape(-1, 3) @ self._p_flange_com_m).reshape(n, 3)
        p_base_com_m = np.where(np.isfinite(p_base_flange_m), p_base_flange_m, 0.0) + turned_m
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


class Neighbours:
    """Samples with the poses on both sides of them, which show the inertial wrench of the load.

    While that is subtracted, the newest samples wait for the poses after them.
    """

    def __init__(self, info: StreamInfo) -> None:
        motion = info.calibration.motion
        self._tensor = None if motion is None else motion.inertia_kg_m2
        self._g_m_s2, self._p_flange_sensor_m = info.calibration.g_m_s2, info.p_flange_sensor_m
        self._stride = max(1, round(_KNOT_S * info.sensor_rate_Hz))
        knot_s = self._stride / info.sensor_rate_Hz
        self._reach = max(2, round(max(_REACH_S, 2 / info.arm_rate_Hz) / knot_s))
        self.restart()

    def restart(self) -> None:
        """Forget the samples before an interruption."""
        self._buffer: Paired | None = None
        self._states, self._felt = np.zeros(0, np.int8), np.zeros((0, 6))
        # Rows of the buffer that are processed.
        self._done = 0

    @property
    def knows_tensor(self) -> bool:
        """Whether the inertia of the tool was calibrated."""
        return self._tensor is not None

    def arrange(
        self, rows: Paired, states: NDArray[np.int8], felt: Array, load: Calibrated, *, on: bool, last: bool
    ) -> tuple[Paired, NDArray[np.int8], Array, Array | None]:
        """Add samples with their motion; return those that are due, and the inertial wrench (n, 6) if it is wanted.

        `last` is whether no more poses come, so that none waits for them.
        """
        if self._buffer is None and not (on and len(rows)):
            return rows, states, felt, None
        buffer = rows if self._buffer is None else Paired.concatenate([self._buffer, rows])
        self._states, self._felt = np.concatenate([self._states, states]), np.concatenate([self._felt, felt])
        end, inertial = len(buffer), None
        neighbours = self._reach * self._stride
        if on and np.isfinite(buffer.p_base_flange_m[-1]).all():
            inertial, ready = self.wrench(buffer, load)
            end = end if last else max(ready, self._done)
            ahead = np.minimum(np.arange(self._done, end) + neighbours, len(self._states) - 1)  # the poses after them
            state = self._states[ahead]
            # at rest nothing is subtracted, because that would amplify the noise of the joints
            inertial = np.where((state == REST)[:, None], 0.0, inertial[self._done : end])
        else:
            state = self._states[self._done : end]
        rows, felt = buffer.rows(slice(self._done, end)), self._felt[self._done : end]
        # knots stay where they are
        keep = max(0, end - neighbours - self._stride) // self._stride * self._stride
        self._buffer, self._done = buffer.rows(slice(keep, None)), end - keep
        self._states, self._felt = self._states[keep:], self._felt[keep:]
        if not on:
            self.restart()
        return rows, state, felt, inertial

    def wrench(self, rows: Paired, load: Calibrated) -> tuple[Array, int]:
        """Return the inertial wrench of all rows, and the number of those with neighbours on both sides."""
        knots = np.arange(0, len(rows), self._stride)
        t_s = (rows.t_host_ns - rows.t_host_ns[0]) * 1e-9
        # a coarse clock repeats times
        knots = knots[np.diff(t_s[knots], prepend=-1.0) > 0]
        if len(knots) < 2 * self._reach + 2:
            return np.zeros((len(rows), 6)), 0
        moved = MovedLoad(load.parameters, self._g_m_s2, self._p_flange_sensor_m, self._reach)
        motion = moved.motion(t_s[knots], rows.R_base_flange[knots], rows.p_base_flange_m[knots])
        at_knots = moved.wrench(motion, self._tensor)
        wrench = np.stack([np.interp(t_s, motion.t_s, column) for column in at_knots.T], axis=1)
        return wrench, int(knots[-1 - self._reach]) + 1


def wrench_by_acceleration(mass_kg: float, p_sensor_com_m: Array) -> Array:
    """Wrench (6, 3) of a load by the three axes of its acceleration, N and N·m per m/s², sensor axes."""
    return mass_kg * np.concatenate([np.eye(3), skew(p_sensor_com_m)])
