"""Hysteresis of the last swing: found where it is, with sigmas that hold."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from ftcalib import CalibrationDataset, CalibrationResult, Parameters, solve
from ftcalib.likelihood.fit import fit
from ftcalib.likelihood.structure import FEW, hysteresis_columns
from ftcalib.model import Array, gravity_wrench, predict

SIGMA = np.repeat([0.01, 0.4e-3], 3)
N = 24
TRUTH = Parameters(
    np.asarray(Rotation.from_rotvec([0.02, -0.03, 0.8]).as_matrix()),
    np.array([0.2, -0.1, -15.0]),
    np.array([3.0, -4.0, 5.0]),
    np.array([0.01, -0.02, 0.06]),
    np.array([0.1, -0.2, 0.3]),
)


def session(seed: int, share: float) -> tuple[Array, Array]:
    """Simulate a tour that begins after an unknown pose."""
    rng = np.random.default_rng(seed)
    R = Rotation.random(N + 1, rng=rng).as_matrix()
    wrench = predict(TRUTH, R[1:]) - share * np.diff(gravity_wrench(TRUTH, R), axis=0)
    return R[1:], wrench + SIGMA * rng.normal(size=(N, 6))


def solved(seed: int, share: float) -> CalibrationResult:
    R, wrench = session(seed, share)
    return solve(CalibrationDataset(R, wrench, np.tile(np.diag(SIGMA**2), (N, 1, 1)), np.full(N, 500), np.arange(24.0)))


def test_columns_are_the_lag_of_each_axis_behind_its_last_swing() -> None:
    R = Rotation.random(5, rng=np.random.default_rng(0)).as_matrix()
    T, share = hysteresis_columns(TRUTH, R), np.array([1, 2, 3, 4, 5, 6.0])
    expected = -share * np.diff(gravity_wrench(TRUTH, R), axis=0)
    np.testing.assert_allclose((T @ np.append(share, np.ones(6)))[1:], expected)
    usual = np.sqrt(np.mean(np.diff(gravity_wrench(TRUTH, R), axis=0) ** 2, axis=0))
    np.testing.assert_allclose(T[0] @ np.append(np.ones(6), share), share * usual)
    assert hysteresis_columns(TRUTH, np.tile(np.eye(3), (FEW, 1, 1))).shape[2] == 12
    assert hysteresis_columns(TRUTH, np.tile(np.eye(3), (FEW + 1, 1, 1))).shape[2] == 6


@pytest.mark.slow
def test_it_is_found_and_the_sigmas_hold() -> None:
    z, shares, seeds = [], [], 6
    for seed in range(seeds):
        result = solved(seed, 0.002)
        shares.append(result.components["hysteresis"])  # of six axes, so one session gives it to about 40 %
        error = result.parameters.difference(TRUTH)
        z.append(error / np.sqrt(np.diag(result.covariance)))
    ratio = np.sqrt([np.mean(part**2) for part in np.split(np.array(z), 5, axis=1)])
    np.testing.assert_allclose(ratio, 1, atol=0.2 + 1.2 / np.sqrt(seeds))
    assert np.median(shares) == pytest.approx(0.002, rel=0.2 + 0.5 / np.sqrt(seeds))


@pytest.mark.slow
def test_it_is_not_found_where_there_is_none() -> None:
    found = sum("hysteresis" in fit(*session(seed, 0.0), np.diag(SIGMA**2)).components for seed in range(30))
    assert found <= 1
