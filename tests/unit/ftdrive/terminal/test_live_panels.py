"""What the panels of the live screen say, and what is read on a low screen."""

from dataclasses import replace

import numpy as np
import pytest

from ftdrive.runs.calibration import FOREIGN
from ftdrive.stream.feed import FeedNote
from ftdrive.terminal import live_panels
from ftdrive.terminal.lines import GOOD, WARNING, Line
from ftdrive.terminal.live_screen import draw_live
from ftdrive.words.stream import View
from ftdrivers.interfaces import Fact
from tests.unit.ftdrive.terminal.fake_stream import FakeStream
from tests.unit.ftdrive.words.test_stream import Rig, reading_of


@pytest.fixture(scope="module")
def view() -> View:
    return Rig(FakeStream("contact")).run(30)


def text(line: Line) -> str:
    return "".join(part.text for part in line.parts)


def test_range_is_used_by_the_load_where_the_zero_is_arbitrary(view: View) -> None:
    bias = np.concatenate([view.info.calibration.force_bias_N, view.info.calibration.torque_bias_Nm])
    facts = {"range": Fact((50.0,) * 3 + (10.0,) * 3, "configured")}
    reading = replace(reading_of(view), raw=bias + np.array([0, 0, 20, 0, 0, 0]))
    sensor = replace(view.info.sensor, facts=facts | {"zero": Fact("arbitrary", "assumed")})
    share, axis = replace(view, reading=reading, info=replace(view.info, sensor=sensor)).used_range or (0.0, "")
    assert (round(share, 3), axis) == (0.4, "Fz")
    plain = replace(view.info.sensor, facts=facts)
    assert replace(view, reading=reading, info=replace(view.info, sensor=plain)).used_range != (share, axis)


def test_a_calibration_of_another_cell_is_marked_in_the_header_and_not_green(view: View) -> None:
    foreign = replace(view, info=replace(view.info, foreign=True, emulated=True))
    assert FOREIGN in text(live_panels.head_lines(foreign, 80)[0])
    styles = {part.text: part.style for part in live_panels.head_lines(foreign, 80)[2].parts}
    assert styles["GOOD"] == WARNING
    assert {part.text: part.style for part in live_panels.head_lines(view, 80)[2].parts}["GOOD"] == GOOD


def test_a_refusal_is_read_to_its_end_on_a_low_screen(view: View) -> None:
    words = "tare refused: the reading differs from a free tool by 1.52 N, more than noise, calibration and a usual "
    words += "drift explain (test value 31, limit 22.5); take hand or contact away, or calibrate again"
    refused = replace(view, notes=[FeedNote(None, words, "tare-refused"), *view.notes])
    shown = " ".join(text(line).strip() for line in draw_live(refused, 80, 24))
    assert words in " ".join(shown.split())
