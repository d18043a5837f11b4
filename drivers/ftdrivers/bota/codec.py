"""Bota SensONE and Rokubi: the 37-byte stream frame and the set-up commands, as pure functions on bytes.

Ref: Bota Systems, serial interface of SensONE and Rokubi, as in the vendor's example programs and ROS drivers.
Checked on hardware: no. Verified against: tests/unit/drivers/bota/test_codec.py.

A decoder returns a value or raises `ProtocolError` and no other exception. All numbers are little-endian.
"""

import math
import re
import struct
from typing import NamedTuple

from ftdrivers.errors import ProtocolError
from ftdrivers.wires.framing import Deframer, crc16_x25

HEADER = b"\xaa"
_PAYLOAD = struct.Struct("<H6fIf")
FRAME_SIZE = 1 + _PAYLOAD.size + 2

STATUS_BITS = {0: "application too slow", 1: "overrange", 2: "invalid measurement", 3: "raw measurement"}
OVERRANGE, INVALID, RAW = 2, 4, 8

BAUDS = (9600, 57_600, 115_200, 230_400, 460_800)
"""Baud rates in the order of their codes 0 to 4."""
DEFAULT_BAUD = 230_400

ENTER_SETUP, ENTER_RUN, ASK_SERIAL = b"C", b"R", b"p?"

_CONFIGURATION = re.compile(rb"c(?:,\d){3},([0-4])")
_NAME, _SERIAL, _FIRMWARE = (re.compile(word + rb":\s*([ -~]+)\r") for word in (rb"name", rb"S/N", rb"FW version"))
_SERIAL_REPLY = re.compile(rb"p,\d,(\d+),[^,\r\n]*,[^,\r\n]*,([ -~]*)")


class Identity(NamedTuple):
    """Name, serial number and firmware that a sensor reports; a text is empty if the sensor does not report it."""

    name: str
    serial: str
    firmware: str


class Frame(NamedTuple):
    """One decoded sample of the sensor."""

    status: int
    wrench: tuple[float, ...]
    """(6,) force in N, then torque in N·m."""
    t_us: int
    """Time on the sensor's clock, µs, which wraps at 2**32 µs, that is, every 71.6 minutes."""
    temperature_C: float


def is_frame(data: bytes) -> bool:
    """Return whether bytes are a complete frame with correct header and checksum."""
    return (
        len(data) == FRAME_SIZE and data.startswith(HEADER) and crc16_x25(data[1:-2]).to_bytes(2, "little") == data[-2:]
    )


def deframer() -> Deframer:
    """Return a `Deframer` for these frames."""
    return Deframer(HEADER, FRAME_SIZE, is_frame)


def decode_frame(data: bytes) -> Frame:
    """Decode a complete stream frame."""
    if not is_frame(data):
        raise ProtocolError(f"the bytes {data.hex(' ')} are not a frame")
    status, *wrench, t_us, temperature_C = _PAYLOAD.unpack_from(data, 1)
    if not all(map(math.isfinite, wrench)):
        raise ProtocolError(f"the sensor sends the wrench {wrench}, which is not finite", "power it off and on")
    return Frame(status, tuple(wrench), t_us, temperature_C)


def find_identity(text: bytes) -> Identity:
    """Find name, serial number and firmware in the boot text or the reply to `ASK_SERIAL`, even among other bytes."""
    if reply := _SERIAL_REPLY.search(text):
        return Identity(reply[2].decode("ascii").strip(), reply[1].decode("ascii"), "")
    found = (pattern.search(text) for pattern in (_NAME, _SERIAL, _FIRMWARE))
    return Identity(*("" if match is None else match[1].decode("ascii").strip() for match in found))


def find_baud(text: bytes) -> int | None:
    """Return the baud rate in the configuration that a sensor prints at 230400 baud while it boots, or None."""
    match = _CONFIGURATION.search(text)
    return None if match is None else BAUDS[int(match[1])]


def setup_commands(baud: int, sinc: int) -> tuple[bytes, bytes]:
    """Return the commands that select calibrated binary frames and set the length of the sinc filter.

    They switch temperature compensation off, as the vendor advises, and chopping, fast mode and FIR filter, as in the
    vendor's example.
    """
    return f"c,0,1,0,{BAUDS.index(baud)}".encode("ascii"), f"f,{sinc},0,0,1".encode("ascii")


def success(command: bytes) -> bytes:
    """Return the bytes with which the sensor confirms a command."""
    return b"r,0," + command[:1] + b",0"
