"""Trends over calibrations: false alarms as nominal, with honest and with too small covariances, and true drifts."""

import numpy as np
import pytest
from scipy.linalg import block_diag
from scipy.stats import binomtest, chi2, f

from ftcalib.after.series import trend
from ftcalib.model import Array

A = np.array([[1.0, 0.3, 0.0], [0.3, 2.0, -0.4], [0.0, -0.4, 0.5]])


def series(rng: np.random.Generator, n: int, drift: Array, scatter: float = 1.0) -> tuple[Array, Array, Array]:
    """Estimates at irregular times, some ten times as uncertain as others."""
    t = np.sort(rng.uniform(0, 100, n))
    size = rng.choice([1.0, 10.0], n)[:, None]
    noise = scatter * size * rng.normal(size=(n, 3)) @ np.linalg.cholesky(A).T
    return t, 5.0 + t[:, None] * drift + noise, size[..., None] ** 2 * A


@pytest.mark.parametrize(("scatter", "n"), [(1.0, 3), (1.0, 10), (5.0, 4), (5.0, 10)])
def test_a_stable_sensor_has_a_trend_as_rarely_as_stated(scatter: float, n: int) -> None:
    """Also where something that no covariance knows moves the estimates five times as much."""
    rng = np.random.default_rng(n)
    alarms = sum(trend(*series(rng, n, np.zeros(3), scatter)).p_value < 0.05 for _ in range(300))
    assert binomtest(alarms, 300, 0.05, alternative="greater").pvalue > 1e-6


def test_the_unit_of_time_does_not_matter() -> None:
    t, values, covariance = series(np.random.default_rng(3), 6, np.array([0.1, 0.0, 0.0]))
    days, seconds = trend(t, values, covariance), trend(1.7e9 + 86400 * t, values, covariance)
    assert seconds.p_value == pytest.approx(days.p_value, rel=1e-6)
    assert 86400 * seconds.slope == pytest.approx(days.slope, rel=1e-6)


def test_an_uncertain_estimate_counts_less_in_every_direction() -> None:
    t, values, covariance = series(np.random.default_rng(5), 6, np.array([0.1, 0.0, 0.0]))
    X = np.concatenate([np.hstack([np.eye(3), at * np.eye(3)]) for at in t])
    W = np.linalg.inv(block_diag(*covariance))
    C = np.linalg.inv(X.T @ W @ X)
    x = C @ X.T @ W @ values.ravel()
    left = values.ravel() - X @ x
    scatter = left @ W @ left / 12
    slope_chi2 = x[3:] @ np.linalg.solve(C[3:, 3:], x[3:])
    found = trend(t, values, covariance)
    assert found.slope == pytest.approx(x[3:])
    assert found.sigma == pytest.approx(np.sqrt(np.diag(C)[3:] * max(scatter, 1.0)))
    assert found.p_value == pytest.approx(max(chi2.sf(slope_chi2, 3), f.sf(slope_chi2 / 3 / scatter, 3, 12)))


@pytest.mark.parametrize("t", [[0.0, 1.0], [1.0, 1.0, 1.0]])
def test_too_few_points_have_no_trend(t: list[float]) -> None:
    with pytest.raises(ValueError, match="no trend"):
        trend(np.array(t), np.zeros((len(t), 1)), np.ones((len(t), 1, 1)))


def test_known_values_have_no_trend() -> None:
    with pytest.raises(ValueError, match="positive definite"):
        trend(np.arange(3.0), np.zeros((3, 1)), np.zeros((3, 1, 1)))
