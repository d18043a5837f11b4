"""The sensors of this project: driver, wire and emulators of each. It imports no driver: commands must start fast."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal


@dataclass(frozen=True, slots=True)
class SensorKind:
    """One kind of sensor: the properties that are known before its driver is imported."""

    driver: str
    """Module and class of the driver; docs/how-to/add-a-sensor.md describes what they must have."""
    wire: Literal["can", "serial", "ethernet", "topic"]
    emulated: Mapping[str, str] = field(default_factory=dict)
    """Name of each emulator of this sensor, and its description for the user."""
    bitrate: int = 250_000
    """Default bit rate of the CAN bus, bit/s."""


# Keys are schemes of addresses. A probe tries the sensors on a serial port in this order.
SENSORS: Mapping[str, SensorKind] = {
    "ati-can": SensorKind("ftdrivers.ati.can:AtiCanSensor", "can", {"can": "ATI sensor on CAN"}),
    "robotous-can": SensorKind(
        "ftdrivers.robotous.can:RobotousCan", "can", {"robotous-can": "Robotous sensor on CAN"}, bitrate=1_000_000
    ),
    "bota": SensorKind("ftdrivers.bota.sensor:BotaSensor", "serial", {"bota": "Bota sensor"}),
    "robotiq-ft300": SensorKind(
        "ftdrivers.robotiq.sensor:RobotiqFt300",
        "serial",
        {"robotiq": "Robotiq sensor", "robotiq-urcap": "Robotiq sensor on the controller"},
    ),
    "robotous-serial": SensorKind(
        "ftdrivers.robotous.sensor:RobotousSerial", "serial", {"robotous-serial": "Robotous sensor on a serial port"}
    ),
    "ati-serial": SensorKind("ftdrivers.ati.serial:AtiSerialSensor", "serial", {"serial": "ATI sensor on RS-485"}),
    "ati-netft": SensorKind("ftdrivers.ati.netft:NetFtSensor", "ethernet", {"netft": "ATI Net F/T"}),
    "ur-ft": SensorKind("ftdrivers.ur.sensor:UrWristSensor", "ethernet", {"ur-ft": "sensor of its own"}),
    "ros2": SensorKind("ftdrivers.ros2.sensor:Ros2Sensor", "topic"),
}
