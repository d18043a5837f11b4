"""The onset of a drift: found in time, and neither an offset nor a step is one."""

import numpy as np
import pytest
from scipy.stats import chi2, f

from ftcalib.after.series import FEWEST, LEAST_DAYS, DriftOnset, drift_onset
from ftcalib.model import Array

COMMON = np.full(6, 0.5)
"""Sigma of the calibration, in sigmas of a verification."""


def series(t: Array, seed: int = 0) -> Array:
    """An unchanged bias, in sigmas of a verification."""
    rng = np.random.default_rng(seed)
    return rng.normal(size=(len(t), 6)) + COMMON * rng.normal(size=6)


def searched(t: Array, d: Array, sigma: float = 1.0) -> DriftOnset:
    found = drift_onset(t, d, np.full(d.shape, sigma), COMMON)
    assert found is not None
    return found


def ramp(t: Array, onset: float, a_week: float) -> Array:
    return a_week / 7 * np.maximum(0.0, t - onset)


DAILY = np.arange(90.0) + 0.3


@pytest.mark.slow
@pytest.mark.parametrize("a_week", [1.0, -3.0])
def test_a_drift_is_found_within_three_weeks_with_its_rate_and_onset(a_week: float) -> None:
    """1 sigma a week in 19 of 20 series; docs/contributing/figures/fleet.md has the figures."""
    missed = 0
    for seed in range(20):
        d = series(DAILY, seed)
        d[:, 4] += ramp(DAILY, 48.5, a_week)
        looks = [searched(DAILY[:n], d[:n]) for n in range(50, 70)]
        missed += not any(one.found[4] for one in looks)
        assert not any(one.found[[0, 1, 2, 3, 5]].any() for one in looks)
        later = searched(DAILY, d)
        assert later.found[4]
        assert abs(later.slope[4] - a_week / 7) < 6 * later.sigma[4]
        assert abs(later.t0_days[4] - 48.5) < 14
    assert missed <= 1


def test_an_unchanged_bias_does_not_drift() -> None:
    """Also with an offset since the calibration, which the stated sigma of the calibration does not allow."""
    for seed in range(40):
        assert not searched(DAILY, series(DAILY, seed)).found.any()
        assert not searched(DAILY, series(DAILY, seed) + np.array([0.0, 20.0, 0.0, -8.0, 0.0, 100.0])).found.any()


def test_an_offset_of_an_old_calibration_is_no_slow_drift_since_then() -> None:
    """With the sigma of the calibration alone, a line from the calibration on would explain it."""
    for seed in range(40):
        assert not searched(DAILY + 200, series(DAILY, seed) + 2.5 * np.eye(6)[seed % 6]).found.any()


@pytest.mark.slow
@pytest.mark.parametrize("size", [10.0, 300.0])
def test_a_tare_is_no_drift_on_any_day_after_it(size: float) -> None:
    for seed in range(4):
        tare = size * np.random.default_rng(seed).normal(size=6)
        d = series(DAILY, seed) + np.where(DAILY > 40, 1.0, 0.0)[:, None] * tare
        for n in range(41, 90):
            found = drift_onset(DAILY[:n], d[:n], np.ones((n, 6)), COMMON)
            assert found is None or not found.found.any()


def test_verifications_since_a_tare_are_enough_or_too_few() -> None:
    for since, enough in ((FEWEST, True), (FEWEST - 1, False)):
        d = series(DAILY) + np.where(np.arange(90) >= 90 - since, 500.0, 0.0)[:, None]
        found = drift_onset(DAILY, d, np.ones(d.shape), COMMON)
        assert (found is not None) == enough


def test_a_bad_verification_is_no_drift() -> None:
    for bad in (88, 89, 60, 20):
        d = series(DAILY)
        d[bad] += 50.0
        found = drift_onset(DAILY, d, np.ones(d.shape), COMMON)
        assert found is None or not found.found.any()


@pytest.mark.parametrize("since", [0.0, 30.0])
def test_the_likeliest_onset_is_that_of_generalised_least_squares(since: float) -> None:
    """Verifications differ in sigma; the error of an old calibration limits the level of the bias no more."""
    rng = np.random.default_rng(7)
    t = since + np.cumsum(rng.uniform(2.0, 9.0, 12))
    sigma, common = rng.uniform(0.5, 2.0, (12, 2)), np.array([0.4, 0.8])
    d = 1.5 * sigma * rng.normal(size=(12, 2)) + np.outer(ramp(t, t[5], 1.5), [1.0, -1.0])
    found = drift_onset(t, d, sigma, common)
    assert found is not None
    onsets = [*([0.0] if since == 0 else []), *t[t <= t[-1] - LEAST_DAYS]]
    for k in range(2):
        V = np.diag(sigma[:, k] ** 2) + (common[k] ** 2 if since == 0 else 1e6)
        W = np.linalg.inv(V)
        fits = []
        for onset in onsets:
            x = np.maximum(t - onset, 0.0)
            slope = x @ W @ d[:, k] / (x @ W @ x)
            fits.append((slope**2 * (x @ W @ x), slope, 1 / np.sqrt(x @ W @ x), onset))
        chi2_of_slope, slope, error, onset = max(fits)
        scatter = (d[:, k] @ W @ d[:, k] - chi2_of_slope) / 9
        assert scatter > 1
        assert found.t0_days[k] == onset
        assert found.slope[k] == pytest.approx(slope, rel=1e-4)
        assert found.sigma[k] == pytest.approx(error * np.sqrt(scatter), rel=1e-4)
        assert found.p_value[k] == pytest.approx(
            max(chi2.sf(chi2_of_slope, 1), f.sf(chi2_of_slope / scatter, 1, 9)), rel=1e-3
        )
