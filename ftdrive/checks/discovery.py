"""What answers at an address, and where a sensor may be. Robots and sensors are read, never changed or moved."""

from contextlib import closing
from pathlib import Path

from serial.tools import list_ports

from drivers.clock import REAL, Clock
from drivers.errors import ConnectError
from drivers.probe.can_bus import probe_can
from drivers.probe.serial_line import Answer, probe
from drivers.registry import Options, split_url
from ftdrive.cell.config import CellConfig, RobotConfig, SensorConfig
from ftdrive.cell.devices import build_arm, build_sensor
from ftdrive.checks.check import Check
from ftdrive.checks.computer import (
    can_details,
    can_interfaces,
    check_can_interface,
    check_serial_port,
    name_by_id,
)
from ftdrive.checks.devices import who
from ftdrive.errors import ConfigError

_LOOK_S = 0.5
_CAN = ("socketcan", "slcan")
_SLCAN = "slcan:///dev/ttyACM0?bitrate=250000"


def look_at_robot(host: str, model: str | None, clock: Clock = REAL) -> tuple[str, str]:
    """Model of the arm at an address, and in words what it says of itself; raises `DriverError`."""
    with closing(build_arm(CellConfig(RobotConfig(host, model), SensorConfig(""), clock=clock))) as arm:
        arm.open()
        info, remote = arm.identify(), arm.in_remote_control()
    told = who(info)
    return info.model, told if remote is None else f"{told}, remote control {'ON' if remote else 'OFF'}"


def look_at_sensor(url: str, clock: Clock = REAL) -> str:
    """Say in words what the sensor at an address is and how fast it streams; raises `DriverError` or `ConfigError`."""
    with build_sensor(CellConfig(RobotConfig(""), SensorConfig(url), clock=clock)) as sensor:
        info = sensor.identify()
        rate_Hz = len(sensor.collect(_LOOK_S).t_host_ns) / _LOOK_S
    return f"{who(info)}, {rate_Hz:.0f} Hz"


def is_place(text: str) -> bool:
    """Tell whether this names where a sensor may be, and not yet which one is there."""
    return "://" not in text or text.startswith(tuple(f"{interface}://" for interface in _CAN))


def sensor_at(place: str) -> str:
    """Ask which known sensor is at a place that the user named; raises `ConfigError` unless there is just one."""
    answers = ask(place)
    urls = [answer.url for answer in answers if answer.url]
    if len(urls) == 1:
        return urls[0]
    if urls:
        raise ConfigError(f"{len(urls)} sensors answer on {place}: choose one, {' or '.join(urls)}")
    why = "; ".join(answer.what for answer in answers)
    usual = "is it powered, and at this bit rate? Or give its address, as drivers/README has it"
    raise ConfigError(f"no known sensor answers on {place}: {why or usual}")


def ask(place: str) -> list[Answer]:
    """Ask which known sensors are at a place that the user named; they are only read.

    Parameters
    ----------
    place : str
        A serial port; a CAN interface of the kernel, ``can0`` or ``socketcan://can0?base=0x7F``; or a CAN adapter on a
        serial port with the bit rate of its bus, ``slcan:///dev/ttyACM0?bitrate=250000``.

    Raises
    ------
    ConfigError
        The place is not written so.
    ConnectError
        It is not there, not up, or not permitted.
    """
    if "://" in place:
        return _ask_can(place)
    if "/" in place or place.upper().startswith("COM"):
        _must_pass(check_serial_port(Path(place)))
        answer = probe(place)
        return [] if answer is None else [answer]
    return _ask_can(f"socketcan://{place}")


def _ask_can(url: str) -> list[Answer]:
    try:
        parts = split_url(url)
        interface, channel, options = parts.scheme, parts.address, Options(url, parts.query)
        if interface not in _CAN or not channel:
            raise ConfigError(f"{url} is no place to ask: give a serial port, can0, or {_SLCAN}")
        bitrate = options.integer("bitrate", 0, 0, 1_000_000) or None
        base = options.integer("base", 0x20, 0, 0x7F)
        options.reject_others()
    except ValueError as error:
        raise ConfigError(str(error)) from error
    if interface == "socketcan":
        details = can_details(channel)
        bitrate = bitrate or details.get("bitrate")
        _must_pass([check_can_interface(channel, bitrate or 250_000, details)])
    elif bitrate is None:
        raise ConfigError(f"{url}: at which bit rate? A wrong one disturbs the bus; write it like {_SLCAN}")
    else:
        _must_pass(check_serial_port(Path(channel.split("@")[0])))
    return probe_can(channel, interface=interface, bitrate=bitrate, base=base)


def _must_pass(checks: list[Check]) -> None:
    for check in checks:
        if check.state == "failed":
            raise ConnectError(check.found, check.fix or "")


def places() -> list[str]:
    """List where a sensor may be: CAN interfaces of the kernel, and serial ports on USB by id."""
    ports = sorted(port.device for port in list_ports.comports() if port.vid is not None)
    return can_interfaces() + [str(name_by_id(Path(port)) or port) for port in ports]
