"""The receipt of a push: which settings of the controller were changed, from what, and what was read back.

push.json         ftdrive.push/1: devices, reason, old and new values, values read back, error; push-2.json and so on
"""

import re
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Final, Self

import numpy as np

from ftcalib.errors import BadDataset
from ftcalib.files import check_format, read_object, write_object
from ftdrive.runs.run import Run, made_now
from ftdrivers.interfaces import ControllerSettings, DeviceInfo

FORMAT: Final = "ftdrive.push/1"
NAME: Final = "push"


def write_receipt(
    folder: Path,
    devices: Mapping[str, DeviceInfo],
    reason: Mapping[str, Any],
    values: Mapping[str, ControllerSettings | None],
    error: str,
) -> Path:
    """Write a new receipt; return its path.

    Parameters
    ----------
    folder : Path
        The run.
    devices : mapping
        By role.
    reason : mapping
        Where the new values come from.
    values : mapping
        `old`, `new` (None for a setting that was not to change) and `read_back` (None if it failed).
    error : str
        Why the push failed, or empty.
    """
    receipt = {
        "format": FORMAT,
        **made_now(),
        "devices": {role: asdict(info) for role, info in devices.items()},
        **reason,
        **{name: None if one is None else asdict(one) for name, one in values.items()},
        "error": error or None,
    }
    path = Run(folder).new_path(NAME)
    write_object(path, receipt)
    return path


@dataclass(frozen=True, slots=True)
class Receipt:
    """A receipt on disk."""

    path: Path
    old: ControllerSettings
    new: ControllerSettings
    devices: Mapping[str, Mapping[str, Any]]
    restores: str | None
    """The receipt whose old values were sent back; None for a push."""

    @classmethod
    def load(cls, path: Path) -> Self:
        """Read a receipt; of a run folder the newest of a push. Raises `BadDataset`."""
        if path.is_dir():
            return cls._newest(path)
        try:
            document = read_object(path, BadDataset)
            check_format(document, FORMAT, BadDataset)
            old, new = (_settings(document[name]) for name in ("old", "new"))
            found = cls(path, old, new, document["devices"], document.get("restores"))
            found.devices["arm"]["serial"], found.devices["arm"]["model"]
        except BadDataset as error:
            raise BadDataset(f"{path}: {error}") from error
        except (KeyError, TypeError, ValueError) as error:
            raise BadDataset(f"{path} is damaged ({error!r}): take it from a copy") from error
        return found

    @classmethod
    def _newest(cls, run: Path) -> Self:
        found = {path: re.fullmatch(rf"{NAME}-?(\d*)\.json", path.name) for path in run.iterdir()}
        paths = sorted((int(match[1] or 1), path) for path, match in found.items() if match)
        for _, path in reversed(paths):
            if (receipt := cls.load(path)).restores is None:
                return receipt
        raise BadDataset(f"{run} has no receipt of a push: give the run, or the {NAME}.json, of an earlier push")


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
