"""The judgement: chances that are as stated, and every finding where it is true."""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from ftcalib import CalibrationDataset, CalibrationResult, Finding, Parameters, solve
from ftcalib.judge.faults import faults
from ftcalib.judge.verdict import (
    Case,
    Quality,
    strong_correlations,
)
from ftcalib.likelihood.fit import Estimate
from ftcalib.model import Array, SPECIAL_R_flange_base, jacobian, predict
from ftcalib.solver import _judge
from ftdrive import read_dataset
from tests.known_cells import SIGMA, white
from tests.known_cells import UPSIDE_DOWN as TRUTH

R24 = np.swapaxes(SPECIAL_R_flange_base, 1, 2)


def gauss_newton(R: Array, wrench: Array, cov: Array, start: Parameters = TRUTH) -> Parameters:
    """An estimator of the test's own: plain Gauss-Newton from close by."""
    whiten = np.linalg.inv(np.linalg.cholesky(cov))
    for _ in range(6):
        J = (whiten @ jacobian(start, R)).reshape(-1, 15)
        e = (whiten @ (wrench - predict(start, R))[..., None]).ravel()
        start = start.moved(np.asarray(np.linalg.solve(J.T @ J, J.T @ e)))
    return start


def fit(
    R: Array,
    wrench: Array,
    cov: Array | None = None,
    *,
    start: Parameters = TRUTH,
    second: float | None = None,
    weights: Array | None = None,
    components: Mapping[str, float] | None = None,
) -> Estimate:
    n, noise = len(R), white(len(R)) if cov is None else cov
    weights = np.ones(n) if weights is None else weights
    used = weights > 0
    parameters = gauss_newton(R[used], wrench[used], noise[used], start)
    if cov is None:  # one scale from the residuals
        noise = noise * float(np.sum(((wrench - predict(parameters, R)) / SIGMA) ** 2) / (6 * n - 15))
    J = jacobian(parameters, R[used])
    information = np.einsum("nki,nkl,nlj->ij", J, np.linalg.inv(noise[used]), J)
    covariance = np.asarray(np.linalg.inv(information))
    given = parameters, covariance, R, wrench, noise, weights
    return Estimate.independent(*given, measured=cov is not None, second_basin_chi2=second, components=components)


def with_wrench(fitted: Estimate, wrench: Array) -> Estimate:
    """The same estimates, from 24 poses with measured noise, beside other readings."""
    given = fitted.parameters, fitted.covariance, fitted.R_base_flange, wrench, white(24), fitted.weights
    return Estimate.independent(*given, measured=True, second_basin_chi2=fitted.second_basin_chi2)


def judge(found: Estimate, **given: Any) -> Quality:
    """As `solve` judges it, with what is given of the case."""
    return _judge(Case(found, **given), None)


def noisy(rng: np.random.Generator, R: Array, truth: Parameters = TRUTH, sigma: Array = SIGMA) -> Array:
    return np.asarray(predict(truth, R) + rng.normal(size=(len(R), 6)) * sigma)


def codes(judged: Quality | CalibrationResult) -> list[str]:
    return [one.code for one in judged.findings]


def the(code: str, judged: Quality | CalibrationResult) -> Finding:
    """The one finding with this code."""
    (finding,) = (one for one in judged.findings if one.code == code)
    return finding


# Statistics


def test_a_pose_that_nothing_checks_is_named() -> None:
    spin = Rotation.from_euler("y", 150, degrees=True) * Rotation.from_euler("z", np.arange(9)[:, None] * 0.7)
    R = np.concatenate([spin.as_matrix(), Rotation.from_euler("x", [[100.0]], degrees=True).as_matrix()])
    quality = judge(fit(R, noisy(np.random.default_rng(4), R), white(10)))
    assert the("poses_unchecked", quality).values == {"poses": [10]}
    assert quality.verdict != "good"


def test_p_values_are_uniform_and_clean_runs_are_good_without_a_finding() -> None:
    rng, runs = np.random.default_rng(7), 25
    judged = [judge(fit(R24, noisy(rng, R24), white(24))) for _ in range(runs)]
    p = np.sort([q.chi2_p for q in judged if q.chi2_p is not None])
    assert len(p) == runs
    assert np.abs(p - np.arange(1, runs + 1) / runs).max() < 1.6 / np.sqrt(runs)  # Kolmogorov's 1 %
    assert all(q.verdict == "good" for q in judged)
    assert sum(bool(q.findings) for q in judged) <= 1
    assert np.mean([q.lag1 for q in judged]) == pytest.approx(0, abs=0.36 / np.sqrt(runs))


def test_drift_shows_between_successive_poses_in_time_not_in_rows() -> None:
    rng = np.random.default_rng(8)
    drift = np.linspace(0, 1.0, 24)[:, None] * [0, 0, 1.0, 0, 0, 0]
    wrench = noisy(rng, R24) + drift
    quality = judge(fit(R24, wrench, white(24)))
    assert quality.lag1 > 0.25
    assert the("residuals_alike", quality).values["correlation"] == quality.lag1
    order = rng.permutation(24)
    shuffled = fit(R24[order], wrench[order], white(24))
    assert judge(shuffled, t_s=order.astype(float)).lag1 == pytest.approx(quality.lag1, abs=1e-6)
    assert judge(shuffled).lag1 < 0.2
    assert judge(shuffled, t_s=np.full(24, np.nan)).lag1 == judge(shuffled).lag1


def test_strong_correlations_are_named() -> None:
    covariance = np.eye(15)
    covariance[5, 8] = covariance[8, 5] = -0.95
    assert strong_correlations(covariance) == (("gravity_force_base_N.z", "force_bias_N.z", -0.95),)


# Reasons


def test_noise_beyond_the_measured_is_good_only_while_errors_are_small() -> None:
    rng = np.random.default_rng(10)
    small, large = 0.04, 0.25  # N at 20 N: with three axes 0.3 % and 2.2 %
    for sigma_N, factor, verdict in ((small, 2.0, "good"), (small, 5.0, "usable"), (large, 2.0, "usable")):
        sigma = np.repeat([sigma_N, 0.025 * sigma_N], 3)
        quality = judge(fit(R24, noisy(rng, R24, sigma=sigma), white(24, sigma / factor), components={}))
        assert quality.verdict == verdict
        assert quality.noise_factor == pytest.approx(factor, rel=0.2)
        assert the("noise_exceeded", quality).severity == ("note" if verdict == "good" else "limit")
    known = judge(fit(R24, noisy(rng, R24, sigma=2 * SIGMA), white(24), components={"rotation_rad": 0.002}))
    assert the("noise_exceeded", known).values["components"] == {"rotation_rad": 0.002}


def test_errors_are_stated_relative_to_the_weight() -> None:
    rng = np.random.default_rng(11)
    usable = judge(fit(R24, noisy(rng, R24, sigma=np.repeat([0.4, 0.01], 3))))
    error = usable.findings[0]
    assert (usable.verdict, error.code, error.severity) == ("usable", "force_error", "limit")
    assert error.values["share_percent"] == pytest.approx(2.8, abs=0.05)
    assert (error.values["source"], error.values["limit_percent"]) == ("residuals", 2)
    assert "torque_error" not in codes(usable)
    sigma = np.repeat([0.05, 0.2], 3)
    rejected = judge(fit(R24, noisy(rng, R24, sigma=sigma), white(24, sigma)))
    error = rejected.findings[0]
    assert (rejected.verdict, error.code, error.severity) == ("rejected", "torque_error", "reject")
    assert 10 < error.values["share_percent"] < 20


@pytest.mark.parametrize("channel", [2, 3])
def test_what_is_known_is_doubted_where_the_data_fit_without_it(channel: int) -> None:
    wrench = noisy(np.random.default_rng(24), R24)
    free = fit(R24, wrench, white(24))
    off = 3.0 if channel < 3 else 0.2  # N or N·m of every pose, as from a constraint that is wrong
    constrained = with_wrench(free, wrench + off * np.eye(6)[channel])
    kind, unit = ("force", "N") if channel < 3 else ("torque", "Nm")
    finding = the(f"known_values_misfit_{kind}", judge(constrained, free=free))
    assert finding.values[f"residual_{unit}"] == pytest.approx(off, rel=0.02)
    assert not any(code.startswith("known") for code in codes(judge(free, free=free)))


def test_a_pose_out_of_line_is_pointed_at() -> None:
    wrench = noisy(np.random.default_rng(13), R24)
    wrench[12, 0] += 0.5
    quality = judge(fit(R24, wrench, white(24)))
    assert quality.worst_pose == 12
    assert the("pose_deviates", quality).values["pose"] == 13


def test_a_second_solution_is_given_its_odds() -> None:
    wrench = noisy(np.random.default_rng(14), R24)
    quality = judge(fit(R24, wrench, white(24), second=2.0))
    assert quality.verdict == "rejected"
    assert quality.findings[0].code == "second_solution"
    assert quality.findings[0].values["probability_percent"] == pytest.approx(27, abs=0.5)
    assert judge(fit(R24, wrench, white(24), second=13.0)).verdict == "good"


def test_a_weight_lost_in_noise_is_rejected() -> None:
    light = replace(TRUTH, gravity_force_base_N=np.array([0, 0, -0.03]))
    quality = judge(fit(R24, noisy(np.random.default_rng(15), R24, light), white(24), start=light))
    assert quality.verdict == "rejected"
    assert quality.findings[0].code == "weight_insignificant"


# Signs, axes and units: what a wrongly wired sensor reads, solved without knowing better.


def solved(R: Array, wrench: Array) -> CalibrationResult:
    n = len(R)
    return solve(CalibrationDataset(R, wrench, None, np.zeros(n, np.int64), np.full(n, np.nan)))


F, T = ["fx", "fy", "fz"], ["tx", "ty", "tz"]
DISAGREE = {"orientations_inverted", "axes_disagree", "weight_upwards", "forces_reversed", "torques_reversed"}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("reversed_channels", "code", "corrections"),
    [
        (F + T, "weight_upwards", None),
        (F, "forces_reversed", None),
        (T, "torques_reversed", None),
        (["tx"], "axes_disagree", [["torque", ["-x", "y", "z"]]]),
        (["ty", "tz"], "axes_disagree", [["torque", ["x", "-y", "-z"]], ["force", ["x", "-y", "-z"]]]),
    ],
)
def test_reversed_channels_are_detected(
    reversed_channels: list[str], code: str, corrections: list[object] | None
) -> None:
    rng = np.random.default_rng(17)
    R = Rotation.random(12, rng=rng).as_matrix()
    signs = [-1.0 if channel in reversed_channels else 1.0 for channel in F + T]
    result = solved(R, noisy(rng, R) * signs)
    assert result.verdict == ("rejected" if corrections else "usable")
    assert result.findings[0].code == code
    assert result.findings[0].values.get("corrections") == corrections


@pytest.mark.slow
def test_nothing_is_suspected_of_a_sound_sensor() -> None:
    rng = np.random.default_rng(19)
    for sigma in (SIGMA, 40 * SIGMA):
        R = Rotation.random(12, rng=rng).as_matrix()
        wrench = noisy(rng, R, sigma=sigma)
        assert faults(R, wrench) == []
        assert not DISAGREE & set(codes(solved(R, wrench)))


FITTED = fit(R24, noisy(np.random.default_rng(30), R24), white(24))
WEIGHT_N = FITTED.parameters.weight_N
SMOOTH = {"response_not_linear", "cable_acts", "orientations_smoothly_off"}


@pytest.mark.parametrize(
    ("components", "found"),
    [
        ({"load_force": 0.0019, "load_torque": 0.0005}, [("response_not_linear", "note")]),
        ({"load_torque": 0.0021}, [("response_not_linear", "limit")]),
        ({"cable_torque_Nm": 0.0021 * WEIGHT_N * 0.1}, [("cable_acts", "limit")]),
        ({"kinematics_rad": 0.0021, "gain": 0.1}, [("orientations_smoothly_off", "limit")]),
        ({"walk_force_N": 1.0, "load_force": 0.0004}, []),
    ],
)
def test_a_smooth_error_limits_from_a_fifth_of_a_percent_of_the_weight_on(
    components: dict[str, float], found: list[tuple[str, str]]
) -> None:
    named = judge(replace(FITTED, components=components)).findings
    assert [(one.code, one.severity) for one in named if one.code in SMOOTH] == found


# Rounding, drift and real sessions


@pytest.mark.parametrize("timed", [True, False])
def test_a_linear_drift_goes_on_for_the_next_minute(timed: bool) -> None:
    ramp = np.linspace(-1, 1, 24)[:, None] * [0.3, 0, 0.4, 0, 0.01, 0]
    times = 20.0 * np.arange(24, dtype=np.float64) if timed else np.full(24, np.nan)
    noise = 0.01 * np.random.default_rng(26).normal(size=(24, 6)) * SIGMA / SIGMA[0]
    wrench = predict(TRUTH, R24) + ramp + noise
    result = solve(CalibrationDataset(R24, wrench, None, np.zeros(24, np.int64), times), drift="linear")
    steps = 3 if timed else 6  # of 20 s; of 10 s where no time is known
    at_the_end = np.array([0.3, 0, 0.4, 0, 0.01, 0])
    assert result.mean_bias is not None
    np.testing.assert_allclose(result.parameters.bias - result.mean_bias, at_the_end, atol=0.02)
    np.testing.assert_allclose(result.parameters.bias, TRUTH.bias + at_the_end, atol=0.02)
    np.testing.assert_allclose(result.quality["bias_growth_per_min"], steps * at_the_end * 2 / 23, atol=0.02)
    np.testing.assert_allclose(result.likely_error(), steps * 2 / 23 * np.array([0.5, 0.01]), rtol=0.1)


@pytest.mark.slow
def test_the_likely_error_is_that_of_the_next_use_where_the_bias_walks() -> None:
    walk, rng, ratios = np.repeat([0.1, 0.003], 3), np.random.default_rng(27), []
    times = 10.0 * np.arange(24, dtype=np.float64)
    for _ in range(4):
        moved = np.cumsum(rng.normal(size=(30, 6)) * walk, axis=0)  # six more in the minute after
        wrench = noisy(rng, R24) + moved[:24]
        result = solve(CalibrationDataset(R24, wrench, white(24), np.full(24, 500), times))
        error = result.compensate(predict(TRUTH, R24) + moved[-1], R24)
        ratios.append(np.mean(np.sum(error.reshape(-1, 2, 3) ** 2, axis=2), axis=0) / result.likely_error() ** 2)
        assert result.likely_error()[0] > 1.5 * result.quality["loo_force_rms_N"]
    assert 0.6 < np.sqrt(np.mean(ratios)) < 1.3


@pytest.mark.slow
def test_a_real_session_read_with_wrong_signs_is_found_out(real_data: Path) -> None:
    dataset = read_dataset(real_data / "agimus_mini45_b" / "poses.csv", "R_flange_base")
    R, wrench = dataset.R_base_flange, dataset.wrench
    assert "weight_upwards" in codes(solved(R, -wrench))
    corrections = the("axes_disagree", solved(R, wrench * [1, 1, 1, -1, 1, 1])).values["corrections"]
    assert corrections == [["torque", ["-x", "y", "z"]]]
