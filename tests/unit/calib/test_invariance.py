"""What must change in the answer when the question is put differently, and what must not."""

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from ftcalib import CalibrationDataset, CalibrationResult, Parameters, solve
from ftcalib.model import Array, predict, skew

TRUTH = Parameters(
    Rotation.from_euler("zyx", [40, -8, 3], degrees=True).as_matrix(),
    np.array([0.3, -0.5, -14.0]),
    np.array([2.0, -3.0, 5.0]),
    np.array([0.01, -0.02, -0.07]),
    np.array([0.1, -0.2, 0.05]),
)
SIGMA = np.repeat([0.02, 0.0008], 3)

seeds = st.integers(0, 2**32 - 1)


def poses(seed: int, n: int = 12) -> tuple[Array, Array, Array]:
    rng = np.random.default_rng(seed)
    R = Rotation.random(n, rng=rng).as_matrix()
    cov = np.tile(np.diag(SIGMA**2), (n, 1, 1))
    return R, predict(TRUTH, R) + SIGMA * rng.normal(size=(n, 6)), cov


def answer(R: Array, wrench: Array, cov: Array) -> CalibrationResult:
    n = len(R)
    return solve(CalibrationDataset(R, wrench, cov, np.full(n, 500), np.arange(float(n))), drift="none")


def assert_same(one: CalibrationResult, other: Parameters, within_sigma: float = 1e-4) -> None:
    sigma = np.sqrt(np.diag(one.covariance))
    np.testing.assert_array_less(np.abs(one.parameters.difference(other)) / sigma, within_sigma)


@settings(max_examples=2)
@given(seeds, st.floats(0.01, 100))
def test_other_units_of_force_scale_weight_and_bias_and_leave_geometry(seed: int, unit: float) -> None:
    R, wrench, cov = poses(seed)
    one, other = answer(R, wrench, cov), answer(R, unit * wrench, unit**2 * cov)
    p = one.parameters
    scaled = Parameters(
        p.R_flange_sensor,
        unit * p.gravity_force_base_N,
        unit * p.force_bias_N,
        p.p_sensor_com_m,
        unit * p.torque_bias_Nm,
    )
    assert_same(other, scaled)
    assert other.chi2 == pytest.approx(one.chi2)
    assert other.verdict == one.verdict


@settings(max_examples=2)
@given(seeds)
def test_another_origin_of_the_sensor_moves_the_centre_of_mass_and_the_torques(seed: int) -> None:
    R, wrench, cov = poses(seed)
    d = np.random.default_rng(seed + 2).normal(size=3) * 0.05  # new origin, seen from the old one
    turn = np.eye(6)
    turn[3:, :3] = -skew(d)
    one, other = answer(R, wrench, cov), answer(R, wrench @ turn.T, turn @ cov @ turn.T)
    assume(not one.components and not other.components)  # extra noise is looked for about the origin given
    p = one.parameters
    moved = Parameters(
        p.R_flange_sensor,
        p.gravity_force_base_N,
        p.force_bias_N,
        p.p_sensor_com_m - d,
        p.torque_bias_Nm - np.cross(d, p.force_bias_N),
    )
    assert_same(other, moved)
