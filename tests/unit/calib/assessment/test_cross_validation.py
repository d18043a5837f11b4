"""Residuals in units of their covariance."""

import numpy as np

from ftcalib.assessment.cross_validation import standardized


def test_a_covariance_that_rounding_made_indefinite_still_scales_residuals() -> None:
    rng = np.random.default_rng(0)
    A = rng.normal(size=(3, 6, 6))
    covariance = A @ np.swapaxes(A, 1, 2)
    e = rng.normal(size=(3, 6))
    exact = np.linalg.solve(covariance, e[..., None])[..., 0]
    value, vector = np.linalg.eigh(covariance[1])
    covariance[1] = vector @ np.diag([-1e-18, *value[1:]]) @ vector.T
    z = standardized(e, covariance)
    assert np.isfinite(z).all()
    np.testing.assert_allclose(np.sum(z**2, axis=1)[[0, 2]], np.sum(e * exact, axis=1)[[0, 2]])
