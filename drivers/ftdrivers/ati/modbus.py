"""ATI Digital F/T over RS-485: Modbus RTU frames, the calibration block and the 13-byte stream, as pure functions.

Ref: ATI "Digital F/T" Modbus interface (sections 8.1, 8.3, 8.4 of 9620-05-Digital FT, as cited by public drivers).
Checked on hardware: no. Verified against: tests/unit/drivers/ati/test_modbus.py.

A decoder returns a value or raises `ProtocolError` and no other exception. Registers are big-endian, high word first.
"""

import struct
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray

from ftdrivers.ati.codec import decode_text
from ftdrivers.errors import ProtocolError
from ftdrivers.interfaces import Array
from ftdrivers.wires import modbus as _modbus

ADDRESS = 10
"""Slave address of every sensor, fixed by ATI."""

START_STREAM, STORAGE = 0x46, 0x6A

GAINS, OFFSETS, STATUS = 0x0000, 0x0006, 0x001D

# The stream continues after the program that started it has ended. Only a jamming sequence stops it.
JAM = b"\xaa" * 14
"""Jamming sequence that stops a running stream. Any 14 bytes do; these are not a Modbus frame."""

RECORD_SIZE = 13
NOMINAL_RATE_Hz = 7000.0

STATUS_BITS = {
    0: "watchdog reset",
    1: "excitation voltage too high",
    2: "excitation voltage too low",
    3: "artificial analog ground out of range",
    4: "power supply too high",
    5: "power supply too low",
    6: "no valid active calibration",
    7: "EEPROM error",
    8: "invalid configuration data",
    9: "gauge bridge supply current too high",
    10: "gauge bridge supply current too low",
    11: "thermistor too high",
    12: "thermistor too low",
    13: "DAC reading out of range",
    14: "CAN bus error",
    15: "any error",
}
WATCHDOG_RESET = 0x0001
ANY_ERROR = 0x8000
CRITICAL = 0x3EFE
"""Status bits that make the data unusable: all except watchdog reset, configuration, CAN and the summary bit."""

frame = partial(_modbus.frame, ADDRESS)
read_registers = partial(_modbus.read_registers, ADDRESS)
"""Returns the request to read registers. Up to 64 registers per request are known to work."""
write_registers = partial(_modbus.write_registers, ADDRESS)
reply_size = _modbus.reply_size

UNLOCK = frame(STORAGE, b"\xaa")
LOCK = frame(STORAGE, b"\x18")
START = frame(START_STREAM, b"\x55")


def check_reply(request: bytes, reply: bytes) -> bytes:
    """Check a complete reply to a request and return the bytes of its registers, see `ftdrivers.wires.modbus`."""
    payload = _modbus.check_reply(request, reply)
    function = request[1]
    if function not in {START_STREAM, STORAGE}:
        return payload
    if payload != b"\x01":
        raise _modbus.Refused(
            f"the sensor refused command 0x{function:02X} 0x{request[2]:02X} (reply 0x{payload.hex()})"
        )
    return b""


def calibration_reads(index: int) -> list[tuple[int, int]]:
    """Return pairs (start, count) of registers that hold calibration `index`, 1 to 16, with a count of at most 64."""
    base = 0x00E3 + 192 * (index - 1)
    return [(base, 64), (base + 64, 64), (base + 128, 41)]


@dataclass(frozen=True, slots=True, eq=False)
class _CalibrationBlock:
    """A calibration that is stored in the sensor."""

    serial: str
    part_number: str
    matrix: Array
    """(6, 6) calibration matrix, counts per gauge count, rows Fx..Tz, columns G0..G5."""
    unit_codes: tuple[int, int]
    max_rating: tuple[float, ...]
    """(6,) largest Fx..Tz, in the units of the unit codes."""
    counts_per_unit: tuple[int, int]
    gains: tuple[int, ...]
    offsets: tuple[int, ...]


def decode_calibration_block(data: bytes) -> _CalibrationBlock:
    """Decode the 338 bytes of a calibration. Raises `ProtocolError` for an empty slot."""
    if len(data) != 338:
        raise ProtocolError(f"a calibration has 338 bytes, got {len(data)}")
    matrix = np.frombuffer(data, ">f4", 36, offset=2 * 32).reshape(6, 6)
    force, torque = struct.unpack_from(">ii", data, 2 * 117)
    if not np.isfinite(matrix).all() or force <= 0 or torque <= 0:
        raise ProtocolError(f"the slot is empty: its counts per unit are {force} and {torque}")
    return _CalibrationBlock(
        serial=decode_text(data[0:8]),
        part_number=decode_text(data[8:40]),
        matrix=matrix.astype(np.float64),
        unit_codes=(data[208], data[209]),
        max_rating=struct.unpack_from(">6f", data, 2 * 105),
        counts_per_unit=(force, torque),
        gains=struct.unpack_from(">6H", data, 2 * 121),
        offsets=struct.unpack_from(">6H", data, 2 * 127),
    )


@dataclass(frozen=True, slots=True, eq=False)
class Records:
    """n decoded records of the stream: gauges, checks and error bits."""

    gauges: NDArray[np.int32]
    """(n, 6) gauge counts in natural order G0..G5."""
    intact: NDArray[np.bool_]
    """(n,) whether the checksum of a record is correct."""
    parity: NDArray[np.bool_]
    """(n,) whether the parity of all bytes is correct. Bad parity proves no slip: some adapters mark whole packets."""
    error: NDArray[np.bool_]
    """(n,) error bit, which asks the host to stop the stream and read the status word."""


_RECORD = np.dtype([("gauges", ">i2", 6), ("last", "u1")])
# Indices that restore the natural order of the gauges; a record has the order G0 G2 G4 G1 G3 G5.
_NATURAL_ORDER = np.array([0, 3, 1, 4, 2, 5])


def decode_records(data: bytes, damaged: Sequence[int] = ()) -> Records:
    """Decode n complete records of 13 bytes each: G0 G2 G4 G1 G3 G5, then error bit and 7-bit sum.

    The sum does not detect a flipped bit 7, and parity does not detect an even number of flipped bits in one byte.
    Together they detect any single damaged byte. `damaged` are the indices of bytes with wrong parity; indices beyond
    `data` are ignored.
    """
    if len(data) % RECORD_SIZE:
        raise ProtocolError(f"{len(data)} bytes are not a whole number of {RECORD_SIZE}-byte records")
    columns = np.frombuffer(data, np.uint8).reshape(-1, RECORD_SIZE).T.copy()
    total = columns[:12].sum(axis=0, dtype=np.uint8)  # overflow is harmless, because only seven bits are compared
    last = columns[12]
    # sums along columns and `take` are much faster than sums along short rows and strided assignments
    gauges = np.frombuffer(data, _RECORD)["gauges"].take(_NATURAL_ORDER, axis=1).astype(np.int32)
    intact = (total ^ last) & 0x7F == 0
    parity = np.ones(len(last), bool)
    parity[[place // RECORD_SIZE for place in damaged if place < len(data)]] = False
    return Records(gauges=gauges, intact=intact, parity=parity, error=last >= 0x80)


def keep_records(intact: NDArray[np.bool_]) -> tuple[NDArray[np.bool_], int, bool]:
    """Decide by checksums which of n records to keep, how many are decided, and whether the stream has slipped.

    The stream has no sync byte, and after a slip one record in 128 still passes the checksum. Three damaged records in
    a row are therefore treated as a slip, and an intact record between two damaged ones, or directly before a slip, is
    dropped. The last records can only be decided with their successors: pass the undecided ones again with the next
    records. After a slip, all bytes after the decided records are misaligned.
    """
    bad = ~intact
    n = len(bad)
    runs = np.flatnonzero(bad[:-2] & bad[1:-1] & bad[2:]) if n >= 3 else np.zeros(0, np.intp)
    slipped = len(runs) > 0
    if slipped:
        settled = int(runs[0])
    else:
        good = np.flatnonzero(intact)
        settled = int(good[-1]) if len(good) else 0
        if settled and bad[settled - 1]:
            settled -= 1
    keep = intact.copy()
    keep[1:-1] &= ~(bad[:-2] & bad[2:])
    if slipped and settled:
        keep[settled - 1] = False
    return keep[:settled], settled, slipped
