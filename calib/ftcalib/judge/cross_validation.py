"""What is judged: a fit, or estimates of another method with leave-one-out cross-validation of its poses.

Cross-validation interpolates a drift, but a calibration is used after its tour: `drift_ahead` extrapolates it.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Self

import numpy as np

from ftcalib.likelihood.descent import column_scale
from ftcalib.likelihood.fit import Fit
from ftcalib.likelihood.session_noise import CHUNK, Noise, summed_products
from ftcalib.likelihood.variance_components import FORCE, TORQUE, component, left_out
from ftcalib.model import Array, DriftResult, Parameters, jacobian, predict
from ftcalib.sensor_matrix import Response


@dataclass(frozen=True, slots=True, eq=False)
class Judged:
    """All that the judge looks at: estimates, and what they leave of each pose. Rejected poses count only in arrays."""

    parameters: Parameters
    covariance: Array
    """(15, 15) of the error coordinates `PARAMETER_NAMES`."""
    R_base_flange: Array
    """(n, 3, 3)"""
    wrench: Array
    """(n, 6)"""
    weights: Array
    """(n,) 1 = used, 0 = rejected."""
    residuals: Array
    """(n, 6) measured minus predicted."""
    left_out_residuals: Array
    """(n, 6) measured minus what all other poses predict."""
    left_out_cov: Array
    """(n, 6, 6) covariance of these."""
    chi2: float
    measured_chi2: float
    """Weighted by the measured noise alone; NaN without it."""
    dof: int
    second_basin_chi2: float | None
    components: Mapping[str, float]
    response: Response | None = None
    drift: DriftResult | None = None
    gain_sigma: float = 0.0
    elsewhere: Array = field(default_factory=lambda: np.zeros(6))
    """(6,) mean square error of predicting the wrench in any orientation, less that in those of the poses."""
    fit: Fit | None = None
    """The fit by maximum likelihood that has these values; None for another method, whose noise has no model."""

    @classmethod
    def of(cls, fit: Fit) -> Self:
        """Take a fit, which cross-validates its poses itself."""
        own = {name: getattr(fit, name) for name in cls.__dataclass_fields__ if name != "fit"}
        return cls(**own, fit=fit)

    @classmethod
    def independent(  # noqa: PLR0913 - what an estimate rests on
        cls,
        parameters: Parameters,
        covariance: Array,
        R_base_flange: Array,
        wrench: Array,
        wrench_cov: Array,
        weights: Array,
        *,
        measured: bool,
        second_basin_chi2: float | None = None,
        components: Mapping[str, float] | None = None,
        free: Array | None = None,
    ) -> Self:
        """Cross-validate the estimates of another method, for poses with independent noise.

        Parameters
        ----------
        parameters : Parameters
        covariance : array, shape (15, 15)
        R_base_flange : array, shape (n, 3, 3)
        wrench : array, shape (n, 6)
        wrench_cov : array, shape (n, 6, 6)
        weights : array, shape (n,)
        measured : bool
            Whether `wrench_cov` was measured, not estimated from the residuals.
        second_basin_chi2 : float, optional
        components : mapping, optional
        free : array, shape (15, m), optional
            Error coordinates that the method estimates: fewer where it assumes mounting or gravity.
        """
        free = np.eye(15) if free is None else free
        residuals = np.asarray(wrench - predict(parameters, R_base_flange))
        r = residuals[..., None]
        chi2 = float(weights @ np.sum(r * np.linalg.solve(wrench_cov, r), axis=(1, 2)))
        # Each pose is left out by (I - H_kk)^-1 r_k, without fitting again: exact for a linear model.
        J, noise = jacobian(parameters, R_base_flange) @ free, Noise(wrench_cov, kept=weights > 0)
        WJ = noise.solve(J)
        information = summed_products(J, WJ)
        # Radians, newtons and metres stand side by side: without the scale the smallest eigenvalues count as zero.
        scale = column_scale(information)
        C = np.asarray(np.linalg.pinv(information / np.outer(scale, scale), hermitian=True)) / np.outer(scale, scale)
        return cls(
            parameters,
            covariance,
            R_base_flange,
            wrench,
            weights,
            residuals,
            *left_out(noise, WJ, noise.solve(r)[..., 0], C),
            chi2,
            chi2 if measured else float("nan"),
            6 * int(weights.sum()) - int(free.shape[1]),
            second_basin_chi2,
            components or {},
        )


def standardize(residuals: Array, covariance: Array) -> Array:
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


# From pose to pose, if their times are not known.
USUAL_INTERVAL_S = 10.0
# From the last pose to the next use.
NEXT_USE_S = 60.0
HOUR = 3600.0 / NEXT_USE_S
# A linear drift is mostly the beginning of a warm-up, of 10 to 30 min.
WARM_UP = 1200.0 / NEXT_USE_S


@dataclass(frozen=True, slots=True, eq=False)
class DriftAhead:
    """The bias at the next use, a minute after the last pose, less that of the result; zero without drift."""

    growth_per_min: Array
    """(6,) change in the next minute: its size if the bias is linear in time, its standard deviation if it walks."""
    square: Array
    """(6,) expected square at the next use."""
    hour_square: Array
    """(6,) the same an hour after the last pose."""


def drift_ahead(fit: Judged, t_s: Array | None = None) -> DriftAhead:
    """Extrapolate the drift of a fit; without finite times `t_s` (n,) one pose every 10 s in their order."""
    if fit.drift is None or fit.drift.course is None:
        return DriftAhead(*np.zeros((3, 6)))
    n = len(fit.weights)
    timed = t_s is not None and np.isfinite(t_s).all() and np.ptp(t_s) > 0
    time = np.asarray(t_s if timed else USUAL_INTERVAL_S * np.arange(n), dtype=np.float64)
    used = np.flatnonzero(fit.weights > 0)
    first, last = used[np.argmin(time[used])], used[np.argmax(time[used])]
    intervals = NEXT_USE_S * (n - 1) / np.ptp(time)
    walk = np.zeros(6)
    for channels in (FORCE, TORQUE, *([c] for c in range(6))):
        # A random walk has no direction: only its variance grows until the next use.
        walk[channels] += intervals * fit.components.get(component("walk", channels).name, 0.0) ** 2
    linear = np.where(walk > 0, 0.0, fit.drift.change * NEXT_USE_S / (time[last] - time[first]))
    # The change from the first pose to the last has the errors of both ends.
    known = fit.drift.sigma**2 / 2
    square = linear**2 + walk + known
    hour = (WARM_UP * (1 - np.exp(-HOUR / WARM_UP)) * linear) ** 2 + HOUR * walk + known
    return DriftAhead(np.sqrt(walk + linear**2), square, hour)
