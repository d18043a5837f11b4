"""How the arm moves: the paths of motion commands, and an arm that follows them.

A path is a function of *path time*, which runs slower when the speed slider is down and stands still while the program
is paused. A motion that meets a moving arm first brings it to rest: position and velocity never jump.
"""

import math
from collections import deque
from collections.abc import Generator
from typing import Protocol

from mocks.arrays import Array
from mocks.kinematics import (
    ZERO6,
    Dh,
    Vector6,
    forward,
    inverse_matrix,
    jacobian,
    refine,
    rotation,
    rotvec,
    vector6,
)

FOLLOW_TIME_S = 0.005
"""Time constant with which the joints follow the set-point."""

PAUSE_TIME_S = 0.15
"""Time in which the arm comes to rest on its path when the program pauses, or follows the speed slider."""

IDLE_DECELERATION_RAD_S2 = 8.0
"""Deceleration of an arm that lost its path."""


class MotionError(Exception):
    """The motion cannot be executed; the running program ends."""


class CannotFollow(Exception):
    """The path leads where the arm cannot follow; the safety system stops it."""


class Trapezoid:
    """Distance over time from rest to rest, with a speed limit and constant acceleration.

    Parameters
    ----------
    length, speed, acceleration
        In any one unit of length and seconds; speed and acceleration positive.
    """

    def __init__(self, length: float, speed: float, acceleration: float) -> None:
        if not (speed > 0.0 and acceleration > 0.0):
            raise MotionError(f"speed {speed} and acceleration {acceleration} must be positive")
        self.length = length
        self.acceleration = acceleration
        self.peak = min(speed, math.sqrt(length * acceleration))
        self.ramp_s = self.peak / acceleration
        self.duration_s = length / self.peak + self.ramp_s if length > 0.0 else 0.0

    def at(self, t: float) -> float:
        """Distance covered `t` seconds after the start."""
        left = self.duration_s - t
        if left <= 0.0:
            return self.length
        if t < self.ramp_s:
            return 0.5 * self.acceleration * t * t
        if left < self.ramp_s:
            return self.length - 0.5 * self.acceleration * left * left
        return self.peak * (t - 0.5 * self.ramp_s)


class Path(Protocol):
    """One motion, planned when the arm starts it."""

    duration_s: float
    real_time: bool
    """Whether it ignores speed slider and limiter."""

    def begin(self, q: Vector6, qd: Vector6, /) -> None:
        """Plan from the present set-point: angles (rad) and speeds (rad/s). Sets `duration_s`."""

    def at(self, t: float) -> Vector6:
        """Return the set-point (rad) at path time `t`, called with rising `t` up to `duration_s`."""


class JointMove:
    """movej: all joints start and end together, the one with the longest travel leads.

    Parameters
    ----------
    goal
        Joint angles, rad.
    speed, acceleration
        Of the leading joint, rad/s and rad/s²; no joint exceeds its own speed limit.
    """

    real_time = False

    def __init__(self, dh: Dh, goal: Vector6, speed: float, acceleration: float) -> None:
        Trapezoid(0.0, speed, acceleration)  # refuses impossible values now, not in mid-motion
        self._dh, self._goal, self._speed, self._acceleration = dh, goal, speed, acceleration

    def begin(self, q: Vector6, _qd: Vector6, /) -> None:
        """See `Path`."""
        self._q0 = q
        self._travel = vector6([b - a for a, b in zip(q, self._goal, strict=True)])
        longest = max(abs(w) for w in self._travel)
        speed = self._speed
        for travel, limit in zip(self._travel, self._dh.max_speed, strict=True):
            if abs(travel) * speed > limit * longest:
                speed = limit * longest / abs(travel)
        self._profile = Trapezoid(longest, speed, self._acceleration)
        self.duration_s = self._profile.duration_s

    def at(self, t: float) -> Vector6:
        """See `Path`."""
        if t >= self.duration_s:
            return self._goal
        share = self._profile.at(t) / self._profile.length
        return vector6([a + w * share for a, w in zip(self._q0, self._travel, strict=True)])


class LineMove:
    """movel: the TCP moves along a straight line and turns about a fixed axis, on the present branch of the arm.

    Parameters
    ----------
    X_flange_tcp, goal
        Active TCP and its goal in base, (4, 4).
    speed, acceleration
        m/s and m/s²; a turn of one radian counts as one metre where it is the longer of the two.
    """

    real_time = False

    def __init__(self, dh: Dh, X_flange_tcp: Array, goal: Array, speed: float, acceleration: float) -> None:
        Trapezoid(0.0, speed, acceleration)
        self._dh, self._goal, self._speed, self._acceleration = dh, goal, speed, acceleration
        self._X_flange_tcp, self._X_tcp_flange = X_flange_tcp, inverse_matrix(X_flange_tcp)

    def begin(self, q: Vector6, _qd: Vector6, /) -> None:
        """See `Path`."""
        self._q = q
        self._start = forward(self._dh, q) @ self._X_flange_tcp
        self._travel = self._goal[:3, 3] - self._start[:3, 3]
        self._turn = rotvec(self._goal[:3, :3] @ self._start[:3, :3].T)
        length = max(math.hypot(*self._travel), math.hypot(*self._turn))
        self._profile = Trapezoid(length, self._speed, self._acceleration)
        self.duration_s = self._profile.duration_s

    def at(self, t: float) -> Vector6:
        """See `Path`."""
        if self._profile.length == 0.0:
            return self._q
        share = self._profile.at(t) / self._profile.length
        X = self._start.copy()
        X[:3, 3] += share * self._travel
        X[:3, :3] = rotation(share * self._turn) @ self._start[:3, :3]
        q = refine(self._dh, X @ self._X_tcp_flange, self._q)
        if q is None:
            raise CannotFollow("the straight line leaves the workspace or meets a singularity")
        self._q = q
        return q


class HandMove(JointMove):
    """The operator pushes the arm: as movej, but slider and limiter do not act on it."""

    real_time = True


class Stop:
    """stopj and stopl: slow down linearly along the present direction, within `duration_s` at any slider."""

    real_time = True

    def __init__(self, duration_s: float) -> None:
        self.duration_s = duration_s

    def begin(self, q: Vector6, qd: Vector6, /) -> None:
        """See `Path`."""
        self._q0, self._qd0 = q, qd

    def at(self, t: float) -> Vector6:
        """See `Path`."""
        if self.duration_s <= 0.0:
            return self._q0
        rolled_s = t - t * t / (2 * self.duration_s)
        return vector6([p + v * rolled_s for p, v in zip(self._q0, self._qd0, strict=True)])


class Arm:
    """Set-point and actual joints, and the path being followed.

    Parameters
    ----------
    dh
        The real arm.
    q
        Joint angles (rad) to start with.
    """

    def __init__(self, dh: Dh, q: Vector6) -> None:
        self.dh = dh
        self.q = self.actual_q = q
        self.qd = self.actual_qd = self.qdd = ZERO6
        self.speed_fraction = 1.0
        """Speed slider, 0 to 1."""
        self.pushed_rad = ZERO6
        """How far the operator pushes the joints off their set-points."""
        self.scaling = 1.0
        """Fraction of the speed that the trajectory limiter allows, 0 to 1."""
        self.paused = False
        """Whether the arm should stand still on its path."""
        self.pace = 1.0
        """Present speed of path time, without the slider: `scaling` running, 0 paused, between while it changes."""
        self.still_s = 0.0
        """How long the set-point has stood still."""
        self._slider = 1.0
        self._paths: deque[Path] = deque()
        self._planned: Path | None = None
        self._t = 0.0
        self._owner: str | None = None

    @property
    def at_rest(self) -> bool:
        """Whether the set-point stands still."""
        return not any(self.qd)

    @property
    def busy(self) -> bool:
        """Whether a path is not yet finished."""
        return bool(self._paths)

    @property
    def _under_travel(self) -> bool:
        """Whether there is motion to be ended: a path that has just been finished ended at rest."""
        return self.busy and not self.at_rest

    def start(self, path: Path, owner: str) -> None:
        """Follow `path` for the program thread `owner`, from rest.

        Raises
        ------
        MotionError
            When another thread of the program controls the arm.
        """
        self._seize(owner)
        self._follow([self._rundown(), path] if self._under_travel else [path])

    def stop_joints(self, deceleration: float, owner: str) -> None:
        """stopj: the fastest joint slows down by `deceleration` (rad/s²)."""
        self._brake(max(abs(v) for v in self.qd), deceleration, owner)

    def stop_tool(self, deceleration: float, owner: str) -> None:
        """stopl: the tool slows down by `deceleration` (m/s² or rad/s², whichever takes longer)."""
        twist = jacobian(self.dh, self.q) @ self.qd
        self._brake(max(math.hypot(*twist[:3]), math.hypot(*twist[3:])), deceleration, owner)

    def until_finished(self, owner: str) -> Generator[None, None, None]:
        """Wait a cycle at a time until the path has ended; closing this generator takes the arm from its path."""
        try:
            while self.busy:
                yield
        finally:
            self.release(owner)

    def release(self, owner: str | None = None) -> None:
        """Drop the path of `owner` (None: of any owner); a moving arm comes to rest by itself."""
        if owner is None or owner == self._owner:
            self._owner = None
            self._follow([self._rundown()] if self._under_travel else [])

    def step(self, dt: float) -> None:
        """Let `dt` seconds pass.

        Raises
        ------
        CannotFollow
            When the path leads out of the workspace; the arm stands where it is.
        """
        change = dt / PAUSE_TIME_S
        self.pace = _towards(0.0 if self.paused else self.scaling, self.pace, change)
        self._slider = _towards(self.speed_fraction, self._slider, change)
        q, qd = self.q, ZERO6
        if self._paths:
            try:
                q = self._along(dt if self._paths[0].real_time else dt * self.pace * self._slider)
            except CannotFollow:
                self._paths.clear()
                self.qd = ZERO6
                raise
            if q == self.q:
                q = self.q  # the same object: readers recognise a resting arm by it
            else:
                qd = vector6([(new - old) / dt for new, old in zip(q, self.q, strict=True)])
        if qd is not ZERO6 or self.qd is not ZERO6:
            self.qdd = vector6([(new - old) / dt for new, old in zip(qd, self.qd, strict=True)])
        self.q, self.qd = q, qd
        self.still_s = 0.0 if any(qd) else self.still_s + dt
        self._lag(dt)

    def _seize(self, owner: str) -> None:
        if self.busy and self._owner not in (None, owner):
            raise MotionError(f"another thread ({self._owner}) is already controlling the robot")
        self._owner = owner

    def _follow(self, paths: list[Path]) -> None:
        self._paths = deque(paths)
        self._planned = None

    def _rundown(self) -> Stop:
        return Stop(max(abs(v) for v in self.qd) / IDLE_DECELERATION_RAD_S2)

    def _brake(self, speed: float, deceleration: float, owner: str) -> None:
        if not deceleration > 0.0:
            raise MotionError(f"deceleration {deceleration} must be positive")
        self._seize(owner)
        self._follow([Stop(speed / deceleration)] if self._under_travel else [])

    def _along(self, dt: float) -> Vector6:
        path = self._paths[0]
        if path is not self._planned:
            path.begin(self.q, self.qd)
            self._planned, self._t = path, 0.0
        self._t = min(self._t + dt, path.duration_s)
        q = path.at(self._t)
        if self._t >= path.duration_s:
            self._paths.popleft()
        return q

    def _lag(self, dt: float) -> None:
        goal = self.q
        if self.pushed_rad is not ZERO6:
            goal = vector6([q + off for q, off in zip(self.q, self.pushed_rad, strict=True)])
        if self.actual_q is goal:
            self.actual_qd = ZERO6
            return
        share = 1.0 - math.exp(-dt / FOLLOW_TIME_S)
        after = vector6([a + (b - a) * share for a, b in zip(self.actual_q, goal, strict=True)])
        if self.qd is ZERO6 and max(abs(a - b) for a, b in zip(after, goal, strict=True)) < 1e-9:
            after = goal
        self.actual_qd = vector6([(new - old) / dt for new, old in zip(after, self.actual_q, strict=True)])
        self.actual_q = after


def _towards(goal: float, value: float, change: float) -> float:
    return min(goal, value + change) if value < goal else max(goal, value - change)
