"""What can be assessed: a fit, or estimates of another method with leave-one-out cross-validation of its poses.

Cross-validation interpolates a drift, but a calibration is used after its tour: `drift_ahead` extrapolates it.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from ftcalib.likelihood.descent import column_scale
from ftcalib.likelihood.fit import Fit
from ftcalib.likelihood.session_noise import CHUNK, Noise, summed_products
from ftcalib.likelihood.variance_components import FORCE, TORQUE, component, left_out
from ftcalib.model import Array, Parameters, jacobian, predict


@dataclass(frozen=True, eq=False)
class IndependentFit:
    """A fit to poses with independent noise, for methods without cross-validation of their own."""

    parameters: Parameters
    covariance: Array
    R_base_flange: Array
    wrench: Array
    wrench_cov: Array
    """(n, 6, 6)"""
    measured: bool
    """Whether `wrench_cov` was measured, not estimated from the residuals."""
    weights: Array
    second_basin_chi2: float | None = None
    components: Mapping[str, float] = field(default_factory=dict)
    response: None = None
    drift: None = None
    gain_sigma: float = 0.0
    free: Array = field(default_factory=lambda: np.eye(15))
    """(15, m) error coordinates that the method estimates: fewer where it assumes mounting or gravity."""

    @cached_property
    def residuals(self) -> Array:
        """(n, 6) measured minus predicted."""
        return np.asarray(self.wrench - predict(self.parameters, self.R_base_flange))

    @cached_property
    def chi2(self) -> float:
        """Of the used poses."""
        r = self.residuals[..., None]
        return float(self.weights @ np.sum(r * np.linalg.solve(self.wrench_cov, r), axis=(1, 2)))

    @property
    def measured_chi2(self) -> float:
        """The same, if the noise was measured."""
        return self.chi2 if self.measured else float("nan")

    @property
    def dof(self) -> int:
        """Of chi2."""
        return 6 * int(self.weights.sum()) - int(self.free.shape[1])

    @property
    def left_out_residuals(self) -> Array:
        """(n, 6) measured minus what all other poses predict."""
        return self._left_out[0]

    @property
    def left_out_cov(self) -> Array:
        """(n, 6, 6) covariance of these."""
        return self._left_out[1]

    @cached_property
    def _left_out(self) -> tuple[Array, Array]:
        """(I - H_kk)^-1 r_k without fitting again, exact for a linear model, and its covariance."""
        J, noise = (
            jacobian(self.parameters, self.R_base_flange) @ self.free,
            Noise(self.wrench_cov, kept=self.weights > 0),
        )
        WJ = noise.solve(J)
        information = summed_products(J, WJ)
        scale = column_scale(information)
        C = np.asarray(np.linalg.pinv(information / np.outer(scale, scale), hermitian=True)) / np.outer(scale, scale)
        return left_out(noise, WJ, noise.solve(self.residuals[..., None])[..., 0], C)


AssessedFit = Fit | IndependentFit
"""Rejected poses count only in arrays with n rows."""


def standardized(residuals: Array, covariance: Array) -> Array:
    """Divide residuals (n, 6) by a root of their covariance (n, 6, 6): independent, of unit variance."""
    unit = np.empty_like(residuals)
    for first in range(0, len(residuals), CHUNK):
        part = slice(first, first + CHUNK)
        unit[part] = np.linalg.solve(_root(covariance[part]), residuals[part, :, None])[..., 0]
    return unit


def _root(covariance: Array) -> Array:
    """Give roots A with A A' = covariance (n, 6, 6), which rounding may have made indefinite."""
    try:
        return np.asarray(np.linalg.cholesky(covariance), dtype=np.float64)
    except np.linalg.LinAlgError:
        value, vector = np.linalg.eigh(covariance)
        return np.asarray(vector * np.sqrt(np.maximum(value, 1e-12 * value[:, -1:]))[:, None])


USUAL_INTERVAL_S = 10.0
"""From pose to pose, if their times are not known."""
NEXT_USE_S = 60.0
"""From the last pose to the next use."""


@dataclass(frozen=True, slots=True, eq=False)
class DriftAhead:
    """The bias at the next use, a minute after the last pose, less the mean bias of the tour; zero without drift."""

    offset: Array
    """(6,) at the last used pose, N and N·m."""
    growth_per_min: Array
    """(6,) change in the next minute: its size if the bias is linear in time, its standard deviation if it walks."""
    square: Array
    """(6,) expected square at the next use."""


def drift_ahead(fit: AssessedFit, t_s: Array | None = None) -> DriftAhead:
    """Extrapolate the drift of a fit.

    Parameters
    ----------
    fit : AssessedFit
    t_s : array, shape (n,), optional
        When each pose was measured; without it, or with times that are not finite, one pose every 10 s in their order.
    """
    if fit.drift is None:
        return DriftAhead(np.zeros(6), np.zeros(6), np.zeros(6))
    n = len(fit.weights)
    timed = t_s is not None and np.isfinite(t_s).all() and np.ptp(t_s) > 0
    time = np.asarray(t_s if timed else USUAL_INTERVAL_S * np.arange(n), dtype=np.float64)
    used = np.flatnonzero(fit.weights > 0)
    first, last = used[np.argmin(time[used])], used[np.argmax(time[used])]
    offset = fit.drift.bias[last]
    intervals = NEXT_USE_S * (n - 1) / np.ptp(time)
    walk = np.zeros(6)
    for channels in (FORCE, TORQUE, *([c] for c in range(6))):
        walk[channels] += intervals * fit.components.get(component("walk", channels).name, 0.0) ** 2
    linear = np.where(walk > 0, 0.0, fit.drift.change * NEXT_USE_S / (time[last] - time[first]))
    # The change from the first pose to the last has the errors of both ends.
    square = (offset + linear) ** 2 + walk + fit.drift.sigma**2 / 2
    return DriftAhead(offset, np.sqrt(walk + linear**2), square)
