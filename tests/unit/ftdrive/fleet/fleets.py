"""Fleets as the store would give them, and a reading of one."""

from datetime import UTC, datetime, timedelta
from typing import Any

from ftdrive.fleet.state import BiasDrift, CellState, Fleet, FleetFinding

NOW = datetime(2026, 11, 22, 12, tzinfo=UTC)
CALM = BiasDrift(0.8, found=False, words="")
DRIFTING = BiasDrift(6.5, found=True, words="force bias x drifts by 0.12 N per week since 2026-11-01")


def cell(name: str, tool: str | None = "gripper", **more: Any) -> CellState:
    """A calibrated cell that was verified yesterday, and is due in six days."""
    found: dict[str, Any] = {
        "arm_serial": "arm-1",
        "sensor_serial": "ft-1",
        "sensor_model": "ATI",
        "calibration_id": "7c1e9a03f5d2",
        "verdict": "good",
        "calibrated": NOW - timedelta(days=30),
        "verified": NOW - timedelta(days=1),
        "passed": True,
        "change": None,
        "due": NOW + timedelta(days=6),
        "mass_kg": 1.25,
        "temperature_C": None,
        "drift": CALM,
    }
    return CellState(cell=name, tool=tool, **found | more)


def never_calibrated(name: str) -> CellState:
    """A cell without any result."""
    return CellState(name)


def fleet(*cells: CellState, findings: tuple[FleetFinding, ...] = ()) -> Fleet:
    """A fleet."""
    return Fleet(cells, findings)


def reading(*cells: CellState, findings: Any = (), store_up: bool = True) -> tuple[Fleet, datetime, bool]:
    """A reading of a moment ago."""
    return Fleet(cells, findings), NOW, store_up
