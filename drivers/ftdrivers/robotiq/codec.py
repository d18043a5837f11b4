"""Robotiq FT 300: Modbus RTU requests and the 16-byte stream frame, as pure functions on bytes.

Ref: Robotiq, "FT 300 Force Torque Sensor" instruction manual, control over Modbus RTU; the layout of serial number and
firmware as in Robotiq's own C driver.
Checked on hardware: no. Verified against: tests/unit/drivers/robotiq/test_codec.py.

A decoder returns a value or raises `ProtocolError` and no other exception. Registers are big-endian, the stream is
little-endian.
"""

import struct
from collections.abc import Sequence
from functools import partial

from ftdrivers.errors import ProtocolError
from ftdrivers.interfaces import NOT_REPORTED
from ftdrivers.wires import modbus as _modbus
from ftdrivers.wires.framing import Deframer, crc16_modbus

ADDRESS = 9

FIRMWARE, SERIAL = 500, 510
START_STREAM = _modbus.write_registers(ADDRESS, 410, [0x0200])

STOP = b"\xff" * 50
"""Bytes that stop a running stream, which may take 0.5 s."""

HEADER = b"\x20\x4e"
FRAME_SIZE = 16
NOMINAL_RATE_Hz = 100.0
COUNTS_PER_UNIT = (100, 100, 100, 1000, 1000, 1000)
"""(6,) counts per N and per N·m."""
RANGE = (300.0, 300.0, 300.0, 30.0, 30.0, 30.0)
"""(6,) largest force in N and torque in N·m, in both directions."""


Refused = _modbus.Refused
read_registers = partial(_modbus.read_registers, ADDRESS)
reply_size = _modbus.reply_size


def check_reply(request: bytes, reply: bytes) -> tuple[int, ...]:
    """Check a complete reply to a request and return its registers; an empty tuple for a write request."""
    payload = _modbus.check_reply(request, reply)
    return struct.unpack(f">{len(payload) // 2}H", payload)


def is_frame(data: bytes) -> bool:
    """Return whether bytes are a complete stream frame with correct header and checksum."""
    return (
        len(data) == FRAME_SIZE
        and data.startswith(HEADER)
        and crc16_modbus(data[:-2]) == int.from_bytes(data[-2:], "little")
    )


def deframer() -> Deframer:
    """Return a `Deframer` for these frames."""
    return Deframer(HEADER, FRAME_SIZE, is_frame)


def decode_frame(data: bytes) -> tuple[int, ...]:
    """Decode a stream frame: six counts Fx..Tz."""
    if not is_frame(data):
        raise ProtocolError(f"the bytes {data.hex(' ')} are not a stream frame")
    return struct.unpack_from("<6h", data, len(HEADER))


def decode_serial(registers: Sequence[int]) -> str:
    """Decode registers 510 to 513: three letters, and a number whose low word comes first."""
    first, second, low, high = _words(registers, 4)
    number = high << 16 | low
    letters = _letters(first >> 8, first & 0xFF, second >> 8)
    return f"{letters}-{number:04d}" if number and letters else f"{number:04d}" if number else NOT_REPORTED


def decode_firmware(registers: Sequence[int]) -> str:
    """Decode registers 500 to 502: three letters and three numbers."""
    first, second, third = _words(registers, 3)
    letters = _letters(first >> 8, first & 0xFF, second >> 8)
    version = f"{second & 0xFF}.{third >> 8}.{third & 0xFF}"
    return f"{letters}-{version}" if letters else version


def _words(registers: Sequence[int], count: int) -> Sequence[int]:
    if len(registers) != count or not all(0 <= word <= 0xFFFF for word in registers):
        raise ProtocolError(f"expected {count} registers, got {list(registers)}")
    return registers


def _letters(*codes: int) -> str:
    """Decode character codes; return an empty text if one of them is not printable."""
    return bytes(codes).decode("ascii") if all(0x20 < code < 0x7F for code in codes) else ""
