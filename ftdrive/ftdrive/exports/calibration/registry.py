"""One calibration in, the text of one target out, unless the target would compensate differently."""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from math import degrees

import numpy as np

from ftcalib import CalibrationResult
from ftcalib.files import JSON
from ftcalib.model import angle_between, angle_between_vectors
from ftdrive.errors import NotAccepted
from ftdrive.exports.calibration import complete, models, robots, ros1, ros2
from ftdrive.exports.calibration.difference import compensations, largest_difference
from ftdrive.exports.calibration.formats import FORMATS, MAX_FORCE_ERROR_N, Format
from ftdrive.exports.calibration.settings import Settings
from ftdrive.exports.calibration.text import Exported, made_by, with_header
from ftdrive.runs.verification_record import MARKS, marks_of

TARGETS: Mapping[str, Callable[[CalibrationResult, Settings], Exported]] = {
    "kth": ros1.kth,
    "ft-tools": ros2.ft_tools,
    "ros2-message": ros2.ros2_message,
    "calaw": ros2.calaw,
    "ros2-control": ros2.ros2_control,
    "admittance": ros2.admittance,
    "kit": ros1.kit,
    "code-iai": ros1.code_iai,
    "mc-rtc": robots.mc_rtc,
    "xarm": robots.xarm,
    "franka": robots.franka,
    "ur-payload": robots.ur_payload,
    "urdf": models.urdf,
    "mujoco": models.mujoco,
    "static-transform": ros2.static_transform,
    "json": complete.as_json,
    "yaml": complete.as_yaml,
}


@dataclass(frozen=True, slots=True)
class Export:
    """The text of one target and what must be known with it."""

    text: str
    notes: tuple[str, ...]
    elsewhere: Mapping[str, JSON]
    max_force_error_N: float
    """Largest difference to `CalibrationResult.compensate` over all orientations."""
    max_torque_error_Nm: float


def export(
    calibration: CalibrationResult, name: str, settings: Settings, *, max_force_error_N: float = MAX_FORCE_ERROR_N
) -> Export:
    """Write a calibration for one target.

    Parameters
    ----------
    name : str
        A key of `FORMATS`.
    max_force_error_N : float
        The target may differ by so much from `CalibrationResult.compensate`, in any orientation.

    Raises
    ------
    ConfigError
        The target needs a value that was not measured.
    NotAccepted
        The calibration is rejected, or the target would differ by more.
    """
    if calibration.verdict == "rejected":
        raise NotAccepted(
            f"the calibration is rejected and not exported: {'; '.join(calibration.reasons)}. Calibrate again"
        )
    target = FORMATS[name]
    exported = TARGETS[name](calibration, settings)
    force_N, torque_Nm = 0.0, 0.0
    notes = list(exported.notes)
    if target.subtracts:
        force_N, torque_Nm = largest_difference(*compensations(calibration, target))
        if lost := list(_lost(calibration, target)):
            words = (
                f"{name} cannot express {' and '.join(lost)}: its result differs from that of ftdrive by up to "
                f"{force_N:.3g} N and {torque_Nm:.3g} N·m"
            )
            if force_N > max_force_error_N:
                raise NotAccepted(
                    f"{words}, and the limit is {max_force_error_N:g} N. Choose another format "
                    f"({', '.join(_lossless(calibration, target))}), or raise --max-force-error"
                )
            notes.insert(0, f"{words}.")
    notes[:0] = [MARKS[mark] for mark in marks_of(calibration)]
    notes += [f"Also set {place} = {_in_words(value)}." for place, value in exported.elsewhere.items()]
    origin = made_by(calibration, settings.verification)
    text = with_header(exported.text, target.comment, [origin, target.description, *notes])
    return Export(text, tuple(notes), exported.elsewhere, force_N, torque_Nm)


def _lost(calibration: CalibrationResult, target: Format) -> Iterator[str]:
    """Name what the calibration has and the target cannot express, beyond rounding."""
    down = np.array([0.0, 0.0, -1.0])
    gravity = calibration.gravity_force_base_N
    tilt_rad = angle_between_vectors(down, gravity)
    turn_rad = float(angle_between(calibration.R_flange_sensor, np.eye(3)))
    if "tilt" not in target.expresses and tilt_rad > 1e-9:
        yield f"the base tilt of {degrees(tilt_rad):.3g}°"
    if "rotation" not in target.expresses and turn_rad > 1e-9:
        yield f"the sensor turned by {degrees(turn_rad):.3g}° in the flange"
    if "response" not in target.expresses and calibration.response is not None:
        yield "gain and cross-talk of the sensor"


def _lossless(calibration: CalibrationResult, target: Format) -> Iterator[str]:
    """Name the formats that lose nothing, subtract as much, and read our sensor if the target does."""
    for name, other in FORMATS.items():
        as_much = set(other.subtracts) >= set(target.subtracts) and other.has_own_reading <= target.has_own_reading
        if as_much and not list(_lost(calibration, other)):
            yield name


def _in_words(value: JSON) -> str:
    """Write a value of `elsewhere` for people."""
    if isinstance(value, Mapping):
        return f"({', '.join(f'{name} {_in_words(one)}' for name, one in value.items())})"
    if isinstance(value, list):
        return f"[{', '.join(map(_in_words, value))}]"
    return str(value)  # of a float every digit
