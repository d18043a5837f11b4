"""The state of a fleet: what the status, its page, the metrics and the messages show."""

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from datetime import datetime
from typing import Any, Literal

from ftdrive.store.records import tool_in_words


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
class Weighings:
    """Of one tool on its last day with weighings."""

    day: str
    """As ISO 8601, UTC."""
    number: int
    """Of parts that were weighed."""
    refused: Mapping[str, int]
    """How often nothing was weighed, by the code of the reason."""
    last_utc: str | None
    """When the last part was weighed; None if every weighing of that day was refused or found nothing."""
    mass_kg: float | None
    """Of the last part."""
    mass_sigma_kg: float | None


@dataclass(frozen=True, slots=True)
class CellState:
    """One tool of one cell. The configured tool has a state also if it was never calibrated."""

    cell: str
    tool: str | None = None
    arm_serial: str | None = None
    sensor_serial: str | None = None
    sensor_model: str | None = None
    calibration_id: str | None = None
    """Of the newest accepted calibration."""
    verdict: str | None = None
    calibrated: datetime | None = None
    """UTC."""
    verified: datetime | None = None
    """Of the last verification of that calibration, UTC."""
    passed: bool | None = None
    change: str | None = None
    """What the last verification found to have changed, such as "bias"."""
    due: datetime | None = None
    """When the next verification is due, UTC; None for a tool that was never calibrated, which is due at once."""
    mass_kg: float | None = None
    temperature_C: float | None = None
    drift: BiasDrift | None = None
    """None with too few verifications."""
    weighings: Weighings | None = None
    """None without any in the last 90 days."""
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
        plain = {
            key: value.isoformat() if isinstance(value, datetime) else value for key, value in asdict(self).items()
        }
        return {**plain, "is_due": self.is_due(now)}


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
