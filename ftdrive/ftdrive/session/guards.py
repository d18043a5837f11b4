"""Guards that watch the arm while the program controls it; `watchdog.py` runs them in a thread.

Each guard covers rows of the hazard table in docs/reference/hazards.md, which also names the test of each row. A guard
judges one observation, `Seen`, and raises `Tripped`. No guard is a safety function: safety is the task of the robot's
safety system and of the user's risk assessment.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, Final, Self

import numpy as np

from ftcalib.model import Array
from ftdrive.checks.sensor import AXES, SATURATION
from ftdrive.errors import SupervisorGone
from ftdrive.planning.geometry.certify import Certifier
from ftdrive.session.events import Hazard
from ftdrivers.clock import Clock
from ftdrivers.errors import DeviceError, DeviceFault, DeviceTimeout
from ftdrivers.interfaces import ArmState, ArmStatus

G_M_S2: Final = 9.81
_SLIDER: Final = 0.02
# On a curve, the arm has made progress once a joint has turned by this angle.
_PROGRESS_RAD: Final = 1e-3


class Tripped(Exception):
    """Raised by a guard that stops the session; `error` is the cause, `hazard` the row of the hazard table."""

    def __init__(self, hazard: Hazard, error: Exception) -> None:
        super().__init__(str(error))
        self.hazard = hazard
        self.error = error


def fault(hazard: Hazard, *words: str) -> Tripped:
    """Return a trip whose error is a `DeviceFault` with this text."""
    return Tripped(hazard, DeviceFault(*words))


@dataclass(frozen=True, slots=True)
class Limits:
    """Limits of the guards and of the preflight checks; the hazard table quotes them."""

    frozen_rad: float = float(np.radians(0.5))
    """Largest allowed motion of a joint that should be at rest."""
    tracking_rad: float = float(np.radians(2.0))
    """Largest allowed distance of a moving joint from the planned path in joint space."""
    flange_m: float = 0.002
    flange_rad: float = float(np.radians(0.2))
    """Largest deviation of the reported flange pose from this arm's own kinematics; twice the limit of its driver."""
    nominal_m: float = 0.020
    nominal_rad: float = float(np.radians(3.0))
    """Largest deviation of the flange pose from a model's nominal kinematics. Real arms deviate by 7.5 mm and 1.3°."""
    lag_s: float = 0.008
    """Largest delay between the joint angles and the flange pose of one reported state."""
    sensor_age_moving_s: float = 0.1
    sensor_age_holding_s: float = 0.5
    """Longest time without a new sample of the sensor: while the arm moves, and while it stands."""
    frozen_samples_s: float = 0.2
    """Longest time for which all samples of the sensor may be equal."""
    saturation: float = SATURATION
    """Largest share of the sensor's range that a reading may reach."""
    contact_N: float = 8.0
    contact_Nm: float = 0.8
    contact_sigmas: float = 5.0
    """The contact limit is `contact_N` or `contact_Nm`, or this number of noise standard deviations if larger."""
    unknown_N: float = 15.0
    unknown_Nm: float = 1.5
    """Contact limit until the running fit is reliable, in addition to twice the weight of the heaviest tool."""
    low_pass_Hz: float = 20.0
    skew_s: float = 0.03
    """Largest time between a wrench and the pose of the arm with which it is compared."""
    stalled_s: float = 10.0
    look_s: float = 0.01
    """Period of the guards, s."""
    counted_s: float = 0.02
    """Most time that a guard counts between two observations, so that a pause of this process trips no other guard."""
    aside_s: float = 0.05
    """Period, s, at which the safety status is read while the guards watch no motion."""
    blind_s: float = 1.0
    """Time without a status after which an emergency stop may have been pressed and released unnoticed."""
    hung_s: float = 1.0
    """Time without an observation after which the guards are considered hung."""
    slow_stop_s: float = 0.2
    """A stop that takes longer than this is reported before it ends. A responsive arm brakes from 60 °/s in 0.2 s."""
    link_usual_s: float = 0.02
    """Largest median response time of the arm; waiting for its next state is up to 8 ms of it."""
    link_asked_s: float = 0.04
    """Added to `link_usual_s` if the controller reports its TCP only to a program: two requests, usually 24 ms."""
    link_gap_s: float = 0.1
    """Response time of the arm that nine of ten answers must not exceed."""
    program_ends_s: float = 1.5
    """Time-out for the end of an earlier session's program, which ends by itself 0.5 s after its session was killed."""

    @classmethod
    def of(cls, clock: Clock) -> Self:
        """Return the limits for a cell with this clock. An emulated clock may lead its arm, so it gets longer times."""
        usual = cls()
        return cls(link_usual_s=usual.link_usual_s + clock.lead_s, stalled_s=clock.patience_s(usual.stalled_s))


@dataclass(frozen=True, eq=False)
class ExpectedMotion:
    """The expected motion: a straight move in joint space, a curve, or standstill."""

    start_rad: Array
    goal_rad: Array
    moving: bool
    curve_rad: Array | None = None
    """(n, 6) dense points of a curve from start to goal."""

    @cached_property
    def turns_rad(self) -> Array:
        """Range (6,) that each joint covers, rad."""
        if self.curve_rad is None:
            return np.abs(self.goal_rad - self.start_rad)
        return np.asarray(np.ptp(self.curve_rad, axis=0))

    def nearest_rad(self, q_rad: Array) -> Array:
        """Return the point (6,) of the motion that is nearest to a posture (6,)."""
        if self.curve_rad is not None:
            return np.asarray(self.curve_rad[np.square(self.curve_rad - q_rad).sum(axis=1).argmin()])
        turn = self.goal_rad - self.start_rad
        length2 = float(turn @ turn)
        share = 0.0 if length2 == 0 else float(np.clip((q_rad - self.start_rad) @ turn / length2, 0, 1))
        return np.asarray(self.start_rad + share * turn)


@dataclass(frozen=True, slots=True, eq=False)
class Seen:
    """One observation of the arm and the sensor."""

    t_s: float
    """Time of the observation on the cell's clock."""
    dt_s: float
    """Time since the previous observation, at most `Limits.counted_s`."""
    motion: ExpectedMotion
    state: ArmState
    status: ArmStatus
    wrench: Array
    """(6,) newest sample of the sensor, N and N·m."""
    sample: int
    """Sequence number of that sample."""
    turn_rad_s: float
    """Angular speed of the flange between the previous observation and this one."""


class Guard(ABC):
    """Watches one row of the hazard table, or several rows with the same signal."""

    def begin(self, seen: Seen) -> None:
        """Take this observation as the reference: it is the first of a session, or the first after a resume."""
        del seen  # most guards need no reference

    @abstractmethod
    def look(self, seen: Seen) -> None:
        """Raise `Tripped` if this observation shows the hazard."""


@dataclass
class SupervisorGuard(Guard):
    """Guards against hazard 27: trips if no operator, or program in their place, follows the session."""

    absence: Callable[[], str | None]
    """Returns why no operator follows, or None, like `Operator.absence`."""

    def look(self, seen: Seen) -> None:
        """Trip if the operator is absent."""
        del seen  # an observation of the arm does not show whether an operator follows
        if why := self.absence():
            raise Tripped(Hazard.SUPERVISOR_GONE, SupervisorGone(why))


@dataclass
class PathGuard(Guard):
    """Guards against hazards 2 and 21: trips if a moving joint leaves the planned path, or a resting one moves."""

    limits: Limits

    def look(self, seen: Seen) -> None:
        """Compare the joint angles with the nearest point of the motion."""
        motion, q = seen.motion, seen.state.q_rad
        off = np.abs(q - motion.nearest_rad(q))
        resting = (motion.turns_rad < 1e-3) & ((np.arange(6) < 3) | (not motion.moving))
        allowed = np.where(resting, self.limits.frozen_rad, self.limits.tracking_rad)
        if not (off > allowed).any():
            return
        joint = int(np.argmax(off / allowed))
        words = f"joint {joint + 1} is {np.degrees(off[joint]):.1f}° off its planned position"
        if motion.moving:
            raise fault(
                Hazard.SELF_COLLISION,
                f"{words} during the move (allowed: {np.degrees(allowed[joint]):.1f}°): find what holds the arm",
            )
        raise fault(
            Hazard.OTHER_CLIENT,
            f"{words} while the arm should stand still: stop whatever else moves the arm, then resume",
        )


@dataclass
class StallGuard(Guard):
    """Guards against hazard 22: trips if the arm makes no progress during a move; slow progress is allowed."""

    limits: Limits
    _nearest_rad: float = field(default=np.inf, init=False)
    _still_s: float = field(default=0.0, init=False)
    _on_curve: Array | None = field(default=None, init=False)
    _goal_rad: Array | None = field(default=None, init=False)

    def look(self, seen: Seen) -> None:
        """Measure how long the arm makes no progress: towards the goal, or on a curve in any direction."""
        goal = seen.motion.goal_rad
        if seen.motion.curve_rad is not None:
            if self._on_curve is None or np.abs(seen.state.q_rad - self._on_curve).max() > _PROGRESS_RAD:
                self._on_curve, self._still_s = seen.state.q_rad, 0.0
            left, self._nearest_rad, self._goal_rad = np.inf, -np.inf, goal
        else:
            self._on_curve = None
            left = float(np.abs(goal - seen.state.q_rad).max())
        if goal is not self._goal_rad or not seen.motion.moving or left < self._nearest_rad - 1e-4:
            self._goal_rad, self._nearest_rad, self._still_s = goal, left, 0.0
            return
        self._still_s += seen.dt_s
        if self._still_s > self.limits.stalled_s and left > 1e-3:
            raise Tripped(
                Hazard.STALL,
                DeviceTimeout(
                    f"the arm has not come nearer to its goal for {self._still_s:.0f} s (speed slider "
                    f"{100 * seen.status.speed_slider:.0f} %, scaling {100 * seen.status.speed_scaling:.0f} %): set "
                    "the slider on the pendant, or find what holds the arm"
                ),
            )


@dataclass
class SliderGuard(Guard):
    """Guards against hazard 22 in a sweep: trips if the speed slider, without effect on a sweep, is moved."""

    _before: float | None = field(default=None, init=False)

    def begin(self, seen: Seen) -> None:
        """Store the position of the slider."""
        self._before = seen.status.speed_slider

    def look(self, seen: Seen) -> None:
        """Compare the slider with its stored position during a sweep."""
        if self._before is None or seen.motion.curve_rad is None:
            return
        if abs(seen.status.speed_slider - self._before) > _SLIDER:
            raise fault(
                Hazard.STALL,
                f"the speed slider was moved from {100 * self._before:.0f} to {100 * seen.status.speed_slider:.0f} %, "
                "which does not affect a running sweep: start the sweep again at the new speed",
            )


@dataclass
class ModelGuard(Guard):
    """Guards against hazards 8 and 9: trips if the reported flange pose contradicts the kinematics of the arm."""

    limits: Limits
    certifier: Certifier

    def look(self, seen: Seen) -> None:
        """Check the flange pose of this observation."""
        self.judge(seen.state)

    def judge(self, state: ArmState) -> None:
        """Compare the reported flange pose with the forward kinematics for which the plan was certified."""
        arm, limits = self.certifier.arm, self.limits
        at = arm.frames(state.q_rad)
        away_m = float(np.linalg.norm(at.flange_m[0] - state.p_base_flange_m))
        cosine = (np.trace(at.R_base_flange[0].T @ state.R_base_flange) - 1) / 2
        away_rad = float(np.arccos(np.clip(cosine, -1, 1)))
        lag_rad = float(np.abs(state.qd_rad_s).sum()) * limits.lag_s
        allowed_m, allowed_rad = limits.flange_m, limits.flange_rad
        if arm.is_nominal:
            allowed_m, allowed_rad = limits.nominal_m, limits.nominal_rad
        reach_m = float(np.linalg.norm(at.flange_m[0]))
        if away_m > allowed_m + lag_rad * reach_m or away_rad > allowed_rad + lag_rad:
            raise fault(
                Hazard.WRONG_TCP,
                f"the flange is {1e3 * away_m:.1f} mm and {np.degrees(away_rad):.2f}° off the pose that the kinematics "
                f"of a {arm.name} give: check the model and the active TCP",
            )


@dataclass
class SettingsGuard(Guard):
    """Guards against hazards 7 and 8: trips if the payload or the TCP set in the controller changes."""

    _before: ArmStatus | None = field(default=None, init=False)

    def begin(self, seen: Seen) -> None:
        """Store the payload and the TCP."""
        self._before = seen.status

    def look(self, seen: Seen) -> None:
        """Compare the payload and the TCP with the stored values."""
        before, now = self._before, seen.status
        if before is None:
            return
        if _changed(before.tcp_offset, now.tcp_offset):
            raise fault(
                Hazard.WRONG_TCP,
                f"the active TCP was changed to {_rounded(now.tcp_offset)}: find what changed it, then resume",
            )
        for what, was, reported in (
            ("payload in kg", before.payload_kg, now.payload_kg),
            ("centre of the payload in m", before.p_flange_payload_m, now.p_flange_payload_m),
        ):
            if _changed(was, reported):
                raise fault(
                    Hazard.WRONG_PAYLOAD,
                    f"the controller's {what} was changed from {_rounded(was)} to {_rounded(reported)}: find "
                    "what set it, then resume",
                )


@dataclass
class SafetyGuard(Guard):
    """Guards against hazards 7, 10, 11, 12 and 21: trips on a safety stop, or if the control program ends."""

    _mode: str | None = field(default=None, init=False)

    def begin(self, seen: Seen) -> None:
        """Store the safety mode: normal, or reduced if the operator has accepted that."""
        self._mode = seen.status.safety_mode

    def look(self, seen: Seen) -> None:
        """Trip on every stop, every change of the safety mode, and every pause or end of the control program."""
        status = seen.status
        if status.fault is not None:
            raise by_safety(status, f"the arm stopped: {status.fault}")
        if self._mode is not None and status.safety_mode != self._mode:
            raise fault(
                Hazard.SAFETY_MODE,
                f"the safety mode changed from {self._mode} to {status.safety_mode}: check the pendant",
            )
        if status.program in ("stopping", "stopped"):
            raise fault(
                Hazard.OTHER_CLIENT,
                f"the control program is {status.program}: it ended by itself, or a second Ctrl-C, the pendant or "
                "another client ended it; read the log of the pendant, then resume",
            )
        if status.program != "playing":
            raise fault(
                Hazard.OTHER_CLIENT,
                f"the control program is {status.program}: the pendant or another client paused it; leave the "
                "arm to this program, then resume",
            )


@dataclass
class SensorGuard(Guard):
    """Guards against hazard 15: trips if the sensor sends no new samples, or samples that never change."""

    limits: Limits
    _sample: int = field(default=-1, init=False)
    _silent_s: float = field(default=0.0, init=False)
    _wrench: Array | None = field(default=None, init=False)
    _same_s: float = field(default=0.0, init=False)
    _same: int = field(default=0, init=False)

    def begin(self, seen: Seen) -> None:
        """Forget earlier samples."""
        self._sample, self._silent_s = seen.sample - 1, 0.0
        self._wrench, self._same_s, self._same = None, 0.0, 0

    def look(self, seen: Seen) -> None:
        """Measure how long no sample arrives, or all samples are equal."""
        if not np.isfinite(seen.wrench).all():
            raise fault(Hazard.SENSOR_LOST, f"the sensor sent {seen.wrench.tolist()}: check its cable and power")
        if seen.sample == self._sample:
            self._silent_s += seen.dt_s
        else:
            self._sample, self._silent_s = seen.sample, 0.0
        allowed = self.limits.sensor_age_moving_s if seen.motion.moving else self.limits.sensor_age_holding_s
        if self._silent_s > allowed:
            raise Tripped(
                Hazard.SENSOR_LOST,
                DeviceTimeout(f"the sensor has sent no sample for {self._silent_s:.2f} s: check its cable and power"),
            )
        if self._wrench is not None and np.array_equal(seen.wrench, self._wrench):
            self._same_s, self._same = self._same_s + seen.dt_s, self._same + 1
        else:
            self._same_s, self._same = 0.0, 0
        self._wrench = seen.wrench
        if self._silent_s == 0 and self._same > 10 and self._same_s > self.limits.frozen_samples_s:
            raise fault(
                Hazard.SENSOR_LOST, f"the sensor repeated one reading for {self._same_s:.2f} s: restart it, then resume"
            )


@dataclass
class RangeGuard(Guard):
    """Guards against hazard 13: trips if an axis is near the end of its range; never if the range is unknown."""

    limits: Limits
    range: Array | None
    """Largest wrench (6,) of the sensor, N and N·m; None if it is unknown."""
    zero: Array = field(default_factory=lambda: np.zeros(6))
    """Reading (6,), N and N·m, from which the range is counted: not 0 if the zero of the sensor is arbitrary."""

    def look(self, seen: Seen) -> None:
        """Check the newest sample."""
        self.judge(seen.wrench)

    def judge(self, wrench: Array) -> None:
        """Trip if a sample (..., 6) exceeds the allowed share of the range."""
        if self.range is None:
            return
        share = (np.abs(wrench - self.zero) / self.range).reshape(-1, 6).max(axis=0)
        if share.max() > self.limits.saturation:
            axis = int(share.argmax())
            verb = "reading has changed by" if self.zero.any() else "reads"
            raise fault(
                Hazard.OVERLOAD,
                f"the sensor {verb} {100 * share[axis]:.0f} % of its range in {AXES[axis]}: "
                "take the load off, or use a lighter or shorter tool",
            )


@dataclass
class ContactGuard(Guard):
    """Guards against hazards 14 and 1: trips if the sensor carries more than the weight of the tool."""

    limits: Limits
    heaviest_kg: float
    """Mass of the heaviest possible tool."""
    lever_m: float
    """Largest distance of the tool from the flange."""
    acceleration_rad_s2: float
    quiet_std: Array
    """Standard deviation (6,) of the samples from the resting sensor."""
    predict: Callable[[Array], Array | None] = lambda _: None
    """Returns the wrench (6,) of the free tool at a flange orientation (3, 3), or None while that is unknown."""
    _start: Array | None = field(default=None, init=False)
    _sample: int = field(default=-1, init=False)
    _residual: Array | None = field(default=None, init=False)
    _turns_rad_s: list[float] = field(default_factory=list, init=False)

    def begin(self, seen: Seen) -> None:
        """Use the session's first wrench as that of the free tool, and no later one: contact may outlast a stop."""
        if self._start is None:
            self._start = seen.wrench
        self._residual = None

    def forget(self) -> None:
        """Take the next wrench as the wrench of the free tool, because the zero of a reopened sensor may differ."""
        self._start = None

    def look(self, seen: Seen) -> None:
        """Compare the wrench with the running fit, or before the first fit with the weight of the heaviest tool."""
        self._turns_rad_s = [*self._turns_rad_s[-3:], seen.turn_rad_s]
        if seen.sample == self._sample:
            return
        self._sample = seen.sample
        expected = self.predict(seen.state.R_base_flange)
        if expected is None:
            self._residual = None
            self._unknown(seen)
        else:
            self._known(seen, seen.wrench - expected)

    def _unknown(self, seen: Seen) -> None:
        weight_N = self.heaviest_kg * G_M_S2
        limit_N = 2 * weight_N + self.limits.unknown_N
        limit_Nm = 2 * weight_N * self.lever_m + self.limits.unknown_Nm
        start = seen.wrench if self._start is None else self._start
        than = f"since the start, more than a tool of {self.heaviest_kg:g} kg ([tool] mass_kg) explains"
        self._trip(seen.wrench - start, limit_N, limit_Nm, "has changed by", than)

    def _known(self, seen: Seen, residual: Array) -> None:
        if self._residual is None:
            self._residual = residual
        gain = 1 - np.exp(-2 * np.pi * self.limits.low_pass_Hz * max(seen.dt_s, 1e-3))
        self._residual = self._residual + gain * (residual - self._residual)
        turn = max(self._turns_rad_s)
        inertia_m_s2 = self.lever_m * (self.acceleration_rad_s2 + turn**2) if seen.motion.moving else 0.0
        allowance_N = self.heaviest_kg * (inertia_m_s2 + G_M_S2 * min(turn * self.limits.skew_s, 2.0))
        five = self.limits.contact_sigmas * self.quiet_std
        limit_N = max(self.limits.contact_N, float(np.linalg.norm(five[:3]))) + allowance_N
        limit_Nm = max(self.limits.contact_Nm, float(np.linalg.norm(five[3:]))) + allowance_N * self.lever_m
        self._trip(self._residual, limit_N, limit_Nm, "is", "from the weight of the free tool")

    @staticmethod
    def _trip(wrench: Array, limit_N: float, limit_Nm: float, verb: str, than: str) -> None:
        force_N, torque_Nm = float(np.linalg.norm(wrench[:3])), float(np.linalg.norm(wrench[3:]))
        if force_N > limit_N or torque_Nm > limit_Nm:
            raise fault(
                Hazard.CONTACT,
                f"unexpected contact: the wrench {verb} {force_N:.1f} N, {torque_Nm:.2f} N·m {than} (allowed: "
                f"{limit_N:.1f} N, {limit_Nm:.2f} N·m); check the tool, the cables and people nearby, then resume",
            )


def arm_lost(error: DeviceError, *, moving: bool) -> Tripped:
    """Return the trip for hazard 16, an arm that reports no state; if it moves, it may not receive a stop either."""
    if not moving:
        return Tripped(Hazard.CONTROLLER_LOST, error)
    found = (
        f"{error.found}; a stop was sent, but the arm may not have received it; in that case it completes the current "
        "move, which is proven clear, and stops"
    )
    return Tripped(Hazard.CONTROLLER_LOST, type(error)(found, error.fix))


def by_safety(status: ArmStatus, words: str) -> Tripped:
    """Return the trip for hazard 7, 10, 11 or 12, a stop by the safety system; `words` describe the stop."""
    mode = status.safety_mode
    if mode == "protective stop":
        payload = "" if status.payload_kg is None else f" (payload set: {status.payload_kg:.2f} kg)"
        words += f"; usual causes are contact and, in the controller, a wrong payload or centre of mass{payload}"
        return fault(Hazard.PROTECTIVE_STOP, words)
    stopped = any(word in mode for word in ("emergency", "safeguard", "enabling"))
    return Tripped(Hazard.EMERGENCY_STOP if stopped else Hazard.SAFETY_MODE, DeviceFault(words))


def _changed(before: Any, now: Any) -> bool:
    return before is not None and now is not None and bool(np.abs(np.subtract(before, now)).max() > 1e-3)


def _rounded(values: float | Sequence[float] | None) -> Any:
    return np.round(0.0 if values is None else values, 3).tolist()
