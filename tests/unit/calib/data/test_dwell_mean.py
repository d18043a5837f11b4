"""The covariance of the mean of a dwell is correct, and quiet dwells pass the test."""

import numpy as np
import pytest
from scipy.signal import lfilter

from ftcalib import BadDataset, is_stationary, mean_and_covariance
from ftcalib.data.dwell_mean import (
    AveragingTime,
    allan_deviation,
    averaging_time,
    is_quiet,
    noise_level,
    restless_channels,
    without_swing,
)
from ftcalib.model import Array


def noise(rng: np.random.Generator, N: int, rho: Array) -> Array:
    """AR(1) of unit variance, one rho for each of the six channels."""
    white = rng.normal(size=(N + 300, 6))
    return np.column_stack([lfilter([np.sqrt(1 - r**2)], [1, -r], white[:, c])[300:] for c, r in enumerate(rho)])


MIXED = [0, 0.5, 0.9, 0, 0.9, 0.5]


@pytest.mark.parametrize(("N", "rho"), [(400, [0.9] * 6), (1500, [-0.5] * 6), (400, MIXED)])
def test_the_mean_lies_where_its_covariance_states(N: int, rho: list[float]) -> None:
    rng = np.random.default_rng(N)
    lag = np.arange(1, N)
    variance = np.array([1 + 2 * np.sum((1 - lag / N) * r**lag) for r in rho]) / N
    z, ratio = [], []
    for _ in range(100):
        pose = mean_and_covariance(5.0 + noise(rng, N, np.array(rho)))
        z.append((pose.mean - 5.0) / np.sqrt(np.diag(pose.covariance)))
        ratio.append(np.diag(pose.covariance) / variance)
    assert 0.98 < np.mean(ratio) < 1.12  # a little on the safe side
    coverage = np.mean(np.abs(z) < 1.96)
    hard = N == 400 and max(rho) == 0.9  # 21 independent samples: the spread itself is known to 30 %
    assert (0.88 if hard else 0.92) < coverage < 0.98


def test_correlation_between_channels_is_kept() -> None:
    """Of channels as unlike in size as newtons and newton metres, in the samples and in their mean."""
    sigma = np.repeat([0.3, 0.004], 3)
    mixing = np.eye(6)
    mixing[4, [0, 4]] = 0.8, 0.6
    rng = np.random.default_rng(1)
    found = [mean_and_covariance(noise(rng, 500, np.full(6, 0.8)) @ mixing.T * sigma) for _ in range(150)]
    correlations = [C[0, 4] / np.sqrt(C[0, 0] * C[4, 4]) for C in (pose.covariance for pose in found)]
    assert np.median(correlations) == pytest.approx(0.8, abs=0.02)
    difference = np.array([1, 0, 0, 0, -1, 0]) / sigma  # of which correlation takes most of the spread away
    z = [difference @ pose.mean / np.sqrt(difference @ pose.covariance @ difference) for pose in found]
    assert np.std(z) == pytest.approx(1, abs=0.2)
    np.testing.assert_array_equal(found[0].covariance, found[0].covariance.T)


@pytest.mark.parametrize("sigma", [0.25, 0.7])
def test_averaging_cannot_see_through_coarse_steps(sigma: float) -> None:
    rng = np.random.default_rng(2)
    z = []
    for _ in range(60):
        true = rng.uniform(-5, 5, 6)
        pose = mean_and_covariance(np.round(true + sigma * rng.normal(size=(400, 6))))
        z.append((pose.mean - true) / np.sqrt(np.diag(pose.covariance)))
    assert np.mean(np.abs(z) < 1.96) > 0.92
    if sigma > 0.5:
        assert np.std(z) > 0.9  # and fine steps cost nothing


def test_a_channel_that_never_moves_or_copies_another_leaves_a_usable_covariance() -> None:
    rng = np.random.default_rng(3)
    samples = rng.normal(size=(200, 6)) * [0.1, 0.1, 0.1, 0.002, 0.002, 0.002] + 3.3
    samples[:, 1] = 3.3
    samples[:, 5] = samples[:, 4]
    C = mean_and_covariance(samples).covariance
    assert np.linalg.eigvalsh(C).min() > 0
    assert C[1, 1] == max(C[0, 0], C[2, 2])  # no more trust than its neighbours earn
    silent = mean_and_covariance(np.full((50, 6), 0.1)).covariance
    np.testing.assert_allclose(np.sqrt(np.diag(silent)), [1e-3] * 3 + [2.5e-5] * 3)


def test_a_drift_or_a_decay_of_any_channel_fails() -> None:
    rng, N = np.random.default_rng(5), 400
    t = np.linspace(0, 1, N)
    standard_error = 1 / np.sqrt(N)
    for channel in range(6):
        for disturbance in (60 * t, 20 * (t > 0.5), 120 * np.exp(-t / 0.4)):  # a third less is sometimes missed
            samples = rng.normal(size=(N, 6))
            assert is_stationary(samples)
            samples[:, channel] += standard_error * disturbance
            assert not is_stationary(samples)


def filtered(rng: np.random.Generator, seconds: float, corner_Hz: float) -> Array:
    """White noise of a 500 Hz sensor behind a low-pass of first order; the beginning is forgotten."""
    keep = np.exp(-2 * np.pi * corner_Hz / 500)
    samples: Array = lfilter([1 - keep], [1, -keep], rng.normal(size=(int(500 * (seconds + 2)), 6)), axis=0)[1000:]
    return samples


def test_a_sensor_left_alone_is_quiet() -> None:
    rng = np.random.default_rng(17)
    level = noise_level(filtered(rng, 20, 5), 1000)
    alarms = np.mean([not is_quiet(filtered(rng, 2, 5), level) for _ in range(200)])
    assert alarms < 0.015  # with a threshold of 3 standard errors 4 %


@pytest.mark.parametrize(
    "disturbance",
    [
        4 * np.sin(2 * np.pi * 7 * np.arange(1000) / 500),  # vibration
        np.where(np.arange(1000) // 50 == 4, 15.0, 0.0),  # a jolt of a tenth of a second
        6 * np.sin(2 * np.pi * np.arange(1000) / 1000) ** 2 * np.sin(np.arange(1000) / 20),  # a hand
    ],
)
def test_what_stationary_halves_hide_is_not_quiet(disturbance: Array) -> None:
    rng = np.random.default_rng(19)
    level = noise_level(rng.normal(size=(10_000, 6)), 1000)
    for channel in range(6):
        samples = rng.normal(size=(1000, 6))
        assert is_quiet(samples, level)
        samples[:, channel] += disturbance
        assert is_stationary(samples)
        assert not is_quiet(samples, level)
        assert np.flatnonzero(restless_channels(samples, level)).tolist() == [channel]


def test_the_noise_level_ignores_a_touch_and_a_slow_drift() -> None:
    rng = np.random.default_rng(20)
    samples = rng.normal(size=(30_000, 6)) + np.linspace(0, 10, 30_000)[:, None]
    samples[4000:7000, 2] += 40 * rng.normal(size=3000)
    np.testing.assert_allclose(noise_level(samples, 1000), 1.0, atol=0.1)


def test_a_coarse_sensor_may_flicker_between_two_numbers() -> None:
    level = noise_level(np.full((1000, 6), 0.3), 100)
    np.testing.assert_allclose(level, 0, atol=1e-12)
    samples = np.full((200, 6), 0.3)
    samples[::7, 4] = 0.4
    assert is_quiet(samples, level)
    samples[::14, 4] = 0.2
    samples[3::14, 4] = 0.6
    assert not is_quiet(samples, level)


@pytest.mark.parametrize("window", [19, 201])
def test_a_window_must_fit_the_record(window: int) -> None:
    with pytest.raises(BadDataset, match="record of 200"):
        noise_level(np.zeros((200, 6)), window)


@pytest.mark.parametrize(
    ("samples", "words"),
    [
        (np.zeros((19, 6)), r"shape \(19, 6\), expected \(N, 6\) with N >= 20: record longer"),
        (np.zeros((50, 3)), r"shape \(50, 3\)"),
        (np.where(np.arange(300).reshape(50, 6) == 8, np.nan, 0.0), r"sample 2: wrench\[2\] is nan"),
    ],
)
def test_bad_dwells_are_rejected(samples: Array, words: str) -> None:
    for function in (mean_and_covariance, is_stationary):
        with pytest.raises(BadDataset, match=words):
            function(samples)


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


@pytest.mark.parametrize("kind", ["walk", "offset"])
def test_it_is_the_definition(kind: str) -> None:
    wrench = white(1)
    if kind == "walk":
        wrench = wrench.cumsum(axis=0)
    elif kind == "offset":
        wrench += 1e4
    lengths = [1, 2, 7, 50, 99, 100]
    expected = [[by_definition(wrench[:, c], m) for c in range(6)] for m in lengths]
    np.testing.assert_allclose(allan_deviation(wrench, lengths), expected, rtol=1e-7)


@pytest.mark.parametrize("lengths", [[0], [101], [10, -1]])
def test_lengths_that_do_not_fit_are_rejected(lengths: list[int]) -> None:
    with pytest.raises(BadDataset, match="choose 1 to 100"):
        allan_deviation(white(1), lengths)


def test_white_noise_is_averaged_as_long_as_the_target_asks() -> None:
    seconds = 7.5
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


def swinging(amplitude_rad: float, seed: int) -> tuple[Array, Array]:
    """Four seconds (N, 6) under 2 kg on a string of 300 mm, with noise, and what it reads at rest (6,)."""
    rng, t_s = np.random.default_rng(seed), np.arange(0, 4, 1 / 250)
    angle = amplitude_rad * np.cos(np.sqrt(9.81 / 0.3) * t_s + rng.uniform(0, 2 * np.pi))
    # Tension of a pendulum to the second order of its angle.
    tension = 2 * 9.81 * (1 + amplitude_rad**2 - 1.5 * angle**2)
    force = np.column_stack([tension * np.sin(angle), 0 * t_s, -tension * np.cos(angle)])
    torque = np.cross([0.0, 0.0, 0.2], force)
    noise = rng.normal(size=(len(t_s), 6)) * np.repeat([0.1, 0.005], 3)
    return np.hstack([force, torque]) + noise, np.array([0, 0, -2 * 9.81, 0, 0, 0])


def test_a_swing_is_no_part_of_a_mean() -> None:
    for seed in range(5):
        wrench, rest = swinging(np.radians(4.0), seed)
        left, amplitude = without_swing(wrench, 4.0)
        assert left.mean(axis=0) == pytest.approx(rest, abs=0.03)
        assert amplitude[0] == pytest.approx(2 * 9.81 * np.radians(4.0), rel=0.02)
        assert is_quiet(left, np.repeat([0.1, 0.005], 3))


def test_a_dwell_without_a_swing_stays_as_it_is() -> None:
    for seed in range(5):
        wrench, _ = swinging(0.0, seed)
        left, amplitude = without_swing(wrench, 4.0)
        assert left is wrench
        assert not amplitude.any()
