"""The scene of a plan: where it puts things. What a browser draws is looked at by eye."""

import urllib.error
import urllib.request
from importlib.util import find_spec

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from ftdrive.errors import ConfigError
from ftdrive.planning.geometry.arm_model import ArmModel, Cylinder
from ftdrive.planning.geometry.certify import Certifier
from ftdrive.planning.geometry.scene import BASE_PLANE, Box, Plane, Scene
from ftdrive.planning.motion import Speeds
from ftdrive.planning.plan import Plan
from ftdrive.planning.planner import guess_of, plan_tour
from ftdrive.view.page import serve
from ftdrive.view.plan_page import describe, path
from ftdrive.view.scene import line_of_action, revolved, turned_up


@pytest.fixture(scope="module")
def certifier() -> Certifier:
    scene = Scene((BASE_PLANE, Plane((-1.0, 0.0, 0.0), -0.9)), (Box((0.5, 0.5, 0.0), (0.7, 0.7, 0.2)),))
    return Certifier(ArmModel("ur5e", [Cylinder(0.0, 0.2, 0.1)]), scene)


@pytest.fixture(scope="module")
def plan(certifier: Certifier) -> Plan:
    return plan_tour(certifier, poses=6, speeds=Speeds(), guess=guess_of(certifier))


def test_the_slider_goes_through_every_pose_and_back(plan: Plan) -> None:
    q, move = path(plan)
    assert len(q) == len(move)
    poses = np.array([step.q_rad for step in plan.steps])
    starts = np.flatnonzero(np.diff(move, prepend=-1))
    np.testing.assert_allclose(q[starts], poses)
    np.testing.assert_allclose(q[-1], poses[0])
    assert np.abs(np.diff(q, axis=0)).max() <= np.radians(3) + 1e-9
    assert [describe(plan, int(i)).split("**")[1] for i in (0, len(poses) - 1)] == ["1 of 6", "6 of 6"]


def test_the_slider_begins_where_the_arm_stands(plan: Plan) -> None:
    first = np.array(plan.steps[0].q_rad)
    way = first + np.radians([[-20.0, 0, 0, 10, 0, 0], [0.0, 0, 0, 10, 0, 0], [0.0] * 6])
    q, move = path(plan, way)
    alone, _ = path(plan)
    np.testing.assert_allclose(q[0], way[0])
    np.testing.assert_allclose(q[move >= 0], alone)
    assert np.abs(np.diff(q, axis=0)).max() <= np.radians(3) + 1e-9
    assert "From the present posture" in describe(plan, int(move[0]))


@given(st.floats(0, 1), st.floats(0, 0.5), st.floats(0, 0.2))
def test_bodies_have_their_size_and_are_closed(half_length: float, radius: float, rounding: float) -> None:
    vertices, faces = revolved(half_length, radius, rounding)
    assert abs(vertices[:, 2]).max() == pytest.approx(half_length + rounding)
    assert np.hypot(*vertices[:, :2].T).max() == pytest.approx(radius + rounding)
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    directed = {tuple(edge) for edge in edges.tolist()}
    rim = [edge for edge in directed if edge[::-1] not in directed]
    assert np.allclose(vertices[list({i for edge in rim for i in edge})][:, :2], 0)  # only where the caps meet the axis


def test_faces_look_outward() -> None:
    vertices, faces = revolved(0.3, 0.1, 0.05)
    a, b, c = (vertices[faces[:, i]] for i in range(3))
    normal = np.cross(b - a, c - a)
    assert np.all((normal * (a + b + c)).sum(axis=1) >= -1e-12)


@given(st.lists(st.floats(-1, 1), min_size=3, max_size=3).filter(lambda v: float(np.linalg.norm(v)) > 1e-3))
def test_bodies_point_where_they_should(direction: list[float]) -> None:
    axis = np.array(direction) / np.linalg.norm(direction)
    turned = Rotation.from_quat(turned_up(axis), scalar_first=True).apply([0.0, 0.0, 1.0])
    np.testing.assert_allclose(turned, axis, atol=1e-6)


def test_straight_down_is_a_direction_too() -> None:
    turned = Rotation.from_quat(turned_up(np.array([0.0, 0.0, -1.0])), scalar_first=True).apply([0.0, 0.0, 1.0])
    np.testing.assert_allclose(turned, [0, 0, -1], atol=1e-12)


@given(st.lists(st.floats(-1, 1), min_size=3, max_size=3), st.lists(st.floats(0.1, 9), min_size=3, max_size=3))
def test_a_force_on_its_line_of_action_has_the_torque(p: list[float], force: list[float]) -> None:
    at, F = np.array([0.3, -0.2, 0.5]), np.array(force)
    torque = np.cross(np.array(p), F)
    ((start, end),) = line_of_action(at, np.concatenate([F, torque]))
    for point in (start, end):
        np.testing.assert_allclose(np.cross(point - at, F), torque, atol=1e-9)


def test_a_page_on_this_computer_or_what_to_install() -> None:
    if find_spec("viser") is None:
        with pytest.raises(ConfigError, match=r"of the extra viz"), serve("a plan"):
            pass
        return
    with serve("a plan") as page:
        assert page.url.startswith("http://127.0.0.1:")
        bare = page.url.partition("?")[0]
        opener = urllib.request.build_opener(urllib.request.HTTPCookieProcessor())
        for url, headers in (
            (bare, {}),
            (f"{bare}?token=guessed", {}),
            (page.url, {"Origin": "https://evil.example"}),
            (page.url, {"Host": "evil.example"}),
        ):
            with pytest.raises(urllib.error.HTTPError, match="403"):
                opener.open(urllib.request.Request(url, headers=headers), timeout=10)
        for url in (page.url, bare):  # the token is needed once
            with opener.open(url, timeout=10) as answer:
                assert b"<html" in answer.read()
