"""Errors that have a structure: smooth functions of load and orientation, which no number of poses averages away.

    load         readings that are no linear function of the load: its second and third powers
    cable        force and torque of a cable or hose: a linear function of the entries of the orientation
    kinematics   an error of the orientation of the arm: the same, times the derivative by the orientation

The coefficients of a kind are unknowns of mean zero with one variance. Each basis has about the length 1 in every
orientation, so that the standard deviation is that of the error itself: a share of the weight, N and N·m, rad.

Errors of arm and mounts that resemble the parameters do not show in the data. Their sizes are assumed, and they belong
to the sigmas of the parameters (`hidden_columns`). Hysteresis is no smooth error: see `hysteresis_columns`.
"""

import numpy as np

from ftcalib.known import RANGE_LEVER_M
from ftcalib.model import Array, Parameters, gravity_wrench, jacobian, skew

# Of more poses only the kinds that some of them show, because so many unknowns take memory and time.
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
        "load": _load_response_columns(parameters, R_base_flange),
        "cable": _of_each_channel(away),
        "kinematics": np.einsum("nck,ni->ncki", turn, away).reshape(len(turn), 6, -1),
    }


# Angle over which an error of the arm, or the pull of a cable, changes.
SMOOTH_RAD = 1.2


def alike(R_base_flange: Array, others: Array) -> Array:
    """Return the correlation (n, m) of smooth errors at two orientations."""
    cosine = R_base_flange.reshape(-1, 9) @ others.reshape(-1, 9).T
    return np.asarray(np.exp((cosine - 3) / (2 * SMOOTH_RAD**2)))


# Errors of the orientation that a session hides, in sigmas of the flange: on the side of the base, and smooth ones.
_OF_BASE, _SMOOTH = 5 / 3, 2 / 3
# One sigma of the sag of adapter and mount under the moment of the tool, and of the shift of a soft tool's centre.
_SAG_RAD_PER_NM, _SOFT_M = 3e-4, 1e-4


def hidden_columns(
    parameters: Parameters,
    R_base_flange: Array,
    middle: Array,
    orientation_rad: float,
) -> Array:
    """Give what arm and mounts do to the wrenches (n, 6, k), each column for one standard deviation of its cause.

    It resembles a change of mounting, direction of gravity, bias and centre of mass, so that a session shows little.

    Parameters
    ----------
    parameters : Parameters
    R_base_flange : array, shape (n, 3, 3)
    middle : array, shape (3, 3)
        As in `structure_columns`.
    orientation_rad : float
        One standard deviation of an axis of the arm's orientation; 0 for an exact arm with rigid mounts.
    """
    if orientation_rad == 0:
        return np.zeros((len(R_base_flange), 6, 0))
    turn = jacobian(parameters, R_base_flange)[..., :3]
    return np.concatenate(
        [
            orientation_rad * turn,
            _OF_BASE * orientation_rad * np.einsum("nci,nji->ncj", turn, R_base_flange),
            _SMOOTH * orientation_rad * structure_columns(parameters, R_base_flange, middle)["kinematics"],
            yielding_columns(parameters, R_base_flange),
        ],
        axis=2,
    )


def yielding_columns(parameters: Parameters, R_base_flange: Array) -> Array:
    """Give what mounts and tool do to the wrenches (n, 6, 9) that yield to the weight, as `hidden_columns`."""
    turn = jacobian(parameters, R_base_flange)[..., :3]
    weight = gravity_wrench(parameters, R_base_flange)
    moment_flange_Nm = weight[:, None, 3:] @ parameters.R_flange_sensor.T
    direction = weight[:, :3] / max(parameters.weight_N, 1e-12)
    # A force along i shifts the centre along j by as much as one along j along i.
    i, j = np.triu_indices(3)
    soft, across = np.zeros((len(turn), 6, 6)), -skew(weight[:, :3])
    soft[:, 3:] = across[..., i] * direction[:, None, j] + (i != j) * across[..., j] * direction[:, None, i]
    return np.concatenate([_SAG_RAD_PER_NM * turn * moment_flange_Nm, _SOFT_M * soft], axis=2)


def hidden_in_any_poses(parameters: Parameters, orientation_rad: float) -> Array:
    """Return the covariance (15, 15) of mounting and gravity from errors of the arm's orientation, whatever the poses.

    Arguments as in `hidden_columns`, which also has what the mounts do in given poses.
    """
    hidden = np.zeros((15, 15))
    gravity = skew(parameters.gravity_force_base_N)
    hidden[:3, :3] = (1 + _SMOOTH**2) * np.eye(3)
    hidden[3:6, 3:6] = (_OF_BASE**2 + _SMOOTH**2) * gravity @ gravity.T
    return np.asarray(orientation_rad**2 * hidden)


def error_with_other_joints(parameters: Parameters, orientation_rad: float) -> Array:
    """Return the error (2,) of force and torque, root mean square, where the base joints are not those of the session.

    The error of the orientation on the side of the base was part of the direction of gravity in the session. Half of
    its variance, and the smooth errors of both places, are others there. Arguments as in `hidden_columns`.
    """
    turn_rad = orientation_rad * np.sqrt(_OF_BASE**2 / 2 + 2 * _SMOOTH**2)
    force_N = parameters.weight_N * turn_rad * np.sqrt(2.0)  # two axes across the weight
    return np.asarray(force_N * np.array([1.0, np.sqrt(2 / 3) * np.linalg.norm(parameters.p_sensor_com_m)]))


def _load_response_columns(parameters: Parameters, R_base_flange: Array) -> Array:
    """Give the derivative (n, 6, 54) of the wrench by the coefficients of a response that is not linear.

    Each channel has squares and products of the axes of the force, and their third powers. In the torque they count at
    the lever of the centre of mass, or at that of cross-talk if it is longer.
    """
    u = gravity_wrench(parameters, R_base_flange)[:, :3] / max(parameters.weight_N, 1e-12)
    squares = np.column_stack([u**2, np.sqrt(2) * u * u[:, [1, 2, 0]]])
    lever_m = max(float(np.linalg.norm(parameters.p_sensor_com_m)), RANGE_LEVER_M)
    scale = parameters.weight_N * np.repeat([1.0, lever_m], 3)
    return _of_each_channel(np.column_stack([squares, u**3]) / np.sqrt(2)) * scale[:, None]


def _of_each_channel(basis: Array) -> Array:
    """Give columns (n, 6, 6 k) that have the basis (n, k) in one channel each."""
    return np.asarray(np.einsum("cd,nk->ncdk", np.eye(6), basis).reshape(len(basis), 6, -1))


# How a sensor with hysteresis reads: each axis lags behind by a share of its last swing.
# Reading i is wrench i less a share of its step, wrench i minus wrench i - 1.
#
# Six shares, one for each axis, have one variance. Where the arm came from before the first pose is unknown, so that
# pose is off by a share of a usual swing. Compensation knows no swing: hysteresis is part of the noise of a reading.

# More poses need no allowance for the first.
FEW = 1000


def hysteresis_columns(parameters: Parameters, R_base_flange: Array) -> Array:
    """Give the derivative (n, 6, 12) of the wrench by the shares, and by those of the swing to the first pose.

    The poses are in the order of measuring. More than 1000 have only the first 6 columns.
    """
    wrench = gravity_wrench(parameters, R_base_flange)
    n, axis = len(wrench), range(6)
    columns = np.zeros((n, 6, 12 if n <= FEW else 6))
    swing = np.diff(wrench, axis=0)
    columns[1:, axis, axis] = -swing
    if n <= FEW:
        columns[0, axis, range(6, 12)] = np.sqrt(np.mean(swing**2, axis=0))
    return columns
