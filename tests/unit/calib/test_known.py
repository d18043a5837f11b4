"""Known values in the form of the solver: derivatives, and starts that respect them."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from ftcalib import Parameters
from ftcalib.known import Constraints, Known, turn_between, unit_vector
from ftcalib.model import Array

RNG = np.random.default_rng(0)
MOUNT = Rotation.from_euler("ZYX", [50, 10, 175], degrees=True).as_matrix()
TOOL = Parameters(
    MOUNT, np.array([4.0, -3.0, -18.0]), np.array([3.0, -2, 8]), np.array([0.03, -0.02, 0.06]), np.array([0.1, 0.2, 0])
)
DOWN = np.array([0.3, -0.4, -1.2])


def step(k: int) -> Array:
    return np.asarray(1e-6 * np.eye(15)[k])


@pytest.mark.parametrize("yaw_only", [False, True])
def test_measurements_fall_as_their_derivative_says(yaw_only: bool) -> None:
    tilted = Rotation.from_rotvec([0.02, -0.03, 0.01]).as_matrix() @ MOUNT
    known = Known(tilted, 0.01, yaw_only, DOWN, 0.03, 2.0, 0.05)
    constraints = Constraints(known, 9.8)
    near = replace(TOOL, gravity_force_base_N=18.5 * unit_vector(DOWN) + [0.1, 0.2, 0.05])
    A, residual = constraints.measurements(near)
    assert A.shape == ((5, 15) if yaw_only else (6, 15))
    assert constraints.dof == len(residual)
    fall = np.empty_like(A)
    for k in range(15):
        (_, up), (_, down) = (constraints.measurements(near.moved(sign * step(k))) for sign in (1, -1))
        fall[:, k] = (down - up) / 2e-6
    size = np.abs(A).max(axis=1, keepdims=True)
    np.testing.assert_allclose(A / size, fall / size, atol=0.04)  # the angles are a few hundredths
    # In sigmas: each angle by 0.01 rad, the weight by 0.05 kg.
    assert residual[-1] == pytest.approx((2.0 * 9.8 - np.linalg.norm(near.gravity_force_base_N)) / (0.05 * 9.8))
    turn = np.array([0.02, -0.03, 0.01]) / 0.01
    first = [residual @ np.eye(len(residual))[k] for k in range(2 if yaw_only else 3)]
    np.testing.assert_allclose(np.abs(first), np.abs(turn[: len(first)]), rtol=0.02, atol=0.02)
    off = angle_between_directions(near.gravity_force_base_N, DOWN) / 0.03
    assert np.linalg.norm(residual[len(first) : -1]) == pytest.approx(off)


def angle_between_directions(a: Array, b: Array) -> float:
    return float(np.arccos(a @ b / np.linalg.norm(a) / np.linalg.norm(b)))


def test_a_tolerance_fixes_nothing() -> None:
    soft = Constraints(Known(MOUNT, 1e-9, False, DOWN, 1e-9, 2.0, 1e-9), 9.8)
    np.testing.assert_array_equal(soft.free(TOOL), np.eye(15))
    assert np.abs(TOOL.difference(soft.satisfy(TOOL))).max() == 0


def test_starts_respect_the_known_mounting() -> None:
    minima = list(Rotation.random(3, rng=RNG).as_matrix())
    none = np.zeros((9, 9))
    assert Constraints(Known(), 9.8).rotations(minima, none) is minima
    (only,) = Constraints(Known(R_flange_sensor=MOUNT), 9.8).rotations(minima, none)
    np.testing.assert_array_equal(only, MOUNT)
    assert len(Constraints(Known(R_flange_sensor=MOUNT, R_tolerance_rad=0.1), 9.8).rotations(minima, none)) == 4


@pytest.mark.parametrize("angle_rad", [0.0, 1e-9, 1.0, np.pi])
def test_the_smallest_turn_between_vectors(angle_rad: float) -> None:
    a, b = np.array([0.0, 0.6, 0.8]), np.array([1.0, 0.0, 0.0])
    b = np.cos(angle_rad) * a + np.sin(angle_rad) * b
    turn = turn_between(a, b)
    np.testing.assert_allclose(Rotation.from_rotvec(turn).apply(a), b, atol=1e-12)
    assert np.linalg.norm(turn) == pytest.approx(angle_rad, abs=1e-12)
    assert turn @ a == pytest.approx(0, abs=1e-12)


def test_a_vector_without_length_points_down() -> None:
    np.testing.assert_array_equal(unit_vector(np.zeros(3)), [0, 0, -1])
    np.testing.assert_allclose(unit_vector(np.array([0.0, 3.0, 4.0])), [0, 0.6, 0.8])


def test_limits_of_what_can_be_known() -> None:
    assert np.linalg.norm(np.asarray(Known(gravity_direction_base=(0, 3, 4)).gravity_direction_base)) == pytest.approx(
        1
    )
    np.testing.assert_array_equal(np.asarray(Known(yaw_only=True).R_flange_sensor), np.eye(3))
    for bad in ({"mass_kg": np.inf}, {"gravity_direction_base": (0, 1)}, {"R_tolerance_rad": np.nan}):
        with pytest.raises(ValueError, match=next(iter(bad))):
            Known(**bad)
