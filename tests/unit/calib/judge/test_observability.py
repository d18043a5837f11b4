"""Observability of poses: exact ranks, correct reasons, and advice that helps."""

import re
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from syrupy.assertion import SnapshotAssertion

from ftcalib import NotObservable, Parameters
from ftcalib.judge.observability import (
    AMBIGUOUS_GAP,
    NOMINAL,
    Observability,
    assess,
    different_orientations,
    evenly_spread,
    largest_gap,
    require_observable,
    require_orientations,
    second_minimum,
)
from ftcalib.model import Array, SPECIAL_R_flange_base, predict

R24 = np.swapaxes(SPECIAL_R_flange_base, 1, 2)
T12 = R24[np.array([1, 2, 5, 6, 11, 12, 15, 16, 17, 18, 21, 22]) - 1]
DOWN = Rotation.from_euler("x", 180, degrees=True)
RNG = np.random.default_rng(2021)
ANY = Rotation.random(12, rng=RNG).as_matrix()

# A tool hung askew on a tilted sensor of a robot on a wall.
WALL = Parameters(
    Rotation.from_euler("ZYX", [50, 10, 175], degrees=True).as_matrix(),
    np.array([-12.0, 3.0, 0.5]),
    np.array([3.0, -2, 8]),
    np.array([0.03, -0.02, -0.06]),
    np.array([0.1, 0.2, -0.3]),
)


def turned(axis: str, n: int = 8, tilt_deg: float = 0.0) -> Array:
    """The tool at a tilt, turned about one axis of its flange."""
    about = Rotation.from_euler(axis, np.arange(n)[:, None] * 360.0 / n, degrees=True)
    return np.asarray((Rotation.from_euler("y", tilt_deg, degrees=True) * about).as_matrix())


def about_the_vertical(n: int = 8) -> Array:
    about = Rotation.from_euler("z", np.arange(n)[:, None] * 0.7)
    return np.asarray((about * Rotation.from_euler("xy", [150, 20], degrees=True)).as_matrix())


def leaning(tilt_deg: float, n: int = 8) -> Array:
    azimuth = np.arange(n) * 2 * np.pi / n
    lean = np.deg2rad(tilt_deg) * np.column_stack([np.cos(azimuth), np.sin(azimuth), 0 * azimuth])
    return np.asarray((Rotation.from_rotvec(lean) * DOWN).as_matrix())


def within(tilt_deg: float, n: int) -> Array:
    rng = np.random.default_rng(int(tilt_deg))
    axis = rng.normal(size=(n, 3))
    axis *= np.deg2rad(tilt_deg) * rng.uniform(0, 1, (n, 1)) ** (1 / 3) / np.linalg.norm(axis, axis=1)[:, None]
    return np.asarray((Rotation.from_rotvec(axis) * DOWN).as_matrix())


OBLIQUE = (
    Rotation.from_euler("y", 0.5) * Rotation.from_rotvec(np.arange(8)[:, None] * np.array([[0.5, 0.3, 0.2]]))
).as_matrix()

HALF_TURNS = np.array([np.diag(d) for d in ([1.0, 1, 1], [1.0, -1, -1], [-1.0, 1, -1], [-1.0, -1, 1])])

DEGENERATE = {
    "one pose": (ANY[:1], 6, "there is only one orientation"),
    "one pose, repeated": (np.tile(ANY[:1], (5, 1, 1)), 6, "there is only one orientation"),
    "two poses": (ANY[:2], 11, "there are only 2 different orientations"),
    "about the vertical": (about_the_vertical(), 8, "turned about the vertical only"),
    "last joint at one tilt": (turned("z", tilt_deg=150), 13, "only the last joint was turned"),
    "about flange x": (turned("x"), 13, "turned about the flange's x axis only"),
    "about an oblique axis": (OBLIQUE, 13, r"turned about the axis \(.*\) of the flange only"),
    "half turns": (HALF_TURNS, 13, "gravity acts along one line of the tool only"),
}


@pytest.mark.parametrize("name", DEGENERATE)
def test_degenerate_sets_have_their_rank_a_reason_and_advice_that_helps(name: str) -> None:
    R, rank, words = DEGENERATE[name]
    found = assess(R)
    assert found.rank == rank
    assert found.condition == float("inf")
    assert not found.sound
    assert re.search(words, found.ambiguities[0])
    assert len(found.advice) == len(found.advised_R_base_flange) <= 3
    completed = assess(np.concatenate([R, found.advised_R_base_flange]))
    assert completed.sound
    assert completed.ambiguities == completed.advice == ()


def test_one_tilt_has_full_rank_and_an_exact_second_solution() -> None:
    R = leaning(40)
    found = assess(R)
    assert found.rank == 15
    assert found.second_gap < 1e-12
    assert "one angle to gravity, 40° from the vertical" in found.ambiguities[0]
    assert "tilt the tool" in found.sentence()
    assert len(found.advice) == 1
    completed = assess(np.concatenate([R, found.advised_R_base_flange]))
    assert completed.sound
    # The second solution itself.
    over = Rotation.from_euler("z", 180, degrees=True).as_matrix()
    height_N = float((NOMINAL.gravity_force_base_N @ R)[0, 2])
    shift = 2 * height_N * NOMINAL.R_flange_sensor.T @ [0, 0, 1]
    P = NOMINAL.p_sensor_com_m
    second = Parameters(over @ NOMINAL.R_flange_sensor, -NOMINAL.gravity_force_base_N, shift, P, np.cross(P, shift))
    np.testing.assert_allclose(predict(second, R), predict(NOMINAL, R), atol=1e-12)


def test_little_tilt_is_called_so() -> None:
    found = assess(within(15, 12))
    assert found.rank == 15
    assert "gravity stays within 1" in found.ambiguities[0]
    assert assess(np.concatenate([within(15, 12), found.advised_R_base_flange])).sound


def test_inexact_poses_do_not_hide_a_degenerate_set() -> None:
    exact = turned("z", tilt_deg=150)
    real = exact @ Rotation.from_rotvec(2e-4 * np.random.default_rng(4).normal(size=(8, 3))).as_matrix()
    found = assess(real)
    assert found.rank == 15
    assert found.condition > 1e6
    assert "the last joint" in found.ambiguities[0]
    assert assess(np.concatenate([real, found.advised_R_base_flange])).sound


@pytest.mark.parametrize("R", [R24, T12, ANY, ANY[:6]], ids=["24", "12", "any 12", "any 6"])
@pytest.mark.parametrize("tool", [NOMINAL, WALL], ids=["upright", "wall"])
def test_sound_sets_get_no_advice(R: Array, tool: Parameters) -> None:
    found = assess(R, tool)
    assert found.sound
    assert found.ambiguities == found.advice == ()
    require_observable(R, tool)
    require_observable(R[:4] if R is ANY else R, tool)  # any four are enough, if the tool is not too light


def test_three_orientations_are_never_enough_although_their_rank_is_full() -> None:
    R = np.concatenate([ANY[:3], ANY[:3]])
    found = assess(R)
    assert (found.rank, found.orientations) == (15, 3)
    assert second_minimum(R)[0] < AMBIGUOUS_GAP
    assert not found.sound
    assert assess(np.concatenate([R, found.advised_R_base_flange])).sound
    with pytest.raises(NotObservable, match="only 3 different"):
        require_orientations(R)


@pytest.mark.parametrize(
    "R",
    [ANY[:3], leaning(40), about_the_vertical()],
    ids=["few", "one tilt", "about the vertical"],
)
def test_rejections_are_one_sentence_with_advice(R: Array, snapshot: SnapshotAssertion) -> None:
    with pytest.raises(NotObservable) as refusal:
        require_observable(R, NOMINAL)
    reason, _, _ = str(refusal.value).partition("from the last one")  # which of equal turns is proposed may vary
    assert reason == snapshot


def test_without_parameters_only_the_count_is_checked() -> None:
    require_orientations(leaning(40))
    with pytest.raises(NotObservable, match=r"4 poses .* add 1"):
        require_orientations(ANY[:4], least=5)


def test_orientations_are_counted_with_half_a_degree() -> None:
    near = Rotation.from_euler("x", [[0], [0.4], [0.6]], degrees=True).as_matrix()
    assert different_orientations(near) == 2
    assert different_orientations(R24) == 24


SOUND = Observability(4, 15, 0.99e4, (), (), np.zeros((0, 3, 3)), 0.021)


def test_a_set_is_sound_up_to_its_limits() -> None:
    assert SOUND.sound
    assert not replace(SOUND, orientations=3).sound
    assert not replace(SOUND, rank=14).sound
    assert not replace(SOUND, condition=1.01e4).sound
    assert not replace(SOUND, second_gap=0.019).sound


@pytest.mark.parametrize(
    ("ambiguities", "advice", "sentence"),
    [
        ((), (), "the poses determine all parameters (condition 9.9e+03, gap 0.021)."),
        (("a",), (), "a."),
        (("a", "b"), ("x",), "a: b; add a pose: from the last one, x."),
        (("a", "b", "c"), ("x", "y"), "a: b, and c; add 2 poses, each from the last one: x; y."),
    ],
)
def test_reason_and_advice_are_one_sentence(
    ambiguities: tuple[str, ...], advice: tuple[str, ...], sentence: str
) -> None:
    assert replace(SOUND, ambiguities=ambiguities, advice=advice).sentence() == sentence


def test_directions_are_evenly_spread() -> None:
    n = 500
    u = evenly_spread(n)
    np.testing.assert_allclose(np.linalg.norm(u, axis=1), 1)
    np.testing.assert_allclose(u.mean(axis=0), 0, atol=2 / n)
    np.testing.assert_allclose(u.T @ u / n, np.eye(3) / 3, atol=2 / n)
    cosine = u @ u.T - 2 * np.eye(n)
    nearest = np.arccos(cosine.max(axis=1)) / np.sqrt(4 * np.pi / n)  # relative to the side of the area of each
    assert 0.8 < nearest.min() <= nearest.max() < 1.1


@pytest.mark.parametrize("copies", [1, 400])
@pytest.mark.parametrize(
    ("directions", "gap_deg", "towards"),
    [
        ([[0, 0, 1]], 180.0, [0, 0, -1]),
        ([[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, 0, 1], [0, 0, -1]], 90.0, [0, -1, 0]),
        (np.vstack([np.eye(3), -np.eye(3)]), np.degrees(np.arccos(1 / np.sqrt(3))), None),
    ],
)
def test_the_largest_gap(
    directions: list[list[float]], gap_deg: float, towards: list[float] | None, copies: int
) -> None:
    given = np.repeat(np.array(directions, dtype=np.float64), copies, axis=0)
    angle_rad, direction = largest_gap(given)
    assert np.degrees(angle_rad) == pytest.approx(gap_deg, abs=2)
    assert np.arccos((given @ direction).max()) == pytest.approx(angle_rad)
    if towards is not None:
        assert np.degrees(np.arccos(np.clip(direction @ towards, -1, 1))) < 3
