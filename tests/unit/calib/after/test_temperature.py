"""The bias against temperature: what the fit finds, what it takes for chance, and what it applies."""

from dataclasses import replace
from itertools import product

import numpy as np
import pytest
from scipy.linalg import null_space
from scipy.stats import f, multivariate_normal

from ftcalib.after.series import BiasTemperature, bias_temperature
from ftcalib.after.state import with_bias_change
from ftcalib.model import BIASES, Array
from ftcalib.sensor_matrix import Response
from tests.unit.ftdrive.stream.simulated import calibrated

ONES = np.repeat([1.0, 0.03], 3)
SLOPE = 0.1 * ONES
NOISE = 0.02 * ONES

SHARES = np.array([0.0, 0.1, 0.2, 0.4, 0.7, 1.0, 1.5, 2.5])
"""Standard deviations that are tried, relative to the spread of the residuals."""


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


def restricted(y: Array, X: Array, V: Array) -> float:
    """Log likelihood of what no column of X explains: of contrasts, up to a constant."""
    K = null_space(X.T)
    return float(sum(multivariate_normal.logpdf(K.T @ one, cov=K.T @ V @ K) for one in y.T))


def test_scatter_and_walk_are_averaged_by_their_likelihood() -> None:
    rng = np.random.default_rng(3)
    n = 7
    t_days, T = np.sort(rng.uniform(5, 60, n)), rng.uniform(20, 36, n)
    y = (
        0.05 * np.outer(T, [1, -1, 2])
        + np.cumsum(0.3 * rng.normal(size=(n, 3)), axis=0)
        + 0.2 * rng.normal(size=(n, 3))
    )
    sigma = rng.uniform(0.05, 0.3, (n, 6))
    found = bias_temperature(t_days, T, np.hstack([y, y]), sigma)
    assert found is not None
    since = (t_days - t_days[0]) / (t_days[-1] - t_days[0])
    rms = []
    for X in (np.column_stack([np.ones(n), T - T.mean()]), np.ones((n, 1))):
        left = y - X @ np.linalg.lstsq(X, y, rcond=None)[0]
        spread = np.sqrt(np.mean(left**2))
        weights, slopes, variances, misses = [], [], [], []
        for scatter, walk in product(SHARES * spread, repeat=2):
            V = np.diag(np.mean(sigma[:, :3] ** 2, axis=1) + scatter**2) + walk**2 * np.minimum.outer(since, since)
            W = np.linalg.inv(V)
            C = np.linalg.inv(X.T @ W @ X)
            weights.append(restricted(y, X, V))
            slopes.append((C @ X.T @ W @ y)[-1])
            variances.append(C[-1, -1])
            missed = []
            for i in range(n):
                others = np.arange(n) != i
                Wo, Xo = np.linalg.inv(V[np.ix_(others, others)]), X[others]
                x = np.linalg.solve(Xo.T @ Wo @ Xo, Xo.T @ Wo @ y[others])
                missed.append(y[i] - X[i] @ x - V[i, others] @ Wo @ (y[others] - Xo @ x))
            misses.append(missed)
        w = np.exp(np.array(weights) - max(weights))
        w /= w.sum()
        mean = w @ np.array(slopes)
        if X.shape[1] == 2:
            error = np.sqrt(w @ np.array(variances) + w @ (np.array(slopes) - mean) ** 2)
            np.testing.assert_allclose(found.slope[:3], mean, rtol=1e-6)
            np.testing.assert_allclose(found.sigma[:3], error, rtol=1e-6)
            assert found.p_value[0] == pytest.approx(f.sf(np.mean((mean / error) ** 2), 3, 3 * (n - 2)))
        rms.append(np.sqrt(np.mean(np.tensordot(w, np.array(misses), 1) ** 2)))
    assert (found.error[0], found.error_without[0]) == pytest.approx(rms, rel=1e-6)
    assert (found.n, found.coldest_C, found.warmest_C) == (n, T.min(), T.max())
    later = bias_temperature(t_days + 100, T, np.hstack([y, y]), sigma)
    assert later is not None
    np.testing.assert_allclose(later.slope, found.slope)


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
