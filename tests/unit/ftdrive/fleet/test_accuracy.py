"""Scatter of simulated calibrations against stated sigmas."""

import json
from collections.abc import Callable, Iterator
from concurrent.futures import BrokenExecutor, Future
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ftcalib import CalibrationResult, Parameters
from ftdrive.fleet.accuracy import BLOCK, Accuracy, accuracy_of, compared
from ftdrive.fleet.draws import ACCEPTED, DRAW, NOT_OBSERVABLE, REJECTED, stated_sigma
from ftdrive.fleet.workers import Answer, OtherVersion, Workers
from tests.calibrated_runs import calibrated_run, dataset, rewrite_dataset, white_run
from tests.edited_files import edit


def at_once(function: Callable[..., list[Answer]], *arguments: Any) -> "Future[list[Answer]]":
    future = Future[list[Answer]]()
    future.set_result(function(*arguments))
    return future


PARAMETERS = [one.name for one in fields(Parameters)]
HERE = Workers(1, at_once, BrokenExecutor, group=8)


def simulated(result: CalibrationResult, outcomes: list[int]) -> Any:
    """Errors with the stated covariance, for the accepted draws; large ones for the others."""
    rng = np.random.default_rng(1)
    draws = np.zeros(len(outcomes), DRAW)
    e = rng.multivariate_normal(np.zeros(15), result.covariance, len(outcomes), method="cholesky")
    draws["outcome"], draws["sigma"] = outcomes, stated_sigma(result)
    F = result.gravity_force_base_N
    draws["error"] = np.column_stack([e, e[:, 3:6] @ F / np.linalg.norm(F) / result.g_m_s2])
    draws["chi2"] = np.einsum("ni,ij,nj->n", e, np.linalg.inv(result.covariance), e)
    draws["error"][np.array(outcomes) != ACCEPTED] = 1e9
    return draws


def test_scatter_is_compared_with_the_stated_sigma(tmp_path: Path) -> None:
    result = CalibrationResult.load(calibrated_run(tmp_path, "run") / "calibration.json")
    found = compared(result, simulated(result, [ACCEPTED] * 1000 + [REJECTED, REJECTED, NOT_OBSERVABLE]))
    assert (found.poses, found.draws, found.rejected, found.not_observable) == (8, 1003, 2, 1)
    assert found.components == result.components
    assert found.chi2_per_dof == pytest.approx(1, abs=6 * np.sqrt(2 / 15 / 1000))
    assert [one.name for one in found.groups] == [*PARAMETERS, "mass_kg"]
    for one in found.groups:
        stated = np.sqrt(np.mean(np.square(result.sigma[one.name])))
        assert one.stated == pytest.approx(stated, rel=1e-3)
        assert one.ratio == pytest.approx(1, abs=6 * one.ratio_sigma)
        assert 0.01 < one.ratio_sigma < 0.03  # between that of 3000 independent errors, 0.013, and of 1000
        assert one.inside == pytest.approx(0.95, abs=6 * np.sqrt(0.95 * 0.05 / 1000))
        assert one.holds


@pytest.mark.parametrize(("factor", "draws", "holds"), [(1 / 3, 40, False), (1.5, 200, False), (1.08, 20000, True)])
def test_a_sigma_that_does_not_hold_is_found_if_it_matters(
    tmp_path: Path, factor: float, draws: int, holds: bool
) -> None:
    """A difference of 8 % is significant with 20000 draws, but of no importance."""
    result = CalibrationResult.load(calibrated_run(tmp_path, "run") / "calibration.json")
    found = compared(replace(result, covariance=result.covariance * factor**2), simulated(result, [ACCEPTED] * draws))
    assert [one.holds for one in found.groups] == [holds] * 6
    for one in found.groups:
        assert abs(one.ratio - 1) > 4 * one.ratio_sigma
        assert one.ratio == pytest.approx(1 / factor, abs=6 * one.ratio_sigma)


def test_few_accepted_draws_show_nothing(tmp_path: Path) -> None:
    result = CalibrationResult.load(calibrated_run(tmp_path, "run") / "calibration.json")
    found = compared(result, simulated(result, [ACCEPTED] * 19 + [REJECTED]))
    assert (found.groups, found.chi2_per_dof, found.rejected) == ((), None, 1)


def test_blocks_may_come_in_any_order(tmp_path: Path) -> None:
    folder, shown = white_run(tmp_path, "run"), list[tuple[int, Answer]]()

    def show(found: Iterator[tuple[int, Answer]]) -> list[tuple[int, Answer]]:
        shown.extend(sorted(found, key=lambda one: -one[0]))
        return shown

    found = accuracy_of(folder, HERE, draws=BLOCK + 11, seed=3)
    assert isinstance(found, Accuracy)
    assert found.draws == BLOCK + 11
    assert accuracy_of(folder, HERE, draws=BLOCK + 11, seed=3, show=show) == found
    assert [first for first, _ in shown] == [2 * BLOCK, BLOCK, 0]


def test_a_failure_has_its_reason(tmp_path: Path) -> None:
    other = white_run(tmp_path, "other")
    rewrite_dataset(other, dataset(2))
    assert "calibration.json is not of the poses in dataset.json" in str(accuracy_of(other, HERE))
    damaged = white_run(tmp_path, "damaged")
    (damaged / "dataset.json").write_text('{"format": "ftdrive.data')
    assert "not valid JSON" in str(accuracy_of(damaged, HERE))
    folder = white_run(tmp_path, "run")
    path = folder / "calibration.json"
    document = json.loads(path.read_text())
    edit(path, lambda found: found.update(components={"hysteresis_N": 1.0}))
    assert "this version does not know" in str(accuracy_of(folder, HERE, draws=20))
    covariance = np.array(document["covariance"])
    covariance[:3] = covariance[:, :3] = 0.0
    edit(path, lambda found: found.update(covariance=covariance.tolist(), components=document["components"]))
    assert "exactly known values" in str(accuracy_of(folder, HERE, draws=20))
    path.write_text(json.dumps(document))

    def other_version(*_: object) -> "Future[list[Answer]]":
        return at_once(lambda: [OtherVersion("a worker has ftdrive 0.0.1")])

    with pytest.raises(OtherVersion, match=r"0\.0\.1"):
        accuracy_of(folder, Workers(1, other_version, BrokenExecutor), draws=20)


@pytest.mark.slow
def test_an_honest_result_holds_and_one_that_is_not_is_found(tmp_path: Path) -> None:
    folder = white_run(tmp_path, "run", poses=12)
    check_honest(accuracy_of(folder, HERE, draws=150), 150)

    path = folder / "calibration.json"
    result = CalibrationResult.load(path)
    path.unlink()
    replace(result, covariance=result.covariance / 9).save(path)
    found = accuracy_of(folder, HERE, draws=40)
    assert isinstance(found, Accuracy)
    assert not any(one.holds for one in found.groups)
    for one in found.groups:
        assert one.ratio == pytest.approx(3, abs=6 * one.ratio_sigma)


@pytest.mark.slow
def test_a_drift_that_the_result_states_is_drawn(tmp_path: Path) -> None:
    found = accuracy_of(calibrated_run(tmp_path, "run"), HERE, draws=30)
    check_honest(found, 30)
    assert isinstance(found, Accuracy)
    assert [*found.components] == ["walk_force_N"]


def check_honest(found: Accuracy | str, draws: int) -> None:
    """Errors of one calibration depend on one another, so a share has fewer independent values than it counts."""
    assert isinstance(found, Accuracy)
    assert found.rejected == found.not_observable == 0
    assert found.chi2_per_dof == pytest.approx(1, abs=6 * np.sqrt(2 / 15 / draws))
    for one in found.groups:
        assert one.ratio == pytest.approx(1, abs=6 * one.ratio_sigma)
        assert one.inside == pytest.approx(0.95, abs=6 * np.sqrt(0.95 * 0.05 / draws))
        assert one.holds
