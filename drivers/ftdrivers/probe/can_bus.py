"""Probe a CAN bus for known sensors: listen first, then request their names. Only for buses that the user names.

Three frames may be sent, all read requests: serial number and firmware of an ATI NETCANOEM, and model of a Robotous. A
sensor is asked only if its identifiers are silent, because they may be commands to other devices. For motor drives,
0x201 to 0x20F are set values.

Ref: ATI 9610-05-1030-04, command list; Robotous RFT manual 1.8, communication protocol; CiA 301, predefined connection
set.
"""

from collections.abc import Callable, Mapping, Sequence
from collections.abc import Set as AbstractSet
from dataclasses import dataclass

from ftdrivers.ati import codec as ati
from ftdrivers.ati.codec import Op
from ftdrivers.clock import REAL, Clock
from ftdrivers.errors import ConnectError, ProtocolError, StreamBroken
from ftdrivers.probe.serial_line import Answer
from ftdrivers.registry import in_url
from ftdrivers.robotous import can as robotous_can
from ftdrivers.robotous import codec as robotous
from ftdrivers.wires.can_bus import CanBus

# Ten samples of the slowest Robotous, and about the slowest usual heartbeat.
_LISTEN_S = 1.0
_REPLY_S = 0.25
# So many in a row and in order identify a sensor.
_ENOUGH_SAMPLES = 5

# Nodes of CANopen. On their bus every lower identifier may be a command, even one that is silent now.
_HEARTBEATS = frozenset(range(0x701, 0x780))

Frame = tuple[int, bytes]


@dataclass(frozen=True, slots=True)
class _Known:
    name: str
    url: str
    # Identifiers that must be silent before the sensor is asked.
    must_be_silent: AbstractSet[int]
    shows_itself: Callable[[Sequence[Frame]], str | None]
    ask: Callable[[CanBus, Clock], str | None]


def probe_can(
    channel: str, *, interface: str, bitrate: int | None, base: int = 0x20, clock: Clock = REAL
) -> list[Answer]:
    """Return the known sensors on a bus, and those that could not be asked.

    Parameters
    ----------
    channel, interface : str
        ``can0`` and ``socketcan``, or a serial port and ``slcan``.
    bitrate : int or None
        Bit/s of the bus: a wrong one disturbs it. None on socketcan, where it is unknown.
    base : int
        Base identifier of an ATI sensor, 0x00 to 0x7F.
    clock : Clock
        Measures the waits.

    Raises
    ------
    ConnectError
        The bus does not open, or is lost.
    """
    known = [_ati(channel, interface, bitrate, base)]
    if bitrate in {None, robotous_can.BITRATE}:
        known.append(_robotous(channel, interface))
    bus = CanBus(f"{interface} {channel}", channel, interface, bitrate or 250_000, clock=clock)
    try:
        with clock.keeping_up():
            bus.open()
            heard = _hear(bus, clock)
            return [answer for sensor in known if (answer := _look(sensor, heard, bus, clock))]
    except StreamBroken as exc:
        raise ConnectError(exc.found, exc.fix) from exc
    finally:
        bus.close()


def _hear(bus: CanBus, clock: Clock) -> list[Frame]:
    return [frame for left_s in clock.looks(_LISTEN_S) if (frame := bus.look(min(left_s, clock.poll_s)))]


def _look(known: _Known, heard: Sequence[Frame], bus: CanBus, clock: Clock) -> Answer | None:
    if what := known.shows_itself(heard):
        return Answer(known.url, what)
    if busy := sorted(known.must_be_silent & {identifier for identifier, _ in heard}):
        some = ", ".join(f"0x{identifier:03X}" for identifier in busy[:4]) + (" …" if busy[4:] else "")
        return Answer(
            None,
            f"{known.name} was not asked, because another device sends on {some}; "
            f"use {known.url} if you know that it is there",
        )
    return Answer(known.url, what) if (what := known.ask(bus, clock)) else None


def _ati(channel: str, interface: str, bitrate: int | None, base: int) -> _Known:
    first = base << 4
    own = frozenset(range(first, first + 16))
    options = [
        f"interface={interface}" if interface != "socketcan" else "",
        f"bitrate={bitrate}" if bitrate else "",
        f"base=0x{base:02X}" if base != 0x20 else "",
    ]

    def replies(op: Op) -> dict[int, int]:
        return {first | opcode: size for opcode, size in ati.REPLIES[op].items()}

    def is_read(heard: Sequence[Frame]) -> str | None:
        request = (first | Op.GAUGES, b"")
        ours = [frame for frame in heard if frame[0] in own and frame != request]
        return "another host reads it" if len(_messages(ours, replies(Op.GAUGES))) >= _ENOUGH_SAMPLES else None

    def ask(bus: CanBus, clock: Clock) -> str | None:
        serial = _ask(bus, clock, first | Op.SERIAL, b"", replies(Op.SERIAL))
        firmware = None if serial is None else _ask(bus, clock, first | Op.FIRMWARE, b"", replies(Op.FIRMWARE))
        if serial is None or firmware is None:
            return None
        major, minor, build = ati.decode_firmware(firmware)
        return f"ATI NETCANOEM, serial {ati.decode_serial(serial)}, firmware {major}.{minor} build {build}"

    return _Known(
        f"an ATI NETCANOEM at base 0x{base:02X}",
        _url("ati-can", channel, options),
        own | _HEARTBEATS if first < min(_HEARTBEATS) else own,
        is_read,
        ask,
    )


def _robotous(channel: str, interface: str) -> _Known:
    command, *answers = robotous_can.IDS
    reply = dict.fromkeys(answers, 8)

    def streams(heard: Sequence[Frame]) -> str | None:
        fields = _messages([frame for frame in heard if frame[0] in reply], reply)
        try:
            samples = [robotous.decode_sample(field) for field in fields]
        except ProtocolError:
            return None
        plausible = all(sample.overload < 0x40 for sample in samples)
        return "it streams" if plausible and len(samples) >= _ENOUGH_SAMPLES else None

    def ask(bus: CanBus, clock: Clock) -> str | None:
        field = _ask(bus, clock, command, robotous.encode(robotous.Command.MODEL), reply)
        try:
            model = field and field[0] == robotous.Command.MODEL and robotous.decode_text(field)
        except ProtocolError:
            return None
        return f"Robotous {model}" if model else None

    return _Known(
        "a Robotous",
        _url("robotous-can", channel, [f"interface={interface}" if interface != "socketcan" else ""]),
        reply.keys() | {command},
        streams,
        ask,
    )


def _url(scheme: str, channel: str, options: Sequence[str]) -> str:
    return f"{scheme}://{in_url(channel)}?{'&'.join(filter(None, options))}".rstrip("?")


def _ask(bus: CanBus, clock: Clock, identifier: int, data: bytes, parts: Mapping[int, int]) -> bytes | None:
    bus.send(identifier, data)
    frames: list[Frame] = []
    for left_s in clock.looks(_REPLY_S):
        frame = bus.look(min(left_s, clock.poll_s))
        if frame and len(frame[1]) == parts.get(frame[0]):
            frames.append(frame)
            if replies := _messages(frames, parts):
                return replies[0]
    return None


def _messages(frames: Sequence[Frame], parts: Mapping[int, int]) -> list[bytes]:
    """Assemble whole messages; none if a frame is out of order or of the wrong length.

    Parameters
    ----------
    parts : mapping
        Identifier and length in bytes of the frames of one message, in their order.
    """
    order = list(parts)
    if not frames or frames[0][0] not in order:
        return []
    begun = order.index(frames[0][0])
    for number, (identifier, data) in enumerate(frames, start=begun):
        if identifier != order[number % len(order)] or len(data) != parts[identifier]:
            return []
    whole = frames[-begun % len(order) :]
    return [
        b"".join(data for _, data in whole[start : start + len(order)])
        for start in range(0, len(whole) - len(order) + 1, len(order))
    ]
