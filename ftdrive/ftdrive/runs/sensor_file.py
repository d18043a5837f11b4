"""The file of a sensor's matrix: `sensor.json` in the folder where commands run, beside ftdrive.toml.

A later one is `sensor-2.json`, and so on; the newest counts. It belongs to the sensor, so it serves every tool.
"""

import re
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

from ftcalib import CalibrationResult
from ftcalib.sensor_matrix import SensorMatrix

_NAME: Final = re.compile(r"sensor(?:-(\d+))?\.json")


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


def sensor_serial(origin: Mapping[str, Any]) -> str | None:
    """Return the serial number of the sensor in the provenance of a result, or what a dataset has; None without one."""
    devices = origin.get("devices")
    sensor = devices.get("sensor") if isinstance(devices, dict) else None
    serial = sensor.get("serial") if isinstance(sensor, dict) else None
    return serial if isinstance(serial, str) else None


def with_sensor(calibration: CalibrationResult, folder: Path = Path()) -> CalibrationResult:
    """Return a calibration that decodes contacts by the newest matrix of its sensor in a folder, if there is one.

    Raises `BadCalibration` or `OSError` if that file cannot be read.
    """
    for path in reversed(sensor_files(folder)):
        sensor = SensorMatrix.load(path)
        if sensor.provenance.get("serial") == sensor_serial(calibration.provenance):
            return replace(calibration, sensor=sensor)
    return calibration
