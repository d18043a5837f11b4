"""The bias against temperature: what the fit finds, what it takes for chance, and what it applies."""

import numpy as np
import pytest

from ftcalib.extras.temperature import BiasTemperature, bias_temperature
from ftcalib.extras.update import with_bias_change
from ftcalib.model import BIASES, Array
from tests.unit.ftdrive.live.simulated import calibrated

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
    found = [fitted(seed, SLOPE) for seed in range(40)]
    z = np.array([(one.slope - SLOPE) / one.sigma for one in found])
    assert 0.8 < np.sqrt(np.mean(np.square(z))) < 1.25
    assert all(one.predicts == (True, True) for one in found)
    assert np.mean([one.error[0] for one in found]) < 0.5 * np.mean([one.error_without[0] for one in found])


@pytest.mark.parametrize(("scatter", "walk"), [(0.0, 1.0), (0.1, 0.3), (0.1, 0.0)])
def test_a_walk_is_not_taken_for_a_temperature(scatter: float, walk: float) -> None:
    found = [fitted(seed, np.zeros(6), scatter=scatter, walk=walk) for seed in range(30)]
    assert sum(any(one.predicts) for one in found) <= 2


def test_few_runs_or_one_temperature_show_nothing() -> None:
    t, T = np.arange(8.0), np.linspace(20, 30, 8)
    bias, sigma = np.outer(T, SLOPE), np.tile(NOISE, (8, 1))
    assert bias_temperature(t, T, bias, sigma) is not None
    assert bias_temperature(t[:5], T[:5], bias[:5], sigma[:5]) is None
    assert bias_temperature(t, 25 + T / 10, bias, sigma) is None


def test_only_what_predicts_is_applied_and_never_beyond_the_runs() -> None:
    found = fitted(0, SLOPE * [1, 1, 1, 0, 0, 0])
    assert found.predicts == (True, False)
    change, sigma = found.change(25.0, 30.0)
    assert change == pytest.approx([*(5 * found.slope[:3]), 0, 0, 0])
    assert sigma == pytest.approx([*(5 * found.sigma[:3]), 0, 0, 0])
    assert found.change(30.0, 90.0)[0] == pytest.approx(found.change(30.0, found.warmest_C)[0])


def test_a_changed_bias_widens_its_sigma_alone() -> None:
    before, step = calibrated(), np.arange(1.0, 7.0)
    after = with_bias_change(before, step, 0.1 * step)
    wrench = np.concatenate([after.parameters.force_bias_N, after.parameters.torque_bias_Nm])
    assert wrench == pytest.approx(np.concatenate([before.force_bias_N, before.torque_bias_Nm]) + step)
    wider = np.diag(after.covariance - before.covariance)
    assert wider[BIASES] == pytest.approx((0.1 * step) ** 2)
    assert np.count_nonzero(wider) == 6
