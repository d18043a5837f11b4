"""The result of a check, and the comparison of a calibration with the connected devices and their mounting."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from types import EllipsisType
from typing import TYPE_CHECKING, Literal

from ftdrivers.interfaces import NOT_REPORTED, DeviceInfo, Diagnosis

if TYPE_CHECKING:
    from ftcalib import CalibrationResult

State = Literal["ok", "warning", "failed", "skipped"]


@dataclass(frozen=True, slots=True)
class Check:
    """Result of checking one property, as `doctor` and the preflight checks report it."""

    name: str
    """Subject and property, such as "sensor.rate"."""
    state: State
    found: str
    """What the check found, with its values."""
    fix: str | None = None
    """The remedy: a command or an instruction; None if there is nothing to fix."""


def check_diagnosis(diagnosis: Diagnosis, device: str = "robot") -> Check:
    """Return, as a `Check`, the result of a check that a driver made on its own device."""
    state: State = "ok" if diagnosis.passed else "failed"
    return Check(f"{device}.{diagnosis.name}", state, diagnosis.found, diagnosis.fix or None)


def verdict(checks: Sequence[Check]) -> State:
    """Return the worst of the states of some checks, such as "failed"."""
    states = {check.state for check in checks}
    return "failed" if "failed" in states else "warning" if "warning" in states else "ok"


def merge_checks(name: str, checks: Sequence[Check]) -> Check:
    """Return one check with the worst state of several, and with the findings of those in this state."""
    state = verdict(checks)
    worst = [check for check in checks if check.state == state]
    fix = "; ".join(check.fix for check in worst if check.fix)
    return Check(name, state, ", ".join(check.found for check in worst), fix or None)


def who(info: DeviceInfo) -> str:
    """Describe a device by model, serial number and firmware."""
    return f"{info.model}, serial {info.serial}, firmware {info.firmware}"


@dataclass(frozen=True, slots=True)
class _Belonging:
    """Result of comparing a calibration with the connected devices, as sentences."""

    others: tuple[str, ...]
    """Sentences about connected devices that differ from those of the calibration."""
    unknown: tuple[str, ...]
    """Sentences about devices of the right model that were not compared further: a serial number is unknown."""


def compare_devices(
    result: "CalibrationResult", connected: Mapping[str, DeviceInfo], mount: str | EllipsisType | None = ...
) -> _Belonging:
    """Compare the devices of a calibration with the connected ones, by role.

    Devices are compared by serial number if both have one, else by model. The mounting label `mount`, which may be
    None, must be equal; it is not compared if it is omitted, or if the calibration is too old to have one.
    """
    made_with = result.provenance.get("devices")
    others, unknown = [], []
    for role, device in connected.items():
        made = made_with.get(role, {}) if isinstance(made_with, Mapping) else {}
        serial, model = made.get("serial", NOT_REPORTED), made.get("model", device.model)
        if NOT_REPORTED not in {serial, device.serial}:
            if serial != device.serial:
                pair = f"the {role} {serial}, but the {role} {device.serial}"
                others.append(f"the calibration was made with {pair} is connected")
        elif model.casefold() != device.model.casefold():
            others.append(f"the calibration was made with the {role} {model}, but {device.model} is connected")
        else:
            which = "of the calibration" if serial == NOT_REPORTED else "connected now"
            why = f"the {role} {which} reports no serial number"
            unknown.append(f"cannot check that the calibration belongs to this {role}: {why}")
    setup = result.provenance.get("setup")
    if mount is not ... and isinstance(setup, Mapping) and setup.get("mount", mount) != mount:
        made_as, now = (
            f"[sensor] mount = {label!r}" if label else "no [sensor] mount" for label in (setup["mount"], mount)
        )
        others.append(f"the calibration was made with {made_as}, but {now} is configured")
    return _Belonging(tuple(others), tuple(unknown))


def check_calibration(
    result: "CalibrationResult", connected: Mapping[str, DeviceInfo], mount: str | EllipsisType | None = ...
) -> Check:
    """Check that a calibration belongs to the connected devices and the mounting; see `compare_devices`."""
    name = "calibration.devices"
    belongs = compare_devices(result, connected, mount)
    if belongs.others:
        return Check(name, "failed", "; ".join(belongs.others), "run ftdrive calibrate")
    created = result.provenance.get("created_utc")
    made = f"verdict {result.verdict}, made at an unknown time"
    if isinstance(created, str):
        made = f"verdict {result.verdict}, made on {created[:10]} at {created[11:16]} UTC"
    if belongs.unknown:
        fix = "add serial=… (from its label) to the sensor's address, then calibrate again"
        return Check(name, "warning", f"{made}; {'; '.join(belongs.unknown)}", fix)
    return Check(name, "ok", f"{made}, with these devices" if connected else f"{made}; no device is connected")
