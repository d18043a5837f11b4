"""Wrong parity in the emulators: what a frame knows of it, how it is marked, and a terminal that is full."""

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from ftmocks.clock import CellClock
from ftmocks.sensors.ati_serial import RECORD_BYTES, AtiSerialBox
from ftmocks.wires.faults import Faults, FaultyWire
from ftmocks.wires.uart import WrongParity, marked
from tests.unit.mocks.real_time import RealTime

CLOCK = CellClock(RealTime())
LATER = 1e6  # seconds: whatever is on its way has arrived
BYTES = st.binary(max_size=30) | st.lists(st.sampled_from([0x00, 0x01, 0xFF]), max_size=30).map(bytes)


@st.composite
def wrong(draw: st.DrawFn) -> WrongParity:
    data = draw(BYTES.filter(bool))
    return WrongParity(data, draw(st.integers(0, len(data) - 1)))


def unmarked(wire: bytes) -> list[tuple[int, bool]]:
    """Every byte, and whether it was marked, by the rules of POSIX."""
    read, characters = iter(wire), []
    for byte in read:
        if byte != 0xFF:
            characters.append((byte, False))
        elif (second := next(read)) == 0xFF:
            characters.append((0xFF, False))
        else:
            assert second == 0
            characters.append((next(read), True))
    return characters


@pytest.mark.parametrize(
    ("data", "wire"),
    [
        (b"", ""),
        (b"a\xff\0b", "61 FF FF 00 62"),
        (WrongParity(b"abc", 1), "61 FF 00 62 63"),
        (WrongParity(b"\xffa\xff", 2), "FF FF 61 FF 00 FF"),
        (WrongParity(b"\0\0", 0), "FF 00 00 00"),
    ],
)
def test_marks_of_posix(data: bytes, wire: str) -> None:
    assert marked(data) == bytes.fromhex(wire)


@given(st.integers(0, 2**32))
def test_corrupt_shows_when_an_odd_number_of_bits_is_wrong(seed: int) -> None:
    frame = bytes(range(13))
    whole, slipped = (corrupted(frame, seed, byte_slip) for byte_slip in (0.0, 1.0))
    flipped = [(a ^ b).bit_count() for a, b in zip(frame, whole, strict=True)]
    assert sum(count > 0 for count in flipped) == 1
    characters = unmarked(marked(whole))
    assert characters == [(byte, count % 2 == 1) for byte, count in zip(whole, flipped, strict=True)]
    assert unmarked(marked(slipped)) in [characters[:i] + characters[i + 1 :] for i in range(13)]


def corrupted(frame: bytes, seed: int, byte_slip: float) -> bytes:
    wire: FaultyWire[bytes] = FaultyWire(Faults(corrupt=1, byte_slip=byte_slip), CLOCK, seed)
    wire.put([frame])
    return wire.due(CLOCK.now_s() + LATER)[0]


class Box(AtiSerialBox):
    """An emulator whose client asks for marks."""

    def _client_wants_marks(self) -> bool:
        return True

    def send(self, burst: bytes) -> int:
        return self._send(burst, RECORD_BYTES)

    def finish(self) -> None:
        while self._unsent or self._begun:
            self._finish_record()


@given(
    st.lists(
        st.tuples(st.integers(1, 3), st.integers(0, 12) | st.none(), st.sampled_from([0xFF, 0x00])),
        min_size=1,
        max_size=12,
    ),
    st.lists(st.integers(0, 3) | st.integers(0, 60), max_size=40),
)
@example([(1, 12, 0x00), (1, None, 0x00)], [13, 0, 0, 1, 60])
@example([(1, None, 0xFF), (1, None, 0x00)], [1, 0, 0])
@example([(3, None, 0xFF)], [1])
def test_a_full_terminal_drops_whole_records_and_breaks_no_mark(
    bursts: list[tuple[int, int | None, int]], room: list[int]
) -> None:
    """Bursts of numbered records, each with a wrong byte or none, into a terminal with so much room at each write."""
    box = Box(lambda n: np.zeros((n, 6)))
    wire, rooms = bytearray(), iter(room)

    def write(_master: int, data: bytes) -> int:
        count = min(len(data), next(rooms, len(data)))
        if data and not count:
            raise BlockingIOError
        wire.extend(data[:count])
        return count

    sent: list[list[tuple[int, bool]]] = []
    dropped = 0
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("ftmocks.wires.pty.os.write", write)
        for count, at, filler in bursts:
            data = b"".join(bytes([filler] * 12 + [len(sent) + i]) for i in range(count))
            burst = data if at is None else WrongParity(data, at)
            characters = unmarked(marked(burst))
            sent += [characters[i : i + RECORD_BYTES] for i in range(0, len(data), RECORD_BYTES)]
            dropped += box.send(burst)
        box.finish()
    characters = unmarked(bytes(wire))
    arrived = [characters[i : i + RECORD_BYTES] for i in range(0, len(characters), RECORD_BYTES)]
    assert len(arrived) == len(sent) - dropped
    numbers = [record[-1][0] for record in arrived]
    assert numbers == sorted(set(numbers))
    assert arrived == [sent[number] for number in numbers]
