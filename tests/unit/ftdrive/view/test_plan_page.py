"""The page of a plan: the plan over time, and what viewers choose. What a browser draws is looked at by eye."""

import json
import threading
import time
from typing import Any

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from ftdrive.planning.geometry.arm_model import ArmModel, Cylinder
from ftdrive.planning.geometry.certify import Certifier
from ftdrive.planning.geometry.scene import BASE_PLANE, Box, Plane, Scene
from ftdrive.planning.motion import Speeds
from ftdrive.planning.plan import Plan
from ftdrive.planning.planner import guess_of, plan_tour
from ftdrive.view.page import Page
from ftdrive.view.plan_page import PlanPage, PlanTimeline, describe_move
from ftdrive.view.scene import arm_parts, turned_up, wrench_parts


@pytest.fixture(scope="module")
def certifier() -> Certifier:
    scene = Scene((BASE_PLANE, Plane((-1.0, 0.0, 0.0), -0.9)), (Box((0.5, 0.5, 0.0), (0.7, 0.7, 0.2)),))
    return Certifier(ArmModel("ur5e", [Cylinder(0.0, 0.2, 0.1)]), scene)


@pytest.fixture(scope="module")
def plan(certifier: Certifier) -> Plan:
    return plan_tour(certifier, poses=6, speeds=Speeds(), guess=guess_of(certifier))


@pytest.fixture
def page() -> Page:
    return Page("test")


class Shown(PlanPage):
    def __init__(self, page: Page, plan: Plan, certifier: Certifier) -> None:
        super().__init__(page, plan, certifier)
        self.page, self.arm = page, certifier.arm

    def along_s(self) -> float:
        return float(control(self, "along")["value"])


@pytest.fixture
def shown(page: Page, plan: Plan, certifier: Certifier) -> Shown:
    return Shown(page, plan, certifier)


def parts_of(shown: Shown) -> dict[str, Any]:
    shown.draw()
    parts = json.loads(shown.page.since(0)[1])
    return {name: part for name, part in parts.items() if part is not None}


def control(shown: Shown, name: str) -> dict[str, Any]:
    (found,) = [one for one in parts_of(shown)["controls"]["controls"] if one["name"] == name]
    return dict(found)


def arm_is_at(shown: Shown, q_rad: Any) -> bool:
    parts = parts_of(shown)
    wanted = arm_parts(shown.arm, q_rad)
    return all(np.allclose(parts[name]["at"], part["at"], atol=1e-3) for name, part in wanted.items() if part)


def test_the_tour_goes_through_every_pose_in_its_time_and_back(plan: Plan) -> None:
    tour = PlanTimeline(plan)
    np.testing.assert_allclose(tour.at(tour.begins_s), plan.nodes_rad)
    np.testing.assert_allclose(tour.at([0.0, tour.end_s]), plan.nodes_rad[[0, 0]])
    assert tour.end_s == pytest.approx(plan.motion_time_s)
    middle_s = tour.begins_s[2] + plan.steps[2].duration_s / 2
    np.testing.assert_allclose(tour.at(middle_s), plan.nodes_rad[2:4].mean(axis=0))
    assert [tour.move(float(t_s)) for t_s in tour.begins_s] == list(range(6))
    assert [describe_move(plan, move)[0].split(",")[0] for move in (0, 5)] == ["Move 1 of 6", "Move 6 of 6"]
    assert all(np.abs(tour.q_rad - q).max(axis=1).min() < 1e-9 for q in plan.nodes_rad)
    assert np.abs(np.diff(tour.q_rad, axis=0)).max() < np.radians(7)


def test_the_tour_begins_where_the_arm_stands(plan: Plan) -> None:
    way = plan.nodes_rad[0] + np.radians([[-20.0, 0, 0, 10, 0, 0], [0.0, 0, 0, 10, 0, 0], [0.0] * 6])
    tour, alone = PlanTimeline(plan, way), PlanTimeline(plan)
    approach_s = tour.begins_s[0]
    np.testing.assert_allclose(tour.at(0.0), way[0])
    assert approach_s > 1
    assert tour.end_s == pytest.approx(approach_s + alone.end_s)
    np.testing.assert_allclose(tour.at(approach_s + 3.0), alone.at(3.0))
    assert (tour.move(approach_s - 0.1), tour.move(approach_s)) == (-1, 0)
    assert "From the present posture" in describe_move(plan, tour.move(0.0))[0]


def test_the_approach_of_a_resumed_run_ends_at_its_own_pose(plan: Plan) -> None:
    way = np.array([plan.nodes_rad[2] + 0.2, plan.nodes_rad[2]])
    tour = PlanTimeline(plan, way)
    np.testing.assert_allclose(tour.at(tour.begins_s[0] - 1e-9), plan.nodes_rad[2], atol=1e-6)
    np.testing.assert_allclose(tour.at(tour.begins_s[0]), plan.nodes_rad[0])


def test_the_page_shows_cell_plan_and_controls(shown: Shown, plan: Plan) -> None:
    parts = parts_of(shown)
    assert {"scene/plane 1", "scene/plane 2", "scene/box 1", "scene/ball", "scene/path", "scene/camera"} <= set(parts)
    named = {colour for colour, _, _ in parts["scene/legend"]["rows"]}
    assert {part["colour"] for name, part in parts.items() if name.startswith("scene/") and "colour" in part} == named
    assert (parts["state"]["head"], *parts["state"]["lines"]) == describe_move(plan, 0)
    assert arm_is_at(shown, plan.nodes_rad[0])


def test_viewers_step_from_pose_to_pose(shown: Shown, page: Page, plan: Plan) -> None:
    for name, at in (("next", 1), ("next", 2), ("previous", 1), ("previous", 0), ("previous", 5), ("next", 0)):
        page.act("viewer 0", name, None)
        assert arm_is_at(shown, plan.nodes_rad[at]), (name, at)
        assert control(shown, "along")["text"].startswith(f"pose {at + 1} of 6, ")
    page.act("viewer 0", "largest", None)
    largest = int(np.argmax([step.turn_rad for step in plan.steps]))
    assert arm_is_at(shown, plan.nodes_rad[largest])
    assert parts_of(shown)["state"]["head"] == describe_move(plan, largest)[0]


def test_the_slider_moves_the_arm(shown: Shown, page: Page, plan: Plan) -> None:
    tour = PlanTimeline(plan)
    page.act("viewer 0", "along", 4.0)
    assert arm_is_at(shown, tour.at(4.0))
    assert (control(shown, "along")["value"], control(shown, "along")["text"].split(", ")[1]) == (
        4.0,
        f"4 of {tour.end_s:.0f} s",
    )
    with pytest.raises(ValueError, match="cannot have this value"):
        page.act("viewer 0", "along", tour.end_s + 1)


def test_one_button_plays_and_pauses_and_a_step_pauses(shown: Shown, page: Page) -> None:
    page.act("viewer 0", "speed", "8 ×")
    assert control(shown, "play")["label"] == "Play"
    page.act("viewer 0", "play", None)
    assert control(shown, "play")["label"] == "Pause"
    ended = threading.Event()
    thread = threading.Thread(target=shown.play, args=(ended,))
    thread.start()
    time.sleep(0.5)
    page.act("viewer 0", "play", None)
    moved_s = shown.along_s()
    time.sleep(0.2)
    ended.set()
    thread.join()
    assert 1.0 < moved_s < 12.0
    assert shown.along_s() == moved_s
    page.act("viewer 0", "play", None)
    page.act("viewer 0", "next", None)
    assert control(shown, "play")["label"] == "Play"


def test_playing_goes_round(shown: Shown, page: Page, plan: Plan) -> None:
    page.act("viewer 0", "along", round(plan.motion_time_s - 0.05, 1))
    page.act("viewer 0", "play", None)
    ended = threading.Event()
    threading.Timer(0.3, ended.set).start()
    shown.play(ended)
    assert 0 < shown.along_s() < 2


def test_the_room_that_the_tool_sweeps_over(shown: Shown, page: Page) -> None:
    assert not [name for name in parts_of(shown) if name.startswith("scene/swept")]
    page.act("viewer 0", "swept", True)
    parts = parts_of(shown)
    swept = [part for name, part in parts.items() if name.startswith("scene/swept")]
    assert len(swept) == 1
    assert swept[0]["alpha"] < 1
    copies = np.array(swept[0]["copies"])
    assert copies.shape[1] == 7
    assert len(copies) > 50
    np.testing.assert_allclose(np.linalg.norm(copies[:, 3:], axis=1), 1, atol=1e-3)
    assert np.ptp(copies[:, :3], axis=0).max() > 0.1
    assert [words for _, _, words in parts["scene/legend"]["rows"]][-1] == "space swept by the tool"
    page.act("viewer 0", "swept", False)
    assert not [name for name in parts_of(shown) if name.startswith("scene/swept")]


@given(st.lists(st.floats(-1, 1), min_size=3, max_size=3).filter(lambda v: float(np.linalg.norm(v)) > 1e-3))
@example([0.0, 0.0, -1.0])
def test_bodies_point_where_they_should(direction: list[float]) -> None:
    axis = np.array(direction) / np.linalg.norm(direction)
    turned = Rotation.from_quat(turned_up(axis), scalar_first=True).apply([0.0, 0.0, 1.0])
    np.testing.assert_allclose(turned, axis, atol=1e-6)


@given(st.lists(st.floats(-1, 1), min_size=3, max_size=3), st.lists(st.floats(0.1, 9), min_size=3, max_size=3))
def test_a_force_on_its_line_of_action_has_the_torque(p: list[float], force: list[float]) -> None:
    at, F = np.array([0.3, -0.2, 0.5]), np.array(force)
    torque = np.cross(np.array(p), F)
    line = wrench_parts(at, np.concatenate([F, torque]), 1.0, 1.0)["scene/line of action"]
    assert line is not None
    for point in np.array(line["points"]):
        np.testing.assert_allclose(np.cross(point - at, F), torque, atol=5e-3)  # a page has five digits
