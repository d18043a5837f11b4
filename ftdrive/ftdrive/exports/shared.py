"""What several targets share: what they need beside the calibration, numbers, YAML and header, frames and gravity."""

import re
import warnings
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from ftcalib import CalibrationResult
from ftcalib.after.weighing import true_tool
from ftcalib.files import JSON
from ftcalib.model import Array
from ftdrive.checks.arm import flange_load
from ftdrive.errors import ConfigError
from ftdrive.live.samples import sensor_origin_m
from ftdrive.runs.run import Run, is_run
from ftdrive.runs.verification import VerificationRecord

_SPELLED = str.maketrans({"°": " deg", "·": " ", "±": "+/-", "×": "x", "–": "-", "µ": "u", "²": "2"})


# Also inside a comment of XML, where `--` is an error.
_NAME = re.compile(r"[A-Za-z_](-?[A-Za-z0-9_./])*")
# ur_description/urdf/ur_macro.xacro, joint base_link-base_fixed_joint: 180° about z.
# ROS users have base_link; without the turn a tilt would be wrong without a message.
_R_BASE_LINK_BASE = np.diag([-1.0, -1.0, 1.0])
# ur_description/urdf/ur_macro.xacro, joint flange-tool0: rpy = (π/2, 0, π/2). x of `flange` points out.
_R_FLANGE_TOOL0 = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])


@dataclass(frozen=True, slots=True)
class Settings:
    """Names and measured values; None where not measured. Raises `ConfigError` for a name that files cannot take."""

    base_frame: str = "base"
    """The controller's base, or the `base_link` of a UR in ROS, with any prefix."""
    flange_frame: str = "tool0"
    """With z out of the flange, or the `flange` of ROS-Industrial with x out, with any prefix."""
    sensor_frame: str = "ft_sensor"
    """Also the name of the sensor, where a target has one."""
    tool_frame: str = "tool"
    height_mm: float | None = None
    """Height of the sensor's origin above the flange face."""
    sensor_mass_kg: float | None = None
    """Mass of sensor and adapter."""
    sensor_com_mm: tuple[float, ...] | None = None
    """Centre of mass of sensor and adapter, from the flange, in flange axes; None: half way up on the flange axis."""
    verification: VerificationRecord | None = None
    """The last one of the calibration; None if there is none."""

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

    @property
    def R_frame_base(self) -> Array:
        """Orientation (3, 3) of the controller's base in `base_frame`."""
        return _R_BASE_LINK_BASE if self.base_frame.endswith("base_link") else np.eye(3)

    @property
    def base_axes(self) -> str:
        """The axes that `base_frame` must have, in words."""
        turned = ", turned by 180° about z" if self.base_frame.endswith("base_link") else ""
        return f"the base of the controller{turned}"

    @property
    def R_frame_flange(self) -> Array:
        """Orientation (3, 3) of the flange, z out, in `flange_frame`."""
        return _R_FLANGE_TOOL0 if self.flange_frame.endswith("flange") else np.eye(3)

    def p_frame_sensor_m(self, target: str) -> Array:
        """Return the sensor's origin (3,) in `flange_frame`, m; raises `ConfigError` if it was not measured."""
        return self.R_frame_flange @ self.p_flange_sensor_m(target)

    def p_flange_sensor_m(self, target: str) -> Array:
        """Return the sensor's origin (3,) in the flange, m; raises `ConfigError` if it was not measured."""
        if self.height_mm is None:
            raise ConfigError(
                f"{target} needs the height of the sensor's origin above the flange face, which gravity cannot show: "
                "give --height MM, or set [sensor] height_mm before the next calibration"
            )
        return sensor_origin_m(self.height_mm)

    def payload(self, target: str, calibration: CalibrationResult) -> tuple[float, Array]:
        """Return mass (kg) and centre of mass (3,) (m, flange axes) of all that the flange carries.

        Raises
        ------
        ConfigError
            Height or mass of the sensor was not measured.
        """
        height_m = float(self.p_flange_sensor_m(target)[2])
        if self.sensor_mass_kg is None:
            raise ConfigError(
                f"{target} needs the mass of sensor and adapter, because the sensor cannot weigh itself: give "
                "--sensor-mass KG from scale or datasheet (0 for a sensor inside the arm)"
            )
        sensor_com_m = None if self.sensor_com_mm is None else np.array(self.sensor_com_mm) / 1e3
        load = flange_load(calibration, self.sensor_mass_kg, height_m, sensor_com_m)
        return load.mass_kg, load.p_flange_com_m

    @property
    def assumed(self) -> str:
        """Note about the centre of mass of the sensor; empty if it was measured."""
        if not self.sensor_mass_kg or self.sensor_com_mm is not None:
            return ""
        return (
            f"The centre of mass of sensor and adapter ({self.sensor_mass_kg:g} kg) is taken half way up, on the axis "
            "of the flange, as `ftdrive push` does: give --sensor-com X,Y,Z if you know it."
        )


def plain(text: str) -> str:
    """Reduce a text to printable ASCII without quotes and backslashes, because URScript strings have no escapes."""
    return "".join(c if " " <= c <= "~" and c not in "\"'\\" else "?" for c in text.translate(_SPELLED))


@dataclass(frozen=True, slots=True)
class Exported:
    """The text of one target, and what must be known with it."""

    text: str
    notes: tuple[str, ...] = ()
    """What the user of the target must know; sentences."""
    elsewhere: Mapping[str, JSON] = field(default_factory=dict)
    """What the target reads from another place, by its name there."""
    max_force_error_N: float = 0.0
    """Largest difference to `CalibrationResult.compensate` of a free tool over all orientations."""
    max_torque_error_Nm: float = 0.0


def numbers(values: ArrayLike) -> list[float]:
    """Return plain floats without a negative zero."""
    return [float(value) + 0.0 for value in np.ravel(values)]


def yaml_text(document: Mapping[str, Any] | list[float]) -> str:
    """Return YAML that keeps every bit of a float and the order of the keys."""
    # YAML 1.1 reads 1e-05 as a text and yes as true; PyYAML quotes what must be quoted.
    return yaml.safe_dump(document, sort_keys=False, default_flow_style=None, width=10**6)


def gravity_m_s2(calibration: CalibrationResult) -> Array:
    """Return gravity (3,) in axes of the controller's base, pointing down, m/s²; along -z if nothing hangs."""
    if calibration.mass_kg == 0.0:
        return np.array([0.0, 0.0, -calibration.g_m_s2])
    return calibration.gravity_force_base_N / calibration.mass_kg


def R_frame_sensor(calibration: CalibrationResult, settings: Settings) -> Array:
    """Return the orientation (3, 3) of the sensor in the frame `settings.flange_frame`."""
    return settings.R_frame_flange @ calibration.R_flange_sensor


def rpy_rad(R: Array) -> list[float]:
    """Return a rotation as URDF has it: roll, pitch, yaw with R = Rz(yaw) Ry(pitch) Rx(roll)."""
    with warnings.catch_warnings():
        # At a pitch of 90 degrees roll is set to zero.
        warnings.simplefilter("ignore")
        return numbers(Rotation.from_matrix(R).as_euler("xyz"))


def quaternion_xyzw(R: Array) -> list[float]:
    """Return a rotation as a quaternion, scalar last and not negative."""
    return numbers(Rotation.from_matrix(R).as_quat(canonical=True))


def inertia_kg_m2(calibration: CalibrationResult) -> Array | None:
    """Return the inertia (3, 3) about the centre of mass, sensor axes; None if motion did not identify one of a body.

    A body has positive moments, none larger than the sum of the others.
    """
    if calibration.motion is None:
        return None
    J = calibration.motion.inertia_kg_m2
    low, middle, high = np.linalg.eigvalsh(J)
    return J if low > 0 and high <= low + middle else None


def payload_inertia_kg_m2(calibration: CalibrationResult, settings: Settings, target: str) -> Array | None:
    """Return the inertia (3, 3) of all that the flange carries, about its centre of mass, flange axes; None as above.

    The sensor itself counts as a point at its centre of mass.
    """
    J = inertia_kg_m2(calibration)
    if J is None:
        return None
    mass_kg, p_flange_com_m = settings.payload(target, calibration)
    Q, (tool_kg, p_sensor_com_m) = calibration.R_flange_sensor, true_tool(calibration)
    tool_m = settings.p_flange_sensor_m(target) + Q @ p_sensor_com_m - p_flange_com_m
    total, sensor_kg = Q @ J @ Q.T + tool_kg * _steiner(tool_m), mass_kg - tool_kg
    if sensor_kg > 0:
        total += sensor_kg * _steiner(-tool_kg / sensor_kg * tool_m)
    return np.asarray(total)


def inertia_note(calibration: CalibrationResult) -> str:
    """Say whether the inertia was identified."""
    motion = calibration.motion
    if motion is None or inertia_kg_m2(calibration) is None:
        why = "" if motion is None else " well enough"
        return f"The inertia was not identified{why}: zeros stand for a point mass. Take the values of a CAD model."
    sigma = 1e3 * float(np.sqrt(np.diag(motion.covariance)[15:21].max()))
    return f"The inertia was identified from motion, with a sigma of {sigma:.2g} g·m2 at most."


def _steiner(p_m: Array) -> Array:
    """Inertia per mass (3, 3) of a point about the origin."""
    return np.asarray(p_m @ p_m * np.eye(3) - np.outer(p_m, p_m))


def recorded_sensor(path: Path, calibration: CalibrationResult) -> tuple[float | None, float | None]:
    """Return height (mm) and mass (kg) of the sensor as configured at the calibration; None where unknown.

    Parameters
    ----------
    path : Path
        A calibration file or its run folder.
    calibration : CalibrationResult
        Read from there.
    """
    folder = path if path.is_dir() else path.resolve().parent
    if path.is_dir() or (folder.name == calibration.provenance.get("run") and is_run(folder)):
        sensor = Run(folder).header().get("config", {}).get("sensor", {})
        return sensor.get("height_mm"), sensor.get("mass_kg")
    setup: Any = calibration.provenance.get("setup")
    mass = setup.get("sensor_mass_kg") if isinstance(setup, dict) else None
    return None, float(mass) if isinstance(mass, int | float) else None
