"""Linear change of an estimate from calibration to calibration, and whether it is significant."""

from dataclasses import dataclass

import numpy as np
import scipy

from ftcalib.model import Array

FEWEST = 3
"""Two points have a line without any scatter about it."""


@dataclass(frozen=True, slots=True, eq=False)
class Trend:
    """Weighted straight line through n estimates of k numbers."""

    slope: Array
    """(k,) change per unit of time."""
    sigma: Array
    """(k,) one standard deviation of that, from the covariances or from the scatter if that is larger."""
    p_value: float
    """Probability of a larger slope, in any direction, if nothing changes linearly."""
    n: int


def trend(t: Array, values: Array, covariance: Array) -> Trend:
    """Fit a line by generalised least squares, and test its slope against zero.

    The slope must be significant against the stated covariances (chi-square, k degrees of freedom), and against the
    scatter about the line (F test, k and k (n - 2)). The p-value is the larger of the two, so neither covariances that
    are too small nor a scatter that happens to be small makes a trend.

    Parameters
    ----------
    t : array, shape (n,)
        n >= 3, not all equal.
    values : array, shape (n, k)
    covariance : array, shape (n, k, k)
        Of each row, positive definite; the rows are independent.

    Raises
    ------
    ValueError
        Too few rows, all at one time, or a covariance that is not positive definite.
    """
    t, values = np.asarray(t, dtype=np.float64), np.asarray(values, dtype=np.float64)
    n, k = values.shape
    if n < FEWEST or np.ptp(t) == 0:
        raise ValueError(f"{n} estimates at {len(np.unique(t))} times have no trend: give {FEWEST} or more")
    try:
        whiten = np.linalg.inv(np.linalg.cholesky(covariance))  # (n, k, k)
    except np.linalg.LinAlgError as error:
        raise ValueError("a covariance is not positive definite: leave out values taken as known") from error
    scale = float(np.ptp(t))
    design = np.concatenate([whiten, whiten * ((t - t.mean()) / scale)[:, None, None]], axis=2).reshape(n * k, 2 * k)
    readings = (whiten @ (values - values.mean(axis=0))[..., None]).reshape(n * k)
    inverse = np.linalg.inv(design.T @ design)
    x = inverse @ design.T @ readings
    slope, slope_cov = x[k:], inverse[k:, k:]
    dof = k * (n - 2)
    scatter = float(np.sum((readings - design @ x) ** 2)) / dof
    chi2 = float(slope @ np.linalg.solve(slope_cov, slope))
    special = scipy.special
    against_scatter = special.fdtrc(k, dof, chi2 / k / scatter) if scatter > 0 else 0.0
    sigma = np.sqrt(np.diag(slope_cov) * max(scatter, 1.0))
    return Trend(slope / scale, sigma / scale, float(max(special.chdtrc(k, chi2), against_scatter)), n)
