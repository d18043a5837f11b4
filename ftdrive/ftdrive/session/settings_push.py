"""Push the payload and gravity from a calibration to the controller: sent after a typed word, then read back.

A push changes the robot's model of its load. It is refused unless the arm is that of the calibration, stands still, and
no program runs. Every attempt that may have sent something writes a receipt with the old values, which can be restored.

push.json         ftdrive.push/1: devices, reason, old and new values, values read back, error; then push-2.json …
"""

import re
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Final, Self

import numpy as np

from ftcalib import CalibrationResult
from ftcalib.errors import BadDataset
from ftcalib.files import check_format, read_object, write_object
from ftcalib.judge.described_cell import Lean, lean_from
from ftcalib.model import Array
from ftdrive.cell.config import CellConfig
from ftdrive.checks import computer
from ftdrive.checks.arm import FlangeLoad, check_arm, check_remote, check_safety, flange_load
from ftdrive.checks.check import compare_devices
from ftdrive.checks.sensor import check_level
from ftdrive.errors import ConfigError, NotAccepted
from ftdrive.planning.geometry.scene import down_of
from ftdrive.runs.calibration import made_now
from ftdrive.runs.run import Run
from ftdrive.session.guards import Limits
from ftdrive.session.preflight import require_no_program
from ftdrivers.interfaces import ControllerSettings, DeviceInfo, ForceTorqueSensor, Guard, RobotArm

FORMAT: Final = "ftdrive.push/1"
# Start of the file name of each receipt.
_RECEIPT: Final = "push"
# The word that the operator types to send each setting.
WORDS: Final = {"payload": "PUSH", "gravity": "GRAVITY"}

_STILL_S: Final = 5.0
_LISTEN_S: Final = 1.0
# Number of attempts to obtain a steady reading; a steady one fails the test about once in a hundred times.
_LISTENS: Final = 3
# Largest allowed difference between a value sent and the value read back, which both have 64 bits.
_TOLERANCE: Final = 1e-6

# Asks the operator for the word of a setting, such as PUSH for "payload"; raises `Declined` if it is not typed.
Ask = Callable[[str], None]


@dataclass(frozen=True, slots=True)
class Receipt:
    """Receipt of a push, read from disk."""

    path: Path
    old: ControllerSettings
    new: ControllerSettings
    devices: Mapping[str, Mapping[str, Any]]
    restores: str | None
    """Path of the earlier receipt whose old values this push restored; None for an ordinary push."""

    @classmethod
    def load(cls, path: Path) -> Self:
        """Read a receipt, or a run folder's newest one that is not of a restoration; raises `BadDataset` on failure."""
        if path.is_dir():
            return cls._newest(path)
        try:
            document = read_object(path, BadDataset)
            check_format(document, FORMAT, BadDataset)
            old, new = (_settings(document[name]) for name in ("old", "new"))
            receipt = cls(path, old, new, document["devices"], document.get("restores"))
            receipt.devices["arm"]["serial"], receipt.devices["arm"]["model"]
        except BadDataset as error:
            raise BadDataset(f"{path}: {error}") from error
        except (KeyError, TypeError, ValueError) as error:
            raise BadDataset(f"{path} is damaged ({error!r}): restore it from a copy") from error
        return receipt

    @classmethod
    def _newest(cls, run: Path) -> Self:
        found = {path: re.fullmatch(rf"{_RECEIPT}-?(\d*)\.json", path.name) for path in run.iterdir()}
        paths = sorted((int(match[1] or 1), path) for path, match in found.items() if match)
        for _, path in reversed(paths):
            if (receipt := cls.load(path)).restores is None:
                return receipt
        raise BadDataset(f"{run} has no receipt of a push: give the run or the {_RECEIPT}.json of an earlier push")


def _settings(values: Mapping[str, Any]) -> ControllerSettings:
    shapes = {"mass_kg": (), "p_flange_com_m": (3,), "inertia_kg_m2": (6,), "up_base_m_s2": (3,)}
    found: dict[str, Any] = {}
    for name, shape in shapes.items():
        if (value := values[name]) is not None:
            array = np.array(value, np.float64)
            if array.shape != shape or not np.isfinite(array).all():
                raise ValueError(f"{name} is {value}")
            found[name] = tuple(array.tolist()) if shape else float(array)
    return ControllerSettings(**found)


@dataclass(frozen=True, slots=True, eq=False)
class Push:
    """A push to make: the new and the current settings, and the comparison that led to the new ones."""

    old: ControllerSettings
    new: ControllerSettings
    """New values; None for each setting that does not change."""
    devices: Mapping[str, DeviceInfo]
    reason: Mapping[str, Any]
    """Origin of the new values, as the receipt records it."""
    load: FlangeLoad | None = None
    lean: Lean | None = None
    """Tilt of the base relative to the gravity set in the controller, or if unknown, to the configured mounting."""
    contact: Array | None = None
    """(6,) reading minus the reading of a free tool, N and N·m: contact, or drift since the calibration."""

    @property
    def settings(self) -> list[str]:
        """Names of the settings to send, as in `WORDS`."""
        asked = {"payload": self.new.mass_kg, "gravity": self.new.up_base_m_s2}
        return [name for name, value in asked.items() if value is not None]


def propose(
    cell: CellConfig,
    arm: RobotArm,
    sensor: ForceTorqueSensor,
    result: CalibrationResult,
    *,
    payload: bool,
    gravity: bool,
    name: str,
) -> Push:
    """Compare a calibration, from the path `name`, with the settings of the controller; return the push to make.

    Raises
    ------
    ConfigError
        Mass or height of the sensor is not configured.
    NotAccepted
        The calibration is rejected or belongs to other devices, or the arm is not ready.
    """
    # Sensor and adapter are modelled as one mass at half the height; the plate that carries the tool is counted twice.
    if result.verdict == "rejected":
        raise NotAccepted(f"{name} is rejected ({'; '.join(result.reasons)}): calibrate again")
    mass_kg, height_m = _sensor_of(cell)
    connected = {"arm": arm.identify(), "sensor": sensor.identify()}
    if others := compare_devices(result, connected, cell.sensor.mount).others:
        raise NotAccepted(f"{others[0]}: push the calibration of this cell")
    _require_ready(cell, arm)
    load, old = flange_load(result, mass_kg, height_m), arm.controller_settings()
    down = down_of(cell.workcell.mounting) if old.up_base_m_s2 is None else -_unit_vector(old.up_base_m_s2)
    lean = lean_from(down, result.gravity_force_base_N, result.covariance[3:6, 3:6])
    return Push(
        old,
        ControllerSettings(
            load.mass_kg if payload else None,
            tuple(load.p_flange_com_m.tolist()) if payload else None,
            (old.inertia_kg_m2 or (0.0,) * 6) if payload else None,
            _gravity_to_set(result, lean, old) if gravity else None,
        ),
        connected,
        {
            "calibration": {"path": name, "id": result.id, "created_utc": result.provenance.get("created_utc")},
            "payload_at_calibration_kg": (result.provenance.get("setup") or {}).get("payload_kg"),
            "sensor_mass_kg": mass_kg,
            "sensor_height_mm": 1e3 * height_m,
            "sigma": {"mass_kg": load.sigma_kg, "p_flange_com_m": load.sigma_m.tolist()},
            "lean": asdict(lean),
        },
        load,
        lean,
        _contact_wrench(arm, sensor, result),
    )


def _sensor_of(cell: CellConfig) -> tuple[float, float]:
    """Return mass (kg) and height (m) of the sensor. Raises `ConfigError` if one of them is not configured."""
    mass_kg, height_mm = cell.sensor.mass_kg, cell.sensor.height_mm
    if mass_kg is None:
        raise ConfigError(
            "[sensor] mass_kg is not set, and the sensor cannot measure its own mass: set it to the mass of sensor and "
            "adapter, or to 0 for the sensor inside the wrist"
        )
    if height_mm is None:
        raise ConfigError(
            "[sensor] height_mm is not set, and gravity does not determine it: set it to the height of the sensor's "
            "origin above the flange face"
        )
    return mass_kg, height_mm / 1e3


def _require_ready(cell: CellConfig, arm: RobotArm) -> None:
    """Raise `NotAccepted` unless this is the configured arm, without a program, in remote control, and at rest."""
    require_no_program(arm, cell.clock, Limits())
    for check in (
        check_arm(arm.identify(), cell.robot),
        check_remote(arm),
        check_safety(arm.status()),
    ):
        if check.state == "failed":
            raise NotAccepted(f"{check.found}: {check.fix}; nothing was sent")
    _wait_until_still(arm)


def _wait_until_still(arm: RobotArm) -> None:
    arm.wait_until_still(timeout_s=_STILL_S, guard=lambda: None)


def _contact_wrench(arm: RobotArm, sensor: ForceTorqueSensor, result: CalibrationResult) -> Array | None:
    """Return reading (6,) minus free-tool reading; None if the pose is unknown. `NotAccepted` if it is not steady."""
    for _ in range(_LISTENS):
        wrench = sensor.collect(_LISTEN_S).wrench
        check = check_level(wrench)
        if check.state == "ok":
            break
    else:
        raise NotAccepted(f"{check.found}: {check.fix}; nothing was sent")
    if arm.status().tcp_offset is None:
        return None
    return np.asarray(result.compensate(wrench.mean(axis=0), arm.state().R_base_flange))


def _gravity_to_set(result: CalibrationResult, lean: Lean, old: ControllerSettings) -> tuple[float, ...] | None:
    """Return the gravity to set, with its present magnitude; None if the controller's direction already agrees."""
    # If the controller does not report its gravity, a change could neither be read back nor be restored.
    if old.up_base_m_s2 is None:
        raise NotAccepted(
            f"the base {lean} relative to [workcell] mounting, and this controller does not report its gravity vector, "
            "so a change could not be verified: set the mounting on the pendant"
        )
    if lean.is_other_mounting:
        raise NotAccepted(
            f"gravity is {lean.deg:.0f}° off the direction in the controller: correct the mounting on the pendant; "
            "if it is near 180°, check the sensor's sign first"
        )
    if not lean.is_significant:
        return None
    size_m_s2 = float(np.linalg.norm(old.up_base_m_s2))
    return tuple((-size_m_s2 * _unit_vector(result.gravity_force_base_N)).tolist())


def _unit_vector(vector: Any) -> Array:
    return np.asarray(vector, np.float64) / np.linalg.norm(vector)


# ------------------------------------------------------------------------------------------------------------- sending


def send(
    arm: RobotArm, push: Push, folder: Path, ask: Ask, guard: Guard = lambda: None
) -> tuple[Path, ControllerSettings]:
    """Ask for the word of each setting, send the settings, and read them back.

    `guard` is called before each setting is sent, and may raise.

    Returns the path of the receipt, a new file in `folder`, and the settings that the controller then reports.

    Raises
    ------
    NotAccepted
        The settings have changed since they were shown, or the controller reports values that differ from those sent.
    Declined
        A word was not typed; nothing was sent.
    DeviceError
        The arm failed. If a setting may have been sent, there is a receipt.
    """
    # The settings are read back after ftdrive's program has ended, because only then are they known to outlast it.
    disk = computer.check_disk(folder)
    if disk.state == "failed":
        raise NotAccepted(f"no receipt can be written: {disk.found}. Copy the run to another folder; nothing was sent")
    for name in push.settings:
        ask(name)
    arm.open(control=True)
    _wait_until_still(arm)
    if arm.controller_settings() != push.old:
        raise NotAccepted("the settings of the controller have changed meanwhile: start again; nothing was sent")
    guard()
    read_back, failure = None, ""
    try:
        _set(arm, push.new, guard)
        arm.close()  # the settings that outlast the program are to be read back
        arm.open()
        read_back = arm.controller_settings()
    except BaseException as error:  # including Ctrl-C
        failure = str(error) or "interrupted"
        raise
    finally:
        values = {"old": push.old, "new": push.new, "read_back": read_back}
        path = _write_receipt(folder, push.devices, push.reason, values, failure)
    if different := _differences(push.new, read_back):
        raise NotAccepted(
            f"the controller does not report the {' and '.join(different)} that was sent: check the settings at the "
            f"pendant; receipt: {path}"
        )
    return path, read_back


# Effect of each setting, with the question for its word.
EFFECTS: Final = {
    "payload": (
        "The controller uses the payload to detect collisions and to limit speed. With a wrong payload the arm may "
        "stop or move by itself. Setting it zeroes the arm's own force sensor, and the arm may make a small jump. "
        "Keep the arm free and still, and hands off. Type PUSH to send the payload"
    ),
    "gravity": (
        "The controller uses the gravity direction to compensate the weight of the whole arm. With a wrong direction "
        "the arm may stop, or sink in freedrive. Keep the arm free and still, and hands off. Type GRAVITY to send "
        "gravity"
    ),
}


def _set(arm: RobotArm, new: ControllerSettings, guard: Guard) -> None:
    if new.mass_kg is not None and new.p_flange_com_m is not None:
        arm.set_payload(new.mass_kg, new.p_flange_com_m, new.inertia_kg_m2 or (0.0,) * 6)
    if new.up_base_m_s2 is not None:
        guard()
        arm.set_gravity(new.up_base_m_s2)


def _differences(sent: ControllerSettings, read_back: ControllerSettings | None) -> list[str]:
    """Return the names of the settings for which the controller reports a value other than the one sent."""
    back = read_back or ControllerSettings()
    pairs = {
        "mass": (sent.mass_kg, back.mass_kg),
        "centre of mass": (sent.p_flange_com_m, back.p_flange_com_m),
        "inertia": (sent.inertia_kg_m2, back.inertia_kg_m2),
        "gravity": (sent.up_base_m_s2, back.up_base_m_s2),
    }
    return [
        name
        for name, (a, b) in pairs.items()
        if a is not None and b is not None and not np.allclose(a, b, rtol=0.0, atol=_TOLERANCE)
    ]


def restore(cell: CellConfig, arm: RobotArm, receipt: Receipt) -> Push:
    """Return the push that restores the old values of a receipt; raises the errors of `propose`."""
    info = arm.identify()
    made = receipt.devices["arm"]["model"], receipt.devices["arm"]["serial"]
    if made != (info.model, info.serial):
        raise NotAccepted(
            f"{receipt.path} belongs to the arm {made[0]}, serial {made[1]}, but {info.model}, serial {info.serial}, "
            "is connected: connect the arm that the receipt names"
        )
    _require_ready(cell, arm)
    old, changed = receipt.old, receipt.new
    payload = changed.mass_kg is not None
    if payload and (old.mass_kg is None or old.p_flange_com_m is None):
        raise NotAccepted(f"{receipt.path} has no old payload, the controller did not report it: set it on the pendant")
    back = ControllerSettings(
        old.mass_kg if payload else None,
        old.p_flange_com_m if payload else None,
        old.inertia_kg_m2 if payload else None,
        old.up_base_m_s2 if changed.up_base_m_s2 is not None else None,
    )
    return Push(arm.controller_settings(), back, {"arm": info}, {"restores": str(receipt.path)})


def _write_receipt(
    folder: Path,
    devices: Mapping[str, DeviceInfo],
    reason: Mapping[str, Any],
    values: Mapping[str, ControllerSettings | None],
    error: str,
) -> Path:
    """Write a new receipt into a run folder; return its path.

    `reason` is the origin of the new values. `values` has the entries `old`, `new` (None for a setting that does not
    change) and `read_back` (None if reading failed). `error` says why the push failed, or is empty.
    """
    receipt = {
        "format": FORMAT,
        **made_now(),
        "devices": {role: asdict(info) for role, info in devices.items()},
        **reason,
        **{name: None if value is None else asdict(value) for name, value in values.items()},
        "error": error or None,
    }
    path = Run(folder).new_path(_RECEIPT)
    write_object(path, receipt)
    return path
