"""Differences between calibrations, drift onsets, trends, and the dependence of the bias on temperature."""

from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import NamedTuple, Protocol

import numpy as np
import scipy  # submodules are imported at their first use, so that listing calibrations starts fast
from numpy.typing import NDArray

from ftcalib.model import Array, Parameters, read_only

# Difference between two calibrations in standard deviations, and its joint test.

# A standard deviation below this share of the largest is a rounding error: the value was exactly known.
_KNOWN = 1e-9
# Eigenvalues of a correlation matrix below this share of the largest are rounding errors.
_SINGULAR = 1e-10
# Smallest significant difference along a direction that both calibrations take as exactly known.
_ROUNDING_SIGMAS = 1e-3


class EstimatedParameters(Protocol):
    """Parameters with covariance: a calibration, an update of a calibration, or a row of a store."""

    @property
    def parameters(self) -> Parameters:
        """Estimated parameters of sensor and tool."""

    @property
    def covariance(self) -> Array:
        """(15, 15) covariance of the error coordinates `ftcalib.model.PARAMETER_NAMES`."""


@dataclass(frozen=True, slots=True)
class ChiSquare:
    """Chi-square test of the hypothesis that two calibrations do not differ."""

    chi2: float
    """Squared Mahalanobis distance; infinite if exactly known values differ."""
    dof: int
    p_value: float


@dataclass(frozen=True, slots=True, eq=False)
class Difference:
    """Difference between two calibrations: the second minus the first."""

    change: Array
    """(15,) difference in the error coordinates `ftcalib.model.PARAMETER_NAMES`; rotation about flange axes, rad."""
    sigma: Array
    """(15,) standard deviation of the difference; 0 if both calibrations share a value or take it as exactly known."""
    joint: ChiSquare
    """Joint chi-square test of all parameters that are not identical in both calibrations."""
    groups: Mapping[str, ChiSquare]
    """Chi-square test of each field of `Parameters`, by the name of the field."""

    @property
    def in_sigmas(self) -> Array:
        """(15,) change divided by sigma; 0 for shared values, infinite if exactly known values differ."""
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.asarray(np.where(self.change == 0, 0.0, self.change / self.sigma))


def calibration_difference(first: EstimatedParameters, second: EstimatedParameters) -> Difference:
    """Return the difference between two calibrations whose errors are independent.

    A field that is identical in both calibrations was copied, for example by an update of the bias. It is left out of
    the joint test, because its error is common. Gain and cross-talk of the sensor are not compared.

    Returns
    -------
    Difference
        Its covariance is the sum of both. The mountings are R1 = exp(-d1) R and R2 = exp(-d2) R, with small errors d
        about the flange axes, so the error d1 is rotated into the axes of the second mounting before adding.
    """
    old, new = first.parameters, second.parameters
    change = old.difference(new)
    # The left Jacobian of the rotation cancels in the Mahalanobis distance, because it does not change the axis.
    turn = scipy.linalg.block_diag(new.R_flange_sensor @ old.R_flange_sensor.T, np.eye(12))
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
    """Return the chi-square test of some rows of a difference. Values without variance must be equal."""
    sigma = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    known = sigma[rows] <= _KNOWN * sigma.max()
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
    return ChiSquare(chi2, dof, float(scipy.special.chdtrc(dof, chi2)))


# Drift onset: the beginning of a linear change of the bias in a series of verifications of one calibration.
#
# The changes d_i of a component of the bias since the calibration, at times t_i, are modelled by
#
#     d_i = c + s max(0, t_i - t0) + e_i,    e_i ~ N(0, sigma_i^2),    c ~ N(0, sigma_c^2),
#
# with the common error c of the calibration. For each onset t0, c and s are estimated by generalised least squares. The
# t0 with the largest chi2 of s is selected (Hinkley, J. Am. Stat. Assoc. 66, 1971). As in `trend`, s must be
# significant compared with the stated sigmas and with the scatter about the line (F test).
#
# A sudden change, such as a tare, a knock or one bad verification, also increases this chi2. The onset therefore
# competes with a step at any t1:
#
#     d_i = c + b [t_i >= t1] + e_i.
#
# If a step is significant and fits better than any onset, the series is restarted at t1 with a free c.

# Smallest number of verifications for a drift onset, because fewer do not show their scatter.
FEWEST = 6
# Largest p-value of a significant onset, for one component in one analysis. It allows for the search over onsets, six
# components and 365 analyses a year. Simulated false alarms and delays: docs/contributing/figures/fleet.md.
SIGNIFICANT = 1e-5
# Shortest duration of a drift; a more recent change may be a step.
LEAST_DAYS = 7.0
# If the series begins more than this after the calibration, the error of the calibration no longer constrains c.
_NEAR_DAYS = 14.0
# Smallest difference in chi2 by which a step fits better than an onset: odds of 20 to 1.
CLEARLY = 6.0


@dataclass(frozen=True, slots=True, eq=False)
class DriftOnset:
    """Likeliest drift onset of each of k components of the bias; arrays (k,)."""

    found: NDArray[np.bool_]
    """Whether the component drifts significantly."""
    t0_days: Array
    """Time from the calibration to the onset of the drift, days."""
    slope: Array
    """Change of the bias per day since the onset of the drift, N/d and N·m/d."""
    sigma: Array
    """Standard deviation of the slope, from the stated sigmas or from the scatter, whichever is larger."""
    p_value: Array
    """p-value of the slope for a single given onset and component, without allowance for the search."""

    def __post_init__(self) -> None:
        for name in ("t0_days", "slope", "sigma", "p_value"):
            object.__setattr__(self, name, read_only(getattr(self, name)))


def drift_onset(t_days: Array, change: Array, sigma: Array, calibration_sigma: Array) -> DriftOnset | None:
    """Return the drift onset in a series of verifications; None if there are too few since the last step.

    Parameters
    ----------
    t_days : array, shape (n,)
        Times since the calibration in ascending order, at any spacing.
    change : array, shape (n, k)
        Changes of the bias since the calibration, from `ftcalib.after.verification`.
    sigma : array, shape (n, k)
        Standard deviations due to the readings of each verification, positive.
    calibration_sigma : array, shape (k,)
        Standard deviations due to the calibration, common to all verifications.
    """
    if len(t_days) < FEWEST:
        return None
    weight, known = 1 / np.square(sigma), 1 / np.maximum(np.square(calibration_sigma), 1e-12 * np.square(sigma[0]))
    near = t_days[0] <= _NEAR_DAYS
    if not near:
        known = np.zeros_like(known)
    first = 0
    while len(t_days) - first >= FEWEST:
        t, d, w = t_days[first:], change[first:], weight[first:]
        chi2 = np.sum(w * d * d, axis=0) - np.sum(w * d, axis=0) ** 2 / (np.sum(w, axis=0) + known)
        ramp, slope, slope_sigma, t0 = _onsets(t, d, w, known, from_calibration=near and first == 0)
        step, after = _best_steps(d, w, known)
        p_ramp, p_step = (_p_value(part, chi2, len(t) - 3) for part in (ramp, step))
        ahead = np.where(p_step < SIGNIFICANT, step - ramp, -np.inf)
        if ahead.max() <= CLEARLY:
            scatter = np.maximum((chi2 - ramp) / (len(t) - 3), 1.0)
            return DriftOnset(p_ramp < SIGNIFICANT, t0, slope, slope_sigma * np.sqrt(scatter), p_ramp)
        first += int(after[ahead.argmax()])
        known = np.zeros_like(known)
    return None


def _onsets(t: Array, d: Array, w: Array, known: Array, *, from_calibration: bool) -> tuple[Array, Array, Array, Array]:
    """Return chi2, slope, sigma of the slope and time (k,) of the best onset, at a verification or the calibration."""
    t0 = t[t <= t[-1] - LEAST_DAYS]
    if from_calibration:
        t0 = np.append(0.0, t0)
    if not len(t0):
        t0 = t[:1]
    later = np.searchsorted(t, t0, side="right")  # index of the first verification after each trial onset
    x = t[:, None]
    W, Wt, Wtt, Wd, Wtd = (_reversed_sums(part)[later] for part in (w, w * x, w * x * x, w * d, w * x * d))
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


def _best_steps(d: Array, w: Array, known: Array) -> tuple[Array, Array]:
    """Return chi2 of the best step and the row (k,) of the first verification after it."""
    A, B = np.sum(w, axis=0) + known, _reversed_sums(w)[:-1]
    y = A * _reversed_sums(w * d)[:-1] - B * np.sum(w * d, axis=0)
    determinant = B * (A - B)
    usable = determinant > 1e-9 * A * A
    chi2 = np.where(usable, y * y / (A * np.where(usable, determinant, 1.0)), 0.0)
    best = chi2.argmax(axis=0)
    return chi2[best, np.arange(d.shape[1])], best


def _reversed_sums(rows: Array) -> Array:
    """Return the sums (n + 1, k) of each row and all later rows; the last row is 0."""
    return np.concatenate([np.cumsum(rows[::-1], axis=0)[::-1], np.zeros((1, rows.shape[1]))])


def _p_value(chi2: Array, total: Array, dof: int) -> Array:
    """Return the larger of two p-values of a coefficient: with the stated sigmas, and with the observed scatter."""
    rest = np.maximum(total - chi2, 1e-12) / dof
    return np.maximum(scipy.special.chdtrc(1, chi2), scipy.special.fdtrc(1, dof, chi2 / rest))


# Linear trend of an estimate over successive calibrations, and its significance.

# Smallest number of estimates for a trend, because two points show no scatter about a line.
FEWEST_ESTIMATES = 3


@dataclass(frozen=True, slots=True, eq=False)
class Trend:
    """Weighted straight line over time through n estimates of k numbers, and the test of its slope."""

    slope: Array
    """(k,) change of the estimated numbers per unit of `t`."""
    sigma: Array
    """(k,) standard deviation of the slope, from the covariances or from the scatter, whichever is larger."""
    p_value: float
    """Probability of a larger slope, in any direction, without a linear change."""
    n: int


def trend(t: Array, values: Array, covariance: Array) -> Trend:
    """Return a line fitted by generalised least squares, with a test of its slope against zero.

    The slope is tested with the stated covariances (chi-square, k degrees of freedom) and with the scatter about the
    line (F test, k and k (n - 2)). The p-value is the larger of the two, so both must show the trend.

    Parameters
    ----------
    t : array, shape (n,)
        Times; n >= 3, not all equal.
    values : array, shape (n, k)
    covariance : array, shape (n, k, k)
        Covariance of each row, positive definite; the rows are independent.

    Raises
    ------
    ValueError
        Too few rows, all at one time, or a covariance that is not positive definite.
    """
    t, values = np.asarray(t, dtype=np.float64), np.asarray(values, dtype=np.float64)
    n, k = values.shape
    if n < FEWEST_ESTIMATES or np.ptp(t) == 0:
        raise ValueError(f"{n} estimates at {len(np.unique(t))} times show no trend: give {FEWEST_ESTIMATES} or more")
    try:
        whiten = np.linalg.inv(np.linalg.cholesky(covariance))  # (n, k, k)
    except np.linalg.LinAlgError as error:
        raise ValueError("a covariance is not positive definite: exclude values that were taken as known") from error
    scale = float(np.ptp(t))
    design = np.concatenate([whiten, whiten * ((t - t.mean()) / scale)[:, None, None]], axis=2).reshape(n * k, 2 * k)
    readings = (whiten @ (values - values.mean(axis=0))[..., None]).reshape(n * k)
    inverse = np.linalg.inv(design.T @ design)
    x = inverse @ design.T @ readings
    slope, slope_cov = x[k:], inverse[k:, k:]
    dof = k * (n - 2)
    scatter = float(np.sum((readings - design @ x) ** 2)) / dof
    chi2 = float(slope @ np.linalg.solve(slope_cov, slope))
    against_scatter = scipy.special.fdtrc(k, dof, chi2 / k / scatter) if scatter > 0 else 0.0
    sigma = np.sqrt(np.diag(slope_cov) * max(scatter, 1.0))
    return Trend(slope / scale, sigma / scale, float(max(scipy.special.chdtrc(k, chi2), against_scatter)), n)


# Dependence of the bias on the temperature of the sensor, over calibrations and verifications.
#
# A component of the bias is y = a + c (T - T0) + s + w(t), with a scatter s from run to run and a random walk w. Their
# variances are averaged over the restricted likelihood, with common values for the components of force and for those of
# torque, so a walk that resembles the temperature increases the sigma of c. Leave-one-out predictions have a closed
# form. The temperature is used only if it predicts left-out runs better than the other runs alone.

# Smallest difference between the coldest and the warmest run, K.
_LEAST_K = 3.0
# Largest p-value of a temperature slope of the bias that is used for predictions.
SURE = 1e-3
# Largest number of runs; older runs are ignored, because the random walk makes them irrelevant.
_MOST = 100
# Trial values of scatter and walk, relative to the standard deviation of the runs about their line.
_SHARES = np.array([0.0, 0.1, 0.2, 0.4, 0.7, 1.0, 1.5, 2.5])


@dataclass(frozen=True, slots=True, eq=False)
class BiasTemperature:
    """Linear dependence of the bias on the temperature of a sensor, force first, in sensor axes."""

    slope: Array
    """(6,) change of the bias per kelvin, N/K and N·m/K."""
    sigma: Array
    """(6,) standard deviation of the slope."""
    n: int
    """Number of runs (calibrations and verifications) from which the slope is estimated."""
    coldest_C: float
    warmest_C: float
    error: Array
    """(2,) leave-one-out rms error per axis of the bias predicted from the temperature: forces, N; torques, N·m."""
    error_without: Array
    """(2,) leave-one-out rms error per axis of the bias predicted without it: forces, N; torques, N·m."""
    p_value: Array
    """(2,) p-values of the slopes of force and torque."""

    @property
    def predicts(self) -> tuple[bool, bool]:
        """(2,) whether the temperature improves the prediction of the force bias, and of the torque bias."""
        force, torque = (self.error < self.error_without) & (self.p_value < SURE)
        return bool(force), bool(torque)

    def change(self, from_C: float, to_C: float) -> tuple[Array, Array]:
        """Return the bias change (6,) between two temperatures, and its sigma; both 0 where `predicts` is false.

        Temperatures beyond those of the runs are clipped to the nearest of them.
        """
        used = np.repeat(self.predicts, 3)
        step_K = float(np.diff(np.clip([from_C, to_C], self.coldest_C, self.warmest_C))[0])
        return np.where(used, self.slope * step_K, 0.0), np.where(used, self.sigma * abs(step_K), 0.0)


def spans_temperature(temperature_C: Array, fewest: int) -> bool:
    """Whether a dependence can be estimated, which takes at least `fewest` runs that span at least 3 K."""
    return len(temperature_C) >= fewest and bool(np.ptp(temperature_C) >= _LEAST_K)


def bias_temperature(t_days: Array, temperature_C: Array, bias: Array, sigma: Array) -> BiasTemperature | None:
    """Return the dependence of the bias of one sensor, in one mounting, on its temperature.

    Parameters
    ----------
    t_days : array, shape (n,)
        Ascending times of the runs.
    temperature_C : array, shape (n,)
    bias : array, shape (n, 6)
        Bias of each run, N and N·m, in sensor axes.
    sigma : array, shape (n, 6)
        Standard deviation of each bias.

    Returns
    -------
    BiasTemperature or None
        None for fewer than 6 runs, or for runs that span less than 3 K.
    """
    columns = (t_days, temperature_C, bias, sigma)
    t_days, T, y, sigma = (np.asarray(column, dtype=np.float64)[-_MOST:] for column in columns)
    n = len(T)
    if not spans_temperature(T, FEWEST):
        return None
    alone = np.ones((n, 1))
    line = np.column_stack([alone, T - T.mean()])
    walk = np.minimum.outer(t_days - t_days[0], t_days - t_days[0]) / max(float(np.ptp(t_days)), 1e-9)
    slope, error, errors, p_values = np.zeros((2, 6)), np.zeros(2), np.zeros(2), np.ones(2)
    for k, group in enumerate((slice(0, 3), slice(3, 6))):
        noise = np.mean(np.square(sigma[:, group]), axis=1)
        with_T, without = (_fit_columns(X, walk, y[:, group], noise) for X in (line, alone))
        slope[0, group], slope[1, group] = with_T.x[1], with_T.sigma
        error[k], errors[k] = with_T.left_out, without.left_out
        p_values[k] = scipy.special.fdtrc(3, 3 * (n - 2), float(np.mean(np.square(with_T.x[1] / with_T.sigma))))
    return BiasTemperature(slope[0], slope[1], n, float(T.min()), float(T.max()), error, errors, p_values)


class _TemperatureFit(NamedTuple):
    # (k, 3) coefficients of the k columns, for the three axes of force or torque.
    x: Array
    # (3,) standard deviation of the last coefficient, which is the temperature slope.
    sigma: Array
    # Leave-one-out rms error of the fit, over runs and axes.
    left_out: float


def _fit_columns(X: Array, walk: Array, y: Array, noise: Array) -> _TemperatureFit:
    """Return the fit of columns X (n, k) to components y (n, 3), averaged over scatter and walk by likelihood."""
    spread = float(np.mean(np.square(y - X @ np.linalg.lstsq(X, y, rcond=None)[0])))
    tried, likelihood = list[tuple[Array, float, Array]](), list[float]()
    for scatter in _SHARES**2 * spread:
        for walked in _SHARES**2 * spread:
            W = np.linalg.inv(np.diag(noise + scatter + 1e-9 * spread + 1e-24) + walked * walk)
            information = X.T @ W @ X
            C = np.linalg.inv(information)
            P = W - W @ X @ C @ X.T @ W  # matrix that maps the data y to weighted residuals
            left = P @ y
            tried.append((C @ X.T @ W @ y, float(C[-1, -1]), left / np.diag(P)[:, None]))
            determinants = 3 * (np.linalg.slogdet(W)[1] - np.linalg.slogdet(information)[1])
            likelihood.append((determinants - float(np.sum(y * left))) / 2)
    weights = np.exp(np.array(likelihood) - max(likelihood))
    weights /= weights.sum()
    x, variance, left_out = (np.array(values) for values in zip(*tried, strict=True))
    mean = np.tensordot(weights, x, 1)
    scattered = np.tensordot(weights, np.square(x[:, -1] - mean[-1]), 1)
    rms = float(np.sqrt(np.mean(np.square(np.tensordot(weights, left_out, 1)))))
    return _TemperatureFit(mean, np.sqrt(weights @ variance + scattered), rms)
