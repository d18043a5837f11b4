"""Whether an earlier result can serve a new tool: the same sensor, arm and mounting."""

from collections.abc import Mapping
from typing import Any

from ftcalib import CalibrationResult
from ftdrive.errors import ConfigError


def require_same_cell(earlier: CalibrationResult, provenance: Mapping[str, Any]) -> None:
    """Raise `ConfigError` if a rejected result, or one of another sensor, arm or mount, is to serve a new tool.

    What a file does not name is not compared.
    """
    if earlier.verdict == "rejected":
        raise ConfigError(f"--from: result {earlier.id} is rejected: take an accepted one")
    before, now = earlier.provenance, provenance
    for device in ("sensor", "arm"):
        serials = [_of(one, "devices", device, "serial") for one in (before, now)]
        if all(serials) and serials[0] != serials[1]:
            raise ConfigError(
                f"--from: result {earlier.id} is of {device} {serials[0]}, the new data of {serials[1]}: take one of "
                f"the same {device}"
            )
    mounts = [_of(one, "setup", "mount") for one in (before, now)]
    if all(mounts) and mounts[0] != mounts[1]:
        raise ConfigError(f"--from: result {earlier.id} is of mount {mounts[0]}, the new data of {mounts[1]}")


def _of(document: Any, *keys: str) -> Any:
    for key in keys:
        document = document.get(key) if isinstance(document, Mapping) else None
    return document
