"""Errors that have a structure: smooth functions of load and orientation, which no number of poses averages away.

    load         readings that are no linear function of the load: its second and third powers
    cable        force and torque of a cable or hose: a linear function of the entries of the orientation
    kinematics   an error of the orientation of the arm: the same, times the derivative by the orientation

The coefficients of a kind are unknowns of mean zero with one variance. Each basis has about the length 1 in every
orientation, so that the standard deviation is that of the error itself: a share of the weight, N and N·m, rad.
"""

import numpy as np

from ftcalib.likelihood.response import LEVER_M
from ftcalib.model import Array, Parameters, gravity_wrench, jacobian

# More poses need too much memory for so many unknowns; what is smooth then shows in poses that are left out in blocks.
MOST_POSES = 1000


def structure_columns(parameters: Parameters, R_base_flange: Array, middle: Array) -> dict[str, Array]:
    """Give the derivatives (n, 6, k) of the wrench by the coefficients of each kind.

    Parameters
    ----------
    parameters : Parameters
    R_base_flange : array, shape (n, 3, 3)
    middle : array, shape (3, 3)
        Mean of the orientations of the session: what a cable or the arm does there is part of bias and mounting.
    """
    away = (R_base_flange - middle).reshape(-1, 9) / np.sqrt(3)
    turn = jacobian(parameters, R_base_flange)[..., :3]
    return {
        "load": _load_columns(parameters, R_base_flange),
        "cable": _of_each_channel(away),
        "kinematics": np.einsum("nck,ni->ncki", turn, away).reshape(len(turn), 6, -1),
    }


def _load_columns(parameters: Parameters, R_base_flange: Array) -> Array:
    """Give the derivative (n, 6, 54) of the wrench by the coefficients of a response that is not linear.

    Each channel has squares and products of the axes of the force, and their third powers. In the torque they count at
    the lever of the centre of mass, or at that of cross-talk if it is longer.
    """
    u = gravity_wrench(parameters, R_base_flange)[:, :3] / max(parameters.weight_N, 1e-12)
    squares = np.column_stack([u**2, np.sqrt(2) * u * u[:, [1, 2, 0]]])
    lever_m = max(float(np.linalg.norm(parameters.p_sensor_com_m)), LEVER_M)
    scale = parameters.weight_N * np.repeat([1.0, lever_m], 3)
    return _of_each_channel(np.column_stack([squares, u**3]) / np.sqrt(2)) * scale[:, None]


def _of_each_channel(basis: Array) -> Array:
    """Give columns (n, 6, 6 k) that have the basis (n, k) in one channel each."""
    return np.asarray(np.einsum("cd,nk->ncdk", np.eye(6), basis).reshape(len(basis), 6, -1))
