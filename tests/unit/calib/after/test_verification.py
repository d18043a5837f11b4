"""Verification: unchanged cells pass, each change is named with its update, contact is not explained away."""

import json
from dataclasses import replace
from functools import lru_cache

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from ftcalib import BadDataset, CalibrationDataset, CalibrationResult, Parameters, Setup, solve
from ftcalib.after.state import apply_update
from ftcalib.after.verification import Verification, expected_with_smooth_errors, verify_calibration
from ftcalib.model import Array, predict
from ftcalib.poses.information import SUBSET_6, special
from ftcalib.sensor_matrix import response_columns
from tests.known_cells import UPRIGHT as TRUTH

SIGMA = np.repeat([0.05, 0.002], 3) / np.sqrt(200)
COEFFICIENTS = 0.01 * np.random.default_rng(0).normal(size=11)
TURN = Rotation.from_rotvec(np.deg2rad(1.0) * np.array([0.6, 0.0, 0.8]))
CHANGED = {
    "bias": replace(TRUTH, force_bias_N=TRUTH.force_bias_N + np.array([0.3, 0.0, 0.4])),
    "payload": replace(
        TRUTH, gravity_force_base_N=TRUTH.gravity_force_base_N * 1.025, p_sensor_com_m=TRUTH.p_sensor_com_m + 0.001
    ),
    "centre of mass": replace(TRUTH, p_sensor_com_m=TRUTH.p_sensor_com_m + np.array([0.0, 0.003, 0.0])),
    "mounting": replace(TRUTH, R_flange_sensor=TURN.as_matrix() @ TRUTH.R_flange_sensor),
    "base": replace(
        TRUTH,
        gravity_force_base_N=Rotation.from_euler("x", 0.5, degrees=True).apply(np.array(TRUTH.gravity_force_base_N)),
    ),
}


def readings(parameters: Parameters, R: Array, seed: int, coefficients: Array | None = None) -> Array:
    noise = np.random.default_rng(seed).normal(size=(len(R), 6)) * SIGMA
    added = 0.0 if coefficients is None else response_columns(parameters, R) @ coefficients
    return np.asarray(predict(parameters, R) + added + noise)


# No error of gain is assumed.
EXACT = Setup(sensor_accuracy_percent=0.0)


def noise_of(n: int) -> Array:
    return np.tile(np.diag(SIGMA**2), (n, 1, 1))


@lru_cache(maxsize=64)
def calibrated(seed: int = 2, *, poses: int = 24, gain: bool = False) -> CalibrationResult:
    R = special(range(1, 25)) if poses == 24 else special(SUBSET_6)
    wrench = readings(TRUTH, R, seed, COEFFICIENTS if gain else None)
    dataset = CalibrationDataset(R, wrench, noise_of(poses), np.zeros(poses, np.int64), np.full(poses, np.nan))
    return solve(dataset, setup=EXACT)


def orientations(n: int, seed: int = 2) -> Array:
    return np.asarray(Rotation.random(n, rng=np.random.default_rng(seed)).as_matrix())


def verified(parameters: Parameters, n: int = 6, seed: int = 3, *, gain: bool = False) -> Verification:
    wrench = readings(parameters, orientations(n), seed, COEFFICIENTS if gain else None)
    return verify_calibration(calibrated(gain=gain), orientations(n), wrench, noise_of(n))


@pytest.mark.parametrize(("n", "gain"), [(2, True), (6, False)])
def test_an_unchanged_cell_passes(n: int, gain: bool) -> None:
    found = verified(TRUTH, n, gain=gain)
    assert found.passed
    assert (found.change, found.update, found.dof) == (None, None, 6 * n)
    assert "agree with the calibration" in found.reason
    json.dumps(found.to_dict(), allow_nan=False)


@pytest.mark.parametrize(("what", "gain"), [*((what, False) for what in CHANGED), ("payload", True)])
def test_a_change_is_named_and_the_smallest_update_makes_up_for_it(what: str, gain: bool) -> None:
    found = verified(CHANGED[what], gain=gain)
    assert not found.passed
    assert (found.change, found.alternatives) == (what, ())
    assert found.update is not None
    assert found.update.kind == what
    error = CHANGED[what].difference(found.update.parameters)
    assert error @ np.linalg.solve(found.update.covariance, error) < 45  # chi-square, 15 dof: one in 10 000
    child = apply_update(calibrated(gain=gain), found.update)
    wrench = readings(CHANGED[what], orientations(6, 9), 9, COEFFICIENTS if gain else None)
    assert verify_calibration(child, orientations(6, 9), wrench, noise_of(6)).passed
    json.dumps(found.to_dict(), allow_nan=False)


def test_the_reason_states_the_change_with_its_size() -> None:
    assert "the bias has changed by 0.5 N" in verified(CHANGED["bias"]).reason
    assert "the payload has changed by +30 g" in verified(CHANGED["payload"]).reason
    assert "the centre of mass has moved by 3.0 mm" in verified(CHANGED["centre of mass"]).reason
    assert "turned on the flange by 1°" in verified(CHANGED["mounting"]).reason
    assert "gravity has turned in base axes by 0.5" in verified(CHANGED["base"]).reason


def test_everything_changed_needs_all() -> None:
    everything = replace(CHANGED["base"], R_flange_sensor=CHANGED["mounting"].R_flange_sensor)
    everything = replace(everything, force_bias_N=CHANGED["bias"].force_bias_N)
    found = verified(everything, 8)
    assert found.change == "several"
    assert found.update is not None
    assert found.update.kind == "all"


def test_a_hand_on_the_tool_in_one_pose_is_no_change_of_the_calibration() -> None:
    wrench = readings(TRUTH, orientations(6), 3)
    wrench[3] += [2.0, 1.0, 0.0, 0.1, 0.0, 0.05]
    found = verify_calibration(calibrated(), orientations(6), wrench, noise_of(6))
    assert not found.passed
    assert (found.change, found.update) == (None, None)
    assert "pose 4 deviates most" in found.reason
    assert "free tool and cables" in found.reason


def test_two_poses_that_do_not_separate_mounting_from_base_say_so() -> None:
    """Without a turn between them, the poses show a turned sensor and a tilted base alike."""
    R = np.array([Rotation.from_euler("x", 180 + d, degrees=True).as_matrix() for d in (-2.0, 2.0)])
    turned = Rotation.from_euler("y", 1.0, degrees=True).as_matrix() @ TRUTH.R_flange_sensor
    found = verify_calibration(calibrated(), R, readings(replace(TRUTH, R_flange_sensor=turned), R, 4), noise_of(2))
    assert not found.passed
    assert {found.change, *found.alternatives} >= {"mounting", "base"}
    assert "do not distinguish it from a change of" in found.reason


def test_sigma_holds_noise_and_the_uncertainty_of_the_calibration() -> None:
    new = orientations(6)
    for gain in (False, True):
        found, calibration = verified(TRUTH, gain=gain), calibrated(gain=gain)
        variance = SIGMA**2 + np.diagonal(calibration.wrench_covariance(new), axis1=1, axis2=2)
        factor = 1.0 if gain else calibration.chi2 / calibration.dof  # the residuals of the fit show it
        np.testing.assert_allclose(found.predicted_sigma**2, factor * variance, rtol=1e-9)


def test_errors_of_each_pose_that_the_fit_found_are_expected_again() -> None:
    calibration = calibrated()
    inexact = Rotation.from_rotvec(0.003 * np.random.default_rng(5).normal(size=(6, 3))).as_matrix()
    wrench = readings(TRUTH, orientations(6) @ inexact, 6)
    assert not verify_calibration(calibration, orientations(6), wrench, noise_of(6)).passed
    aware = replace(calibration, components={"rotation_rad": 0.003})
    assert verify_calibration(aware, orientations(6), wrench, noise_of(6)).passed
    noisy = replace(calibration, components={"white_force_N": 0.05, "white_torque_Nm": 0.004})
    assert verify_calibration(noisy, orientations(6), wrench, noise_of(6)).passed


def inexact(poses: int, seed: int) -> tuple[CalibrationDataset, Array, Array]:
    """Readings of a fit and of six new poses, whose orientations are off by 0.02°; the fit often does not find it."""
    rng, R = np.random.default_rng(seed), special(SUBSET_6 if poses == 6 else range(1, 25))
    parts = []
    for part in (R, orientations(6, seed)):
        off = Rotation.from_rotvec(np.deg2rad(0.02) * rng.normal(size=(len(part), 3))).as_matrix()
        parts.append(readings(TRUTH, part @ off, seed + len(part)))
    fitted = CalibrationDataset(R, parts[0], noise_of(poses), np.zeros(poses, np.int64), np.full(poses, np.nan))
    return fitted, orientations(6, seed), parts[1]


@pytest.mark.slow
def test_hysteresis_is_no_false_alarm_and_hides_no_change() -> None:
    R, new = special(range(1, 25)), orientations(6)
    lag = 0.002
    y, y_new = readings(TRUTH, R, 0), readings(TRUTH, new, 100)
    y[1:] -= lag * np.diff(predict(TRUTH, R), axis=0)
    moved = -lag * np.diff(predict(TRUTH, np.concatenate([R[-1:], new])), axis=0)
    fitted = CalibrationDataset(R, y, noise_of(24), np.zeros(24, np.int64), np.full(24, np.nan))
    calibration = solve(fitted, setup=EXACT)
    assert verify_calibration(calibration, new, y_new + moved, noise_of(6), fitted=fitted).passed
    for what in ("bias", "payload", "centre of mass"):
        changed = readings(CHANGED[what], new, 100) + moved
        assert verify_calibration(calibration, new, changed, noise_of(6), fitted=fitted).change == what


def test_poses_of_another_kind_of_fit_explain_nothing() -> None:
    fitted, R, _ = inexact(6, 1)
    calibration = solve(fitted, setup=EXACT)
    weights = [one.weight for one in expected_with_smooth_errors(calibration, fitted, R, noise_of(6))]
    assert sum(weights) == pytest.approx(1)
    assert min(weights) > 0
    for other in (replace(calibration, method="srom"), replace(calibration, dof=24)):
        assert expected_with_smooth_errors(other, fitted, R, noise_of(6)) == []
    unmeasured = replace(fitted, wrench_cov=None)
    assert expected_with_smooth_errors(calibration, unmeasured, R, noise_of(6)) == []
    with pytest.raises(BadDataset, match="has 6 poses, but the calibration has 24"):
        verify_calibration(calibrated(), R, readings(TRUTH, R, 0), noise_of(6), fitted=fitted)


def test_what_cannot_be_verified_is_refused() -> None:
    with pytest.raises(BadDataset, match="1 pose is too few for a verification: record 2 or more"):
        verify_calibration(calibrated(), orientations(1), readings(TRUTH, orientations(1), 0), noise_of(1))
    with pytest.raises(BadDataset, match="wrench_cov"):
        verify_calibration(calibrated(), orientations(2), readings(TRUTH, orientations(2), 0), noise_of(3))
    with pytest.raises(ValueError, match="false_alarms is 0"):
        verify_calibration(
            calibrated(), orientations(2), readings(TRUTH, orientations(2), 0), noise_of(2), false_alarms=0
        )
