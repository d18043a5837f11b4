"""A cable that acts as a spring: found in what a fit leaves, and part of the reported sigma only."""

from dataclasses import replace

import numpy as np
import pytest
from scipy import stats
from scipy.spatial.transform import Rotation

from ftcalib import CalibrationDataset, CalibrationResult, Parameters, solve
from ftcalib.findings import CODES
from ftcalib.judge.session_change import cable_of
from ftcalib.likelihood.fit import Fit, fit
from ftcalib.model import BIASES, Array, jacobian, predict

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


@pytest.mark.slow
@pytest.mark.parametrize("measured", [True, False])
def test_sigma_of_the_centre_of_mass_allows_for_a_cable(measured: bool) -> None:
    result = calibrated(np.array([[0.02, 0, 0.01], [0, 0.02, 0], [0, 0.005, 0.02]]), 1, measured=measured)
    error = np.abs(result.p_sensor_com_m - P_M)
    sigma_without = np.sqrt(np.diag(result.covariance)[9:12])
    assert (error / sigma_without).max() > 2
    assert (error < 2 * np.asarray(result.sigma["p_sensor_com_m"])).all()
    [finding] = [one for one in result.findings if one.code == "cable_spring"]
    assert finding.severity == "note"
    assert finding.values["shift_mm"] == pytest.approx(1e3 * np.linalg.norm(error), rel=0.3)
    assert 0.01 < finding.values["torque_Nm"] < 0.03


def test_white_noise_shows_no_cable() -> None:
    for seed in range(2):
        assert calibrated(np.zeros((3, 3)), seed).cable_shift is None


@pytest.mark.slow
def test_a_file_has_it_and_may_lack_it() -> None:
    result = calibrated(0.02 * np.eye(3), 3)
    document = result.to_dict()
    again = CalibrationResult.from_dict(document)
    np.testing.assert_array_equal(again.tool_covariance, result.tool_covariance)
    del document["cable_shift"]
    assert CalibrationResult.from_dict(document).cable_shift is None
    assert "cable_spring" in CODES


def quiet(n: int) -> tuple[Fit, Array]:
    """Fit n poses without a cable; also the torques of one that is slack at their mean orientation."""
    rng = np.random.default_rng(6)
    R = DOWN @ Rotation.from_rotvec(rng.uniform(-1, 1, (n, 3))).as_matrix()
    tool = Parameters(np.eye(3), np.array([0.0, 0, -12]), np.array([1.0, 2, 3]), P_M, np.array([0.1, 0.2, 0.3]))
    found = fit(R, predict(tool, R) + SIGMA * rng.normal(size=(n, 6)), np.diag(SIGMA**2), drift="none")
    v = (Rotation.from_matrix(R).mean().inv() * Rotation.from_matrix(R)).as_rotvec()
    X = np.zeros((n, 6, 3, 3))
    for axis in range(3):
        X[:, 3 + axis, axis] = v
    return found, X.reshape(n, 6, 9)


def test_a_cable_is_found_and_moves_the_estimates_as_least_squares_with_nine_more_unknowns() -> None:
    found, X = quiet(24)
    stiffness_Nm = np.array([[2.0, 0, 1], [0.5, 2, 0], [0, -1, 1]]).ravel()
    J = (jacobian(found.parameters, found.R_base_flange) / SIGMA[:, None]).reshape(-1, 15)
    X_unit = (X / SIGMA[:, None]).reshape(-1, 9)
    outcomes = set()
    for size in (0.0, *np.geomspace(1e-4, 2e-3, 16)):
        pulled = replace(found, wrench=found.wrench + X @ (size * stiffness_Nm))
        r = ((pulled.wrench - predict(pulled.parameters, pulled.R_base_flange)) / SIGMA).ravel()
        without, with_cable = (np.linalg.lstsq(A, r)[0] for A in (J, np.column_stack([J, X_unit])))
        left = np.sum((r - J @ without) ** 2), np.sum((r - np.column_stack([J, X_unit]) @ with_cable) ** 2)
        p = stats.f.sf((left[0] - left[1]) / 9 / (left[1] / (found.dof - 9)), 9, found.dof - 9)
        cable = cable_of(pulled)
        assert (cable is not None) == (p < 1e-3)
        outcomes.add(cable is not None)
        if cable is not None:
            shift = without - with_cable[:15]
            shift[BIASES] = 0.0
            np.testing.assert_allclose(cable[1], shift, atol=0.01 * np.abs(shift).max())
            torque_Nm = (X @ with_cable[15:])[:, 3:]
            assert cable[0].values["torque_Nm"] == pytest.approx(
                np.sqrt(np.mean(np.sum(torque_Nm**2, axis=1))), rel=0.01
            )
    assert outcomes == {True, False}
