"""Text of the targets: what a target function returns, numbers, YAML, header."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import yaml
from numpy.typing import ArrayLike

from ftcalib import CalibrationResult
from ftcalib.files import JSON
from ftdrive import __version__
from ftdrive.exports.calibration.formats import Comment
from ftdrive.exports.common import plain
from ftdrive.runs.verification_record import VerificationRecord, marks_of


@dataclass(frozen=True, slots=True)
class Exported:
    """What one target gets."""

    text: str
    notes: tuple[str, ...] = ()
    """What the user of the target must know; sentences."""
    elsewhere: Mapping[str, JSON] = field(default_factory=dict)
    """What the target reads from another place, by its name there."""


def numbers(values: ArrayLike) -> list[float]:
    """Return plain floats without a negative zero."""
    return [float(value) + 0.0 for value in np.ravel(values)]


def xyz(values: ArrayLike) -> dict[str, float]:
    """Return a vector as ROS messages have it."""
    return dict(zip("xyz", numbers(values), strict=True))


def yaml_text(document: Mapping[str, Any] | list[float]) -> str:
    """Return YAML that keeps every bit of a float and the order of the keys."""
    return yaml.safe_dump(document, sort_keys=False, default_flow_style=None, width=10**6)


def made_by(calibration: CalibrationResult, verification: VerificationRecord | None) -> str:
    """Say which calibration this is, when it was made and last verified, and by which version."""
    made = calibration.provenance.get("created_utc")
    date = made if isinstance(made, str) else "at an unknown time"
    verified = "not verified"
    if verification is not None:
        verified = "last verified" if verification.passed else "VERIFICATION FAILED"
        verified += f" {verification.created_utc.isoformat()}"
    marks = "".join(f"{mark} " for mark in marks_of(calibration))
    return f"{marks}ftdrive calibration {calibration.id}, made {date}, {verified}; made by ftdrive {__version__}"


def with_header(text: str, comment: Comment, lines: Iterable[str]) -> str:
    """Add comment lines, reduced to printable ASCII."""
    clean = [plain(line) for line in lines]
    if comment == "none":
        return text
    if comment == "<!-- -->":
        inside = "\n".join(f"  {line.replace('--', '- -')}" for line in clean)
        return f"<!--\n{inside}\n-->\n{text}"
    head = "".join(f"# {line}\n" for line in clean)
    return text + head if comment == "# at the end" else head + text
