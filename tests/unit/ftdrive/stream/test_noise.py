"""The learnt noise of each state of motion, against what was simulated."""

import numpy as np
import pytest

from ftcalib.model import Array
from ftdrive.stream.noise import REST, NoiseEstimator, SensorNoise

RATE_HZ, SIZE = 1000.0, 20
"""A reading is 0.02 s."""
MIXED = np.array([[2.0, 0, 0, 0, 0, 0], [1.0, 1, 0, 0, 0, 0], *np.eye(6)[2:]]) * np.repeat([0.05, 0.002], 3)[:, None]
TRUE = MIXED @ MIXED.T
PULL = np.vstack([np.eye(3), np.zeros((3, 3))]) * 1.5
"""Wrench by acceleration."""


def samples(readings: int, seed: int = 1) -> Array:
    return np.asarray(np.random.default_rng(seed).standard_normal((readings * SIZE, 6)) @ MIXED.T)


def learnt(residual: Array, state: int = REST, estimator: NoiseEstimator | None = None) -> NoiseEstimator:
    estimator = estimator or NoiseEstimator(RATE_HZ, PULL)
    for part in np.array_split(residual, 7):
        estimator.add(part, np.full(len(part), state, np.int8))
    return estimator


def known(estimator: NoiseEstimator, state: int = REST) -> SensorNoise:
    noise = estimator.of(state)
    assert noise is not None
    return noise


def test_white_noise_of_a_sample_and_of_a_reading_at_rest() -> None:
    drift = np.linspace(0, 0.6, 1504 * SIZE)[:, None] * np.repeat([1.0, 0.04], 3)
    noise = known(learnt(samples(1504) + drift + 7.0))
    scale = np.sqrt(np.outer(np.diag(TRUE), np.diag(TRUE)))
    np.testing.assert_allclose(noise.sample / scale, TRUE / scale, atol=0.02)
    np.testing.assert_allclose(noise.reading * SIZE / scale, TRUE / scale, atol=0.1)
    step = 0.6 * 25 / 1504 * np.repeat([1.0, 0.04], 3)  # of the drift, from one half second to the next
    of_means = np.diag(noise.wander) - step**2  # of two with 25 readings
    np.testing.assert_allclose(of_means * SIZE * 25 / 2 / np.diag(TRUE), 1.0, atol=0.4)
    assert noise.dof == 60 * 25 / 4


@pytest.mark.parametrize(("state", "size"), [(REST, 25), (1, 8)])
@pytest.mark.parametrize("kept", [True, False])
def test_a_loud_window_and_a_jump_do_not_count(state: int, size: int, kept: bool) -> None:
    windows, rng = 16, np.random.default_rng(4)
    line = np.stack([np.ones(size), np.arange(size)], axis=1)
    course = rng.standard_normal((size, 6))
    course -= line @ np.linalg.lstsq(line, course, rcond=None)[0]
    loud = {REST: (1.3, 1.8), 1: (3.0, 5.0)}[state][not kept]  # limits are 1.5 and 4
    factor = np.where(np.arange(windows) == 5, loud, 1.0)
    reading_variance = course.T @ course / (size - 2)
    means = 0.1 * (np.arange(windows)[:, None] % 2) * np.ones(6)
    usual = np.sqrt(0.1**2 / 0.1015 + np.diag(reading_variance).max() / 25)  # a tenth of chi2 is below 0.1015 of sigma²
    means[9:] += (4.0 if kept else 5.8) * usual
    values = means[:, None] + np.sqrt(factor)[:, None, None] * course
    values = np.vstack([values.reshape(-1, 6), np.tile(values[-1, -1], (4, 1))])
    noise = known(learnt(np.repeat(values, SIZE, axis=0), state), state)
    assert noise.dof == (windows - (not kept)) * size / 4
    mean = reading_variance * np.mean(factor if kept else factor[factor == 1])
    np.testing.assert_allclose(noise.reading, mean, atol=1e-5)
    steps = np.diff(means, axis=0)
    steps = steps if kept else steps[np.abs(steps[:, 0]) < 1]
    np.testing.assert_allclose(noise.wander, steps.T @ steps / len(steps), atol=1e-9)
