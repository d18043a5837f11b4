"""NETCANOEM frames that the dialogue of test_can_driver.py does not show."""

import struct

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ftdrivers.ati import codec
from ftdrivers.errors import ProtocolError
from ftdrivers.wires.framing import describe_status

i16 = st.integers(-32768, 32767)


def test_capture_of_a_real_unit() -> None:
    first = codec.decode_gauges(bytes.fromhex("4000 0012 FE3A E6A8"), bytes.fromhex("04FA FA93 0143"))
    assert first.status == 0x4000
    assert not first.status & codec.CRITICAL  # this unit was measuring well
    assert first.gauges.tolist() == [18, 1274, -454, -1389, -6488, 323]
    second = codec.decode_gauges(bytes.fromhex("4000 0043 FE77 E6EE"), bytes.fromhex("0569 FAE0 0183"))
    assert second.gauges.tolist() == [67, 1385, -393, -1312, -6418, 387]
    row = codec.decode_matrix_row(
        bytes.fromhex("3F40256A C1DAD5F4"), bytes.fromhex("3FF85F58 C1CCED0E"), bytes.fromhex("3F9FF9FC C1DD29AD")
    )
    np.testing.assert_allclose(row, [0.75057, -27.35447, 1.94041, -25.61575, 1.24982, -27.64535], atol=5e-6)


def test_identity_and_units() -> None:
    assert codec.decode_serial(bytes.fromhex("4654313233343500")) == "FT12345"
    assert codec.decode_serial(b"FT1    \0") == "FT1"
    assert codec.decode_slot(bytes.fromhex("00")) == 0
    assert codec.decode_counts_per_unit(bytes.fromhex("000F4240000F4240")) == (1_000_000, 1_000_000)
    assert codec.decode_unit_codes(bytes.fromhex("0203")) == (2, 3)
    firmware = codec.decode_firmware(bytes.fromhex("03080002"))
    assert firmware == (3, 8, 2)
    assert firmware >= codec.COUNTS_PER_UNIT_SINCE
    assert codec.Firmware(3, 7, 0) >= codec.COUNTS_PER_UNIT_SINCE > codec.Firmware(3, 6, 99)


def test_status_in_words() -> None:
    assert describe_status(0, codec.STATUS_BITS) == "0x0000 (ok)"
    assert describe_status(0x8040, codec.STATUS_BITS) == (
        "0x8040 (bit 6: no valid calibration in the active slot, bit 15: any error)"
    )
    critical = {bit for bit in range(16) if codec.CRITICAL >> bit & 1}
    assert critical == {1, 2, 3, 4, 5, 6, 7, 11, 12}


@pytest.mark.parametrize("bad", ["7FC00000", "7F800000", "FF800000"])
def test_a_matrix_that_is_not_finite_is_refused(bad: str) -> None:
    with pytest.raises(ProtocolError, match="not finite"):
        codec.decode_matrix_row(bytes(8), bytes(4) + bytes.fromhex(bad), bytes(8))


@given(st.integers(0, 0xFFFF), st.tuples(i16, i16, i16, i16, i16, i16))
def test_gauges_round_trip(status: int, gauges: tuple[int, ...]) -> None:
    first = struct.pack(">H3h", status, *gauges[0::2])
    second = struct.pack(">3h", *gauges[1::2])
    reading = codec.decode_gauges(first, second)
    assert reading.status == status
    assert tuple(reading.gauges) == gauges


@given(st.lists(st.floats(width=32, allow_nan=False, allow_infinity=False), min_size=6, max_size=6))
def test_matrix_row_round_trip(row: list[float]) -> None:
    data = struct.pack(">6f", *row)
    assert codec.decode_matrix_row(data[:8], data[8:16], data[16:]).tolist() == row
