"""The state of a fleet, its words, and the loop of its server: what the status, its page and the metrics show."""

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from typing import Any, Final, Literal

from ftcalib.files import JSON
from ftcalib.rounding import counted
from ftdrive.errors import BadStore
from ftdrive.runs.verification import age_in_words
from ftdrive.runs.weighings import WeighingDay
from ftdrive.store.records import StoredCell
from ftdrive.words.history import tool_in_words
from ftdrivers.clock import Clock


@dataclass(frozen=True, slots=True)
class BiasDrift:
    """Drift of the bias, from the verifications of the newest calibration."""

    level_sigmas: float
    """Largest change of a component of the bias since the calibration, in sigmas of one verification."""
    found: bool
    """Whether a component has begun to drift; a steady offset is none."""
    words: str
    """Such as "force bias x drifts by 0.12 N a week since 2026-03-02"; empty if `found` is false."""


@dataclass(frozen=True, slots=True)
class CellState:
    """One tool of one cell. The configured tool has a state also if it was never calibrated."""

    cell: str
    tool: str | None = None
    arm_serial: str | None = None
    sensor_serial: str | None = None
    sensor_model: str | None = None
    calibration_id: str | None = None
    """Id of the newest accepted calibration."""
    verdict: str | None = None
    calibrated: datetime | None = None
    """UTC."""
    verified: datetime | None = None
    """Time of the last verification of that calibration, UTC."""
    passed: bool | None = None
    change: str | None = None
    """What the last verification found to have changed, such as "bias"."""
    due: datetime | None = None
    """When the next verification is due, UTC; None for a tool that was never calibrated, which is due at once."""
    mass_kg: float | None = None
    temperature_C: float | None = None
    drift: BiasDrift | None = None
    """None with too few verifications."""
    weighings: WeighingDay | None = None
    """The last day with weighings; None without any in the last 90 days."""
    emulated: bool = False
    """Whether the calibration was made in an emulated cell."""

    @property
    def tool_in_words(self) -> str:
        """Name of the tool, and whether the cell was emulated."""
        return tool_in_words(self.tool, emulated=self.emulated)

    def is_due(self, now: datetime) -> bool:
        """Whether a verification, or the first calibration, is due."""
        return self.due is None or self.due <= now

    def to_dict(self, now: datetime) -> dict[str, Any]:
        """Return the fields as JSON, and whether it is due."""
        found = asdict(self) | {"weighings": None if self.weighings is None else _counts(self.weighings)}
        plain = {key: value.isoformat() if isinstance(value, datetime) else value for key, value in found.items()}
        return {**plain, "is_due": self.is_due(now)}


def _counts(day: WeighingDay) -> dict[str, JSON]:
    refused: dict[str, JSON] = {code: number for code, number in day.refusals.items() if number}
    named: dict[str, JSON] = {name: getattr(day, name) for name in ("last_utc", "mass_kg", "mass_sigma_kg")}
    return {"day": day.day, "number": day.weighings, "refused": refused, **named}


FindingKind = Literal["payload", "temperature", "base", "overdue", "weighing"]


@dataclass(frozen=True, slots=True)
class FleetFinding:
    """Something that several results show together."""

    kind: FindingKind
    cells: tuple[str, ...]
    words: str
    """What was found, with values, and what to do."""


@dataclass(frozen=True, slots=True)
class Fleet:
    """All cells and what they show together."""

    cells: tuple[CellState, ...]
    findings: tuple[FleetFinding, ...]

    def is_due(self, one: StoredCell, now: datetime) -> bool:
        """Whether the mounted tool is due; without a name of it, whether any tool of the cell is."""
        states = [state for state in self.cells if state.cell == one.name]
        if one.tool is not None:
            states = [state for state in states if state.tool in {one.tool, None}]
        return not states or any(state.is_due(now) for state in states)

    def id_of(self, cell: str, tool: str) -> str | None:
        """Return the id of the newest accepted calibration of a tool; None without one."""
        return next((one.calibration_id for one in self.cells if (one.cell, one.tool) == (cell, tool)), None)


MOST: Final = 4


def join_names(names: Sequence[str]) -> str:
    """Write names in a sentence, such as "a, b and c"; of many only the first."""
    shown = list(names) if len(names) <= MOST + 1 else [*names[:MOST], f"{len(names) - MOST} more"]
    return shown[0] if len(shown) == 1 else f"{', '.join(shown[:-1])} and {shown[-1]}"


def times_in_words(state: CellState, now: datetime) -> dict[str, str]:
    """Write what the columns of a table have that change with time.

    They are the age of the calibration, outcome and age of the last verification, such as "FAILED 3 h", when the next
    one is due, such as "in 5 d", "now" or "3 d ago", and mass and age of the last weighing, such as "0.250 kg 3 h".
    """
    due, found = "now", state.weighings
    if state.due is not None and state.due > now:
        due = f"in {age_in_words(state.due - now)}"
    elif state.due is not None and (days := (now - state.due).days):
        due = f"{days} d ago"
    weighed = "-"
    if found is not None and found.mass_kg is not None and found.last_utc is not None:
        weighed = f"{found.mass_kg:.3f} kg {age_in_words(now - datetime.fromisoformat(found.last_utc))}"
    outcome = "" if state.passed else "FAILED "
    return {
        "age": "-" if state.calibrated is None else age_in_words(now - state.calibrated),
        "verified": "-" if state.verified is None else f"{outcome}{age_in_words(now - state.verified)}",
        "due": due,
        "weighed": weighed,
    }


def summary(fleet: Fleet, now: datetime) -> str:
    """Count the cells and tools that need attention, such as "200 cells: 2 failed, 5 drifting, 12 due"."""
    tools, cells = fleet.cells, {one.cell for one in fleet.cells}
    counts = {
        "never calibrated": sum(one.calibration_id is None for one in tools),
        "failed": sum(one.passed is False for one in tools),
        "drifting": sum(one.drift is not None and one.drift.found for one in tools),
        "due": sum(one.is_due(now) and one.calibration_id is not None for one in tools),
        "with a finding": len({cell for one in fleet.findings if one.kind != "overdue" for cell in one.cells}),
    }
    found = ", ".join(f"{number} {what}" for what, number in counts.items() if number)
    return f"{counted(len(cells), 'cell')}: {found or 'none needs attention'}"


def attention(fleet: Fleet, now: datetime) -> list[str]:
    """Return what is wrong in single cells, then what several show together: one sentence each."""
    found = []
    for one in fleet.cells:
        name = f"{one.cell}, {one.tool}" if one.tool else one.cell
        if one.calibration_id is None:
            found.append(f"{name}: never calibrated: run `ftdrive calibrate` at this cell")
        if one.passed is False and one.verified is not None:
            failed = f"{name}: the verification failed {age_in_words(now - one.verified)} ago"
            if one.change:
                found.append(f"{failed} ({one.change} changed): verify again and accept the update, or calibrate again")
            else:
                found.append(f"{failed}, and no change explains it: verify again with a free tool, or calibrate again")
        if one.drift is not None and one.drift.found:
            found.append(f"{name}: {one.drift.words}: calibrate again, and check the sensor if it goes on")
    return found + [one.words for one in fleet.findings]


# Time between two reads of the store.
EVERY_S: Final = 60.0


def serve_status(
    fleet_at: Callable[[datetime], Fleet],
    update: Callable[[Fleet, datetime, bool], None],
    clock: Clock,
    *,
    say: Callable[[str], None],
    now: Callable[[], datetime] = lambda: datetime.now(UTC),
) -> None:
    """Read the state by `fleet_at` until an exception ends it, such as `KeyboardInterrupt`.

    `update` takes the state, when it was read (UTC), and whether the store could be read now. A store that cannot be
    read later than at the start ends nothing: the last state stays, with its age, and `say` takes a sentence for the
    operator. `clock` times the period. Raises `BadStore` at the start.
    """
    # A store that cannot be read at the start ends the server, so that a wrong address is noticed at once.
    read, is_up = now(), True
    fleet = fleet_at(read)
    while True:
        update(fleet, read, is_up)
        clock.sleep(EVERY_S)
        was_up, time = is_up, now()
        try:
            fleet, read, is_up = fleet_at(time), time, True
        except BadStore as error:
            is_up = False
            if was_up:
                say(f"{error}. The last state is served meanwhile. It is {age_in_words(time - read)} old.")
        else:
            if not was_up:
                say("The store can be read again.")
