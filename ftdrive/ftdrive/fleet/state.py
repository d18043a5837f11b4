"""The state of a fleet, its description in sentences, and the loop of its server."""

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
    """Drift of the bias, estimated from the verifications of the newest calibration."""

    level_sigmas: float
    """Largest change of a component of the bias since the calibration, in sigmas of one verification."""
    found: bool
    """Whether a component drifts; a constant offset is not a drift."""
    words: str
    """Description such as "force bias x drifts by 0.12 N per week since 2026-03-02"; empty if `found` is false."""


@dataclass(frozen=True, slots=True)
class CellState:
    """State of one tool of one cell; the configured tool has a state even if it was never calibrated."""

    cell: str
    tool: str | None = None
    arm_serial: str | None = None
    sensor_serial: str | None = None
    sensor_model: str | None = None
    calibration_id: str | None = None
    """Id of the newest accepted calibration."""
    verdict: str | None = None
    calibrated: datetime | None = None
    """Time at which the newest calibration was made, UTC."""
    verified: datetime | None = None
    """Time of the last verification of this calibration, UTC."""
    passed: bool | None = None
    change: str | None = None
    """What has changed since the calibration, as the last verification found, such as "bias"; None if nothing."""
    due: datetime | None = None
    """Time at which the next verification is due, UTC; None for a tool without a calibration, which is due now."""
    mass_kg: float | None = None
    temperature_C: float | None = None
    drift: BiasDrift | None = None
    """Drift of the bias; None with too few verifications."""
    weighings: WeighingDay | None = None
    """The last weighing day; None if there is none in the last 90 days."""
    emulated: bool = False
    """Whether the calibration was made in an emulated cell."""

    @property
    def tool_in_words(self) -> str:
        """Name of the tool, with a mark if the cell was emulated."""
        return tool_in_words(self.tool, emulated=self.emulated)

    def is_due(self, now: datetime) -> bool:
        """Return whether a verification, or the first calibration, is due."""
        return self.due is None or self.due <= now

    def to_dict(self, now: datetime) -> dict[str, Any]:
        """Return the fields as JSON, and whether a verification is due."""
        values = asdict(self) | {"weighings": None if self.weighings is None else _counts(self.weighings)}
        plain = {key: value.isoformat() if isinstance(value, datetime) else value for key, value in values.items()}
        return {**plain, "is_due": self.is_due(now)}


def _counts(day: WeighingDay) -> dict[str, JSON]:
    refused: dict[str, JSON] = {code: number for code, number in day.refusals.items() if number}
    named: dict[str, JSON] = {name: getattr(day, name) for name in ("last_utc", "mass_kg", "mass_sigma_kg")}
    return {"day": day.day, "number": day.weighings, "refused": refused, **named}


FindingKind = Literal["payload", "temperature", "base", "overdue", "weighing"]


@dataclass(frozen=True, slots=True)
class FleetFinding:
    """A finding that needs the results of several calibrations or cells together."""

    kind: FindingKind
    cells: tuple[str, ...]
    words: str
    """A sentence with the finding, its values, and the remedy."""


@dataclass(frozen=True, slots=True)
class Fleet:
    """States of all cells, and findings across them."""

    cells: tuple[CellState, ...]
    findings: tuple[FleetFinding, ...]

    def is_due(self, cell: StoredCell, now: datetime) -> bool:
        """Return whether the configured tool is due or, without a tool name, whether any tool of the cell is due."""
        states = [state for state in self.cells if state.cell == cell.name]
        if cell.tool is not None:
            states = [state for state in states if state.tool in {cell.tool, None}]
        return not states or any(state.is_due(now) for state in states)

    def id_of(self, cell: str, tool: str) -> str | None:
        """Return the id of the newest accepted calibration of a tool; None if there is none."""
        return next((state.calibration_id for state in self.cells if (state.cell, state.tool) == (cell, tool)), None)


MOST: Final = 4


def join_names(names: Sequence[str]) -> str:
    """Return names joined for a sentence, such as "a, b and c"; if there are many, only the first."""
    shown = list(names) if len(names) <= MOST + 1 else [*names[:MOST], f"{len(names) - MOST} more"]
    return shown[0] if len(shown) == 1 else f"{', '.join(shown[:-1])} and {shown[-1]}"


def times_in_words(state: CellState, now: datetime) -> dict[str, str]:
    """Return the time-dependent columns of a table.

    These are the age of the calibration; outcome and age of the last verification, such as "FAILED 3 h"; the time of
    the next one, such as "in 5 d", "now" or "3 d ago"; and mass and age of the last weighing, such as "0.250 kg 3 h".
    """
    due, day = "now", state.weighings
    if state.due is not None and state.due > now:
        due = f"in {age_in_words(state.due - now)}"
    elif state.due is not None and (days := (now - state.due).days):
        due = f"{days} d ago"
    weighed = "-"
    if day is not None and day.mass_kg is not None and day.last_utc is not None:
        weighed = f"{day.mass_kg:.3f} kg {age_in_words(now - datetime.fromisoformat(day.last_utc))}"
    outcome = "" if state.passed else "FAILED "
    return {
        "age": "-" if state.calibrated is None else age_in_words(now - state.calibrated),
        "verified": "-" if state.verified is None else f"{outcome}{age_in_words(now - state.verified)}",
        "due": due,
        "weighed": weighed,
    }


def summary(fleet: Fleet, now: datetime) -> str:
    """Return the numbers of cells and tools that need attention, such as "200 cells: 2 failed, 5 drifting, 12 due"."""
    tools, cells = fleet.cells, {one.cell for one in fleet.cells}
    counts = {
        "never calibrated": sum(one.calibration_id is None for one in tools),
        "failed": sum(one.passed is False for one in tools),
        "drifting": sum(one.drift is not None and one.drift.found for one in tools),
        "due": sum(one.is_due(now) and one.calibration_id is not None for one in tools),
        "with a finding": len({cell for one in fleet.findings if one.kind != "overdue" for cell in one.cells}),
    }
    listed = ", ".join(f"{number} {what}" for what, number in counts.items() if number)
    return f"{counted(len(cells), 'cell')}: {listed or 'none needs attention'}"


def attention(fleet: Fleet, now: datetime) -> list[str]:
    """Return one sentence per problem of a single cell, then per finding across cells."""
    sentences = []
    for state in fleet.cells:
        name = f"{state.cell}, {state.tool}" if state.tool else state.cell
        if state.calibration_id is None:
            sentences.append(f"{name}: never calibrated: run `ftdrive calibrate` at this cell")
        if state.passed is False and state.verified is not None:
            failed = f"{name}: the verification failed {age_in_words(now - state.verified)} ago"
            if state.change:
                sentences.append(
                    f"{failed} ({state.change} changed): verify again and accept the update, or calibrate again"
                )
            else:
                sentences.append(
                    f"{failed}, and no change explains it: verify again with a free tool, or calibrate again"
                )
        if state.drift is not None and state.drift.found:
            sentences.append(f"{name}: {state.drift.words}: calibrate again, and check the sensor if it continues")
    return sentences + [state.words for state in fleet.findings]


# Time between two readings of the fleet's store by the server, s.
EVERY_S: Final = 60.0


def serve_status(
    fleet_at: Callable[[datetime], Fleet],
    update: Callable[[Fleet, datetime, bool], None],
    clock: Clock,
    *,
    say: Callable[[str], None],
    now: Callable[[], datetime] = lambda: datetime.now(UTC),
) -> None:
    """Read the state with `fleet_at` periodically, until an exception such as `KeyboardInterrupt`.

    `update` receives the state, the time of its reading (UTC), and whether the last reading succeeded. After a failed
    reading the last state is kept, and `say` receives a sentence for the operator. `clock` times the period. Raises
    `BadStore` if the first reading fails, so that a wrong address is noticed at once.
    """
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
                say(f"{error}. The server shows the last state, which is {age_in_words(time - read)} old.")
        else:
            if not was_up:
                say("The store can be read again.")
