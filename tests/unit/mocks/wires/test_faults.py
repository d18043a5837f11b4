"""What goes wrong between a sensor and its client: certain faults, foreign frames, and marks of wrong parity."""

import pytest

from ftmocks.clock import CellClock
from ftmocks.wires.faults import Faults, FaultyWire
from ftmocks.wires.slcan import CanFrame
from ftmocks.wires.uart import WrongParity, marked
from tests.unit.mocks.real_time import RealTime

CLOCK = CellClock(RealTime())
"""Of the tests in which no time passes."""
LATER_S = CLOCK.now_s() + 1e6
"""Whatever is on its way has arrived."""


def sent(faults: Faults, frames: list[bytes], *, stream: bool = False, seed: int = 1) -> list[bytes]:
    wire: FaultyWire[bytes] = FaultyWire(faults, CLOCK, seed)
    wire.put(frames, stream=stream)
    return wire.due(LATER_S)


NUMBERED = [i.to_bytes(2, "big") for i in range(1000)]


def test_certain_faults() -> None:
    assert sent(Faults(drop=1), NUMBERED) == []
    assert sent(Faults(stall=True), NUMBERED) == []
    assert sent(Faults(duplicate=1), NUMBERED[:2]) == [NUMBERED[0], NUMBERED[0], NUMBERED[1], NUMBERED[1]]
    assert sent(Faults(swap=1), NUMBERED[:4]) == [NUMBERED[i] for i in (1, 0, 3, 2)]
    assert sent(Faults(swap=1), NUMBERED[:3]) == [NUMBERED[i] for i in (1, 0, 2)], "an answer keeps nothing back"
    assert all(
        len(a) == len(b) == sum(x == y for x, y in zip(a, b, strict=True)) + 1
        for a, b in zip(sent(Faults(corrupt=1), NUMBERED), NUMBERED, strict=True)
    )
    assert {len(frame) for frame in sent(Faults(byte_slip=1), NUMBERED)} == {1}


def test_foreign_frames_precede_and_can_frames_stay_whole() -> None:
    alien, own = CanFrame(0x7FF), CanFrame(1, b"12345678")
    wire: FaultyWire[CanFrame] = FaultyWire(Faults(foreign=1, corrupt=1, byte_slip=1), CLOCK)
    wire.foreign = lambda _rng: alien
    wire.put([own, own])
    assert wire.due(LATER_S) == [alien, own, alien, own]


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
