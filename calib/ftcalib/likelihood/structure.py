"""Structured errors: smooth functions of load and orientation, which do not average out over many poses.

    load         nonlinear response of the sensor: second and third powers of the load
    cable        force and torque of a cable or hose: a linear function of the entries of the orientation matrix
    kinematics   orientation error of the arm: a linear function of the same entries

The coefficients of a kind are random with zero mean and a common variance. The basis functions have a norm of about 1
in every orientation, so the standard deviation is that of the error itself: a share of the weight, N and N·m, or rad.

Errors of arm and mounts that resemble a change of the parameters do not show in the data. Their sizes are assumed, and
they are part of the sigmas of the parameters (`hidden_columns`). Hysteresis is not smooth: see `hysteresis_columns`.
"""

import numpy as np

from ftcalib.known import RANGE_LEVER_M
from ftcalib.model import Array, Parameters, gravity_wrench, jacobian, skew

# With more poses than this, only the kinds found in a subset are modelled, to save memory and time.
MOST_POSES = 1000


def structure_columns(parameters: Parameters, R_base_flange: Array, middle: Array) -> dict[str, Array]:
    """Return the derivatives (n, 6, k) of the wrench with respect to the coefficients of each kind.

    Parameters
    ----------
    R_base_flange : array, shape (n, 3, 3)
    middle : array, shape (3, 3)
        Mean of the orientations of the session, where errors of cable and arm are part of bias and mounting.
    """
    away = (R_base_flange - middle).reshape(-1, 9) / np.sqrt(3)
    turn = jacobian(parameters, R_base_flange)[..., :3]
    return {
        "load": _load_response_columns(parameters, R_base_flange),
        "cable": _of_each_channel(away),
        "kinematics": np.einsum("nck,ni->ncki", turn, away).reshape(len(turn), 6, -1),
    }


# Angle over which orientation errors of the arm and cable forces are correlated.
SMOOTH_RAD = 1.2


def alike(R_base_flange: Array, others: Array) -> Array:
    """Return the correlation (n, m) of smooth errors between orientations (n, 3, 3) and others (m, 3, 3)."""
    cosine = R_base_flange.reshape(-1, 9) @ others.reshape(-1, 9).T
    return np.asarray(np.exp((cosine - 3) / (2 * SMOOTH_RAD**2)))


# Orientation errors that a session cannot show, relative to the sigma of the flange: constant in base, and smooth ones.
_OF_BASE, _SMOOTH = 5 / 3, 2 / 3
# One sigma of the sag of adapter and mount under the moment of the tool, and of the shift of a compliant tool's centre
# of mass under its weight.
_SAG_RAD_PER_NM, _SOFT_M = 3e-4, 1e-4


def hidden_columns(
    parameters: Parameters,
    R_base_flange: Array,
    middle: Array,
    orientation_rad: float,
) -> Array:
    """Return the effects (n, 6, k) of errors of arm and mounts on the wrenches, one column per standard deviation.

    They resemble a change of mounting, direction of gravity, bias and centre of mass, so a session hardly shows them.

    Parameters
    ----------
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
    """Return the effects (n, 6, 9) of compliant mounts and of a compliant tool, as in `hidden_columns`."""
    turn = jacobian(parameters, R_base_flange)[..., :3]
    weight = gravity_wrench(parameters, R_base_flange)
    moment_flange_Nm = weight[:, None, 3:] @ parameters.R_flange_sensor.T
    direction = weight[:, :3] / max(parameters.weight_N, 1e-12)
    # The compliance is symmetric: a force along i shifts the centre along j as much as a force along j does along i.
    i, j = np.triu_indices(3)
    soft, across = np.zeros((len(turn), 6, 6)), -skew(weight[:, :3])
    soft[:, 3:] = across[..., i] * direction[:, None, j] + (i != j) * across[..., j] * direction[:, None, i]
    return np.concatenate([_SAG_RAD_PER_NM * turn * moment_flange_Nm, _SOFT_M * soft], axis=2)


def hidden_in_any_poses(parameters: Parameters, orientation_rad: float) -> Array:
    """Return the covariance (15, 15) of mounting and gravity due to orientation errors of the arm, for any poses.

    Arguments as in `hidden_columns`, which also includes the mounts, for given poses.
    """
    hidden = np.zeros((15, 15))
    gravity = skew(parameters.gravity_force_base_N)
    hidden[:3, :3] = (1 + _SMOOTH**2) * np.eye(3)
    hidden[3:6, 3:6] = (_OF_BASE**2 + _SMOOTH**2) * gravity @ gravity.T
    return np.asarray(orientation_rad**2 * hidden)


def error_with_other_joints(parameters: Parameters, orientation_rad: float) -> Array:
    """Return the rms error (2,) of force and torque at base joint angles that differ from those of the session.

    In the session, the orientation error that is constant in base is part of the direction of gravity. At other base
    joints half of its variance, and the smooth errors of both places, are different. Arguments as in `hidden_columns`.
    """
    turn_rad = orientation_rad * np.sqrt(_OF_BASE**2 / 2 + 2 * _SMOOTH**2)
    force_N = parameters.weight_N * turn_rad * np.sqrt(2.0)  # rotations about the two axes perpendicular to gravity act
    return np.asarray(force_N * np.array([1.0, np.sqrt(2 / 3) * np.linalg.norm(parameters.p_sensor_com_m)]))


def _load_response_columns(parameters: Parameters, R_base_flange: Array) -> Array:
    """Return the derivative (n, 6, 54) of the wrench with respect to the coefficients of a nonlinear response.

    Each channel has squares, products and third powers of the components of the force. In the torque they are scaled by
    the lever of the centre of mass, or by that of cross-talk if it is longer.
    """
    u = gravity_wrench(parameters, R_base_flange)[:, :3] / max(parameters.weight_N, 1e-12)
    squares = np.column_stack([u**2, np.sqrt(2) * u * u[:, [1, 2, 0]]])
    lever_m = max(float(np.linalg.norm(parameters.p_sensor_com_m)), RANGE_LEVER_M)
    scale = parameters.weight_N * np.repeat([1.0, lever_m], 3)
    return _of_each_channel(np.column_stack([squares, u**3]) / np.sqrt(2)) * scale[:, None]


def _of_each_channel(basis: Array) -> Array:
    """Return columns (n, 6, 6 k) with the basis (n, k) in each of the six channels separately."""
    return np.asarray(np.einsum("cd,nk->ncdk", np.eye(6), basis).reshape(len(basis), 6, -1))


# Hysteresis: each axis lags behind by a share of its last change. Reading i is wrench i minus a share of the step from
# wrench i - 1 to wrench i.
#
# The six shares, one for each axis, have a common variance. The step to the first pose is unknown, so a usual step is
# assumed for it. The compensation does not model steps, so hysteresis is part of the noise of a reading.

# With more poses than this, hysteresis from the unknown step to the first pose is negligible.
FEW = 1000


def hysteresis_columns(parameters: Parameters, R_base_flange: Array) -> Array:
    """Return the wrench's derivative (n, 6, 12) with respect to the shares, and those of the step to the first pose.

    The poses are in the order of measurement. With more than 1000 poses only the first 6 columns are returned.
    """
    wrench = gravity_wrench(parameters, R_base_flange)
    n, axis = len(wrench), range(6)
    columns = np.zeros((n, 6, 12 if n <= FEW else 6))
    swing = np.diff(wrench, axis=0)
    columns[1:, axis, axis] = -swing
    if n <= FEW:
        columns[0, axis, range(6, 12)] = np.sqrt(np.mean(swing**2, axis=0))
    return columns
