"""The file of a sensor's matrix: `sensor.json` in the folder where commands run, beside ftdrive.toml.

A later one is `sensor-2.json`, and so on; the newest counts. It belongs to the sensor, so it serves every tool.
"""

import logging
import re
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

from ftcalib import CalibrationResult
from ftcalib.files import JSON
from ftcalib.sensor_matrix import SensorMatrix
from ftdrivers.interfaces import NOT_REPORTED

_NAME: Final = re.compile(r"sensor(?:-(\d+))?\.json")
# Facts of a sensor that change what its matrix means. Counts differ between calibration slots.
_FACTS: Final = {
    "counts_per_N": "counts per N",
    "counts_per_Nm": "counts per N·m",
    "range": "range",
    "sign": "sign",
}

_log = logging.getLogger(__name__)


def sensor_files(folder: Path = Path()) -> list[Path]:
    """Return the files of a folder, the oldest first."""
    numbered = [
        (int(name[1] or 1), path) for path in folder.glob("sensor*.json") if (name := _NAME.fullmatch(path.name))
    ]
    return [path for _, path in sorted(numbered)]


def next_sensor_file(folder: Path = Path()) -> Path:
    """Return the name of the next file."""
    existing = sensor_files(folder)
    if not existing:
        return folder / "sensor.json"
    number = _NAME.fullmatch(existing[-1].name)
    return folder / f"sensor-{int((number and number[1]) or 1) + 1}.json"


def sensor_identity(origin: Mapping[str, Any]) -> dict[str, JSON]:
    """Return what identifies a sensor in the provenance of a result, or in what a dataset has.

    Its model, serial number, counts per unit (which differ between calibration slots), range, sign, and whether it is
    emulated; None for what is not reported.
    """
    devices = origin.get("devices")
    sensor = devices.get("sensor") if isinstance(devices, Mapping) else None
    sensor = sensor if isinstance(sensor, Mapping) else {}
    facts = sensor.get("facts")
    facts = facts if isinstance(facts, Mapping) else {}
    values = {name: fact.get("value") if isinstance(fact := facts.get(name), Mapping) else None for name in _FACTS}
    named = {name: one if isinstance(one := sensor.get(name), str) else None for name in ("model", "serial")}
    serial = None if named["serial"] in ("", NOT_REPORTED) else named["serial"]
    is_emulated = bool(origin.get("station") or origin.get("emulated"))
    return {**named, "serial": serial, **values, "emulated": is_emulated}


def difference(sensor: SensorMatrix, identity: Mapping[str, JSON]) -> str:
    """Return why a matrix is not that of a sensor with this identity, as half a sentence; empty if it is."""
    theirs = sensor.provenance.get("sensor")
    if not isinstance(theirs, Mapping):
        return "it was saved without the model and the range of its sensor: run `ftdrive loads solve` again"
    if identity["serial"] is None or theirs.get("serial") is None:
        whose = "this calibration" if identity["serial"] is None else "that file"
        return f"the sensor of {whose} reports no serial number: name it by serial=NAME in the sensor's address"
    words = {"serial": "serial number", "model": "model", **_FACTS, "emulated": "emulated"}
    for name, what in words.items():
        if (ours := _comparable(identity[name])) != (other := _comparable(theirs.get(name))):
            return f"its {what} is {_shown(other)}, that of this calibration {_shown(ours)}"
    return ""


def with_sensor(calibration: CalibrationResult, folder: Path = Path()) -> CalibrationResult:
    """Return a calibration that decodes contacts by the newest matrix of its sensor in a folder, if there is one.

    A warning says why the newest matrix of the same serial number, or of a sensor without one, is not used.

    Raises `BadCalibration` or `OSError` if that file cannot be read.
    """
    identity = sensor_identity(calibration.provenance)
    unused = ""
    for path in reversed(sensor_files(folder)):
        sensor = SensorMatrix.load(path)
        if not (why := difference(sensor, identity)):
            return replace(calibration, sensor=sensor)
        theirs = sensor.provenance.get("sensor")
        known = theirs.get("serial") if isinstance(theirs, Mapping) else sensor.provenance.get("serial")
        if not unused and (known is None or identity["serial"] in (None, known)):
            unused = f"{path.name} is not used: {why}"
    if unused:
        _log.warning("%s", unused)
    return calibration


def _comparable(value: JSON) -> JSON:
    """Return numbers without the rounding of a file."""
    if isinstance(value, list | tuple):
        return [_comparable(one) for one in value]
    return float(f"{value:.9g}") if isinstance(value, float | int) and not isinstance(value, bool) else value


def _shown(value: JSON) -> str:
    if value is None:
        return "not known"
    if isinstance(value, list):
        return ", ".join(map(_shown, value))
    return f"{value:g}" if isinstance(value, float) else str(value)
