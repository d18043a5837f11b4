"""The live screen as a user sees it: what it shows at which size, keys, colours."""

import time
from contextlib import nullcontext
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any
from unittest.mock import MagicMock

import pytest
from rich.cells import cell_len
from syrupy.assertion import SnapshotAssertion

from ftdrive.checks.check import Check
from ftdrive.errors import ConfigError
from ftdrive.stream.samples import Block, Stages, WrenchFrame
from ftdrive.stream.sources import STEP_S
from ftdrive.terminal.console import messages
from ftdrive.terminal.live_screen import LiveScreen, draw_live, run_live
from ftdrive.words.stream import StreamSummary
from ftdrivers.errors import DeviceTimeout
from tests.fake_clock import FakeClock
from tests.unit.ftdrive.stream.simulated import calibrated, dwells, info, paired, replayed
from tests.unit.ftdrive.terminal.fake_stream import FakeStream, Scenario, SteppedFeed
from tests.wire.waiting import wait_until

CHECKS = (
    Check("calibration.devices", "ok", "verdict good, with these devices"),
    Check("robot.payload", "ok", "robot 1.74 kg; weighed 1.44 kg + 0.30 kg sensor"),
)


@pytest.fixture(autouse=True)
def utc(monkeypatch: pytest.MonkeyPatch) -> Any:
    monkeypatch.setenv("TZ", "UTC")
    monkeypatch.delenv("NO_COLOR", raising=False)
    time.tzset()
    yield
    monkeypatch.undo()
    time.tzset()


class Screen:
    """A screen whose stream runs block by block, without a thread and a terminal."""

    def __init__(self, scenario: Scenario = "still", size: tuple[int, int] = (80, 24), blocks: int = 120) -> None:
        self.stream: Any = FakeStream(scenario, 200.0, blocks if scenario == "stale" else None, block_s=0.1)
        self.size = size
        self.show(self.stream)
        self.step(blocks)
        if scenario == "tare-refused":
            self.screen.press("t")
        self.step(1)

    def show(self, stream: Any) -> None:
        self.stream, self.feed = stream, SteppedFeed(stream)
        self.summary = StreamSummary(self.feed, CHECKS)
        self.screen = LiveScreen(self.feed, self.summary)

    def step(self, blocks: int) -> None:
        self.feed.step(blocks)

    def lines(self) -> list[str]:
        return [str(line) for line in self.screen.lines(*self.size)]

    def press(self, *keys: str) -> list[str]:
        for key in keys:
            self.screen.press(key)
            self.step(1)
        return self.lines()


@pytest.mark.parametrize("size", [(80, 24), (160, 50)], ids=["80x24", "160x50"])
@pytest.mark.parametrize("scenario", ["still", "contact", "stale", "tare-refused"])
def test_screen(scenario: Scenario, size: tuple[int, int], snapshot: SnapshotAssertion) -> None:
    lines = Screen(scenario, size).lines()
    assert {cell_len(line) for line in lines} == {size[0]}
    assert len(lines) == size[1]
    assert "\n".join(lines) == snapshot


@pytest.mark.slow
def test_every_size_is_filled_exactly() -> None:
    view = Screen("contact").summary.view()
    tall = (40, 40), (60, 70), (119, 70), (121, 40), (200, 70)
    for width, height in (*product((1, 40, 60, 79, 81, 119, 121), (1, 8, 16, 23, 25)), *tall):
        lines = draw_live(view, width, height)
        assert {line.width for line in lines} == {width}
        assert len(lines) == height


def test_keys_change_frame_and_stages_and_the_screen_says_what_the_numbers_are() -> None:
    screen = Screen()
    screen.press("x", "a", "a")
    assert screen.stream.frame == WrenchFrame("tcp", "flange")
    lines = screen.press("2", "3", "4")
    assert screen.stream.stages == Stages(gravity=False, inertia=True)
    assert "2 gravity(off)▸3 inertia▸4 LP(off)" in lines[1].replace(" ▸ ", "▸")
    assert "weight included, tcp @ flange" in lines[1]


def test_keys_tare_undo_and_mark() -> None:
    screen = Screen()
    assert "text, then Enter; Esc cancels" in screen.press("t", "b")[-1]
    screen.press("t", "escape", "u", "b", "enter", "b")
    assert screen.press(*"q ho", "backspace", "backspace", *"hi")[-1].strip() == "q hi"
    lines = screen.press("enter")
    assert screen.stream.called == ["tare", "tare-undone", "mark"]
    assert 'mark "q hi"' in lines[-3]


def test_a_replay_pauses_steps_seeks_and_says_where_it_is() -> None:
    rows = paired(dwells(1, 2000, seed=1), rate_Hz=100.0)
    screen, stream = Screen(blocks=0), replayed(info(calibrated()), rows)
    replay: Any = stream.source
    screen.show(stream)
    screen.step(3)
    screen.press(" ")
    assert replay.is_paused
    begin_s = replay.at_s
    lines = screen.press(".", ".")
    assert begin_s + STEP_S < replay.at_s < begin_s + 5 * STEP_S
    assert "of 00:20.0, paused" in lines[0]
    screen.press("right", "right", "left", "right", "+", " ")
    screen.step(40)
    assert replay.at_s > 10
    lines = screen.lines()
    assert ", x 2" in lines[0]
    assert "space pause" in lines[-1]
    assert "+0.0" in lines[5] or "-0.0" in lines[5]


class Paced(FakeStream):
    def read(self) -> Block:
        time.sleep(0.001)  # else its thread leaves the screen no time
        return super().read()


class Other(FakeStream):
    def read(self) -> Block:
        if self.blocks < 3:
            return super().read()
        raise ConfigError("another device answers: start again")


@pytest.mark.parametrize(
    ("stream", "ends"),
    [
        (Paced(), nullcontext()),
        (FakeStream(silent_after=30), pytest.raises(DeviceTimeout, match="sent no sample")),
        (Other(), pytest.raises(ConfigError, match="another device")),
    ],
    ids=["recorded", "failed", "crashed"],
)
def test_a_failure_is_the_end_of_the_command_and_recordings_are_named(
    stream: FakeStream, ends: Any, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    def run(screen: LiveScreen) -> None:
        is_well = isinstance(ends, nullcontext)
        screen.press("r")
        with screen.reading():
            wait_until(lambda: feed.status.failure or screen.failure or (feed.recorded and is_well))
            screen.lines(80, 24)

    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(LiveScreen, "run", run)
    tape = MagicMock()
    feed = SteppedFeed(stream, lambda _: tape)
    with messages.capture() as said, ends:
        run_live(feed)
    assert f"Recorded: {tmp_path}/live-" in said.get().replace("\n", "")
    tape.end.assert_called_once()


def test_a_frame_that_is_not_configured_is_left_out_and_named() -> None:
    screen, rows = Screen(blocks=0), paired(dwells(1, 2000, seed=1), rate_Hz=100.0)
    screen.show(replayed(info(calibrated(), height=False), rows, clock=FakeClock()))
    screen.step(3)
    screen.press("a")
    assert any("set [sensor] height_mm" in note.text for note in screen.summary.view().notes)
    assert screen.stream.frame == WrenchFrame()


def test_a_key_pushes_the_tool_of_an_emulated_cell_only() -> None:
    pushes: list[str] = []
    assert "f push" not in Screen().press("f")[-1]
    screen = Screen()
    screen.feed.push = partial(pushes.append, "pushed")
    lines = screen.press("f")
    assert pushes == ["pushed"]
    assert "f push" in lines[-1]
    assert "the emulated tool is pushed" in lines[-3]
