"""The Allan deviation is what its definition says, and it leads to the shortest average that is enough."""

import numpy as np
import pytest
from scipy.signal import lfilter

from ftcalib import BadDataset
from ftcalib.data.dwell_mean import AveragingTime, allan_deviation, averaging_time
from ftcalib.model import Array

RATE_HZ = 200.0
SIGMA = np.repeat([0.3, 0.01], 3)


def white(seconds: float, seed: int = 0) -> Array:
    noise: Array = np.random.default_rng(seed).normal(size=(int(seconds * RATE_HZ), 6)) * SIGMA
    return noise


def chosen(wrench: Array, force_N: float = 1.0, torque_Nm: float = 1.0) -> AveragingTime:
    return averaging_time(wrench, RATE_HZ, target_force_N=force_N, target_torque_Nm=torque_Nm)


def by_definition(x: Array, m: int) -> float:
    """Half the mean squared difference of successive averages over m samples, from every start."""
    means = [x[j : j + m].mean() for j in range(len(x) - m + 1)]
    return float(np.sqrt(np.mean([(b - a) ** 2 for a, b in zip(means, means[m:], strict=False)]) / 2))


@pytest.mark.parametrize("kind", ["white", "walk", "offset"])
def test_it_is_the_definition(kind: str) -> None:
    wrench = white(1)
    if kind == "walk":
        wrench = wrench.cumsum(axis=0)
    elif kind == "offset":
        wrench += 1e4
    lengths = [1, 2, 7, 50, 99, 100]
    expected = [[by_definition(wrench[:, c], m) for c in range(6)] for m in lengths]
    np.testing.assert_allclose(allan_deviation(wrench, lengths), expected, rtol=1e-7)


def test_it_falls_with_white_noise_and_grows_with_a_random_walk_and_a_ramp() -> None:
    lengths = np.array([1, 10, 100, 1000])
    noise = white(600)
    np.testing.assert_allclose(allan_deviation(noise, lengths) / (SIGMA / np.sqrt(lengths)[:, None]), 1, atol=0.25)
    walk = allan_deviation(noise.cumsum(axis=0), lengths)
    np.testing.assert_allclose(walk / (SIGMA * np.sqrt((2 * lengths**2 + 1) / (6 * lengths))[:, None]), 1, atol=0.3)
    ramp = allan_deviation(np.outer(np.arange(4000.0), np.ones(6)), lengths)
    np.testing.assert_allclose(ramp, np.outer(lengths, np.ones(6)) / np.sqrt(2), rtol=1e-9)


@pytest.mark.parametrize("lengths", [[0], [101], [10, -1]])
def test_lengths_that_do_not_fit_are_rejected(lengths: list[int]) -> None:
    with pytest.raises(BadDataset, match="choose 1 to 100"):
        allan_deviation(white(1), lengths)


@pytest.mark.parametrize("seconds", [2.0, 7.5])
def test_white_noise_is_averaged_as_long_as_the_target_asks(seconds: float) -> None:
    target = SIGMA[0] / np.sqrt(seconds * RATE_HZ)
    times = [chosen(white(120, seed), force_N=target).seconds for seed in range(7)]
    assert np.median(times) == pytest.approx(seconds, rel=0.25)  # the worst of three channels decides
    assert all(t == pytest.approx(round(t, 1), abs=1e-9) for t in times)


def test_the_time_stays_within_one_and_ten_seconds() -> None:
    easy = chosen(white(60))
    assert (easy.seconds, easy.reached) == (1.0, True)
    np.testing.assert_allclose(easy.sigma, SIGMA / np.sqrt(RATE_HZ), rtol=0.3)
    assert "average 1.0 s at each pose" in easy.words
    hard = chosen(white(60), force_N=1e-4)
    assert 5 < hard.seconds <= 10
    assert not hard.reached
    assert "0.0001 N: that needs" in hard.words
    assert "more poses" in hard.words


def test_torque_counts_like_force() -> None:
    target = SIGMA[3] / np.sqrt(4 * RATE_HZ)
    assert 3 < np.median([chosen(white(120, seed), torque_Nm=target).seconds for seed in range(5)]) < 6.5


def test_filtered_noise_is_averaged_longer_than_its_samples_suggest() -> None:
    slow = np.asarray(lfilter([1], [1, -0.99], white(200), axis=0))[2000:]  # 100 samples of memory
    slow *= SIGMA / slow.std(axis=0)
    naive_s = 1.0
    target = SIGMA[0] / np.sqrt(naive_s * RATE_HZ)
    assert chosen(white(180), force_N=1.05 * target).seconds < 1.3
    result = chosen(slow, force_N=target)
    assert not result.reached
    assert result.sigma[:3].max() > 2 * target
    spread = np.std(slow[: len(slow) // 2000 * 2000].reshape(-1, 2000, 6).mean(axis=1), axis=0)  # of 10 s means
    assert 0.3 < result.sigma[0] / spread[0] < 3


def test_drift_ends_the_averaging_at_the_minimum_of_the_curve() -> None:
    rng = np.random.default_rng(4)
    wrench = white(120)
    step = SIGMA[2] / 3.0 / RATE_HZ * np.sqrt(3)  # walk and noise are as large at 3 s
    wrench[:, 2] += np.cumsum(rng.normal(size=len(wrench)) * step)
    result = chosen(wrench, force_N=1e-4)
    assert 1.5 < result.seconds < 6
    assert result.sigma[2] < 1.06 * result.floor[2]
    assert "fz does not reach the target of 0.0001 N" in result.words
    assert "it drifts" in result.words


def test_a_frozen_channel_does_not_matter_and_a_coarse_one_is_not_believed() -> None:
    wrench = white(60)
    wrench[:, 1] = 3.25
    assert chosen(wrench).sigma[1] == 0.0
    wrench[:, 1] = np.round(wrench[:, 0] / 3) * 3 + 3.0 * (np.arange(len(wrench)) == 77)
    result = chosen(wrench, force_N=0.1)
    assert not result.reached
    assert result.seconds < 2  # waiting does not help
    assert result.sigma[1] == pytest.approx(3 / np.sqrt(12), rel=0.05)
    assert "fy does not reach the target of 0.1 N" in result.words
    assert "too coarse" in result.words


def test_a_short_record_reports_its_limit() -> None:
    result = chosen(white(6), force_N=0.5 * SIGMA[0] / np.sqrt(RATE_HZ))
    assert result.seconds <= 2.0
    assert "record of 6 s" in result.words
    with pytest.raises(BadDataset, match="record at least 3 s"):
        chosen(white(2.9))
    assert chosen(white(3)).seconds == 1.0


@pytest.mark.parametrize("rate_Hz", [20.0, 62.5, 125.0, 976.5625])
def test_any_rate_will_do(rate_Hz: float) -> None:
    wrench = np.random.default_rng(3).normal(size=(int(60 * rate_Hz), 6))
    target = 1 / np.sqrt(3 * rate_Hz)
    result = averaging_time(wrench, rate_Hz, target_force_N=target, target_torque_Nm=1.0)
    assert 2 < result.seconds < 4.5


def test_invalid_targets_are_rejected() -> None:
    for force_N, torque_Nm in ((0.0, 1.0), (1.0, 0.0), (-1.0, 1.0), (1.0, -1.0)):
        with pytest.raises(ValueError, match=f"{force_N} N and {torque_Nm} N·m"):
            chosen(white(10), force_N, torque_Nm)
    broken = white(10)
    broken[17, 2] = np.nan
    with pytest.raises(BadDataset, match=r"sample 18: wrench\[2\] is nan"):
        chosen(broken)
    with pytest.raises(BadDataset, match="too short"):
        averaging_time(white(10), 0.0, target_force_N=1.0, target_torque_Nm=1.0)
