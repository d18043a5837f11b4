"""Probe a serial port for known sensors: listen first, then request their names. Only for ports that the user names.

Only read requests are sent, with the protocols of ATI, Robotiq and Robotous. Their effect on other devices is unknown.
A Bota that restarts when its port is opened prints its baud rate at 230400 baud. The maker's driver waits 2 s for it.
"""

from collections.abc import Callable
from dataclasses import dataclass

from ftdrivers.ati import modbus
from ftdrivers.ati.codec import decode_text
from ftdrivers.bota import codec as bota
from ftdrivers.clock import REAL, Clock
from ftdrivers.errors import ConnectError, ProtocolError, StreamBroken
from ftdrivers.registry import in_url
from ftdrivers.robotiq import codec as robotiq
from ftdrivers.robotous import codec as robotous
from ftdrivers.wires.framing import Deframer
from ftdrivers.wires.serial_port import SerialPort

_LISTEN_S = 0.25
_REPLY_S = 0.25
_BOOT_S = 2.5
# A port that is closed for less may not restart the sensor.
_CLOSED_S = 0.1
# So many with a right checksum identify a stream.
_ENOUGH_FRAMES = 5


@dataclass(frozen=True, slots=True)
class Answer:
    """A sensor that was found, or one that could not be asked."""

    url: str | None
    """Its address; None for a sensor that was not asked."""
    what: str
    """What it reports about itself, or why it was not asked."""


@dataclass(frozen=True, slots=True)
class _Known:
    url: str
    baud: int
    even_parity: bool
    streams: Callable[[bytes], bool]
    request: bytes | None = None
    # What the device reports about itself; raises `ProtocolError`.
    reply: Callable[[bytes], str] | None = None


def probe(port: str, clock: Clock = REAL) -> Answer | None:
    """Return the known sensor on this port, or None.

    Raises
    ------
    ConnectError
        The port does not open.
    """
    with clock.keeping_up():
        for known in _KNOWN:
            if known.streams(_hear(port, known, None, _LISTEN_S, clock)):
                return Answer(known.url.format(port=in_url(port)), "it streams")
        for known in _KNOWN:
            if known.request is not None and known.reply is not None:
                try:
                    what = known.reply(_hear(port, known, known.request, _REPLY_S, clock))
                except ProtocolError:
                    continue
                return Answer(known.url.format(port=in_url(port)), what)
        clock.sleep(_CLOSED_S)
        if baud := bota.find_baud(_hear(port, _BOTA, None, _BOOT_S, clock)):
            return Answer(f"bota://{in_url(port)}?baud={baud}", "it boots")
    return None


def _hear(path: str, known: _Known, request: bytes | None, duration_s: float, clock: Clock) -> bytes:
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


_robotous_streams = _frames(robotous.deframer)

_BOTA = _Known("bota://{port}?baud=230400", 230_400, False, _frames(bota.deframer))
_KNOWN = (
    _Known("bota://{port}?baud=460800", 460_800, False, _BOTA.streams),
    _BOTA,
    _Known("robotiq-ft300://{port}", 19_200, False, _frames(robotiq.deframer), _ROBOTIQ_REQUEST, _robotiq_reply),
    _Known("robotous-serial://{port}", 115_200, False, _robotous_streams, _ROBOTOUS_REQUEST, _robotous_reply),
    _Known(
        "robotous-serial://{port}?baud=921600",
        921_600,
        False,
        _robotous_streams,
        _ROBOTOUS_REQUEST,
        _robotous_reply,
    ),
    _Known("ati-serial://{port}", 1_250_000, True, _ati_streams, _ATI_REQUEST, _ati_reply),
)
