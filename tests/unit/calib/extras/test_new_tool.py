"""A new tool from four poses, and runs with a moved bias as one fit."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from ftcalib import CalibrationDataset, CalibrationResult, solve
from ftcalib.errors import NotObservable
from ftcalib.extras.new_tool import new_tool, together
from ftcalib.model import Array, Parameters, predict
from tests.unit.ftdrive.live.simulated import NOISE, TRUTH, calibrated

OTHER = replace(
    TRUTH,
    gravity_force_base_N=0.6 * TRUTH.gravity_force_base_N,
    force_bias_N=TRUTH.force_bias_N + np.array([0.4, -0.3, 0.6]),
    p_sensor_com_m=np.array([-0.02, 0.01, 0.11]),
    torque_bias_Nm=TRUTH.torque_bias_Nm + np.array([0.01, 0.0, -0.02]),
)
_TETRAHEDRON = np.array([[1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]]) / np.sqrt(3)
FOUR = np.array([Rotation.align_vectors([[0, 0, -1.0]], [down])[0].as_matrix() for down in _TETRAHEDRON])
"""Gravity points evenly in all directions of the flange."""


def poses(truth: Parameters, R: Array, seed: int, longer: float = 1.0) -> CalibrationDataset:
    sigma = NOISE / 20 / np.sqrt(longer)
    wrench = predict(truth, R) + sigma * np.random.default_rng(seed).normal(size=(len(R), 6))
    covariance = np.tile(np.diag(sigma**2), (len(R), 1, 1))
    return CalibrationDataset(R, wrench, covariance, np.zeros(len(R), np.int64), np.full(len(R), np.nan))


def error(result: CalibrationResult, truth: Parameters) -> Array:
    return result.parameters.difference(truth)


def test_sigmas_of_a_new_tool_hold_and_its_parent_is_named() -> None:
    z2 = []
    for seed in range(60):
        earlier = calibrated(24, seed % 12)
        result = new_tool(earlier, poses(OTHER, FOUR, seed))
        e = error(result, OTHER)
        z2.append(e @ np.linalg.solve(result.covariance, e) / 15)
        assert result.provenance["parent"] == {"id": earlier.id}
    assert 0.8 < np.mean(z2) < 1.2
    assert result.verdict == "good"
    assert CalibrationResult.from_dict(result.to_dict()).id == result.id


def test_a_turned_sensor_and_a_leaning_base_are_named() -> None:
    turn = Rotation.from_rotvec([0.0, 0.0, 1.0], degrees=True).as_matrix()
    with pytest.raises(NotObservable, match=r"the sensor is mounted otherwise.*, by (0.9|1|1.1)"):
        new_tool(calibrated(), poses(replace(OTHER, R_flange_sensor=turn @ TRUTH.R_flange_sensor), FOUR, 1))
    lean = Rotation.from_rotvec([2.0, 0.0, 0.0], degrees=True).as_matrix()
    with pytest.raises(NotObservable, match="the base leans otherwise"):
        new_tool(calibrated(), poses(replace(OTHER, gravity_force_base_N=lean @ OTHER.gravity_force_base_N), FOUR, 1))
    touched = poses(OTHER, FOUR, 1)
    wrench = touched.wrench.copy()
    wrench[1] += [3.0, -2.0, 1.0, 0.3, 0.0, 0.2]
    with pytest.raises(NotObservable, match=r"check for contact|otherwise"):
        new_tool(calibrated(), replace(touched, wrench=wrench))


def test_poses_without_noise_are_refused() -> None:
    with pytest.raises(NotObservable, match="noise of the poses was not measured"):
        new_tool(calibrated(), CalibrationDataset.of(FOUR, predict(OTHER, FOUR)))


def test_two_days_with_a_moved_bias_are_one_fit() -> None:
    z2, sizes = [], []
    R = Rotation.random(16, rng=np.random.default_rng(5)).as_matrix()
    moved = replace(TRUTH, force_bias_N=TRUTH.force_bias_N + 2.0, torque_bias_Nm=TRUTH.torque_bias_Nm - 0.05)
    for seed in range(15):
        days = [solve(poses(TRUTH, R[:8], 2 * seed)), solve(poses(moved, R[8:], 2 * seed + 1))]
        both = together(days)
        e = error(both, moved)
        z2.append(e @ np.linalg.solve(both.covariance, e) / 15)
        sizes.append(both.sigma["mass_kg"])
        assert np.diag(both.covariance)[0] < min(np.diag(one.covariance)[0] for one in days)
    assert 0.6 < np.mean(z2) < 1.5
    other = replace(moved, p_sensor_com_m=TRUTH.p_sensor_com_m + np.array([0.002, 0, 0]))
    with pytest.raises(NotObservable, match="contradict each other"):
        together([solve(poses(TRUTH, R[:8], 1)), solve(poses(other, R[8:], 2))])
