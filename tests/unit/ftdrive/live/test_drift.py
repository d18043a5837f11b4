"""The drift filter against generalised least squares of all its means at once."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from ftcalib.model import Array
from ftdrive.live.noise import DriftFilter, SensorNoise

SAMPLE = np.repeat([0.04, 0.0016], 3)
READING = np.repeat([0.01, 0.0004], 3)
"""Variances."""
UNCERTAINTY = np.repeat([0.02, 1e-5], 3)
NOISE = SensorNoise(np.diag(SAMPLE), np.diag(READING), np.zeros((6, 6)), 100.0)
TRUE_RATE = np.array([6.0, -8.0, 0.0, 0.1, 0.0, 0.0])
"""N/h and N·m/h."""
EYE, TURNED = np.eye(3), Rotation.from_rotvec([0.0, 0.0, 0.05]).as_matrix()


def second(filter_: DriftFilter, k: int, mean: Array, R: Array = EYE, R_end: Array | None = None) -> bool:
    """Add the second k, of 100 samples that are all alike; return whether there was a mean."""
    t_ns = k * 10**9 + np.arange(100) * 10**7
    poses = np.tile(R, (100, 1, 1))
    poses[-1] = R if R_end is None else R_end
    return filter_.follow(t_ns, np.tile(mean, (100, 1)), poses, NOISE, UNCERTAINTY)


def by_least_squares(means: dict[int, Array], turn: int) -> tuple[float, float]:
    """Rate of the force and its sigma at the last of these means in N/h, where the pose changes at second `turn`."""
    seconds = sorted(means)
    n = len(seconds)
    # unknown: bias and rate at the first mean, a step of the bias at the turn, a step of bias and rate before each mean
    rate = 5.0 / 3600
    prior = [1.0, rate**2, 2 * UNCERTAINTY[0]]
    H, to_last = np.zeros((n, 3 + 2 * (n - 1))), np.zeros(3 + 2 * (n - 1))
    H[:, 0], H[:, 1] = 1.0, np.array(seconds) - seconds[0]
    H[:, 2] = np.array(seconds) >= turn
    to_last[1] = 1.0
    for i in range(1, n):
        dt_s = seconds[i] - seconds[i - 1]
        prior += [0.1**2 * SAMPLE[0] * dt_s / 60, rate**2 * dt_s / 3600]
        H[i:, 1 + 2 * i] = 1.0
        H[i:, 2 + 2 * i] = np.array(seconds[i:]) - seconds[i]
        to_last[2 + 2 * i] = 1.0
    variance = READING[0] / (0.99 / 0.02)  # of a mean over 0.99 s
    covariance = np.linalg.inv(np.diag(1 / np.array(prior)) + H.T @ H / variance)
    rates = 3600 * to_last @ covariance @ H.T @ np.array([means[k][:3] for k in seconds]) / variance
    return float(np.linalg.norm(rates)), float(3600 * np.sqrt(to_last @ covariance @ to_last))


def test_the_rate_is_that_of_least_squares() -> None:
    rng, drift, means = np.random.default_rng(1), DriftFilter(), {}
    for k in range(1, 41):
        if k in (12, 13):  # the arm moves in these seconds
            assert not second(drift, k, np.full(6, 9.0), R_end=Rotation.from_rotvec([0.0011, 0, 0]).as_matrix())
            continue
        means[k] = TRUE_RATE / 3600 * k + rng.normal(0, np.sqrt(READING / 50))
        means[k][:3] += 0.1 * (k >= 20)
        assert second(drift, k, means[k], TURNED if k >= 20 else EYE)
    np.testing.assert_allclose(drift.force_rate_N_h, by_least_squares(means, 20))


def test_a_contact_is_no_drift_and_a_load_that_stays_is_a_new_beginning() -> None:
    drift, still, touch = DriftFilter(), DriftFilter(), np.array([0.0, 0.0, 0.5, 0.0, 0.0, 0.0])
    for k in range(10):
        second(drift, k, np.zeros(6))
        second(still, k, np.zeros(6))
    settled = drift.force_rate_N_h
    for k in range(10, 39):
        second(drift, k, touch)
    assert drift.force_rate_N_h[0] == settled[0]
    second(drift, 39, touch)  # the thirtieth
    for k in range(40, 45):
        second(drift, k, touch)
    assert drift._x[2, 0] == pytest.approx(0.5, abs=0.01)


def test_small_turns_and_moves_do_not_matter() -> None:
    plain, turned = DriftFilter(), DriftFilter()
    for k in range(10):
        slightly = Rotation.from_rotvec([0.0, 0.0, 0.028 * (k % 2)]).as_matrix()
        end = slightly @ Rotation.from_rotvec([9e-4, 0, 0]).as_matrix()
        assert second(plain, k, np.full(6, 0.01 * k))
        assert second(turned, k, np.full(6, 0.01 * k), slightly, end)
    assert plain.force_rate_N_h == turned.force_rate_N_h


def test_a_change_of_the_bias_is_no_drift() -> None:
    plain, shifted, change = DriftFilter(), DriftFilter(), np.arange(1.0, 7.0)
    for k in range(12):
        if k == 6:
            shifted.shift(change)
        second(plain, k, np.full(6, 0.01 * k))
        second(shifted, k, np.full(6, 0.01 * k) - change * (k >= 6))
    np.testing.assert_allclose(shifted.force_rate_N_h, plain.force_rate_N_h)


def test_blocks_of_any_size_make_the_same_means() -> None:
    t_ns, rng = np.arange(1000) * 10**7, np.random.default_rng(2)
    residual, poses = rng.normal(0, 0.2, (1000, 6)), np.tile(EYE, (1000, 1, 1))
    whole, pieces = DriftFilter(), DriftFilter()
    assert whole.follow(t_ns, residual, poses, NOISE, UNCERTAINTY)
    parts = np.split(np.arange(1000), range(7, 1000, 7))
    added = [pieces.follow(t_ns[i], residual[i], poses[i], NOISE, UNCERTAINTY) for i in parts]
    assert sum(added) == 10
    np.testing.assert_allclose(whole.force_rate_N_h, pieces.force_rate_N_h)
    np.testing.assert_allclose(DriftFilter().force_rate_N_h, (0.0, 5.0))


def test_a_usual_bias_at_the_beginning_is_no_contact() -> None:
    for bias in (np.array([3.0, 0, 0, 0, 0, 0]), np.array([0, 0, 0, 0.09, 0, 0])):
        drift = DriftFilter()
        second(drift, 0, bias)
        np.testing.assert_allclose(drift._x[:, 0], bias, rtol=0.02)
