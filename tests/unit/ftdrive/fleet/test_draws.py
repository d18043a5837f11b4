"""Datasets drawn from a result, against the noise model of the fit, and their solution."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ftcalib import CalibrationDataset, CalibrationResult
from ftcalib.errors import BadCalibration
from ftcalib.likelihood.gain_and_cross_talk import response_columns
from ftcalib.likelihood.session_noise import Noise
from ftcalib.model import jacobian, predict
from ftdrive.fleet.draws import ACCEPTED, DRAW, NOT_OBSERVABLE, REJECTED, drawn, solved_draws
from ftdrive.fleet.resolve import solved, task_of
from tests.calibrated_runs import calibrated_run, dataset, rewrite_dataset, white_run

DRAWS = 150
FORCE, TORQUE = np.repeat([1.0, 0.0], 3), np.repeat([0.0, 1.0], 3)
T_S = np.array([0.0, 4, 9, 11, 30, 37, 41, 60])


def result_of(tmp_path: Path, **changes: Any) -> CalibrationResult:
    found = CalibrationResult.load(calibrated_run(tmp_path, "run") / "calibration.json")
    return replace(found, components={}, **changes)


@pytest.mark.parametrize(
    "components",
    [
        {},
        {"white_force_N": 0.02, "white_torque_Nm": 0.001},
        {"rotation_rad": 0.002},
        {"walk_force_N": 0.05, "walk_ty_Nm": 0.002},
        {"slope_force_N": 0.1, "slope_tz_Nm": 0.005},
        {"gain": 0.01, "cross_talk": 0.02},
    ],
)
def test_drawn_readings_have_the_noise_model_of_the_fit(tmp_path: Path, components: dict[str, float]) -> None:
    """The pose that was rejected does not count, and the walk goes on meanwhile."""
    weights = np.ones(8)
    weights[3] = 0
    result = replace(result_of(tmp_path, weights=weights), components=components)
    shuffled = np.array([2, 0, 1, 3, 7, 6, 5, 4])  # the order of time counts, not that of the rows
    given = replace(dataset(1), t_s=T_S[np.argsort(shuffled)])
    in_time = shuffled[shuffled != 3]
    p, R, time = result.parameters, given.R_base_flange[in_time], given.t_s[in_time] * 7 / 60
    size = {name: components.get(name, 0.0) for name in ("rotation_rad", "gain", "cross_talk")}
    turn = jacobian(p, R)[..., :3]
    assert given.wrench_cov is not None
    D = given.wrench_cov[in_time] + size["rotation_rad"] ** 2 * turn @ np.swapaxes(turn, 1, 2)
    D += np.diag(
        components.get("white_force_N", 0.0) ** 2 * FORCE + components.get("white_torque_Nm", 0.0) ** 2 * TORQUE
    )
    walk = components.get("walk_force_N", 0.0) * FORCE + components.get("walk_ty_Nm", 0.0) * np.eye(6)[4]
    slope = components.get("slope_force_N", 0.0) * FORCE + components.get("slope_tz_Nm", 0.0) * np.eye(6)[5]
    effects = response_columns(p, R), np.repeat([size["gain"], size["cross_talk"]], [5, 6]) ** 2
    noise = Noise(D, time, walk, slope, effects if size["gain"] else None)

    rows = [list(np.flatnonzero(weights)).index(i) for i in in_time]
    chi2 = []
    for seed in range(DRAWS):
        found = drawn(given, result, np.random.default_rng(seed))
        assert len(found) == 7
        e = found.wrench[rows] - predict(p, R)
        chi2.append(float(np.vdot(e, noise.solve(e[..., None]))))
    dof = 42
    assert np.mean(chi2) == pytest.approx(dof, abs=6 * np.sqrt(2 * dof / DRAWS))
    assert np.var(chi2) == pytest.approx(2 * dof, rel=6 * np.sqrt((2 + 12 / dof) / DRAWS))


def test_unmeasured_noise_is_that_of_the_residuals(tmp_path: Path) -> None:
    given = replace(dataset(1), wrench_cov=None)
    for components, sigma in (
        ({"white_force_N": 0.1, "white_torque_Nm": 0.02}, [0.1, 0.02]),
        ({"white_force_N": 0.1}, [0.1, 0.0025]),  # of few poses
    ):
        result = replace(result_of(tmp_path / str(len(components))), components=components)
        draws = [drawn(given, result, np.random.default_rng(seed)) for seed in range(100)]
        e = np.array([one.wrench - predict(result.parameters, one.R_base_flange) for one in draws])
        assert all(one.wrench_cov is None for one in draws)
        spread = np.sqrt((e**2).mean(axis=(0, 1)).reshape(2, 3).mean(axis=1))
        assert spread == pytest.approx(sigma, rel=6 / np.sqrt(2 * 100 * 8 * 3))


def test_noise_that_is_not_stated_is_not_drawn(tmp_path: Path) -> None:
    exact, rng = replace(dataset(1), wrench_cov=None), np.random.default_rng(0)
    result = result_of(tmp_path)
    with pytest.raises(BadCalibration, match="states no noise"):
        drawn(exact, result, rng)
    with pytest.raises(BadCalibration, match="the component hysteresis_N, which this version does not know"):
        drawn(exact, replace(result, components={"hysteresis_N": 0.1}), rng)


def test_the_draws_do_not_depend_on_their_grouping(tmp_path: Path) -> None:
    folder = white_run(tmp_path, "run")
    data, task = task_of(folder)
    calibration = (folder / "calibration.json").read_bytes()
    all_at_once = solved_draws(data, calibration, task, 7, 0, 4)
    assert (
        solved_draws(data, calibration, task, 7, 0, 2) + solved_draws(data, calibration, task, 7, 2, 2) == all_at_once
    )
    draws, again = (np.frombuffer(one, DRAW) for one in (all_at_once, solved_draws(data, calibration, task, 8, 0, 4)))
    assert (draws["outcome"] == ACCEPTED).all()
    assert len({*draws["chi2"], *again["chi2"]}) == 8

    given, result = CalibrationDataset.from_dict(json.loads(data)), CalibrationResult.from_dict(json.loads(calibration))
    rewrite_dataset(folder, drawn(given, result, np.random.default_rng([7, 3])))
    third = CalibrationResult.from_dict(json.loads(solved(*task_of(folder))))
    assert result.parameters.moved(draws["error"][3][:15]).force_bias_N == pytest.approx(third.force_bias_N, abs=1e-9)
    assert draws["error"][3][15] == pytest.approx(third.mass_kg - result.mass_kg, abs=1e-12)
    assert draws["sigma"][3][:15] == pytest.approx(np.sqrt(np.diag(third.covariance)))
    assert draws["sigma"][3][15] == pytest.approx(third.sigma["mass_kg"], rel=1e-3)  # with a small common gain
    z = draws["error"][3][:15]
    assert draws["chi2"][3] == pytest.approx(z @ np.linalg.solve(third.covariance, z), rel=1e-6)


def test_draws_that_give_no_result_are_counted(tmp_path: Path) -> None:
    folder = white_run(tmp_path, "run")
    data, task = task_of(folder)
    result = CalibrationResult.load(folder / "calibration.json")
    few = replace(result, weights=np.repeat([1.0, 0.0], [3, 5]))
    noisy = replace(result, components={"white_force_N": 5.0, "white_torque_Nm": 0.5})
    for one, outcome in ((few, NOT_OBSERVABLE), (noisy, REJECTED)):
        document = json.dumps(one.to_dict()).encode()
        draws = np.frombuffer(solved_draws(data, document, task, 0, 0, 1), DRAW)
        assert draws["outcome"].tolist() == [outcome]
