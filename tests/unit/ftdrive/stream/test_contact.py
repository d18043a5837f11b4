"""The limit of the distance of a reading from a free tool."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from ftdrive.stream.contact import ContactTest, Inertia
from ftdrive.stream.noise import SensorNoise
from tests.unit.ftdrive.stream.simulated import KnownNoise, calibrated, paired

RATE_HZ, SIZE = 1000.0, 20
"""A reading is 0.02 s."""
BEYOND = np.repeat([1e-4, 1e-6], 3)


def limit_of(rate: float, dof: float) -> float:
    test, n = ContactTest(RATE_HZ, rate, BEYOND, np.array([0.0, 0.6, 0.8])), 2 * SIZE
    test.expect(calibrated(), 1.5, tensor_known=False)
    nothing = np.zeros((n, 6))
    noise: Any = KnownNoise(SensorNoise(np.eye(6), np.eye(6), np.diag(np.repeat([1e-3, 1e-5], 3)), dof))
    free: Any = SimpleNamespace(
        windows=SimpleNamespace(steps=lambda n: np.zeros(n, int)),
        add=lambda *_: None,
        filter=SimpleNamespace(changes=0, offset=lambda uncertainty, _: (np.zeros(6), uncertainty)),
    )
    motion = np.zeros(n, np.int8), nothing
    rows = paired(np.tile(np.eye(3), (n, 1, 1)))
    test.judge(nothing, nothing, rows, motion, noise, free, delay_sigma_s=0.003, inertia=Inertia.EXACT)
    return test.limit


def test_the_limit_is_that_of_an_estimated_covariance() -> None:
    rng, dof, n = np.random.default_rng(1), 20, 10_000
    samples, readings = rng.standard_normal((n, dof, 6)), rng.standard_normal((n, 6))
    covariances = np.swapaxes(samples, 1, 2) @ samples / dof
    squared = np.einsum("ni,ni->n", readings, np.linalg.solve(covariances, readings[..., None])[..., 0])
    for rate in (0.1, 0.02):
        assert (squared > limit_of(rate, dof)).mean() == pytest.approx(rate, rel=0.1)
    assert limit_of(0.01, 6.0) == float("inf") > limit_of(0.01, 6.1)
