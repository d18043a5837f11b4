"""A change in mid-session is found, named, and refused where poses of both kinds were used."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from ftcalib import CalibrationDataset, CalibrationResult, solve
from ftcalib.judge.faults import rough_fit
from ftcalib.judge.session_change import KINDS, SessionChange, _likeliest_change
from ftcalib.judge.verdict import Case, statistics
from ftcalib.likelihood.fit import fit
from ftcalib.likelihood.session import LEVER_M
from ftcalib.model import Parameters, SPECIAL_R_flange_base, predict
from ftcalib.solver import _find_change
from tests.structured_cell import CELLS, Cell, flange, tour

Array = NDArray[np.float64]

ORIENTATIONS = np.swapaxes(SPECIAL_R_flange_base, 1, 2)[np.random.default_rng(0).permutation(24)]
SIGMA = np.repeat([0.002, 1e-4], 3)
TOOL = Parameters(
    R_flange_sensor=Rotation.from_euler("z", 30, degrees=True).as_matrix(),
    gravity_force_base_N=np.array([0.1, -0.2, -12.0]),
    force_bias_N=np.array([3.0, -2.0, 5.0]),
    p_sensor_com_m=np.array([0.004, -0.003, 0.06]),
    torque_bias_Nm=np.array([0.2, 0.1, -0.3]),
)
SHIFTED = replace(TOOL, p_sensor_com_m=TOOL.p_sensor_com_m + np.array([0.001, 0.002, 0]))
LIGHTER = replace(TOOL, gravity_force_base_N=0.97 * TOOL.gravity_force_base_N)
TARED = replace(TOOL, force_bias_N=TOOL.force_bias_N - 0.3)


def turned(parameters: Parameters, angle_deg: float) -> Parameters:
    turn = Rotation.from_rotvec([0, 0, angle_deg], degrees=True).as_matrix()
    com = turn.T @ parameters.p_sensor_com_m
    return replace(parameters, R_flange_sensor=parameters.R_flange_sensor @ turn, p_sensor_com_m=com)


TURNED = turned(TOOL, 5)
OTHER = replace(turned(TOOL, 70), force_bias_N=np.array([-1.0, 2.0, 1.0]))


def session(
    after: Parameters,
    which: int | slice,
    seed: int,
    rows: NDArray[np.int64] | None = None,
    *,
    added: Array | float = 0.0,
    measured: bool = True,
) -> CalibrationResult:
    """24 poses, the later ones of another tool; `rows`: the pose in each row of the dataset."""
    which = slice(which, None) if isinstance(which, int) else which
    wrench = predict(TOOL, ORIENTATIONS) + added
    wrench[which] += predict(after, ORIENTATIONS[which]) - predict(TOOL, ORIENTATIONS[which])
    wrench += np.random.default_rng(seed).normal(0, SIGMA, wrench.shape)
    order = np.arange(24) if rows is None else rows
    dataset = CalibrationDataset(
        R_base_flange=ORIENTATIONS[order],
        wrench=wrench[order],
        wrench_cov=np.broadcast_to(np.diag(SIGMA**2), (24, 6, 6)) if measured else None,
        n_samples=np.full(24, 200),
        t_s=np.arange(24.0)[order] * 3,
    )
    return solve(dataset)


def sigmas(result: CalibrationResult, truth: Parameters) -> Array:
    return np.asarray(result.parameters.difference(truth) / np.sqrt(np.diag(result.covariance)))


@pytest.mark.slow
def test_poses_of_two_loads_are_refused() -> None:
    result = session(LIGHTER, 21, seed=21)
    first = result.findings[0]
    assert (result.verdict, first.code, first.values["pose"]) == ("rejected", "load_changed", 22)
    assert first.values["change_N"] == pytest.approx(-0.36, abs=0.01)


@pytest.mark.slow
def test_poses_count_as_they_were_taken_not_as_they_stand() -> None:
    rows = np.random.default_rng(3).permutation(24)
    result = session(LIGHTER, 12, seed=2, rows=rows)
    assert result.verdict == "rejected"
    assert result.findings[0].values["pose"] == np.flatnonzero(rows == 12)[0] + 1


@pytest.mark.slow
@pytest.mark.parametrize(("after", "code"), [(TARED, "bias_stepped"), (OTHER, "sensor_changed")])
def test_other_changes_are_named_before_the_drift_that_they_look_like(after: Parameters, code: str) -> None:
    result = session(after, 13, seed=4, measured=False)
    first = result.findings[0]
    assert (first.code, first.values["pose"]) == (code, 14)
    assert (result.verdict == "rejected") == (code != "bias_stepped")


@pytest.mark.slow
def test_a_tool_that_turns_with_its_sensor_is_named_with_its_angle() -> None:
    axis = np.random.default_rng(0).normal(size=3)
    turn = Rotation.from_rotvec(axis / np.linalg.norm(axis), degrees=True).as_matrix()
    after = replace(TOOL, R_flange_sensor=TOOL.R_flange_sensor @ turn)
    first = session(after, 9, 0).findings[0]
    assert (first.code, first.severity, first.values["pose"]) == ("sensor_turned", "reject", 10)
    assert first.values["turn_deg"] == pytest.approx(1.0, abs=0.05)


@pytest.mark.slow
def test_rows_of_two_sensors_are_named() -> None:
    assert session(OTHER, slice(1, None, 2), seed=1).findings[0].code == "sensors_alternate"


@pytest.mark.slow
def test_a_run_that_was_tared_is_not_refused() -> None:
    result = session(TARED, 12, seed=0)
    assert result.verdict == "usable"
    sure = [0, 1, 2, 3, 4, 5, 9, 10, 11]  # the bias is that of no single moment
    assert np.abs(sigmas(result, TOOL)[sure]).max() < 4.5


@pytest.mark.slow
def test_a_random_walk_is_no_step() -> None:
    walk = np.cumsum(10 * SIGMA * np.random.default_rng(1).normal(size=(24, 6)), axis=0)
    found = {one.code for one in session(TOOL, 12, 1, added=walk, measured=False).findings}
    assert not found & {"bias_stepped", "com_shifted", "load_changed", "sensor_turned", "sensor_changed"}


COUNT = np.arange(24)
STEP_N = np.array([0.2, 0, 0.1])
STEPPED = replace(TOOL, force_bias_N=TOOL.force_bias_N + STEP_N, torque_bias_Nm=TOOL.torque_bias_Nm - 0.01)
TOUCHED = replace(OTHER, torque_bias_Nm=TOOL.torque_bias_Nm + np.array([0.03, 0, 0.04]))


@pytest.mark.parametrize(
    ("rows", "measured"), [(COUNT >= 3, True), (COUNT >= 10, False), (COUNT >= 21, True), (COUNT % 2 == 1, False)]
)
@pytest.mark.parametrize(
    ("after", "code", "values"),
    [
        (STEPPED, "bias_stepped", {"force_N": np.sqrt(0.05), "torque_Nm": np.sqrt(3e-4)}),
        (SHIFTED, "com_shifted", {"shift_mm": np.sqrt(5.0)}),
        (LIGHTER, "load_changed", {"change_N": -0.03 * np.linalg.norm(TOOL.gravity_force_base_N)}),
        (TURNED, "sensor_turned", {"turn_deg": 5.0}),
        (TOUCHED, "sensor_changed", {"turn_deg": 70.0, "force_N": np.sqrt(48.0), "torque_Nm": 0.05}),
    ],
)
def test_a_change_is_as_large_as_it_is_and_can_be_undone(
    after: Parameters, code: str, values: dict[str, float], rows: NDArray[np.bool_], measured: bool
) -> None:
    wrench = np.where(rows[:, None], predict(after, ORIENTATIONS), predict(TOOL, ORIENTATIONS))
    wrench += 0.01 * np.random.default_rng(5).normal(0, SIGMA, wrench.shape)
    scale = SIGMA if measured else np.repeat([1.0, LEVER_M], 3)
    change = _likeliest_change(rough_fit(ORIENTATIONS, wrench), ORIENTATIONS, wrench, scale)
    assert change is not None
    assert (change.code, change.takes_turns) == (code, not rows[22])
    assert change.starts[0] == np.flatnonzero(rows)[0]
    assert {name: change.values[name] for name in values} == pytest.approx(values, rel=0.02)
    left = change.corrected - predict(rough_fit(ORIENTATIONS, change.corrected), ORIENTATIONS)
    assert np.sqrt(np.mean((left / SIGMA) ** 2)) < 0.1
    if measured:
        assert change.misfit < 1e-3


def zeroed(places: list[int], seed: int, n: int = 24) -> CalibrationResult:
    """A tour in which the sensor was zeroed before some rows, each time in another orientation."""
    rng = np.random.default_rng(seed)
    R = np.asarray(Rotation.random(n, rng=rng).as_matrix())
    wrench = predict(TOOL, R) + rng.normal(0, SIGMA, (n, 6))
    for place in places:
        wrench[place:] = predict(TOOL, R[place:]) - predict(TOOL, Rotation.random(1, rng=rng).as_matrix())
        wrench[place:] += rng.normal(0, SIGMA, (n - place, 6))
    return solve(CalibrationDataset.of(R, wrench, t_s=np.arange(float(n))))


@pytest.mark.slow
def test_every_zeroing_is_named_with_its_pose_and_nothing_that_it_explains() -> None:
    result = zeroed([4, 9], 5, 12)
    assert result.verdict != "good"
    assert result.findings[0].code == "bias_stepped"
    assert result.findings[0].values["pose"] == [5, 10]
    assert "zeroed" in result.findings[0].words
    assert not {"drift", "force_error", "residuals_alike"} & {one.code for one in result.findings}


@pytest.mark.slow
def test_a_sensor_that_warms_up_is_not_zeroed() -> None:
    cooling = 0.6 * np.exp(-np.arange(24) / 8)[:, None] * np.repeat([1.0, 0.025], 3)
    found = {one.code for one in session(TOOL, 12, 0, added=cooling, measured=False).findings}
    assert "bias_stepped" not in found


def all_disturbances(seed: int, turn_deg: float) -> CalibrationResult:
    """A tour of a cell with errors of every structure, whose sensor and tool turn on the flange in its middle."""
    rng = np.random.default_rng([seed, 21])
    cell, after = Cell([seed], CELLS["all"]), Cell([seed], CELLS["all"])
    axis = rng.normal(size=3)
    turn = Rotation.from_rotvec(turn_deg * axis / np.linalg.norm(axis), degrees=True).as_matrix()
    after.R_flange_sensor = cell.R_flange_sensor @ turn
    q, first = tour(np.random.default_rng([seed, 1]), 24, "whole"), int(rng.integers(8, 17))
    t_s, samples = cell.dwells(q, 0.0)
    samples[first:] = after.dwells(q, 0.0)[1][first:]
    return solve(CalibrationDataset.of(flange(q), samples.mean(axis=1), t_s=t_s))


@pytest.mark.slow
@pytest.mark.parametrize("seed", [3005, *(pytest.param(k, marks=pytest.mark.slow) for k in (3006, 3012))])
def test_a_turn_by_a_degree_is_named_beside_errors_that_have_a_structure(seed: int) -> None:
    first = all_disturbances(seed, 1.0).findings[0]
    assert (first.code, first.severity) == ("sensor_turned", "reject")
    assert first.values["turn_deg"] == pytest.approx(1.0, abs=0.6)


@pytest.mark.slow
@pytest.mark.parametrize("seed", [4005, *(pytest.param(k, marks=pytest.mark.slow) for k in (4008, 4009))])
def test_errors_that_have_a_structure_are_no_change(seed: int) -> None:
    named = {one.code for one in all_disturbances(seed, 0.0).findings}
    assert not named & {*KINDS, "sensors_alternate"}


@pytest.mark.slow
def test_a_change_is_named_from_some_of_many_poses(monkeypatch: pytest.MonkeyPatch) -> None:
    n, looked_at, sizes = 1800, 150, list[int]()

    def counted(parameters: Parameters, R: Array, wrench: Array, scale: Array) -> SessionChange | None:
        sizes.append(len(R))
        return _likeliest_change(parameters, R, wrench, scale)

    monkeypatch.setattr("ftcalib.judge.session_change._likeliest_change", counted)
    R = Rotation.random(n, rng=3).as_matrix()
    wrench = predict(TOOL, R) + np.random.default_rng(4).normal(0, SIGMA, (n, 6))
    wrench[n // 2 :] += predict(TARED, R[n // 2 :]) - predict(TOOL, R[n // 2 :])
    case = Case(fit(R, wrench, np.diag(SIGMA**2)))
    (finding,) = _find_change(case, statistics(case), SIGMA)
    assert finding.code == "bias_stepped"
    assert abs(finding.values["pose"] - n // 2) <= n // looked_at + 1
    assert set(sizes) == {looked_at}
