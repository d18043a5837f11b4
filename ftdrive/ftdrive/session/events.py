"""Events of a session: what the terminal shows and the journal keeps; and the rows of the hazard table."""

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
    """What can go wrong while the arm moves."""

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
    """A safeguard stop too."""
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
    """The operator, or the program in their place, does not follow the session any more."""


SCHEMA_VERSION = 1


class State(StrEnum):
    """State of a session. A trip leads from any state to STOP, then HOLD, where the operator decides."""

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
    """Base of all events."""

    t_utc: str = field(default_factory=lambda: datetime.now(UTC).isoformat())

    def to_dict(self) -> dict[str, Any]:
        """Return what `--json` writes, one object a line; arrays become lists, NaN and infinity null."""
        name = "".join(f"-{c.lower()}" if c.isupper() else c for c in type(self).__name__).lstrip("-")
        return {"schema_version": SCHEMA_VERSION, "event": name} | {
            each.name: _to_json(getattr(self, each.name)) for each in fields(self)
        }


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class RunOpened(Event):
    """A run folder is open; it keeps every pose from now on."""

    folder: str
    resume: str
    """The command that continues it; empty for a sweep, which starts again."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class StateChanged(Event):
    """The session has entered a state."""

    state: State
    stop: int | None = None
    """Place in the tour, from 1; the return to the first pose comes last."""
    stops: int | None = None
    number: int | None = None
    """Number of the orientation."""
    words: str = ""
    """The cause, for STOP and HOLD; else what happens or what to do."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Checked(Event):
    """Result of a preflight check."""

    name: str
    passed: bool
    words: str
    """What was found; for a failed check, what to do."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Planned(Event):
    """Every motion to come; shown before any question."""

    plan: Plan
    """Its file's contents in `to_dict`."""
    way_rad: Array
    """(k + 1, 6) joint vectors from where the arm stands to the first pose; (0, 6) if it stands there."""
    way_words: str
    stop_words: str = ""
    """How far the arm goes on in a stop; empty for an arm of another package."""

    def to_dict(self) -> dict[str, Any]:
        """Return what `--json` writes, with the plan as in its file."""
        return Event.to_dict(self) | {"plan": self.plan.to_dict()}


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Noted(Event):
    """A note for the operator without a type of its own."""

    words: str
    warning: bool = False


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PoseTaken(Event):
    """A pose is on disk."""

    stop: int
    stops: int
    number: int
    gravity_flange: Array
    """(3,) unit vector down, in the flange frame, as the base is mounted."""
    mean: Array
    """(6,) N and N·m, as measured."""
    sigma: Array
    """(6,) of the mean, N and N·m."""
    samples: int
    settle_s: float
    average_s: float
    attempts: int
    steady: bool
    temperature_C: float | None = None
    """Temperature of the sensor, where it reports it."""


def rms_sigma(sigma: Array) -> tuple[float, float]:
    """Return one standard deviation of one axis, force in N and torque in N·m, from those of all six axes."""
    force_N, torque_Nm = (float(np.sqrt(np.mean(part**2))) for part in (sigma[:3], sigma[3:]))
    return force_N, torque_Nm


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class MotionRecorded(Event):
    """A recording in motion is on disk."""

    file: str
    duration_s: float
    samples: int
    """Samples of the sensor."""
    states: int
    """States of the arm."""
    temperature_C: float | None = None
    """Temperature of the sensor, where it reports it."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Estimated(Event):
    """The running fit over the poses so far; only the coverage before a fit is possible."""

    poses: int
    values: Mapping[str, Any]
    """By the names of `Parameters` and its derived quantities, SI units; empty before four distinct poses."""
    sigma: Mapping[str, Any]
    """One standard deviation each, same names."""
    residual_sigma: float | None
    """Largest of the six residuals of the newest pose, each over its standard deviation."""
    residual_force_N: float | None
    """Norm of the residual force of the newest pose."""
    faces: tuple[int, int, int, int, int, int]
    """Poses by the flange axis that gravity is nearest to: +x -x +y -y +z -z."""
    cond9: float
    cond_u1: float
    empty_cap_deg: float
    """Largest angle from any direction of gravity to the nearest one seen."""
    light: str
    """green, amber or red: whether the poses suffice."""
    hint: str
    """The most useful next pose, in words; empty if the light is green or the arm is not moved by hand."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Compared(Event):
    """A pose of a verification, beside the prediction of the calibration."""

    stop: int
    number: int
    residual: Array
    """(6,) measured minus predicted, N and N·m."""
    sigma: Array
    """(6,) one standard deviation of that, of noise and calibration together."""
    poses: int
    """Number of poses so far."""
    light: str
    """green if the poses suffice, else amber."""
    hint: str = ""
    """What to do, if the pose does not count."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Weighed(Event):
    """The running fit is reliable: the identified mass, beside the payload set on the controller."""

    mass_kg: float
    """Mass that the sensor carries, so without sensor and adapter."""
    payload_kg: float
    p_flange_payload_m: tuple[float, ...] | None
    """(3,) centre of mass of that payload, flange axes; None for a controller that does not report it."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class GuardTripped(Event):
    """A guard has stopped the arm."""

    hazard: int
    """Row of the hazard table."""
    words: str
    """What was found, with the value, and what to do."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Asked(Event):
    """A question and its answer."""

    question: str
    answer: str
    by: Literal["person", "--yes"]
    """Who answered: the operator, or the option, which gives the assumed answer."""


class SensorEvents:
    """Shows each event of a sensor once, such as interruptions and reconnections."""

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
        return {key: _to_json(one) for key, one in value.items()}
    if isinstance(value, list | tuple):
        return [_to_json(one) for one in value]
    if isinstance(value, np.generic):
        return _to_json(value.item())
    if isinstance(value, float) and not np.isfinite(value):
        return None
    return value


class Key(Enum):
    """Requests of the operator at any time; the values are the keys of the live screen."""

    KEEP = "k"
    REDO = "r"
    SKIP = "s"
    PAUSE = "p"
    STOP = "q"
    OTHER = ""
    """Any other key: Space, Enter, an arrow, Ctrl-D, Ctrl-Z. It stops an arm in motion."""


@dataclass(frozen=True, slots=True)
class Question:
    """A question that the session waits for."""

    text: str
    """The question, with the meaning of each answer."""
    answers: tuple[str, ...] = ("yes", "no")
    """Accepted answers; a single one must be typed in full."""
    assumed: str | None = None
    """Answer of `--yes`; None if the operator must answer."""


class Operator(Protocol):
    """The operator as the session sees them."""

    def show(self, event: Event) -> None:
        """Show an event; returns at once. Raises `SupervisorGone` if it cannot be seen any more."""

    def ask(self, question: Question) -> str:
        """Wait for one of the question's answers; raises `Declined` or `SupervisorGone` if no operator can answer."""

    def absence(self) -> str | None:
        """Return what shows that no operator follows the session any more, such as a closed terminal; else None.

        Any thread may call it; returns at once.
        """

    @property
    def has_keys(self) -> bool:
        """Whether keys are read; key hints are shown only then."""

    def pressed(self) -> Key | None:
        """Return the oldest key not yet returned, or None; returns at once."""

    @property
    def pressed_by(self) -> str:
        """Who pressed the key that `pressed` returned last: "the operator", or a viewer of the page."""
