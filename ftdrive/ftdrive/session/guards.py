"""Guards that watch the arm under control, by rows of the hazard table; `watchdog.py` runs them in a thread.

A guard judges one `Seen` and raises `Tripped`. No guard is a safety function: safety is the task of the robot's safety
system and the user's risk assessment. docs/reference/hazards.md lists every row, its guard
and the test that injects it.
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
# On a curve, an arm that has moved so far makes progress.
_PROGRESS_RAD: Final = 1e-3


class Tripped(Exception):
    """Raised by a guard that stops the session; `error` is the cause, `hazard` the row of the hazard table."""

    def __init__(self, hazard: Hazard, error: Exception) -> None:
        super().__init__(str(error))
        self.hazard = hazard
        self.error = error


def fault(hazard: Hazard, *words: str) -> Tripped:
    """Return a trip for a `DeviceFault` with these words."""
    return Tripped(hazard, DeviceFault(*words))


@dataclass(frozen=True, slots=True)
class Limits:
    """Limits at which the guards trip; the numbers of the hazard table."""

    frozen_rad: float = float(np.radians(0.5))
    """Allowed motion of joints that should rest."""
    tracking_rad: float = float(np.radians(2.0))
    """Allowed distance of a moving joint from the straight line in joint space."""
    flange_m: float = 0.002
    flange_rad: float = float(np.radians(0.2))
    """From the arm's own kinematics: twice what the driver allows at rest, which has looked before."""
    nominal_m: float = 0.020
    nominal_rad: float = float(np.radians(3.0))
    """From nominal kinematics; real arms are up to 7.5 mm and 1.3 degrees from them."""
    lag_s: float = 0.008
    """Between joint angles and pose of one state."""
    sensor_age_moving_s: float = 0.1
    sensor_age_holding_s: float = 0.5
    frozen_samples_s: float = 0.2
    saturation: float = SATURATION
    """Share of the sensor's range."""
    contact_N: float = 8.0
    contact_Nm: float = 0.8
    contact_sigmas: float = 5.0
    unknown_N: float = 15.0
    """Added to twice the heaviest tool's weight while the tool is unknown."""
    unknown_Nm: float = 1.5
    low_pass_Hz: float = 20.0
    skew_s: float = 0.03
    """Largest time between a pose and the wrench compared with it."""
    stalled_s: float = 10.0
    look_s: float = 0.01
    """Period of the guards."""
    counted_s: float = 0.02
    """Longest time between two looks that counts: if this process gets no CPU time, nothing else is late."""
    aside_s: float = 0.05
    """Period of the look for a stop of the safety system while the guards rest."""
    blind_s: float = 1.0
    """The operator needs longer to press a stop, release it and make the arm ready again."""
    hung_s: float = 1.0
    """Guards that have not looked for this time count as hung."""
    slow_stop_s: float = 0.2
    """A stop that takes longer is reported before it ends. An arm that answers brakes from 60 deg/s in 0.2 s."""
    link_usual_s: float = 0.02
    """Usual time until the arm answers. The wait for the next sample takes 8 ms of it."""
    link_asked_s: float = 0.04
    """Added for a controller that reports its TCP only to a program, which is asked twice: usually 24 ms."""
    link_gap_s: float = 0.1
    """Time within which nine answers in ten arrive."""
    program_ends_s: float = 1.5
    """The program of a killed session ends by itself within 0.5 s."""

    @classmethod
    def of(cls, clock: Clock) -> Self:
        """Limits of a cell: the clock of an emulated one may lead its arm, whose control process may starve."""
        usual = cls()
        return cls(link_usual_s=usual.link_usual_s + clock.lead_s, stalled_s=clock.patience_s(usual.stalled_s))


@dataclass(frozen=True, eq=False)
class ExpectedMotion:
    """The expected motion: a straight move in joint space, along a curve, or standing."""

    start_rad: Array
    goal_rad: Array
    moving: bool
    curve_rad: Array | None = None
    """(n, 6) dense points of a curve from start to goal."""

    @cached_property
    def turns_rad(self) -> Array:
        """How far each joint turns (6,)."""
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
    """One look at arm and sensor."""

    t_s: float
    """Of the guards' own clock."""
    dt_s: float
    """Since the previous look; at most `Limits.counted_s`."""
    motion: ExpectedMotion
    state: ArmState
    status: ArmStatus
    wrench: Array
    """(6,) the newest sample."""
    sample: int
    """Its running number."""
    turn_rad_s: float
    """Angular speed of the flange between the previous look and this one."""


class Guard(ABC):
    """Watches one row of the hazard table, or several rows with the same signal."""

    def begin(self, seen: Seen) -> None:
        """Take this look as normal: the first of a session, or the first after the operator resumes."""
        del seen  # most compare with the plan alone

    @abstractmethod
    def look(self, seen: Seen) -> None:
        """Raise `Tripped`."""


@dataclass
class SupervisorGuard(Guard):
    """Row 27: an operator, or a program in their place, follows the session."""

    absence: Callable[[], str | None]
    """As `Operator.absence`."""

    def look(self, seen: Seen) -> None:
        """Look at the far ends of the streams."""
        del seen  # the arm does not show it
        if why := self.absence():
            raise Tripped(Hazard.SUPERVISOR_GONE, SupervisorGone(why))


@dataclass
class PathGuard(Guard):
    """Rows 2 and 21: moving joints stay on the straight line or curve to the goal, the others rest."""

    limits: Limits

    def look(self, seen: Seen) -> None:
        """Compare with the nearest point of the motion."""
        motion, q = seen.motion, seen.state.q_rad
        off = np.abs(q - motion.nearest_rad(q))
        resting = (motion.turns_rad < 1e-3) & ((np.arange(6) < 3) | (not motion.moving))
        allowed = np.where(resting, self.limits.frozen_rad, self.limits.tracking_rad)
        if not (off > allowed).any():
            return
        joint = int(np.argmax(off / allowed))
        words = f"joint {joint + 1} is {np.degrees(off[joint]):.1f}° from where it should be"
        if motion.moving:
            raise fault(
                Hazard.SELF_COLLISION,
                f"{words} on the way (allowed: {np.degrees(allowed[joint]):.1f}°): find what holds the arm",
            )
        raise fault(
            Hazard.OTHER_CLIENT,
            f"{words} while the arm should stand, so something else moves it: stop that, then resume",
        )


@dataclass
class StallGuard(Guard):
    """Row 22: a slow arm is allowed, an arm that stands still during a move is not."""

    limits: Limits
    _nearest_rad: float = field(default=np.inf, init=False)
    _still_s: float = field(default=0.0, init=False)
    _on_curve: Array | None = field(default=None, init=False)
    _goal_rad: Array | None = field(default=None, init=False)

    def look(self, seen: Seen) -> None:
        """Count the time without progress: towards the goal, or on a curve in any direction."""
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
                    "the slider at the pendant, or find what holds the arm"
                ),
            )


@dataclass
class SliderGuard(Guard):
    """Row 22 in a sweep, on which the speed slider does not act: the operator who moves it wants another speed."""

    _before: float | None = field(default=None, init=False)

    def begin(self, seen: Seen) -> None:
        """Remember the slider."""
        self._before = seen.status.speed_slider

    def look(self, seen: Seen) -> None:
        """Compare while the arm sweeps."""
        if self._before is None or seen.motion.curve_rad is None:
            return
        if abs(seen.status.speed_slider - self._before) > _SLIDER:
            raise fault(
                Hazard.STALL,
                f"the speed slider was moved from {100 * self._before:.0f} to {100 * seen.status.speed_slider:.0f} %, "
                "which a sweep does not follow: start again, it takes the new speed",
            )


@dataclass
class ModelGuard(Guard):
    """Rows 8 and 9: the reported flange pose matches the kinematics of the arm model."""

    limits: Limits
    certifier: Certifier

    def look(self, seen: Seen) -> None:
        """Compare the newest state."""
        self.judge(seen.state)

    def judge(self, state: ArmState) -> None:
        """Compare the flange with the forward kinematics of the model the plan was certified for."""
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
                f"the flange is {1e3 * away_m:.1f} mm and {np.degrees(away_rad):.2f}° from where a "
                f"{arm.name} should have it: check the model and the active TCP",
            )


@dataclass
class SettingsGuard(Guard):
    """Rows 7 and 8: payload and TCP stay as they were at the start."""

    _before: ArmStatus | None = field(default=None, init=False)

    def begin(self, seen: Seen) -> None:
        """Remember both."""
        self._before = seen.status

    def look(self, seen: Seen) -> None:
        """Compare."""
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
    """Rows 7, 10, 11, 12 and 21: the safety system and the program on the controller."""

    _mode: str | None = field(default=None, init=False)

    def begin(self, seen: Seen) -> None:
        """Remember the safety mode: normal, or reduced if the operator accepted it."""
        self._mode = seen.status.safety_mode

    def look(self, seen: Seen) -> None:
        """Trip on every stop and every change."""
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
                "another client stopped it; read the pendant's log, then resume",
            )
        if status.program != "playing":
            raise fault(
                Hazard.OTHER_CLIENT,
                f"the control program is {status.program}: the pendant or another client paused it; leave the arm to "
                "this program, then resume",
            )


@dataclass
class SensorGuard(Guard):
    """Row 15: samples keep arriving, and differ."""

    limits: Limits
    _sample: int = field(default=-1, init=False)
    _silent_s: float = field(default=0.0, init=False)
    _wrench: Array | None = field(default=None, init=False)
    _same_s: float = field(default=0.0, init=False)
    _same: int = field(default=0, init=False)

    def begin(self, seen: Seen) -> None:
        """Forget what was seen before."""
        self._sample, self._silent_s = seen.sample - 1, 0.0
        self._wrench, self._same_s, self._same = None, 0.0, 0

    def look(self, seen: Seen) -> None:
        """Time how long no sample arrives, or all are the same."""
        if not np.isfinite(seen.wrench).all():
            raise fault(Hazard.SENSOR_LOST, f"the sensor sent {seen.wrench.tolist()}: check its cable and supply")
        if seen.sample == self._sample:
            self._silent_s += seen.dt_s
        else:
            self._sample, self._silent_s = seen.sample, 0.0
        allowed = self.limits.sensor_age_moving_s if seen.motion.moving else self.limits.sensor_age_holding_s
        if self._silent_s > allowed:
            raise Tripped(
                Hazard.SENSOR_LOST,
                DeviceTimeout(f"the sensor has sent no sample for {self._silent_s:.2f} s: check its cable and supply"),
            )
        if self._wrench is not None and np.array_equal(seen.wrench, self._wrench):
            self._same_s, self._same = self._same_s + seen.dt_s, self._same + 1
        else:
            self._same_s, self._same = 0.0, 0
        self._wrench = seen.wrench
        if self._silent_s == 0 and self._same > 10 and self._same_s > self.limits.frozen_samples_s:
            raise fault(
                Hazard.SENSOR_LOST, f"the sensor repeats one reading for {self._same_s:.2f} s: restart it, then resume"
            )


@dataclass
class RangeGuard(Guard):
    """Row 13: no axis comes near the end of its range. If the range is unknown, only the device's status shows it."""

    limits: Limits
    range: Array | None
    """(6,) N and N·m."""
    zero: Array = field(default_factory=lambda: np.zeros(6))
    """(6,) N and N·m: the reading from which the range counts, where the sensor's own zero is arbitrary."""

    def look(self, seen: Seen) -> None:
        """Compare the newest sample."""
        self.judge(seen.wrench)

    def judge(self, wrench: Array) -> None:
        """Compare any number of samples (..., 6)."""
        if self.range is None:
            return
        share = (np.abs(wrench - self.zero) / self.range).reshape(-1, 6).max(axis=0)
        if share.max() > self.limits.saturation:
            axis = int(share.argmax())
            verb = "has changed by" if self.zero.any() else "reads"
            raise fault(
                Hazard.OVERLOAD,
                f"the sensor {verb} {100 * share[axis]:.0f} % of its range in {AXES[axis]}: "
                "take the load off, or use a lighter or shorter tool",
            )


@dataclass
class ContactGuard(Guard):
    """Rows 14 and 1: the sensor carries only the tool's weight."""

    limits: Limits
    heaviest_kg: float
    """Mass of the heaviest possible tool."""
    lever_m: float
    """Largest reach of a tool."""
    acceleration_rad_s2: float
    quiet_std: Array
    """(6,) of the samples of a resting sensor."""
    predict: Callable[[Array], Array | None] = lambda _: None
    """Return the wrench of a free tool at an orientation; None while it is unknown."""
    _start: Array | None = field(default=None, init=False)
    _sample: int = field(default=-1, init=False)
    _residual: Array | None = field(default=None, init=False)
    _turns_rad_s: list[float] = field(default_factory=list, init=False)

    def begin(self, seen: Seen) -> None:
        """Take the first wrench as that of the free tool; after a stop the contact may still be there."""
        if self._start is None:
            self._start = seen.wrench
        self._residual = None

    def forget(self) -> None:
        """Take the next wrench as that of the free tool: a reopened sensor may have another zero."""
        self._start = None

    def look(self, seen: Seen) -> None:
        """Compare with the running fit; before there is one, with the weight of the heaviest tool."""
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
        than = f"since the start, where a tool of {self.heaviest_kg:g} kg is assumed ([tool] mass_kg)"
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
    """Row 16: the arm reports no state. An arm in a move may not receive the stop either."""
    if not moving:
        return Tripped(Hazard.CONTROLLER_LOST, error)
    found = (
        f"{error.found}; a stop was sent, but the arm may not have heard it: then it ends the one move it was given, "
        "which is proven clear, and goes no further"
    )
    return Tripped(Hazard.CONTROLLER_LOST, type(error)(found, error.fix))


def by_safety(status: ArmStatus, words: str) -> Tripped:
    """Rows 7, 10, 11 and 12: the safety system has stopped the arm, as `words` report."""
    mode = status.safety_mode
    if mode == "protective stop":
        payload = "" if status.payload_kg is None else f" (payload set: {status.payload_kg:.2f} kg)"
        words += f"; usual causes are contact, and a controller with a wrong payload or centre of mass{payload}"
        return fault(Hazard.PROTECTIVE_STOP, words)
    stopped = any(word in mode for word in ("emergency", "safeguard", "enabling"))
    return Tripped(Hazard.EMERGENCY_STOP if stopped else Hazard.SAFETY_MODE, DeviceFault(words))


def _changed(before: Any, now: Any) -> bool:
    return before is not None and now is not None and bool(np.abs(np.subtract(before, now)).max() > 1e-3)


def _rounded(values: float | Sequence[float] | None) -> Any:
    return np.round(0.0 if values is None else values, 3).tolist()
