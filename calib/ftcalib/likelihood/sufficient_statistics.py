"""Sufficient statistics: a cost that is quadratic in the sixty coefficients of the model, however many poses there are.

The model is linear in `features`, phi = (R_base_flange row by row, 1): predicted wrench = Theta phi with

    Theta = [[b^T (x) R, F0], [[P]x (b^T (x) R), T0]]    (6, 10),    R = R_flange_sensor.T, b = gravity_force_base_N

so the weighted squares of a million poses are one 60 x 60 matrix, and a Gauss-Newton step costs the same for any
number of them.
"""

from dataclasses import dataclass
from typing import Self

import numpy as np

from ftcalib.likelihood.session_noise import CHUNK, Noise
from ftcalib.model import Array, Parameters, skew

FEW = 256
"""Rows of 100 products per matrix product, so that they stay in the cache."""

_CROSS = skew(np.eye(3))
_CONSTANT = np.zeros((15, 6, 10))
_CONSTANT[range(6, 9), range(3), 9] = _CONSTANT[range(12, 15), range(3, 6), 9] = 1.0


def features(R_base_flange: Array) -> Array:
    """Give phi (n, 10)."""
    return np.concatenate([R_base_flange.reshape(-1, 9), np.ones((len(R_base_flange), 1))], axis=1)


def coefficients(p: Parameters) -> Array:
    """Give Theta (6, 10)."""
    Theta = np.empty((6, 10))
    Theta[:3, :9] = _kron(p.gravity_force_base_N, p.R_flange_sensor.T)
    Theta[3:, :9] = skew(p.p_sensor_com_m) @ Theta[:3, :9]
    Theta[:3, 9], Theta[3:, 9] = p.force_bias_N, p.torque_bias_Nm
    return Theta


def coefficients_derivative(p: Parameters) -> Array:
    """Give the derivative (15, 6, 10) of Theta by the error vector of `Parameters.moved`."""
    R, b = p.R_flange_sensor.T, p.gravity_force_base_N
    T = _CONSTANT.copy()
    T[0:3, :3, :9] = ((R @ _CROSS)[:, :, None, :] * b[:, None]).reshape(3, 3, 9)
    for k in range(3):
        T[3 + k, :3, 3 * k : 3 * k + 3] = R
    T[0:6, 3:, :9] = skew(p.p_sensor_com_m) @ T[0:6, :3, :9]
    T[9:12, 3:, :9] = _CROSS @ _kron(b, R)
    return T


def _kron(b: Array, R: Array) -> Array:
    return np.asarray((R[:, None, :] * b[:, None]).reshape(3, 9))


@dataclass(frozen=True, slots=True, eq=False)
class Statistics:
    """Weighted squares of the residuals as a function of Theta = reference + D: `square - 2 B.D + D.A.D`."""

    reference: Array
    """(6, 10) close to the answer, so that no digits are lost."""
    A: Array
    """(60, 60)"""
    B: Array
    """(60,)"""
    square: float

    @classmethod
    def of(cls, phi: Array, wrench: Array, weights: Array, reference: Array) -> Self:
        """Sum up.

        Parameters
        ----------
        phi : array, shape (n, 10)
        wrench : array, shape (n, 6)
        weights : array, shape (n, 6, 6)
            Inverse noise covariances.
        reference : array, shape (6, 10)
        """
        n = len(phi)
        e = wrench - phi @ reference.T
        We = np.einsum("nij,nj->ni", weights, e)
        A = np.zeros((36, 100))
        for first in range(0, n, FEW):
            part = slice(first, first + FEW)
            outer = (phi[part, :, None] * phi[part, None, :]).reshape(-1, 100)
            A += weights[part].reshape(-1, 36).T @ outer
        return cls(reference, _sixty(A), (We.T @ phi).ravel(), float(np.vdot(We, e)))

    @classmethod
    def of_noise(cls, phi: Array, wrench: Array, noise: Noise, reference: Array) -> Self:
        """Sum up for noise that may be correlated between poses."""
        if noise.independent:
            return cls.of(phi, wrench, noise.W, reference)
        e = wrench - phi @ reference.T
        We = noise.solve(e[..., None])[..., 0]
        A = np.empty((6, 10, 6, 10))
        for channel in range(6):
            X = np.zeros((len(phi), 6, 10))
            X[:, channel] = phi
            A[:, :, channel] = np.tensordot(noise.solve(X), phi, (0, 0)).transpose(0, 2, 1)
        return cls(reference, A.reshape(60, 60), (We.T @ phi).ravel(), float(np.vdot(We, e)))

    @classmethod
    def of_gram(cls, gram: Array, weight: Array, reference: Array) -> Self:
        """Take the sums of `wrench_gram` for one common inverse noise covariance (6, 6)."""
        A = np.einsum("cd,ml->cdml", weight, gram[6:, 6:]).reshape(36, 100)
        return cls(reference, _sixty(A), (weight @ gram[:6, 6:]).ravel(), float(np.vdot(weight, gram[:6, :6])))

    def normal_equations(self, p: Parameters) -> tuple[Array, Array, float]:
        """Give information (15, 15), its right-hand side (15,) and the cost."""
        T = coefficients_derivative(p).reshape(15, 60)
        D = (coefficients(p) - self.reference).ravel()
        rest = self.B - self.A @ D
        return T @ self.A @ T.T, T @ rest, self.square - float(D @ (self.B + rest))


def _sixty(A: Array) -> Array:
    return np.ascontiguousarray(A.reshape(6, 6, 10, 10).transpose(0, 2, 1, 3)).reshape(60, 60)


def wrench_gram(R_base_flange: Array, wrench: Array, reference: Array) -> Array:
    """Sum up all that the model needs to know of poses with common noise.

    Parameters
    ----------
    R_base_flange : array, shape (n, 3, 3)
    wrench : array, shape (n, 6)
    reference : array, shape (6, 10)
        Only its last column may differ from zero: an offset.

    Returns
    -------
    array, shape (16, 16)
        Sum of row.T @ row with row = (wrench - offset, features). Sums of disjoint data add up.
    """
    n = len(wrench)
    gram = np.zeros((16, 16))
    rows = np.ones((min(n, CHUNK), 16))
    for first in range(0, n, CHUNK):
        size = min(CHUNK, n - first)
        np.subtract(wrench[first : first + size], reference[:, 9], out=rows[:size, :6])
        rows[:size, 6:15] = R_base_flange[first : first + size].reshape(-1, 9)
        gram += rows[:size].T @ rows[:size]
    return gram
