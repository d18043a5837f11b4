"""Register of plans that were driven to their end, by arm: only those may run fast, or without a typed word."""

import json
import os
from datetime import UTC, datetime
from pathlib import Path

from ftdrivers.interfaces import NOT_REPORTED

FORMAT = "ftdrive.completed/1"


def state_file() -> Path:
    """Return the user's register of completed plans; it need not exist."""
    home = os.environ.get("XDG_STATE_HOME", "")
    folder = Path(home) if Path(home).is_absolute() else Path("~/.local/state").expanduser()
    return folder / "ftdrive" / "completed.ndjson"


def has_completed(arm_serial: str, plan_sha256: str) -> bool:
    """Whether this arm has driven this plan to its end before; unreadable lines are ignored.

    False for an arm that reports no serial number, because it may be another one.
    """
    path = state_file()
    if arm_serial == NOT_REPORTED or not path.is_file():
        return False
    wanted = {"format": FORMAT, "arm": arm_serial, "plan": plan_sha256}
    return any(
        wanted.items() <= _read(line).items()
        for line in path.read_text(encoding="utf-8", errors="replace").splitlines()
    )


def remember_completed(arm_serial: str, plan_sha256: str) -> None:
    """Record that one session drove every move of the plan, slowly, and took every pose."""
    path = state_file()
    path.parent.mkdir(parents=True, exist_ok=True)
    line = {"format": FORMAT, "arm": arm_serial, "plan": plan_sha256, "utc": datetime.now(UTC).isoformat()}
    with path.open("a", encoding="utf-8") as file:
        file.write(json.dumps(line) + "\n")


def _read(line: str) -> dict[str, object]:
    try:
        found = json.loads(line)
    except ValueError:
        return {}
    return found if isinstance(found, dict) else {}
