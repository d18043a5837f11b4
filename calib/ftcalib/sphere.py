"""Directions: evenly spread over the sphere, the largest gap between given ones, and the axes that they are near."""

import numpy as np

from ftcalib.model import Array

# Neighbours are about 3° apart.
_POINTS = 4000
# Directions that are compared with all points at once, to save memory.
_PART = 500
_ALIGNED = np.sin(np.radians(22.5))


def evenly_spread(n: int) -> Array:
    """Return n unit vectors (n, 3), evenly spread over the sphere: Fibonacci's spiral."""
    i = np.arange(n) + 0.5
    z, azimuth = 1 - 2 * i / n, i * np.pi * (3 - np.sqrt(5))
    rho = np.sqrt(1 - z**2)
    return np.column_stack([rho * np.cos(azimuth), rho * np.sin(azimuth), z])


def largest_gap(directions: Array) -> tuple[float, Array]:
    """Find the direction that is farthest from the nearest of these unit vectors (n, 3).

    Returns
    -------
    angle_rad : float
        From that direction to the nearest, to about a degree.
    direction : array, shape (3,)
        Unit vector.
    """
    everywhere = evenly_spread(_POINTS)
    parts = np.array_split(directions, 1 + len(directions) // _PART)
    nearest = np.max([(everywhere @ part.T).max(axis=1) for part in parts], axis=0)
    worst = int(np.argmin(nearest))
    return float(np.arccos(np.clip(nearest[worst], -1, 1))), everywhere[worst]


def axes_along(direction: Array) -> list[str]:
    """Return the names of the axes along or between which a unit vector (3,) points, such as "-x"."""
    return [
        f"{'-' if part < 0 else '+'}{axis}"
        for axis, part in zip("xyz", direction.tolist(), strict=True)
        if abs(part) > _ALIGNED
    ]
