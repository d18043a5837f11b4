"""Construction of drivers from the configuration; no other module does this."""

from collections.abc import Callable
from math import radians
from typing import Any, cast

from ftcalib.routine import Arm, Sensor
from ftdrive.cell.config import CellConfig
from ftdrive.cell.emulated import sensor_reached
from ftdrive.errors import ConfigError
from ftdrivers.errors import BadUrl
from ftdrivers.interfaces import ForceTorqueSensor, RobotArm
from ftdrivers.registry import arm_class, sensor_from_url
from ftdrivers.ur.rtde import ProgramRegisters
from ftdrivers.ur.timing import STRICT, UrTiming


def build_arm(cell: CellConfig) -> RobotArm:
    """Return the driver of the arm, not yet open; its default speed comes from the cell."""
    robot = cell.robot
    try:
        by_topic = robot.driver == "ur" and robot.host.startswith("ros2:")
        driver = "ros2" if by_topic else robot.driver
        build = cast("Callable[..., RobotArm]", arm_class(driver))
    except BadUrl as error:
        raise ConfigError(f"[robot] driver: {error}") from error
    # Only an emulated arm gets a clock, because a driver from another package may not accept one.
    more: dict[str, Any] = {"clock": cell.clock} if cell.is_emulated else {}
    if driver == "ur":
        timing = UrTiming.emulated() if cell.is_emulated else STRICT
        stop_rad_s2 = radians(robot.stop_deceleration_deg_s2)
        more |= {"control": robot.control, "stop_rad_s2": stop_rad_s2, "api_port": robot.api_port, "timing": timing}
    arm = build(
        robot.host,
        model=robot.model,
        speed_rad_s=radians(robot.speed_deg_s),
        acceleration_rad_s2=radians(robot.acceleration_deg_s2),
        **more,
    )
    _fits: Arm = arm  # checked statically: the driver satisfies the interface of the routine
    return arm


def build_sensor(cell: CellConfig) -> ForceTorqueSensor:
    """Return the driver of the sensor, not yet open."""
    url, clock = sensor_reached(cell.sensor.url, cell.clock)
    sensor = sensor_from_url(url, sign=cell.sensor.sign, clock=clock)
    _fits: Sensor = sensor
    return sensor


def program_registers(cell: CellConfig, first: int, integers: int, doubles: int) -> ProgramRegisters:
    """Return registers for answers to a program on the controller.

    Raises `ConfigError` if the arm has no registers, and `ConnectError` if the controller does not answer, or if
    another client or a fieldbus owns a register.
    """
    if cell.robot.driver != "ur":
        raise ConfigError(f"[robot] driver {cell.robot.driver} has no registers: serve-load needs a UR arm")
    return ProgramRegisters(cell.robot.host, first, integers, doubles, clock=cell.clock)
