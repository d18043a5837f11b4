"""Kinematics of the emulated arms against plain DH products, and round trips."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ftmocks.arrays import Array
from ftmocks.factory_kinematics import drawn
from ftmocks.kinematics import (
    MODELS,
    closed_form,
    forward,
    inverse,
    inverse_matrix,
    jacobian,
    matrix_of,
    pose_of,
    rotation,
    rotvec,
)

angles = st.tuples(*[st.floats(-math.pi, math.pi)] * 6)
models = st.sampled_from(sorted(MODELS))


def dh_product(name: str, q: tuple[float, ...]) -> Array:
    """Standard DH written out with 4 x 4 matrices: Rz Tz Tx Rx."""
    dh, X = MODELS[name], np.eye(4)
    for i in range(6):
        turn, shift, twist = np.eye(4), np.eye(4), np.eye(4)
        turn[:3, :3] = rotation([0, 0, q[i] + dh.theta[i]])
        shift[:3, 3] = dh.a[i], 0, dh.d[i]
        twist[:3, :3] = rotation([dh.alpha[i], 0, 0])
        X = X @ turn @ shift @ twist
    return X


@given(models, angles)
def test_forward_is_the_dh_product(name: str, q: tuple[float, ...]) -> None:
    np.testing.assert_allclose(forward(MODELS[name], q), dh_product(name, q), atol=1e-12)


@given(models, angles)
def test_every_closed_form_branch_reaches_the_pose(name: str, q: tuple[float, ...]) -> None:
    dh = MODELS[name]
    target = forward(dh, q)
    for solution in closed_form(dh, target):
        np.testing.assert_allclose(forward(dh, solution), target, atol=1e-6)


@pytest.mark.parametrize("calibrated", [False, True])
def test_inverse_returns_to_the_nearest_posture(calibrated: bool) -> None:
    dh = drawn("UR5e", 3) if calibrated else MODELS["UR5e"]
    rng = np.random.default_rng(2)
    for _ in range(50):
        q = np.radians([45, -100, 60, -50, 90, 45]) + rng.uniform(-0.5, 0.5, 6)
        q[5] -= 2 * math.pi  # a joint may stand a turn away
        solution = inverse(dh, forward(dh, q.tolist()), (q + rng.uniform(-0.05, 0.05, 6)).tolist())
        assert solution is not None
        np.testing.assert_allclose(np.array(solution), q, atol=1e-8)


@given(angles)
def test_jacobian_is_the_derivative(q: tuple[float, ...]) -> None:
    dh, h = MODELS["UR10e"], 1e-6
    for i in range(6):
        ahead, behind = np.array(q), np.array(q)
        ahead[i] += h
        behind[i] -= h
        A, B = forward(dh, ahead.tolist()), forward(dh, behind.tolist())
        twist = np.concatenate((A[:3, 3] - B[:3, 3], rotvec(A[:3, :3] @ B[:3, :3].T))) / (2 * h)
        np.testing.assert_allclose(jacobian(dh, q)[:, i], twist, atol=1e-6)


def test_poses_are_metres_and_a_rotation_vector() -> None:
    X = matrix_of([0.1, 0.2, 0.3, 0.0, 0.0, math.pi / 2])
    np.testing.assert_allclose(X[:3, :3] @ [1, 0, 0], [0, 1, 0], atol=1e-12)
    assert pose_of(X) == pytest.approx([0.1, 0.2, 0.3, 0.0, 0.0, math.pi / 2])
    np.testing.assert_allclose(X @ inverse_matrix(X), np.eye(4), atol=1e-12)
