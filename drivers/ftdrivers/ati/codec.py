"""ATI NETCANOEM over CAN: commands, replies and status, as pure functions on bytes. Units of all ATI sensors.

Ref: ATI Industrial Automation, "F/T CAN Bus and Serial Bus Network Interface for OEM", 9610-05-1030 revision 04. The
wrench in counts is the matrix (rows Fx..Tz, columns G0..G5) times the gauges; force and torque are these counts divided
by the counts per unit. NETCANOEM, Digital F/T, Axia and Net F/T have the same unit codes.
Checked on hardware: no. Verified against: tests/unit/drivers/ati/test_codec.py and test_calibration.py.

A decoder returns a value or raises `ProtocolError` and no other exception. All multi-byte numbers are big-endian.
"""

import struct
from collections.abc import Mapping
from dataclasses import dataclass
from enum import IntEnum
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ftdrivers.errors import DeviceFault, ProtocolError
from ftdrivers.interfaces import Array

COUNTS_PER_UNIT_SINCE = (3, 7)
"""First firmware that replies to `COUNTS_PER_UNIT` and `UNIT_CODES`. Older firmware has 1 000 000 counts per unit."""


class Op(IntEnum):
    """Opcodes that this driver sends. The identifier of a request or reply is `base << 4 | opcode`."""

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
# All bits except watchdog reset, configuration, CAN and the summary bit: a healthy unit had the CAN bit set.
CRITICAL = 0x18FE
"""Status bits that make the data unusable. The device keeps sending data, so the host must check these bits."""


class GaugeReading(NamedTuple):
    """One reading: the status word and the six gauges in natural order G0..G5."""

    status: int
    gauges: NDArray[np.int32]


class Firmware(NamedTuple):
    """Firmware version, which can be compared with a tuple."""

    major: int
    minor: int
    build: int


def decode_gauges(first: bytes, second: bytes) -> GaugeReading:
    """Decode the two halves of a reading: status, G0, G2, G4, and G1, G3, G5."""
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
    """Decode the serial number in a reply of the sensor."""
    _expect(data, 8, "serial number")
    return decode_text(data)


def decode_slot(data: bytes) -> int:
    """Decode the reply to `SELECT_SLOT`: the selected calibration slot."""
    return int(_unpack(">B", data, "calibration slot echo")[0])


def decode_counts_per_unit(data: bytes) -> tuple[int, int]:
    """Decode counts per unit of force and of torque."""
    force, torque = _unpack(">II", data, "counts per unit")
    if not force or not torque:
        raise ProtocolError(f"counts per unit must be positive, but are {force} and {torque}")
    return force, torque


def decode_unit_codes(data: bytes) -> tuple[int, int]:
    """Decode the unit codes of force and torque."""
    force, torque = _unpack(">BB", data, "unit codes")
    return force, torque


def decode_firmware(data: bytes) -> Firmware:
    """Decode the firmware version in a reply of the sensor."""
    return Firmware(*_unpack(">BBH", data, "firmware version"))


def _expect(data: bytes, size: int, what: str) -> None:
    if len(data) != size:
        raise ProtocolError(f"{what}: expected {size} bytes, got {len(data)} ({data.hex(' ')})")


def _unpack(form: str, data: bytes, what: str) -> tuple[int, ...]:
    _expect(data, struct.calcsize(form), what)
    return struct.unpack(form, data)


# -------------------------------------------------------------------------- from counts to N, for all ATI interfaces

FORCE_UNITS_N = {
    "lbf": 4.4482216152605,
    "N": 1.0,
    "klbf": 4448.2216152605,
    "kN": 1000.0,
    "kgf": 9.80665,
    "gf": 0.00980665,
}
"""One unit of force in N, in the order of ATI's unit codes 1 to 6. Units of torque have the same order."""
TORQUE_UNITS_NM = {
    "lbf-in": 0.1129848290276167,
    "lbf-ft": 1.3558179483314004,
    "N-m": 1.0,
    "N-mm": 0.001,
    "kgf-cm": 0.0980665,
    "kN-m": 1000.0,
}
NEWTON, NEWTON_METRE = 2, 3

_FORCES, _TORQUES = tuple(FORCE_UNITS_N), tuple(TORQUE_UNITS_NM)
_LOWEST, _HIGHEST = -32768, 32767


def unit_names(unit_codes: tuple[int, int]) -> tuple[str, str]:
    """Return the names of the units of force and torque. Raises `ProtocolError` for unknown codes."""
    force, torque = unit_codes
    if not (1 <= force <= len(_FORCES) and 1 <= torque <= len(_TORQUES)):
        raise ProtocolError(f"unit codes are {force} (force) and {torque} (torque), but only 1 to 6 are known")
    return _FORCES[force - 1], _TORQUES[torque - 1]


def units(unit_codes: tuple[int, int]) -> tuple[float, float]:
    """Return one unit of force in N and one unit of torque in N·m. Raises `ProtocolError` for unknown codes."""
    force, torque = unit_names(unit_codes)
    return FORCE_UNITS_N[force], TORQUE_UNITS_NM[torque]


def parse_units(text: str) -> tuple[int, int]:
    """Return the unit codes of an option such as ``lbf,lbf-in``. Raises `ValueError` for an unknown unit."""
    force, _, torque = text.partition(",")
    if force not in _FORCES or torque not in _TORQUES:
        raise ValueError(
            f"units are '{text}'; give one of {' '.join(_FORCES)}, a comma, and one of {' '.join(_TORQUES)}"
        )
    return _FORCES.index(force) + 1, _TORQUES.index(torque) + 1


@dataclass(frozen=True, slots=True, eq=False)
class Calibration:
    """One calibration of one transducer."""

    wrench_per_count: Array
    """(6, 6) N and N·m (rows Fx..Tz) per gauge count (columns G0..G5)."""
    counts_per_N: float
    counts_per_Nm: float

    @classmethod
    def from_vendor(cls, matrix: Array, counts_per_unit: tuple[int, int], unit_codes: tuple[int, int]) -> "Calibration":
        """Build a calibration from the values that the device reports.

        Parameters
        ----------
        matrix : array, shape (6, 6)
            The run-time matrix, which includes the gauge gains, in counts per gauge count.
        counts_per_unit, unit_codes : (int, int)
            Values for force and for torque.

        Raises
        ------
        ProtocolError
            A unit code is unknown, or the matrix is singular or not finite.
        """
        unit_N, unit_Nm = units(unit_codes)
        if not np.isfinite(matrix).all() or np.linalg.matrix_rank(matrix) < 6:
            raise ProtocolError("the calibration matrix is empty or not invertible")
        counts_per_N, counts_per_Nm = counts_per_unit[0] / unit_N, counts_per_unit[1] / unit_Nm
        return cls(matrix / np.repeat([counts_per_N, counts_per_Nm], 3)[:, np.newaxis], counts_per_N, counts_per_Nm)

    def wrench(self, gauges: NDArray[Any]) -> Array:
        """Convert gauges (n, 6) to wrenches (n, 6) in N and N·m."""
        return np.asarray(gauges @ self.wrench_per_count.T)


def refuse_saturated(name: str, gauges: NDArray[np.int32]) -> None:
    """Raise `DeviceFault` if a gauge is at the end of its range in any row of `gauges` (n, 6).

    Such a wrench is meaningless. No status bit reports an overload or a broken cable.
    """
    saturated = np.flatnonzero(((gauges == _LOWEST) | (gauges == _HIGHEST)).any(axis=0))
    if len(saturated):
        names = ", ".join(f"G{gauge}" for gauge in saturated)
        raise DeviceFault(f"{name}: gauge {names} is at the end of its range", "remove the load and check the cable")
