"""What unchanged readings scatter by, under each explanation of a fit, against dense formulas."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy.linalg import block_diag
from scipy.spatial.transform import Rotation
from scipy.stats import chi2, f

from ftcalib import CalibrationDataset, CalibrationResult, Setup, solve
from ftcalib.after.expected_readings import (
    USUAL_ERRORS_RAD,
    USUAL_SHARES,
    USUAL_WALKS,
    Expected,
    _posterior,
    _walk_columns,
    expected_as_found,
    expected_with_hysteresis,
    expected_with_inexact_orientations,
    expected_with_walk,
)
from ftcalib.after.state import Update
from ftcalib.model import BIASES, Array, DriftResult, gravity_wrench, jacobian, predict
from ftcalib.poses.information import SUBSET_6, special
from tests.first_order import propagated
from tests.unit.ftdrive.live.simulated import NOISE, TRUTH, calibrated

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


def test_without_components_the_residuals_show_a_factor_of_the_noise() -> None:
    calibration = replace(found_with(), chi2=3.0 * calibrated().dof)
    _, _, expected = added(calibration)
    assert (expected.factor, expected.freedom) == (3.0, calibration.dof)
    assert expected_as_found(replace(calibration, chi2=1e-3), NEW, COV).factor == 0.1
    gain = expected_as_found(found_with(gain=0.01), NEW, COV)
    assert (gain.factor, gain.freedom) == (1.0, np.inf)


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


def test_a_posterior_is_that_of_dense_formulas() -> None:
    rng = np.random.default_rng(3)
    J, e = rng.normal(size=(5, 6, 12)), rng.normal(size=(5, 6))
    roots = rng.normal(size=(5, 6, 6))
    V = roots @ np.swapaxes(roots, 1, 2)
    sigma, offset = np.r_[np.full(4, np.inf), 0.5, 2.0, 0.0, np.full(5, 0.1)], np.r_[np.zeros(4), rng.normal(size=8)]
    x, C, misfit, logdet = _posterior(J, V, sigma, e, offset)
    flat, known = J[..., :4].reshape(30, 4), J[..., 4:].reshape(30, 8)
    S = block_diag(*V) + known @ np.diag(sigma[4:] ** 2) @ known.T
    y = e.ravel() + known @ np.where(sigma[4:] > 0, offset[4:], 0.0)
    W = np.linalg.inv(S)
    cov = np.linalg.inv(flat.T @ W @ flat)
    free = cov @ flat.T @ W @ y
    left = y - flat @ free
    np.testing.assert_allclose(x[:4], free)
    np.testing.assert_allclose(C[:4, :4], cov)
    shrunk = np.diag(sigma[4:] ** 2) @ known.T @ W @ left - np.where(sigma[4:] > 0, offset[4:], 0.0)
    np.testing.assert_allclose(x[4:], shrunk, atol=1e-12)
    assert misfit == pytest.approx(left @ W @ left)
    assert logdet == pytest.approx(np.linalg.slogdet(S)[1] - np.linalg.slogdet(cov)[1])


def test_the_bias_of_a_walk_is_that_of_the_last_pose() -> None:
    rng = np.random.default_rng(4)
    D = np.array([np.diag(row) for row in rng.uniform(0.5, 2, (4, 6))])
    steps = rng.normal(size=(3, 6))
    walk = np.concatenate(
        [np.zeros((1, 6)), np.cumsum(steps * np.sqrt(D.diagonal(axis1=1, axis2=2).mean(axis=0)), axis=0)]
    )
    np.testing.assert_allclose(_walk_columns(D) @ steps.ravel(), walk - walk[-1], atol=1e-12)


@pytest.fixture(scope="module")
def fitted() -> tuple[CalibrationResult, CalibrationDataset]:
    R = special(SUBSET_6)
    rng = np.random.default_rng(5)
    inexact = Rotation.from_rotvec(5e-4 * rng.normal(size=(6, 3))).as_matrix()
    wrench = predict(TRUTH, R @ inexact) + SIGMA * rng.normal(size=(6, 6))
    dataset = CalibrationDataset(
        R, wrench, np.tile(np.diag(SIGMA**2), (6, 1, 1)), np.zeros(6, np.int64), np.full(6, np.nan)
    )
    return replace(
        solve(dataset, setup=Setup(sensor_accuracy_percent=0.0)), components={"white_force_N": 1e-3}
    ), dataset


@pytest.mark.parametrize("kind", ["orientations", "hysteresis", "walk"])
def test_explanations_have_the_likelihood_of_the_residuals(
    fitted: tuple[CalibrationResult, CalibrationDataset], kind: str
) -> None:
    calibration, dataset = fitted
    p, R = calibration.parameters, dataset.R_base_flange
    e, J = (dataset.wrench - predict(p, R)).ravel(), jacobian(p, R).reshape(36, 15)
    J_new = jacobian(p, NEW).reshape(24, 15)
    swing = np.diff(gravity_wrench(p, R), axis=0)
    lag = np.zeros((6, 6, 6))
    lag[1:, range(6), range(6)] = swing
    first = np.diag(np.concatenate([np.mean(swing**2, axis=0), np.zeros(30)]))
    earlier = np.arange(5.0, -1.0, -1.0)
    explain: Any = {
        "orientations": expected_with_inexact_orientations,
        "hysteresis": expected_with_hysteresis,
        "walk": expected_with_walk,
    }[kind]
    found = explain(calibration, dataset, NEW, COV)
    usual = {
        "orientations": list(USUAL_ERRORS_RAD),
        "hysteresis": list(USUAL_SHARES),
        "walk": [(a, b) for a in USUAL_WALKS for b in USUAL_WALKS],
    }[kind]
    assert len(found) == len(usual)
    logs = []
    for one, size in zip(found, usual, strict=True):
        S = np.kron(np.eye(6), np.diag(SIGMA**2))
        if kind == "orientations":
            turns = jacobian(p, R)[..., :3]
            S += size**2 * block_diag(*(turns @ np.swapaxes(turns, 1, 2)))
        elif kind == "hysteresis":
            S += size**2 * (lag.reshape(36, 6) @ lag.reshape(36, 6).T + first)
        else:
            steps = np.repeat(size, 3) * SIGMA
            S += np.kron(np.minimum.outer(earlier, earlier), np.diag(steps**2))
            ahead = np.arange(1.0, 5.0)
            noise = np.kron(np.minimum.outer(ahead, ahead), np.diag(steps**2)) + block_diag(*COV)
            np.testing.assert_allclose(one.noise, noise, atol=1e-15)
        W = np.linalg.inv(S)
        C = np.linalg.inv(J.T @ W @ J)
        x = C @ J.T @ W @ e
        misfit = float((e - J @ x) @ W @ (e - J @ x))
        logs.append(-0.5 * (np.linalg.slogdet(S)[1] - np.linalg.slogdet(C)[1] + 21 * np.log(misfit)))
        assert one.freedom == 21
        assert one.factor == pytest.approx(max(misfit / 21, 0.1), rel=1e-5)
        covariance = C + np.outer(x, x) / one.factor
        if kind != "hysteresis":  # there the shares are known from the fit, together with the parameters
            np.testing.assert_allclose(
                one.common(NEW), J_new @ covariance @ J_new.T, rtol=1e-4, atol=1e-4 * one.common(NEW).max()
            )
    weights = np.exp(np.array(logs) - max(logs))
    np.testing.assert_allclose([one.weight for one in found], weights / weights.sum(), rtol=1e-4, atol=1e-9)
