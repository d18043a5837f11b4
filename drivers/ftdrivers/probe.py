"""Probe a serial port or a CAN bus for known sensors: listen first, then request their names.

Only ports and buses that the user names are probed. Only read requests are sent, in the protocols of the sensors of
`ftdrivers.sensors`; the effect of the requests on other devices is unknown.
"""

from collections.abc import Iterator, Sequence
from importlib import import_module
from types import ModuleType
from typing import Any, NamedTuple

from ftdrivers.clock import REAL, Clock
from ftdrivers.errors import ConnectError, ProtocolError, StreamBroken
from ftdrivers.registry import in_url
from ftdrivers.sensors import SENSORS
from ftdrivers.wires.can_bus import CanBus, CanFrame, CanProbe
from ftdrivers.wires.serial_port import SerialPort, SerialProbe

_LISTEN_LINE_S = 0.25
_REPLY_S = 0.25
# A Bota that restarts when its port is opened prints its baud rate at 230400 baud; its vendor waits 2 s for this text.
_BOOT_S = 2.5
# A port that is closed for a shorter time than this may not restart the sensor.
_CLOSED_S = 0.1
# Listening time on a bus: ten samples of the slowest Robotous, and about the period of the slowest usual heartbeat.
_LISTEN_BUS_S = 1.0


class Answer(NamedTuple):
    """Result of a probe: a sensor that was found, or one that could not be queried safely."""

    url: str | None
    """Address of the sensor; None if it was not asked."""
    what: str
    """What the sensor reports about itself, or why it was not asked."""


def _drivers(wire: str) -> Iterator[tuple[ModuleType, Any]]:
    """Yield module and class of each driver on this wire."""
    for name in (kind.driver for kind in SENSORS.values() if kind.wire == wire):
        module = import_module(name.partition(":")[0])
        yield module, getattr(module, name.partition(":")[2])


def probe_serial(port: str, clock: Clock = REAL) -> Answer | None:
    """Return the sensor that was found on this port, or None. Raises `ConnectError` if the port does not open."""
    probes = [probe for module, _ in _drivers("serial") for probe in module.SERIAL_PROBES]
    with clock.keeping_up():
        for probe in probes:
            if probe.streams(_receive_from_line(port, probe, b"", _LISTEN_LINE_S, clock)):
                return Answer(probe.url.format(port=in_url(port)), "it streams")
        for probe in probes:
            if probe.identify is not None:
                try:
                    what = probe.identify(_receive_from_line(port, probe, probe.request, _REPLY_S, clock))
                except ProtocolError:
                    continue
                return Answer(probe.url.format(port=in_url(port)), what)
        clock.sleep(_CLOSED_S)
        for probe in probes:
            if probe.boot_url and (url := probe.boot_url(_receive_from_line(port, probe, b"", _BOOT_S, clock))):
                return Answer(url.format(port=in_url(port)), "it boots")
    return None


def _receive_from_line(path: str, probe: SerialProbe, request: bytes, duration_s: float, clock: Clock) -> bytes:
    port = SerialPort(path, path, probe.baud, even_parity=probe.even_parity, read_s=0.02, clock=clock)
    data = b""
    try:
        port.open()
        if request:
            port.write(request)
        for _ in clock.looks(duration_s):
            data += port.read(4096)
    except StreamBroken as exc:
        raise ConnectError(exc.found, exc.fix) from exc
    finally:
        port.close()
    return data


def probe_can(
    channel: str, *, interface: str, bitrate: int | None, base: int = 0x20, clock: Clock = REAL
) -> list[Answer]:
    """Return the sensors that were found on a bus, and those that could not be asked safely.

    Parameters
    ----------
    channel, interface : str
        ``can0`` and ``socketcan``, or a serial port and ``slcan``.
    bitrate : int or None
        Bit rate of the bus, bit/s; a wrong one disturbs the bus. None on socketcan, if it is unknown.
    base : int
        Base identifier of an ATI sensor, 0x00 to 0x7F.
    clock : Clock
        Clock of the time-outs.

    Raises
    ------
    ConnectError
        The bus does not open, or is lost.
    """
    probes = [driver.probe(channel, interface, bitrate, base) for _, driver in _drivers("can")]
    bus = CanBus(f"{interface} {channel}", channel, interface, bitrate or 250_000, clock=clock)
    try:
        with clock.keeping_up():
            bus.open()
            heard = [frame for left_s in clock.looks(_LISTEN_BUS_S) if (frame := bus.look(min(left_s, clock.poll_s)))]
            return [answer for probe in probes if probe and (answer := _ask_sensor(probe, heard, bus))]
    except StreamBroken as exc:
        raise ConnectError(exc.found, exc.fix) from exc
    finally:
        bus.close()


def _ask_sensor(probe: CanProbe, heard: Sequence[CanFrame], bus: CanBus) -> Answer | None:
    if what := probe.recognize(heard):
        return Answer(probe.url, what)
    if busy := sorted(probe.must_be_silent & {identifier for identifier, _ in heard}):
        some = ", ".join(f"0x{identifier:03X}" for identifier in busy[:4]) + (" …" if busy[4:] else "")
        return Answer(
            None,
            f"{probe.name} was not queried, because another device sends on {some}; use {probe.url} if you know that "
            "this sensor is connected",
        )
    return Answer(probe.url, what) if (what := probe.ask(bus)) else None
