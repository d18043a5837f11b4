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
from ftdrive.view.plan_page import PlanPage
from ftdrive.view.scene import turned_up


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


@pytest.mark.slow
def test_one_button_plays_and_pauses_and_a_step_pauses(shown: Shown, page: Page) -> None:
    page.act("viewer 0", "speed", "8 ×")
    assert control(shown, "play")["label"] == "Play"
    page.act("viewer 0", "play", None)
    assert control(shown, "play")["label"] == "Pause"
    ended = threading.Event()
    thread = threading.Thread(target=shown.play, args=(ended,))
    thread.start()
    time.sleep(0.3)
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


@given(st.lists(st.floats(-1, 1), min_size=3, max_size=3).filter(lambda v: float(np.linalg.norm(v)) > 1e-3))
@example([0.0, 0.0, -1.0])
def test_bodies_point_where_they_should(direction: list[float]) -> None:
    axis = np.array(direction) / np.linalg.norm(direction)
    turned = Rotation.from_quat(turned_up(axis), scalar_first=True).apply([0.0, 0.0, 1.0])
    np.testing.assert_allclose(turned, axis, atol=1e-6)
