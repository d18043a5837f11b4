"""The page of a session as an operator: what it passes on, who stops, and what it shows without a browser."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from ftdrive.errors import Declined
from ftdrive.session import session
from ftdrive.session.events import (
    Compared,
    Estimated,
    GuardTripped,
    Key,
    Noted,
    PoseTaken,
    Question,
    State,
    StateChanged,
)
from ftdrive.session.options import SessionOptions
from ftdrive.session.session import Calibrating
from ftdrive.view.page import Page, serve
from ftdrive.view.session_page import SessionPage
from tests.unit.ftdrive.fake_cell import Lab, Scripted

pytest.importorskip("viser", reason="the extra viz is not installed")


@pytest.fixture(scope="module")
def page() -> Iterator[Page]:
    with serve("test") as page:
        yield page


@pytest.fixture
def lab(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Lab:
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
    return Lab(tmp_path, monkeypatch)


def pose(stop: int, down: tuple[float, float, float]) -> PoseTaken:
    return PoseTaken(
        stop=stop,
        stops=7,
        number=stop,
        gravity_flange=np.array(down),
        mean=np.zeros(6),
        sigma=np.full(6, 0.01),
        samples=100,
        settle_s=0.5,
        average_s=1.0,
        attempts=1,
        steady=True,
    )


def estimated(sigmas: float | None, **values: float) -> Estimated:
    return Estimated(
        poses=5,
        values=values,
        sigma=dict.fromkeys(values, 0.00213),
        residual_sigma=sigmas,
        residual_force_N=0.1,
        faces=(1, 1, 1, 1, 1, 0),
        cond9=1.5,
        cond_u1=1.5,
        empty_cap_deg=60.0,
        light="amber",
        hint="",
    )


def shown(page: SessionPage) -> dict[str, str]:
    page.draw()
    return {part: text.content for part, text in page._texts.items()}


def run_with(lab: Lab, page: SessionPage) -> None:
    chosen = lab._options(watch=page.watch)
    session.take_poses(Calibrating(lab.cell, chosen), page, chosen)


def test_a_stop_in_mid_move_ends_the_session_in_the_name_of_the_viewer(lab: Lab, page: Page) -> None:
    lab.operator.has_keys = False
    watched = SessionPage(page, lab.operator, "calibrate")

    def press() -> None:
        watched.stop("viewer 2")
        watched.stop("viewer 3")

    lab.arm.at_move[4] = press
    with pytest.raises(Declined, match="stopped by viewer 2"):
        run_with(lab, watched)
    assert len(lab.arm.moves) == 4
    stopped = [event.words for event in lab.operator.of(StateChanged) if event.state is State.STOP]
    assert stopped == ["stopped by viewer 2"]
    assert "stopped by viewer 2" in (lab.run().folder / "events.ndjson").read_text()
    assert "Stop was pressed by viewer 2" in shown(watched)["alert"]


@pytest.mark.parametrize("words", ["Is the tool free", "Type MOVE"])
def test_nothing_moves_after_a_stop_at_a_question(words: str, lab: Lab, page: Page) -> None:
    watched = SessionPage(page, lab.operator, "calibrate")
    lab.operator.at_question = [(words, lambda: watched.stop("viewer 1"))]
    with pytest.raises(Declined, match="stopped by viewer 1"):
        run_with(lab, watched)
    assert lab.arm.moves == []
    assert words in lab.operator.asked[-1].text
    for folder in (lab.folder / "runs").glob("*"):
        assert "stopped by viewer 1" in (folder / "events.ndjson").read_text()


def test_the_rest_is_that_of_the_terminal(page: Page) -> None:
    terminal = Scripted(keys=[Key.SKIP], gone="the terminal was closed")
    watched = SessionPage(page, terminal, "calibrate")
    assert watched.has_keys
    assert watched.absence() == "the terminal was closed"
    assert watched.pressed() is Key.SKIP
    assert watched.pressed_by == "the operator"
    assert watched.pressed() is None
    assert watched.ask(Question("Go on?")) == "yes"
    watched.show(note := Noted(words="a note"))
    assert terminal.shown == [note]


def test_a_question_is_shown_while_it_waits(page: Page) -> None:
    terminal = Scripted()
    watched = SessionPage(page, terminal, "calibrate")
    seen = []
    terminal.at_question = [("<Go>", lambda: seen.append(shown(watched)["question"]))]
    watched.ask(Question("<Go> on?"))
    assert "&lt;Go&gt; on?" in seen[0]
    assert shown(watched)["question"] == ""


def test_the_arm_and_its_next_pose_are_drawn(lab: Lab, page: Page) -> None:
    watched = SessionPage(page, lab.operator, "calibrate")
    at: list[tuple[np.ndarray, bool, np.ndarray]] = []

    def look(_: object) -> None:
        watched.draw()
        cell = watched._scene
        if cell is not None and lab.operator.states()[-1] is State.MOVE:
            ghost = cell._drawn[cell._ghost]
            assert ghost is not None
            arm = cell._drawn[cell._arm]
            assert arm is not None
            at.append((arm, cell._ghost._meshes[0].visible, ghost))

    lab.operator.on_event = look
    run_with(lab, watched)
    assert watched._scene is not None
    nodes = watched._scene.plan.nodes_rad
    assert len(at) == 6
    for k, (arm, ghost_is_visible, ghost) in enumerate(at):
        np.testing.assert_allclose(arm, nodes[k], atol=1e-3)
        assert ghost_is_visible
        np.testing.assert_allclose(ghost, nodes[(k + 1) % 6])
    assert not watched._scene._ghost._meshes[0].visible
    texts = shown(watched)
    assert "7 kept" in texts["state"]
    assert "°/s" in texts["guards"]


def test_poses_have_the_colour_of_their_residual(page: Page) -> None:
    watched = SessionPage(page, Scripted(), "calibrate")
    for stop, sigmas in ((1, None), (2, 1.0), (3, 4.0), (4, 20.0)):
        watched.show(pose(stop, (0.0, 0.0, 1.0)))
        watched.show(estimated(sigmas))
    watched.show(pose(2, (1.0, 0.0, 0.0)))
    watched.show(Compared(stop=2, number=2, residual=np.ones(6), sigma=np.full(6, 0.1), poses=4, light="green"))
    watched.draw()
    cloud = watched._poses
    assert len({tuple(colour) for colour in cloud.colors}) == 3
    np.testing.assert_array_equal(cloud.colors[1], cloud.colors[3])
    np.testing.assert_allclose(cloud.points[1] / np.linalg.norm(cloud.points[1]), np.eye(3)[0], atol=1e-3)


def test_estimates_have_the_digits_of_their_sigma(page: Page) -> None:
    watched = SessionPage(page, Scripted(), "calibrate")
    watched.show(pose(1, (0.0, 0.0, 1.0)))
    watched.show(estimated(1.0, mass_kg=1.2345678, p_sensor_com_m=0.0512345))
    results = shown(watched)["results"]
    assert "1.2346" in results
    assert "0.0021" in results
    assert "51.2" in results
    assert "centre mm" in results


def test_a_trip_is_red_until_the_next_pose(page: Page) -> None:
    watched = SessionPage(page, Scripted(), "calibrate")
    watched.show(GuardTripped(hazard=14, words="contact of 9 N"))
    alert = shown(watched)["alert"]
    assert "contact of 9 N" in alert
    assert "color:" in alert
    watched.show(pose(1, (0.0, 0.0, 1.0)))
    assert shown(watched)["alert"] == ""


@pytest.mark.slow
def test_a_sweep_is_one_motion(lab: Lab, page: Page) -> None:
    watched = SessionPage(page, lab.operator, "calibrate")
    seen: list[str] = []
    lab.operator.at_question = [("Type MOVE", lambda: seen.append(shown(watched)["question"]))]

    def look(event: object) -> None:
        if isinstance(event, StateChanged) and event.state is State.SWEEP:
            watched.stop("viewer 0")

    lab.operator.on_event = look
    chosen = SessionOptions(lab.folder / "runs", mode="sweep", seconds=10.0, watch=watched.watch)
    with pytest.raises(Declined, match="stopped by viewer 0"):
        session.take_poses(Calibrating(lab.cell, chosen), watched, chosen)
    assert "Sweep of 10 s" in seen[0]
    assert watched._scene is not None
    assert len(watched._scene.path_rad) > 100
    assert lab.operator.states()[-1] is State.STOP
