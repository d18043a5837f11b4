"""The result of one check, as `doctor` prints it and preflight passes it on."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

from ftdrivers.interfaces import (
    DeviceInfo,
)

State = Literal["ok", "warning", "failed", "skipped"]


@dataclass(frozen=True, slots=True)
class Check:
    """One property that was checked."""

    name: str
    """Subject and property, such as "sensor.rate"."""
    state: State
    found: str
    fix: str | None = None
    """The command or the instruction that fixes it."""


def verdict(checks: Sequence[Check]) -> State:
    """Return the worst state of all."""
    states = {check.state for check in checks}
    return "failed" if "failed" in states else "warning" if "warning" in states else "ok"


def merge_checks(name: str, checks: Sequence[Check]) -> Check:
    """Merge checks into one with their worst state; it says what those in this state found."""
    state = verdict(checks)
    worst = [check for check in checks if check.state == state]
    fix = "; ".join(check.fix for check in worst if check.fix)
    return Check(name, state, ", ".join(check.found for check in worst), fix or None)


def who(info: DeviceInfo) -> str:
    """Return a device's model, serial number and firmware in words."""
    return f"{info.model}, serial {info.serial}, firmware {info.firmware}"
