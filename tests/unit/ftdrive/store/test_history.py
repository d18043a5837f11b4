"""What the history says of simulated months: drifts with their significance, ages, failures and temperatures."""

from datetime import timedelta
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ftcalib.model import BIASES, Array
from ftdrive.runs.verification import VerificationRecord
from ftdrive.store.history import drifts, warnings
from ftdrive.store.records import StoredResult, read_records, record_paths
from ftdrive.store.trends import QuantityTrend, sensor_biases
from ftdrive.words.history import temperature_lines
from tests.unit.ftdrive.store.run_folders import FIRST, new_run, result, verified
from tests.unit.ftdrive.stream.simulated import calibrated


def records(folder: Path) -> tuple[list[StoredResult], list[VerificationRecord]]:
    found, unreadable = read_records(record_paths([folder]))
    assert unreadable == ()
    return [one for one in found if isinstance(one, StoredResult)], [
        one for one in found if isinstance(one, VerificationRecord)
    ]


def months(folder: Path, rate: Array, n: int = 6, scatter: float = 0.0, **about: Any) -> list[StoredResult]:
    """Monthly results of a sensor whose numbers change by `rate` (15,) sigmas a month; noise as stated, and scatter."""
    sigma = np.sqrt(np.diag(calibrated().covariance))
    rng = np.random.default_rng(3)
    for month in range(n):
        noise = rng.multivariate_normal(np.zeros(15), calibrated().covariance)
        step = noise + sigma * (month * rate + scatter * rng.normal(size=15))
        new_run(folder, f"{month:02d}", result(30 * month, step, **about))
    return records(folder)[0]


def significant(found: list[QuantityTrend]) -> dict[str, bool]:
    return {drift.quantity: drift.is_significant for drift in found}


def test_scatter_that_no_covariance_knows_is_no_trend(tmp_path: Path) -> None:
    """As of a sensor that is tared by hand each time: every result is far from the others, in no direction."""
    assert not any(significant(drifts(months(tmp_path, np.zeros(15), scatter=50.0))).values())


def test_a_drift_of_the_bias_is_found_and_only_that(tmp_path: Path) -> None:
    sigma = np.sqrt(np.diag(calibrated().covariance))
    rate = np.zeros(15)
    rate[6] = 5.0
    found = drifts(months(tmp_path, rate))
    assert significant(found) == {"force bias": True, "torque bias": False, "centre of mass": False, "mass": False}
    force = found[0].trend
    assert (force.slope - [5 * sigma[6], 0, 0]) / force.sigma == pytest.approx(np.zeros(3), abs=6)
    assert "gripper, force bias: +" in str(found[0])
    assert "N per 30 days (1 sigma, 6 results), significant (p = " in str(found[0])
    assert found[0].to_dict()["significant"] is True


def test_tools_sensors_and_mounts_are_not_mixed(tmp_path: Path) -> None:
    """Two results of each are too few, although eight are there."""
    abouts: tuple[dict[str, Any], ...] = ({}, {"tool": "drill"}, {"mount": "b"}, {"serials": ("arm-1", "ft-2")})
    results = [one for i, about in enumerate(abouts) for one in months(tmp_path / str(i), np.zeros(15), 2, **about)]
    assert drifts(results) == []


def test_a_copied_or_known_value_is_no_point_of_a_trend(tmp_path: Path) -> None:
    """Updates of the bias keep mass and centre of mass: only three results have estimated these."""
    results = months(tmp_path, np.zeros(15), 5)
    for later in (3, 4):
        numbers = {**results[later].numbers, "p_sensor_com_m": results[2].numbers["p_sensor_com_m"]}
        results[later] = StoredResult(
            **{
                **{name: getattr(results[later], name) for name in StoredResult.__slots__},
                "numbers": numbers,
                "mass_kg": results[2].mass_kg,
            }
        )
    assert {drift.quantity: drift.trend.n for drift in drifts(results)} == {
        "force bias": 5,
        "torque bias": 5,
        "centre of mass": 3,
        "mass": 3,
    }


def test_an_old_calibration_should_be_verified_unless_it_was(tmp_path: Path) -> None:
    new_run(tmp_path, "a", result(0))
    results, _ = records(tmp_path)
    assert list(warnings(results, [], FIRST + timedelta(days=29))) == []
    (words,) = warnings(results, [], FIRST + timedelta(days=45))
    assert "neither made nor verified in the last 45 days: verify it" in words
    verified(tmp_path / "a", results[0].id, 40)
    assert list(warnings(*records(tmp_path), FIRST + timedelta(days=45))) == []


def test_a_failed_verification_counts_until_the_next_calibration(tmp_path: Path) -> None:
    new_run(tmp_path, "a", result(0))
    verified(tmp_path / "a", result(0).id, 1, passed=False)
    (words,) = warnings(*records(tmp_path), FIRST + timedelta(days=2))
    assert "failed its last verification (the force bias has changed by 0.5 N): calibrate again" in words
    new_run(tmp_path, "b", result(1.5))
    assert list(warnings(*records(tmp_path), FIRST + timedelta(days=2))) == []


@pytest.mark.parametrize(("now_C", "words"), [(35.0, "14 K warmer"), (12.0, "9 K"), (8.0, "13 K colder")])
def test_another_temperature_is_named(tmp_path: Path, now_C: float, words: str) -> None:
    new_run(tmp_path, "a", result(0, temperature_C=21.0))
    verified(tmp_path / "a", result(0).id, 1, temperature_C=now_C)
    found = list(warnings(*records(tmp_path), FIRST + timedelta(days=2)))
    assert [words in one for one in found] == ([True] if abs(now_C - 21) > 10 else [])


def test_the_temperature_of_a_sensor_is_fitted_over_calibrations_and_verifications(tmp_path: Path) -> None:
    slope = np.array([0.3, 0, -0.2, 0, 0.005, 0])
    rng = np.random.default_rng(4)
    first = result(0, np.zeros(15), temperature_C=25.0)
    folder = new_run(tmp_path, "first", first)
    for day, T in enumerate([22.0, 34.0, 28.0, 31.0, 24.0, 36.0], start=1):
        change = (T - 25) * slope + rng.normal(size=6) * 0.01 * np.repeat([1, 0.03], 3)
        values = {"value": change.tolist(), "sigma": [0.01] * 3 + [3e-4] * 3, "calibration_sigma": [1e-3] * 6}
        verified(new_run(tmp_path, f"check-{day}"), first.id, day, temperature_C=T, bias_change=values)
    step = np.zeros(15)
    step[BIASES] = 10 * slope
    new_run(tmp_path, "warm", result(8, step, temperature_C=35.0))
    verified(folder, "of no known calibration", 9, temperature_C=60.0)
    ((mounted, (fit, _)),) = sensor_biases(*records(tmp_path)).items()
    assert mounted == ("ft-1", "arm-1", None)
    assert fit is not None
    assert (fit.n, fit.coldest_C, fit.warmest_C) == (8, 22.0, 36.0)
    assert np.abs((fit.slope - slope) / fit.sigma).max() < 4
    assert fit.predicts == (True, True)
    force, torque = temperature_lines("ft-1", fit)
    assert "temperature, ft-1, force bias: +0." in force
    assert force.endswith("applied by --tool")
    assert "N·m/K (1 sigma, 8 runs, 22 to 36 °C)" in torque


def test_runs_within_hours_show_how_far_the_bias_moves(tmp_path: Path) -> None:
    """A random walk of 0.2 N and 6 mN·m in the root of an hour; one cable was moved, and a month passed."""
    rng = np.random.default_rng(11)
    first, sigma = result(0, np.zeros(15)), np.repeat([0.2, 0.006], 3)
    new_run(tmp_path, "first", first)
    change, day = np.zeros(6), 0.0
    for k, hours in enumerate([2.0, 0.5, 1.0, 30 * 24, 3.0, 1.0, 0.1, 2.0, 4.0, 1.0, 2.0, 0.5]):
        day += hours / 24
        change = change + np.sqrt(hours) * sigma * rng.normal(size=6) + (2.0 if k == 5 else 0.0)
        values = {"value": change.tolist(), "sigma": [0.01] * 3 + [3e-4] * 3, "calibration_sigma": [1e-3] * 6}
        verified(new_run(tmp_path, f"check-{k}"), first.id, day, bias_change=values)
    ((_, (_, found)),) = sensor_biases(*records(tmp_path)).items()
    assert found is not None
    assert ((found > 0.6 * sigma) & (found < 1.6 * sigma)).all()
    assert sensor_biases(records(tmp_path)[0], []) == {("ft-1", "arm-1", None): (None, None)}
