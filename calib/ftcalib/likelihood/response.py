"""How a sensor of inexact calibration responds: a gain of the force, and cross-talk from force to torque.

    force_N = (1 + force_gain) u + force_bias_N        torque_Nm = p x u + cross_talk_m u + torque_bias_Nm

with u the weight in the sensor frame. Both matrices are symmetric, and the gain has no trace: together with mounting,
weight and centre of mass they describe every linear response to one payload. A gain common to all axes cannot be
separated from the weight.
"""

from dataclasses import dataclass

import numpy as np

from ftcalib.files import JSON
from ftcalib.known import COMMON_SHARE, CROSS_TALK_SHARE, RANGE_LEVER_M, USUAL_GAIN
from ftcalib.model import Array, Parameters, gravity_wrench, jacobian, read_only, skew

# Cross-talk counts relative to a force at this lever.
LEVER_M = RANGE_LEVER_M


def _symmetric(i: int, j: int) -> Array:
    matrix = np.zeros((3, 3))
    matrix[i, j] = matrix[j, i] = 1.0
    return matrix


_MIXED = [_symmetric(i, j) for i, j in ((0, 1), (0, 2), (1, 2))]
# (5, 3, 3) basis of the gain: equal and independent coefficients make the entries so.
GAIN = np.array([np.diag([1.0, -1, 0]) / np.sqrt(2), np.diag([1.0, 1, -2]) / np.sqrt(6), *_MIXED])
# (6, 3, 3) basis of the cross-talk, m.
CROSS_TALK_M = LEVER_M * np.array([*(_symmetric(i, i) for i in range(3)), *_MIXED])
SIZE = len(GAIN) + len(CROSS_TALK_M)
# One sigma of each coefficient of a mounted or aged sensor before its fit.
USUAL = USUAL_GAIN * np.array([1.0, 1.0, *[CROSS_TALK_SHARE] * 9])
# Sum of the squares of the entries of each basis; of the cross-talk relative to the lever.
SQUARES = np.array([1.0, 1, 2, 2, 2, 1, 1, 1, 2, 2, 2])

# Weights of the squared coefficients whose sum is the variance of one entry, if all nine are independent: the symmetric
# part of two entries has half their variance.
_ENTRIES = np.array([1, 1, 2, 2, 2]) / 5
# Least sigma of the gain common to all axes: no orientation shows it, and no sensor is better.
LEAST_COMMON_GAIN = 0.002


def response_columns(parameters: Parameters, R_base_flange: Array) -> Array:
    """Give the derivative (..., 6, 11) of the wrench by the coefficients of gain and cross-talk."""
    u = gravity_wrench(parameters, R_base_flange)[..., :3]
    T = np.zeros((*u.shape[:-1], 6, SIZE))
    T[..., :3, :5] = np.einsum("kij,...j->...ik", GAIN, u)
    T[..., 3:, 5:] = np.einsum("kij,...j->...ik", CROSS_TALK_M, u)
    return T


def sensor_columns(parameters: Parameters, R_base_flange: Array) -> dict[str, Array]:
    """Give these derivatives by what they are of."""
    columns = response_columns(parameters, R_base_flange)
    return {"gain": columns[..., : len(GAIN)], "cross_talk": columns[..., len(GAIN) :]}


@dataclass(frozen=True, slots=True, eq=False)
class Response:
    """Gain and cross-talk as estimated; what was not looked for, or not found, is zero. Arrays are read-only."""

    coefficients: Array
    """(11,) of the bases `GAIN` and `CROSS_TALK_M`."""
    covariance: Array
    """(26, 26) of the 15 error coordinates of the parameters and of the coefficients."""

    def __post_init__(self) -> None:
        for name, shape in (("coefficients", (SIZE,)), ("covariance", (15 + SIZE, 15 + SIZE))):
            value = read_only(getattr(self, name))
            if value.shape != shape or not np.isfinite(value).all():
                raise ValueError(f"the response's {name} must be {shape} finite numbers, got shape {value.shape}")
            object.__setattr__(self, name, value)

    @property
    def force_gain(self) -> Array:
        """(3, 3) symmetric, without trace: read minus true force, over the true force."""
        return np.asarray(np.tensordot(self.coefficients[:5], GAIN, 1))

    @property
    def cross_talk_m(self) -> Array:
        """(3, 3) symmetric: torque read for a force, N·m/N."""
        return np.asarray(np.tensordot(self.coefficients[5:], CROSS_TALK_M, 1))

    @property
    def sigma(self) -> dict[str, Array]:
        """One standard deviation (3, 3) of each entry of both matrices, by their names."""
        C = self.covariance[15:, 15:]
        return {
            name: np.sqrt(np.maximum(np.einsum("kij,kl,lij->ij", basis, C[own, own], basis), 0.0))
            for name, basis, own in (("force_gain", GAIN, slice(5)), ("cross_talk_m", CROSS_TALK_M, slice(5, None)))
        }

    @property
    def gain_sigma(self) -> float:
        """Standard deviation of the entries of the whole gain, of which the symmetric part without trace shows."""
        return float(np.sqrt(_ENTRIES @ (self.coefficients**2 + np.diag(self.covariance)[15:])[:5]))

    def wrench(self, parameters: Parameters, R_base_flange: Array) -> Array:
        """Give what gain and cross-talk add (..., 6) to the wrench of the weight."""
        return np.asarray(response_columns(parameters, R_base_flange) @ self.coefficients)

    def to_dict(self) -> dict[str, JSON]:
        """Give what a calibration file holds of it; reading takes `coefficients` and `covariance`."""
        return {
            "force_gain": self.force_gain.tolist(),
            "cross_talk_m": self.cross_talk_m.tolist(),
            "sigma": {name: value.tolist() for name, value in self.sigma.items()},
            "coefficients": self.coefficients.tolist(),
            "covariance": self.covariance.tolist(),
        }


def joint_covariance(covariance: Array, response: Response | None) -> Array:
    """(15, 15) of the parameters, or (26, 26) with gain and cross-talk where they were found."""
    return covariance if response is None else response.covariance


def joint_jacobian(parameters: Parameters, response: Response | None, R_base_flange: Array) -> Array:
    """Derivative (..., 6, 15 or 26) of the wrench by what `joint_covariance` has."""
    J = jacobian(parameters, R_base_flange)
    return J if response is None else np.concatenate([J, response_columns(parameters, R_base_flange)], axis=-1)


def with_covariance(response: Response | None, joint: Array) -> Response | None:
    """Keep gain and cross-talk, if there are any, with another joint covariance."""
    return None if response is None else Response(response.coefficients, joint)


def predicted_covariance(
    parameters: Parameters, covariance: Array, response: Response | None, R_base_flange: Array
) -> Array:
    """Covariance (..., 6, 6) of the predicted wrench that the uncertainty of all estimates causes.

    Parameters
    ----------
    parameters : Parameters
    covariance : array, shape (15, 15)
    response : Response or None
    R_base_flange : array, shape (..., 3, 3)
    """
    J = joint_jacobian(parameters, response, R_base_flange)
    return np.asarray(J @ joint_covariance(covariance, response) @ np.swapaxes(J, -1, -2))


# The whole matrix of the sensor, of which a tool shows eleven numbers.

ENTRIES = np.eye(36).reshape(36, 6, 6)
"""Derivative of an error (6, 6) of the matrix by its entries, row by row."""


def ranges(lever_m: float) -> Array:
    """Return the ranges (6,) of the axes relative to that of a force, for a range of torque of `lever_m` times it."""
    return np.repeat([1.0, lever_m], 3)


def own_variances(gain_sigma: float, lever_m: float = LEVER_M) -> Array:
    """Return the variances (36,) of the entries of a usual sensor's error, without what all axes have in common.

    Parameters
    ----------
    gain_sigma : float
        One standard deviation of the entries of the diagonal, the common part included.
    lever_m : float
        Range of torque over range of force.
    """
    F = ranges(lever_m)
    share = np.where(np.eye(6) > 0, np.sqrt(1 - COMMON_SHARE), CROSS_TALK_SHARE)
    return np.asarray((gain_sigma * share * F[:, None] / F).ravel() ** 2)


def gain_at(E: Array, p: Array) -> tuple[Array, Array]:
    """Return force and torque (..., 3, 3) that E reads for a force at p, beyond the true ones."""
    P = skew(p)
    return E[..., :3, :3] + E[..., :3, 3:] @ P, E[..., 3:, :3] + E[..., 3:, 3:] @ P


def vector_of(M: Array) -> Array:
    """Return the vectors (..., 3) of the antisymmetric part of matrices (..., 3, 3)."""
    A = (M - np.swapaxes(M, -1, -2)) / 2
    return np.stack([A[..., 2, 1], A[..., 0, 2], A[..., 1, 0]], axis=-1)


def mounting_turn(E: Array, p: Array) -> Array:
    """Return the rotation vector (..., 3) that the calibration of a tool at p has for E, sensor axes."""
    return vector_of(gain_at(E, p)[0])


def shown_by(p: Array) -> Array:
    """Return the derivative (11, 36) of gain and cross-talk of a tool at p by the entries of E."""
    force, torque = gain_at(ENTRIES, p)
    torque = torque - skew(p) @ skew(mounting_turn(ENTRIES, p))
    parts = [
        np.einsum("kij,aij->ka", basis, M) / np.einsum("kij,kij->k", basis, basis)[:, None]
        for basis, M in ((GAIN, force), (CROSS_TALK_M, torque))
    ]
    return np.concatenate(parts)


# How a sensor with hysteresis reads: each axis lags behind by a share of its last swing.
# Reading i is wrench i less a share of its step, wrench i minus wrench i - 1.
#
# Six shares, one for each axis, have one variance. Where the arm came from before the first pose is unknown, so that
# pose is off by a share of a usual swing. Compensation knows no swing: hysteresis is part of the noise of a reading.

# More poses need no allowance for the first.
FEW = 1000


def hysteresis_columns(parameters: Parameters, R_base_flange: Array) -> Array:
    """Give the derivative (n, 6, 12) of the wrench by the shares, and by those of the swing to the first pose.

    Parameters
    ----------
    parameters : Parameters
    R_base_flange : array, shape (n, 3, 3)
        In the order of measuring. More than 1000 poses have only the first 6 columns.
    """
    wrench = gravity_wrench(parameters, R_base_flange)
    n, axis = len(wrench), range(6)
    columns = np.zeros((n, 6, 12 if n <= FEW else 6))
    swing = np.diff(wrench, axis=0)
    columns[1:, axis, axis] = -swing
    if n <= FEW:
        columns[0, axis, range(6, 12)] = np.sqrt(np.mean(swing**2, axis=0))
    return columns
