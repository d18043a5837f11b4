"""Writes the rows of `formats.py`, the complete JSON and YAML, and says how far a target is from the calibration."""

import json
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from math import degrees
from typing import Any, Final

import numpy as np
from scipy.spatial.transform import Rotation

from ftcalib import CalibrationResult
from ftcalib.after.weighing import true_tool
from ftcalib.compensation import Compensator
from ftcalib.files import JSON
from ftcalib.model import Array, angle_between, angle_between_vectors, nearest_rotation, skew
from ftdrive import __version__
from ftdrive.errors import NotAccepted
from ftdrive.exports.formats import FORMATS, MAX_FORCE_ERROR_N, MC_RTC_G_M_S2, Comment, Format
from ftdrive.exports.shared import (
    Exported,
    R_frame_sensor,
    Settings,
    gravity_m_s2,
    inertia_kg_m2,
    inertia_note,
    numbers,
    payload_inertia_kg_m2,
    plain,
    quaternion_xyzw,
    rpy_rad,
    yaml_text,
)
from ftdrive.runs.verification import MARKS, VerificationRecord, marks_of

FORMAT = "ftdrive.export/1"

# Named and defined as in a calibration file.
_FIELDS = (
    *("mass_kg", "g_m_s2", "weight_N", "gravity_force_base_N"),
    *("R_flange_sensor", "p_sensor_com_m", "force_bias_N", "torque_bias_Nm"),
)


def _document(calibration: CalibrationResult, settings: Settings) -> dict[str, JSON]:
    """Return all that compensation needs, for a program of the user.

    With u = R_flange_sensor^T R_base_flange^T gravity_force_base_N, the weight in the sensor frame, and zeros where
    there is no `response`:

        force = raw - force_bias_N - u - force_gain u
        torque = raw - torque_bias_Nm - p_sensor_com_m x u - cross_talk_m u
        contact = decoder (force, torque)

    `decoder` (6 x 6) is null where no error of the sensor's matrix is known. Then the contact is (force, torque).
    """
    result = calibration.to_dict()
    response, decoder = calibration.response, calibration.contact.decoder
    origin_m = None if settings.height_mm is None else settings.p_flange_sensor_m("json").tolist()
    made, last = calibration.provenance.get("created_utc"), settings.verification
    return {
        "format": FORMAT,
        "id": calibration.id,
        "marks": list(marks_of(calibration)),
        "created_utc": made if isinstance(made, str) else None,
        "verification": None
        if last is None
        else {name: last.to_dict()[name] for name in ("created_utc", "passed", "change")},
        "made_by": f"ftdrive {__version__}",
        "sign": "wrench on the sensor, sensor axes, about the sensor origin; contact = decoder (raw - bias - weight)",
        **{name: result[name] for name in _FIELDS},
        "p_flange_sensor_m": origin_m,
        "response": None
        if response is None
        else {"force_gain": response.force_gain.tolist(), "cross_talk_m": response.cross_talk_m.tolist()},
        "decoder": None if decoder is None else decoder.tolist(),
        "sigma": {name: np.asarray(value).tolist() for name, value in calibration.sigma.items()},
    }


_STEPS = 500
# Relative gain of a step, at the start that gains most.
_CONVERGED = 1e-12


def _compensations(calibration: CalibrationResult, target: Format) -> tuple[Compensator, Compensator]:
    """Return our compensation of a free tool, and that of a target that expresses all but what its `expresses` lacks.

    Without tilt, gravity points along -z of the base. Without rotation, the sensor's axes are those of the flange.
    Where the target has another sensor, or none, neither has the response of ours.
    """
    parameters = calibration.parameters
    response = None if target.has_own_reading else calibration.response
    ours = Compensator(parameters, response=response)
    if "tilt" not in target.expresses:
        parameters = replace(parameters, gravity_force_base_N=np.array([0.0, 0.0, -calibration.weight_N]))
    if "rotation" not in target.expresses:
        parameters = replace(parameters, R_flange_sensor=np.eye(3))
    return ours, Compensator(parameters, response=response if "response" in target.expresses else None)


def largest_difference(one: Compensator, other: Compensator) -> tuple[float, float]:
    """Return the largest norms of the difference of force (N) and torque (N·m) over all orientations."""
    matrix, offset = other.matrix - one.matrix, other.offset - one.offset
    return _largest_norm(matrix[:3], offset[:3]), _largest_norm(matrix[3:], offset[3:])


def _largest_norm(matrix: Array, offset: Array) -> float:
    """Maximise |matrix @ vec(R) + offset| over rotations R.

    The square is convex in R, so that the rotation which is best for its tangent never lowers it. Ascent from the 60
    rotations of the icosahedron reaches every maximum.
    """
    R = Rotation.create_group("I").as_matrix()
    norms = np.zeros(len(R))
    for _ in range(_STEPS):
        error = R.reshape(-1, 9) @ matrix.T + offset
        before, norms = norms, np.linalg.norm(error, axis=1)
        if (norms - before).max() <= _CONVERGED * norms.max():
            break
        R = nearest_rotation((error @ matrix).reshape(-1, 3, 3))
    return float(norms.max())


@dataclass(frozen=True, slots=True)
class _Values:
    """The values that a row names: `_VALUES`, and fields of the calibration and of the settings."""

    target: str
    calibration: CalibrationResult
    settings: Settings

    def __getitem__(self, name: str) -> Any:
        """Return a value in the unit of its name; raises `ConfigError` if it was not measured."""
        base, _, form = name.rpartition("_")
        if name in _VALUES:
            value = _VALUES[name](self)
        elif form in _FORMS:
            value = _FORMS[form](self[base])
        elif name.startswith("minus_"):
            value = -np.array(self[name.removeprefix("minus_")])
        else:
            value = getattr(self.calibration if hasattr(self.calibration, name) else self.settings, name)
        return numbers(value) if isinstance(value, np.ndarray) else value

    def filled(self, node: Any) -> Any:
        """Return a part of a row with its values."""
        if isinstance(node, Mapping):
            return {key: self.filled(value) for key, value in node.items()}
        if isinstance(node, list):
            return [each for one in node for each in (self[one[1:]] if "*" in str(one) else [self.filled(one)])]
        return self[node[1:]] if isinstance(node, str) and node.startswith("$") else node


_DIAGONAL_FIRST: Final = [0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]
# How a name ends that stands for a value in a certain form.
_FORMS: Mapping[str, Callable[[Any], Any]] = {
    "xyz": lambda value: dict(zip("xyz", value, strict=True)),  # as ROS messages have a vector
    "words": lambda value: ", ".join(map(str, value)),
    "spaced": lambda value: " ".join(map(repr, value)),
    "fixed": lambda value: ", ".join(f"{one:.12f}" for one in value),  # the URScript manual mentions no exponents
    "yaml": lambda value: yaml_text(value).removesuffix("\n").removesuffix("\n..."),
}
_VALUES: Mapping[str, Callable[[_Values], Any]] = {
    "mc_rtc_mass_kg": lambda v: v.calibration.weight_N / MC_RTC_G_M_S2,
    "com_mm": lambda v: 1e3 * v.calibration.p_sensor_com_m,
    "gravity_m_s2": lambda v: v.settings.R_frame_base @ gravity_m_s2(v.calibration),
    "gravity_direction": lambda v: (g := gravity_m_s2(v.calibration)) / np.linalg.norm(g),
    "rpy_rad": lambda v: rpy_rad(R_frame_sensor(v.calibration, v.settings)),
    "quaternion_wxyz": lambda v: np.roll(quaternion_xyzw(R_frame_sensor(v.calibration, v.settings)), 1),
    "quaternion": lambda v: quaternion_xyzw(R_frame_sensor(v.calibration, v.settings)),
    "origin_m": lambda v: v.settings.p_frame_sensor_m(v.target),
    "frame_com_m": lambda v: (
        v.settings.p_frame_sensor_m(v.target) + R_frame_sensor(v.calibration, v.settings) @ v.calibration.p_sensor_com_m
    ),
    "payload_kg": lambda v: v.settings.payload(v.target, v.calibration)[0],
    "payload_com_m": lambda v: v.settings.payload(v.target, v.calibration)[1],
    "payload_inertia": lambda v: (
        "0, 0, 0, 0, 0, 0"
        if (J := payload_inertia_kg_m2(v.calibration, v.settings, v.target)) is None
        else _FORMS["fixed"](numbers(J[_DIAGONAL_FIRST]))
    ),
    "gravity_base_m_s2": lambda v: gravity_m_s2(v.calibration),
    "true_kg": lambda v: true_tool(v.calibration)[0],
    "true_com_m": lambda v: true_tool(v.calibration)[1],
    "J": lambda v: np.zeros(9) if (J := inertia_kg_m2(v.calibration)) is None else J,
    "inertia_note": lambda v: inertia_note(v.calibration),
    "urdf_point_mass": lambda v: _point_mass(v.calibration, ""),
    "mujoco_point_mass": lambda v: _point_mass(v.calibration, "inertia "),
    "mujoco_inertia": lambda v: (
        'diaginertia="0 0 0"'
        if (J := inertia_kg_m2(v.calibration)) is None
        else f'fullinertia="{_FORMS["spaced"](numbers(J[_DIAGONAL_FIRST]))}"'
    ),
}


def _point_mass(calibration: CalibrationResult, what: str) -> str:
    """Return a comment of XML and the start of its next line, or nothing if the inertia was identified."""
    if inertia_kg_m2(calibration) is not None:
        return ""
    return f"<!-- {what}not identified: zeros stand for a point mass; put values of the CAD model here -->\n      "


def _written(name: str, calibration: CalibrationResult, settings: Settings) -> Exported:
    """Write a target. Raises `ConfigError` if a value was not measured."""
    if name == "json":
        return Exported(json.dumps(_document(calibration, settings), indent=1, allow_nan=False) + "\n")
    if name == "yaml":
        return Exported(yaml_text(_document(calibration, settings)))
    row, values = FORMATS[name], _Values(name, calibration, settings)
    text = row.content.format_map(values) if isinstance(row.content, str) else yaml_text(values.filled(row.content))
    notes = (note.format_map(values) for note in row.notes)
    return Exported(text, tuple(note for note in notes if note), values.filled(row.elsewhere))


def export(
    calibration: CalibrationResult, name: str, settings: Settings, *, max_force_error_N: float = MAX_FORCE_ERROR_N
) -> Exported:
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
    exported = _written(name, calibration, settings)
    force_N, torque_Nm = 0.0, 0.0
    notes = list(exported.notes)
    if target.subtracts:
        force_N, torque_Nm = largest_difference(*_compensations(calibration, target))
        if lost := list(_lost(calibration, target)):
            words = (
                f"{name} cannot express {' and '.join(lost)}: its reading of a free tool differs from that of ftdrive "
                f"by up to {force_N:.3g} N and {torque_Nm:.3g} N·m"
            )
            if force_N > max_force_error_N:
                raise NotAccepted(
                    f"{words}, and the limit is {max_force_error_N:g} N. Choose another format "
                    f"({', '.join(_lossless(calibration, target))}), or accept it: --max-force-error {_above(force_N)}"
                )
            notes.insert(0, f"{words}.")
        if "response" not in target.expresses:
            notes += _undecoded(name, calibration)
    notes[:0] = [MARKS[mark] for mark in marks_of(calibration)]
    # The file has every digit.
    shown, exact = (
        [
            *notes,
            *(f"Also set {place} = {_describe_value(value, form)}." for place, value in exported.elsewhere.items()),
        ]
        for form in (".6g", "")
    )
    origin = _made_by(calibration, settings.verification)
    text = _with_header(exported.text, target.comment, [origin, target.description, *exact])
    return Exported(text, tuple(shown), exported.elsewhere, force_N, torque_Nm)


def _above(value: float) -> str:
    """Write the next larger number of two digits."""
    step = 10.0 ** (np.floor(np.log10(value)) - 1)
    return f"{np.ceil(value / step) * step:.2g}"


def _lost(calibration: CalibrationResult, target: Format) -> Iterator[str]:
    """Name what the calibration has and the target cannot express, beyond rounding."""
    tilt_rad = angle_between_vectors(np.array([0.0, 0.0, -1.0]), calibration.gravity_force_base_N)
    turn_rad = float(angle_between(calibration.R_flange_sensor, np.eye(3)))
    if "tilt" not in target.expresses and tilt_rad > 1e-9:
        yield f"the base tilt of {degrees(tilt_rad):.3g}°"
    if "rotation" not in target.expresses and turn_rad > 1e-9:
        yield f"the sensor turned by {degrees(turn_rad):.3g}° in the flange"
    if "response" not in target.expresses and calibration.response is not None:
        yield "gain and cross-talk of the sensor"


def _undecoded(name: str, calibration: CalibrationResult) -> Iterator[str]:
    """State the largest error of a contact where the target does not decode it."""
    if (decoder := calibration.contact.decoder) is None:
        return
    at_tool = np.concatenate([np.eye(3), skew(calibration.p_sensor_com_m)])
    error = (np.linalg.inv(decoder) - np.eye(6)) @ at_tool
    percent = 100 * np.linalg.norm(error[:3], 2)
    yield (
        f"{name} cannot decode contacts: a force at the tool's centre of mass is off by up to {percent:.2g} %. "
        "Multiply the result by the decoder of the formats json or yaml."
    )


def _lossless(calibration: CalibrationResult, target: Format) -> Iterator[str]:
    """Name the formats that lose nothing, subtract as much, and read our sensor if the target does."""
    for name, other in FORMATS.items():
        as_much = set(other.subtracts) >= set(target.subtracts) and other.has_own_reading <= target.has_own_reading
        if as_much and not list(_lost(calibration, other)):
            yield name


def _describe_value(value: JSON, form: str) -> str:
    if isinstance(value, Mapping):
        return f"({', '.join(f'{name} {_describe_value(one, form)}' for name, one in value.items())})"
    if isinstance(value, list):
        return f"[{', '.join(_describe_value(one, form) for one in value)}]"
    return format(value, form) if isinstance(value, float) else str(value)


def _made_by(calibration: CalibrationResult, verification: VerificationRecord | None) -> str:
    """Say which calibration this is, when it was made and last verified, and by which version."""
    made = calibration.provenance.get("created_utc")
    date = made if isinstance(made, str) else "at an unknown time"
    verified = "not verified"
    if verification is not None:
        verified = "last verified" if verification.passed else "VERIFICATION FAILED"
        verified += f" {verification.to_dict()['created_utc']}"
    marks = "".join(f"{mark} " for mark in marks_of(calibration))
    return f"{marks}ftdrive calibration {calibration.id}, made {date}, {verified}; made by ftdrive {__version__}"


def _with_header(text: str, comment: Comment, lines: Iterable[str]) -> str:
    """Add comment lines, reduced to printable ASCII."""
    clean = [plain(line) for line in lines]
    if comment == "none":
        return text
    if comment == "<!-- -->":
        inside = "\n".join(f"  {line.replace('--', '- -')}" for line in clean)
        return f"<!--\n{inside}\n-->\n{text}"
    head = "".join(f"# {line}\n" for line in clean)
    return text + head if comment == "# at the end" else head + text
