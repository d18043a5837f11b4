"""Covariances of pose means that come from few samples each."""

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtri as chi2_isf

from ftcalib.model import Array

TRUSTED_SAMPLES = 100.0
"""With this many independent samples, the covariance of a pose counts as much as the common shape."""
MEDIAN_SCATTER = float(chi2_isf(5, 0.5)) / 5
"""Median of the variance of six Gaussian values, relative to its mean."""
UNLIKE = 3.0
"""A pose whose variances scatter more than this, relative to their freedom, has a shape of its own: 1 % by chance."""


def pooled_covariance(wrench_cov: Array, n_samples: NDArray[np.int64]) -> Array:
    """Shrink each covariance towards the shape common to all poses, times a size of its own.

    A 6 x 6 covariance from N samples is so uncertain that weighting with it increases the mean square error of the
    calibration: 3 times with N = 10, 1.15 times with N = 50. The common shape has no such error. The size keeps the
    differences between poses that exceed the scatter of N samples.

    Samples of filtered noise repeat each other, and their correlation in time is itself uncertain: 1000 samples behind
    a low-pass of 2 Hz may determine a variance no better than 4 independent ones. So the covariances themselves show
    their degrees of freedom, a share of N - 1: within a pose, the logarithms of six variances of equal size scatter by
    2 / freedom.

    Parameters
    ----------
    wrench_cov : array, shape (n, 6, 6)
        Covariance of the mean of each pose.
    n_samples : int array, shape (n,)
        Samples of each, independent or not; 0 = unknown: that covariance is not changed.

    Returns
    -------
    array, shape (n, 6, 6)
    """
    known = n_samples > 1
    if known.sum() < 2:
        return wrench_cov
    S = (wrench_cov if known.all() else wrench_cov[known]).reshape(-1, 36)
    freedom = np.asarray(n_samples[known] - 1, dtype=np.float64)
    size = np.ones(len(S))
    for _ in range(8):
        shape = ((freedom / size) @ S / freedom.sum()).reshape(6, 6)
        before, size = size, S @ np.linalg.inv(shape).ravel() / 6
        if np.abs(size - before).max() <= 1e-12 * size.max():
            break
    spread = _spread_within(S, shape)
    typical = float(np.median(spread * freedom)) / MEDIAN_SCATTER / (1 - 1 / len(S))
    freedom *= min(1.0, 2 / max(typical, 1e-12))
    # Equal sizes scatter by 2 / (6 freedom) in the logarithm, whose mean is half of that low: remove both.
    log_size, scatter = np.log(size), 2 / (6 * freedom)
    mean = float(np.average(log_size, weights=freedom))
    found = float(np.average((log_size - mean) ** 2, weights=freedom))
    real = max(found - float(np.average(scatter, weights=freedom)), 0.0)
    size = np.exp(mean + (log_size - mean) * real / (real + scatter) + np.minimum(scatter, found) / 2)
    own, common = np.ones(len(known)), np.zeros(len(known))
    unlike = 1 - UNLIKE * 2 / freedom / np.maximum(spread, 1e-12)
    own[known] = np.maximum(freedom / (freedom + TRUSTED_SAMPLES), unlike)
    common[known] = (1 - own[known]) * size
    pooled = own[:, None, None] * wrench_cov
    for i, j in np.ndindex(6, 6):  # without a second array of that size
        pooled[:, i, j] += common * shape[i, j]
    return pooled


def _spread_within(S: Array, shape: Array) -> Array:
    """Return how the logarithms of the six variances of each covariance (n, 36) scatter, independent ones in shape."""
    white = np.linalg.inv(np.linalg.cholesky(shape))
    log_variances = np.log(S @ np.einsum("ca,cb->abc", white, white).reshape(36, 6))
    log_variances -= np.median(log_variances, axis=0)  # a pose of another shape is a part of the common one
    return np.asarray(log_variances.var(axis=1, ddof=1))
