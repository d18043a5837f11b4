"""A program of the operator that swings the arm continuously, for tests of a moving sensor."""

import math
from collections.abc import Generator

import numpy as np

from ftmocks.arrays import Array
from ftmocks.kinematics import Dh, JointState, Vector6, flange_motion, vector6
from ftmocks.ur.controller_program import ControllerProgram
from ftmocks.ur.robot import Robot

SPEED_RAD_S = 1.0
ACCELERATION_RAD_S2 = 2.0
ACCELERATION_M_S2 = 2.0

TURNING = ((3, 1, 1.0), (4, 2, 0.4), (5, 3, 0.3))
"""Oscillations that rotate the flange: index of the joint, cycles per period, relative amplitude."""
LIFTING = ((1, 2, 1.0), (3, 2, -1.0), (2, 3, 0.5), (3, 3, -0.5))
"""Oscillations that translate the flange with constant orientation, because joint 4 compensates the rotation."""

PHASES = 120
TRIALS = 60
TOLERANCE = 1e-3


class Swing:
    """A path on which each joint oscillates. It begins and ends at rest, at one end of the oscillation.

    Parameters
    ----------
    dh
        Kinematics of the real arm.
    q
        Joint angles at the start, rad.
    speed_rad_s, acceleration_rad_s2, acceleration_m_s2
        Largest angular speed, angular acceleration and linear acceleration of the flange on the path.
    seconds
        Shortest duration. It is extended to whole periods.

    Raises
    ------
    ValueError
        No oscillation reaches all three values, or a joint would be too fast.
    """

    real_time = False

    def __init__(
        self,
        dh: Dh,
        q: Vector6,
        seconds: float,
        *,
        speed_rad_s: float = SPEED_RAD_S,
        acceleration_rad_s2: float = ACCELERATION_RAD_S2,
        acceleration_m_s2: float = ACCELERATION_M_S2,
    ) -> None:
        wanted = np.array([speed_rad_s, acceleration_rad_s2, acceleration_m_s2])
        if not (np.isfinite([*wanted, seconds]).all() and min(*wanted, seconds) > 0.0):
            raise ValueError(f"speed, accelerations {wanted.tolist()} and {seconds} s must be positive")
        self._q0 = q
        self._turn = self._lift = 0.1
        self._rate_rad_s = acceleration_rad_s2 / speed_rad_s
        for _ in range(TRIALS):
            missing = wanted / self._peaks(dh)
            if np.abs(missing - 1.0).max() < TOLERANCE:
                break
            faster = missing[1] / missing[0]
            self._rate_rad_s *= faster
            self._turn *= missing[0] / faster
            self._lift *= missing[2] / faster**2
        else:
            raise ValueError(
                f"no swing turns with {wanted[0]} rad/s, {wanted[1]} rad/s² and moves with {wanted[2]} m/s²"
            )
        fastest = np.abs([state.qd for state in self._period()]).max(axis=0)
        if (fastest > dh.max_speed).any():
            raise ValueError(f"the joints would need {fastest.tolist()} rad/s")
        self.period_s = 2 * math.pi / self._rate_rad_s
        self.duration_s = math.ceil(seconds / self.period_s) * self.period_s

    def begin(self, q: Vector6, _qd: Vector6, /) -> None:
        """Plan the motion from the current set-point, see `Path.begin`."""
        self._q0 = q

    def at(self, t: float) -> JointState:
        """Return the set-point at path time `t` with its derivatives, see `Path.at`."""
        q, qd, qdd = list(self._q0), [0.0] * 6, [0.0] * 6
        for size, sweeps in ((self._turn, TURNING), (self._lift, LIFTING)):
            for joint, swings, share in sweeps:
                rate = swings * self._rate_rad_s
                reach, c, s = size * share, math.cos(rate * t), math.sin(rate * t)
                q[joint] += reach * (1.0 - c)
                qd[joint] += reach * rate * s
                qdd[joint] += reach * rate * rate * c
        return JointState(vector6(q), vector6(qd), vector6(qdd))

    def _period(self) -> list[JointState]:
        return [self.at(2 * math.pi * k / (PHASES * self._rate_rad_s)) for k in range(PHASES)]

    def _peaks(self, dh: Dh) -> Array:
        """Return the largest angular speed, angular acceleration and acceleration of the flange, (3,)."""
        motions = [flange_motion(dh, state)[1:] for state in self._period()]
        peaks: Array = np.linalg.norm(motions, axis=2).max(axis=0)
        return peaks


class SwingProgram(ControllerProgram):
    """Program on the pendant that moves the arm along a `Swing`."""

    def __init__(self, robot: Robot, swing: Swing) -> None:
        super().__init__("swing")
        self._steps = self._run(robot, swing)

    def step(self) -> bool:
        """Run one control cycle; return False if the program has ended."""
        return next(self._steps, "ended") is None

    def close(self) -> None:
        """End the program. A moving arm comes to rest."""
        self._steps.close()

    def _run(self, robot: Robot, swing: Swing) -> Generator[None, None, None]:
        robot.arm.start(swing, self.name)
        yield from robot.arm.until_finished(self.name)
