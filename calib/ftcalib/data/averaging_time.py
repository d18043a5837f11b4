"""Choice of the averaging time at a pose."""

from dataclasses import dataclass

import numpy as np

from ftcalib.data.dwell_mean import CHANNELS, checked, quantisation_variance
from ftcalib.errors import BadDataset
from ftcalib.model import Array

SHORTEST_S, LONGEST_S = 1.0, 10.0

# Averages are compared in steps that hold whole periods of 50 Hz and of 60 Hz mains.
STEP_S = 0.1

# Block means of this length lose nothing for averages of a second or more.
BLOCK_S = 0.02

# The scatter of an average needs a record that is several averages long.
AVERAGES_IN_RECORD = 3

# The curve is flat and noisy near its minimum: a shorter average may be worse by this factor.
FLAT = 1.05

# If sigma of the longest average exceeds the prediction for white noise by this factor, the cause is drift.
DRIFTS = 2.0


@dataclass(frozen=True, slots=True, eq=False)
class AveragingTime:
    """An averaging time and the sigma that it gives."""

    seconds: float
    """1 to 10, a multiple of 0.1."""
    sigma: Array
    """(6,) standard deviation of a mean over that time, N and N·m."""
    floor: Array
    """(6,) smallest sigma of all examined times, per channel, N and N·m."""
    reached: bool
    """Whether every channel meets its target."""
    words: str
    """The same in a sentence, with the reason if a target is not reached."""


def allan_deviation(wrench: Array, lengths: Array | list[int]) -> Array:
    """Overlapping Allan deviation: scatter of the means of successive intervals of a record.

    ``sigma²(m) = sum_j (S_j+2m - 2 S_j+m + S_j)² / (2 m² (N - 2m + 1))`` with S the cumulative sum. For white noise it
    is the standard deviation of a mean over m samples. With drift it stays finite, and grows again
    where drift dominates.

    Parameters
    ----------
    wrench : array, shape (N, 6)
        Consecutive samples, evenly spaced.
    lengths : array of int, shape (k,)
        Samples in an interval, each 1 to N / 2.

    Returns
    -------
    array, shape (k, 6)
        In the units of `wrench`.

    References
    ----------
    Riley, Handbook of Frequency Stability Analysis, NIST SP 1065 (2008), eq. 11.
    """
    wrench = checked(wrench)
    N = len(wrench)
    for m in lengths:
        if not 1 <= m <= N // 2:
            raise BadDataset(f"a record of {N} samples has no Allan deviation over {m}: choose 1 to {N // 2}.")
    S = np.concatenate([np.zeros((1, wrench.shape[1])), np.cumsum(wrench - wrench.mean(axis=0), axis=0)])
    return np.array(
        [
            np.sqrt(np.mean((S[2 * m :] - 2 * S[m : N - m + 1] + S[: N - 2 * m + 1]) ** 2, axis=0) / 2) / m
            for m in lengths
        ]
    )


def averaging_time(wrench: Array, rate_Hz: float, *, target_force_N: float, target_torque_Nm: float) -> AveragingTime:
    """Choose the shortest averaging time that meets the targets, from a record of the sensor at rest.

    Parameters
    ----------
    wrench : array, shape (N, 6)
        Consecutive samples, N and N·m; at least 3 s. 30 s cover all times up to 10 s; 60 s cover them well.
    rate_Hz : float
        Sampling rate.
    target_force_N, target_torque_Nm : float
        Wanted standard deviation of the mean of one pose. Sigma of the biases from n poses is about ``sqrt(3 / n)``
        times that, so 0.02 N from 24 poses need 0.057 N here.

    Raises
    ------
    BadDataset
        The record is shorter than 3 s, or contains a value that is not finite.

    Notes
    -----
    Sigma of a mean is its Allan deviation, plus the rounding error that averaging does not remove if the noise is
    smaller than the resolution. All six channels must meet their targets. If one cannot, the time is chosen that brings
    the worst channel closest. Chance lengthens the time more often than it shortens it: for white noise that needs 3 s,
    a record of 60 s gives 2.8 to 6.1 s (5 to 95 %), a record of 120 s gives 3.0 to 4.6 s.
    """
    if not (target_force_N > 0 and target_torque_Nm > 0):
        raise ValueError(f"targets are {target_force_N} N and {target_torque_Nm} N·m: choose positive values.")
    wrench = checked(wrench)
    if not rate_Hz > 0 or len(wrench) / rate_Hz < (1 - 1e-3) * AVERAGES_IN_RECORD * SHORTEST_S:
        raise BadDataset(
            f"a record of {len(wrench)} samples at {rate_Hz:g} Hz is too short for choosing an averaging time: "
            f"record at least {AVERAGES_IN_RECORD * SHORTEST_S:.0f} s."
        )
    size = max(1, int(BLOCK_S * rate_Hz))
    blocks = wrench[: len(wrench) // size * size].reshape(-1, size, 6).mean(axis=1)
    longest_s = min(LONGEST_S, len(wrench) / rate_Hz / AVERAGES_IN_RECORD)
    times_s = np.arange(round(SHORTEST_S / STEP_S), int(longest_s / STEP_S + 1e-2) + 1) * STEP_S
    lengths = np.maximum(1, np.round(times_s * rate_Hz / size).astype(int))
    rounding = quantisation_variance(wrench, wrench.std(axis=0, ddof=1))
    sigma = np.sqrt(allan_deviation(blocks, lengths) ** 2 + rounding)
    target = np.repeat([target_force_N, target_torque_Nm], 3)
    excess = (sigma / target).max(axis=1)
    best = int(np.argmax(excess <= max(1.0, FLAT * excess.min())))
    reached = bool(excess[best] <= 1)
    floor = sigma.min(axis=0)
    words = f"average {times_s[best]:.1f} s at each pose: sigma {_in_words(sigma[best])}"
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
    return AveragingTime(round(float(times_s[best]), 1), sigma[best], floor, reached, words)


def _in_words(sigma: Array) -> str:
    return f"{sigma[:3].max():.2g} N and {sigma[3:].max():.2g} N·m"
