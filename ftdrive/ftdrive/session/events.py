"""Rows of the hazard table, and the events of a session, which the terminal shows and the journal records."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, fields
from datetime import UTC, datetime
from enum import Enum, IntEnum, StrEnum
from typing import Any, Literal, Protocol

import numpy as np

from ftcalib.model import Array
from ftdrive.planning.plan import Plan
from ftdrivers.interfaces import ForceTorqueSensor


class Hazard(IntEnum):
    """Row of the hazard table: what can go wrong while the arm moves."""

    CABLE_PULL = 1
    SELF_COLLISION = 2
    WORKCELL_COLLISION = 3
    UNDESCRIBED_OBSTACLE = 4
    APPROACH = 5
    SINGULARITY = 6
    WRONG_PAYLOAD = 7
    WRONG_TCP = 8
    WRONG_MODEL = 9
    PROTECTIVE_STOP = 10
    EMERGENCY_STOP = 11
    """Emergency stop or safeguard stop."""
    SAFETY_MODE = 12
    OVERLOAD = 13
    CONTACT = 14
    SENSOR_LOST = 15
    CONTROLLER_LOST = 16
    INTERRUPT = 17
    UNGUARDED = 18
    """The program, its guards or the computer failed."""
    FREEDRIVE = 19
    PEOPLE = 20
    OTHER_CLIENT = 21
    STALL = 22
    """The speed slider is at 0, or something holds the arm."""
    LOOSE_TOOL = 23
    LOOSE_BASE = 24
    WRONG_PLAN = 25
    DISK_FULL = 26
    SUPERVISOR_GONE = 27
    """Neither an operator nor a supervising program can see the session any more."""


SCHEMA_VERSION = 1


class State(StrEnum):
    """State of a session. Every trip leads to STOP and then to HOLD, where the operator decides."""

    IDLE = "idle"
    PREFLIGHT = "preflight"
    APPROACH = "approach"
    MOVE = "move"
    SETTLE = "settle"
    SAMPLE = "sample"
    SWEEP = "sweep"
    CLOSE = "close"
    REPORT = "report"
    STOP = "stop"
    HOLD = "hold"


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Event:
    """Base class of the events that a session shows and records."""

    t_utc: str = field(default_factory=lambda: datetime.now(UTC).isoformat())

    def to_dict(self) -> dict[str, Any]:
        """Return the object that `--json` writes as one line; arrays become lists, NaN and infinity null."""
        name = "".join(f"-{c.lower()}" if c.isupper() else c for c in type(self).__name__).lstrip("-")
        return {"schema_version": SCHEMA_VERSION, "event": name} | {
            each.name: _to_json(getattr(self, each.name)) for each in fields(self)
        }


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class RunOpened(Event):
    """The run folder is open and receives every pose from now on."""

    folder: str
    resume: str
    """Command that resumes the run after an interruption; empty for a recording in motion, which cannot be resumed."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class StateChanged(Event):
    """The session has entered a state."""

    state: State
    stop: int | None = None
    """Number of the stop in the tour, from 1; the last stop is the return to the first pose."""
    stops: int | None = None
    """Number of stops in the tour, including the return to the first pose."""
    number: int | None = None
    """Number of the pose's orientation in the plan; None if no pose is meant."""
    words: str = ""
    """Cause of a STOP or HOLD; otherwise what is happening or what to do."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Checked(Event):
    """Result of a preflight check."""

    name: str
    passed: bool
    words: str
    """The finding, and for a failed check the remedy."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Planned(Event):
    """Plan and approach, which are all the motion to come; shown before the first question."""

    plan: Plan
    """The plan; `to_dict` gives the contents of its file."""
    way_rad: Array
    """Joint vectors (k + 1, 6) of the approach to the first pose; (0, 6) if the arm is already there."""
    way_words: str
    stop_words: str = ""
    """Stopping distance of the arm, in words; empty for an arm whose driver comes from another package."""

    def to_dict(self) -> dict[str, Any]:
        """Return the object that `--json` writes, with the plan as in its file."""
        return Event.to_dict(self) | {"plan": self.plan.to_dict()}


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Noted(Event):
    """A note for the operator that has no other event type."""

    words: str
    warning: bool = False


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PoseTaken(Event):
    """A pose has been measured and is on disk."""

    stop: int
    stops: int
    number: int
    gravity_flange: Array
    """(3,) unit vector down, flange axes, from the configured mounting."""
    mean: Array
    """(6,) mean of the samples as measured, N and N·m."""
    sigma: Array
    """(6,) standard deviation of that mean, N and N·m."""
    samples: int
    settle_s: float
    average_s: float
    attempts: int
    steady: bool
    temperature_C: float | None = None
    """Temperature that the sensor reports; None if it does not."""


def rms_sigma(sigma: Array) -> tuple[float, float]:
    """Return the RMS of six standard deviations: over the force axes, N, and over the torque axes, N·m."""
    force_N, torque_Nm = (float(np.sqrt(np.mean(part**2))) for part in (sigma[:3], sigma[3:]))
    return force_N, torque_Nm


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class MotionRecorded(Event):
    """A recording in motion is on disk."""

    file: str
    duration_s: float
    samples: int
    """Number of wrench samples from the sensor."""
    states: int
    """Number of arm states (joint angles and flange pose) that the controller reported."""
    temperature_C: float | None = None
    """Temperature that the sensor reports; None if it does not."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Estimated(Event):
    """The running fit of the poses so far, and their coverage; the coverage alone before a fit is possible."""

    poses: int
    values: Mapping[str, Any]
    """Estimates by the names of `Parameters` and its derived quantities, SI units; empty without a fit."""
    sigma: Mapping[str, Any]
    """Standard deviation of each estimate, by the same names."""
    residual_sigma: float | None
    """Largest residual of the newest pose over the six channels, each divided by its standard deviation."""
    residual_force_N: float | None
    """Norm of the residual force of the newest pose, N."""
    faces: tuple[int, int, int, int, int, int]
    """Number of poses whose gravity direction is nearest to each flange axis: +x -x +y -y +z -z."""
    cond9: float
    cond_u1: float
    """Condition numbers of the poses; see `ftcalib.poses.information.Prediction`."""
    empty_cap_deg: float
    """Largest gap in the coverage: angle from the direction farthest from all gravity directions to the nearest one."""
    light: str
    """Whether the poses suffice: "green", "amber" or "red"."""
    hint: str
    """Most useful next pose, in words; empty if the light is green or the arm is not moved by hand."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Compared(Event):
    """Comparison of a verification pose with the prediction of the calibration."""

    stop: int
    number: int
    residual: Array
    """(6,) measured minus predicted wrench, N and N·m."""
    sigma: Array
    """(6,) standard deviation of the residual, from noise and calibration, N and N·m."""
    poses: int
    """Number of poses so far."""
    light: str
    """Whether the poses suffice: "green" or "amber"."""
    hint: str = ""
    """What to do if the pose is too close to a calibration pose; otherwise empty."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Weighed(Event):
    """Mass from the running fit, once the fit is reliable, and the payload set in the controller to compare it with."""

    mass_kg: float
    """Mass that the sensor carries, without the sensor and its adapter."""
    payload_kg: float
    """Payload set in the controller, including the sensor and its adapter."""
    p_flange_payload_m: tuple[float, ...] | None
    """(3,) centre of mass of the payload, flange axes; None if the controller does not report it."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class GuardTripped(Event):
    """A guard has stopped the arm."""

    hazard: int
    """Row of the hazard table."""
    words: str
    """The finding, with the value, and the remedy."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Asked(Event):
    """A question and its answer."""

    question: str
    answer: str
    by: Literal["person", "--yes"]
    """Who answered: "person" for the operator, or "--yes" for the option, which gives the assumed answer."""


class SensorEvents:
    """Shows each event of a sensor once, such as an interruption or a reconnection."""

    def __init__(self, sensor: ForceTorqueSensor, show: Callable[[Event], None]) -> None:
        self._sensor, self._show = sensor, show
        self._shown = 0

    def show_new(self) -> None:
        """Show the events since the last call."""
        events = self._sensor.health().events
        for t_host_ns, words in events[self._shown :]:
            self._show(Noted(words=f"sensor: {words} (host clock {t_host_ns / 1e9:.3f} s)", warning=True))
        self._shown = len(events)


def _to_json(value: Any) -> Any:
    if isinstance(value, np.ndarray):
        return _to_json(value.tolist())
    if isinstance(value, Mapping):
        return {key: _to_json(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_to_json(item) for item in value]
    if isinstance(value, np.generic):
        return _to_json(value.item())
    if isinstance(value, float) and not np.isfinite(value):
        return None
    return value


class Key(Enum):
    """Requests that the operator may make at any time; the values are the keys of the session screen."""

    KEEP = "k"
    REDO = "r"
    SKIP = "s"
    PAUSE = "p"
    STOP = "q"
    OTHER = ""
    """Any other key, such as Space, Enter, an arrow, Ctrl-D or Ctrl-Z, which stops a moving arm."""


@dataclass(frozen=True, slots=True)
class Question:
    """A question whose answer the session waits for."""

    text: str
    """The question, with the meaning of each answer."""
    answers: tuple[str, ...] = ("yes", "no")
    """Accepted answers; if there is only one, it must be typed in full."""
    assumed: str | None = None
    """Answer that `--yes` gives; None if the operator must answer."""


class Operator(Protocol):
    """Interface between a session and its operator."""

    def show(self, event: Event) -> None:
        """Show an event; return at once. Raises `SupervisorGone` if the operator cannot see the event."""

    def ask(self, question: Question) -> str:
        """Return one of the answers to a question; raises `Declined` or `SupervisorGone` if no operator can answer."""

    def absence(self) -> str | None:
        """Return why no operator is following, such as a closed terminal; None if one is. Callable from any thread."""

    @property
    def has_keys(self) -> bool:
        """Whether keys are read; hints about keys are shown only then."""

    def pressed(self) -> Key | None:
        """Return the oldest key not yet returned, or None, without waiting."""

    @property
    def pressed_by(self) -> str:
        """Who pressed the last key that `pressed` returned: "the operator", or a viewer of the page."""
