"""The drift until the next use."""

from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest

from ftcalib.judge.verdict import drift_ahead
from ftcalib.likelihood.fit import Estimate
from ftcalib.model import Array, DriftResult

CHANGE, SIGMA = np.array([0.3, 0, 0.4, 0, 0.01, 0]), np.array([0.02, 0.02, 0.02, 1e-3, 1e-3, 1e-3])


def drifting(components: dict[str, float], rows: Array) -> Estimate:
    """Of 12 poses, whose bias grows by a twelfth of its change at each; the first and the last are left out."""
    share = (rows - 5.5) / 12
    drift, used = DriftResult(CHANGE, SIGMA, share[:, None] * CHANGE), (rows > 0) & (rows < 11)
    return cast(Estimate, SimpleNamespace(drift=drift, weights=used.astype(float), components=components))


@pytest.mark.parametrize(("interval_s", "per_min"), [(20.0, 3), (None, 6)])
def test_a_bias_goes_on_as_it_moved(interval_s: float | None, per_min: int) -> None:
    rows = np.arange(12.0) if interval_s is None else np.random.default_rng(0).permutation(12).astype(float)
    times = None if interval_s is None else 100 + interval_s * rows
    line = drift_ahead(drifting({}, rows), times)
    growth = CHANGE * per_min / 9  # nine intervals between the used poses
    np.testing.assert_allclose(line.growth_per_min, growth)
    np.testing.assert_allclose(line.square, growth**2 + SIGMA**2 / 2)
    # A warm-up of 20 min has gone 95 % of its way in an hour, 19 times as far as in a minute.
    np.testing.assert_allclose(line.hour_square, (20 * (1 - np.exp(-3)) * growth) ** 2 + SIGMA**2 / 2)

    walks = {"walk_force_N": 0.1, "walk_fy_N": 0.2, "walk_tz_Nm": 0.01, "white_force_N": 5.0}
    walk = drift_ahead(drifting(walks, rows), times)
    variance = per_min * np.array([0.01, 0.01 + 0.04, 0.01, 0, 0, 1e-4])
    growth = np.where(variance > 0, 0.0, growth)
    np.testing.assert_allclose(walk.growth_per_min, np.sqrt(variance) + growth)
    np.testing.assert_allclose(walk.square, growth**2 + variance + SIGMA**2 / 2)
    where = variance > 0
    np.testing.assert_allclose(walk.hour_square[where], (60 * variance + SIGMA**2 / 2)[where])


def test_times_that_are_no_times_are_intervals_of_ten_seconds() -> None:
    fit, rows = drifting({"walk_force_N": 0.1}, np.arange(12.0)), np.arange(12.0)
    for times in (np.full(12, 7.0), np.where(rows == 3, np.nan, rows)):
        np.testing.assert_array_equal(drift_ahead(fit, times).square, drift_ahead(fit).square)
