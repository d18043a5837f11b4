"""Exports a calibration in the formats of `formats.py` or as complete JSON or YAML, with the error of the target."""

import json
import re
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from math import degrees
from pathlib import Path
from typing import Any, Final

import numpy as np
import yaml
from scipy.spatial.transform import Rotation

from ftcalib import CalibrationResult
from ftcalib.after.weighing import true_tool
from ftcalib.compensation import Compensator
from ftcalib.files import JSON
from ftcalib.model import Array, angle_between, angle_between_vectors, nearest_rotation, skew
from ftdrive import __version__
from ftdrive.checks.arm import FlangeLoad, flange_load
from ftdrive.errors import ConfigError, NotAccepted
from ftdrive.exports.formats import FORMATS, MAX_FORCE_ERROR_N, MC_RTC_G_M_S2, Comment, ExportFormat, plain_ascii
from ftdrive.runs import is_run
from ftdrive.runs.calibration import MARKS, marks_of
from ftdrive.runs.run import Run
from ftdrive.runs.verification import VerificationRecord
from ftdrive.stream.samples import sensor_origin_m

FORMAT = "ftdrive.export/1"

# Fields of the complete export with the same names and definitions as in calibration.json.
_FIELDS = (
    *("mass_kg", "g_m_s2", "weight_N", "gravity_force_base_N"),
    *("R_flange_sensor", "p_sensor_com_m", "force_bias_N", "torque_bias_Nm"),
)


# Valid names of frames; `--` is excluded, because it is an error in an XML comment.
_NAME = re.compile(r"[A-Za-z_](-?[A-Za-z0-9_./])*")
# From ur_description/urdf/ur_macro.xacro, joint base_link-base_fixed_joint: 180° about z. ROS users have base_link;
# without this rotation a tilt would be wrong without a message.
_R_BASE_LINK_BASE = np.diag([-1.0, -1.0, 1.0])
# From ur_description/urdf/ur_macro.xacro, joint flange-tool0: rpy = (π/2, 0, π/2). x of `flange` points out.
_R_FLANGE_TOOL0 = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])


@dataclass(frozen=True, slots=True)
class Settings:
    """Names of frames, and values that a calibration lacks. Raises `ConfigError` for invalid or equal names."""

    base_frame: str = "base"
    """Name of the base frame, with any prefix: `base` is that of the controller, `base_link` that of a UR in ROS."""
    flange_frame: str = "tool0"
    """Name of the flange frame, with any prefix: `tool0` has z out of the flange, `flange` of ROS-Industrial x."""
    sensor_frame: str = "ft_sensor"
    """Name of the sensor's frame, and of the sensor itself."""
    tool_frame: str = "tool"
    height_mm: float | None = None
    """Height of the sensor's origin above the flange face, mm; None if unknown."""
    sensor_mass_kg: float | None = None
    """Mass of sensor and adapter, kg; None if unknown."""
    sensor_com_mm: tuple[float, ...] | None = None
    """Centre of mass of sensor and adapter, mm, flange axes; None means that it is taken as halfway up the sensor."""
    verification: VerificationRecord | None = None
    """Last verification of the calibration; None if it was not verified."""

    def __post_init__(self) -> None:
        for field_name in ("base_frame", "flange_frame", "sensor_frame", "tool_frame"):
            if not _NAME.fullmatch(name := getattr(self, field_name)):
                option = field_name.replace("_", "-")
                raise ConfigError(
                    f"--{option} is {name!r}: use letters, digits and _ . / -, a letter or _ first, no --"
                )
        frames = self.flange_frame, self.sensor_frame, self.tool_frame
        if len(set(frames)) < len(frames):
            raise ConfigError(f"the frames of flange, sensor and tool are {', '.join(frames)}: give each its own name")


def recorded_sensor(path: Path, calibration: CalibrationResult) -> tuple[float | None, float | None]:
    """Return the sensor's height, mm, and mass, kg, in the configuration of the calibration's run; None if unknown."""
    folder = path if path.is_dir() else path.resolve().parent
    if path.is_dir() or (folder.name == calibration.provenance.get("run") and is_run(folder)):
        sensor = Run(folder).header().get("config", {}).get("sensor", {})
        return sensor.get("height_mm"), sensor.get("mass_kg")
    setup: Any = calibration.provenance.get("setup")
    mass = setup.get("sensor_mass_kg") if isinstance(setup, dict) else None
    return None, float(mass) if isinstance(mass, int | float) else None


def _yaml(document: Any) -> str:
    # PyYAML writes numbers and texts as YAML 1.1 needs them, which reads 1e-05 as a text and yes as true.
    return yaml.safe_dump(document, sort_keys=False, default_flow_style=None, width=10**6)


@dataclass(frozen=True, slots=True)
class _Values:
    """The values that formats name: from `_VALUES`, the calibration or the settings, in the unit that the name states.

    Raises `ConfigError` for a value that is needed but was not measured.
    """

    target: str
    calibration: CalibrationResult
    settings: Settings

    def __getitem__(self, name: str) -> Any:
        base, _, form = name.rpartition("_")
        if name in _VALUES:
            value = _VALUES[name](self)
        elif form in _FORMS:
            value = _FORMS[form](self[base])
        elif name.startswith("minus_"):
            value = -np.array(self[name.removeprefix("minus_")])
        else:
            value = getattr(self.calibration if hasattr(self.calibration, name) else self.settings, name)
        # adding 0.0 turns negative zeros into zeros
        return (np.ravel(value) + 0.0).tolist() if isinstance(value, np.ndarray) else value

    def filled(self, node: Any) -> Any:
        """Return a part of a format's document in which values replace "$name" and "*name"."""
        if isinstance(node, Mapping):
            return {key: self.filled(value) for key, value in node.items()}
        if isinstance(node, list):
            return [each for one in node for each in (self[one[1:]] if "*" in str(one) else [self.filled(one)])]
        return self[node[1:]] if isinstance(node, str) and node.startswith("$") else node

    @property
    def is_turned(self) -> bool:
        """Whether the base frame is `base_link` of ROS, which is turned by 180° from the controller's base."""
        return self.settings.base_frame.endswith("base_link")

    @property
    def R_frame_flange(self) -> Array:
        """Orientation (3, 3) of the flange axes (z out) in the frame `flange_frame`, whose x may point out instead."""
        return _R_FLANGE_TOOL0 if self.settings.flange_frame.endswith("flange") else np.eye(3)

    @property
    def R_frame_sensor(self) -> Array:
        """Orientation (3, 3) of the sensor in the frame `flange_frame`."""
        return self.R_frame_flange @ self.calibration.R_flange_sensor

    @property
    def gravity_base_m_s2(self) -> Array:
        """Gravity (3,), m/s², in axes of the controller's base; for a tool without mass, it is taken along -z."""
        if self.calibration.mass_kg == 0.0:
            return np.array([0.0, 0.0, -self.calibration.g_m_s2])
        return self.calibration.gravity_force_base_N / self.calibration.mass_kg

    @property
    def p_flange_sensor_m(self) -> Array:
        """Position (3,) of the sensor's origin, m, flange axes. Raises `ConfigError` if its height is unknown."""
        if self.settings.height_mm is None:
            raise ConfigError(
                f"{self.target} needs the height of the sensor's origin above the flange face, which gravity does not "
                "determine: give --height MM, or set [sensor] height_mm before the next calibration"
            )
        return sensor_origin_m(self.settings.height_mm)

    @property
    def payload(self) -> FlangeLoad:
        """Mass and centre of mass of everything that the flange carries: sensor, adapter and tool."""
        height_m = float(self.p_flange_sensor_m[2])
        if self.settings.sensor_mass_kg is None:
            raise ConfigError(
                f"{self.target} needs the mass of sensor and adapter, because the sensor cannot weigh itself: give "
                "--sensor-mass KG from a scale or data sheet (0 for a sensor inside the arm)"
            )
        com_mm = self.settings.sensor_com_mm
        sensor_com_m = None if com_mm is None else np.array(com_mm) / 1e3
        return flange_load(self.calibration, self.settings.sensor_mass_kg, height_m, sensor_com_m)

    @property
    def inertia_kg_m2(self) -> Array | None:
        """Inertia (3, 3) of the tool about its centre of mass, sensor axes; None if unknown or of no possible body."""
        if self.calibration.motion is None:
            return None
        J = self.calibration.motion.inertia_kg_m2
        # principal moments of a rigid body are positive, and none is larger than the sum of the other two
        low, middle, high = np.linalg.eigvalsh(J)
        return J if low > 0 and high <= low + middle else None


def _rpy_rad(v: _Values) -> Array:
    """Return the sensor's roll, pitch and yaw as in URDF: R = Rz(yaw) Ry(pitch) Rx(roll)."""
    with warnings.catch_warnings():
        # SciPy warns at a pitch of 90 degrees, where it sets one of the other angles to zero
        warnings.simplefilter("ignore")
        return Rotation.from_matrix(v.R_frame_sensor).as_euler("xyz")


def _quaternion(v: _Values) -> Array:
    """Return the sensor's orientation in `flange_frame` as a quaternion, with the scalar last and not negative."""
    return Rotation.from_matrix(v.R_frame_sensor).as_quat(canonical=True)


def _payload_inertia(v: _Values) -> str:
    """Return the inertia of the whole payload about its centre of mass, flange axes; the sensor counts as a point."""
    if (J := v.inertia_kg_m2) is None:
        return "0, 0, 0, 0, 0, 0"
    payload, Q, (tool_kg, p_sensor_com_m) = v.payload, v.calibration.R_flange_sensor, true_tool(v.calibration)
    tool_m = v.p_flange_sensor_m + Q @ p_sensor_com_m - payload.p_flange_com_m
    sensor_kg = payload.mass_kg - tool_kg
    # add the moments of two point masses, sensor and tool, about their common centre
    reduced_kg = tool_kg + (tool_kg**2 / sensor_kg if sensor_kg > 0 else 0.0)
    total = Q @ J @ Q.T + reduced_kg * (tool_m @ tool_m * np.eye(3) - np.outer(tool_m, tool_m))
    return str(_FORMS["fixed"](total[_DIAGONAL_FIRST]))


def _inertia_note(v: _Values) -> str:
    motion = v.calibration.motion
    if motion is None or v.inertia_kg_m2 is None:
        why = "" if motion is None else " well enough"
        return f"The inertia was not identified{why}: zeros stand for a point mass. Use the values from a CAD model."
    sigma = 1e3 * float(np.sqrt(np.diag(motion.covariance)[15:21].max()))
    return f"The inertia was identified from motion, with a sigma of {sigma:.2g} g·m2 at most."


def _point_mass(v: _Values, what: str) -> str:
    if v.inertia_kg_m2 is not None:
        return ""
    return f"<!-- {what}not identified: zeros stand for a point mass; put values of the CAD model here -->\n      "


def _assumption_note(v: _Values) -> str:
    if not v.settings.sensor_mass_kg or v.settings.sensor_com_mm is not None:
        return ""
    return (
        f"The centre of mass of sensor and adapter ({v.settings.sensor_mass_kg:g} kg) is assumed to be halfway up, on "
        "the flange axis, as `ftdrive push` does: give --sensor-com X,Y,Z if you know it."
    )


_DIAGONAL_FIRST: Final = [0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]
# Suffixes of the names in formats, with the form that each gives to the value.
_FORMS: Mapping[str, Callable[[Any], Any]] = {
    "xyz": lambda value: dict(zip("xyz", value, strict=True)),  # as vectors in ROS messages
    "words": lambda value: ", ".join(map(str, value)),
    "spaced": lambda value: " ".join(map(repr, value)),
    "fixed": lambda value: ", ".join(f"{one:.12f}" for one in value),  # URScript documents no exponents
    "yaml": lambda value: _yaml(value).removesuffix("\n").removesuffix("\n..."),
}
_VALUES: Mapping[str, Callable[[_Values], Any]] = {
    "base_axes": lambda v: "the base of the controller" + ", turned by 180° about z" * v.is_turned,
    "mc_rtc_mass_kg": lambda v: v.calibration.weight_N / MC_RTC_G_M_S2,
    "com_mm": lambda v: 1e3 * v.calibration.p_sensor_com_m,
    "gravity_m_s2": lambda v: (_R_BASE_LINK_BASE if v.is_turned else np.eye(3)) @ v.gravity_base_m_s2,
    "gravity_base_m_s2": lambda v: v.gravity_base_m_s2,
    "gravity_direction": lambda v: v.gravity_base_m_s2 / np.linalg.norm(v.gravity_base_m_s2),
    "rpy_rad": _rpy_rad,
    "quaternion": _quaternion,
    "quaternion_wxyz": lambda v: np.roll(_quaternion(v), 1),
    "origin_m": lambda v: v.R_frame_flange @ v.p_flange_sensor_m,
    "frame_com_m": lambda v: v.R_frame_flange @ v.p_flange_sensor_m + v.R_frame_sensor @ v.calibration.p_sensor_com_m,
    "payload_kg": lambda v: v.payload.mass_kg,
    "payload_com_m": lambda v: v.payload.p_flange_com_m,
    "payload_inertia": _payload_inertia,
    "assumed": _assumption_note,
    "true_kg": lambda v: true_tool(v.calibration)[0],
    "true_com_m": lambda v: true_tool(v.calibration)[1],
    "J": lambda v: np.zeros(9) if (J := v.inertia_kg_m2) is None else J,
    "inertia_note": _inertia_note,
    "urdf_point_mass": lambda v: _point_mass(v, ""),
    "mujoco_point_mass": lambda v: _point_mass(v, "inertia "),
    "mujoco_inertia": lambda v: (
        'diaginertia="0 0 0"'
        if (J := v.inertia_kg_m2) is None
        else f'fullinertia="{_FORMS["spaced"](J[_DIAGONAL_FIRST].tolist())}"'
    ),
}


@dataclass(frozen=True, slots=True)
class Exported:
    """A calibration exported for one target: the text of its file, and what the user of the target must know."""

    text: str
    notes: tuple[str, ...]
    """Sentences about what the user of the target must know."""
    elsewhere: Mapping[str, JSON]
    """Values that the user must set in another place of the target, by their names there."""
    max_force_error_N: float
    """Largest difference, N, of the target's compensation from that of ftdrive, for a free tool in any orientation."""
    max_torque_error_Nm: float


def _compensation_document(calibration: CalibrationResult, settings: Settings) -> dict[str, JSON]:
    """Return the complete export: everything that the user's own program needs for the compensation.

    With u = R_flange_sensor^T R_base_flange^T gravity_force_base_N, the weight in the sensor frame, and zeros without
    `response`:

        force = raw - force_bias_N - u - force_gain u
        torque = raw - torque_bias_Nm - p_sensor_com_m x u - cross_talk_m u
        contact = decoder (force, torque)

    `decoder` (6 x 6) is null if no error of the sensor matrix is known. Then the contact is (force, torque).
    """
    result = calibration.to_dict()
    response, decoder = calibration.response, calibration.contact.decoder
    origin_m = None if settings.height_mm is None else sensor_origin_m(settings.height_mm).tolist()
    made, last = calibration.provenance.get("created_utc"), settings.verification
    return {
        "format": FORMAT,
        "id": calibration.id,
        "marks": list(marks_of(calibration)),
        "created_utc": made if isinstance(made, str) else None,
        "verification": None if last is None else last.to_dict(("created_utc", "passed", "change")),
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
# The search in `_largest_norm` has converged if no norm increases by more than this fraction in a step.
_CONVERGED = 1e-12


def _compensations(calibration: CalibrationResult, target: ExportFormat) -> tuple[Compensator, Compensator]:
    """Return the compensators of ftdrive and of the target, which can express only what `target.expresses` lists.

    Without tilt, gravity points along -z of the base. Without rotation, the sensor axes equal the flange axes. If the
    target reads another sensor or none, the response of this sensor is left out of both.
    """
    parameters = calibration.parameters
    response = None if target.has_own_reading else calibration.response
    ours = Compensator(parameters, response=response)
    if "tilt" not in target.expresses:
        parameters = replace(parameters, gravity_force_base_N=np.array([0.0, 0.0, -calibration.weight_N]))
    if "rotation" not in target.expresses:
        parameters = replace(parameters, R_flange_sensor=np.eye(3))
    return ours, Compensator(parameters, response=response if "response" in target.expresses else None)


def _largest_norm(matrix: Array, offset: Array) -> float:
    """Return the maximum of |matrix @ vec(R) + offset| over rotations R.

    Its square is convex in R, so a step to the rotation that maximises its linearisation never decreases it. Steps from
    the 60 rotations of the icosahedron reach every maximum.
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


def export_calibration(
    calibration: CalibrationResult, name: str, settings: Settings, *, max_force_error_N: float = MAX_FORCE_ERROR_N
) -> Exported:
    """Return a calibration as a text for the target with this name in `FORMATS`.

    In any orientation, the target may differ from `CalibrationResult.compensate` by up to `max_force_error_N`. Raises
    `ConfigError` if a value was not measured, and `NotAccepted` if the calibration is rejected or the target differs by
    more.
    """
    if calibration.verdict == "rejected":
        raise NotAccepted(
            f"the calibration is rejected and not exported: {'; '.join(calibration.reasons)}. Calibrate again"
        )
    target, values = FORMATS[name], _Values(name, calibration, settings)
    if isinstance(target.content, str):
        text = target.content.format_map(values)
    elif name == "json":
        text = json.dumps(_compensation_document(calibration, settings), indent=1, allow_nan=False) + "\n"
    else:
        text = _yaml(values.filled(target.content) or _compensation_document(calibration, settings))
    notes = [MARKS[mark] for mark in marks_of(calibration)]
    force_N, torque_Nm = 0.0, 0.0
    if target.subtracts:
        ours, theirs = _compensations(calibration, target)
        matrix, offset = theirs.matrix - ours.matrix, theirs.offset - ours.offset
        force_N, torque_Nm = _largest_norm(matrix[:3], offset[:3]), _largest_norm(matrix[3:], offset[3:])
        if lost := list(_lost(calibration, target)):
            words = (
                f"{name} cannot express {' and '.join(lost)}: its reading of a free tool differs from that of ftdrive "
                f"by up to {force_N:.3g} N and {torque_Nm:.3g} N·m"
            )
            if force_N > max_force_error_N:
                raise NotAccepted(
                    f"{words}, and the limit is {max_force_error_N:g} N. Choose another format "
                    f"({', '.join(_lossless_formats(calibration, target))}), or accept the "
                    f"error: --max-force-error {_round_up(force_N)}"
                )
            notes.append(f"{words}.")
    notes += filter(None, (note.format_map(values) for note in target.notes))
    if target.subtracts and "response" not in target.expresses:
        notes += _undecoded(name, calibration)
    elsewhere = values.filled(target.elsewhere)
    # printed notes have six digits, the header in the file has all
    shown, exact = (
        [*notes, *(f"Also set {place} = {_describe_value(value, form)}." for place, value in elsewhere.items())]
        for form in (".6g", "")
    )
    header = [_made_by(calibration, settings.verification), target.description, *exact]
    return Exported(_with_header(text, target.comment, header), tuple(shown), elsewhere, force_N, torque_Nm)


def _round_up(value: float) -> str:
    step = 10.0 ** (np.floor(np.log10(value)) - 1)
    return f"{np.ceil(value / step) * step:.2g}"


def _lost(calibration: CalibrationResult, target: ExportFormat) -> Iterator[str]:
    tilt_rad = angle_between_vectors(np.array([0.0, 0.0, -1.0]), calibration.gravity_force_base_N)
    turn_rad = float(angle_between(calibration.R_flange_sensor, np.eye(3)))
    if "tilt" not in target.expresses and tilt_rad > 1e-9:
        yield f"the base tilt of {degrees(tilt_rad):.3g}°"
    if "rotation" not in target.expresses and turn_rad > 1e-9:
        yield f"the sensor turned by {degrees(turn_rad):.3g}° in the flange"
    if "response" not in target.expresses and calibration.response is not None:
        yield "gain and cross-talk of the sensor"


def _undecoded(name: str, calibration: CalibrationResult) -> Iterator[str]:
    """Yield a note with the largest error of a contact force, because the target cannot apply the sensor matrix."""
    if (decoder := calibration.contact.decoder) is None:
        return
    at_tool = np.concatenate([np.eye(3), skew(calibration.p_sensor_com_m)])
    error = (np.linalg.inv(decoder) - np.eye(6)) @ at_tool
    percent = 100 * np.linalg.norm(error[:3], 2)
    yield (
        f"{name} cannot decode contacts: a force at the tool's centre of mass is off by up to {percent:.2g} %. "
        "Multiply the result by the decoder of the formats json or yaml."
    )


def _lossless_formats(calibration: CalibrationResult, target: ExportFormat) -> Iterator[str]:
    """Yield formats that express the whole calibration, subtract as much, and read the sensor if the target does."""
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
    made = calibration.provenance.get("created_utc")
    date = made if isinstance(made, str) else "at an unknown time"
    verified = "not verified"
    if verification is not None:
        verified = "last verified" if verification.passed else "VERIFICATION FAILED"
        verified += f" {verification.created_utc}"
    marks = "".join(f"{mark} " for mark in marks_of(calibration))
    return f"{marks}ftdrive calibration {calibration.id}, made {date}, {verified}; made by ftdrive {__version__}"


def _with_header(text: str, comment: Comment, lines: Iterable[str]) -> str:
    clean = [plain_ascii(line) for line in lines]
    if comment == "none":
        return text
    if comment == "<!-- -->":
        inside = "\n".join(f"  {line.replace('--', '- -')}" for line in clean)
        return f"<!--\n{inside}\n-->\n{text}"
    head = "".join(f"# {line}\n" for line in clean)
    return text + head if comment == "# at the end" else head + text
