"""Robotiq FT 300 frames: damage, headers inside the data, replies and identity."""

import pytest

from ftdrivers.errors import ProtocolError
from ftdrivers.robotiq import codec

FRAME = bytes.fromhex("20 4E D2 04 C9 FD 10 27 96 00 E7 FF E8 03 86 DC")
START, STARTED = bytes.fromhex("09 10 01 9A 00 01 02 02 00 CD CA"), bytes.fromhex("09 10 01 9A 00 01 21 52")


@pytest.mark.parametrize("at", range(16))
def test_a_changed_byte_is_noticed(at: int) -> None:
    assert codec.is_frame(FRAME)
    damaged = bytearray(FRAME)
    damaged[at] ^= 0x01
    assert not codec.is_frame(bytes(damaged))
    with pytest.raises(ProtocolError, match="not a stream frame"):
        codec.decode_frame(bytes(damaged))


def test_identity() -> None:
    letters = [0x4654, 0x5300]
    assert codec.decode_serial([*letters, 1234, 0]) == "FTS-1234"
    assert codec.decode_serial([*letters, 1, 1]) == "FTS-65537"
    assert codec.decode_serial([0, 0, 7, 0]) == "0007"
    assert codec.decode_serial([0, 0, 0, 0]) == "not reported"
    assert codec.decode_firmware([0x4654, 0x5302, 0x0001]) == "FTS-2.0.1"
    assert codec.decode_firmware([0, 2, 0x0001]) == "2.0.1"
    for letters in ([0x4620, 0x5300], [0x467F, 0x5300], [0x4654, 0x8000]):  # a space, DEL, none of ASCII
        assert codec.decode_serial([*letters, 1234, 0]) == "1234"
    assert codec.decode_serial([0x217E, 0x4100, 12, 0]) == "!~A-0012"
    for words in ([*letters, 1], [*letters, -1, 0], [*letters, 0x10000, 0]):
        with pytest.raises(ProtocolError, match="expected 4 registers"):
            codec.decode_serial(words)
