"""Gain and cross-talk of the sensor: found where they are, and applied."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from ftcalib import CalibrationDataset, CalibrationResult, Parameters, Setup, solve
from ftcalib.judge.verdict import _response_findings
from ftcalib.known import RANGE_LEVER_M
from ftcalib.likelihood.fit import Fit, fit
from ftcalib.model import Array, gravity_wrench, predict
from ftcalib.sensor_matrix import CROSS_TALK_M, GAIN, Response, response_columns

SIGMA = np.repeat([0.05, 0.00125], 3)
WHITE = np.diag(SIGMA**2)
WEIGHT_N = 20.0


def truth(rng: np.random.Generator) -> Parameters:
    com = rng.normal(size=3)
    return Parameters(
        Rotation.random(rng=rng).as_matrix(),
        np.array([0.3, -0.2, -WEIGHT_N]),
        5 * rng.normal(size=3),
        0.08 * com / np.linalg.norm(com),
        0.3 * rng.normal(size=3),
    )


def session(
    rng: np.random.Generator, n: int, gain: float, cross_talk: float
) -> tuple[Parameters, Array, Array, Array, Array]:
    """Simulate n poses read by a sensor with errors of that size in every entry of its matrix."""
    p, R = truth(rng), np.asarray(Rotation.random(n, rng=rng).as_matrix())
    M, L = gain * rng.normal(size=(3, 3)), cross_talk * RANGE_LEVER_M * rng.normal(size=(3, 3))
    return p, R, read(p, R, M, L) + SIGMA * rng.normal(size=(n, 6)), M, L


def read(p: Parameters, R: Array, M: Array, L: Array) -> Array:
    u = gravity_wrench(p, R)[:, :3]
    return np.asarray(predict(p, R) + np.concatenate([u @ M.T, u @ L.T], axis=1))


def predicted(best: Fit, R: Array) -> Array:
    added = 0.0 if best.response is None else best.response.wrench(best.parameters, R)
    return np.asarray(predict(best.parameters, R) + added)


def test_columns_are_the_derivative_of_the_response() -> None:
    rng = np.random.default_rng(0)
    p, R, x = truth(rng), Rotation.random(3, rng=rng).as_matrix(), rng.normal(size=11)
    M, L = np.tensordot(x[:5], GAIN, 1), np.tensordot(x[5:], CROSS_TALK_M, 1)
    assert np.trace(M) == pytest.approx(0)
    np.testing.assert_allclose(M, M.T)
    np.testing.assert_allclose(L, L.T)
    np.testing.assert_allclose(response_columns(p, R) @ x, read(p, R, M, L) - predict(p, R), atol=1e-12)


def test_a_sensor_of_wrong_gain_is_predicted_as_well_as_by_an_oracle() -> None:
    ours, plain = [], []
    for seed in range(4):
        rng = np.random.default_rng(seed)
        p, R, wrench, M, L = session(rng, 24, 0.02, 0.02)
        best = fit(R, wrench, WHITE)
        assert best.response is not None
        elsewhere = Rotation.random(50, rng=rng).as_matrix()
        right = read(p, elsewhere, M, L)
        ours.append(np.mean((predicted(best, elsewhere) - right) ** 2, axis=0))
        plain.append(np.mean((predict(best.parameters, elsewhere) - right) ** 2, axis=0))
    force, torque = (np.sqrt(np.mean(np.array(ours)[:, c])) for c in (slice(0, 3), slice(3, 6)))
    assert force < SIGMA[0]  # of a pose; 14 numbers from 24 poses
    assert torque < SIGMA[5]
    assert np.sqrt(np.mean(plain)) > 3 * np.sqrt(np.mean(ours))


@pytest.mark.slow
def test_nothing_is_found_in_a_sensor_without_error() -> None:
    found = 0
    for seed in range(20):
        _, R, wrench, _, _ = session(np.random.default_rng(seed), 24, 0.0, 0.0)
        found += fit(R, wrench, WHITE).response is not None
    assert found <= 1


@pytest.mark.slow
def test_few_poses_do_not_show_it_and_it_counts_as_that_of_usual_sensors() -> None:
    distances = []
    for seed in range(10):
        rng = np.random.default_rng(seed)
        p, R, wrench, M, L = session(rng, 6, 0.02, 0.01)
        best = fit(R, wrench, WHITE)
        assert best.response is not None
        elsewhere = np.asarray(Rotation.random(1, rng=rng).as_matrix())
        e = (predicted(best, elsewhere) - read(p, elsewhere, M, L))[0]
        S = best.wrench_covariance(elsewhere)[0]
        distances.append(e @ np.linalg.solve(S, e))
    assert 3 < np.mean(distances) < 12
    assert fit(R, wrench, WHITE, gain_sigma=0.0).response is None


def solved(seed: int = 1) -> tuple[CalibrationResult, Array, Array]:
    _, R, wrench, _, _ = session(np.random.default_rng(seed), 24, 0.02, 0.02)
    dataset = CalibrationDataset(R, wrench, np.tile(WHITE, (24, 1, 1)), np.full(24, 200), np.arange(24.0))
    return solve(dataset), R, wrench


def test_compensation_applies_it_unless_asked_not_to() -> None:
    result, R, wrench = solved()
    assert result.response is not None
    free = result.contact.decode(result.residuals)
    np.testing.assert_allclose(result.compensate(wrench, R), free, atol=1e-12)
    plain = result.compensate(wrench, R, response=False)
    np.testing.assert_allclose(plain, wrench - predict(result.parameters, R), atol=1e-12)
    assert np.sqrt(np.mean(plain**2)) > 2 * np.sqrt(np.mean(result.residuals**2))


@pytest.mark.slow
def test_sigmas_of_the_tool_include_what_gain_and_cross_talk_hide() -> None:
    seeds = 8
    z, compensation = [], []
    for seed in range(seeds):
        rng = np.random.default_rng(seed)
        p, R, wrench, M, L = session(rng, 24, 0.02, 0.02)
        poses = CalibrationDataset(R, wrench, np.tile(WHITE, (24, 1, 1)), np.zeros(24, int), np.arange(24.0))
        result = solve(poses, setup=Setup(orientation_accuracy_deg=0.0))
        error = np.append(result.parameters.difference(p), result.weight_N - np.linalg.norm(p.gravity_force_base_N))
        stated = [result.sigma[name] for name in ("R_flange_sensor", "gravity_force_base_N", "force_bias_N")]
        stated += [result.sigma[name] for name in ("p_sensor_com_m", "torque_bias_Nm", "weight_N")]
        z.append(error / np.hstack(stated))
        e = result.compensate(read(p, R[:1], M, L), R[:1])[0]
        compensation.append(e @ np.linalg.solve(result.wrench_covariance(R[:1])[0], e) / 6)
    ratio = np.sqrt([np.mean(part**2) for part in np.split(np.array(z), [3, 6, 9, 12, 15], axis=1)])
    np.testing.assert_allclose(ratio, 1, atol=0.25 + 1.5 / np.sqrt(seeds))
    assert np.sqrt(np.mean(compensation)) == pytest.approx(1, abs=0.15 + 1 / np.sqrt(seeds))


def test_a_sensor_and_an_arm_that_are_declared_exact_hide_nothing_but_the_least_scale() -> None:
    _, R, wrench, _, _ = session(np.random.default_rng(0), 24, 0.0, 0.0)
    poses = CalibrationDataset(R, wrench, np.tile(WHITE, (24, 1, 1)), np.zeros(24, int), np.arange(24.0))
    usual = solve(poses)
    exact = solve(poses, setup=Setup(sensor_accuracy_percent=0.0, orientation_accuracy_deg=0.0))
    assert usual.response is exact.response is None
    assert not exact.hidden_covariance.any()
    b = exact.gravity_force_base_N
    of_scale = exact.covariance.copy()
    of_scale[3:6, 3:6] += 0.002**2 * np.outer(b, b)
    np.testing.assert_allclose(exact.tool_covariance, of_scale, atol=1e-15)
    assert 0.002 * exact.weight_N < exact.sigma["weight_N"] < 0.003 * exact.weight_N
    # A common gain of 1.4 %, and what the differences that the tool does not show leave of the mean of three axes.
    assert 0.014 < usual.sigma["mass_kg"] / usual.mass_kg < 0.018


def test_it_is_found_along_the_axes_that_have_it() -> None:
    coefficients = np.zeros(11)
    coefficients[1], coefficients[2] = -0.03, 0.01  # low along x and y, high along z; x mixed with y
    found = {one.code: one.values for one in _response_findings(Response(coefficients, 1e-8 * np.eye(26)), 10.0)}
    assert found.keys() == {"gain_x", "gain_y", "gain_z", "axes_mixed"}
    assert found["gain_y"]["gain_percent"] == pytest.approx(-1.22, abs=0.01)
    assert found["gain_z"]["gain_percent"] == pytest.approx(2.45, abs=0.01)
    assert found["axes_mixed"]["axes"] == "x and y"
    coefficients[:], coefficients[5] = 0.0, 0.1
    (finding,) = _response_findings(Response(coefficients, 1e-8 * np.eye(26)), 10.0)
    assert (finding.code, finding.values["torque_mNm"]) == ("cross_talk", pytest.approx(5))
    (finding,) = _response_findings(Response(coefficients, np.eye(26)), 10.0)
    assert finding.code == "response_small"


def test_a_damaged_response_is_refused() -> None:
    with pytest.raises(ValueError, match="coefficients"):
        Response(np.zeros(10), np.eye(26))
