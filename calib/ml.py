"""Maximum likelihood: joint weighted least squares of forces and torques, under the noise the data show."""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from types import MappingProxyType

import numpy as np

from calib.model import Array, Parameters, jacobian, predict


@dataclass(frozen=True, slots=True, eq=False)
class Minimum:
    """One solution that fits better than all of its neighbours."""

    parameters: Parameters
    chi2: float
    """Under the noise model of the fit, on the same poses for all minima."""


@dataclass(frozen=True, eq=False)
class Fit:
    """Estimates and everything needed to judge them. Rejected poses count nowhere but in arrays with n rows."""

    parameters: Parameters
    """With drift the biases are the mean over the poses."""
    information: Array
    """(15, 15) Fisher information of the error coordinates `PARAMETER_NAMES`, priors included."""
    covariance: Array
    """(15, 15), its inverse; zero along what is exactly known, without meaning where the information lacks rank."""
    minima: tuple[Minimum, ...]
    """By ascending chi2, R_flange_sensor at least 1° apart; the first is the answer."""
    chi2: float
    """Under the noise model: measured or estimated white noise plus `components`. About dof by construction."""
    dof: int
    measured_chi2: float
    """The same poses, best fit without drift, weighted by the measured noise alone; NaN when nobody measured it."""
    weights: Array
    """(n,) 1 = used, 0 = rejected because it fits none of what the others tell."""
    components: Mapping[str, float]
    """Standard deviations of what was found beyond the measured noise, by name with unit."""
    R_base_flange: Array
    """(n, 3, 3)"""
    wrench: Array
    """(n, 6)"""
    left_out_residuals: Array
    """(n, 6) measured minus what all other poses predict for this one, drift and correlation included: the exact
    leave-one-out of the linearised model, `P_kk^-1 (P y)_k` with `P = W - W J C J' W`, W the inverse noise covariance."""
    left_out_cov: Array
    """(n, 6, 6) covariance of these, `P_kk^-1`: noise of the pose and uncertainty of its prediction."""

    @cached_property
    def residuals(self) -> Array:
        """(n, 6) measured minus `predict(parameters)`: the plain model, without drift."""
        return np.asarray(self.wrench - predict(self.parameters, self.R_base_flange))

    @cached_property
    def jacobian(self) -> Array:
        """(n, 6, 15) derivative of the prediction."""
        return jacobian(self.parameters, self.R_base_flange)

    @cached_property
    def standardized_residuals(self) -> Array:
        """(n, 6) `left_out_residuals` whitened by `left_out_cov`: independent within a pose, standard deviation 1."""
        L = np.linalg.cholesky(self.left_out_cov)
        return np.asarray(np.linalg.solve(L, self.left_out_residuals[..., None])[..., 0])


_NO_COMPONENTS: Mapping[str, float] = MappingProxyType({})
