"""What answers at an address, and where a sensor may be. Robots and sensors are read, never changed or moved."""

import os
from contextlib import closing

from serial.tools import list_ports

from drivers.probe import probe
from drivers.ur.kinematics import model_named
from drivers.ur.library import ask_dashboard
from drivers.ur.reading import CONNECT_S, Reader
from ftdrive.checks import DEV, can_details, can_interfaces
from ftdrive.config import CellConfig, RobotConfig, SensorConfig
from ftdrive.errors import ConfigError
from ftdrive.wiring import build_sensor

_LOOK_S = 0.5


def look_at_robot(host: str, model: str | None) -> tuple[str, str]:
    """Model of the arm at an address, and in words what it says of itself; raises `DriverError`."""
    with closing(Reader(host, None if model is None else model_named(model, 0))) as reader:
        info, version = reader.info, reader.version
    told = f"{info.model}, serial {info.serial}, PolyScope {info.firmware}"
    if version[:2] >= (5, 6):  # older ones do not tell
        remote = ask_dashboard(host, lambda dashboard: dashboard.isInRemoteControl(), timeout_s=CONNECT_S)
        told += f", remote control {'ON' if remote else 'OFF'}"
    return info.model, told


def look_at_sensor(url: str) -> str:
    """Say in words what the sensor at an address is and how fast it streams; raises `DriverError` or `ConfigError`."""
    with build_sensor(CellConfig(RobotConfig(""), SensorConfig(url))) as sensor:
        info = sensor.identify()
        rate_Hz = len(sensor.collect(_LOOK_S).t_host_ns) / _LOOK_S
    return f"{info.model}, serial {info.serial}, firmware {info.firmware}, {rate_Hz:.0f} Hz"


def sensor_at(port: str) -> str:
    """Ask a serial port that the user named which known sensor is there; raises `ConfigError` if none answers."""
    answer = probe(port)
    if answer is None:
        raise ConfigError(
            f"no known sensor answers on {port}: is it powered? Or give its address, as drivers/README has it"
        )
    return answer.url


def places() -> list[str]:
    """List where a sensor may be: CAN interfaces with the sensors known there, and serial ports on USB by id."""
    found = []
    for name in can_interfaces():
        bitrate = can_details(name).get("bitrate")
        found += [f"ati-can://{name}" + (f"?bitrate={bitrate}" if bitrate else ""), f"robotous-can://{name}"]
    by_id = DEV / "serial" / "by-id"
    links = {os.path.realpath(link): str(link) for link in by_id.iterdir()} if by_id.is_dir() else {}
    ports = sorted(port.device for port in list_ports.comports() if port.vid is not None)
    return found + [links.get(os.path.realpath(port), port) for port in ports]
