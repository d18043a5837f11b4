"""The covariance that an estimate has by its own derivatives."""

from collections.abc import Callable

import numpy as np

from ftcalib.model import Array

_STEP_SIGMAS = 1e-3


def propagated(estimate: Callable[[Array], Array], covariance: Array) -> Array:
    """Covariance of what `estimate` returns for small errors (k,) of its input, which have this covariance (k, k)."""
    variances, axes = np.linalg.eigh(covariance)
    shifts = (axes * np.sqrt(variances.clip(0.0))).T * _STEP_SIGMAS
    root = (np.array([estimate(shift) for shift in shifts]) - estimate(np.zeros(len(covariance)))) / _STEP_SIGMAS
    return np.asarray(root.T @ root)


def assert_same(found: Array, expected: Array, share: float = 1e-3) -> None:
    """Compare two covariances in shares of the variances."""
    sigma = np.sqrt(np.diag(expected)) + 1e-15
    np.testing.assert_allclose(found / np.outer(sigma, sigma), expected / np.outer(sigma, sigma), atol=share)
