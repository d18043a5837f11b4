"""Selection of poses that verify a calibration: far from those of the fit, and able to name what has changed."""

from itertools import combinations

import numpy as np
from numpy.typing import ArrayLike

from ftcalib.model import BIASES, Array
from ftcalib.poses.information import Guess, whitened_jacobian
from ftcalib.poses.selection import Indices, greedy_and_exchange

FEWEST = 2
FARTHER_SHARE = 0.5
"""Share of the candidates, the farthest from the fit, among which the poses are chosen."""
TOOL = Guess(mass_kg=1.0, sigma_force_N=0.02, sigma_torque_Nm=0.001)
"""The choice hardly depends on the tool."""
USUAL_CHANGE = np.repeat([np.deg2rad(1.0), TOOL.weight_N * np.deg2rad(0.5), 0.5, 3e-3, 0.02], 3)
"""(15,) of mounting, gravity force, force bias, centre of mass and torque bias."""

CAUSES = (range(3), range(3, 6), range(9, 12), BIASES)
"""Error coordinates of mounting, gravity force (base or payload), centre of mass, and bias."""


def choose_verification_poses(
    candidates: Array, fitted: Array, n: int, *, gravity_direction_base: ArrayLike = (0.0, 0.0, -1.0)
) -> Indices:
    """Choose poses for a verification: greedily, then exchanging one at a time as long as it helps.

    They are chosen among the half of the candidates in which gravity pulls on the tool from directions farthest from
    those of the fit. They maximise the determinants of the information about each pair of causes of a change, with a
    prior of the usual size of a change. Two poses then differ in tilt, and no two causes look alike.

    Parameters
    ----------
    candidates : array, shape (m, 3, 3)
        Orientations R_base_flange that the arm can reach.
    fitted : array, shape (k, 3, 3)
        R_base_flange of the calibration.
    n : int
        2 or more.
    gravity_direction_base : array_like, shape (3,)
        For a robot on a table -z.

    Returns
    -------
    int array, shape (n,)
        Indices of candidates, all different.
    """
    candidates, fitted = np.asarray(candidates, dtype=np.float64), np.asarray(fitted, dtype=np.float64)
    if not FEWEST <= n <= len(candidates):
        raise ValueError(f"cannot choose {n} poses of {len(candidates)}: {FEWEST} or more, of at least as many")
    down = np.asarray(gravity_direction_base, dtype=np.float64)
    nearest = np.max((down @ candidates) @ (down @ fitted).T, axis=1, initial=-np.inf)  # cosine, in flange axes
    count = max(n, round(FARTHER_SHARE * len(candidates)))
    far = np.sort(np.argsort(nearest, kind="stable")[:count])
    rows = whitened_jacobian(candidates[far], TOOL) / TOOL.scale * USUAL_CHANGE
    pairs = [rows[..., [*a, *b]] for a, b in combinations(CAUSES, 2)]

    def gains(chosen: list[int]) -> Array:
        """Increase of log det(1 + sum of J'J), summed over the pairs of causes."""
        total = np.zeros(len(far))
        for J in pairs:
            done = J[chosen].reshape(-1, J.shape[2])
            covariance = np.linalg.inv(np.eye(J.shape[2]) + done.T @ done)
            total += np.linalg.slogdet(np.eye(6) + J @ covariance @ np.swapaxes(J, 1, 2))[1]
        return total

    return np.asarray(far[greedy_and_exchange(gains, n)])
