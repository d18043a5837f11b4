"""How the state of cells is written, in the terminal and on the page."""

from collections.abc import Sequence
from datetime import datetime
from typing import Final

from ftcalib.rounding import counted
from ftdrive.fleet.state import CellState, Fleet
from ftdrive.runs.verification_record import age_in_words

MOST: Final = 4


def listed(names: Sequence[str]) -> str:
    """Write names in a sentence, such as "a, b and c"; of many only the first."""
    shown = list(names) if len(names) <= MOST + 1 else [*names[:MOST], f"{len(names) - MOST} more"]
    return shown[0] if len(shown) == 1 else f"{', '.join(shown[:-1])} and {shown[-1]}"


def due_in_words(due: datetime | None, now: datetime) -> str:
    """Write when a verification is due, such as "in 5 d", "now" or "3 d ago"."""
    if due is None:
        return "now"
    if due > now:
        return f"in {age_in_words(due - now)}"
    days = (now - due).days
    return f"{days} d ago" if days else "now"


def verified_in_words(state: CellState, now: datetime) -> str:
    """Write outcome and age of the last verification, such as "2 d" or "FAILED 3 h"."""
    if state.verified is None:
        return "-"
    return f"{'' if state.passed else 'FAILED '}{age_in_words(now - state.verified)}"


def weighed_in_words(state: CellState, now: datetime) -> str:
    """Write mass and age of the last weighing, such as "0.250 kg 3 h"."""
    found = state.weighings
    if found is None or found.mass_kg is None or found.last_utc is None:
        return "-"
    return f"{found.mass_kg:.3f} kg {age_in_words(now - datetime.fromisoformat(found.last_utc))}"


def summary(fleet: Fleet, now: datetime) -> str:
    """Count the cells and tools that need attention, such as "200 cells: 2 failed, 5 drifting, 12 due"."""
    tools, cells = fleet.cells, {one.cell for one in fleet.cells}
    counts = {
        "never calibrated": sum(one.calibration_id is None for one in tools),
        "failed": sum(one.passed is False for one in tools),
        "drifting": sum(_drifts(one) for one in tools),
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


def _drifts(one: CellState) -> bool:
    return one.drift is not None and one.drift.found
