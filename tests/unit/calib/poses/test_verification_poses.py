"""Poses for a verification: far from the fit, few, and informative about every cause."""

from itertools import combinations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from ftcalib.model import Array
from ftcalib.poses.information import special, whitened_jacobian
from ftcalib.poses.selection import TOOL, USUAL_CHANGE, choose_verification_poses

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


@pytest.mark.parametrize("n", [2, 6])
def test_chosen_poses_are_far_from_the_fit_and_more_informative_than_others(n: int) -> None:
    R = candidates()
    chosen = choose_verification_poses(R, FITTED, n)
    assert len(set(chosen.tolist())) == n
    distance = distance_rad(R, FITTED)
    assert distance[chosen].min() >= np.median(distance) - 1e-9
    far = R[distance >= np.median(distance)]
    rng = np.random.default_rng(2)
    others = [information(far[rng.choice(len(far), n, replace=False)]) for _ in range(200)]
    assert information(R[chosen]) > np.quantile(others, 0.95)


def test_no_other_pose_of_the_farther_half_is_more_informative() -> None:
    R = candidates(60)
    chosen = choose_verification_poses(R, FITTED, 3).tolist()
    far = np.argsort(-distance_rad(R, FITTED))[:30].tolist()
    assert set(chosen) <= set(far)
    exchanged = [information(R[[*chosen[:i], k, *chosen[i + 1 :]]]) for i in range(3) for k in far if k not in chosen]
    assert max(exchanged) <= information(R[chosen]) * (1 + 1e-6)


def test_two_poses_differ_in_tilt() -> None:
    R = candidates()
    first, second = DOWN @ R[choose_verification_poses(R, FITTED, 2)]
    assert abs(first @ second) < np.cos(np.deg2rad(30))


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
        with pytest.raises(ValueError, match=f"cannot choose {n} poses of 3"):
            choose_verification_poses(candidates(3), FITTED, n)
