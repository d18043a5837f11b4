"""Mean of a dwell, its covariance, and tests whether the dwell was quiet."""

from dataclasses import dataclass

import numpy as np
import scipy
from numpy.typing import NDArray

from ftcalib.errors import BadDataset
from ftcalib.model import Array

LEAST_SAMPLES = 20

CHANNELS = ("fx", "fy", "fz", "tx", "ty", "tz")

# Assumed sigma of a sensor without visible noise: 1 mN, and the torque of that at 25 mm, the usual ratio.
RESOLUTION = np.repeat([1e-3, 2.5e-5], 3)

# In less than 1 % of quiet dwells the halves differ by more than this many standard errors in any of six channels.
# Student's t with 18 degrees of freedom gives 3.7; the rest is for noise that is correlated in time. With 3 standard
# errors, 4 % of quiet dwells of 2 s fail, and 13 % behind a 5 Hz filter: one pose or more in nearly every tour.
QUIET = 4.5

# A dwell that scatters more than this factor times the noise of the sensor is not quiet, even if its halves agree.
RESTLESS = 2.0

# Differences of this size, relative to the largest value, are rounding errors.
ROUNDING = 1e-9


@dataclass(frozen=True, slots=True, eq=False)
class PoseMean:
    """Mean wrench of one dwell."""

    mean: Array
    """(6,) N and N·m."""
    covariance: Array
    """(6, 6) of the mean, positive definite."""


def mean_and_covariance(wrench: Array) -> PoseMean:
    """Average a dwell, with a covariance that allows for correlation in time and coarse quantisation.

    The variance of a mean is tau s² / N with tau the integrated autocorrelation time, here from Geyer's initial
    monotone sequence (Practical Markov Chain Monte Carlo, Stat. Sci. 7, 1992) with Wolff's correction for the
    subtracted mean (Comput. Phys. Commun. 156, 2004). The mean has the correlation of the samples between channels. If
    the noise of a channel is smaller than its quantisation step, averaging does not help, and the step counts instead.

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
    for kind in (slice(0, 3), slice(3, 6)):  # a channel without noise gets the variance of its noisiest neighbour
        silent = variance[kind] == 0
        variance[kind][silent] = variance[kind].max() or RESOLUTION[kind][silent] ** 2
    safe = np.where(std > 0, std, 1.0)
    shrink = min(1.0, 6 / N)  # keeps the matrix positive definite if channels are copies
    correlation = (1 - shrink) * S / np.outer(safe, safe)
    np.fill_diagonal(correlation, 1.0)
    sigma = np.sqrt(variance)
    return PoseMean(mean, correlation * np.outer(sigma, sigma))


def is_stationary(wrench: Array) -> bool:
    """Check whether the two halves of a dwell have the same mean in every channel, within the noise.

    The standard error of their difference comes from 20 batch means, ten in each half, so that it holds for filtered
    noise. Pure noise fails in less than 1 % of dwells. A jolt much shorter than half the dwell increases the standard
    error as much as the difference, and passes.

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
    """Standard deviation (6,) of an untouched sensor: the median over windows, little affected by contact or drift.

    Parameters
    ----------
    wrench : array, shape (N, 6)
        Consecutive samples of the arm at rest, N and N·m.
    window : int
        Samples in a window, 20 to N; as many as in the dwells to compare with it.

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
    """Check whether a dwell is stationary and scatters at most twice as much as the untouched sensor.

    The scatter shows vibration, a hand on the tool and short jolts, which equal halves hide. Pure noise never doubles,
    so quiet dwells fail as rarely as in `is_stationary`: of 2 s at 500 Hz 0.15 % of white noise, 0.4 % behind a
    low-pass of 10 Hz, 0.9 % of 5 Hz, 6 % of 2 Hz, because 2 s contain few independent samples.

    Parameters
    ----------
    wrench : array, shape (N, 6)
        Consecutive samples, N and N·m; N >= 20.
    level : array, shape (6,)
        From `noise_level`.

    Raises
    ------
    BadDataset
        Too few samples, or a value that is not finite.
    """
    return is_stationary(wrench) and not restless_channels(wrench, level).any()


def restless_channels(wrench: Array, level: Array) -> NDArray[np.bool_]:
    """Find the channels (6,) of a dwell that scatter more than twice as much as the untouched sensor."""
    wrench = checked(wrench)
    flicker = _step(wrench) / 2  # between two neighbouring values, normal for a sensor with coarse steps
    return np.asarray(wrench.std(axis=0, ddof=1) > RESTLESS * level + flicker + ROUNDING * np.abs(wrench).max(axis=0))


def checked(wrench: Array) -> Array:
    """Check (N, 6) samples: N >= 20 and all finite. Raises `BadDataset`."""
    wrench = np.asarray(wrench, dtype=np.float64)
    if wrench.ndim != 2 or wrench.shape[1] != 6 or len(wrench) < LEAST_SAMPLES:
        raise BadDataset(f"a dwell has shape {wrench.shape}, expected (N, 6) with N >= {LEAST_SAMPLES}: record longer.")
    for i, j in np.argwhere(~np.isfinite(wrench)):
        raise BadDataset(f"sample {i + 1}: wrench[{j}] is {wrench[i, j]}, not a finite number.")
    return wrench


def _autocorrelation_time(noise: Array) -> Array:
    """Integrated autocorrelation time (6,) in samples: 1 for white noise, and for a channel without noise."""
    N = len(noise)
    fft = scipy.fft
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
    """Variance (6,) of the rounding error in a mean: q²/12 without noise, zero with enough noise.

    Gaussian noise of sigma dithers the error away by exp(-4 pi² sigma² / q²) (Widrow, Kollar, Quantization Noise,
    2008); the rounded samples may add q²/4 to the observed variance.
    """
    step = _step(wrench)
    dither = np.maximum(std**2 - step**2 / 4, 0) / np.where(step > 0, step, 1.0) ** 2
    return np.asarray(step**2 / 12 * np.exp(-4 * np.pi**2 * dither))


def _step(wrench: Array) -> Array:
    """Smallest difference (6,) between two values of a channel, 0 for a constant channel."""
    gaps = np.diff(np.sort(wrench, axis=0), axis=0)
    step = np.where(gaps > ROUNDING * np.abs(wrench).max(axis=0), gaps, np.inf).min(axis=0)
    return np.where(np.isfinite(step), step, 0.0)
