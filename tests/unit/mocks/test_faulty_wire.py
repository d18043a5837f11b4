"""What every emulated sensor shares: the faulty wire and the pacing of streams."""

import time
from itertools import pairwise

import pytest
from hypothesis import given
from hypothesis import strategies as st

from mocks.faults import Faults, FaultyWire
from mocks.slcan import CanFrame
from mocks.stream import MAX_BACKLOG_S, Pacer

LATER = 1e6  # seconds: whatever is on its way has arrived


def sent(faults: Faults, frames: list[bytes], *, stream: bool = False, seed: int = 1) -> list[bytes]:
    wire: FaultyWire[bytes] = FaultyWire(faults, seed)
    wire.put(frames, stream=stream)
    return wire.due(time.monotonic() + LATER)


@given(st.lists(st.binary(), max_size=20), st.booleans())
def test_without_faults_everything_arrives_as_it_is(frames: list[bytes], stream: bool) -> None:
    assert sent(Faults(), frames, stream=stream) == frames


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


def test_a_stream_keeps_a_frame_back_until_the_next_one() -> None:
    faults = Faults(swap=1)
    wire: FaultyWire[bytes] = FaultyWire(faults)
    wire.put([b"1"], stream=True)
    assert wire.due(time.monotonic() + LATER) == []
    faults.swap = 0
    wire.put([b"2"], stream=True)
    assert wire.due(time.monotonic() + LATER) == [b"2", b"1"]


@pytest.mark.parametrize(("faults", "low", "high"), [(Faults(drop=0.1), 850, 950), (Faults(duplicate=0.1), 1050, 1150)])
def test_chances_are_as_told_and_seeded(faults: Faults, low: int, high: int) -> None:
    assert low < len(sent(faults, NUMBERED)) < high
    assert sent(faults, NUMBERED, seed=5) == sent(faults, NUMBERED, seed=5) != sent(faults, NUMBERED, seed=6)


def test_foreign_frames_precede_and_can_frames_stay_whole() -> None:
    alien, own = CanFrame(0x7FF), CanFrame(1, b"12345678")
    wire = FaultyWire(Faults(foreign=1, corrupt=1, byte_slip=1), foreign=lambda _rng: alien)
    wire.put([own, own])
    assert wire.due(time.monotonic() + LATER) == [alien, own, alien, own]


def test_delay_and_jitter_keep_the_order() -> None:
    wire: FaultyWire[bytes] = FaultyWire(Faults(delay_s=0.5, jitter_s=0.1))
    wire.put(NUMBERED[:10])
    wire.put(NUMBERED[10:20])
    now_s = time.monotonic()
    wait_s = wire.wait_s(now_s)
    assert wait_s is not None
    assert 0.45 < wait_s < 0.6
    arrivals = [wire.due(now_s + t) for t in (0.4, 0.52, 0.61)]
    assert arrivals[0] == []
    assert arrivals[1] + arrivals[2] == NUMBERED[:20]
    assert wire.wait_s(now_s) is None


def test_jitter_does_not_add_up_in_a_stream(monkeypatch: pytest.MonkeyPatch) -> None:
    """A frame every millisecond with up to 20 ms of jitter: none is ever later than 20 ms, and some are late."""
    now_s = [100.0]
    monkeypatch.setattr("mocks.faults.time.monotonic", lambda: now_s[0])
    wire: FaultyWire[bytes] = FaultyWire(Faults(jitter_s=0.02))
    waits_s = []
    for number in range(2000):
        now_s[0] = 100.0 + 0.001 * number
        wire.put([b"%d" % number])
        wire.due(now_s[0])
        waits_s.append(wire.wait_s(now_s[0]) or 0.0)
    assert 0.005 < max(waits_s) <= 0.02
    assert len(wire.due(now_s[0] + 0.02)) <= 20


def test_pacer_is_on_schedule() -> None:
    pacer = Pacer()
    assert (pacer.due(time.monotonic()), pacer.wait_s(0.0), pacer.running) == (0, None, False)
    start_s = time.monotonic()
    pacer.start(100)
    steps_s = [start_s + 0.001 + 0.003 * i for i in range(335)]
    counts = [pacer.due(now_s) for now_s in steps_s]
    assert counts[0] == 1, "the first sample at once"
    assert set(counts) == {0, 1}
    assert sum(counts) == pacer.made == 101
    assert all(a + b < 2 for a, b in pairwise(counts))
    pacer.stop()
    assert pacer.due(start_s + 10) == 0


def test_pacer_leaves_out_what_a_pause_of_the_process_missed() -> None:
    pacer = Pacer()
    pacer.start(1000)
    now_s = time.monotonic() + 5
    assert pacer.due(now_s) == MAX_BACKLOG_S * 1000
    assert pacer.made == pytest.approx(5001, abs=2)
    assert pacer.due(now_s) == 0
