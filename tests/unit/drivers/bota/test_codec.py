"""Bota frames: golden vector and damage."""

import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st

from ftdrivers.bota import codec
from ftdrivers.errors import ProtocolError
from ftdrivers.wires.framing import crc16_x25

FRAME = bytes.fromhex("AA 0000 0000803F 000000C0 C3F51C41 CDCCCC3D CDCC4CBE 9A99993E 40420F00 0000CC41 3D0D")
f32 = st.floats(width=32)


def frame(*values: float | int) -> bytes:
    payload = struct.pack("<H6fIf", *values)
    return b"\xaa" + payload + crc16_x25(payload).to_bytes(2, "little")


def test_frame() -> None:
    assert len(FRAME) == codec.FRAME_SIZE == 37
    sample = codec.decode_frame(FRAME)
    assert sample.status == 0
    assert sample.wrench == pytest.approx((1, -2, 9.81, 0.1, -0.2, 0.3), rel=1e-6)
    assert sample.t_us == 1_000_000
    assert sample.temperature_C == 25.5


def test_bits_of_the_status() -> None:
    names = [codec.STATUS_BITS[bit.bit_length() - 1] for bit in (1, codec.OVERRANGE, codec.INVALID, codec.RAW)]
    assert names == ["application too slow", "overrange", "invalid measurement", "raw measurement"]
    assert sorted(codec.STATUS_BITS) == [0, 1, 2, 3]


@given(st.integers(0, 0xFFFF), st.tuples(f32, f32, f32, f32, f32, f32), st.integers(0, 2**32 - 1), f32)
def test_frames_round_trip_or_are_no_wrench(status: int, wrench: tuple[float, ...], t_us: int, celsius: float) -> None:
    data = frame(status, *wrench, t_us, celsius)
    if all(abs(value) < float("inf") for value in wrench):
        assert codec.decode_frame(data)[:3] == (status, wrench, t_us)
    else:
        with pytest.raises(ProtocolError, match="not finite"):
            codec.decode_frame(data)
