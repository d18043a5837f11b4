"""What a target needs beside the calibration: names of frames, place and mass of the sensor."""

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ftcalib import CalibrationResult
from ftcalib.model import Array
from ftdrive.checks.flange_load import flange_load
from ftdrive.errors import ConfigError
from ftdrive.live.samples import sensor_origin_m
from ftdrive.runs.run import Run
from ftdrive.runs.verification_record import VerificationRecord

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
        for field in ("base_frame", "flange_frame", "sensor_frame", "tool_frame"):
            if not _NAME.fullmatch(name := getattr(self, field)):
                option = field.replace("_", "-")
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
    def assumed(self) -> tuple[str, ...]:
        """Note about the centre of mass of the sensor, if it was not measured."""
        if not self.sensor_mass_kg or self.sensor_com_mm is not None:
            return ()
        return (
            f"The centre of mass of sensor and adapter ({self.sensor_mass_kg:g} kg) is taken half way up, on the axis "
            "of the flange, as `ftdrive push` does: give --sensor-com X,Y,Z if you know it.",
        )


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
    if path.is_dir() or (folder.name == calibration.provenance.get("run") and (folder / "run.json").is_file()):
        sensor = Run(folder).header().get("config", {}).get("sensor", {})
        return sensor.get("height_mm"), sensor.get("mass_kg")
    setup: Any = calibration.provenance.get("setup")
    mass = setup.get("sensor_mass_kg") if isinstance(setup, dict) else None
    return None, float(mass) if isinstance(mass, int | float) else None
