"""Values that several targets need."""

import warnings

import numpy as np
from scipy.spatial.transform import Rotation

from calib import CalibrationResult
from calib.model import Array
from ftdrive.exports.calibration.settings import Settings
from ftdrive.exports.calibration.text import numbers


def gravity_m_s2(calibration: CalibrationResult) -> Array:
    """Return gravity (3,) in base axes, pointing down, m/s²; along -z if nothing hangs on the sensor."""
    if calibration.mass_kg == 0.0:
        return np.array([0.0, 0.0, -calibration.g_m_s2])
    return calibration.gravity_force_base_N / calibration.mass_kg


def rpy_rad(calibration: CalibrationResult) -> list[float]:
    """Return `R_flange_sensor` as URDF has it: roll, pitch, yaw with R = Rz(yaw) Ry(pitch) Rx(roll)."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # at a pitch of 90 degrees roll is set to zero
        return numbers(Rotation.from_matrix(calibration.R_flange_sensor).as_euler("xyz"))


def quaternion_xyzw(calibration: CalibrationResult) -> list[float]:
    """Return `R_flange_sensor` as a quaternion, scalar last and not negative."""
    return numbers(Rotation.from_matrix(calibration.R_flange_sensor).as_quat(canonical=True))


def frame_note(calibration: CalibrationResult, settings: Settings) -> str:
    """Say how the robot model must turn the sensor frame, for targets that look it up there."""
    rpy = ", ".join(f"{angle:.6g}" for angle in rpy_rad(calibration))
    return (
        f"The robot model must turn {settings.sensor_frame} against {settings.flange_frame} by roll, pitch, yaw = "
        f"({rpy}) rad: the formats urdf and static-transform write it. {settings.base_frame} must have the axes of "
        "the base of the controller, and base_link of a UR is turned by 180° about z against that."
    )
