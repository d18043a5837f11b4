"""The result of one check, and the check whether a calibration is of the connected devices and their mounting."""

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
    """One property that was checked, as `doctor` prints it and preflight passes it on."""

    name: str
    """Subject and property, such as "sensor.rate"."""
    state: State
    found: str
    fix: str | None = None
    """The command or the instruction that fixes it."""


def check_diagnosis(diagnosis: Diagnosis, device: str = "robot") -> Check:
    """Return what the driver of a robot or a sensor found when it checked its own device."""
    state: State = "ok" if diagnosis.passed else "failed"
    return Check(f"{device}.{diagnosis.name}", state, diagnosis.found, diagnosis.fix or None)


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


@dataclass(frozen=True, slots=True)
class _Belonging:
    """Reasons against a calibration belonging to the connected devices, in words."""

    others: tuple[str, ...]
    """Devices that differ from those of the calibration."""
    unknown: tuple[str, ...]
    """Devices of the same model where a serial number is unknown."""


def compare_devices(
    result: "CalibrationResult", connected: Mapping[str, DeviceInfo], mount: str | EllipsisType | None = ...
) -> _Belonging:
    """Compare the devices of a calibration with the connected ones, by role.

    Serial numbers decide where both sides have one; elsewhere another model is another device. The label `mount` of the
    mounting, None without one, must be the same; it is not compared if it is left out, or if the file is older.
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
            which = "it was made with" if serial == NOT_REPORTED else "connected"
            why = f"the {role} {which} reports no serial number"
            unknown.append(f"whether the calibration is of this {role} cannot be checked: {why}")
    setup = result.provenance.get("setup")
    if mount is not ... and isinstance(setup, Mapping) and setup.get("mount", mount) != mount:
        made_as, now = (f"[sensor] mount = {one!r}" if one else "no [sensor] mount" for one in (setup["mount"], mount))
        others.append(f"the calibration was made with {made_as}, but {now} is configured")
    return _Belonging(tuple(others), tuple(unknown))


def check_calibration(
    result: "CalibrationResult", connected: Mapping[str, DeviceInfo], mount: str | EllipsisType | None = ...
) -> Check:
    """Check that a calibration belongs to the connected devices, and as `compare_devices` does to the mounting."""
    name = "calibration.devices"
    belongs = compare_devices(result, connected, mount)
    if belongs.others:
        return Check(name, "failed", "; ".join(belongs.others), "ftdrive calibrate")
    created = result.provenance.get("created_utc")
    made = f"verdict {result.verdict}, made at an unknown time"
    if isinstance(created, str):
        made = f"verdict {result.verdict}, made on {created[:10]} at {created[11:16]} UTC"
    if belongs.unknown:
        fix = "add serial=… (from its label) to the sensor's address, and calibrate with it once"
        return Check(name, "warning", f"{made}; {'; '.join(belongs.unknown)}", fix)
    return Check(name, "ok", f"{made}, with these devices" if connected else f"{made}; no device to compare with")
