"""A new tool from four poses, and runs with a moved bias as one fit."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from ftcalib import CalibrationDataset, CalibrationResult, solve
from ftcalib.after.new_tool import new_tool, together
from ftcalib.errors import NotObservable
from ftcalib.model import Array, Parameters, predict
from tests.first_order import assert_same, propagated
from tests.unit.ftdrive.stream.simulated import NOISE, TRUTH, calibrated

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


def test_a_turned_sensor_and_a_leaning_base_are_named() -> None:
    turn = Rotation.from_rotvec([0.0, 0.0, 1.0], degrees=True).as_matrix()
    with pytest.raises(NotObservable, match=r"the mounting of the sensor has changed.*, by (0.9|1|1.1)"):
        new_tool(calibrated(), poses(replace(OTHER, R_flange_sensor=turn @ TRUTH.R_flange_sensor), FOUR, 1))
    lean = Rotation.from_rotvec([2.0, 0.0, 0.0], degrees=True).as_matrix()
    with pytest.raises(NotObservable, match="the base has tilted"):
        new_tool(calibrated(), poses(replace(OTHER, gravity_force_base_N=lean @ OTHER.gravity_force_base_N), FOUR, 1))
    touched = poses(OTHER, FOUR, 1)
    wrench = touched.wrench.copy()
    wrench[1] += [3.0, -2.0, 1.0, 0.3, 0.0, 0.2]
    with pytest.raises(NotObservable, match=r"check for contact|otherwise"):
        new_tool(calibrated(), replace(touched, wrench=wrench))


def read_by(matrix: Array, truth: Parameters, R: Array, seed: int) -> CalibrationDataset:
    """Readings of a sensor whose own matrix is off by so much."""
    dataset = poses(truth, R, seed)
    weight = predict(replace(truth, force_bias_N=np.zeros(3), torque_bias_Nm=np.zeros(3)), R)
    return replace(dataset, wrench=dataset.wrench + weight @ matrix.T)


@pytest.mark.parametrize("seed", [0, pytest.param(1, marks=pytest.mark.slow), pytest.param(2, marks=pytest.mark.slow)])
def test_errors_of_the_sensor_are_no_contact_and_hide_no_turn(seed: int) -> None:
    rng = np.random.default_rng(seed)
    levers = np.array([1.0, 0.05])
    scale = np.kron(levers[:, None] / levers, np.ones((3, 3)))
    matrix = scale * np.where(np.eye(6) > 0, 0.012, 0.006) * rng.normal(size=(6, 6))
    R = Rotation.random(24, rng=rng).as_matrix()
    earlier = solve(read_by(matrix, TRUTH, R, seed))
    result = new_tool(earlier, read_by(matrix, OTHER, FOUR, seed))
    assert abs(error(result, OTHER)[9:12]).max() < 4 * result.sigma["p_sensor_com_m"].max()  # type: ignore[union-attr]
    turn = Rotation.from_rotvec([1.0, 0.0, 0.0], degrees=True).as_matrix()
    turned = replace(OTHER, R_flange_sensor=TRUTH.R_flange_sensor @ turn)
    with pytest.raises(NotObservable, match="the mounting of the sensor has changed"):
        new_tool(earlier, read_by(matrix, turned, FOUR, seed))


def test_poses_without_noise_are_refused() -> None:
    with pytest.raises(NotObservable, match="noise of the poses was not measured"):
        new_tool(calibrated(), CalibrationDataset.of(FOUR, predict(OTHER, FOUR)))


@pytest.mark.slow
def test_two_days_with_a_moved_bias_are_one_fit() -> None:
    R = Rotation.random(16, rng=np.random.default_rng(5)).as_matrix()
    moved = replace(TRUTH, force_bias_N=TRUTH.force_bias_N + 2.0, torque_bias_Nm=TRUTH.torque_bias_Nm - 0.05)
    days = [solve(poses(TRUTH, R[:8], 0)), solve(poses(moved, R[8:], 1))]
    both = together(days)
    e = error(both, moved)
    assert abs(e @ np.linalg.solve(both.covariance, e) / 15 - 1) < 3 * np.sqrt(2 / 15)
    assert np.diag(both.covariance)[0] < min(np.diag(one.covariance)[0] for one in days)
    other = replace(moved, p_sensor_com_m=TRUTH.p_sensor_com_m + np.array([0.002, 0, 0]))
    with pytest.raises(NotObservable, match="contradict each other"):
        together([days[0], solve(poses(other, R[8:], 2))])


def test_the_covariance_of_runs_together_is_that_of_first_order() -> None:
    rng = np.random.default_rng(11)
    runs = []
    for k in range(3):
        root = np.diag(np.repeat([3e-3, 0.03, 0.02, 1e-3, 1e-3], 3)) @ (np.eye(15) + 0.4 * rng.normal(size=(15, 15)))
        bias = replace(TRUTH, force_bias_N=TRUTH.force_bias_N + k)
        runs.append(replace(calibrated(8), parameters=bias, covariance=root @ root.T, response=None))

    def joined(k: int, e: Array) -> Array:
        moved = [replace(one, parameters=one.parameters.moved(e)) if i == k else one for i, one in enumerate(runs)]
        return np.asarray(runs[-1].parameters.difference(together(moved).parameters))

    found = together(runs)
    np.testing.assert_allclose(runs[-1].parameters.difference(found.parameters), 0, atol=1e-12)
    assert (found.provenance["between_chi2"], found.provenance["between_dof"]) == (pytest.approx(0), 18)
    expected = sum(propagated(lambda e, k=k: joined(k, e), runs[k].covariance) for k in range(3))  # type: ignore[misc]
    assert_same(found.covariance, np.asarray(expected))
    shifted = runs[0].parameters.moved(0.5 * np.sqrt(np.diag(runs[0].covariance)))
    off = runs[0].parameters.difference(shifted)[[0, 1, 2, 3, 4, 5, 9, 10, 11]]
    two = [replace(runs[0], parameters=shifted), replace(runs[0], parameters=runs[0].parameters)]
    shared = np.ix_([0, 1, 2, 3, 4, 5, 9, 10, 11], [0, 1, 2, 3, 4, 5, 9, 10, 11])
    chi2 = off @ np.linalg.solve(2 * runs[0].covariance[shared], off)  # of a difference
    assert together(two).provenance["between_chi2"] == pytest.approx(chi2)


def test_runs_that_cannot_be_joined_are_refused() -> None:
    one = replace(calibrated(8), response=None)
    covariance = one.covariance.copy()
    covariance[0], covariance[:, 0] = 0.0, 0.0
    with pytest.raises(NotObservable, match="has exactly known values"):
        together([one, replace(one, covariance=covariance)])


def test_poses_that_do_not_show_a_tool_are_refused() -> None:
    with pytest.raises(NotObservable, match="do not determine the tool"):
        new_tool(calibrated(), poses(OTHER, np.tile(FOUR[:1], (4, 1, 1)), 0))
    nothing = replace(OTHER, gravity_force_base_N=1e-4 * TRUTH.gravity_force_base_N)
    with pytest.raises(NotObservable, match=r"the tool weighs .* N \(sigma .* N\), too little"):
        new_tool(calibrated(), poses(nothing, FOUR, 0))
