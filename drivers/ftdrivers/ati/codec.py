"""ATI NETCANOEM over CAN: commands, replies and status, as pure functions on bytes.

Ref: ATI Industrial Automation, "F/T CAN Bus and Serial Bus Network Interface for OEM", 9610-05-1030 revision 04.
Checked on hardware: no. Verified against: tests/unit/drivers/ati/test_codec.py.

A decoder returns a value or raises `ProtocolError`, never anything else. All multi-byte numbers are big-endian.
"""

import struct
from collections.abc import Mapping
from enum import IntEnum
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ftdrivers.errors import ProtocolError
from ftdrivers.interfaces import Array

# Firmware before 3.7 reports neither units nor counts per unit.
COUNTS_PER_UNIT_SINCE = (3, 7)
"""First firmware that answers `COUNTS_PER_UNIT` and `UNIT_CODES`; older ones use 1 000 000 for both."""


class Op(IntEnum):
    """Opcodes that this driver sends; an identifier is `base << 4 | opcode`, for request and reply alike."""

    GAUGES = 0x0
    MATRIX_ROW = 0x2
    SERIAL = 0x5
    SELECT_SLOT = 0x6
    COUNTS_PER_UNIT = 0x7
    UNIT_CODES = 0x8
    FIRMWARE = 0xF


REPLIES: Mapping[Op, Mapping[int, int]] = {
    Op.GAUGES: {0x0: 8, 0x1: 6},
    Op.MATRIX_ROW: {0x2: 8, 0x3: 8, 0x4: 8},
    Op.SERIAL: {0x5: 8},
    Op.SELECT_SLOT: {0x6: 1},
    Op.COUNTS_PER_UNIT: {0x7: 8},
    Op.UNIT_CODES: {0x8: 2},
    Op.FIRMWARE: {0xF: 4},
}
"""Opcode and length of each frame of the reply to a request."""

STATUS_BITS: Mapping[int, str] = {
    0: "watchdog reset",
    1: "DAC/ADC check too high",
    2: "DAC/ADC check too low",
    3: "artificial analog ground out of range",
    4: "power supply too high",
    5: "power supply too low",
    6: "no valid calibration in the active slot",
    7: "EEPROM failure",
    8: "configuration invalid, defaults in use",
    11: "sensor temperature too high",
    12: "sensor temperature too low",
    14: "CAN bus error",
    15: "any error",
}
WATCHDOG_RESET = 0x0001
# All bits but watchdog reset, configuration, CAN and the summary: a healthy unit on a shared bus had the CAN bit set.
CRITICAL = 0x18FE
"""Status bits with which the data is unusable. The device keeps sending, so the host has to check them."""


class GaugeReading(NamedTuple):
    """One reading: the status word and the six gauges in natural order G0..G5."""

    status: int
    gauges: NDArray[np.int32]


class Firmware(NamedTuple):
    """Firmware version; compares with tuples."""

    major: int
    minor: int
    build: int


def decode_gauges(first: bytes, second: bytes) -> GaugeReading:
    """Decode the two halves of a reading: status, G0, G2, G4 and G1, G3, G5."""
    status, g0, g2, g4 = _unpack(">Hhhh", first, "first half of a gauge reading")
    g1, g3, g5 = _unpack(">hhh", second, "second half of a gauge reading")
    return GaugeReading(status, np.array([g0, g1, g2, g3, g4, g5], dtype=np.int32))


def decode_matrix_row(first: bytes, second: bytes, third: bytes) -> Array:
    """Decode one row (6,) of the calibration matrix, counts per gauge count, columns G0..G5."""
    row = np.array([_unpack(">ff", part, "part of a matrix row") for part in (first, second, third)]).ravel()
    if not np.isfinite(row).all():
        raise ProtocolError(f"a calibration matrix row is not finite: {row}")
    return row


def decode_text(data: bytes) -> str:
    """Decode ASCII padded with NUL or spaces; a byte that is not printable becomes ``?``."""
    text = "".join(chr(byte) if 0x20 <= byte < 0x7F else "?" for byte in data.rstrip(b"\0 "))
    return text.strip()


def decode_serial(data: bytes) -> str:
    """Decode the serial number."""
    _expect(data, 8, "serial number")
    return decode_text(data)


def decode_slot(data: bytes) -> int:
    """Decode the echo of the selected calibration slot."""
    return int(_unpack(">B", data, "calibration slot echo")[0])


def decode_counts_per_unit(data: bytes) -> tuple[int, int]:
    """Decode counts per unit of force and of torque."""
    force, torque = _unpack(">II", data, "counts per unit")
    if not force or not torque:
        raise ProtocolError(f"counts per unit are {force} and {torque}, which no calibration has")
    return force, torque


def decode_unit_codes(data: bytes) -> tuple[int, int]:
    """Decode the unit codes of force and torque."""
    force, torque = _unpack(">BB", data, "unit codes")
    return force, torque


def decode_firmware(data: bytes) -> Firmware:
    """Decode the firmware version."""
    return Firmware(*_unpack(">BBH", data, "firmware version"))


def _expect(data: bytes, size: int, what: str) -> None:
    if len(data) != size:
        raise ProtocolError(f"{what}: expected {size} bytes, got {len(data)} ({data.hex(' ')})")


def _unpack(form: str, data: bytes, what: str) -> tuple[int, ...]:
    _expect(data, struct.calcsize(form), what)
    return struct.unpack(form, data)
