"""What the serial sensors share: checksums, and finding frames whose header also occurs in the data."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from ftdrivers.wires.framing import Deframer, crc16_modbus, crc16_x25


def test_checksums_of_the_standard_text() -> None:
    assert crc16_modbus(b"123456789") == 0x4B37
    assert crc16_x25(b"123456789") == 0x906E


def deframer() -> Deframer:
    """Frames of 6 bytes: A B, three bytes, their sum."""
    return Deframer(b"AB", 6, lambda frame: sum(frame[2:5]) & 0xFF == frame[5])


def frame(body: bytes) -> bytes:
    return b"AB" + body + bytes([sum(body) & 0xFF])


@given(st.lists(st.binary(min_size=3, max_size=3), max_size=10), st.integers(1, 20))
def test_every_frame_survives_any_cut_of_the_stream(bodies: list[bytes], step: int) -> None:
    stream = b"".join(map(frame, bodies))
    frames, found = deframer(), []
    for at in range(0, len(stream), step):
        found += frames.feed(stream[at : at + step])
    assert found == list(enumerate(map(frame, bodies), start=1))
    assert frames.damaged == 0


@given(st.lists(st.binary(max_size=30), max_size=10))
def test_any_bytes_are_taken_and_only_intact_frames_come_out(chunks: list[bytes]) -> None:
    frames = deframer()
    found = [pair for chunk in chunks for pair in frames.feed(chunk)]
    assert all(one == frame(one[2:5]) for _, one in found)
    assert [number for number, _ in found] == sorted({number for number, _ in found})


def test_a_false_header_costs_no_frame() -> None:
    inside = frame(b"xAB")  # the header occurs in the data
    frames = deframer()
    assert frames.feed(inside[3:] + inside + inside) == [(1, inside), (2, inside)]


@pytest.mark.parametrize(
    ("data", "arrived", "has_noise"),
    [
        (b"", "no bytes arrived", False),
        (b"A", "bytes arrived, but no frames of 6 bytes", True),
        (b"?" * 30, "bytes arrived, but no frames of 6 bytes", True),
        (b"?" + frame(b"abc") + b"?" * 6 + frame(b"abc"), "2 frames arrived", False),
    ],
)
def test_what_has_arrived_is_described(data: bytes, arrived: str, has_noise: bool) -> None:
    frames = deframer()
    frames.feed(data)
    assert (frames.arrived, frames.has_noise) == (arrived, has_noise)


def test_a_header_of_one_byte_may_stand_before_that_of_a_frame() -> None:
    frames, good = Deframer(b"A", 4, lambda frame: sum(frame[1:3]) & 0xFF == frame[3]), b"A\x01\x02\x03"
    assert frames.feed(b"A" + good + b"AA" + good) == [(1, good), (3, good)]


@pytest.mark.parametrize(
    ("junk", "missing"),
    [(b"AB...", 1), (b"A", 1), (b"A" * 6, 1), (b"B" * 12, 2), (frame(b"abc")[:-1] + b"?", 1), (b"ABAB", 1)],
)
def test_what_is_lost_is_counted_in_frames(junk: bytes, missing: int) -> None:
    good, frames = frame(b"abc"), deframer()
    assert frames.feed(junk) == []  # before the first frame nothing counts
    assert frames.feed(good) == [(1, good)]
    assert frames.feed(junk + good) == [(2 + missing, good)]
    assert frames.damaged == missing
