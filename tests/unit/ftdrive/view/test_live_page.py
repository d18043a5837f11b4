"""The page of the live wrench and of the scale: what it says of a state, and what a viewer may do."""

import re
from dataclasses import replace
from pathlib import Path
from typing import Any, cast
from unittest.mock import MagicMock

import numpy as np
import pytest

from ftdrive.cell.config import CellConfig, RobotConfig, SensorConfig, ToolConfig
from ftdrive.commands.common import ViewOptions
from ftdrive.commands.live import _certifier, _recorded_cell
from ftdrive.commands.live_source import check_view
from ftdrive.errors import ConfigError
from ftdrive.live.replay import ReplayedStream
from ftdrive.live.samples import FrameTransform, WrenchFrame
from ftdrive.live.weighing import WORDS, ScaleState
from ftdrive.recording import Recorder
from ftdrive.terminal.live_feed import Feed
from ftdrive.view.live_page import LivePage, events, head, in_base, is_significant, number, numbers, plot_data
from ftdrive.view.scene import turned
from ftdrive.view.weigh_page import WeighPage, scale
from tests.fake_clock import FakeClock
from tests.unit.ftdrive.live.simulated import calibrated, dwells, info, paired
from tests.unit.ftdrive.terminal.fake_stream import INFO, R_BASE_FLANGE, R_FLANGE_SENSOR, SIGMA, FakeStream
from tests.unit.ftdrive.terminal.test_live_summary import Rig, reading_of
from tests.unit.ftdrive.terminal.test_weigh_screen import NOTHING, PART

PUSHED = np.array([1.0, -2.0, -7.0, 0.1, 0.2, -0.05])
FRAMES = [
    WrenchFrame(),
    WrenchFrame("flange", "flange"),
    WrenchFrame("base", "tcp"),
    WrenchFrame("tcp", "tcp"),
    WrenchFrame("base", "sensor"),
    WrenchFrame("sensor", (0.01, -0.02, 0.3)),
]


def shown_page(feed: Feed, *, viewers: int = 1, controls: bool = False) -> tuple[LivePage, Any]:
    """A page without a server."""
    page = MagicMock(viewers=viewers)
    page.gui.add_html.side_effect = lambda _: MagicMock()
    page.gui.add_uplot.side_effect = lambda **_: MagicMock()
    return LivePage(page, feed, controls=controls), page


def buttons(page: Any) -> dict[str, Any]:
    """The functions behind the buttons of a page that was filled with mocks, by name."""
    names = [call.args[0] for call in page.gui.add_button.call_args_list]
    presses = [call.args[0] for call in page.gui.add_button.return_value.on_click.call_args_list]
    return dict(zip(names, presses, strict=True))


@pytest.mark.parametrize("frame", FRAMES, ids=lambda frame: frame.id)
def test_arrow_and_line_of_action_do_not_depend_on_the_frame(frame: WrenchFrame) -> None:
    """The same wrench about the origin of the base, whatever the axes and the point that the user chose."""
    reading = reading_of(Rig(FakeStream("contact")).run(3))
    p_base_flange_m = reading.p_base_flange_m
    wrench = FrameTransform(frame, INFO).matrix(R_BASE_FLANGE) @ PUSHED
    p_m, wrench_base = in_base(replace(reading, frame=frame, wrench=wrench), INFO, p_base_flange_m)
    R = R_BASE_FLANGE @ R_FLANGE_SENSOR
    sensor_m = p_base_flange_m + R_BASE_FLANGE @ INFO.p_flange_sensor_m
    force = R @ PUSHED[:3]
    np.testing.assert_allclose(wrench_base[:3], force, atol=1e-12)
    about_base = np.cross(p_m, wrench_base[:3]) + wrench_base[3:]
    np.testing.assert_allclose(about_base, np.cross(sensor_m, force) + R @ PUSHED[3:], atol=1e-12)


def test_the_flange_is_turned_as_the_arm_says() -> None:
    w, x, y, z = turned(R_BASE_FLANGE)
    axis = np.array([x, y, z])
    rotated = [v + 2 * np.cross(axis, np.cross(axis, v) + w * v) for v in np.eye(3)]
    np.testing.assert_allclose(np.transpose(rotated), R_BASE_FLANGE, atol=1e-12)


def test_numbers_end_where_their_sigmas_do() -> None:
    reading = reading_of(Rig(FakeStream("contact")).run(3))
    sigma = np.array([2.1, 2.1, 2.1, 0.03, 0.03, 0.03])
    rest = np.array([0.05, 0.04, 0.03, 0.002, 0.002, 0.001])
    wrench = np.array([0.0, 98.04, 0.0, 0.0, 0.0, 1.234])
    reading = replace(reading, wrench=wrench, sigma=sigma, rest_sigma=rest)
    assert number(reading, 0) == ("98.0 ± 2.1 N", "sigma 0.050 N at rest")
    assert number(reading, 3) == ("1.234 ± 0.030 N·m", "sigma 0.0020 N·m at rest")
    unknown = replace(reading, sigma=np.full(6, np.nan))
    assert number(unknown, 0) == ("98.04 N", "the noise is not known yet")
    assert [is_significant(one, 0) for one in (reading, unknown, replace(reading, wrench=wrench / 100))] == [1, 0, 0]


def test_contact_marks_the_plots_and_the_numbers() -> None:
    rig = Rig(FakeStream("contact", block_s=0.05))
    view = rig.run(240)
    columns = view.columns(200)
    t_s, low, high, above, below, contact, edge = plot_data(columns, 2, 10.0, float(SIGMA[2]))
    assert (t_s[-1], len(t_s)) == (0.0, 200)
    assert (np.diff(t_s) > 0).all()
    known = np.isfinite(low)
    assert (low[known] <= high[known]).all()
    np.testing.assert_array_equal(above, -below)
    np.testing.assert_allclose(above, SIGMA[2])
    np.testing.assert_array_equal(contact > edge, columns.in_contact)
    begins_s = t_s[np.flatnonzero(contact > edge)[-1]] - t_s[np.flatnonzero(np.diff(contact > edge))[-1]]
    assert begins_s == pytest.approx(view.contact_s, abs=0.1)
    assert re.search(r"contact, 0\.\d s", numbers(view))
    assert "free" in numbers(Rig(FakeStream()).run(3))
    assert not plot_data(columns, 2, 10.0, np.nan)[3].any()


def test_no_old_number_of_a_silent_device() -> None:
    rig = Rig(FakeStream(silent_after=3))
    assert " ± " in numbers(rig.run(3))
    view = rig.run(1)
    assert "no sample for 0.31 s" in head(view)
    assert not re.search(r"\d+\.\d+ (±|N)", numbers(view))


def test_what_the_numbers_are_is_in_words() -> None:
    rig = Rig(FakeStream())
    assert "contact wrench, base axes, about the tcp origin. Stages: raw, bias, gravity, low-pass" in head(rig.run(3))
    rig.stream.stages = replace(rig.stream.stages, gravity=False)
    assert "weight included" in head(rig.run(30))
    assert "waiting" in head(Rig(FakeStream()).run(0))


def test_events_are_listed_newest_first_and_cannot_write_the_page() -> None:
    rig = Rig(FakeStream(block_s=0.05))
    rig.run(123)
    rig.feed.note("<script>alert(1)</script>")
    shown = events(rig.run(1))
    places = [shown.index(text) for text in ("&lt;script&gt;", "contact 8.0 N", "peg in")]
    assert places == sorted(places)
    assert "<script>" not in shown


def test_without_a_viewer_nothing_is_drawn_and_nothing_piles_up() -> None:
    feed = Feed(FakeStream())
    shown, page = shown_page(feed, viewers=0)
    for _ in range(5):
        feed.step()
        shown.draw()
    assert not feed._news[0].blocks
    page.at_once.assert_not_called()
    page.viewers = 1
    shown.draw()
    assert "contact wrench" in shown._head.content
    assert np.isfinite(shown._plots[2].data[1]).any()


def test_a_viewer_may_tare_only_if_that_is_allowed() -> None:
    stream = FakeStream()
    feed = Feed(stream)
    _, page = shown_page(feed)
    assert not buttons(page)
    _, page = shown_page(feed, controls=True)
    for press in buttons(page).values():
        press(None)
    feed.step()
    assert stream.called == ["tare", "tare-undone"]


def test_a_viewer_of_a_replay_pauses_and_goes_elsewhere() -> None:
    rows = paired(dwells(1, 3000, seed=1))
    replay = ReplayedStream(info(calibrated()), rows, clock=cast("Any", FakeClock()))
    feed = Feed(replay)
    shown, page = shown_page(feed)
    feed.step()
    shown.draw()
    buttons(page)["Pause"](None)
    moved = MagicMock()
    moved.target.value = 2.0
    shown._go_to(moved)
    feed.request("speed", "4")
    feed.step()
    shown.draw()
    assert replay.is_paused
    assert replay.at_s == pytest.approx(2.0, abs=0.02)
    assert replay.speed == 4.0
    assert page.gui.add_button.return_value.label == "Play"
    moved.client = None  # the page itself has moved the slider
    moved.target.value = 0.5
    shown._go_to(moved)
    feed.step()
    assert replay.at_s > 1.9


def test_options_that_would_be_ignored_are_refused() -> None:
    with pytest.raises(ConfigError, match="--allow-control goes only with --view"):
        check_view(ViewOptions(False, None), once=False, allow_control=True)
    with pytest.raises(ConfigError, match="--view does not go with --once"):
        check_view(ViewOptions(False, "0.0.0.0:8080"), once=True, allow_control=False)
    check_view(ViewOptions(True, None), once=False, allow_control=True)


def test_the_scale_shows_a_mass_or_why_there_is_none() -> None:
    shown = scale(ScaleState(PART, None, 3), "zero: the empty gripper was tared")
    for words in ("0.8123 ± 0.0012 kg", "3 parts", "smallest mass 4.8 g", "zero: the empty"):
        assert words in shown
    assert "nothing: " in scale(ScaleState(NOTHING, None))
    for shown_state in (ScaleState(PART, "contact"), ScaleState(None, "moving")):
        shown = scale(shown_state)
        assert "- - -" in shown
        assert "kg" not in shown
        assert WORDS[cast("Any", shown_state.refusal)] in shown
    assert "0.8123 ± 0.0012 kg" in scale(ScaleState(PART, "count"))


def test_a_viewer_zeroes_the_scale_only_if_that_is_allowed() -> None:
    for controls, moving in ((False, False), (True, True), (True, False)):
        page, weighing = MagicMock(viewers=0), MagicMock(moving=moving)
        WeighPage(page, weighing, controls=controls).draw()
        for press in buttons(page).values():
            press(None)
        assert weighing.request_zero.called == (controls and not moving)


def test_a_recording_brings_its_arm_and_tool(tmp_path: Path) -> None:
    cell = CellConfig(
        RobotConfig(host="10.0.0.2"), SensorConfig(url="x"), ToolConfig(cylinders_mm=((0.0, 200.0, 100.0),))
    )
    recorder = Recorder([path := tmp_path / "peg.mcap"], INFO, cell.to_dict())
    recorder.write(FakeStream().read())
    recorder.close()
    found = _recorded_cell(path)
    assert found is not None
    certifier = _certifier(found, INFO.arm.model)
    assert certifier is not None
    assert [part.to_m for part in certifier.arm.tool] == [0.2]
    assert _certifier(replace(found, tool=ToolConfig()), INFO.arm.model) is None
    (table := tmp_path / "table.csv").write_text("t,fx\n0,1\n")
    assert _recorded_cell(table) is None
