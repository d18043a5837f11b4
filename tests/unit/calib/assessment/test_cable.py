"""A cable that acts as a spring: found in what a fit leaves, and part of the reported sigma only."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from ftcalib import CalibrationDataset, CalibrationResult, Parameters, solve
from ftcalib.findings import CODES
from ftcalib.model import BIASES, Array, predict

DOWN = np.diag([1.0, -1.0, -1.0])
P_M = np.array([0.01, -0.005, 0.06])
SIGMA = np.repeat([0.01, 0.4e-3], 3)


def calibrated(stiffness_Nm: Array, seed: int, *, measured: bool = True) -> CalibrationResult:
    rng = np.random.default_rng(seed)
    x, y, z = (
        Rotation.from_rotvec(a[:, None] * axis) for a, axis in zip(rng.uniform(-1, 1, (3, 24)), np.eye(3), strict=True)
    )
    R = DOWN @ (x * y * z).as_matrix()
    tool = Parameters(np.eye(3), np.array([0.0, 0, -12]), np.array([1.0, 2, 3]), P_M, np.array([0.1, 0.2, 0.3]))
    wrench = predict(tool, R) + SIGMA * rng.normal(size=(24, 6))
    wrench[:, 3:] += Rotation.from_matrix(DOWN @ R).as_rotvec() @ stiffness_Nm.T
    cov = np.tile(np.diag(SIGMA**2), (24, 1, 1)) if measured else None
    return solve(CalibrationDataset(R, wrench, cov, np.full(24, 500 if measured else 0), np.arange(24.0)))


@pytest.mark.parametrize("measured", [True, False])
def test_sigma_of_the_centre_of_mass_allows_for_a_cable(measured: bool) -> None:
    result = calibrated(np.array([[0.02, 0, 0.01], [0, 0.02, 0], [0, 0.005, 0.02]]), 1, measured=measured)
    error = np.abs(result.p_sensor_com_m - P_M)
    sigma_without = np.sqrt(np.diag(result.covariance)[9:12])
    assert (error / sigma_without).max() > 3
    assert (error < 2 * np.asarray(result.sigma["p_sensor_com_m"])).all()
    [finding] = [one for one in result.findings if one.code == "cable_spring"]
    assert finding.severity == "note"
    assert finding.values["shift_mm"] == pytest.approx(1e3 * np.linalg.norm(error), rel=0.3)
    assert 0.01 < finding.values["torque_Nm"] < 0.03


def test_the_estimates_compensation_and_biases_do_not_use_it() -> None:
    result = calibrated(0.02 * np.eye(3), 2)
    shift = result.cable_shift
    assert shift is not None
    assert not shift[BIASES].any()
    np.testing.assert_allclose(result.tool_covariance - result.covariance, np.outer(shift, shift), atol=1e-15)
    rest = result.residuals[:, 3:]
    assert np.sqrt(np.mean(np.sum(rest**2, axis=1))) > 3e-3


@pytest.mark.parametrize("measured", [True, False])
def test_white_noise_shows_no_cable(measured: bool) -> None:
    for seed in range(4):
        result = calibrated(np.zeros((3, 3)), seed, measured=measured)
        assert result.cable_shift is None
        assert result.tool_covariance is result.covariance or (result.tool_covariance == result.covariance).all()


def test_a_file_has_it_and_may_lack_it() -> None:
    result = calibrated(0.02 * np.eye(3), 3)
    document = result.to_dict()
    again = CalibrationResult.from_dict(document)
    np.testing.assert_array_equal(again.tool_covariance, result.tool_covariance)
    del document["cable_shift"]
    assert CalibrationResult.from_dict(document).cable_shift is None
    assert "cable_spring" in CODES
