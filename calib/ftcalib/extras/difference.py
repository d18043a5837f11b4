"""The difference of two calibrations, in standard deviations and tested jointly."""

from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag
from scipy.special import chdtrc as chi2_sf

from ftcalib.model import Array, Parameters, read_only

KNOWN = 1e-9
"""A standard deviation below this share of the largest is one of rounding: the value was taken as known."""
_SINGULAR = 1e-10
"""Likewise an eigenvalue of a correlation matrix."""
_ROUNDING_SIGMAS = 1e-3
"""A difference in a direction that both calibrations take as known counts from here on."""


class Estimated(Protocol):
    """A calibration, an update of it, or a row of a store."""

    @property
    def parameters(self) -> Parameters:
        """Estimates."""

    @property
    def covariance(self) -> Array:
        """(15, 15) of the error coordinates `ftcalib.model.PARAMETER_NAMES`."""


@dataclass(frozen=True, slots=True)
class ChiSquare:
    """Chi-square test of no difference."""

    chi2: float
    """Squared Mahalanobis distance; infinite if values that both take as known differ."""
    dof: int
    p_value: float


@dataclass(frozen=True, slots=True, eq=False)
class Difference:
    """Second calibration minus the first."""

    change: Array
    """(15,) in the error coordinates `ftcalib.model.PARAMETER_NAMES`; the rotation about the flange axes, rad."""
    sigma: Array
    """(15,) one standard deviation of that; 0 where both calibrations share the value or take it as known."""
    joint: ChiSquare
    """Of all parameters that the calibrations do not share."""
    groups: Mapping[str, ChiSquare]
    """Of each field of `Parameters`."""

    @property
    def in_sigmas(self) -> Array:
        """(15,) change divided by sigma; 0 where shared, infinite where two known values differ."""
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.asarray(np.where(self.change == 0, 0.0, self.change / self.sigma))


def difference(first: Estimated, second: Estimated) -> Difference:
    """Compare two calibrations whose errors are independent.

    A field that is identical in both was copied, as by an update of the bias. It is left out of the joint test, because
    its error is common to both. Gain and cross-talk of the sensor are not compared.

    Parameters
    ----------
    first, second : Estimated

    Returns
    -------
    Difference
        With the covariances of both. The mountings are R1 = exp(-d1) R and R2 = exp(-d2) R, with small errors d about
        the flange axes, so the error d1 is turned into the axes of the second mounting before it is added.
    """
    old, new = first.parameters, second.parameters
    change = old.difference(new)
    # The left Jacobian of the rotation drops out of the Mahalanobis distance, because it leaves its own axis in place.
    turn = block_diag(new.R_flange_sensor @ old.R_flange_sensor.T, np.eye(12))
    covariance = second.covariance + turn @ first.covariance @ turn.T
    for i, field in enumerate(fields(Parameters)):
        if np.array_equal(getattr(old, field.name), getattr(new, field.name)):
            rows = slice(3 * i, 3 * i + 3)
            change[rows], covariance[rows, :], covariance[:, rows] = 0.0, 0.0, 0.0
    everything = np.arange(15)
    names = [field.name for field in fields(Parameters)]
    groups = {name: _test(change, covariance, everything[3 * i : 3 * i + 3]) for i, name in enumerate(names)}
    sigma = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    return Difference(read_only(change), read_only(sigma), _test(change, covariance, everything), groups)


def _test(change: Array, covariance: Array, rows: NDArray[np.intp]) -> ChiSquare:
    """Test some rows; directions without variance count only if they differ."""
    sigma = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    known = sigma[rows] <= KNOWN * sigma.max()
    if np.any(change[rows[known]] != 0):
        return ChiSquare(np.inf, len(rows), 0.0)
    free = rows[~known]
    if not len(free):
        return ChiSquare(0.0, 0, 1.0)
    z = change[free] / sigma[free]
    eigenvalues, directions = np.linalg.eigh(covariance[np.ix_(free, free)] / np.outer(sigma[free], sigma[free]))
    along = directions.T @ z
    usable = eigenvalues > _SINGULAR * eigenvalues[-1]
    if np.any(np.abs(along[~usable]) > _ROUNDING_SIGMAS):
        return ChiSquare(np.inf, len(free), 0.0)
    chi2, dof = float(np.sum(along[usable] ** 2 / eigenvalues[usable])), int(usable.sum())
    return ChiSquare(chi2, dof, float(chi2_sf(dof, chi2)))
