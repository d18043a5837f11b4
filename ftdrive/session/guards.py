"""What is watched while the arm is under control, row by row of the hazard table; `watchdog.py` has the thread.

A guard looks at one `Seen` and raises `Tripped`. None of them is a safety function: that is the safety system of the
robot and the user's risk assessment. README.md lists every row, where it is watched and which test injects it.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any, Final, Self

import numpy as np
from numpy.typing import NDArray

from drivers.errors import DeviceFault, DeviceTimeout, DriverError
from drivers.interfaces import ArmState, ArmStatus
from ftdrive.planning.geometry.certify import Certifier

Array = NDArray[np.float64]

G_M_S2: Final = 9.81
AXES: Final = ("Fx", "Fy", "Fz", "Tx", "Ty", "Tz")


class Tripped(Exception):
    """A guard does not let the session go on; `error` says why, `hazard` is the row of the hazard table."""

    def __init__(self, hazard: int, error: Exception) -> None:
        super().__init__(str(error))
        self.hazard = hazard
        self.error = error


@dataclass(frozen=True, slots=True)
class Limits:
    """Where the guards trip; the numbers of the hazard table."""

    frozen_rad: float = float(np.radians(0.5))
    """For joints that should not move at all."""
    tracking_rad: float = float(np.radians(2.0))
    """From the straight line in joint space."""
    flange_m: float = 0.005
    flange_rad: float = float(np.radians(0.5))
    sensor_age_moving_s: float = 0.1
    sensor_age_holding_s: float = 0.5
    frozen_samples_s: float = 0.2
    saturation: float = 0.9
    """Share of the sensor's range."""
    contact_N: float = 8.0
    contact_Nm: float = 0.8
    contact_sigmas: float = 5.0
    unknown_N: float = 15.0
    """Beside twice the heaviest tool's weight, as long as the tool is not known."""
    unknown_Nm: float = 1.5
    low_pass_Hz: float = 20.0
    skew_s: float = 0.03
    """How far the times of pose and wrench may be apart."""
    stalled_s: float = 10.0
    look_s: float = 0.01
    """Period of the guards."""
    counted_s: float = 0.02
    """Of the time between two looks, so much counts: when this process gets no time, nothing else is late."""
    aside_s: float = 0.05
    """Between two looks for a stop of the safety system, while nothing else is watched."""
    blind_s: float = 1.0
    """Nobody presses a stop, releases it and has the arm ready again in less."""
    hung_s: float = 1.0
    """Guards that have not looked for so long do not watch."""
    slow_stop_s: float = 0.2
    """A stop that takes longer is reported meanwhile. An arm that answers brakes from 60 deg/s in 0.26 s."""
    link_usual_s: float = 0.02
    """Until the arm answers, as a rule. 8 ms of it are the wait for the next sample."""
    link_asked_s: float = 0.04
    """On top of it where a controller reports its TCP only to a program, which is asked twice: 24 ms if all is well."""
    link_gap_s: float = 0.1
    """Until the arm answers, nine times in ten."""
    program_ends_s: float = 1.5
    """What a session that was killed has left on the controller ends by itself within 0.5 s."""

    @classmethod
    def emulated(cls) -> Self:
        """Limits of an emulated cell, whose clock leads each follower by 10 ms and waits for no control process."""
        return cls(link_usual_s=0.05, stalled_s=60.0)


@dataclass(frozen=True, slots=True, eq=False)
class Motion:
    """What the arm should be doing: a straight move in joint space, or to stand."""

    start_rad: Array
    goal_rad: Array
    moving: bool


@dataclass(frozen=True, slots=True, eq=False)
class Seen:
    """One look at everything."""

    t_s: float
    """Of the guards' own clock."""
    dt_s: float
    """Since the look before, counted as the guards count silence."""
    motion: Motion
    state: ArmState
    status: ArmStatus
    wrench: Array
    """(6,) the newest sample."""
    sample: int
    """Its running number."""
    turn_rad_s: float
    """How fast the flange turned between this look and the one before."""


class Guard(ABC):
    """One row, or a few that are seen the same way."""

    def begin(self, seen: Seen) -> None:
        """Take the first look of a session, or after a person let it go on, as what is normal."""
        del seen  # most compare with the plan alone

    @abstractmethod
    def look(self, seen: Seen) -> None:
        """Raise `Tripped`."""


@dataclass
class PathGuard(Guard):
    """Rows 2 and 21: the joints stay on the straight line to the goal, and those that should rest do."""

    limits: Limits

    def look(self, seen: Seen) -> None:
        """Compare with the nearest point of the line."""
        motion, q = seen.motion, seen.state.q_rad
        turn = motion.goal_rad - motion.start_rad
        length2 = float(turn @ turn)
        share = 0.0 if length2 == 0 else float(np.clip((q - motion.start_rad) @ turn / length2, 0, 1))
        off = np.abs(q - motion.start_rad - share * turn)
        resting = (np.abs(turn) < 1e-3) & ((np.arange(6) < 3) | (not motion.moving))
        allowed = np.where(resting, self.limits.frozen_rad, self.limits.tracking_rad)
        if not (off > allowed).any():
            return
        joint = int(np.argmax(off / allowed))
        words = f"joint {joint + 1} is {np.degrees(off[joint]):.1f}° from where it should be"
        if motion.moving:
            raise Tripped(
                2,
                DeviceFault(
                    f"{words} on the way (allowed: {np.degrees(allowed[joint]):.1f}°): look what holds the arm"
                ),
            )
        raise Tripped(
            21,
            DeviceFault(f"{words} while the arm should stand: something else moves it; end that, then go on"),
        )


@dataclass
class StallGuard(Guard):
    """Row 22: a slow arm is waited for, one that stands still on its way is not."""

    limits: Limits
    _nearest_rad: float = field(default=np.inf, init=False)
    _still_s: float = field(default=0.0, init=False)
    _goal_rad: Array | None = field(default=None, init=False)

    def look(self, seen: Seen) -> None:
        """Count the time without progress."""
        goal = seen.motion.goal_rad
        left = float(np.abs(goal - seen.state.q_rad).max())
        if goal is not self._goal_rad or not seen.motion.moving or left < self._nearest_rad - 1e-4:
            self._goal_rad, self._nearest_rad, self._still_s = goal, left, 0.0
            return
        self._still_s += seen.dt_s
        if self._still_s > self.limits.stalled_s and left > 1e-3:
            raise Tripped(
                22,
                DeviceTimeout(
                    f"the arm has not come nearer to its goal for {self._still_s:.0f} s (speed slider "
                    f"{100 * seen.status.speed_slider:.0f} %, scaling {100 * seen.status.speed_scaling:.0f} %): set "
                    "the slider at the pendant, or look what holds the arm"
                ),
            )


@dataclass
class ModelGuard(Guard):
    """Rows 8 and 9: the flange is where this model has it with these joint angles."""

    limits: Limits
    certifier: Certifier

    def look(self, seen: Seen) -> None:
        """Compare the newest state."""
        self.judge(seen.state)

    def judge(self, state: ArmState) -> None:
        """Compare the flange with the forward kinematics of the model the plan was certified for."""
        at = self.certifier.arm.frames(state.q_rad)
        away_m = float(np.linalg.norm(at.flange_m[0] - state.p_base_flange_m))
        cosine = (np.trace(at.R_base_flange[0].T @ state.R_base_flange) - 1) / 2
        away_rad = float(np.arccos(np.clip(cosine, -1, 1)))
        if away_m > self.limits.flange_m or away_rad > self.limits.flange_rad:
            raise Tripped(
                8,
                DeviceFault(
                    f"the flange is {1e3 * away_m:.1f} mm and {np.degrees(away_rad):.2f}° from where a "
                    f"{self.certifier.arm.name} has it: check the model and the active TCP"
                ),
            )


@dataclass
class SettingsGuard(Guard):
    """Rows 7 and 8: nobody changes payload or TCP meanwhile."""

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
            raise Tripped(
                8,
                DeviceFault(f"the active TCP was set to {_rounded(now.tcp_offset)}: find out what did, then go on"),
            )
        for what, was, told in (
            ("payload in kg", before.payload_kg, now.payload_kg),
            ("centre of the payload in m", before.p_flange_payload_m, now.p_flange_payload_m),
        ):
            if _changed(was, told):
                raise Tripped(
                    7,
                    DeviceFault(
                        f"the controller's {what} was changed from {_rounded(was)} to {_rounded(told)}: find out what "
                        "set it, then go on"
                    ),
                )


@dataclass
class SafetyGuard(Guard):
    """Rows 7, 10, 11, 12 and 21: the safety system and the program on the controller."""

    _mode: str | None = field(default=None, init=False)

    def begin(self, seen: Seen) -> None:
        """Remember the safety mode: normal, or reduced as a person accepted it."""
        self._mode = seen.status.safety_mode

    def look(self, seen: Seen) -> None:
        """Trip on every stop and every change."""
        status = seen.status
        if status.fault is not None:
            raise by_safety(status, f"the arm stopped: {status.fault}")
        if self._mode is not None and status.safety_mode != self._mode:
            raise Tripped(
                12,
                DeviceFault(f"the safety mode changed from {self._mode} to {status.safety_mode}: see the pendant"),
            )
        if status.program != "playing":
            raise Tripped(
                21,
                DeviceFault(
                    f"the control program is {status.program}: somebody else has ended or paused it; leave the arm to "
                    "this program, then go on"
                ),
            )


@dataclass
class SensorGuard(Guard):
    """Row 15: samples keep coming, and differ."""

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
        """Count silence and sameness."""
        if not np.isfinite(seen.wrench).all():
            raise Tripped(15, DeviceFault(f"the sensor says {seen.wrench.tolist()}: check its cable and supply"))
        if seen.sample == self._sample:
            self._silent_s += seen.dt_s
        else:
            self._sample, self._silent_s = seen.sample, 0.0
        allowed = self.limits.sensor_age_moving_s if seen.motion.moving else self.limits.sensor_age_holding_s
        if self._silent_s > allowed:
            raise Tripped(
                15,
                DeviceTimeout(f"the sensor has been silent for {self._silent_s:.2f} s: check its cable and supply"),
            )
        if self._wrench is not None and np.array_equal(seen.wrench, self._wrench):
            self._same_s, self._same = self._same_s + seen.dt_s, self._same + 1
        else:
            self._same_s, self._same = 0.0, 0
        self._wrench = seen.wrench
        if self._silent_s == 0 and self._same > 10 and self._same_s > self.limits.frozen_samples_s:
            raise Tripped(
                15,
                DeviceFault(f"the sensor repeats one reading for {self._same_s:.2f} s: restart it, then go on"),
            )


@dataclass
class RangeGuard(Guard):
    """Row 13: no axis near the end of its range. Without a known range the device's own status has to tell."""

    limits: Limits
    range: Array | None
    """(6,) N and N·m."""

    def look(self, seen: Seen) -> None:
        """Compare the newest sample."""
        self.judge(seen.wrench)

    def judge(self, wrench: Array) -> None:
        """Compare any number of samples (..., 6)."""
        if self.range is None:
            return
        share = (np.abs(wrench) / self.range).reshape(-1, 6).max(axis=0)
        if share.max() > self.limits.saturation:
            axis = int(share.argmax())
            raise Tripped(
                13,
                DeviceFault(
                    f"the sensor reads {100 * share[axis]:.0f} % of its range in {AXES[axis]}: "
                    "take the load off; a lighter or shorter tool may be needed"
                ),
            )


@dataclass
class ContactGuard(Guard):
    """Rows 14 and 1: nothing but the tool's weight on the sensor."""

    limits: Limits
    heaviest_kg: float
    """A tool cannot weigh more."""
    lever_m: float
    """Nor reach farther."""
    acceleration_rad_s2: float
    quiet_std: Array
    """(6,) of the samples of a resting sensor."""
    predict: Callable[[Array], Array | None] = lambda _: None
    """Wrench of a free tool at an orientation, once it is known."""
    _start: Array | None = field(default=None, init=False)
    _sample: int = field(default=-1, init=False)
    _residual: Array | None = field(default=None, init=False)
    _turns_rad_s: list[float] = field(default_factory=list, init=False)

    def begin(self, seen: Seen) -> None:
        """Take what is felt first as the free tool, and nothing later: it may push still when a person resumes."""
        if self._start is None:
            self._start = seen.wrench
        self._residual = None

    def forget(self) -> None:
        """Take what is felt next as the free tool: the sensor was opened again, and its zero may be another."""
        self._start = None

    def look(self, seen: Seen) -> None:
        """Compare with the running fit; before there is one, with what any tool could weigh."""
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
        self._trip(self._residual, limit_N, limit_Nm, "is", "from what the free tool weighs")

    @staticmethod
    def _trip(wrench: Array, limit_N: float, limit_Nm: float, verb: str, than: str) -> None:
        force_N, torque_Nm = float(np.linalg.norm(wrench[:3])), float(np.linalg.norm(wrench[3:]))
        if force_N > limit_N or torque_Nm > limit_Nm:
            raise Tripped(
                14,
                DeviceFault(
                    f"unexpected contact: the wrench {verb} {force_N:.1f} N, {torque_Nm:.2f} N·m {than} (allowed: "
                    f"{limit_N:.1f} N, {limit_Nm:.2f} N·m); look at tool, cables and whoever is near, then go on"
                ),
            )


def out_of_sight(error: DriverError, *, moving: bool) -> Tripped:
    """Row 16: nobody sees the arm any more. On its way it may not hear the stop either."""
    if not moving:
        return Tripped(16, error)
    found = (
        f"{error.found}; the arm was told to stop, but may not have heard it: then it ends the one move it was given, "
        "which is proven clear, and goes no further"
    )
    return Tripped(16, type(error)(found, error.fix))


def by_safety(status: ArmStatus, words: str) -> Tripped:
    """Rows 7, 10, 11 and 12: the safety system has stopped the arm, and `words` say so."""
    mode = status.safety_mode
    if mode == "protective stop":
        told = "" if status.payload_kg is None else f" (it was told {status.payload_kg:.2f} kg)"
        words += f"; usual causes are contact, and a controller with a wrong payload or centre of mass{told}"
        return Tripped(10, DeviceFault(words))
    return Tripped(11 if "emergency" in mode or "safeguard" in mode else 12, DeviceFault(words))


def _changed(before: Any, now: Any) -> bool:
    return before is not None and now is not None and bool(np.abs(np.subtract(before, now)).max() > 1e-3)


def _rounded(values: float | Sequence[float] | None) -> Any:
    return np.round(0.0 if values is None else values, 3).tolist()
