"""Bota SensONE and Rokubi: the 37-byte stream frame and the set-up commands, as pure functions on bytes.

Ref: Bota Systems, serial interface of SensONE and Rokubi, as in the vendor's example programs.
Checked on hardware: no. Verified against: tests/unit/drivers/bota/test_codec.py.

A decoder returns a value or raises `ProtocolError`, never anything else. All numbers are little-endian.
"""

import math
import struct
from typing import NamedTuple

from ftdrivers.errors import ProtocolError
from ftdrivers.wires.crc import crc16_x25
from ftdrivers.wires.framing import Deframer

HEADER = b"\xaa"
_PAYLOAD = struct.Struct("<H6fIf")
FRAME_SIZE = 1 + _PAYLOAD.size + 2

STATUS_BITS = {0: "application too slow", 1: "overrange", 2: "invalid measurement", 3: "raw measurement"}
OVERRANGE, INVALID, RAW = 2, 4, 8

ENTER_SETUP, ENTER_RUN = b"C", b"R"
BINARY_AND_CALIBRATED = b"c,0,1,0,4"
"""No temperature compensation (the vendor's advice), calibrated, binary, 460800 baud."""


class Frame(NamedTuple):
    """One sample."""

    status: int
    wrench: tuple[float, ...]
    """(6,) N and N·m."""
    t_us: int
    """The sensor's clock, which wraps at 2**32 µs, that is every 71.6 minutes."""
    temperature_C: float


def is_frame(data: bytes) -> bool:
    """Return whether bytes are a whole frame: length, header and checksum."""
    return (
        len(data) == FRAME_SIZE and data.startswith(HEADER) and crc16_x25(data[1:-2]).to_bytes(2, "little") == data[-2:]
    )


def deframer() -> Deframer:
    """Build a finder of frames in a stream of bytes."""
    return Deframer(HEADER, FRAME_SIZE, is_frame)


def decode_frame(data: bytes) -> Frame:
    """Decode a whole frame."""
    if not is_frame(data):
        raise ProtocolError(f"the bytes {data.hex(' ')} are not a frame")
    status, *wrench, t_us, temperature_C = _PAYLOAD.unpack_from(data, 1)
    if not all(map(math.isfinite, wrench)):
        raise ProtocolError(f"the sensor sends the wrench {wrench}, which is not finite", "power it off and on")
    return Frame(status, tuple(wrench), t_us, temperature_C)


def filter_command(sinc: int) -> bytes:
    """Build the command that sets the sinc length: no chopping, no fast mode, FIR off (the vendor's example)."""
    return f"f,{sinc},0,0,1".encode("ascii")


def success(command: bytes) -> bytes:
    """Return the confirmation of a command."""
    return b"r,0," + command[:1] + b",0"
