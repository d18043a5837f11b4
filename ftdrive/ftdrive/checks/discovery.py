"""Discovery of sensors on ports and buses; devices are only read."""

from pathlib import Path

from serial.tools import list_ports

from ftdrive.checks.check import Check
from ftdrive.checks.computer import can_details, can_interfaces, check_can_interface, check_serial_port, name_by_id
from ftdrive.errors import ConfigError
from ftdrivers.clock import REAL, Clock
from ftdrivers.errors import ConnectError
from ftdrivers.probe import Answer, probe_can, probe_serial
from ftdrivers.registry import Options, split_url

_CAN = ("socketcan", "slcan")
_SLCAN = "slcan:///dev/ttyACM0?bitrate=250000"


def is_place(text: str) -> bool:
    """Return whether a text names a port or bus to probe, not the address of a sensor."""
    return "://" not in text or text.startswith(tuple(f"{interface}://" for interface in _CAN))


def sensor_at(place: str, clock: Clock = REAL) -> str:
    """Return the address of the only sensor on a port or bus; raises `UsageError` unless exactly one answers."""
    answers = probe_place(place, clock)
    urls = [answer.url for answer in answers if answer.url]
    if len(urls) == 1:
        return urls[0]
    if urls:
        raise ConfigError(f"{len(urls)} sensors answer on {place}: give the address of one, {' or '.join(urls)}")
    why = "; ".join(answer.what for answer in answers)
    usual = "check its power supply and bit rate, or give its address (forms: docs/reference/sensors.md)"
    raise ConfigError(f"no known sensor answers on {place}: {why or usual}")


def probe_place(place: str, clock: Clock = REAL) -> list[Answer]:
    """Return the known sensors that answer on a port or bus; they are only read.

    `place` is a serial port; a CAN interface of the kernel, ``can0`` or ``socketcan://can0?base=0x7F``; or a CAN
    adapter on a serial port with the bit rate of its bus, ``slcan:///dev/ttyACM0?bitrate=250000``. Raises `UsageError`
    for another form, and `ConnectError` if the port or interface does not exist, is down, or is not accessible.
    """
    if "://" in place:
        return _ask_can(place, clock)
    if "/" in place or place.upper().startswith("COM"):
        _must_pass(check_serial_port(Path(place)))
        answer = probe_serial(place, clock)
        return [] if answer is None else [answer]
    return _ask_can(f"socketcan://{place}", clock)


def _ask_can(url: str, clock: Clock) -> list[Answer]:
    parts = split_url(url)
    interface, channel, options = parts.scheme, parts.address, Options(url, parts.query)
    if interface not in _CAN or not channel:
        raise ConfigError(f"{url} cannot be probed: give a serial port, can0, or {_SLCAN}")
    bitrate = options.integer("bitrate", 0, 0, 1_000_000) or None
    base = options.integer("base", 0x20, 0, 0x7F)
    options.reject_others()
    if interface == "socketcan":
        details = can_details(channel)
        bitrate = bitrate or details.get("bitrate")
        _must_pass([check_can_interface(channel, bitrate or 250_000, details)])
    elif bitrate is None:
        raise ConfigError(f"{url} has no bit rate: add it, as in {_SLCAN}; a wrong bit rate disturbs the bus")
    else:
        _must_pass(check_serial_port(Path(channel.split("@")[0])))
    return probe_can(channel, interface=interface, bitrate=bitrate, base=base, clock=clock)


def _must_pass(checks: list[Check]) -> None:
    for check in checks:
        if check.state == "failed":
            raise ConnectError(check.found, check.fix or "")


def places() -> list[str]:
    """Return the CAN interfaces of the kernel and the USB serial ports by permanent name, which can be probed."""
    ports = sorted(port.device for port in list_ports.comports() if port.vid is not None)
    return can_interfaces() + [str(name_by_id(Path(port)) or port) for port in ports]
