"""The bias against temperature: what the fit finds, what it takes for chance, and what it applies."""

from dataclasses import replace

import numpy as np
import pytest

from ftcalib.after.series import BiasTemperature, bias_temperature
from ftcalib.after.state import with_bias_change
from ftcalib.model import BIASES, Array
from ftcalib.sensor_matrix import Response
from tests.unit.ftdrive.stream.simulated import calibrated

ONES = np.repeat([1.0, 0.03], 3)
SLOPE = 0.1 * ONES
NOISE = 0.02 * ONES


def fitted(seed: int, slope: Array, n: int = 12, scatter: float = 0.1, walk: float = 0.3) -> BiasTemperature:
    """Runs of two months in a room of 20 to 36 °C, whose bias also scatters and walks."""
    rng = np.random.default_rng([seed, n])
    t_days, T = np.sort(rng.uniform(0, 60, n)), rng.uniform(20, 36, n)
    steps = rng.normal(size=(n, 6)) * np.sqrt(np.diff(t_days, prepend=0) / 60)[:, None] * walk
    bias = (np.cumsum(steps, axis=0) + scatter * rng.normal(size=(n, 6))) * ONES + np.outer(T - 28, slope)
    found = bias_temperature(t_days, T, bias + NOISE * rng.normal(size=(n, 6)), np.tile(NOISE, (n, 1)))
    assert found is not None
    return found


def test_a_slope_is_found_within_its_sigma_and_predicts() -> None:
    found = [fitted(seed, SLOPE) for seed in range(12)]
    z = np.array([(one.slope - SLOPE) / one.sigma for one in found])
    assert 0.8 < np.sqrt(np.mean(np.square(z))) < 1.25
    assert all(one.predicts == (True, True) for one in found)
    assert np.mean([one.error[0] for one in found]) < 0.5 * np.mean([one.error_without[0] for one in found])


@pytest.mark.slow
def test_a_walk_is_not_taken_for_a_temperature() -> None:
    found = [fitted(seed, np.zeros(6)) for seed in range(8)]
    assert sum(any(one.predicts) for one in found) <= 1


def test_few_runs_or_one_temperature_show_nothing() -> None:
    t, T = np.arange(8.0), np.linspace(20, 30, 8)
    bias, sigma = np.outer(T, SLOPE), np.tile(NOISE, (8, 1))
    assert bias_temperature(t, T, bias, sigma) is not None
    assert bias_temperature(t[:6], T[:6], bias[:6], sigma[:6]) is not None
    assert bias_temperature(t[:5], T[:5], bias[:5], sigma[:5]) is None
    assert bias_temperature(t, 25 + 0.31 * T, bias, sigma) is not None
    assert bias_temperature(t, 25 + 0.29 * T, bias, sigma) is None
    assert bias_temperature(t, 25 + T / 10, bias, sigma) is None


def test_only_what_predicts_is_applied_and_never_beyond_the_runs() -> None:
    found = fitted(0, SLOPE * [1, 1, 1, 0, 0, 0])
    assert found.predicts == (True, False)
    change, sigma = found.change(25.0, 30.0)
    assert change == pytest.approx([*(5 * found.slope[:3]), 0, 0, 0])
    assert sigma == pytest.approx([*(5 * found.sigma[:3]), 0, 0, 0])
    assert found.change(30.0, 90.0)[0] == pytest.approx(found.change(30.0, found.warmest_C)[0])


def test_a_measured_bias_has_its_own_sigma_also_beside_a_gain() -> None:
    joint = np.eye(26) + 0.1
    before = replace(calibrated(), covariance=joint[:15, :15], response=Response(np.full(11, 0.01), joint))
    step = np.arange(1.0, 7.0)
    added, measured = (
        with_bias_change(before, step, (0.1 * step) ** 2, measured=measured) for measured in (False, True)
    )
    for after in (added, measured):
        assert after.response is not None
        np.testing.assert_array_equal(after.response.covariance[:15, :15], after.covariance)
        np.testing.assert_array_equal(after.response.coefficients, np.full(11, 0.01))
        kept = np.setdiff1d(np.arange(26), np.arange(15)[BIASES])
        np.testing.assert_array_equal(after.response.covariance[np.ix_(kept, kept)], joint[np.ix_(kept, kept)])
    np.testing.assert_allclose(np.diag(added.covariance)[BIASES], 1.1 + (0.1 * step) ** 2)
    assert added.covariance[6, 0] == joint[6, 0]
    np.testing.assert_allclose(np.diag(measured.covariance)[BIASES], (0.1 * step) ** 2)
    assert np.count_nonzero(measured.covariance[6]) == 1
