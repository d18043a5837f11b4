"""The loop that reads a stream: how long it waits, what it says, and what becomes of a sink that fails or is slow."""

from collections.abc import Sequence
from contextlib import suppress
from typing import Any, cast

import pytest

from ftdrive.stream.samples import Block, StreamEvent
from ftdrive.stream.stream import Sink, pump
from ftdrivers.errors import DeviceTimeout
from tests.fake_clock import FakeClock
from tests.unit.ftdrive.servers.fake_stream import RATE_HZ, FakeStream, block

FULL = OSError(28, "No space left on device")


class Source(FakeStream):
    """A stream whose reads fail at each `x`; each of the others has 0.1 s and an event. Ctrl-C ends it."""

    def __init__(self, reads: str) -> None:
        super().__init__()
        self.clock, self.left, self.events = FakeClock(), list(reads), list[StreamEvent]()
        self.has_ended = False

    def read(self) -> Block:
        one = self.left.pop(0) if self.left else "last"
        self.events.append(StreamEvent(0, "mark", one))
        if one == "last":
            raise KeyboardInterrupt
        if one == "x":
            self.clock.sleep(0.3)
            raise DeviceTimeout("silent")
        self.has_ended = one == "z"
        return block(round(0.1 * RATE_HZ))

    def take_events(self) -> list[StreamEvent]:
        events, self.events = self.events, []
        return events


class Output(Sink):
    """Keeps what it gets, takes `slow_s` for each block, and raises `fails` with the second one."""

    def __init__(self, source: Source, slow_s: float = 0.0, fails: Exception | None = None) -> None:
        self.source, self.slow_s, self.fails = source, slow_s, fails
        self.got, self.events, self.calls = "", "", list[str]()

    def begin(self, _: object) -> None:
        self.calls.append("begin")

    def add(self, block: Block | None, events: Sequence[StreamEvent]) -> None:
        self.got += "-" if block is None else "." if block else "0"
        if self.fails is not None and self.got == "..":
            raise self.fails
        self.events += "".join(event.text for event in events)
        if block:
            self.source.clock.sleep(self.slow_s)

    def end(self) -> None:
        self.calls.append("end")


class Recorder(Output):
    label, keeps_all = "recording", True


def run(source: Source, *sinks: Sink, **options: Any) -> list[str]:
    """Read to the end or to Ctrl-C, and return what is said."""
    said = list[str]()
    with suppress(KeyboardInterrupt):
        for _ in pump(cast(Any, source), [*sinks], say=said.append, **options):
            pass
    return said


def test_an_interruption_is_said_once_and_each_sink_gets_all_blocks_and_events() -> None:
    sinks = [Output(source := Source("axxbxc")) for _ in range(2)]
    assert run(source, *sinks, meanwhile="Viewers wait.") == ["silent. Viewers wait.", "Samples arrive again."] * 2
    for sink in sinks:
        assert (sink.got, sink.events, sink.calls) == (".--.-.-", "axxbxclast", ["begin", "end"])
    assert run(Source("axb")) == [], "without words for it nothing is said"


def test_a_sink_that_fails_is_ended_and_said_and_the_others_go_on() -> None:
    fails, goes_on = Output(source := Source("abcd"), fails=FULL), Output(source)
    assert run(source, fails, goes_on) == ["output stopped with an error: [Errno 28] No space left on device"]
    assert (fails.got, fails.calls) == ("..", ["begin", "end"])
    assert goes_on.got == "....-"


def test_a_slow_sink_misses_samples_and_no_event_while_a_recorder_and_others_get_all() -> None:
    quick = Output(source := Source("a" * 100))
    slow, recorder = Output(source, slow_s=0.3), Recorder(source, slow_s=0.3)
    (said,) = run(source, quick, slow, recorder)
    assert quick.got == recorder.got == "." * 100 + "-"
    assert (quick.missed, recorder.missed) == (0, 0)
    given = slow.got.count(".")
    assert slow.got.startswith("." * 5), "a delay of one second is nothing"
    assert given * 0.3 == pytest.approx(100 * 0.1 + 1, abs=0.3), "as many as it can take in time"
    assert (slow.missed, slow.events) == ((100 - given) * round(0.1 * RATE_HZ), "a" * 100 + "last")
    assert said == f"output missed {slow.missed} samples because it is slower than the sensor"
