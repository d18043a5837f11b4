"""Motion of the arm: paths of motion commands, and an arm that follows them.

A path is a function of *path time*, which is scaled by the speed slider and stops while the program is paused. If the
arm moves when a motion starts, it is first brought to rest, so position and velocity never jump.

Chosen here, where the script manual is silent: `Servo` is a spring of stiffness `gain` (1/s²), with a damping for which
the set-point lags a target of constant velocity by `lookahead_time`. The speed slider does not act on it. A target that
exceeds the maximum speed of a joint causes a protective stop.
"""

import cmath
import math
from collections import deque
from collections.abc import Generator, Sequence
from typing import NamedTuple, Protocol

import numpy as np

from ftmocks.arrays import Array
from ftmocks.imperfections import IDEAL
from ftmocks.kinematics import (
    ZERO6,
    Dh,
    JointState,
    Vector6,
    cross,
    flange_motion,
    forward,
    inverse_matrix,
    jacobian,
    refine,
    rotation,
    rotvec,
    vector6,
)

SETTLED_RAD = 1e-9
"""Distance from a set-point at rest below which joints have arrived, rad."""

PAUSE_TIME_S = 0.15
"""Time for a change of the pace, when the program pauses or the speed slider changes, s."""

IDLE_DECELERATION_RAD_S2 = 8.0
"""Deceleration with which a moving arm without a path comes to rest."""


NO_WAY_ON = "the straight line leaves the workspace or meets a singularity"


class MotionError(ValueError):
    """A requested motion cannot be executed, which ends the program."""


class CannotFollow(Exception):
    """The arm cannot follow the path, and the safety system stops the arm."""


class Trapezoid:
    """Trapezoidal velocity profile from rest to rest.

    Parameters
    ----------
    length, speed, acceleration
        Length, maximum speed and acceleration in one unit of length and s. Speed and acceleration must be positive.
    """

    def __init__(self, length: float, speed: float, acceleration: float) -> None:
        if not (speed > 0.0 and acceleration > 0.0):
            raise MotionError(f"speed {speed} and acceleration {acceleration} must be positive")
        self.length = length
        self.acceleration = acceleration
        self.peak = min(speed, math.sqrt(length * acceleration))
        self.ramp_s = self.peak / acceleration
        self.duration_s = length / self.peak + self.ramp_s if length > 0.0 else 0.0

    def at(self, t: float) -> tuple[float, float, float]:
        """Return distance, speed and acceleration `t` seconds after the start."""
        left, acceleration = self.duration_s - t, self.acceleration
        if left <= 0.0:
            return self.length, 0.0, 0.0
        if t < self.ramp_s:
            return 0.5 * acceleration * t * t, acceleration * t, acceleration
        if left < self.ramp_s:
            return self.length - 0.5 * acceleration * left * left, acceleration * left, -acceleration
        return self.peak * (t - 0.5 * self.ramp_s), self.peak, 0.0


class Path(Protocol):
    """A motion that is planned when the arm starts it."""

    duration_s: float
    real_time: bool
    """Whether this motion ignores the speed slider and the trajectory limiter."""

    def begin(self, q: Vector6, qd: Vector6, /) -> None:
        """Plan the motion from the current set-point: angles (rad) and speeds (rad/s). Sets `duration_s`."""

    def at(self, t: float) -> JointState:
        """Return the set-point at path time `t` with its derivatives. `t` must not decrease between calls."""


class JointMove:
    """movej: all joints start and end together. The leading joint has the longest travel.

    Parameters
    ----------
    goal
        Joint angles, rad.
    speed, acceleration
        Speed and acceleration of the leading joint, rad/s and rad/s². No joint exceeds its speed limit.
    """

    real_time = False

    def __init__(self, dh: Dh, goal: Vector6, speed: float, acceleration: float) -> None:
        Trapezoid(0.0, speed, acceleration)  # rejects impossible speeds before the motion starts
        self._dh, self._goal, self._speed, self._acceleration = dh, goal, speed, acceleration

    def begin(self, q: Vector6, _qd: Vector6, /) -> None:
        """Plan the motion from the current set-point, see `Path.begin`."""
        self._q0 = q
        self._travel = vector6([b - a for a, b in zip(q, self._goal, strict=True)])
        longest = max(abs(w) for w in self._travel)
        speed = self._speed
        for travel, limit in zip(self._travel, self._dh.max_speed, strict=True):
            if abs(travel) * speed > limit * longest:
                speed = limit * longest / abs(travel)
        self._profile = Trapezoid(longest, speed, self._acceleration)
        self.duration_s = self._profile.duration_s

    def at(self, t: float) -> JointState:
        """Return the set-point at path time `t` with its derivatives, see `Path.at`."""
        if t >= self.duration_s:
            return JointState(self._goal)
        share, speed, acceleration = (value / self._profile.length for value in self._profile.at(t))
        return JointState(
            vector6([a + w * share for a, w in zip(self._q0, self._travel, strict=True)]),
            vector6([w * speed for w in self._travel]),
            vector6([w * acceleration for w in self._travel]),
        )


class LineMove:
    """movel: the TCP moves along a straight line and rotates about a fixed axis. The arm keeps its configuration.

    Parameters
    ----------
    X_flange_tcp, goal
        (4, 4) pose of the active TCP in the flange, and goal of the TCP in the base.
    speed, acceleration
        Speed and acceleration, m/s and m/s². If it takes longer, the rotation determines the duration, 1 rad as 1 m.
    """

    real_time = False

    def __init__(self, dh: Dh, X_flange_tcp: Array, goal: Array, speed: float, acceleration: float) -> None:
        Trapezoid(0.0, speed, acceleration)
        self._dh, self._goal, self._speed, self._acceleration = dh, goal, speed, acceleration
        self._X_flange_tcp, self._X_tcp_flange = X_flange_tcp, inverse_matrix(X_flange_tcp)

    def begin(self, q: Vector6, _qd: Vector6, /) -> None:
        """Plan the motion from the current set-point, see `Path.begin`."""
        self._q = q
        self._start = forward(self._dh, q) @ self._X_flange_tcp
        self._travel = self._goal[:3, 3] - self._start[:3, 3]
        self._turn = rotvec(self._goal[:3, :3] @ self._start[:3, :3].T)
        length = max(math.hypot(*self._travel), math.hypot(*self._turn))
        self._profile = Trapezoid(length, self._speed, self._acceleration)
        self.duration_s = self._profile.duration_s

    def at(self, t: float) -> JointState:
        """Return the set-point at path time `t` with its derivatives, see `Path.at`."""
        if self._profile.length == 0.0:
            return JointState(self._q)
        share, speed, acceleration = (value / self._profile.length for value in self._profile.at(t))
        X = self._start.copy()
        X[:3, 3] += share * self._travel
        X[:3, :3] = rotation(share * self._turn) @ self._start[:3, :3]
        X_base_flange = X @ self._X_tcp_flange
        q = refine(self._dh, X_base_flange, self._q)
        if q is None:
            raise CannotFollow(NO_WAY_ON)
        self._q = q
        try:
            return self._derived(q, X_base_flange[:3, 3] - X[:3, 3], speed, acceleration)
        except np.linalg.LinAlgError:
            raise CannotFollow(NO_WAY_ON) from None

    def _derived(self, q: Vector6, lever: Array, speed: float, acceleration: float) -> JointState:
        """Return joint angles with their derivatives; `lever` (3,) is the vector from TCP to flange in the base."""
        turning = speed * self._turn
        moving = speed * self._travel + cross(turning, lever)
        J = jacobian(self._dh, q)
        qd = vector6(np.linalg.solve(J, np.concatenate((moving, turning))).tolist())
        turned = acceleration * self._turn
        moved = acceleration * self._travel + cross(turned, lever) + cross(turning, cross(turning, lever))
        coasting = flange_motion(self._dh, JointState(q, qd))
        rest = np.concatenate((moved - coasting.acceleration, turned - coasting.angular_acceleration))
        return JointState(q, qd, vector6(np.linalg.solve(J, rest).tolist()))


def damped(off: float, speed: float, stiffness: float, damping: float, t: float) -> tuple[float, float]:
    """Return displacement and velocity of ``x'' = -damping x' - stiffness x`` after `t` seconds."""
    half = damping / 2
    root = cmath.sqrt(half * half - stiffness) or 1e-9
    near, turned = cmath.cosh(root * t), cmath.sinh(root * t) / root
    left = math.exp(-half * t)
    pull = -stiffness * off - half * speed
    return (
        left * (off * near + (speed + half * off) * turned).real,
        left * (speed * near + pull * turned).real,
    )


class Command(NamedTuple):
    """A target of servoj."""

    q: Vector6
    seconds: float
    """Time from the previous target of servoj to this one, s."""
    lookahead_s: float
    gain: float


class Servo:
    """servoj: the set-point follows a sequence of targets.

    Parameters
    ----------
    q
        The first target, rad.
    """

    real_time = False
    duration_s = math.inf

    def __init__(self, dh: Dh, q: Vector6) -> None:
        self._dh, self.target, self._from = dh, q, q
        self._commands: deque[Command] = deque()
        self._into_s = self._t = 0.0
        self._gain, self._lookahead_s = 1.0, 1.0

    @property
    def ahead_s(self) -> float:
        """Time until the last commanded target is due, s."""
        return sum(command.seconds for command in self._commands) - self._into_s

    def command(self, command: Command) -> None:
        """Add the next target of a continuous motion.

        Raises
        ------
        CannotFollow
            A joint would exceed its maximum speed.
        """
        for joint, (a, b, limit) in enumerate(zip(self.target, command.q, self._dh.max_speed, strict=True), 1):
            if abs(b - a) > limit * command.seconds * (1 + 1e-9):
                jump = f"the target of joint {joint} jumps by {b - a:.4f} rad in {command.seconds:.3f} s"
                raise CannotFollow(f"servoj: {jump}, at most {limit * command.seconds:.4f} rad are possible")
        self._commands.append(command)
        self.target = command.q

    def begin(self, q: Vector6, qd: Vector6, /) -> None:
        """Plan the motion from the current set-point, see `Path.begin`."""
        self._state = JointState(q, qd)

    def at(self, t: float) -> JointState:
        """Return the set-point at path time `t` with its derivatives, see `Path.at`."""
        left_s, self._t = t - self._t, t
        while self._commands and left_s > 0.0:
            goal, seconds, self._lookahead_s, self._gain = self._commands[0]
            passed_s = min(left_s, seconds - self._into_s)
            rate = vector6([(b - a) / seconds for a, b in zip(self._from, goal, strict=True)])
            begun = vector6([a + v * self._into_s for a, v in zip(self._from, rate, strict=True)])
            self._pass(passed_s, begun, rate)
            left_s -= passed_s
            self._into_s += passed_s
            if seconds - self._into_s < 1e-9:
                self._commands.popleft()
                self._from, self._into_s = goal, 0.0
        if left_s > 0.0:
            self._pass(left_s, self._from, ZERO6)
        return self._state

    def _pass(self, t: float, target: Vector6, rate: Vector6) -> None:
        """Advance the spring by a time during which the target moves with constant velocity."""
        gain, damping = self._gain, self._gain * self._lookahead_s
        states = []
        for q, v, goal, u in zip(*self._state[:2], target, rate, strict=True):
            off, speed = damped(q - goal + self._lookahead_s * u, v - u, gain, damping, t)
            if u == 0.0 and abs(off) + abs(speed) < SETTLED_RAD:
                off = speed = 0.0
            at_s = t - self._lookahead_s
            states.append((goal + u * at_s + off, u + speed, -damping * speed - gain * off))
        self._state = JointState(*(vector6(values) for values in zip(*states, strict=True)))


class HandMove(JointMove):
    """A motion by the operator's hand: like movej, but independent of the slider and the limiter."""

    real_time = True


class Stop:
    """stopj and stopl: decelerate in the current direction within `duration_s`, independent of the slider."""

    real_time = True

    def __init__(self, duration_s: float) -> None:
        self.duration_s = duration_s

    def begin(self, q: Vector6, qd: Vector6, /) -> None:
        """Plan the motion from the current set-point, see `Path.begin`."""
        self._q0, self._qd0 = q, qd

    def at(self, t: float) -> JointState:
        """Return the set-point at path time `t` with its derivatives, see `Path.at`."""
        if self.duration_s <= 0.0:
            return JointState(self._q0)
        rolled_s, left, braking = t - t * t / (2 * self.duration_s), 1.0 - t / self.duration_s, -1.0 / self.duration_s
        return JointState(
            vector6([p + v * rolled_s for p, v in zip(self._q0, self._qd0, strict=True)]),
            vector6([v * left for v in self._qd0]),
            vector6([v * braking for v in self._qd0]),
        )


class Following(NamedTuple):
    """Actual joints after a control cycle, which follow a set-point with constant acceleration.

    Parameters
    ----------
    lag_s
        Time constant of the lag.
    target
        The set-point in that cycle.
    qd
        Joint speeds in that cycle, rad/s; the joints lag the set-point by ``lag_s * qd``.
    off_rad
        Deflection of the joints when the operator pushes the arm.
    """

    lag_s: float
    target: JointState
    qd: Vector6
    off_rad: Vector6 = ZERO6

    def at(self, t: float) -> JointState:
        """Return the actual joints after `t` seconds, which may be negative. The acceleration must be constant."""
        T = self.lag_s
        target_qd = [v + c * t for v, c in zip(self.target.qd, self.target.qdd, strict=True)]
        qd = _followed(self.qd, self.target.qd, target_qd, self.target.qdd, t, T)
        q = [
            p + (v + 0.5 * c * t) * t + off - T * own
            for p, v, c, off, own in zip(*self.target, self.off_rad, qd, strict=True)
        ]
        qdd = [(v - own) / T for v, own in zip(target_qd, qd, strict=True)]
        return JointState(vector6(q), vector6(qd), vector6(qdd))


class Arm:
    """Set-point and actual joints of the arm, and its current path.

    Parameters
    ----------
    dh
        Kinematics of the real arm.
    q
        Initial joint angles, rad.
    lag_s
        Time constant with which the joints follow the set-point.
    """

    obstacle: str | None = None
    """Reason why this arm cannot be moved, or None."""

    def __init__(self, dh: Dh, q: Vector6, lag_s: float = IDEAL.servo_lag_s) -> None:
        self.dh = dh
        self.lag_s = lag_s
        self.q = self.actual_q = q
        self.qd = self.actual_qd = self.qdd = ZERO6
        self.motion: Following | None = None
        """Motion of the actual joints, which lag the set-point, after the last cycle; None while they are at rest."""
        self.speed_fraction = 1.0
        """Speed slider, 0 to 1."""
        self.pushed_rad = ZERO6
        """Deflection of the joints from their set-points when the operator pushes the arm, rad."""
        self.scaling = 1.0
        """Fraction of the speed that the trajectory limiter allows, 0 to 1."""
        self.paused = False
        """Whether the arm should pause: stand still on its path, and continue later."""
        self.pace = 1.0
        """Current speed of path time without the slider: `scaling`, 0 if paused, or a transition between them."""
        self.still_s = 0.0
        """Time for which the set-point has been at rest, s."""
        self._slider = 1.0
        self._rates = (1.0, 1.0)
        """Speeds of path time: for servoj, on which the speed slider does not act, and for all other paths."""
        self._off_rad = ZERO6
        self._paths: deque[Path] = deque()
        self._planned: Path | None = None
        self._t = 0.0
        self._owner: str | None = None

    @property
    def at_rest(self) -> bool:
        """Whether the set-point is at rest."""
        return not any(self.qd)

    @property
    def busy(self) -> bool:
        """Whether the arm has a path that has not ended."""
        return bool(self._paths)

    def start(self, path: Path, owner: str) -> None:
        """Follow `path` from rest, for the program thread `owner`.

        Raises
        ------
        MotionError
            Another thread of the program controls the arm.
        """
        self._seize(owner)
        self._follow([self._rundown(), path] if not self.at_rest else [path])

    def servo(self, command: Command, owner: str) -> Servo:
        """Follow a target of servoj from the current motion.

        Raises
        ------
        MotionError
            Another thread of the program controls the arm.
        CannotFollow
            The target jumps. The arm continues to the last one.
        """
        self._seize(owner)
        if not isinstance(servo := self._paths[-1] if self._paths else None, Servo):
            servo = Servo(self.dh, self.q)
            servo.command(command)
            self._follow([servo])
        else:
            servo.command(command)
        return servo

    def stop_joints(self, deceleration: float, owner: str) -> None:
        """stopj: decelerate the fastest joint by `deceleration`, rad/s²."""
        self._brake(max(abs(v) for v in self.qd), deceleration, owner)

    def stop_tool(self, deceleration: float, owner: str) -> None:
        """stopl: decelerate the tool by `deceleration`, m/s² or rad/s², whichever takes longer."""
        twist = jacobian(self.dh, self.q) @ self.qd
        self._brake(max(math.hypot(*twist[:3]), math.hypot(*twist[3:])), deceleration, owner)

    def until_finished(self, owner: str) -> Generator[None, None, None]:
        """Yield once per cycle until the path has ended. Closing this generator cancels the path."""
        try:
            while self.busy:
                yield
        finally:
            self.release(owner)

    def release(self, owner: str | None = None) -> None:
        """Cancel the path of `owner` (None: of any owner). A moving arm comes to rest."""
        if owner is None or owner == self._owner:
            self._owner = None
            self._follow([self._rundown()] if not self.at_rest else [])

    def step(self, dt: float, _t_s: float = 0.0) -> None:
        """Advance set-point and actual joints by one control cycle of `dt` seconds.

        Raises
        ------
        CannotFollow
            The path leaves the workspace. The arm stops where it is.
        """
        change = dt / PAUSE_TIME_S
        self.pace = _towards(0.0 if self.paused else self.scaling, self.pace, change)
        self._slider = _towards(self.speed_fraction, self._slider, change)
        before_rates, self._rates = self._rates, (self.pace, self.pace * self._slider)
        state, before_qd = JointState(self.q), self.qd
        if self._paths:
            try:
                state = self._along(dt, before_rates)
            except CannotFollow:
                self._paths.clear()
                self.qd = self.qdd = ZERO6
                raise
        if state.q != self.q:  # at rest, keep the same tuple: other code detects rest by comparing identities
            self.q = state.q
        self.qd, self.qdd = (value if any(value) else ZERO6 for value in state[1:])
        self.still_s = 0.0 if any(self.qd) else self.still_s + dt
        self._lag(dt, before_qd)

    def _seize(self, owner: str) -> None:
        if self.busy and self._owner not in (None, owner):
            raise MotionError("Another thread is already controlling the robot")
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
        self._follow([Stop(speed / deceleration)] if not self.at_rest else [])

    def _along(self, dt: float, before_rates: tuple[float, float]) -> JointState:
        """Advance path time, whose speed changes linearly in this cycle; return the new set-point."""
        path = self._paths[0]
        others = not isinstance(path, Servo)
        if path is not self._planned:
            path.begin(self.q, self.qd)
            self._planned, self._t = path, 0.0
        before, rate = (1.0, 1.0) if path.real_time else (before_rates[others], self._rates[others])
        self._t = min(self._t + 0.5 * (before + rate) * dt, path.duration_s)
        state = path.at(self._t)
        if self._t >= path.duration_s:
            self._paths.popleft()
            return JointState(state.q)
        change = (rate - before) / dt
        return JointState(
            state.q,
            vector6([v * rate for v in state.qd]),
            vector6([c * rate * rate + v * change for v, c in zip(*state[1:], strict=True)]),
        )

    def _lag(self, dt: float, before_qd: Vector6) -> None:
        """Let the joints follow the set-point and a push of the operator."""
        if self.motion is None and self.qd is ZERO6 and before_qd is ZERO6 and self._off_rad is self.pushed_rad:
            self.actual_qd = ZERO6
            return
        lag_s = self.lag_s
        qdd = [(new - old) / dt for new, old in zip(self.qd, before_qd, strict=True)]
        qd = vector6(_followed(self.motion.qd if self.motion else ZERO6, before_qd, self.qd, qdd, dt, lag_s))
        off_rad = self._yielded(math.exp(-dt / lag_s))
        pushed = [(new - old) / dt for new, old in zip(off_rad, self._off_rad, strict=True)]
        self._off_rad = off_rad
        if self.qd is ZERO6 and lag_s * max(map(abs, qd)) < SETTLED_RAD:
            qd, self.motion = ZERO6, None
        else:
            self.motion = Following(lag_s, JointState(self.q, self.qd, self.qdd), qd, off_rad)
        behind = zip(self.q, off_rad, qd, strict=True)
        settled = self.motion is None and off_rad is ZERO6
        self.actual_q = self.q if settled else vector6([q + off - lag_s * v for q, off, v in behind])
        self.actual_qd = vector6([v + push for v, push in zip(qd, pushed, strict=True)])

    def _yielded(self, left: float) -> Vector6:
        """Return the deflection of the joints by a push of the operator after one control cycle, rad."""
        before, goal = self._off_rad, self.pushed_rad
        after = vector6([g + (off - g) * left for off, g in zip(before, goal, strict=True)])
        return goal if max(abs(off - g) for off, g in zip(after, goal, strict=True)) < SETTLED_RAD else after


def _followed(
    qd: Vector6, before: Vector6, target: Sequence[float], qdd: Sequence[float], t: float, lag_s: float
) -> list[float]:
    """Return the speeds of joints that have followed a set-point for a time.

    Parameters
    ----------
    qd
        Initial joint speeds.
    before, target, qdd
        Initial and final speeds of the set-point, and its acceleration.
    t, lag_s
        Duration, and time constant of the lag.
    """
    T, left = lag_s, math.exp(-t / lag_s)
    return [v - T * c + (own - old + T * c) * left for own, old, v, c in zip(qd, before, target, qdd, strict=True)]


def _towards(goal: float, value: float, change: float) -> float:
    return min(goal, value + change) if value < goal else max(goal, value - change)
