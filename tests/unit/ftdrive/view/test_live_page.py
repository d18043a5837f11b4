"""The page of the live wrench and of the scale: what it says of a state, and what a viewer may do."""

import json
import time
from dataclasses import replace
from typing import Any, cast

import numpy as np
import pytest
from syrupy.assertion import SnapshotAssertion

from ftdrive.cell.config import CellConfig, RobotConfig, SensorConfig, ToolConfig
from ftdrive.planning.geometry.certify import Certifier
from ftdrive.planning.planner import certifier_for
from ftdrive.stream.samples import WrenchFrame
from ftdrive.stream.weighing import ScaleState
from ftdrive.view.live_page import LivePage, WeighPage
from ftdrive.view.page import Page, drawing
from ftdrive.words.stream import StreamSummary
from tests.unit.ftdrive.stream.simulated import calibrated, dwells, info, paired, replayed
from tests.unit.ftdrive.terminal.fake_stream import INFO, R_BASE_FLANGE, R_FLANGE_SENSOR, FakeStream, SteppedFeed
from tests.unit.ftdrive.terminal.test_weigh_screen import NOTHING, PART, FakeWeighing

PUSHED = -5.1 * np.array([0.1, -0.05, -1.0, -0.01, 0.04, 0.0])
FRAMES = [
    WrenchFrame(),
    WrenchFrame("base", "tcp"),
    WrenchFrame("sensor", (0.01, -0.02, 0.3)),
]
CELL = CellConfig(RobotConfig(host="10.0.0.2"), SensorConfig(url="x"), ToolConfig(cylinders_mm=((0.0, 200.0, 100.0),)))


def parts_of(page: Page) -> dict[str, Any]:
    shown: dict[str, Any] = json.loads(page.since(0)[1])
    return {name: part for name, part in shown.items() if part is not None}


class Shown:
    def __init__(self, stream: Any, *, certifier: Certifier | None = None, controls: bool = False) -> None:
        self.stream, self.page, self.feed = stream, Page("ftdrive live"), SteppedFeed(stream)
        self.page.viewers = 1
        self.live = LivePage(self.page, self.feed, [], certifier, controls=controls)

    def run(self, blocks: int = 1) -> dict[str, Any]:
        """Read, draw until the plots are drawn too, and return the parts."""
        self.feed.step(blocks)
        for _ in range(5):
            self.live.draw()
        return parts_of(self.page)

    def act(self, name: str, value: object = None) -> None:
        self.page.act("viewer 2", name, value)
        self.feed.step()


def numbers_of(parts: dict[str, Any]) -> tuple[dict[str, str], ...]:
    return tuple(parts["numbers"]["rows"])


def names_of(parts: dict[str, Any]) -> list[str]:
    return [one["name"] for part in parts.values() if part["kind"] == "controls" for one in part["controls"]]


def control(parts: dict[str, Any], name: str) -> dict[str, Any]:
    found: dict[str, Any] = next(
        one for part in parts.values() if part["kind"] == "controls" for one in part["controls"] if one["name"] == name
    )
    return found


@pytest.mark.parametrize("frame", FRAMES, ids=lambda frame: frame.id)
def test_arrow_and_line_of_action_do_not_depend_on_the_frame(frame: WrenchFrame) -> None:
    stream = FakeStream("contact", block_s=0.05)
    stream.frame = frame
    parts = Shown(stream).run(240)
    R = R_BASE_FLANGE @ R_FLANGE_SENSOR
    force, torque = R @ PUSHED[:3], R @ PUSHED[3:]
    start, end = np.array(parts["scene/force"]["ends"])
    np.testing.assert_allclose(end - start, 0.01 * force, atol=1e-3)
    sensor_m = np.array([0.4, 0.1, 0.3]) + R_BASE_FLANGE @ INFO.p_flange_sensor_m
    across = torque - (torque @ force) * force / (force @ force)
    for point in np.array(parts["scene/line of action"]["points"]):
        np.testing.assert_allclose(np.cross(point - sensor_m, force), across, atol=0.02)


class Fresh(FakeStream):
    """The noise is not known yet."""

    def read(self) -> Any:
        block = super().read()
        return replace(block, chi2=np.full(len(block), np.nan))

    def sigma_of_mean(self, *_: object, **__: object) -> Any:
        return np.full(6, np.nan)


class Heavy(FakeStream):
    def __init__(self) -> None:
        super().__init__()
        self.stages = replace(self.stages, gravity=False)


STREAMS: dict[str, tuple[FakeStream, int]] = {
    "waiting": (FakeStream(), 0),
    "free": (FakeStream(), 20),
    "push": (FakeStream("contact", block_s=0.05), 240),
    "noise-unknown": (Fresh(), 3),
    "weight-included": (Heavy(), 30),
}


def in_lines(parts: dict[str, Any]) -> str:
    """The panels, and the names of what is drawn."""
    panels = [(name, part) for name, part in parts.items() if name.startswith(("alert", "numbers", "table"))]
    scene = [name for name in parts if name.startswith("scene")]
    return "\n".join([*(f"{name}: {json.dumps(part, ensure_ascii=False)}" for name, part in panels), *scene])


@pytest.mark.parametrize("name", STREAMS)
def test_what_the_page_shows(name: str, snapshot: SnapshotAssertion) -> None:
    stream, blocks = STREAMS[name]
    assert in_lines(Shown(stream).run(blocks)) == snapshot


def test_no_old_value_of_a_silent_device() -> None:
    certifier = certifier_for(CELL, "ur5e")
    stream = FakeStream("contact", silent_after=240, block_s=0.05)
    shown = Shown(stream, certifier=certifier)
    before = shown.run(240)
    assert "alert" not in before
    assert {"plots", "scene/force", "scene/flange", "scene/arm/0", "scene/arm/along"} <= before.keys()
    parts = shown.run()
    assert parts["alert"]["lines"] == ["ATI Mini45: no sample for 0.31 s"]
    assert parts["alert"]["tone"] == "bad"
    assert [row["value"] for row in numbers_of(parts)] == ["--"] * 3
    assert not any(row["sigma"] for row in numbers_of(parts))
    left = [name for name in parts if name.startswith("scene/") and name not in _still(certifier)]
    assert left == []
    assert "plots" not in parts
    stream.wake()
    assert shown.run(3).keys() == before.keys()


def _still(certifier: Certifier) -> set[str]:
    """What a page shows of a scene before the first sample."""
    return {name for name in parts_of(Shown(FakeStream(), certifier=certifier).page) if name.startswith("scene/")}


def test_viewers_tare_and_choose_the_frame_only_if_that_is_allowed() -> None:
    shown = Shown(FakeStream())
    assert names_of(shown.run(3)) == ["span"]
    for name in ("tare", "undo", "axes", "seek"):
        with pytest.raises(ValueError, match="does not have this control"):
            shown.act(name)
    shown = Shown(FakeStream(), controls=True)
    assert names_of(shown.run(3)) == ["tare", "undo", "span", "axes", "about"]
    for name in ("tare", "undo"):
        shown.act(name)
    assert shown.stream.called == ["tare", "tare-undone"]
    shown.act("axes", "flange")
    shown.act("about", "sensor")
    assert shown.stream.frame == WrenchFrame("flange", "sensor")
    parts = shown.run(3)
    assert "flange axes, about the sensor origin" in parts["table/what"]["lines"][0]
    assert (control(parts, "axes")["value"], control(parts, "about")["value"]) == ("flange", "sensor")
    assert "terminal" in parts["controls/frame"]["note"]
    with pytest.raises(ValueError, match="cannot have this value"):
        shown.act("axes", "world")


def test_a_failed_drawing_is_said_once_and_ends_nothing_else(monkeypatch: pytest.MonkeyPatch) -> None:
    shown, said = Shown(FakeStream()), list[str]()
    shown.feed.step()
    monkeypatch.setattr(StreamSummary, "view", lambda _: 1 / 0)
    with drawing(shown.page, shown.live.draw, said.append):
        while not said:
            time.sleep(0.001)
        shown.feed.step()
    (words,) = said
    assert words == "The page is no longer updated, the command continues: ZeroDivisionError('division by zero')"
    assert "\n" not in words


def weighed(
    shown: ScaleState, *, zeroed_s: float = np.inf, moving: bool = False, controls: bool = False, note: str = ""
) -> tuple[dict[str, Any], Page, FakeWeighing]:
    weighing = FakeWeighing(shown, moving=moving)
    weighing.shown, weighing.note, weighing.part_kg = shown, note, None if shown.count is None else 0.27
    weighing.zeroed_s = zeroed_s
    page = Page("ftdrive weigh")
    page.viewers = 1
    WeighPage(page, weighing, controls=controls).draw()
    return parts_of(page), page, weighing


@pytest.mark.parametrize(
    ("shown", "options"),
    [
        pytest.param(
            ScaleState(PART, None, 3), {"zeroed_s": 180, "note": "zero: the empty gripper was tared"}, id="part"
        ),
        pytest.param(ScaleState(replace(NOTHING, mass_kg=-1e-4), None), {}, id="nothing"),
        pytest.param(ScaleState(PART, "contact"), {}, id="contact"),
        pytest.param(ScaleState(None, "moving"), {}, id="moving"),
        pytest.param(ScaleState(PART, "count"), {}, id="count"),
        pytest.param(ScaleState(None, None, stale="no sample for 0.3 s"), {}, id="stale"),
        pytest.param(ScaleState(replace(NOTHING, least_kg=0.099), None), {}, id="fine-zero"),
        pytest.param(ScaleState(replace(NOTHING, least_kg=0.101), None), {"zeroed_s": 780.0}, id="old-zero"),
        pytest.param(ScaleState(replace(NOTHING, least_kg=0.101), None), {"moving": True}, id="in-motion"),
    ],
)
def test_what_the_scale_shows(shown: ScaleState, options: dict[str, Any], snapshot: SnapshotAssertion) -> None:
    parts, *_ = weighed(shown, **options)
    assert in_lines(parts) == snapshot


def test_a_viewer_zeroes_the_scale_only_if_that_is_allowed() -> None:
    for controls, moving in ((False, False), (True, True)):
        _, page, weighing = weighed(ScaleState(PART, None), controls=controls, moving=moving)
        with pytest.raises(ValueError, match="does not have this control"):
            page.act("viewer 2", "zero", None)
        assert not weighing.is_zeroing
    _, page, weighing = weighed(ScaleState(PART, None), controls=True)
    page.act("viewer 2", "zero", None)
    assert weighing.is_zeroing


def test_a_viewer_of_a_replay_pauses_and_goes_elsewhere() -> None:
    rows = paired(dwells(1, 3000, seed=1))
    stream = replayed(info(calibrated()), rows, speed=3.0)
    replay, shown = cast("Any", stream.source), Shown(stream)
    parts = shown.run()
    assert (control(parts, "play")["label"], control(parts, "speed")["value"]) == ("Pause", "3")
    shown.act("play")
    shown.act("seek", 2)
    shown.act("speed", "4")
    assert replay.is_paused
    assert replay.at_s == pytest.approx(2.0, abs=0.02)
    assert replay.speed == 4.0
    parts = shown.run(0)
    assert (control(parts, "play")["label"], control(parts, "speed")["value"]) == ("Play", "4")
    assert control(parts, "seek")["value"] == pytest.approx(replay.at_s, abs=0.1)
    assert control(parts, "seek")["text"] == f"{replay.at_s:.1f} of 3.0 s"
    shown.act("play")
    assert not replay.is_paused
    replay.seek(replay.duration_s)
    stream.read()
    assert control(shown.run(0), "play")["label"] == "Play"
    shown.act("play")
    assert replay.at_s == pytest.approx(0.0, abs=0.02)
    with pytest.raises(ValueError, match="cannot have this value"):
        shown.act("seek", 3.5)
    assert {"axes", "about"} <= {*names_of(parts)}
    assert "tare" not in names_of(parts)
