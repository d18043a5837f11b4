"""Reading of calibrations: their origin, values in JSON documents, the sensor matrix, and the marks of a calibration.

The sensor matrix is in `sensor.json` in the current folder, next to ftdrive.toml. Later matrices are `sensor-2.json`
and so on; the newest one is used. The matrix belongs to the sensor, so it is used with every tool.
"""

import logging
import platform
import re
import sys
from collections.abc import Mapping
from dataclasses import replace
from datetime import UTC, datetime
from importlib.metadata import version
from math import isfinite
from pathlib import Path
from shlex import quote
from typing import TYPE_CHECKING, Any, Final

import ftcalib
from ftcalib.errors import BadCalibration
from ftcalib.files import JSON, newest_path
from ftdrive import __version__
from ftdrive.cell.config import without_password
from ftdrive.errors import NotAccepted
from ftdrive.runs import is_run

# Only for type checkers: listing results must not import numpy, which takes long.
if TYPE_CHECKING:
    from ftcalib import CalibrationResult, SensorMatrix

_NAME: Final = re.compile(r"sensor(?:-(\d+))?\.json")
# Facts of a sensor to which its matrix is bound. The counts per unit differ between the sensor's calibration slots.
_FACTS: Final = {
    "counts_per_N": "counts per N",
    "counts_per_Nm": "counts per N·m",
    "range": "range",
    "sign": "sign",
}

_log = logging.getLogger(__name__)

EMULATED: Final = "EMULATED"
EDITED: Final = "EDITED BY HAND"
FOREIGN: Final = "OF ANOTHER CELL"
# Warning marks that every output shows for certain calibrations, with their meaning.
MARKS: Final[Mapping[str, str]] = {
    EMULATED: "The cell was EMULATED: these are not the values of a real tool.",
    EDITED: "The file was EDITED BY HAND after it was solved: its verdict and sigmas no longer apply to its numbers.",
    FOREIGN: "The calibration is OF ANOTHER CELL: arm, sensor or mounting differ, and --force applies it anyway.",
}


def made_now() -> dict[str, Any]:
    """Return the origin that every file made now records: time, command line and versions."""
    argv = [without_password(word) for word in sys.argv]
    return {"created_utc": datetime.now(UTC).isoformat(), "argv": argv, "versions": versions()}


def versions() -> dict[str, str]:
    """Return the versions of ftdrive, Python, the platform and the packages on which a result depends."""
    own = {"ftdrive": __version__, "python": platform.python_version(), "platform": platform.platform()}
    return own | {name: version(name) for name in ("numpy", "scipy", "python-can", "pyserial")}


def at(document: Any, *keys: str) -> Any:
    """Return the value at a path of keys in nested JSON objects; None if it does not exist."""
    for key in keys:
        document = document.get(key) if isinstance(document, Mapping) else None
    return document


def text_at(document: Any, *keys: str) -> str | None:
    """Return the string at a path of keys, without characters that databases reject; None if empty or no string."""
    value = at(document, *keys)
    return value.encode(errors="replace").decode().replace("\0", "\ufffd") if isinstance(value, str) and value else None


def number_at(document: Any, *keys: str) -> float | None:
    """Return the finite number at a path of keys in JSON objects; None for any other value."""
    value = at(document, *keys)
    usable = isinstance(value, int | float) and not isinstance(value, bool) and isfinite(value)
    return float(value) if usable else None


def numbers_at(document: Any, n: int, *keys: str) -> list[float] | None:
    """Return the list of n finite numbers at a path of keys in JSON objects; None for any other value."""
    values = at(document, *keys)
    numbers = [number for number in map(number_at, values) if number is not None] if isinstance(values, list) else []
    return numbers if len(numbers) == n == len(values or ()) else None


def time_at(document: Any, *keys: str) -> str | None:
    """Return the time at a path of keys as UTC in ISO 8601 with microseconds, sortable as text; None for no time."""
    try:
        return datetime.fromisoformat(at(document, *keys)).astimezone(UTC).isoformat(timespec="microseconds")
    except (TypeError, ValueError):
        return None


def read_calibration(path: str | Path, *, accept_edited: bool = False) -> "CalibrationResult":
    """Read a calibration; `CalibrationResult.save` writes it.

    If the current folder has a `sensor.json` for the sensor, the result decodes contacts with it.

    Parameters
    ----------
    path : str or Path
        A calibration.json, or a run folder, of which the newest calibration is read.
    accept_edited : bool
        Whether to accept a file that was edited by hand; the result is then marked by `is_edited`.

    Raises
    ------
    DataError
        The file is not a calibration of a known version, is damaged or edited, or was made with a load on the tool.
    OSError
        The file cannot be read.

    Examples
    --------
    >>> import ftdrive
    >>> ftdrive.solve(ftdrive.read_dataset("poses.csv")).save("calibration.json")
    >>> ftdrive.read_calibration("calibration.json").verdict
    'good'
    """
    path = Path(path)
    file = newest_path(path / "calibration.json") if path.is_dir() else path
    if not file.exists() and is_run(path):
        folder = quote(str(path))
        raise FileNotFoundError(
            f"{path} has no calibration, because its run was interrupted or its result rejected. Solve its poses:\n"
            f"ftdrive solve {folder} --output {folder}/calibration.json"
        )
    result = ftcalib.CalibrationResult.load(file, accept_edited=accept_edited)
    if result.provenance.get("load") is not None:
        from ftdrive.runs.load import Load

        load = Load.of_header(result.provenance)
        raise BadCalibration(
            f"{path} was made with {load}: use it in `ftdrive loads solve`, not as a calibration of the tool"
        )
    return with_sensor(result)


def require_accepted(result: "CalibrationResult", *, to_be_saved: bool = False) -> None:
    """Raise `NotAccepted` for a rejected result; with `to_be_saved`, the message adds that it was not saved."""
    if result.verdict == "rejected":
        unsaved = " and was not saved" if to_be_saved else ""
        codes = ", ".join(dict.fromkeys(item.code for item in result.findings if item.severity != "note"))
        raise NotAccepted(f"the result is rejected{unsaved}: its findings say what to fix ({codes})")


def marks_of(calibration: "CalibrationResult", *, emulated: bool = False, foreign: bool = False) -> tuple[str, ...]:
    """Return those `MARKS` that apply; `emulated` and `foreign` are facts of the cell that uses the calibration."""
    applying = {
        EMULATED: emulated or calibration.provenance.get("station") is not None,
        EDITED: calibration.is_edited,
        FOREIGN: foreign,
    }
    return tuple(mark for mark, applies in applying.items() if applies)


def sensor_files(folder: Path = Path()) -> list[Path]:
    """Return the files sensor.json, sensor-2.json, … in a folder, the oldest first."""
    return sorted(filter(_file_number, folder.glob("sensor*.json")), key=_file_number)


def next_sensor_file(folder: Path = Path()) -> Path:
    """Return the unused path for the next sensor matrix in a folder, such as sensor-2.json."""
    number = 1 + max(map(_file_number, sensor_files(folder)), default=0)
    return folder / (f"sensor-{number}.json" if number > 1 else "sensor.json")


def _file_number(path: Path) -> int:
    """Return the number in the name of a sensor-matrix file; 0 for any other file."""
    name = _NAME.fullmatch(path.name)
    return int(name[1] or 1) if name else 0


def sensor_identity(origin: Mapping[str, Any]) -> dict[str, JSON]:
    """Return the identity of a sensor from the provenance of a result or the `meta` of a dataset.

    The identity is model, serial number, counts per unit (which differ between calibration slots), range, sign, and
    whether the sensor is emulated; a value that is not reported is None.
    """
    from ftdrivers.interfaces import NOT_REPORTED

    model, serial = (at(origin, "devices", "sensor", name) for name in ("model", "serial"))
    return {
        "model": model if isinstance(model, str) else None,
        "serial": serial if isinstance(serial, str) and serial not in ("", NOT_REPORTED) else None,
        **{name: at(origin, "devices", "sensor", "facts", name, "value") for name in _FACTS},
        "emulated": bool(origin.get("station") or origin.get("emulated")),
    }


def identity_mismatch(sensor: "SensorMatrix", identity: Mapping[str, JSON]) -> str:
    """Return why a matrix does not belong to the sensor with this identity, as part of a sentence; "" if it does."""
    theirs = sensor.provenance.get("sensor")
    if not isinstance(theirs, Mapping):
        return "it was saved without the model and the range of its sensor: run `ftdrive loads solve` again"
    if identity["serial"] is None or theirs.get("serial") is None:
        whose = "this calibration" if identity["serial"] is None else "that file"
        return f"the sensor of {whose} has no serial number: add serial=NAME to the sensor's address"
    words = {"serial": "serial number", "model": "model", **_FACTS, "emulated": "emulated"}
    for name, what in words.items():
        if (ours := _comparable(identity[name])) != (other := _comparable(theirs.get(name))):
            return f"its {what} is {_shown(other)}, but {_shown(ours)} in this calibration"
    return ""


def with_sensor(calibration: "CalibrationResult", folder: Path = Path()) -> "CalibrationResult":
    """Return the calibration, to which the newest matrix of its sensor in a folder is added to decode contacts.

    Without such a matrix, it is unchanged. If a matrix seems meant for the sensor but cannot be used, logs a warning.

    Raises `BadCalibration` or `OSError` if a file cannot be read.
    """
    identity = sensor_identity(calibration.provenance)
    unused = ""
    for path in reversed(sensor_files(folder)):
        sensor = ftcalib.SensorMatrix.load(path)
        if not (why := identity_mismatch(sensor, identity)):
            return replace(calibration, sensor=sensor)
        theirs = sensor.provenance.get("sensor")
        known = theirs.get("serial") if isinstance(theirs, Mapping) else sensor.provenance.get("serial")
        if not unused and (known is None or identity["serial"] in (None, known)):
            unused = f"{path.name} is not used: {why}"
    if unused:
        _log.warning("%s", unused)
    return calibration


def _comparable(value: JSON) -> JSON:
    """Return a JSON value with numbers rounded to 9 digits, so that equal values from two files compare equal."""
    if isinstance(value, list | tuple):
        return [_comparable(item) for item in value]
    return float(f"{value:.9g}") if isinstance(value, float | int) and not isinstance(value, bool) else value


def _shown(value: JSON) -> str:
    if value is None:
        return "unknown"
    if isinstance(value, list):
        return ", ".join(map(_shown, value))
    return f"{value:g}" if isinstance(value, float) else str(value)
