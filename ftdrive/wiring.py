"""The only place where configuration becomes drivers."""

from math import radians

from calib.ports import Arm, Sensor
from drivers.interfaces import ForceTorqueSensor
from drivers.registry import sensor_from_url
from drivers.ur.arm import UrArm
from ftdrive.config import CellConfig
from ftdrive.errors import ConfigError
from ftdrive.simulation import sensor_url


def build_arm(cell: CellConfig) -> UrArm:
    """Build the arm's driver, not yet open."""
    arm = UrArm(
        cell.robot.host,
        model=cell.robot.model,
        speed_rad_s=radians(cell.robot.speed_deg_s),
        acceleration_rad_s2=radians(cell.robot.acceleration_deg_s2),
    )
    _fits: Arm = arm  # checked statically: what the routine asks for is what the driver gives
    return arm


def build_sensor(cell: CellConfig) -> ForceTorqueSensor:
    """Build the sensor's driver, not yet open."""
    try:
        sensor = sensor_from_url(sensor_url(cell.sensor.url), sign=cell.sensor.sign)
    except ValueError as error:
        raise ConfigError(str(error)) from error
    _fits: Sensor = sensor
    return sensor
