"""Robotous RFT: commands, replies and samples, which are equal on both wires, as pure functions on bytes.

A command is a field of 8 bytes, a reply or sample is a field of 16 bytes. Byte 0 is the command. On CAN, fields are
sent without a frame; on a UART each field is in a frame. All multi-byte numbers are big-endian.

Ref: Robotous, "RFT Series Installation and Operation Manual", revision 1.8, communication protocol, dividers and rates,
as in the public protocol page of ItsLP18/robotous-ft-pipeline. RFT76-HA01 is missing there; public drivers give it the
scale of RFT40-SA01.
Checked on hardware: no. Verified against: tests/unit/drivers/robotous/test_codec.py.

A decoder returns a value or raises `ProtocolError` and no other exception.
"""

import struct
from enum import IntEnum
from typing import NamedTuple

from ftdrivers.errors import ProtocolError
from ftdrivers.wires.framing import Deframer

COMMAND_SIZE, REPLY_SIZE = 8, 16
START_OF_FRAME, END_OF_FRAME = 0x55, 0xAA
FRAME_SIZE = REPLY_SIZE + 3
"""Size of a frame from the sensor, in bytes."""

AXES = ("Fx", "Fy", "Fz", "Tx", "Ty", "Tz")

RATE_CODES = {10: 1, 20: 2, 50: 3, 100: 4, 200: 5, 333: 6, 500: 7, 1000: 8}
"""Code of each output rate (Hz) in commands and replies. A new sensor reports code 0, which means 200 Hz."""

DEFAULT_BAUD = 115_200

FASTEST_Hz = {57_600: 200, 115_200: 333, 230_400: 500, 460_800: 500, 921_600: 1000}
"""Highest output rate, Hz, at each baud rate of a UART."""

# Keys are complete model names, because the first number does not determine the scale of the torque.
_COUNTS_PER_N_NM = {
    "RFT40-SA01": (50, 2000),
    "RFT44-SB01": (50, 2000),
    "RFT60-HA01": (50, 2000),
    "RFT64-SB01": (50, 2000),
    "RFT64-6A01": (50, 1000),
    "RFT76-HA01": (50, 2000),
    "RFT80-6A01": (50, 1000),
    "RFT80-6A02": (50, 1000),
    "RFT82-HA02": (50, 1000),
}
_FAILURES = {1: "not supported", 2: "value out of range", 3: "failed to set"}


# The filter command is not used, because manual and header file number its settings in opposite order.
class Command(IntEnum):
    """The commands that this driver sends. It never sends the bias command, 0x11."""

    MODEL = 0x01
    SERIAL = 0x02
    FIRMWARE = 0x03
    ONE_SAMPLE = 0x0A
    START = 0x0B
    STOP = 0x0C
    SET_RATE = 0x0F
    GET_RATE = 0x10


class Field(NamedTuple):
    """A received field of 16 bytes. `number` also counts damaged fields."""

    number: int
    t_host_ns: int
    data: bytes


class Sample(NamedTuple):
    """One sample: six counts Fx..Tz, and the overload bits, 5 for Fx down to 0 for Tz."""

    counts: tuple[int, ...]
    overload: int


def encode(command: Command, *parameters: int) -> bytes:
    """Return a command field (8 bytes)."""
    return bytes([command, *parameters]).ljust(COMMAND_SIZE, b"\0")


def encode_frame(field: bytes) -> bytes:
    """Return the UART frame of a field: start byte, field, sum of the field, end byte. Nothing is escaped."""
    return bytes([START_OF_FRAME, *field, sum(field) & 0xFF, END_OF_FRAME])


def is_frame(data: bytes) -> bool:
    """Return whether bytes are a complete frame of the sensor with correct start, end and sum."""
    return len(data) == FRAME_SIZE and data == encode_frame(data[1:-2])


def deframer() -> Deframer:
    """Return a `Deframer` for these frames."""
    return Deframer(bytes([START_OF_FRAME]), FRAME_SIZE, is_frame)


def decode_text(field: bytes) -> str:
    """Decode a reply to `MODEL`, `SERIAL` or `FIRMWARE`: 15 ASCII characters, padded."""
    _expect_size(field)
    text = field[1:].split(b"\0")[0].strip()
    if not text or not all(0x20 <= byte < 0x7F for byte in text):
        raise ProtocolError(
            f"the reply to command 0x{field[0]:02X} is not text: {field.hex(' ')}", "power it off and on"
        )
    return text.decode("ascii")


def decode_rate(field: bytes) -> int:
    """Decode the reply to `GET_RATE` and return the output rate in Hz."""
    _expect_size(field)
    for rate_Hz, code in RATE_CODES.items():
        if field[1] in {code, 0} and (field[1] or rate_Hz == 200):
            return rate_Hz
    raise ProtocolError(f"the sensor reports output rate code {field[1]}, not 0 to 8", "power it off and on")


def check_set(field: bytes) -> None:
    """Check the reply to a setting. A refusal raises `ProtocolError` with its reason."""
    _expect_size(field)
    if field[1] != 1:
        reason = _FAILURES.get(field[2], "unknown reason")
        fix = "leave rate out of its address, or power it off and on"
        raise ProtocolError(f"the sensor refused command 0x{field[0]:02X}: {field[2]} ({reason})", fix)


def decode_sample(field: bytes) -> Sample:
    """Decode a sample, sent once for `ONE_SAMPLE` or continually after `START`."""
    _expect_size(field)
    if field[0] not in {Command.ONE_SAMPLE, Command.START}:
        raise ProtocolError(f"a field of command 0x{field[0]:02X} is not a sample: {field.hex(' ')}")
    *counts, overload = struct.unpack_from(">6hB", field, 1)
    return Sample(tuple(counts), overload)


def overloaded_axes(overload: int) -> list[str]:
    """Return the axes whose overload bit is set."""
    return [axis for bit, axis in zip(range(5, -1, -1), AXES, strict=True) if overload >> bit & 1]


def counts_per_unit(model: str) -> tuple[int, int]:
    """Return counts per N and per N·m of a model such as ``RFT60-HA01``; a code of the wire may follow the name."""
    counts = _COUNTS_PER_N_NM.get(model[:10])
    if counts is None:
        found = f"the scale of model '{model}' is unknown; known models are {', '.join(_COUNTS_PER_N_NM)}"
        raise ProtocolError(found, "ask Robotous for its dividers DF and DT, then add counts=DF,DT to its address")
    return counts


def _expect_size(field: bytes) -> None:
    if len(field) != REPLY_SIZE:
        raise ProtocolError(f"expected a field of {REPLY_SIZE} bytes, got {len(field)} ({field.hex(' ')})")
