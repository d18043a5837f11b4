"""Bias of a sensor against its temperature, over calibrations and verifications, and whether that predicts anything.

A component of the bias is y = a + c (T - T0) + s + w(t): s scatters from run to run, w walks with the time. Both are
chosen by restricted likelihood, alike for the components of force and for those of torque, so that a walk which looks
like a temperature by chance widens the sigma of c. What a fit predicts of a run that it lacks has a closed form. A
temperature that does not predict such runs better than the other runs alone is of no use, however steep its slope.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.special import fdtrc as f_sf

from ftcalib.model import Array

FEWEST = 6
"""Runs."""
LEAST_K = 3.0
"""Between the coldest and the warmest run."""
SURE = 1e-3
"""Largest p-value of a slope that is used."""
_MOST = 100
"""Older runs do not count: their walk says little about today."""
_SHARES = np.array([0.0, 0.1, 0.2, 0.4, 0.7, 1.0, 1.5, 2.5])
"""Tried for scatter and walk, in standard deviations of the runs about their line."""


@dataclass(frozen=True, slots=True, eq=False)
class BiasTemperature:
    """Linear change of the bias with the temperature of a sensor, force first, sensor axes."""

    slope: Array
    """(6,) N/K and N·m/K."""
    sigma: Array
    """(6,) one standard deviation."""
    n: int
    """Runs."""
    coldest_C: float
    warmest_C: float
    error: Array
    """(2,) rms error of the bias of a run that was left out, an axis, predicted with the temperature; N and N·m."""
    error_without: Array
    """(2,) the same from the other runs alone."""
    p_value: Array
    """(2,) probability of steeper slopes if there is none, of force and torque."""

    @property
    def predicts(self) -> tuple[bool, bool]:
        """Whether force and torque of left-out runs are predicted better with the temperature."""
        force, torque = (self.error < self.error_without) & (self.p_value < SURE)
        return bool(force), bool(torque)

    def change(self, from_C: float, to_C: float) -> tuple[Array, Array]:
        """Return the change (6,) of the bias between two temperatures and its sigma; 0 where nothing is predicted.

        Beyond the temperatures of the runs it stays as at the nearest of them.
        """
        used = np.repeat(self.predicts, 3)
        step_K = float(np.diff(np.clip([from_C, to_C], self.coldest_C, self.warmest_C))[0])
        return np.where(used, self.slope * step_K, 0.0), np.where(used, self.sigma * abs(step_K), 0.0)


def bias_temperature(t_days: Array, temperature_C: Array, bias: Array, sigma: Array) -> BiasTemperature | None:
    """Fit the bias of one sensor, in one mounting, against its temperature.

    Parameters
    ----------
    t_days : array, shape (n,)
        Ascending.
    temperature_C : array, shape (n,)
    bias : array, shape (n, 6)
        N and N·m, sensor axes.
    sigma : array, shape (n, 6)
        One standard deviation of each.

    Returns
    -------
    BiasTemperature or None
        None for fewer than 6 runs, or within 3 K.
    """
    t_days, T, y, sigma = (np.asarray(one, dtype=np.float64)[-_MOST:] for one in (t_days, temperature_C, bias, sigma))
    n = len(T)
    if n < FEWEST or np.ptp(T) < LEAST_K:
        return None
    alone = np.ones((n, 1))
    line = np.column_stack([alone, T - T.mean()])
    walk = np.minimum.outer(t_days - t_days[0], t_days - t_days[0]) / max(float(np.ptp(t_days)), 1e-9)
    slope, error, errors, p_values = np.zeros((2, 6)), np.zeros(2), np.zeros(2), np.ones(2)
    for k, group in enumerate((slice(0, 3), slice(3, 6))):
        noise = np.mean(np.square(sigma[:, group]), axis=1)
        with_T, without = (_fitted(X, walk, y[:, group], noise) for X in (line, alone))
        slope[0, group], slope[1, group] = with_T.x[1], with_T.sigma
        error[k], errors[k] = with_T.left_out, without.left_out
        p_values[k] = f_sf(3, 3 * (n - 2), float(np.mean(np.square(with_T.x[1] / with_T.sigma))))
    return BiasTemperature(slope[0], slope[1], n, float(T.min()), float(T.max()), error, errors, p_values)


class _Fit(NamedTuple):
    x: Array
    """(k, 3) coefficients of the columns."""
    sigma: Array
    """(3,) of the last coefficient."""
    left_out: float
    """Rms of what each run differs from its prediction by the others."""


def _fitted(X: Array, walk: Array, y: Array, noise: Array) -> _Fit:
    """Fit columns X (n, k) to the components y (n, 3); each scatter and walk counts by its likelihood."""
    spread = float(np.mean(np.square(y - X @ np.linalg.lstsq(X, y, rcond=None)[0])))
    tried, likelihood = list[tuple[Array, float, Array]](), list[float]()
    for scatter in _SHARES**2 * spread:
        for walked in _SHARES**2 * spread:
            W = np.linalg.inv(np.diag(noise + scatter + 1e-9 * spread + 1e-24) + walked * walk)
            information = X.T @ W @ X
            C = np.linalg.inv(information)
            P = W - W @ X @ C @ X.T @ W  # what the columns leave, weighted
            left = P @ y
            tried.append((C @ X.T @ W @ y, float(C[-1, -1]), left / np.diag(P)[:, None]))
            determinants = 3 * (np.linalg.slogdet(W)[1] - np.linalg.slogdet(information)[1])
            likelihood.append((determinants - float(np.sum(y * left))) / 2)
    weights = np.exp(np.array(likelihood) - max(likelihood))
    weights /= weights.sum()
    x, variance, left_out = (np.array(one) for one in zip(*tried, strict=True))
    mean = np.tensordot(weights, x, 1)
    scattered = np.tensordot(weights, np.square(x[:, -1] - mean[-1]), 1)
    rms = float(np.sqrt(np.mean(np.square(np.tensordot(weights, left_out, 1)))))
    return _Fit(mean, np.sqrt(weights @ variance + scattered), rms)
