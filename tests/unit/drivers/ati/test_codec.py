"""NETCANOEM frames that the dialogue of test_can_driver.py does not show."""

import numpy as np

from ftdrivers.ati import codec


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
