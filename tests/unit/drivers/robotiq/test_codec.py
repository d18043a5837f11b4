"""Robotiq FT 300 frames: damage, headers inside the data, replies and identity."""

import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st

from ftdrivers.errors import ProtocolError
from ftdrivers.robotiq import codec
from ftdrivers.wires.framing import Deframer, crc16_modbus

FRAME = bytes.fromhex("20 4E D2 04 C9 FD 10 27 96 00 E7 FF E8 03 86 DC")
START, STARTED = bytes.fromhex("09 10 01 9A 00 01 02 02 00 CD CA"), bytes.fromhex("09 10 01 9A 00 01 21 52")
READ = bytes.fromhex("09 03 00 B4 00 06 84 A6")


def with_crc(body: bytes) -> bytes:
    return body + crc16_modbus(body).to_bytes(2, "little")


@pytest.mark.parametrize("at", range(16))
def test_a_changed_byte_is_noticed(at: int) -> None:
    assert codec.is_frame(FRAME)
    damaged = bytearray(FRAME)
    damaged[at] ^= 0x01
    assert not codec.is_frame(bytes(damaged))
    with pytest.raises(ProtocolError, match="not a stream frame"):
        codec.decode_frame(bytes(damaged))


@given(st.lists(st.sampled_from([0x4E20, 20000, 0x204E, -1, 0]), min_size=6, max_size=6), st.integers(0, 15))
def test_a_header_in_the_data_does_not_mislead(counts: list[int], joined_at: int) -> None:
    """20000 counts (200 N) look exactly like a header: whatever the byte one joins at, every whole frame is found."""
    frame = with_crc(codec.HEADER + struct.pack("<6h", *counts))
    frames = Deframer(codec.HEADER, codec.FRAME_SIZE, codec.is_frame)
    found = frames.feed((frame * 4)[joined_at:])
    assert [one for _, one in found] == [frame] * (4 if joined_at == 0 else 3)


def test_replies_are_checked_against_their_request() -> None:
    assert codec.check_reply(START, STARTED) == ()
    assert codec.check_reply(READ, with_crc(bytes.fromhex("09 03 0C 0001 0002 0003 0004 0005 FFFF"))) == (
        *(1, 2, 3, 4, 5),
        0xFFFF,
    )
    assert codec.reply_size(READ) == 17
    assert codec.reply_size(START) == len(STARTED)


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
