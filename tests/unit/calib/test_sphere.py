"""Directions are evenly spread, and the largest gap between some is found."""

import numpy as np
import pytest

from ftcalib.judge.observability import evenly_spread, largest_gap


def test_directions_are_evenly_spread() -> None:
    n = 500
    u = evenly_spread(n)
    np.testing.assert_allclose(np.linalg.norm(u, axis=1), 1)
    np.testing.assert_allclose(u.mean(axis=0), 0, atol=2 / n)
    np.testing.assert_allclose(u.T @ u / n, np.eye(3) / 3, atol=2 / n)
    cosine = u @ u.T - 2 * np.eye(n)
    nearest = np.arccos(cosine.max(axis=1)) / np.sqrt(4 * np.pi / n)  # relative to the side of the area of each
    assert 0.8 < nearest.min() <= nearest.max() < 1.1


@pytest.mark.parametrize("copies", [1, 400])
@pytest.mark.parametrize(
    ("directions", "gap_deg", "towards"),
    [
        ([[0, 0, 1]], 180.0, [0, 0, -1]),
        ([[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, 0, 1], [0, 0, -1]], 90.0, [0, -1, 0]),
        (np.vstack([np.eye(3), -np.eye(3)]), np.degrees(np.arccos(1 / np.sqrt(3))), None),
    ],
)
def test_the_largest_gap(
    directions: list[list[float]], gap_deg: float, towards: list[float] | None, copies: int
) -> None:
    given = np.repeat(np.array(directions, dtype=np.float64), copies, axis=0)
    angle_rad, direction = largest_gap(given)
    assert np.degrees(angle_rad) == pytest.approx(gap_deg, abs=2)
    assert np.arccos((given @ direction).max()) == pytest.approx(angle_rad)
    if towards is not None:
        assert np.degrees(np.arccos(np.clip(direction @ towards, -1, 1))) < 3
