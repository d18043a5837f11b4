"""How well the mean of a dwell is known, and whether the dwell was quiet."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import fft

from calib.errors import BadDataset
from calib.model import Array

LEAST_SAMPLES = 20

CHANNELS = ("fx", "fy", "fz", "tx", "ty", "tz")

# What a sensor that shows no noise at all is still trusted to: 1 mN, and as much torque at 25 mm, the usual ratio.
RESOLUTION = np.repeat([1e-3, 2.5e-5], 3)

# Halves of a quiet dwell differ by more than this many standard errors in less than 1 % of dwells, six channels taken
# together. Student's t with 18 degrees of freedom asks for 3.7; the rest is for noise that is correlated in time. With
# 3 standard errors 4 % of quiet dwells of 2 s fail, 13 % behind a 5 Hz filter: a pose or more of nearly every tour.
QUIET = 4.5

# A dwell that scatters more than so many times the sensor's own noise is not quiet, whatever its halves say.
RESTLESS = 2.0

# Differences of this size, relative to the largest value, are rounding of the arithmetic.
ROUNDING = 1e-9


@dataclass(frozen=True, slots=True, eq=False)
class PoseMean:
    """Mean wrench of one dwell."""

    mean: Array
    """(6,) N and N·m."""
    covariance: Array
    """(6, 6) of the mean, positive definite."""
    n_effective: float
    """Number of independent samples that would be worth as much, for the worst channel."""


def mean_and_covariance(wrench: Array) -> PoseMean:
    """Average a dwell, with an honest covariance when samples are correlated in time or coarsely quantised.

    The variance of a mean is tau s² / N with tau the integrated autocorrelation time, here from Geyer's initial
    monotone sequence (Practical Markov Chain Monte Carlo, Stat. Sci. 7, 1992) with Wolff's correction for the
    subtracted mean (Comput. Phys. Commun. 156, 2004). Channels keep the correlation the samples have. Where the noise
    is smaller than the step of a quantised channel, averaging does not help and the step counts instead.

    Parameters
    ----------
    wrench : array, shape (N, 6)
        Consecutive samples, N and N·m; N >= 20.

    Raises
    ------
    BadDataset
        Too few samples, or a value that is not finite.
    """
    wrench = checked(wrench)
    N = len(wrench)
    mean = wrench.mean(axis=0)
    noise = wrench - mean
    noise[:, np.ptp(wrench, axis=0) <= ROUNDING * np.abs(wrench).max(axis=0)] = 0.0  # a constant channel
    S = noise.T @ noise / (N - 1)
    std = np.sqrt(np.diag(S))
    tau = _autocorrelation_time(noise)
    variance = tau * std**2 / N + quantisation_variance(wrench, std)
    for kind in (slice(0, 3), slice(3, 6)):  # a channel without noise is trusted like its noisiest neighbour
        silent = variance[kind] == 0
        variance[kind][silent] = variance[kind].max() or RESOLUTION[kind][silent] ** 2
    safe = np.where(std > 0, std, 1.0)
    shrink = min(1.0, 6 / N)  # keeps the matrix positive definite when channels copy each other
    correlation = (1 - shrink) * S / np.outer(safe, safe)
    np.fill_diagonal(correlation, 1.0)
    sigma = np.sqrt(variance)
    return PoseMean(mean, correlation * np.outer(sigma, sigma), float(N / tau.max()))


def is_stationary(wrench: Array) -> bool:
    """Tell whether the two halves of a dwell have the same mean in every channel, as far as noise allows.

    Their difference is compared with its standard error from 20 batch means, ten in each half, so that filtered noise
    is judged rightly. Pure noise fails in less than 1 % of dwells. A jolt much shorter than half the dwell widens the
    standard error as much as the difference and passes.

    Parameters
    ----------
    wrench : array, shape (N, 6)
        Consecutive samples, N and N·m; N >= 20.

    Raises
    ------
    BadDataset
        Too few samples, or a value that is not finite.
    """
    wrench = checked(wrench)
    size = len(wrench) // 20
    batches = wrench[: 20 * size].reshape(2, 10, size, 6).mean(axis=2)
    difference = np.abs(np.diff(batches.mean(axis=1), axis=0)[0])
    standard_error = np.sqrt(batches.var(axis=1, ddof=1).sum(axis=0) / 10)
    rounding = ROUNDING * np.abs(wrench).max(axis=0)
    return bool((difference <= QUIET * standard_error + rounding).all())


def noise_level(wrench: Array, window: int) -> Array:
    """Standard deviation (6,) of a sensor left alone: the median over windows, so that a touch or drift counts little.

    Parameters
    ----------
    wrench : array, shape (N, 6)
        Consecutive samples of the arm at rest, N and N·m.
    window : int
        Samples in a window, 20 to N; as many as in the dwells that will be compared with it.

    Raises
    ------
    BadDataset
        Too few samples, or a value that is not finite.
    """
    wrench = checked(wrench)
    if not LEAST_SAMPLES <= window <= len(wrench):
        raise BadDataset(f"a window of {window} samples does not fit a record of {len(wrench)}: choose 20 or more.")
    windows = wrench[: len(wrench) // window * window].reshape(-1, window, 6)
    return np.asarray(np.median(windows.std(axis=1, ddof=1), axis=0))


def is_quiet(wrench: Array, level: Array) -> bool:
    """Tell whether a dwell is stationary and scatters no more than twice as much as the sensor left alone.

    The scatter shows what equal halves hide: a vibration, a hand on the tool, a short jolt. Pure noise never doubles,
    so quiet dwells fail as seldom as in `is_stationary`: of 2 s at 500 Hz 0.15 % of white noise, 0.4 % behind a
    low-pass of 10 Hz, 0.9 % of 5 Hz, 6 % of 2 Hz, where 2 s hold few independent samples.

    Parameters
    ----------
    wrench : array, shape (N, 6)
        Consecutive samples, N and N·m; N >= 20.
    level : array, shape (6,)
        As `noise_level` gives it.

    Raises
    ------
    BadDataset
        Too few samples, or a value that is not finite.
    """
    return is_stationary(wrench) and not restless_channels(wrench, level).any()


def restless_channels(wrench: Array, level: Array) -> NDArray[np.bool_]:
    """Tell which channels (6,) of a dwell scatter more than twice as much as the sensor left alone."""
    wrench = checked(wrench)
    flicker = _step(wrench) / 2  # between two neighbouring numbers, as a sensor with coarse steps may at any time
    return np.asarray(wrench.std(axis=0, ddof=1) > RESTLESS * level + flicker + ROUNDING * np.abs(wrench).max(axis=0))


def checked(wrench: Array) -> Array:
    """Give (N, 6) samples that can be judged, N >= 20 and all finite; raises `BadDataset`."""
    wrench = np.asarray(wrench, dtype=np.float64)
    if wrench.ndim != 2 or wrench.shape[1] != 6 or len(wrench) < LEAST_SAMPLES:
        raise BadDataset(f"a dwell has shape {wrench.shape}, expected (N, 6) with N >= {LEAST_SAMPLES}: record longer.")
    for i, j in np.argwhere(~np.isfinite(wrench)):
        raise BadDataset(f"sample {i + 1}: wrench[{j}] is {wrench[i, j]}, not a finite number.")
    return wrench


def _autocorrelation_time(noise: Array) -> Array:
    """Integrated autocorrelation time (6,) in samples: 1 for white noise, and for a channel without noise."""
    N = len(noise)
    spectrum = np.abs(fft.rfft(noise, fft.next_fast_len(2 * N, real=True), axis=0)) ** 2
    gamma = fft.irfft(spectrum, fft.next_fast_len(2 * N, real=True), axis=0)[: N // 2 * 2]
    pairs = gamma[0::2] + gamma[1::2]
    tau = np.ones(noise.shape[1])
    for c in np.flatnonzero(noise.any(axis=0)):
        negative = np.flatnonzero(pairs[:, c] <= 0)
        m = int(negative[0]) if negative.size else len(pairs)
        monotone = np.minimum.accumulate(pairs[:m, c])
        tau[c] = (2 * monotone.sum() / gamma[0, c] - 1) * (1 + (4 * m - 1) / N)
    return np.maximum(tau, 0.1)


def quantisation_variance(wrench: Array, std: Array) -> Array:
    """Variance (6,) of the error that rounding to steps leaves in a mean: q²/12 without noise, none with enough of it.

    Gaussian noise of sigma dithers the error away by exp(-4 pi² sigma² / q²) (Widrow, Kollar, Quantization Noise,
    2008); the rounded samples themselves may add q²/4 to the variance that is seen.
    """
    step = _step(wrench)
    dither = np.maximum(std**2 - step**2 / 4, 0) / np.where(step > 0, step, 1.0) ** 2
    return np.asarray(step**2 / 12 * np.exp(-4 * np.pi**2 * dither))


def _step(wrench: Array) -> Array:
    """Smallest difference (6,) between two numbers of a channel, 0 for a constant one."""
    gaps = np.diff(np.sort(wrench, axis=0), axis=0)
    step = np.where(gaps > ROUNDING * np.abs(wrench).max(axis=0), gaps, np.inf).min(axis=0)
    return np.where(np.isfinite(step), step, 0.0)
