"""The sets of Yu's Fig. 6: their counts, where their tools point, and that they are always the same."""

from itertools import combinations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from ftcalib.model import Array
from ftcalib.poses.information import special, whitened_jacobian
from ftcalib.poses.selection import (
    COUNTS,
    EVERY_SET,
    TOOL,
    USUAL_CHANGE,
    choose_verification_poses,
    paper_set,
    set_names,
    set_numbers,
)

CEILING = np.array([0.0, 0.0, 1.0])


def test_the_sets_are_those_of_the_figure_each_time() -> None:
    for name, count in COUNTS.items():
        R = paper_set(name)
        assert R.shape == (count, 3, 3)
        np.testing.assert_allclose(R @ np.swapaxes(R, 1, 2), np.broadcast_to(np.eye(3), R.shape), atol=1e-12)
        np.testing.assert_array_equal(R, paper_set(name))
    np.testing.assert_array_equal(paper_set("H"), paper_set("E")[:12])
    apart = {name: paper_set(name)[0].tobytes() for name in "ABCDEFG"}
    assert len(set(apart.values())) == 7


def test_spare_orientations_follow_the_set() -> None:
    for name in "BDEF":
        np.testing.assert_array_equal(paper_set(name, spare=30)[: COUNTS[name]], paper_set(name))
        assert len(paper_set(name, spare=30)) == COUNTS[name] + 30


@pytest.mark.parametrize("down", [-CEILING, CEILING, np.array([1.0, 0.0, 0.0])])
def test_e_and_f_are_on_opposite_sides_and_never_point_up(down: np.ndarray) -> None:
    axis = {name: paper_set(name, down_base=down)[:, :, 2] for name in "EFGH"}
    forwards = np.eye(3)[2 if down[0] else 0]
    for name, side in (("E", 1), ("F", -1), ("G", 1), ("H", 1)):
        middle = (down + side * forwards) / np.sqrt(2)
        assert (axis[name] @ middle).min() >= 0.5
        assert (axis[name] @ middle).min() < 0.7  # they fill their cone of 60 degrees


def test_numbers_are_those_of_the_paper_for_a_and_unique_for_all() -> None:
    assert set_numbers("A").tolist() == list(range(1, 25))
    every = np.concatenate([set_numbers(name) for name in EVERY_SET.split("+")])
    assert len(np.unique(every)) == len(every) == 294
    assert set(set_numbers("H")) < set(set_numbers("E"))


@pytest.mark.parametrize(
    ("sets", "words"), [("A+X", "no set 'X'"), ("", "no set ''"), ("A+A", "a set twice"), ("E+H", "half of E")]
)
def test_names_that_are_no_sets_are_refused(sets: str, words: str) -> None:
    with pytest.raises(ValueError, match=words):
        set_names(sets)


def test_an_unknown_set_is_refused() -> None:
    with pytest.raises(ValueError, match="no set Z"):
        paper_set("Z")


DOWN = np.array([0.0, 0.0, -1.0])
FITTED = special(range(1, 25))


def candidates(m: int = 200) -> Array:
    return np.asarray(Rotation.random(m, rng=np.random.default_rng(1)).as_matrix())


def distance_rad(R: Array, fitted: Array, down: Array = DOWN) -> Array:
    """Angle of gravity in the flange to the nearest of the fit."""
    return np.asarray(np.arccos(np.clip(((down @ R) @ (down @ fitted).T).max(axis=1), -1, 1)))


def information(R: Array) -> float:
    """About each pair of mounting, gravity, centre of mass and bias."""
    J = (whitened_jacobian(R, TOOL) / TOOL.scale * USUAL_CHANGE).reshape(-1, 15)
    causes = ([0, 1, 2], [3, 4, 5], [9, 10, 11], [6, 7, 8, 12, 13, 14])
    pairs = [J[:, [*a, *b]] for a, b in combinations(causes, 2)]
    return float(sum(np.linalg.slogdet(np.eye(pair.shape[1]) + pair.T @ pair)[1] for pair in pairs))


def test_no_other_pose_of_the_farther_half_is_more_informative() -> None:
    R = candidates(60)
    chosen = choose_verification_poses(R, FITTED, 3).tolist()
    far = np.argsort(-distance_rad(R, FITTED))[:30].tolist()
    assert set(chosen) <= set(far)
    exchanged = [information(R[[*chosen[:i], k, *chosen[i + 1 :]]]) for i in range(3) for k in far if k not in chosen]
    assert max(exchanged) <= information(R[chosen]) * (1 + 1e-6)


def test_gravity_of_a_wall_counts() -> None:
    """On a wall, poses that turn about the base x axis all have one direction of gravity."""
    wall = np.array([-1.0, 0.0, 0.0])
    fitted = Rotation.from_euler("x", np.arange(0, 360, 30)[:, None], degrees=True).as_matrix()
    near = Rotation.from_euler("x", np.arange(15, 360, 30)[:, None], degrees=True).as_matrix()
    R = np.concatenate([near, candidates(12)])
    chosen = choose_verification_poses(R, fitted, 4, gravity_direction_base=wall)
    assert chosen.min() >= 12
    assert distance_rad(R, fitted, wall)[:12].max() < 1e-6


def test_few_candidates_are_all_taken_and_too_few_are_refused() -> None:
    assert sorted(choose_verification_poses(candidates(3), FITTED, 3)) == [0, 1, 2]
    for n in (1, 4):
        with pytest.raises(ValueError, match=f"cannot choose {n} of 3"):
            choose_verification_poses(candidates(3), FITTED, n)
