"""What unchanged readings scatter by, under each explanation of a fit, against dense formulas."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.linalg import block_diag
from scipy.spatial.transform import Rotation
from scipy.stats import chi2, f

from ftcalib import CalibrationResult
from ftcalib.after.state import Update
from ftcalib.after.verification import Expected, expected_as_found
from ftcalib.model import BIASES, Array, DriftResult, gravity_wrench, predict
from tests.first_order import propagated
from tests.unit.ftdrive.stream.simulated import NOISE, TRUTH, calibrated

SIGMA = NOISE / 20
NEW = Rotation.random(4, rng=np.random.default_rng(1)).as_matrix()
COV = np.tile(np.diag(SIGMA**2), (4, 1, 1))
FORCE, TORQUE = np.repeat([1.0, 0.0], 3), np.repeat([0.0, 1.0], 3)


def found_with(**components: float) -> CalibrationResult:
    return replace(calibrated(), components=components, noise_source="measured")


def added(calibration: CalibrationResult) -> tuple[Array, Array, Expected]:
    """What the components add to the noise, pose by pose, and to the variance of the bias."""
    expected = expected_as_found(calibration, NEW, COV)
    noise = (expected.noise - block_diag(*COV)).reshape(4, 6, 4, 6)
    bias = np.diag(expected.calibration.covariance - calibration.covariance)[BIASES]
    np.testing.assert_allclose(expected.calibration.covariance[:6, :6], calibration.covariance[:6, :6])
    return noise, bias, expected


def each_channel(between_poses: Array, variance: Array) -> Array:
    return np.asarray(np.einsum("ij,cd->icjd", between_poses, np.diag(variance)))


def test_a_walk_goes_on_from_the_mean_over_the_tour() -> None:
    noise, bias, expected = added(found_with(walk_force_N=2.0, walk_torque_Nm=0.07))
    variance = 2.0**2 * FORCE + 0.07**2 * TORQUE
    k = np.arange(4.0)
    np.testing.assert_allclose(noise, each_channel(np.minimum.outer(k, k), variance), atol=1e-12)
    np.testing.assert_allclose(bias, (24 / 3 + 1) * variance)
    assert expected.freedom == pytest.approx(3 * 23, rel=1e-2)  # all noise, and half of it is that of the walk
    assert expected.factor == 1


def test_a_linear_drift_goes_on_for_as_long_as_the_tour() -> None:
    change = np.array([0.4, -0.3, 0.2, 0.01, 0.02, -0.03])
    noise, bias, expected = added(replace(found_with(), drift=DriftResult(change, np.full(6, 0.01))))
    k = np.arange(4.0) / np.float64(24)
    np.testing.assert_allclose(noise, each_channel(np.outer(k, k), change**2), atol=1e-12)
    np.testing.assert_allclose(bias, change**2)
    assert expected.freedom > 6


def test_errors_of_each_pose_are_expected_again() -> None:
    noise, bias, expected = added(found_with(rotation_rad=0.1))
    for k in range(4):
        turned = propagated(
            lambda e, R=NEW[k]: predict(calibrated().parameters, R @ Rotation.from_rotvec(e).as_matrix()),  # type: ignore[misc]
            0.1**2 * np.eye(3),
        )
        np.testing.assert_allclose(noise[k, :, k], turned, rtol=1e-3, atol=1e-3 * turned.max())
        noise[k, :, k] = 0.0
    assert not noise.any()
    assert not bias.any()
    assert expected.freedom == pytest.approx((2 * 24 - 6) * 9, rel=1e-2)  # a third of the channels has it
    noise, bias, expected = added(found_with(white_force_N=3.0, white_torque_Nm=0.1))
    np.testing.assert_allclose(noise, each_channel(np.eye(4), 9.0 * FORCE + 0.01 * TORQUE), atol=1e-12)
    assert not bias.any()
    assert expected.freedom == pytest.approx(calibrated().dof, rel=1e-3)
    all_of_it = replace(found_with(white_fx_N=3.0), noise_source="residuals")  # the stated noise is a guess
    unmeasured = expected_as_found(all_of_it, NEW, COV).noise.reshape(4, 6, 4, 6)
    np.testing.assert_allclose(np.diag(unmeasured[1, :, 1]), [9.0, *SIGMA[1:] ** 2])


def test_hysteresis_is_a_share_of_each_change_of_load() -> None:
    noise, bias, expected = added(found_with(hysteresis=0.5))
    swing = np.diff(gravity_wrench(calibrated().parameters, NEW), axis=0)
    for c in range(6):
        shares = np.append(0.0, swing[:, c])
        first = np.sqrt(np.mean(swing[:, c] ** 2)) * np.eye(4)[0]
        np.testing.assert_allclose(noise[:, c, :, c], 0.25 * (np.outer(shares, shares) + np.outer(first, first)))
    assert not bias.any()
    assert expected.freedom == pytest.approx(6 * (24 / 12) ** 2, rel=1e-2)  # 12 of 24 readings are determined by it


def test_p_value_and_deviance_follow_from_the_freedom_of_the_noise() -> None:
    one = Expected(Update(TRUTH, np.zeros((15, 15)), 0.0, 0), block_diag(*COV), 10.0, 2.0)
    assert one.p_value(60.0, 24) == pytest.approx(f.sf(30 / 24, 24, 10))
    assert one.deviance(60.0, 24) == pytest.approx(34 * np.log(4))
    many, exact = replace(one, freedom=1e9), replace(one, freedom=np.inf)
    assert exact.p_value(60.0, 24) == pytest.approx(chi2.sf(30, 24))
    assert many.p_value(60.0, 24) == pytest.approx(chi2.sf(30, 24), rel=1e-6)
    assert (many.deviance(60.0, 24), exact.deviance(60.0, 24)) == pytest.approx((30, 30), rel=1e-6)
    left = np.tile(3 * SIGMA, (4, 1))
    residual, sigma, distance = one.distance(NEW, predict(TRUTH, NEW) + left)
    np.testing.assert_allclose(residual, left)
    np.testing.assert_allclose(sigma, np.sqrt(2) * np.tile(SIGMA, (4, 1)))
    assert distance == pytest.approx(9 * 24)
