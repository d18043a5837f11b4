"""How long to average at a pose: as long as it helps, no longer than needed."""

from dataclasses import dataclass

import numpy as np

from calib.data.dwell_mean import CHANNELS, checked, quantisation_variance
from calib.errors import BadDataset
from calib.model import Array

SHORTEST_S, LONGEST_S = 1.0, 10.0

# Averages are compared in steps that hold whole periods of 50 Hz and of 60 Hz mains.
STEP_S = 0.1

# Faster than this nothing matters to an average of a second: the record is first reduced to means of so many seconds.
BLOCK_S = 0.02

# A record says how much an average scatters only when it holds several of them.
AVERAGES_IN_RECORD = 3

# The curve is flat near its minimum, and noisy: a shorter average that is this little worse is taken.
FLAT = 1.05

# So much larger than white noise predicts from the shortest average, that of the longest is drift and not chance.
DRIFTS = 2.0


@dataclass(frozen=True, slots=True, eq=False)
class AveragingTime:
    """How long to average, and what that gives."""

    seconds: float
    """1 to 10, a multiple of 0.1."""
    sigma: Array
    """(6,) standard deviation of a mean over that time, N and N·m."""
    floor: Array
    """(6,) the smallest that any time up to the longest judged gives, channel by channel, N and N·m."""
    reached: bool
    """Whether every channel meets its target."""
    words: str
    """The same in a sentence, with the reason when a target is out of reach."""


def allan_deviation(wrench: Array, lengths: Array | list[int]) -> Array:
    """Overlapping Allan deviation: how much the means of successive stretches of a record differ.

    ``sigma²(m) = sum_j (S_j+2m - 2 S_j+m + S_j)² / (2 m² (N - 2m + 1))`` with S the cumulative sum. For white noise it
    is the standard deviation of a mean over m samples; unlike that, it stays finite and grows again where drift
    outweighs the averaging.

    Parameters
    ----------
    wrench : array, shape (N, 6)
        Consecutive samples, evenly spaced.
    lengths : array of int, shape (k,)
        Samples in a stretch, each 1 to N / 2.

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
    """Choose the shortest average that is good enough, from a record of the sensor at rest.

    Parameters
    ----------
    wrench : array, shape (N, 6)
        Consecutive samples, N and N·m; 3 s at least. 30 s judge all times up to 10 s; 60 s judge them well.
    rate_Hz : float
        Sampling rate.
    target_force_N, target_torque_Nm : float
        Standard deviation wanted of the mean of one pose. Biases come out of n poses with about ``sqrt(3 / n)`` of
        it, so 0.02 N of bias from 24 poses ask for 0.057 N here.

    Raises
    ------
    BadDataset
        The record is shorter than 3 s, or holds a value that is not finite.

    Notes
    -----
    The scatter of a mean is its Allan deviation, and where a channel's noise does not reach the step of its numbers,
    the rounding that no average removes. All six channels must meet their targets. When one cannot, the time is the
    one that brings the worst channel closest. Chance in the record lengthens the time, seldom shortens it: 3 s of white
    noise come out as 2.8 to 6.1 s from a record of 60 s (5 to 95 %), as 3.0 to 4.6 s from 120 s.
    """
    if not (target_force_N > 0 and target_torque_Nm > 0):
        raise ValueError(f"targets are {target_force_N} N and {target_torque_Nm} N·m: choose both above zero.")
    wrench = checked(wrench)
    if not rate_Hz > 0 or len(wrench) / rate_Hz < (1 - 1e-3) * AVERAGES_IN_RECORD * SHORTEST_S:
        raise BadDataset(
            f"a record of {len(wrench)} samples at {rate_Hz:g} Hz is too short to choose an averaging time from: "
            f"record {AVERAGES_IN_RECORD * SHORTEST_S:.0f} s at least."
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
    words = f"average {times_s[best]:.1f} s at each pose: known to {_in_words(sigma[best])} then"
    if not reached:
        c = int(np.argmax(sigma[best] / target))
        words += f". {CHANNELS[c]} does not come to the {target[c]:.2g} {'N' if c < 3 else 'N·m'} wanted: "
        if rounding[c] > sigma[best, c] ** 2 / 2:
            words += "its numbers are too coarse"
        elif sigma[-1, c] > DRIFTS * sigma[0, c] * np.sqrt(times_s[0] / times_s[-1]):
            words += "it drifts, and longer averages are no better; let the sensor warm up, or take more poses"
        elif (needed_s := times_s[best] * (sigma[best, c] / target[c]) ** 2) > LONGEST_S:
            words += f"that would take {needed_s:.2g} s; take more poses"
        else:
            words += f"a record of {len(wrench) / rate_Hz:.0f} s judges no longer averages; take 30 s or more"
    return AveragingTime(round(float(times_s[best]), 1), sigma[best], floor, reached, words)


def _in_words(sigma: Array) -> str:
    return f"{sigma[:3].max():.2g} N and {sigma[3:].max():.2g} N·m"
