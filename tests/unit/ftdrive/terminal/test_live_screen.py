"""The live screen as a user sees it: what it shows at which size, keys, mouse, colours."""

import asyncio
import threading
import time
from collections.abc import Awaitable, Callable
from dataclasses import replace
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any
from unittest.mock import MagicMock

import numpy as np
import pytest
from rich.cells import cell_len
from syrupy.assertion import SnapshotAssertion
from textual.pilot import Pilot

from ftdrive.checks.check import Check
from ftdrive.errors import ConfigError
from ftdrive.live.replay import STEP_S, ReplayedStream
from ftdrive.live.samples import Block, Paired, Stages, WrenchFrame
from ftdrive.terminal.console import messages
from ftdrive.terminal.live_feed import Feed
from ftdrive.terminal.live_screen import LiveApp, frame, run_live
from ftdrive.terminal.live_view import Summary
from ftdrivers.errors import DeviceTimeout
from tests.fake_clock import FakeClock
from tests.unit.ftdrive.terminal.fake_stream import FREE, INFO, R_BASE_FLANGE, SIGMA, START_NS, FakeStream, Scenario

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
    """An app whose stream runs block by block, without a thread."""

    def __init__(self, scenario: Scenario = "still", size: tuple[int, int] = (80, 24), blocks: int = 120) -> None:
        silent_after = blocks if scenario == "stale" else None
        self.stream = FakeStream(scenario, 200.0, silent_after, block_s=0.1)
        self.feed = Feed(self.stream)
        self.summary = Summary(self.feed, CHECKS)
        self.size = size
        self.step(blocks)
        if scenario == "tare-refused":
            self.feed.request("t")
        self.step(1)

    def step(self, blocks: int) -> None:
        for _ in range(blocks):
            self.feed.step()

    def run(self, act: "Callable[[Screen, Pilot[None]], Awaitable[None]] | None" = None) -> list[str]:
        """Run the app, let `act` use it, and return the lines of the screen."""

        async def main() -> list[str]:
            self.app = LiveApp(self.feed, self.summary)
            async with self.app.run_test(size=self.size) as pilot:
                if act is not None:
                    await act(self, pilot)
                return await self.lines(pilot)

        return asyncio.run(main())

    def pressed(self, *keys: str) -> list[str]:
        """Press the keys, and return the lines of the screen."""
        return self.run(lambda screen, pilot: screen.press(pilot, *keys))

    async def lines(self, pilot: Pilot[None]) -> list[str]:
        self.app.draw()
        await pilot.pause()
        return [strip.text for strip in self.app.screen._compositor.render_strips()]

    async def press(self, pilot: Pilot[None], *keys: str) -> None:
        for key in keys:
            await pilot.press(key)
            self.step(1)


@pytest.mark.parametrize("size", [(80, 24), (160, 50)], ids=["80x24", "160x50"])
@pytest.mark.parametrize("scenario", ["still", "contact", "stale", "tare-refused"])
def test_screen(scenario: Scenario, size: tuple[int, int], snapshot: SnapshotAssertion) -> None:
    lines = Screen(scenario, size).run()
    assert {cell_len(line) for line in lines} == {size[0]}
    assert len(lines) == size[1]
    assert "\n".join(lines) == snapshot


@pytest.mark.parametrize("scenario", ["contact", "stale"])
def test_every_size_is_filled_exactly(scenario: Scenario) -> None:
    view = Screen(scenario).summary.view()
    tall = (40, 40), (60, 70), (119, 70), (121, 40), (200, 70)
    for width, height in (*product((1, 40, 60, 79, 81, 119, 121), (1, 8, 16, 23, 25)), *tall):
        lines = frame(view, width, height)
        assert {line.width for line in lines} == {width}
        assert len(lines) == height


@pytest.mark.parametrize(("rate_Hz", "lowpass_Hz"), [(7000.0, 40.0), (100.0, 25.0)])
def test_the_low_pass_fits_the_rate_of_the_sensor(rate_Hz: float, lowpass_Hz: float) -> None:
    stream = FakeStream()
    stream.info, stream.stages = replace(INFO, sensor_rate_Hz=rate_Hz), Stages()
    feed = Feed(stream)
    for stages in (Stages(lowpass_Hz=lowpass_Hz), Stages()):
        feed.request("4")
        feed.step()
        assert stream.stages == stages


def test_a_stale_screen_shows_no_number_that_looks_live() -> None:
    lines = Screen("stale").run()
    assert lines[3].startswith(" ATI Mini45: no sample for 0.31 s")
    for line in lines[5:14]:
        now = line[4:12].strip()
        assert now in {"--.--", ""}


def test_before_the_first_sample_the_screen_waits() -> None:
    screen = Screen(blocks=0)
    screen.summary = Summary(Feed(FakeStream()))
    assert "waiting for the first sample" in screen.run()[1]


def test_keys_change_frame_and_stages_and_the_screen_says_what_the_numbers_are() -> None:
    async def act(screen: Screen, pilot: Pilot[None]) -> None:
        await screen.press(pilot, "x", "a", "a")
        assert screen.stream.frame == WrenchFrame("tcp", "flange")
        await screen.press(pilot, "2", "3", "4")
        assert screen.stream.stages == Stages(gravity=False, inertia=True)

    lines = Screen().run(act)
    assert "2 gravity(off)▸3 inertia▸4 LP(off)" in lines[1].replace(" ▸ ", "▸")
    assert "weight included, tcp @ flange" in lines[1]


def test_a_frame_that_is_not_configured_is_left_out_and_named() -> None:
    class NoTcp(FakeStream):
        def __setattr__(self, name: str, value: object) -> None:
            if name == "frame" and self.blocks and "tcp" in str(value):
                raise ConfigError("the controller does not report its active TCP")
            super().__setattr__(name, value)

        blocks = 0

    screen = Screen(blocks=0)
    screen.stream = NoTcp()
    screen.stream.frame = WrenchFrame("flange", "flange")
    screen.feed = Feed(screen.stream)
    screen.summary = Summary(screen.feed)
    screen.step(10)
    lines = screen.pressed("x", "x")
    assert screen.stream.frame == WrenchFrame("sensor", "flange")
    assert "does not report its active TCP" in "".join(lines)


def test_keys_tare_undo_and_mark() -> None:
    async def act(screen: Screen, pilot: Pilot[None]) -> None:
        await screen.press(pilot, "t", "b", "t", "escape")
        await pilot.pause()
        await screen.press(pilot, "u", "b", *"hi", "enter")
        await pilot.pause()
        screen.step(1)

    screen = Screen()
    lines = screen.run(act)
    assert screen.stream.called == ["tare", "tare-undone", "mark"]
    assert 'mark "hi"' in lines[-3]


def test_a_key_pushes_the_tool_of_an_emulated_cell_only() -> None:
    pushes: list[str] = []
    assert "f push" not in Screen().pressed("f")[-1]
    screen = Screen()
    screen.feed.push = partial(pushes.append, "pushed")
    lines = screen.pressed("f")
    assert pushes == ["pushed"]
    assert "f push" in lines[-1]
    assert "the emulated tool is pushed" in lines[-3]


def test_at_80_columns_no_word_is_broken_and_none_touches_its_neighbour() -> None:
    screen = Screen("contact", (80, 24))
    screen.step(30)
    view = screen.summary.view()
    reading = replace(view.reading, chi2=98_765.4) if view.reading is not None else None
    status = replace(view.status, false_alarm_rate=1e-6, contact_limit=40.6)
    info = replace(view.info, tool="emulated gripper with long fingers and a camera")
    view = replace(view, reading=reading, info=info, status=status, recording_s=754.0, contact_s=123.4)
    lines = list(map(str, frame(view, 80, 24)))
    assert all(cell_len(line) == 80 for line in lines)
    words = {*lines[0].split()[-3:], *f"ftdrive live UR5e · ATI Mini45 FT12345 {info.tool} …".split()}
    assert set(lines[0].split()) <= words
    assert lines[0].endswith(" ● REC 00:12:34 ")
    assert any(
        line.endswith("▲ CONTACT 123.4 s  test 98765, limit 40.6 ") for line in (f"{x.rstrip()} " for x in lines)
    )


def test_freeze_span_and_peaks() -> None:
    async def act(screen: Screen, pilot: Pilot[None]) -> None:
        assert float((await screen.lines(pilot))[8].split("free")[0].split()[-1]) > 7.5
        await screen.press(pilot, "p", "g", "z")

    lines = Screen().run(act)
    assert "FROZEN" in lines[0]
    assert float(lines[8].split("free")[0].split()[-1]) < 7 * SIGMA[0]
    assert "60 s" in lines[4]


def recording(seconds: int) -> ReplayedStream:
    """A free tool at rest, 100 Hz."""
    n = 100 * seconds
    rng = np.random.default_rng(1)
    rows = Paired(
        t_host_ns=START_NS + np.arange(n) * 10_000_000,
        t_device_s=np.full(n, np.nan),
        seq=np.arange(n),
        status=np.zeros(n, np.uint32),
        raw=FREE + rng.normal(size=(n, 6)) * SIGMA,
        q_rad=np.zeros((n, 6)),
        R_base_flange=np.tile(R_BASE_FLANGE, (n, 1, 1)),
        p_base_flange_m=np.full((n, 3), np.nan),
    )
    return ReplayedStream(INFO, rows, clock=FakeClock())


def test_a_replay_pauses_steps_seeks_and_says_where_it_is() -> None:
    async def act(screen: Screen, pilot: Pilot[None]) -> None:
        await screen.press(pilot, "space")
        assert replayed.is_paused
        begin_s = replayed.at_s
        await screen.press(pilot, ".", ".")
        assert begin_s + STEP_S < replayed.at_s < begin_s + 5 * STEP_S
        assert "of 00:20.0, paused" in (await screen.lines(pilot))[0]
        await screen.press(pilot, "right", "right", "left", "right", "plus", "space")
        screen.step(40)
        assert replayed.at_s > 10

    replayed = recording(20)
    screen = Screen(blocks=0)
    screen.feed = Feed(replayed)
    screen.summary = Summary(screen.feed)
    screen.step(3)
    lines = screen.run(act)
    assert ", x 2" in lines[0]
    assert "space pause" in lines[-1]
    assert "+0.0" in lines[5] or "-0.0" in lines[5]


def test_help_covers_the_screen_until_a_key() -> None:
    async def act(screen: Screen, pilot: Pilot[None]) -> None:
        await screen.press(pilot, "question_mark")
        lines = await screen.lines(pilot)
        assert "tare: change the bias so that a free tool reads zero" in "".join(lines)
        assert not [line for line in lines if "…" in line]
        await screen.press(pilot, "t")

    screen = Screen()
    assert "Fx" in screen.run(act)[5]
    assert not screen.stream.called


def test_stages_and_keys_can_be_clicked_and_q_ends() -> None:
    async def act(screen: Screen, pilot: Pilot[None]) -> None:
        lines = await screen.lines(pilot)
        await pilot.click(offset=(lines[1].index("2 gravity"), 1))
        await pilot.click(offset=(lines[-1].index("t tare"), 23))
        screen.step(1)
        await pilot.press("q")
        assert screen.app._exit

    screen = Screen()
    screen.run(act)
    assert not screen.stream.stages.gravity
    assert screen.stream.called == ["tare"]


@pytest.fixture
def no_app(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let the app end as soon as its stream has failed."""

    def run(app: LiveApp) -> None:
        for _ in range(2000):
            if app._feed.reader.failure is not None or app._feed.crash is not None:
                return
            threading.Event().wait(0.005)

    monkeypatch.setattr(LiveApp, "run", run)


@pytest.mark.usefixtures("no_app")
def test_a_stream_that_has_failed_is_the_end_of_the_command() -> None:
    with pytest.raises(DeviceTimeout, match="sent no sample"):
        run_live(Feed(FakeStream(silent_after=3)))


def test_recordings_are_named_at_the_end(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    def run(app: LiveApp) -> None:
        app.action_press("r")
        while not app._feed.recorded:
            threading.Event().wait(0.001)

    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(LiveApp, "run", run)
    monkeypatch.setattr(LiveApp, "draw", lambda _: None)
    tape = MagicMock()
    with messages.capture() as said:
        run_live(Feed(FakeStream(), lambda _: tape))
    assert f"Recorded: {tmp_path}/live-" in said.get().replace("\n", "")
    tape.close.assert_called_once()


@pytest.mark.usefixtures("no_app")
def test_an_error_of_the_reading_thread_is_raised() -> None:
    class Other(FakeStream):
        def read(self) -> Block:
            raise ConfigError("another device answers: start again")

    with pytest.raises(ConfigError, match="another device"):
        run_live(Feed(Other()))


def styles(screen: Screen) -> set[Any]:
    """Foreground and background of everything drawn."""
    found = set()

    async def act(screen: Screen, pilot: Pilot[None]) -> None:
        await screen.lines(pilot)
        for strip in screen.app.screen._compositor.render_strips():
            for segment in strip:
                if segment.style is not None:
                    found.update({segment.style.color, segment.style.bgcolor})

    screen.run(act)
    return {color for color in found if color is not None and not color.is_default}


def test_colours_are_those_of_the_terminal_so_that_light_and_dark_ones_do() -> None:
    found = styles(Screen("contact"))
    assert {color.name for color in found} == {"green", "magenta"}


def test_no_color_draws_no_colour(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("NO_COLOR", "1")
    assert styles(Screen("stale")) == set()
