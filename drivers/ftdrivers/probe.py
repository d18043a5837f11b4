"""Probe a serial port or a CAN bus for known sensors: listen first, then request their names.

Only for ports and buses that the user names. Only read requests are sent. On a serial port they are in the protocols of
ATI, Robotiq and Robotous; their effect on other devices is unknown. On a bus they are three frames: serial number and
firmware of an ATI NETCANOEM, and model of a Robotous.

Ref: ATI 9610-05-1030-04, command list; Robotous RFT manual 1.8, communication protocol; CiA 301, predefined connection
set.
"""

from collections.abc import Callable, Mapping, Sequence
from collections.abc import Set as AbstractSet
from dataclasses import dataclass, replace

from ftdrivers.ati import codec as ati
from ftdrivers.ati import modbus
from ftdrivers.ati.codec import Op, decode_text
from ftdrivers.bota import codec as bota
from ftdrivers.clock import REAL, Clock
from ftdrivers.errors import ConnectError, ProtocolError, StreamBroken
from ftdrivers.registry import in_url
from ftdrivers.robotiq import codec as robotiq
from ftdrivers.robotous import can as robotous_can
from ftdrivers.robotous import codec as robotous
from ftdrivers.wires.can_bus import CanBus
from ftdrivers.wires.framing import Deframer
from ftdrivers.wires.serial_port import SerialPort

_LISTEN_LINE_S = 0.25
_REPLY_S = 0.25
# A Bota that restarts when its port is opened prints its baud rate at 230400 baud; its maker waits 2 s for it.
_BOOT_S = 2.5
# A port that is closed for less may not restart the sensor.
_CLOSED_S = 0.1
# So many with a right checksum identify a stream.
_ENOUGH_FRAMES = 5
# Ten samples of the slowest Robotous, and about the slowest usual heartbeat.
_LISTEN_BUS_S = 1.0
# So many in a row and in order identify a sensor.
_ENOUGH_SAMPLES = 5

# Nodes of CANopen. On their bus every lower identifier may be a command, even one that is silent now.
_HEARTBEATS = frozenset(range(0x701, 0x780))


@dataclass(frozen=True, slots=True)
class Answer:
    """A sensor that was found, or one that could not be asked."""

    url: str | None
    """Its address; None for a sensor that was not asked."""
    what: str
    """What it reports about itself, or why it was not asked."""


@dataclass(frozen=True, slots=True)
class _KnownOnLine:
    url: str
    baud: int
    even_parity: bool
    streams: Callable[[bytes], bool]
    request: bytes | None = None
    # What the device reports about itself; raises `ProtocolError`.
    reply: Callable[[bytes], str] | None = None


def probe_serial(port: str, clock: Clock = REAL) -> Answer | None:
    """Return the known sensor on this port, or None. Raises `ConnectError` if the port does not open."""
    with clock.keeping_up():
        for known in _KNOWN:
            if known.streams(_hear_line(port, known, None, _LISTEN_LINE_S, clock)):
                return Answer(known.url.format(port=in_url(port)), "it streams")
        for known in _KNOWN:
            if known.request is not None and known.reply is not None:
                try:
                    what = known.reply(_hear_line(port, known, known.request, _REPLY_S, clock))
                except ProtocolError:
                    continue
                return Answer(known.url.format(port=in_url(port)), what)
        clock.sleep(_CLOSED_S)
        if baud := bota.find_baud(_hear_line(port, _BOTA, None, _BOOT_S, clock)):
            return Answer(f"bota://{in_url(port)}?baud={baud}", "it boots")
    return None


def _hear_line(path: str, known: _KnownOnLine, request: bytes | None, duration_s: float, clock: Clock) -> bytes:
    port = SerialPort(path, path, known.baud, even_parity=known.even_parity, read_s=0.02, clock=clock)
    data = b""
    try:
        port.open()
        if request is not None:
            port.write(request)
        for _ in clock.looks(duration_s):
            data += port.read(4096)
    except StreamBroken as exc:
        raise ConnectError(exc.found, exc.fix) from exc
    finally:
        port.close()
    return data


def _frames(deframer: Callable[[], Deframer]) -> Callable[[bytes], bool]:
    return lambda data: len(deframer().feed(data)) >= _ENOUGH_FRAMES


def _ati_streams(data: bytes) -> bool:
    """Require a right checksum in 20 records or more, because they have neither header nor number."""
    data = data[-100 * modbus.RECORD_SIZE :]
    if not data.strip(b"\0"):
        return False
    for start in range(modbus.RECORD_SIZE):
        whole = (len(data) - start) // modbus.RECORD_SIZE * modbus.RECORD_SIZE
        if whole >= 20 * modbus.RECORD_SIZE and modbus.decode_records(data[start : start + whole]).intact.all():
            return True
    return False


# Serial and part number of the first stored calibration.
_ATI_REQUEST = modbus.read_registers(modbus.calibration_reads(1)[0][0], 20)
_ROBOTIQ_REQUEST = robotiq.read_registers(robotiq.SERIAL, 4)
_ROBOTOUS_REQUEST = robotous.encode_frame(robotous.encode(robotous.Command.MODEL))


def _ati_reply(data: bytes) -> str:
    registers = modbus.check_reply(_ATI_REQUEST, data[: modbus.reply_size(_ATI_REQUEST)])
    return f"ATI Digital F/T {decode_text(registers[8:])}, serial {decode_text(registers[:8])}"


def _robotiq_reply(data: bytes) -> str:
    registers = robotiq.check_reply(_ROBOTIQ_REQUEST, data[: robotiq.reply_size(_ROBOTIQ_REQUEST)])
    return f"Robotiq FT 300, serial {robotiq.decode_serial(registers)}"


def _robotous_reply(data: bytes) -> str:
    for _, frame in robotous.deframer().feed(data):
        field = frame[1:-2]
        if field[0] == robotous.Command.MODEL:
            return f"Robotous {robotous.decode_text(field)}"
    raise ProtocolError("no reply of a Robotous sensor")


_BOTA = _KnownOnLine("bota://{port}?baud=230400", 230_400, False, _frames(bota.deframer))
_ROBOTOUS = _KnownOnLine(
    "robotous-serial://{port}", 115_200, False, _frames(robotous.deframer), _ROBOTOUS_REQUEST, _robotous_reply
)
_KNOWN = (
    replace(_BOTA, url="bota://{port}?baud=460800", baud=460_800),
    _BOTA,
    _KnownOnLine("robotiq-ft300://{port}", 19_200, False, _frames(robotiq.deframer), _ROBOTIQ_REQUEST, _robotiq_reply),
    _ROBOTOUS,
    replace(_ROBOTOUS, url="robotous-serial://{port}?baud=921600", baud=921_600),
    _KnownOnLine("ati-serial://{port}", 1_250_000, True, _ati_streams, _ATI_REQUEST, _ati_reply),
)


_Frame = tuple[int, bytes]


@dataclass(frozen=True, slots=True)
class _KnownOnBus:
    name: str
    url: str
    # Identifiers that must be silent before the sensor is asked: they may be commands to other devices, such as set
    # values of motor drives from 0x201 to 0x20F.
    must_be_silent: AbstractSet[int]
    shows_itself: Callable[[Sequence[_Frame]], str | None]
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
            heard = [frame for left_s in clock.looks(_LISTEN_BUS_S) if (frame := bus.look(min(left_s, clock.poll_s)))]
            return [answer for sensor in known if (answer := _look(sensor, heard, bus, clock))]
    except StreamBroken as exc:
        raise ConnectError(exc.found, exc.fix) from exc
    finally:
        bus.close()


def _look(known: _KnownOnBus, heard: Sequence[_Frame], bus: CanBus, clock: Clock) -> Answer | None:
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


def _ati(channel: str, interface: str, bitrate: int | None, base: int) -> _KnownOnBus:
    first = base << 4
    own = frozenset(range(first, first + 16))
    options = [
        f"interface={interface}" if interface != "socketcan" else "",
        f"bitrate={bitrate}" if bitrate else "",
        f"base=0x{base:02X}" if base != 0x20 else "",
    ]

    def replies(op: Op) -> dict[int, int]:
        return {first | opcode: size for opcode, size in ati.REPLIES[op].items()}

    def is_read(heard: Sequence[_Frame]) -> str | None:
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

    return _KnownOnBus(
        f"an ATI NETCANOEM at base 0x{base:02X}",
        _url("ati-can", channel, options),
        own | _HEARTBEATS if first < min(_HEARTBEATS) else own,
        is_read,
        ask,
    )


def _robotous(channel: str, interface: str) -> _KnownOnBus:
    command, *answers = robotous_can.IDS
    reply = dict.fromkeys(answers, 8)

    def streams(heard: Sequence[_Frame]) -> str | None:
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

    return _KnownOnBus(
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
    frames: list[_Frame] = []
    for left_s in clock.looks(_REPLY_S):
        frame = bus.look(min(left_s, clock.poll_s))
        if frame and len(frame[1]) == parts.get(frame[0]):
            frames.append(frame)
            if replies := _messages(frames, parts):
                return replies[0]
    return None


def _messages(frames: Sequence[_Frame], parts: Mapping[int, int]) -> list[bytes]:
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
