"""Pooled covariances: the common shape, the size of each, and what stays as it is."""

import numpy as np
import pytest
from numpy.typing import NDArray

from ftcalib.data.dataset import pooled_covariance

Array = NDArray[np.float64]
SHAPE = np.diag(np.square([1.0, 2.0, 3.0, 0.1, 0.2, 0.3]))


def sampled(rng: np.random.Generator, n_samples: NDArray[np.int64], scale: Array) -> Array:
    """Covariances of means of n samples of noise with SHAPE, times the scale of each pose."""
    return np.array(
        [
            k * np.cov(rng.multivariate_normal(np.zeros(6), SHAPE, n).T) / n
            for n, k in zip(n_samples, scale, strict=True)
        ]
    )


def misfit(covariance: Array, truth: Array) -> float:
    return float(np.linalg.norm(np.linalg.solve(truth, covariance) - np.eye(6)))


def test_two_poses_are_pooled_and_one_alone_is_not() -> None:
    cov = sampled(np.random.default_rng(1), np.array([20, 20, 20]), np.ones(3))
    for known in ([20, 20, 0], [20, 20, 1]):
        pooled = pooled_covariance(cov, np.array(known))
        assert not np.allclose(pooled[:2], cov[:2])
        np.testing.assert_array_equal(pooled[2], cov[2])
    np.testing.assert_array_equal(pooled_covariance(cov, np.array([20, 0, 1])), cov)


def test_pooling_comes_nearer_to_the_truth() -> None:
    n_samples = np.full(12, 20)
    cov = sampled(np.random.default_rng(2), n_samples, np.ones(12))
    pooled = pooled_covariance(cov, n_samples)
    assert np.mean([misfit(c, SHAPE / 20) for c in pooled]) < 0.6 * np.mean([misfit(c, SHAPE / 20) for c in cov])


def test_a_noisy_pose_keeps_its_size() -> None:
    n_samples, scale = np.full(12, 50), np.ones(12)
    scale[4] = 25.0
    cov = sampled(np.random.default_rng(3), n_samples, scale)
    size = np.trace(np.linalg.solve(SHAPE / 50, pooled_covariance(cov, n_samples)), axis1=1, axis2=2) / 6
    assert 15 < size[4] < 40
    assert np.all(np.delete(size, 4) < 2)


def test_samples_of_filtered_noise_count_as_few() -> None:
    rng, n_samples = np.random.default_rng(4), np.full(24, 1000)
    own = SHAPE * rng.chisquare(4, (24, 1, 6)) / 4  # as of 1000 samples behind a low-pass of 2 Hz
    pooled = np.diagonal(pooled_covariance(own, n_samples), axis1=1, axis2=2) / np.diag(SHAPE)
    assert pooled.std() < 0.35  # 0.7 with the weight of 1000 independent samples
    assert 0.8 < pooled.mean() < 1.2


@pytest.mark.parametrize("freedom", [20, 999])
def test_a_pose_of_another_shape_keeps_it(freedom: int) -> None:
    own = SHAPE * np.random.default_rng(5).chisquare(freedom, (24, 1, 6)) / freedom
    own[7, 2, 2] *= 50.0
    pooled = pooled_covariance(own, np.full(24, 1000))
    assert 20 < pooled[7, 2, 2] / pooled[8, 2, 2] < 60
    assert pooled[7, 0, 0] < 3.5 * pooled[8, 0, 0]


def test_equal_covariances_are_not_changed() -> None:
    np.testing.assert_allclose(pooled_covariance(np.tile(SHAPE, (5, 1, 1)), np.full(5, 2)), np.tile(SHAPE, (5, 1, 1)))


def test_the_mean_noise_is_kept_where_few_samples_are_independent() -> None:
    own = SHAPE * np.random.default_rng(6).chisquare(4, (2000, 1, 6)) / 4
    pooled = np.diagonal(pooled_covariance(own, np.full(2000, 1000)), axis1=1, axis2=2) / np.diag(SHAPE)
    assert pooled.mean() == pytest.approx(1.0, abs=0.02)  # 0.96 with the mean of the logarithms
