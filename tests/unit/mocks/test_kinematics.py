"""Kinematics of the emulated arms against plain DH products, and round trips."""

import math

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from ftmocks.arrays import Array
from ftmocks.kinematics import (
    MODELS,
    closed_form,
    forward,
    jacobian,
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
