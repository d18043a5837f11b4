"""The distance of a reading from a free tool, its limit, and what joins readings to contacts."""

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from ftcalib.model import Array
from ftdrive.stream.contact import ContactTest, Inertia
from ftdrive.stream.noise import SensorNoise
from tests.unit.ftdrive.stream.simulated import KnownNoise, calibrated, paired

RATE_HZ, SIZE = 1000.0, 20
"""A reading is 0.02 s."""
MASS_KG = 1.5
BEYOND = np.repeat([1e-4, 1e-6], 3)
RNG = np.random.default_rng(3)
ROOT = RNG.standard_normal((6, 6)) * np.repeat([0.05, 0.002], 3)[:, None]
NOISE = SensorNoise(np.eye(6), ROOT @ ROOT.T, np.diag(np.repeat([1e-3, 1e-5], 3)), 300.0)
R = np.linalg.qr(RNG.standard_normal((3, 3)))[0]
OFFSET = np.repeat([0.03, 0.001], 3)
FRICTION_AXIS = np.array([0.0, 0.6, 0.8])


def judged(
    test: ContactTest,
    residual: Array,
    predicted: Array,
    state: int,
    felt: Array,
    inertia: Inertia,
    known: SensorNoise = NOISE,
) -> tuple[Array, Array, NDArray[np.bool_]]:
    test.expect(calibrated(), MASS_KG, tensor_known=False)
    n = len(residual)
    motion: Any = np.full(n, state, np.int8), np.tile(felt, (n, 1))
    noise: Any = KnownNoise(known)
    free: Any = SimpleNamespace(
        windows=SimpleNamespace(steps=lambda n: np.zeros(n, int)),
        add=lambda *_: None,
        filter=SimpleNamespace(changes=0, offset=lambda uncertainty, _: (OFFSET, uncertainty)),
    )
    rows = paired(np.tile(R, (n, 1, 1)))
    return test.judge(residual, predicted, rows, motion, noise, free, delay_sigma_s=0.003, inertia=inertia)


def limit_of(rate: float, dof: float) -> float:
    test, nothing = ContactTest(RATE_HZ, rate, BEYOND, FRICTION_AXIS), np.zeros((2 * SIZE, 6))
    judged(test, nothing, nothing, 0, np.zeros(6), Inertia.EXACT, replace(NOISE, dof=dof))
    return test.limit


def test_the_limit_is_that_of_an_estimated_covariance() -> None:
    rng, dof, n = np.random.default_rng(1), 20, 10_000
    samples, readings = rng.standard_normal((n, dof, 6)), rng.standard_normal((n, 6))
    covariances = np.swapaxes(samples, 1, 2) @ samples / dof
    squared = np.einsum("ni,ni->n", readings, np.linalg.solve(covariances, readings[..., None])[..., 0])
    for rate in (0.1, 0.02):
        assert (squared > limit_of(rate, dof)).mean() == pytest.approx(rate, rel=0.1)
    assert limit_of(0.01, 6.0) == float("inf") > limit_of(0.01, 6.1)
