"""What `stream` prints, what it passes on, and when it ends."""

from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any, Self, cast

import pytest
from click.testing import CliRunner

from ftdrive.commands import live_source, stream
from ftdrive.commands.common import CellOptions
from ftdrive.errors import ConfigError, exit_code
from ftdrive.live.samples import Block, StreamEvent, WrenchFrame
from ftdrive.live.stream import RECOVER_S
from ftdrivers.errors import DeviceTimeout
from tests.fake_clock import FakeClock
from tests.unit.ftdrive.servers.fake_stream import FakeStream, block


class Source(FakeStream):
    """Takes 50 ms for each block, and notes a stale event when it fails first."""

    def __init__(self, *fails: tuple[float, float], ends_s: float = 1.0) -> None:
        super().__init__()
        self.clock = FakeClock()
        self._begin_s = self.clock.now_s()
        self._fails = fails
        self._ends_s = ends_s
        self.warnings = ["the arm reports no serial number"]
        self.events: list[StreamEvent] = []
        self.reads = 0

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        pass

    def read(self) -> Block:
        self.clock.advance(0.05)
        t_s = self.clock.now_s() - self._begin_s
        if t_s > self._ends_s:
            self.events.append(StreamEvent(0, "mark", "the last"))
            raise KeyboardInterrupt
        if any(start < t_s < end for start, end in self._fails):
            self.events.append(StreamEvent(0, "stale", f"sensor: silent at {t_s:.0f} s"))
            raise DeviceTimeout("no sample for 0.3 s", "check cable and supply")
        self.reads += 1
        return block(1, self.reads)

    def take_events(self) -> list[StreamEvent]:
        events, self.events = self.events, []
        return events


class Sink:
    def __init__(self) -> None:
        self.blocks: list[Block] = []
        self.events: list[StreamEvent] = []
        self.write: Callable[[Block], None] = self.blocks.append
        self.event: Callable[[StreamEvent], None] = self.events.append


def serve(source: Source, *sinks: Sink) -> None:
    stream.serve(cast(Any, source), cast(Any, sinks))


def test_every_sink_gets_every_block_and_event() -> None:
    source, sinks = Source(), [Sink(), Sink()]
    with pytest.raises(KeyboardInterrupt):
        serve(source, *sinks)
    for sink in sinks:
        assert [int(one.seq[0]) for one in sink.blocks] == list(range(1, source.reads + 1))
        assert [event.text for event in sink.events] == ["the last"]


def test_viewers_stay_connected_while_a_device_is_silent(capsys: pytest.CaptureFixture[str]) -> None:
    source, sink = Source((1.0, 10.9), (11.0, 20.9), ends_s=30.0), Sink()
    with pytest.raises(KeyboardInterrupt):
        serve(source, sink)
    assert len(sink.blocks) == source.reads > 180
    assert sink.events[0].kind == "stale"
    printed = capsys.readouterr().err
    assert printed.count("no sample for 0.3 s; check cable and supply. Viewers stay connected for 10 s.") == 2
    assert printed.count("Samples arrive again.") == 2


def test_a_device_that_stays_silent_ends_the_stream() -> None:
    source, sink = Source((1.0, 60.0), ends_s=60.0), Sink()
    with pytest.raises(DeviceTimeout) as failure:
        serve(source, sink)
    assert exit_code(failure.value) == 4
    assert source.clock.now_s() - 1001.0 == pytest.approx(RECOVER_S, abs=0.11)
    assert "silent at 11 s" in sink.events[-1].text


def run(monkeypatch: pytest.MonkeyPatch, tmp_path: Path, *arguments: str) -> tuple[dict[str, Any], str]:
    """Run the command on a fake stream; return how it opened it, and what it printed."""
    opened: dict[str, Any] = {}

    def open_(_cell: object, _calibration: object, **options: Any) -> Source:
        opened.update(options)
        return Source()

    monkeypatch.setattr(live_source, "CompensatedStream", open_)
    monkeypatch.setattr(live_source, "read_calibration", lambda *_, **__: SimpleNamespace())
    monkeypatch.setattr(CellOptions, "cell", lambda _: SimpleNamespace())
    calibration = tmp_path / "calibration.json"
    calibration.touch()
    outcome = CliRunner().invoke(stream.stream, ["--calibration", str(calibration), "--port", "0", *arguments])
    if isinstance(outcome.exception, Exception):
        raise outcome.exception
    assert outcome.stdout == ""
    return opened, outcome.stderr


def test_it_prints_what_is_served_and_how_to_open_it(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    opened, printed = run(monkeypatch, tmp_path, "--axes", "base", "--about", "flange", "--udp", "localhost:9871")
    assert opened["frame"] == WrenchFrame("base", "flange")
    assert opened["name"].endswith("calibration.json")
    assert "the arm reports no serial number" in printed
    assert printed.count("ws://127.0.0.1:") == 2
    assert "port 9871, JSON" in printed
    assert "app.foxglove.dev" in printed
    assert "Unprotected" not in printed


@pytest.mark.parametrize(("host", "protected"), [("localhost", True), ("127.0.0.2", True), ("0.0.0.0", False)])
def test_an_address_that_others_reach_is_said_to_be_unprotected(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, host: str, protected: bool
) -> None:
    _, printed = run(monkeypatch, tmp_path, "--host", host)
    assert ("There is no password and no encryption" in printed) is not protected
    assert "ws://0.0.0.0" not in printed


@pytest.mark.parametrize("udp", ["9870", "host:", "host:x", "host:70000", ":9870"])
def test_a_wrong_udp_address_is_refused_before_any_work(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, udp: str
) -> None:
    with pytest.raises(ConfigError, match=f"--udp is '{udp}': give HOST:PORT, such as"):
        run(monkeypatch, tmp_path, "--udp", udp)


def test_a_calibration_is_needed() -> None:
    outcome = CliRunner().invoke(stream.stream, [])
    assert isinstance(outcome.exception, ConfigError)
    assert "give --calibration PATH or --tool NAME, or --simulate" in str(outcome.exception)
