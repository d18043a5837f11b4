"""Whether a bias has begun to drift: the onset of a linear change in a series of verifications of one calibration.

A component of the bias, as changes d_i since the calibration at times t_i, is modelled by

    d_i = c + s max(0, t_i - t0) + e_i,    e_i ~ N(0, sigma_i^2),    c ~ N(0, sigma_c^2),

with the common error c of the calibration. For each onset t0, c and s are estimated by generalised least squares. The
t0 with the largest chi2 of s counts (Hinkley, J. Am. Stat. Assoc. 66, 1971). As in `trend`, s must be significant
against the stated sigmas and against the scatter about the line (F test).

A sudden change, such as a tare, a knock or one bad verification, raises the same statistic. So a step at any t1
competes:

    d_i = c + b [t_i >= t1] + e_i.

Where a step is significant and fits better than any onset, the series begins again at t1 with a free c.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtrc as chi2_sf
from scipy.special import fdtrc as f_sf

from ftcalib.model import Array, read_only

FEWEST = 6
"""Verifications: fewer do not show their scatter."""
SIGNIFICANT = 1e-5
"""Largest p-value of an onset that counts, in one component at one look. It allows for the search over onsets, six
components and 365 looks a year: false alarms and delays in simulation are in docs/reference/figures/fleet.md."""
LEAST_DAYS = 7.0
"""A drift has gone on for so long: a sudden change of the last days is no drift yet."""
NEAR_DAYS = 14.0
"""If the series begins later, the error of the calibration limits its level no more, because more may have changed."""
CLEARLY = 6.0
"""A step fits better than an onset if its chi2 is larger by this: odds of 20 to 1."""


@dataclass(frozen=True, slots=True, eq=False)
class DriftOnset:
    """Likeliest onset of each of k components; arrays (k,)."""

    found: NDArray[np.bool_]
    """Whether the component drifts."""
    t0_days: Array
    """When it began."""
    slope: Array
    """Change a day since then."""
    sigma: Array
    """One standard deviation of that, by the stated sigmas or by the scatter if that is larger."""
    p_value: Array
    """Of the slope, for one onset and one component."""
    since_days: float
    """Time of the first verification that counts: the series begins again after a step."""

    def __post_init__(self) -> None:
        for name in ("t0_days", "slope", "sigma", "p_value"):
            object.__setattr__(self, name, read_only(getattr(self, name)))


def drift_onset(t_days: Array, change: Array, sigma: Array, calibration_sigma: Array) -> DriftOnset | None:
    """Search the onset of a drift in a series of verifications; None if there are too few since the last step.

    Parameters
    ----------
    t_days : array, shape (n,)
        Since the calibration, in ascending order; any spacing.
    change : array, shape (n, k)
        Of the bias since the calibration, as `ftcalib.extras.bias_change` estimates it.
    sigma : array, shape (n, k)
        Of the readings of each verification, positive.
    calibration_sigma : array, shape (k,)
        Of the calibration, common to all.
    """
    if len(t_days) < FEWEST:
        return None
    weight, known = 1 / np.square(sigma), 1 / np.maximum(np.square(calibration_sigma), 1e-12 * np.square(sigma[0]))
    near = t_days[0] <= NEAR_DAYS
    if not near:
        known = np.zeros_like(known)
    first = 0
    while len(t_days) - first >= FEWEST:
        t, d, w = t_days[first:], change[first:], weight[first:]
        chi2 = np.sum(w * d * d, axis=0) - np.sum(w * d, axis=0) ** 2 / (np.sum(w, axis=0) + known)
        ramp, slope, slope_sigma, t0 = _onsets(t, d, w, known, from_calibration=near and first == 0)
        step, after = _steps(d, w, known)
        p_ramp, p_step = (_p_value(one, chi2, len(t) - 3) for one in (ramp, step))
        ahead = np.where(p_step < SIGNIFICANT, step - ramp, -np.inf)
        if ahead.max() <= CLEARLY:
            scatter = np.maximum((chi2 - ramp) / (len(t) - 3), 1.0)
            found = p_ramp < SIGNIFICANT
            return DriftOnset(found, t0, slope, slope_sigma * np.sqrt(scatter), p_ramp, float(t[0]))
        first += int(after[ahead.argmax()])
        known = np.zeros_like(known)
    return None


def _onsets(t: Array, d: Array, w: Array, known: Array, *, from_calibration: bool) -> tuple[Array, Array, Array, Array]:
    """Return chi2, slope, its sigma and onset (k,) of the best onset, at a verification or at the calibration."""
    t0 = t[t <= t[-1] - LEAST_DAYS]
    if from_calibration:
        t0 = np.append(0.0, t0)
    if not len(t0):
        t0 = t[:1]
    later = np.searchsorted(t, t0, side="right")  # the first verification after each onset
    x = t[:, None]
    W, Wt, Wtt, Wd, Wtd = (_from_here(part)[later] for part in (w, w * x, w * x * x, w * d, w * x * d))
    z = t0[:, None]
    A, B, D = np.sum(w, axis=0) + known, Wt - z * W, Wtt - 2 * z * Wt + z * z * W
    y = A * (Wtd - z * Wd) - B * np.sum(w * d, axis=0)
    determinant = A * D - B * B
    usable = determinant > 1e-9 * A * D
    determinant = np.where(usable, determinant, 1.0)
    chi2 = np.where(usable, y * y / (A * determinant), 0.0)
    best, each = chi2.argmax(axis=0), np.arange(d.shape[1])
    slope, variance = y / determinant, A / determinant
    return chi2[best, each], slope[best, each], np.sqrt(variance[best, each]), t0[best]


def _steps(d: Array, w: Array, known: Array) -> tuple[Array, Array]:
    """Return chi2 and row (k,) of the best step, which is the first verification after it."""
    A, B = np.sum(w, axis=0) + known, _from_here(w)[:-1]
    y = A * _from_here(w * d)[:-1] - B * np.sum(w * d, axis=0)
    determinant = B * (A - B)
    usable = determinant > 1e-9 * A * A
    chi2 = np.where(usable, y * y / (A * np.where(usable, determinant, 1.0)), 0.0)
    best = chi2.argmax(axis=0)
    return chi2[best, np.arange(d.shape[1])], best


def _from_here(rows: Array) -> Array:
    """Return the sums (n + 1, k) of each row and all later ones, the last of which is none."""
    return np.concatenate([np.cumsum(rows[::-1], axis=0)[::-1], np.zeros((1, rows.shape[1]))])


def _p_value(chi2: Array, total: Array, dof: int) -> Array:
    """Return the larger p-value of one coefficient: against the stated sigmas, and against the scatter."""
    rest = np.maximum(total - chi2, 1e-12) / dof
    return np.maximum(chi2_sf(1, chi2), f_sf(1, dof, chi2 / rest))
