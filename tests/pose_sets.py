"""Pose sets with known information, and the efficiency of a set: what tests and benchmarks of plans compare with."""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from ftcalib.model import Array
from ftcalib.poses.information import Guess, prediction_weights, special, whitened_jacobian

SUBSET_12 = (2, 4, 5, 7, 10, 12, 13, 15, 18, 20, 21, 23)
"""A-optimal for the forces; with torques 0.96 to 1 of `T12`, depending on the centre of mass."""
SUBSET_8 = (2, 3, 6, 8, 17, 19, 22, 23)
"""The best eight of the 24: second-basin gap 0.5."""
AMBIGUOUS_6 = (4, 6, 9, 15, 18, 23)
"""A-optimal for the forces, but another mounting of the sensor explains them exactly (gap 0): do not use."""

# Found by numerical optimisation; rotation vectors in rad of R_base_flange, tool down first.
_OPTIMISED: Mapping[int, tuple[tuple[float, float, float], ...]] = {
    6: (
        (3.141593, 0.000000, 0.000000),
        (-0.435672, 1.905989, -1.760305),
        (-1.130622, -1.904908, -1.547113),
        (0.914169, -0.138790, -1.156033),
        (-0.774574, 1.437738, 1.067425),
        (0.000059, -0.860257, 1.088217),
    ),
    8: (
        (3.141593, 0.000000, 0.000000),
        (0.001302, 3.140850, -0.006137),
        (1.010150, -0.991248, 1.652328),
        (-1.184080, 0.401703, 0.653962),
        (0.490081, 1.439710, -2.023385),
        (0.793096, -1.522294, -2.392674),
        (1.096127, 0.574306, 0.209976),
        (-0.909292, -0.925868, -1.044533),
    ),
}


class Efficiency(NamedTuple):
    """Information per pose relative to the 24 special orientations: 1 is the best possible."""

    D: float
    """From the determinant of the information, per parameter."""
    A: float
    """From the trace of the covariance in the units of `Guess.scale`."""
    I_F: float
    """From the mean square error of force compensation over all orientations."""
    I_T: float
    """The same of torque."""


def optimised(n: int) -> Array:
    """Return n orientations R_base_flange (n, 3, 3), n = 6 or 8, nearly as good per pose as the special 24.

    They have the least mean inverse efficiency for centres of mass in all directions. The first has the tool straight
    down. A turn of the whole set about the vertical, or by one rotation of the flange, keeps its information.
    """
    return Rotation.from_rotvec(_OPTIMISED[n]).as_matrix()


def efficiency(R_base_flange: Array, guess: Guess) -> Efficiency:
    """Compare the information per pose with that of the 24 special orientations.

    Parameters
    ----------
    R_base_flange : array, shape (n, 3, 3)
        A set that determines all parameters.
    guess : Guess
        Only the ratio of its torque and force noise matters.
    """
    own, best = (_per_pose(R, guess) for R in (np.asarray(R_base_flange, dtype=np.float64), special(range(1, 25))))
    return Efficiency(*(b / o for o, b in zip(own, best, strict=True)))


def _per_pose(R_base_flange: Array, guess: Guess) -> tuple[float, float, float, float]:
    """Variances whose inverses are D, A, I_F and I_T, for the information of one average pose."""
    J = whitened_jacobian(R_base_flange, guess)
    covariance = np.linalg.inv(np.einsum("nki,nkj->ij", J, J) / len(J))
    _, log_det = np.linalg.slogdet(covariance)
    force, torque = (float(np.sum(covariance * M)) for M in prediction_weights(special(range(1, 25)), guess))
    return float(np.exp(log_det / 15)), float(np.trace(covariance)), force, torque
