"""The thread that reads: failures are kept, keys act between two reads, a recorder never ends the screen."""

import threading
from typing import Any

import pytest

from ftdrive.errors import ConfigError
from ftdrive.live.samples import Block, StreamEvent
from ftdrive.terminal.live_feed import Feed
from ftdrivers.errors import DeviceTimeout
from tests.unit.ftdrive.terminal.fake_stream import FakeStream


class Tape:
    """A recorder in memory."""

    def __init__(self, full_after: int = 1000) -> None:
        self.blocks: list[Block] = []
        self.events: list[StreamEvent] = []
        self.closed = 0
        self._full_after = full_after

    def write(self, block: Block) -> None:
        if len(self.blocks) == self._full_after:
            raise OSError(28, "No space left on device")
        self.blocks.append(block)

    def event(self, event: StreamEvent) -> None:
        self.events.append(event)

    def close(self) -> None:
        self.closed += 1


def test_a_recording_has_all_blocks_and_events_from_key_to_key() -> None:
    tape = Tape()
    feed = Feed(FakeStream(), lambda path: tape if path.name == "live-2026-11-16T150000Z.mcap" else Tape(0))
    news = feed.subscribe()
    feed.step()
    feed.request("r")
    feed.step()
    feed.request("b", "peg in")
    feed.step()
    assert feed.recording_since_ns is not None
    feed.request("r")
    feed.step()
    assert news.notes[0].text.endswith("live-2026-11-16T150000Z.mcap")
    assert (len(tape.blocks), [event.kind for event in tape.events], tape.closed) == (2, ["mark"], 1)
    assert feed.recording_since_ns is None


def test_a_full_disk_ends_the_recording_and_not_the_screen() -> None:
    tape = Tape(full_after=2)
    feed = Feed(FakeStream(), lambda _: tape)
    news = feed.subscribe()
    feed.request("r")
    for _ in range(5):
        feed.step()
    assert len(news.blocks) == 5
    assert tape.closed == 1
    assert feed.recording_since_ns is None
    assert "recording ended: [Errno 28] No space left on device" in [note.text for note in news.notes]


def test_without_a_recorder_the_key_says_what_to_do() -> None:
    feed = Feed(FakeStream())
    news = feed.subscribe()
    feed.request("r")
    feed.step()
    assert "ftdrive record" in news.notes[-1].text


def test_a_request_that_is_refused_is_a_line_on_the_screen() -> None:
    class Refusing(FakeStream):
        def tare(self) -> StreamEvent:
            raise ConfigError("a torque about the tcp needs [sensor] height_mm")

    feed = Feed(Refusing())
    news = feed.subscribe()
    feed.request("t")
    feed.step()
    assert news.notes[0].text == "a torque about the tcp needs [sensor] height_mm"
    assert len(news.blocks) == 1


def test_a_failure_lasts_until_samples_arrive() -> None:
    stream = FakeStream(silent_after=3)
    feed = Feed(stream)
    news = feed.subscribe()
    for _ in range(4):
        feed.step()
    assert isinstance(feed.reader.failure, DeviceTimeout)
    assert feed.status.sensor.error
    stream.wake()
    feed.step()
    assert feed.reader.failure is None
    assert len(news.blocks) == 4


def test_the_thread_reads_until_it_is_stopped_and_completes_the_recording() -> None:
    tape, enough = Tape(), threading.Event()

    class Counted(FakeStream):
        def read(self) -> Block:
            if self.blocks >= 50:
                enough.set()
                threading.Event().wait(0.001)
            return super().read()

    feed = Feed(Counted(), lambda _: tape)
    feed.request("r")
    feed.start()
    assert enough.wait(20)
    feed.stop()
    assert tape.closed == 1
    assert len(tape.blocks) == feed.stream.blocks  # type: ignore[attr-defined]


def test_what_ends_the_thread_is_kept() -> None:
    class Broken(FakeStream):
        def read(self) -> Any:
            raise ConfigError("another device answers: start again")

    feed = Feed(Broken())
    feed.start()
    feed.stop()
    assert isinstance(feed.crash, ConfigError)


def test_a_screen_that_does_not_draw_costs_no_more_memory(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("ftdrive.terminal.live_feed._MOST_BLOCKS", 20)
    feed = Feed(FakeStream())
    news = feed.subscribe()
    for _ in range(30):
        feed.step()
    assert len(news.blocks) == 20


def test_each_reader_gets_every_block_and_note() -> None:
    feed = Feed(FakeStream())
    screen, page = feed.subscribe(), feed.subscribe()
    for _ in range(3):
        feed.step()
        page.blocks.clear()
    feed.note("pushed")
    assert len(screen.blocks) == 3
    assert [note.text for note in screen.notes] == [note.text for note in page.notes] == ["pushed"]
