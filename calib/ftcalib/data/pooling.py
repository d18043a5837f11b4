"""Covariances of pose means that come from few samples each."""

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtri as chi2_isf

from ftcalib.model import Array

TRUSTED_SAMPLES = 100.0
"""With this many independent samples, the covariance of a pose counts as much as the common shape."""
MEDIAN_SCATTER = float(chi2_isf(5, 0.5)) / 5
"""Median of the variance of six Gaussian values, relative to its mean."""


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
    freedom *= _independent_share(S, shape, freedom)
    # Equal sizes scatter by 2 / (6 freedom) in the logarithm, whose mean is half of that low: remove both.
    scatter = 2 / (6 * freedom)
    log_size = np.log(size) + scatter / 2
    mean = float(np.average(log_size, weights=freedom))
    real = max(float(np.average((log_size - mean) ** 2 - scatter, weights=freedom)), 0.0)
    size = np.exp(mean + (log_size - mean) * real / (real + scatter))
    own, common = np.ones(len(known)), np.zeros(len(known))
    own[known] = freedom / (freedom + TRUSTED_SAMPLES)
    common[known] = (1 - own[known]) * size
    pooled = own[:, None, None] * wrench_cov
    for i, j in np.ndindex(6, 6):  # without a second array of that size
        pooled[:, i, j] += common * shape[i, j]
    return pooled


def _independent_share(S: Array, shape: Array, freedom: Array) -> float:
    """Estimate which share of the freedom covariances (n, 36) have; the median ignores a pose of another shape."""
    white = np.linalg.inv(np.linalg.cholesky(shape))
    log_variances = np.log(S @ np.einsum("ca,cb->abc", white, white).reshape(36, 6))
    log_variances -= np.median(log_variances, axis=0)  # a pose of another shape is a part of the common one
    scatter = float(np.median(log_variances.var(axis=1, ddof=1) * freedom)) / MEDIAN_SCATTER
    return min(1.0, 2 * (1 - 1 / len(S)) / max(scatter, 1e-12))
