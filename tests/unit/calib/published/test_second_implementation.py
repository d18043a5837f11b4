"""Our published methods against `tests.second_methods`, which another hand wrote from the papers alone.

With noise both must find the same estimate, not only the truth. Closed forms differ by rounding alone. The iterations
of both end on steps below 1e-13, which at the slowest convergence here, in 40 deg, leaves 1e-12. Both forms of
`polynomial` end where the gradient vanishes; where the cost stops falling would leave 1e-8. Measured: below 1e-13.
"""

from collections.abc import Callable, Mapping

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from ftcalib.model import Array, Parameters, predict
from ftcalib.published.methods import published
from tests import second_methods as second

SNR = 100
SEEDS = range(4)
SPECIAL = np.swapaxes(second.special(), 1, 2)

Second = Callable[[Parameters, Array, Array, Array], second.Estimate]
"""Takes what is known from the truth, A, F and T."""


def _carlson(bias: bool) -> Mapping[str, Second]:
    return {
        "carlson-relaxation": lambda known, A, F, T: second.relaxation(A, F, T, _down(known), bias),
        "carlson-cayley": lambda known, A, F, T: second.cayley(
            A, F, T, known.gravity_force_base_N, bias, half_turns=True
        ),
        "carlson-eigen": lambda _, A, F, T: second.eigen(A, F, T, bias),
        "carlson-nullspace": lambda _, A, F, T: second.nullspace(A, F, T, bias),
        "carlson-iterative": lambda _, A, F, T: second.iterative(A, F, T, bias),
        "carlson-polynomial": lambda _, A, F, T: second.polynomial(A, F, T, bias),
    }


COMPLETE: Mapping[str, Second] = {
    "srom": lambda _, A, F, T: second.srom(A, F, T),
    "lrom": lambda _, A, F, T: second.lrom(A, F, T),
    **_carlson(bias=True),
}
AS_PUBLISHED = _carlson(bias=False)


def _down(parameters: Parameters) -> Array:
    force_N = parameters.gravity_force_base_N
    return np.asarray(force_N / np.linalg.norm(force_N))


def _truth(seed: int, *, bias: bool = True) -> Parameters:
    rng = np.random.default_rng(seed)
    R = Rotation.random(rng=rng).as_matrix()
    return Parameters(
        R, rng.normal(0, 12, 3), bias * rng.normal(0, 5, 3), rng.normal(0, 0.08, 3), bias * rng.normal(size=3)
    )


def _poses(method: str, seed: int) -> Array:
    rng = np.random.default_rng(100 + seed)
    n = 24 + 8 * seed
    if method == "srom":
        return SPECIAL[rng.permutation(24)]
    if seed % 2:
        return Rotation.random(n, rng=rng).as_matrix()
    axes = Rotation.random(n, rng=rng).as_matrix()[:, 0]
    return Rotation.from_rotvec(axes * rng.uniform(0, np.deg2rad(40), (n, 1))).as_matrix()


def _estimates(
    method: str, hand: Second, truth: Parameters, R_base_flange: Array, noise: Array | float
) -> tuple[Parameters, Parameters]:
    """Return our estimate and the other."""
    weight_N = float(np.linalg.norm(truth.gravity_force_base_N))
    wrench = predict(truth, R_base_flange) + weight_N * noise
    ours = published(method, R_base_flange, gravity_direction_base=_down(truth), weight_N=weight_N)(wrench)
    R, F_b, F0, P, T0 = hand(truth, R_base_flange.transpose(0, 2, 1), wrench[:, :3], wrench[:, 3:])
    return ours, Parameters(R.T, F_b, F0, P, T0)


def _assert_equal(one: Parameters, other: Parameters) -> None:
    weight_N = np.linalg.norm(other.gravity_force_base_N)
    com_m = np.linalg.norm(other.p_sensor_com_m)
    scale = np.repeat([1, weight_N, weight_N, com_m, weight_N * com_m], 3)
    np.testing.assert_allclose(other.difference(one) / scale, 0, atol=1e-10)


def _noise(n: int, seed: int) -> Array:
    """Of forces, in weights, and of torques, in weights times a metre."""
    return np.random.default_rng(200 + seed).normal(0, np.repeat([1, 0.03], 3) / SNR, (n, 6))


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("method", COMPLETE)
def test_both_find_the_truth_without_noise(method: str, seed: int) -> None:
    truth, poses = _truth(seed), _poses(method, seed)
    for found in _estimates(method, COMPLETE[method], truth, poses, 0.0):
        _assert_equal(found, truth)


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("method", COMPLETE)
def test_both_find_the_same_estimate_with_noise(method: str, seed: int) -> None:
    truth, poses = _truth(seed), _poses(method, seed)
    _assert_equal(*_estimates(method, COMPLETE[method], truth, poses, _noise(len(poses), seed)))
