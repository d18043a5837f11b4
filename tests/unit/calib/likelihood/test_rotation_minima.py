"""All minima over the rotations, checked against least squares and brute force; and the proof."""

from itertools import permutations, product

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.optimize import minimize
from scipy.spatial.transform import Rotation

from ftcalib.likelihood import rotation_minima

Array = NDArray[np.float64]

GRAVITY_N = np.array([1.0, 3.0, -40.0])
BIAS_N = np.array([63.0, 5.0, 21.0])
SIGNED = [np.diag(s)[list(p)] for p in permutations(range(3)) for s in product((1.0, -1.0), repeat=3)]
CUBE = np.array([R for R in SIGNED if np.linalg.det(R) > 0])

seeds = st.integers(0, 10**6)
slow = settings(max_examples=settings().max_examples // 2)


def forces(R_base_flange: Array, R: Array, noise_N: float = 0.0, seed: int = 0, gravity_N: Array = GRAVITY_N) -> Array:
    force = R_base_flange.swapaxes(1, 2) @ gravity_N @ R.T + BIAS_N
    return np.asarray(force + noise_N * np.random.default_rng(seed).normal(size=force.shape))


def problem(seed: int, n: int = 12, noise_N: float = 1.0) -> tuple[Array, Array, Array]:
    """(n, 3, 3) orientations, (n, 3) forces and the true R."""
    rng = np.random.default_rng(seed)
    R_base_flange, R = Rotation.random(n, rng=rng).as_matrix(), Rotation.random(rng=rng).as_matrix()
    return R_base_flange, forces(R_base_flange, R, noise_N, seed), R


def wishart(seed: int) -> Array:
    G = np.random.default_rng(seed).normal(size=(9, 9))
    return np.asarray(G @ G.T)


def cost(Q: Array, R: Array) -> float:
    return float(R.ravel() @ Q @ R.ravel())


def angle(R: Array, other: Array) -> float:
    return float(np.linalg.norm(Rotation.from_matrix(R.T @ other).as_rotvec()))


def nearest(found: list[rotation_minima.RotationMinimum], R: Array) -> float:
    return min(angle(minimum.R, R) for minimum in found)


# The cost


def test_a_huge_bias_costs_no_digits() -> None:
    R_base_flange, force, R = problem(0, noise_N=0)
    best, *_ = rotation_minima.minima(rotation_minima.force_cost(R_base_flange, force + 1e5, np.ones(12)))
    assert angle(best.R, R) < 1e-11


# The minima


@pytest.mark.slow
def test_brute_force_finds_no_other_minimum() -> None:
    Q = wishart(0)
    found = rotation_minima.minima(Q)
    yaw, pitch, roll = np.meshgrid(np.arange(0, 360, 12), np.arange(-90, 91, 12), np.arange(0, 360, 12))
    grid = Rotation.from_euler("ZYX", np.stack((yaw.ravel(), pitch.ravel(), roll.ravel()), axis=1), degrees=True)
    r = grid.as_matrix().reshape(-1, 9)
    costs = np.sum((r @ Q) * r, axis=1)
    assert costs.min() >= found[0].cost
    for i in (*np.argsort(costs)[:3], *np.random.default_rng(0).integers(0, len(r), 5)):

        def polished(v: Array, start: Rotation = grid[int(i)]) -> float:
            return cost(Q, (start * Rotation.from_rotvec(v)).as_matrix())

        end = minimize(polished, np.zeros(3), tol=1e-10)
        assert end.fun >= found[0].cost - 1e-12 * np.trace(Q)
        assert nearest(found, (grid[int(i)] * Rotation.from_rotvec(end.x)).as_matrix()) < 1e-3


def yaw_only() -> Array:
    tilt, turn = Rotation.from_rotvec([2.5, 0, 0]), Rotation.from_rotvec(np.outer(np.arange(5), [0, 0, 1]))
    R_base_flange = (tilt * turn).as_matrix()
    return rotation_minima.force_cost(R_base_flange, forces(R_base_flange, np.eye(3), noise_N=0.5), np.ones(5))


@pytest.mark.parametrize(
    "Q",
    [
        np.zeros((9, 9)),
        np.diag(np.arange(9.0)),  # rows and columns of squared entries add up to 1: constant
        np.diag([1.0, *[0] * 8]),
        rotation_minima.force_cost(CUBE[:1], np.ones((1, 3)), np.ones(1)),
        rotation_minima.force_cost(CUBE[:2], np.arange(6.0).reshape(2, 3), np.ones(2)),
        yaw_only(),
        1e-100 * wishart(0),
        1e100 * wishart(0),
    ],
    ids=["zero", "constant", "one entry", "1 pose", "2 poses", "yaw only", "tiny", "huge"],
)
def test_degenerate_cost_gives_few_representatives(Q: Array) -> None:
    found = rotation_minima.minima(Q)
    assert 1 <= len(found) <= 16
    assert 0 <= rotation_minima.certificate(Q, found[0].R) <= 1e-8
    assert min(cost(Q, R) for R in Rotation.random(2000, rng=np.random.default_rng(0)).as_matrix()) >= (
        found[0].cost - 1e-14 * np.trace(Q)
    )


def test_minima_of_no_matrix_are_refused() -> None:
    for Q in (np.eye(3), np.full((9, 9), np.nan)):
        with pytest.raises(ValueError, match="9x9 finite"):
            rotation_minima.minima(Q)


# The proof


@slow
@given(seeds, st.sampled_from([1e-6, 1e-3, 1.0]))
def test_nothing_false_is_proved(seed: int, away: float) -> None:
    Q = wishart(seed)
    best, *_ = rotation_minima.minima(Q)
    R = best.R @ Rotation.from_rotvec(away * np.array([0.6, 0, 0.8])).as_matrix()
    assert rotation_minima.certificate(Q, R) >= (cost(Q, R) - best.cost) / (np.trace(Q) / 3)


def test_gap_has_no_unit() -> None:
    Q = wishart(3)
    assert rotation_minima.certificate(1e-3 * Q, np.eye(3)) == pytest.approx(
        rotation_minima.certificate(Q, np.eye(3)), abs=1e-9
    )


def test_only_rotations_are_judged() -> None:
    for R in (np.diag([1.0, 1, -1]), 2 * np.eye(3), np.eye(9)):
        with pytest.raises(ValueError, match="rotation"):
            rotation_minima.certificate(np.eye(9), R)
