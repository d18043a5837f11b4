"""The difference of two calibrations: calibrated p-values, turned mountings, shared and known values."""

from dataclasses import dataclass

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.stats import kstest

from ftcalib.after.series import calibration_difference
from ftcalib.model import Array, Parameters, rotation_of
from tests.known_cells import UPRIGHT as TRUTH

SIGMA = np.repeat([1e-3, 0.02, 0.02, 2e-4, 1e-3], 3)


@dataclass
class Calibrated:
    parameters: Parameters
    covariance: Array


def correlated(seed: int = 0, scale: float = 1.0) -> Array:
    """A full covariance with very different sizes."""
    A = np.random.default_rng(seed).normal(size=(15, 15)) + 2 * np.eye(15)
    C = A @ A.T
    root = np.sqrt(np.diag(C))
    return np.asarray(scale**2 * C / np.outer(root, root) * np.outer(SIGMA, SIGMA))


def estimate(rng: np.random.Generator, covariance: Array, truth: Parameters = TRUTH) -> Calibrated:
    return Calibrated(truth.moved(np.linalg.cholesky(covariance) @ rng.normal(size=15)), covariance)


@pytest.mark.parametrize("turn_deg", [0.0, 90.0])
def test_the_p_value_is_uniform_also_where_the_sensor_was_turned_between(turn_deg: float) -> None:
    """The turn itself is taken out: what is left must be the noise, in axes that have turned."""
    rng, runs = np.random.default_rng(1), 60
    first_cov, second_cov = correlated(1), correlated(2, 3.0)
    turn = Rotation.from_euler("x", turn_deg, degrees=True).as_matrix()
    turned = Parameters(
        turn @ TRUTH.R_flange_sensor,
        TRUTH.gravity_force_base_N,
        TRUTH.force_bias_N,
        TRUTH.p_sensor_com_m,
        TRUTH.torque_bias_Nm,
    )
    p, z = [], []
    for _ in range(runs):
        one, other = estimate(rng, first_cov), estimate(rng, second_cov, turned)
        found = calibration_difference(one, other)
        if turn_deg:  # only the covariance is asked: the distance from the known turn, in its own axes
            error = -Rotation.from_matrix(
                turn.T @ other.parameters.R_flange_sensor @ one.parameters.R_flange_sensor.T
            ).as_rotvec()
            z.append(turn @ error / found.sigma[:3])
        else:
            p.append(found.joint.p_value)
            z.append(found.in_sigmas[:3])
            assert found.joint.dof == 15
    assert np.std(z, axis=0) == pytest.approx(np.ones(3), abs=6 / np.sqrt(2 * runs))
    if p:
        assert kstest(p, "uniform").pvalue > 1e-6


def test_a_rotation_is_compared_as_one_and_not_number_by_number() -> None:
    delta = np.array([0.0, 0.02, 0.0])
    other = Parameters(
        rotation_of(-delta) @ TRUTH.R_flange_sensor,
        TRUTH.gravity_force_base_N,
        TRUTH.force_bias_N,
        TRUTH.p_sensor_com_m,
        TRUTH.torque_bias_Nm,
    )
    covariance = np.diag(SIGMA**2)
    found = calibration_difference(Calibrated(TRUTH, covariance), Calibrated(other, covariance))
    assert found.change[:3] == pytest.approx(delta, abs=1e-12)
    assert found.joint.chi2 == pytest.approx(0.02**2 / (2 * 1e-6))
    back = calibration_difference(Calibrated(other, covariance), Calibrated(TRUTH, covariance))
    assert back.joint.chi2 == pytest.approx(found.joint.chi2)


def test_values_taken_as_known_count_only_if_they_differ() -> None:
    known = correlated(4)
    known[:3, :], known[:, :3] = 0.0, 0.0
    step = np.random.default_rng(5).multivariate_normal(np.zeros(15), 2 * known)
    same = calibration_difference(Calibrated(TRUTH, known), Calibrated(TRUTH.moved(step), known))
    assert same.joint.dof == 12
    assert same.joint.p_value > 1e-6
    step[0] = 1e-4
    other = calibration_difference(Calibrated(TRUTH, known), Calibrated(TRUTH.moved(step), known))
    assert other.joint.p_value == 0.0
    assert np.isinf(other.in_sigmas[0])


def test_a_known_direction_leaves_one_degree_of_freedom() -> None:
    """Gravity known in direction: its covariance has rank one."""
    down = TRUTH.gravity_force_base_N / np.linalg.norm(TRUTH.gravity_force_base_N)
    covariance = np.diag(SIGMA**2)
    covariance[3:6, 3:6] = 0.02**2 * np.outer(down, down)
    step = np.zeros(15)
    step[3:6] = 0.1 * down
    found = calibration_difference(Calibrated(TRUTH, covariance), Calibrated(TRUTH.moved(step), covariance))
    assert found.joint.dof == 1
    assert found.joint.chi2 == pytest.approx(0.1**2 / (2 * 0.02**2))
    step[3:6] = 0.1 * np.cross(down, [1.0, 0.0, 0.0])
    across = calibration_difference(Calibrated(TRUTH, covariance), Calibrated(TRUTH.moved(step), covariance))
    assert across.joint.p_value == 0.0
