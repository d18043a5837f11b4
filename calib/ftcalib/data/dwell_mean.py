"""Mean and covariance of a dwell, tests for a quiet dwell, and the choice of the averaging time."""

from dataclasses import dataclass

import numpy as np
import scipy
from numpy.typing import NDArray

from ftcalib.errors import BadDataset
from ftcalib.model import Array

LEAST_SAMPLES = 20

CHANNELS = ("fx", "fy", "fz", "tx", "ty", "tz")

# Assumed sigma of a sensor without visible noise: 1 mN, and the torque of this force at the usual lever of 25 mm.
RESOLUTION = np.repeat([1e-3, 2.5e-5], 3)

# In less than 1 % of quiet dwells the halves differ by more than this many standard errors in any of six channels.
# Student's t with 18 degrees of freedom gives 3.7; the margin allows for correlated noise. With 3 standard errors, 4 %
# of quiet dwells of 2 s would fail, and 13 % after a 5 Hz filter: at least one pose in nearly every tour.
QUIET = 4.5

# A dwell with more than this factor times the noise of the sensor is not quiet, even if its halves agree.
RESTLESS = 2.0

# Frequencies at which a weight swings on a string of 100 to 500 mm.
SWING_HZ = (0.7, 1.6)
# Smallest share of the variance of all channels that a swing explains; fits to white noise do not reach it.
SWING_SHARE = 0.25
# Number of block means of a dwell that are searched for the frequency of a swing.
SWING_BLOCKS = 200

# Differences below this share of the largest value are rounding errors.
ROUNDING = 1e-9


@dataclass(frozen=True, slots=True, eq=False)
class PoseMean:
    """Mean wrench of one dwell."""

    mean: Array
    """(6,) mean wrench, N and N·m."""
    covariance: Array
    """(6, 6) covariance of the mean, positive definite."""


def mean_and_covariance(wrench: Array) -> PoseMean:
    """Return the mean of a dwell with its covariance, which accounts for autocorrelation and quantisation.

    The variance of a mean is tau s² / N with tau the integrated autocorrelation time, here from Geyer's initial
    monotone sequence (Practical Markov Chain Monte Carlo, Stat. Sci. 7, 1992) with Wolff's correction for the
    subtracted mean (Comput. Phys. Commun. 156, 2004). The correlation between channels is that of the samples. If the
    noise of a channel is smaller than its quantisation step, averaging does not help, and the step is used instead.

    Parameters
    ----------
    wrench : array, shape (N, 6)
        Consecutive samples, N and N·m; N >= 20.

    Raises
    ------
    BadDataset
        Too few samples, or a value that is not finite.
    """
    wrench = _require_samples(wrench)
    N = len(wrench)
    mean = wrench.mean(axis=0)
    noise = wrench - mean
    noise[:, np.ptp(wrench, axis=0) <= ROUNDING * np.abs(wrench).max(axis=0)] = 0.0  # a constant channel
    S = noise.T @ noise / (N - 1)
    std = np.sqrt(np.diag(S))
    tau = _autocorrelation_time(noise)
    variance = tau * std**2 / N + _quantisation_variance(wrench, std)
    for kind in (slice(0, 3), slice(3, 6)):  # a channel without noise gets the largest variance of its group
        silent = variance[kind] == 0
        variance[kind][silent] = variance[kind].max() or RESOLUTION[kind][silent] ** 2
    safe = np.where(std > 0, std, 1.0)
    shrink = min(1.0, 6 / N)  # keeps the matrix positive definite if channels are copies
    correlation = (1 - shrink) * S / np.outer(safe, safe)
    np.fill_diagonal(correlation, 1.0)
    sigma = np.sqrt(variance)
    return PoseMean(mean, correlation * np.outer(sigma, sigma))


def without_swing(wrench: Array, duration_s: float) -> tuple[Array, Array]:
    """Return a dwell without the swing of a weight on a string, and the amplitude (6,) of the first harmonic.

    The swing is fitted by two harmonics of one frequency and subtracted if it is significant; otherwise the amplitude
    is zero. A plain mean would keep part of the swing, because a dwell rarely contains whole periods. `wrench` (N, 6)
    has 20 or more evenly spaced samples, in N and N·m, over `duration_s`; three periods of the longest string, of
    1.4 s each, are best. Raises `BadDataset` for too few samples, or a value that is not finite.
    """
    wrench = _require_samples(wrench)
    N = len(wrench)
    t_s = duration_s * np.linspace(0.0, 1.0, N)
    size = max(1, N // SWING_BLOCKS)
    blocks = wrench[: N // size * size].reshape(-1, size, 6).mean(axis=1)
    middle_s = t_s[: N // size * size].reshape(-1, size).mean(axis=1)
    scale = blocks.std(axis=0)
    blocks = (blocks - blocks.mean(axis=0)) / np.where(scale > 0, scale, 1.0)

    def left_of(frequency_Hz: float) -> float:
        X = _harmonics(middle_s, frequency_Hz)
        return float(np.square(blocks - X @ np.linalg.lstsq(X, blocks)[0]).sum())

    best_Hz = min(np.arange(*SWING_HZ, 0.02), key=left_of)
    best_Hz = min(best_Hz + np.arange(-0.02, 0.02, 0.002), key=left_of)
    if left_of(best_Hz) > (1 - SWING_SHARE) * np.square(blocks).sum():
        return wrench, np.zeros(6)
    X = _harmonics(t_s, best_Hz)
    fitted = np.linalg.lstsq(X, wrench)[0]
    return wrench - X[:, 1:] @ fitted[1:], np.hypot(fitted[1], fitted[2])


def _harmonics(t_s: Array, frequency_Hz: float) -> Array:
    phase = 2 * np.pi * frequency_Hz * t_s
    return np.column_stack([np.ones_like(t_s), *(f(k * phase) for k in (1, 2) for f in (np.cos, np.sin))])


def is_stationary(wrench: Array) -> bool:
    """Return whether the two halves of a dwell have the same mean in every channel, within the noise.

    The standard error of the difference is estimated from 20 batch means, ten in each half, so it is valid for filtered
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
    wrench = _require_samples(wrench)
    size = len(wrench) // 20
    batches = wrench[: 20 * size].reshape(2, 10, size, 6).mean(axis=2)
    difference = np.abs(np.diff(batches.mean(axis=1), axis=0)[0])
    standard_error = np.sqrt(batches.var(axis=1, ddof=1).sum(axis=0) / 10)
    rounding = ROUNDING * np.abs(wrench).max(axis=0)
    return bool((difference <= QUIET * standard_error + rounding).all())


def noise_level(wrench: Array, window: int) -> Array:
    """Return the standard deviation (6,) of an untouched sensor: the median over windows, robust to contact and drift.

    `wrench` (N, 6) are samples with the arm at rest, N and N·m. A window has 20 to N samples, the same number as the
    dwells that are compared with it. Raises `BadDataset` for too few samples, or a value that is not finite.
    """
    wrench = _require_samples(wrench)
    if not LEAST_SAMPLES <= window <= len(wrench):
        raise BadDataset(f"a window of {window} does not fit a record of {len(wrench)}: choose 20 to {len(wrench)}.")
    windows = wrench[: len(wrench) // window * window].reshape(-1, window, 6)
    return np.asarray(np.median(windows.std(axis=1, ddof=1), axis=0))


def is_quiet(wrench: Array, level: Array) -> bool:
    """Return whether a dwell is stationary and has at most twice the noise of the untouched sensor.

    The noise reveals vibration, a hand on the tool and short jolts, even if the halves are equal. Pure noise never
    doubles, so quiet dwells fail as rarely as in `is_stationary`. With 2 s at 500 Hz, 0.15 % fail for white noise, and
    0.4, 0.9 and 6 % after a low-pass filter of 10, 5 and 2 Hz, because 2 s contain few independent samples.

    `level` (6,) is the result of `noise_level`. Raises `BadDataset` for fewer than 20 samples, or if one is not finite.
    """
    return is_stationary(wrench) and not restless_channels(wrench, level).any()


def restless_channels(wrench: Array, level: Array) -> NDArray[np.bool_]:
    """Return which channels (6,) of a dwell have more than twice the noise of the untouched sensor."""
    wrench = _require_samples(wrench)
    flicker = _resolution(wrench) / 2  # noise below one quantisation step, which is normal for coarse quantisation
    return np.asarray(wrench.std(axis=0, ddof=1) > RESTLESS * level + flicker + ROUNDING * np.abs(wrench).max(axis=0))


def _require_samples(wrench: Array) -> Array:
    """Return samples (N, 6) as an array; raise `BadDataset` unless N >= 20 and all are finite."""
    wrench = np.asarray(wrench, dtype=np.float64)
    if wrench.ndim != 2 or wrench.shape[1] != 6 or len(wrench) < LEAST_SAMPLES:
        raise BadDataset(f"a dwell has shape {wrench.shape}, expected (N, 6) with N >= {LEAST_SAMPLES}: record longer.")
    for i, j in np.argwhere(~np.isfinite(wrench)):
        raise BadDataset(f"sample {i + 1}: wrench[{j}] is {wrench[i, j]}, not a finite number.")
    return wrench


def _autocorrelation_time(noise: Array) -> Array:
    """Return the integrated autocorrelation time (6,) in samples: 1 for white noise, or for a channel without noise."""
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
    # Anticorrelated noise shortens the autocorrelation time; the lower bound avoids overconfident means.
    return np.maximum(tau, 0.1)


def _quantisation_variance(wrench: Array, std: Array) -> Array:
    """Return the variance (6,) of the rounding error of a mean: q²/12 without noise, zero with enough noise.

    Gaussian noise of standard deviation sigma reduces it by the factor exp(-4 pi² sigma² / q²) (Widrow, Kollar,
    Quantization Noise, 2008). Rounding may add up to q²/4 to the observed variance.
    """
    step = _resolution(wrench)
    dither = np.maximum(std**2 - step**2 / 4, 0) / np.where(step > 0, step, 1.0) ** 2
    return np.asarray(step**2 / 12 * np.exp(-4 * np.pi**2 * dither))


def _resolution(wrench: Array) -> Array:
    """Return the smallest difference (6,) between two values of each channel; 0 for a constant channel."""
    gaps = np.diff(np.sort(wrench, axis=0), axis=0)
    step = np.where(gaps > ROUNDING * np.abs(wrench).max(axis=0), gaps, np.inf).min(axis=0)
    return np.where(np.isfinite(step), step, 0.0)


# Choice of the averaging time at a pose.

SHORTEST_S, LONGEST_S = 1.0, 10.0

# Step of the averaging times, which contains whole periods of 50 Hz and of 60 Hz mains.
STEP_S = 0.1

# Duration of the blocks of which a record is reduced to means; short compared with averaging times of 1 s or more.
BLOCK_S = 0.02

# Smallest length of a record, in averaging times, for estimating the scatter of averages.
AVERAGES_IN_RECORD = 3

# A shorter average is accepted if its sigma is larger by at most this factor, because the minimum is flat and noisy.
FLAT = 1.05

# A sigma of the longest average that exceeds the prediction for white noise by this factor is due to drift.
DRIFTS = 2.0


@dataclass(frozen=True, slots=True, eq=False)
class AveragingTime:
    """Averaging time at a pose and the resulting standard deviation."""

    seconds: float
    """Averaging time, s: 1 to 10, a multiple of 0.1."""
    sigma: Array
    """(6,) standard deviation of a mean over the averaging time, N and N·m."""
    floor: Array
    """(6,) smallest standard deviation of each channel over all examined averaging times, N and N·m."""
    reached: bool
    """Whether the standard deviation of every channel meets its target."""
    words: str
    """Sentence with averaging time and sigma, and the reason if a target is not reached."""


def allan_deviation(wrench: Array, lengths: Array | list[int]) -> Array:
    """Return the overlapping Allan deviation: the scatter of the means of successive intervals of a record.

    ``sigma²(m) = sum_j (S_j+2m - 2 S_j+m + S_j)² / (2 m² (N - 2m + 1))`` with S the cumulative sum. For white noise it
    is the standard deviation of a mean over m samples. With drift it remains finite, and increases for long intervals.

    Parameters
    ----------
    wrench : array, shape (N, 6)
        Consecutive samples, evenly spaced.
    lengths : array of int, shape (k,)
        Numbers of samples per interval, each from 1 to N / 2.

    Returns
    -------
    array, shape (k, 6)
        In the units of `wrench`.

    References
    ----------
    Riley, Handbook of Frequency Stability Analysis, NIST SP 1065 (2008), eq. 11.
    """
    wrench = _require_samples(wrench)
    N = len(wrench)
    for m in lengths:
        if not 1 <= m <= N // 2:
            raise BadDataset(f"a record of {N} samples is too short for intervals of {m}: choose 1 to {N // 2}.")
    S = np.concatenate([np.zeros((1, wrench.shape[1])), np.cumsum(wrench - wrench.mean(axis=0), axis=0)])
    return np.array(
        [
            np.sqrt(np.mean((S[2 * m :] - 2 * S[m : N - m + 1] + S[: N - 2 * m + 1]) ** 2, axis=0) / 2) / m
            for m in lengths
        ]
    )


def averaging_time(wrench: Array, rate_Hz: float, *, target_force_N: float, target_torque_Nm: float) -> AveragingTime:
    """Return the shortest averaging time that meets the targets, from a record of the sensor at rest.

    Parameters
    ----------
    wrench : array, shape (N, 6)
        Consecutive samples, N and N·m, of at least 3 s. 30 s cover all times up to 10 s; 60 s are better.
    rate_Hz : float
        Sampling rate.
    target_force_N, target_torque_Nm : float
        Required standard deviation of the mean of one pose. The sigma of the biases from n poses is about
        ``sqrt(3 / n)`` times smaller, so 0.02 N from 24 poses requires 0.057 N here.

    Raises
    ------
    BadDataset
        The record is shorter than 3 s, or contains a value that is not finite.

    Notes
    -----
    The sigma of a mean is its Allan deviation, plus the rounding error that averaging does not remove if the noise is
    smaller than the resolution. All six channels must meet their targets. If one cannot, the time that brings the worst
    channel closest to its target is chosen. The estimated time is more often too long than too short: for white noise
    that requires 3 s, a record of 60 s gives 2.8 to 6.1 s (5 to 95 %), a record of 120 s gives 3.0 to 4.6 s.
    """
    if not (target_force_N > 0 and target_torque_Nm > 0):
        raise ValueError(f"targets are {target_force_N} N and {target_torque_Nm} N·m: choose positive values.")
    wrench = _require_samples(wrench)
    if not rate_Hz > 0 or len(wrench) / rate_Hz < (1 - 1e-3) * AVERAGES_IN_RECORD * SHORTEST_S:
        raise BadDataset(
            f"a record of {len(wrench)} samples at {rate_Hz:g} Hz is too short to choose an averaging time: record at "
            f"least {AVERAGES_IN_RECORD * SHORTEST_S:.0f} s."
        )
    size = max(1, int(BLOCK_S * rate_Hz))
    blocks = wrench[: len(wrench) // size * size].reshape(-1, size, 6).mean(axis=1)
    longest_s = min(LONGEST_S, len(wrench) / rate_Hz / AVERAGES_IN_RECORD)
    times_s = np.arange(round(SHORTEST_S / STEP_S), int(longest_s / STEP_S + 1e-2) + 1) * STEP_S
    lengths = np.maximum(1, np.round(times_s * rate_Hz / size).astype(int))
    rounding = _quantisation_variance(wrench, wrench.std(axis=0, ddof=1))
    sigma = np.sqrt(allan_deviation(blocks, lengths) ** 2 + rounding)
    target = np.repeat([target_force_N, target_torque_Nm], 3)
    excess = (sigma / target).max(axis=1)
    best = int(np.argmax(excess <= max(1.0, FLAT * excess.min())))
    reached = bool(excess[best] <= 1)
    force_N, torque_Nm = sigma[best, :3].max(), sigma[best, 3:].max()
    words = f"average {times_s[best]:.1f} s at each pose: sigma {force_N:.2g} N and {torque_Nm:.2g} N·m"
    if not reached:
        c = int(np.argmax(sigma[best] / target))
        words += f". {CHANNELS[c]} does not reach the target of {target[c]:.2g} {'N' if c < 3 else 'N·m'}: "
        if rounding[c] > sigma[best, c] ** 2 / 2:
            words += "its resolution is too coarse"
        elif sigma[-1, c] > DRIFTS * sigma[0, c] * np.sqrt(times_s[0] / times_s[-1]):
            words += "it drifts, and longer averages do not help. Let the sensor warm up, or take more poses"
        elif (needed_s := times_s[best] * (sigma[best, c] / target[c]) ** 2) > LONGEST_S:
            words += f"that needs {needed_s:.2g} s. Take more poses"
        else:
            words += f"a record of {len(wrench) / rate_Hz:.0f} s is too short for longer averages. Record 30 s or more"
    return AveragingTime(round(float(times_s[best]), 1), sigma[best], sigma.min(axis=0), reached, words)
