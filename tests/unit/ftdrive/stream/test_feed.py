"""What is read for the screen: keys act between two reads, a recorder never ends the screen."""

from collections.abc import Sequence
from functools import partial

from ftdrive.errors import ConfigError
from ftdrive.stream.samples import Block, StreamEvent
from ftdrive.stream.stream import Sink
from tests.unit.ftdrive.terminal.fake_stream import FakeStream, SteppedFeed


class Tape(Sink):
    label, keeps_all = "recording", True

    def __init__(self, full_after: int = 1000) -> None:
        self.blocks: list[Block] = []
        self.events: list[StreamEvent] = []
        self.closed = 0
        self._full_after = full_after

    def add(self, block: Block | None, events: Sequence[StreamEvent]) -> None:
        if block and len(self.blocks) == self._full_after:
            raise OSError(28, "No space left on device")
        self.blocks += [block] if block else []
        self.events += events

    def end(self) -> None:
        self.closed += 1


def test_a_recording_has_all_blocks_and_events_from_key_to_key() -> None:
    tape = Tape()
    feed = SteppedFeed(FakeStream(), lambda path: tape if path.name == "live-2026-11-16T150000Z.mcap" else Tape(0))
    _, notes = feed.subscribe()
    feed.step()
    feed.do(feed.switch_recording)
    feed.step()
    feed.do(partial(feed.stream.mark, "peg in"))
    feed.step()
    assert feed.recording_s is not None
    feed.do(feed.switch_recording)
    feed.step()
    assert notes[0].text.endswith("live-2026-11-16T150000Z.mcap")
    assert (len(tape.blocks), [event.kind for event in tape.events], tape.closed) == (2, ["mark"], 1)
    assert feed.recording_s is None


def test_a_full_disk_ends_the_recording_and_not_the_screen() -> None:
    tape = Tape(full_after=2)
    feed = SteppedFeed(FakeStream(), lambda _: tape)
    blocks, notes = feed.subscribe()
    feed.do(feed.switch_recording)
    feed.step(5)
    assert len(blocks) == 5
    assert tape.closed == 1
    assert feed.recording_s is None
    assert "recording stopped with an error: [Errno 28] No space left on device" in [note.text for note in notes]


def test_a_request_that_is_refused_is_a_line_on_the_screen() -> None:
    def refuse() -> None:
        raise ConfigError("a torque about the tcp needs [sensor] height_mm")

    feed = SteppedFeed(FakeStream())
    blocks, notes = feed.subscribe()
    feed.do(refuse)
    feed.do(feed.switch_recording)
    feed.step(2)
    assert notes[0].text == "a torque about the tcp needs [sensor] height_mm"
    assert "use `ftdrive record" in notes[1].text
    assert len(blocks) == 2
