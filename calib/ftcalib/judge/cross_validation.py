"""Cross-validated residuals in units of their covariance, and the drift until the next use.

Cross-validation interpolates a drift, but a calibration is used after its tour: `drift_ahead` extrapolates it.
"""

from dataclasses import dataclass

import numpy as np

from ftcalib.likelihood.fit import Estimate
from ftcalib.likelihood.session_noise import CHUNK
from ftcalib.likelihood.variance_components import FORCE, TORQUE, component
from ftcalib.model import Array


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


def drift_ahead(found: Estimate, t_s: Array | None = None) -> DriftAhead:
    """Extrapolate the drift that was found; without finite times `t_s` (n,) one pose every 10 s in their order."""
    if found.drift is None or found.drift.course is None:
        return DriftAhead(*np.zeros((3, 6)))
    n = len(found.weights)
    timed = t_s is not None and np.isfinite(t_s).all() and np.ptp(t_s) > 0
    time = np.asarray(t_s if timed else USUAL_INTERVAL_S * np.arange(n), dtype=np.float64)
    used = np.flatnonzero(found.weights > 0)
    first, last = used[np.argmin(time[used])], used[np.argmax(time[used])]
    intervals = NEXT_USE_S * (n - 1) / np.ptp(time)
    walk = np.zeros(6)
    for channels in (FORCE, TORQUE, *([c] for c in range(6))):
        # A random walk has no direction: only its variance grows until the next use.
        walk[channels] += intervals * found.components.get(component("walk", channels).name, 0.0) ** 2
    linear = np.where(walk > 0, 0.0, found.drift.change * NEXT_USE_S / (time[last] - time[first]))
    # The change from the first pose to the last has the errors of both ends.
    known = found.drift.sigma**2 / 2
    square = linear**2 + walk + known
    hour = (WARM_UP * (1 - np.exp(-HOUR / WARM_UP)) * linear) ** 2 + HOUR * walk + known
    return DriftAhead(np.sqrt(walk + linear**2), square, hour)
