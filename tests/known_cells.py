"""Cells whose truth several tests know."""

import numpy as np
from scipy.spatial.transform import Rotation

from ftcalib import Parameters
from ftcalib.model import Array

SIGMA = np.repeat([0.05, 0.05 * 0.025], 3)
# Like a real cell: the sensor is mounted nearly upside down and turned, the base leans a little.
UPSIDE_DOWN = Parameters(
    Rotation.from_euler("ZYX", [105, 2, 179], degrees=True).as_matrix(),
    np.array([0.6, -0.4, -20.0]),
    np.array([3.0, -5.0, 8.0]),
    np.array([0.01, -0.02, -0.07]),
    np.array([0.1, 0.2, -0.3]),
)
UPRIGHT = Parameters(
    Rotation.from_euler("zx", [20, 3], degrees=True).as_matrix(),
    np.array([0.2, -0.1, -11.76]),
    np.array([3.0, -2.0, 5.0]),
    np.array([0.01, -0.005, 0.07]),
    np.array([0.1, 0.2, -0.1]),
)
TURNED = Parameters(
    Rotation.from_rotvec([0.02, -0.01, 0.5]).as_matrix(),
    np.array([0.1, -0.2, -12.0]),
    np.array([1.0, -2.0, 3.0]),
    np.array([0.004, -0.002, 0.05]),
    np.array([0.01, 0.02, -0.03]),
)


def white(n: int, sigma: Array = SIGMA) -> Array:
    """Covariances (n, 6, 6) of independent channels."""
    return np.tile(np.diag(sigma**2), (n, 1, 1))
