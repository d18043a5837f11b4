"""Digital F/T replies, calibration blocks and stream records: what is refused, and what happens to damaged records."""

import struct

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ftdrivers.ati import modbus
from ftdrivers.errors import ProtocolError

i16 = st.integers(-32768, 32767)


@pytest.mark.parametrize(
    ("request_", "reply", "message"),
    [
        (modbus.read_registers(0x7000, 1), "0A 83 02 B1 33", "illegal register"),
        (modbus.START, "0A 46 00 63 A2", "refused command 0x46 0x55"),
        (modbus.START, "0A 46 01 A2 63", "damaged"),
        (modbus.START, "0A 6A 01 BE A2", "does not belong"),
        (modbus.read_registers(modbus.STATUS, 2), "0A 03 02 00 00 1D 85", "does not belong"),
        (modbus.write_registers(modbus.GAINS, [0] * 6), "0A 10 00 06 00 06 A1 71", "other registers"),
        (modbus.read_registers(modbus.STATUS, 1), "0A 03 04 00 00 FD 84", "announces 4 bytes"),
        (modbus.START, "", "empty"),
    ],
)
def test_wrong_replies_are_refused(request_: bytes, reply: str, message: str) -> None:
    with pytest.raises(ProtocolError, match=message):
        modbus.check_reply(request_, bytes.fromhex(reply))


def block(**change: bytes) -> bytes:
    """Build the 338 bytes of a calibration, field by field at the documented register offsets."""
    data = bytearray(338)
    fields = {
        0: b"FT12345\0",
        8: b"SI-130-10".ljust(32, b"\0"),
        40: b"Net\0",
        44: b"2019-09-2404:00:00Z\0",
        64: struct.pack(">36f", *range(36)),
        208: b"\x02\x03",
        210: struct.pack(">6f", 130, 130, 400, 10, 10, 10.5),
        234: struct.pack(">ii", 1_000_000, 2_000_000),
        242: struct.pack(">6H", 543, 555, 569, 579, 565, 567),
        254: struct.pack(">6H", 29000, 30000, 31000, 32000, 33000, 34000),
    } | {int(key[1:]): value for key, value in change.items()}
    for offset, value in fields.items():
        data[offset : offset + len(value)] = value
    return bytes(data)


@pytest.mark.parametrize("empty", [bytes(338), b"\xff" * 338, block(_234=bytes(4)), block(_64=b"\x7f\xc0\0\0")])
def test_an_empty_calibration_is_refused(empty: bytes) -> None:
    with pytest.raises(ProtocolError, match="empty"):
        modbus.decode_calibration_block(empty)


def test_where_calibrations_are_stored() -> None:
    assert modbus.calibration_reads(1) == [(0x00E3, 64), (0x0123, 64), (0x0163, 41)]
    assert modbus.calibration_reads(16)[0] == (0x0C23, 64)


@given(st.lists(st.tuples(st.tuples(i16, i16, i16, i16, i16, i16), st.booleans())))
def test_records_round_trip(rows: list[tuple[tuple[int, ...], bool]]) -> None:
    data = b""
    for gauges, error in rows:
        body = struct.pack(">6h", *gauges[0::2], *gauges[1::2])
        data += body + bytes([sum(body) & 0x7F | error << 7])
    records = modbus.decode_records(data)
    assert [tuple(row) for row in records.gauges.tolist()] == [gauges for gauges, _ in rows]
    assert records.intact.all()
    assert records.error.tolist() == [error for _, error in rows]


@pytest.mark.parametrize(
    ("seen", "kept", "slipped"),
    [
        ("", "", False),
        ("gggg", "kkk", False),
        ("gbgg", "k-k", False),
        ("gbbgg", "k--k", False),
        ("ggb", "k", False),  # damage waits: is it the first of three? Then the one before it is not believed
        ("ggbb", "k", False),
        ("ggbg", "kk", False),  # is the last one real, or a chance in a slipped stream?
        ("gbgbgg", "k---k", False),
        ("ggbbb", "k-", True),
        ("gbgbbbgg", "k--", True),
        ("bbb", "", True),
        ("b", "", False),
    ],
)
def test_which_records_are_believed(seen: str, kept: str, slipped: bool) -> None:
    keep, settled, slip = modbus.keep_records(np.array([c == "g" for c in seen], dtype=bool))
    assert "".join("k" if k else "-" for k in keep) == kept
    assert (settled, slip) == (len(kept), slipped)
