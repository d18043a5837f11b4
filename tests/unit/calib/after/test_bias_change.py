"""The change of the bias in a verification: right in simulation, with both of its sigmas."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.linalg import block_diag
from scipy.spatial.transform import Rotation

from ftcalib import CalibrationDataset, solve
from ftcalib.after.state import Update
from ftcalib.after.verification import Expected
from ftcalib.model import Array, predict
from tests.known_cells import UPRIGHT as TRUTH

SIGMA = np.repeat([0.05, 0.002], 3) / np.sqrt(200)
CHANGE = np.array([0.1, -0.02, 0.0, 0.001, 0.0, -0.003])
CHANGED = replace(TRUTH, force_bias_N=TRUTH.force_bias_N + CHANGE[:3], torque_bias_Nm=TRUTH.torque_bias_Nm + CHANGE[3:])


def orientations(n: int, seed: int) -> Array:
    return np.asarray(Rotation.random(n, rng=np.random.default_rng(seed)).as_matrix())


def covariance_of_a_calibration() -> Array:
    R = orientations(24, 1)
    wrench = predict(TRUTH, R) + np.random.default_rng(1).normal(size=(24, 6)) * SIGMA
    noise = np.tile(np.diag(SIGMA**2), (24, 1, 1))
    return solve(CalibrationDataset(R, wrench, noise, np.zeros(24, np.int64), np.full(24, np.nan))).covariance


def simulated(verifications: int, calibrations: int) -> list[list[tuple[Array, Array, Array]]]:
    """Verify each of several calibrations several times, with six poses whose noise differs."""
    rng, covariance = np.random.default_rng(2), covariance_of_a_calibration()
    R, each = orientations(6, 3), np.outer([1.0, 1.0, 3.0, 1.0, 0.5, 2.0], SIGMA)
    noise = np.asarray(block_diag(*(np.diag(row**2) for row in each)))
    found = []
    for _ in range(calibrations):
        parameters = TRUTH.moved(rng.multivariate_normal(np.zeros(15), covariance))
        expected = Expected(Update(parameters, covariance, 0.0, 0), noise, np.inf)
        wrenches = predict(CHANGED, R) + each * rng.normal(size=(verifications, 6, 6))
        found.append([expected.bias_change(R, wrench) for wrench in wrenches])
    return found


@pytest.mark.slow
def test_both_sigmas_are_those_of_a_simulation() -> None:
    """Verifications of one calibration scatter by `sigma`, their means by `calibration_sigma`."""
    found = simulated(20, 100)
    values = np.array([[value for value, *_ in series] for series in found])
    _, sigma, calibration_sigma = found[0][0]
    within = (values - values.mean(axis=1, keepdims=True)) / sigma
    assert np.abs((within**2).sum(axis=(0, 1)) / (100 * 19) - 1).max() < 6 * np.sqrt(2 / (100 * 19))
    means = (values.mean(axis=1) - CHANGE) / np.hypot(calibration_sigma, sigma / np.sqrt(20))
    assert np.abs(np.sum(means**2, axis=0) / 100 - 1).max() < 6 * np.sqrt(2 / 100)
    assert np.abs(means.mean(axis=0)).max() < 6 / np.sqrt(100)
