"""Gain of a sensor whose own calibration is wrong, identified from known weights.

Force gain, 3x3: F_i = M A_i b + F0 with A = R_base_flange.T and M = K R_sensor_flange. Only M and b are identifiable,
up to a common scale, so one known weight is needed. Splitting M into a gain K and a rotation is a
convention: here the polar one, K symmetric and positive.

Wrench gain, 6x6: y_i = C (f_i, p_k x f_i) + y0 with f_i = w_k R_sensor_flange A_i d, d the direction of gravity and k
the payload of pose i. Three known payloads whose centres of mass are not on one line are needed, because in all
poses the torques of one payload are the same combination of its forces.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from calib.data.dataset import finite
from calib.errors import BadDataset, NotObservable
from calib.model import Array, Parameters, skew

RANK_TOLERANCE = 1e-9  # of eigenvalues of the Fisher information, columns scaled
MAX_STEPS = 30
CONVERGED = 1e-6  # standard deviations of the noise

Linearised = Callable[[Array], tuple[Array, Array]]
"""Parameters to Jacobian (n, k, parameters) and residual (n, k)."""


@dataclass(frozen=True, slots=True, eq=False)
class ForceGain:
    """A 3x3 force gain with the gravity force and bias that belong to it."""

    M: Array
    """(3, 3) true force in flange axes to measured force, dimensionless; `gain @ R_flange_sensor.T`."""
    gravity_force_base_N: Array
    """(3,) of the known norm."""
    force_bias_N: Array
    """(3,) as measured."""
    covariance: Array
    """(15, 15) of M row by row, gravity force, force bias; rank 14, because the weight is taken as exact."""
    chi2: float
    dof: int

    @property
    def gain(self) -> Array:
        """(3, 3) K = (M M^T)^(1/2), by the polar convention: true force in sensor axes to measured force."""
        U, s, _ = np.linalg.svd(self.M)
        return np.asarray(U * s @ U.T)

    @property
    def R_flange_sensor(self) -> Array:
        """(3, 3) maps sensor coordinates to flange coordinates, by the polar convention."""
        U, _, Vt = np.linalg.svd(self.M)
        return np.asarray((U @ Vt).T)

    def compensate_force(self, force_N: Array, R_base_flange: Array) -> Array:
        """Return the true contact force in the sensor axes of `R_flange_sensor`.

        Parameters
        ----------
        force_N : array, shape (..., 3)
            As measured.
        R_base_flange : array, shape (..., 3, 3)

        Returns
        -------
        array, shape (..., 3)
            N.
        """
        flange_N = (force_N - self.force_bias_N) @ np.linalg.inv(self.M).T - self.gravity_force_base_N @ R_base_flange
        return np.asarray(flange_N @ self.R_flange_sensor)


@dataclass(frozen=True, slots=True)
class Payload:
    """A known load on the sensor, everything below the sensor included."""

    weight_N: float
    p_sensor_com_m: tuple[float, float, float] | None
    """Centre of mass in the sensor frame; None if unknown."""


@dataclass(frozen=True, slots=True, eq=False)
class WrenchGain:
    """A 6x6 gain in the sensor axes of the starting calibration."""

    gain: Array
    """(6, 6) C: true wrench to measured wrench; blocks in 1, 1/m, m, 1."""
    gravity_direction_base: Array
    """(3,) unit vector."""
    bias: Array
    """(6,) N and N·m as measured."""
    covariance: Array
    """(45, 45) of C row by row, direction, bias; rank 44, because the direction has length 1."""
    chi2: float
    dof: int


def estimate_force_gain(
    start: Parameters, R_base_flange: Array, force_N: Array, force_cov: Array, weight_N: float | None
) -> ForceGain:
    """Force gain, direction of gravity and bias from one known weight: 14 numbers.

    Parameters
    ----------
    start : Parameters
        An ordinary calibration of the same poses, without gain.
    R_base_flange : array, shape (n, 3, 3)
        n >= 5 different orientations; 12 or more recommended.
    force_N : array, shape (n, 3)
        Mean readings as measured, in the sensor frame.
    force_cov : array, shape (n, 3, 3)
        Covariance of those means.
    weight_N : float or None
        True weight of the load on the measuring side, assumed exact.

    Raises
    ------
    BadDataset
        Shapes that do not fit each other.
    NotObservable
        The weight is unknown, or the poses do not determine all parameters.
    """
    n = len(force_N)
    R_base_flange = finite("R_base_flange", R_base_flange, (n, 3, 3))
    force_N, force_cov = finite("force_N", force_N, (n, 3)), finite("force_cov", force_cov, (n, 3, 3))
    if weight_N is None:
        raise NotObservable(
            "the scale is undetermined without a known weight, because twice the gain and half the weight give the "
            "same readings: weigh the load on the sensor and pass its weight."
        )
    _require_weight(weight_N)
    if 3 * n < 14:
        raise NotObservable(f"{n} poses give {3 * n} equations for 14 numbers: add {5 - n} or more orientations.")

    def linearised(x: Array) -> tuple[Array, Array]:
        M, d, bias = x[:9].reshape(3, 3), x[9:12], x[12:]
        turned = d @ R_base_flange  # (n, 3) unit gravity in flange axes
        J = np.zeros((n, 3, 15))
        J[:, :, 0:9] = np.einsum("ij,nk->nijk", np.eye(3), weight_N * turned).reshape(n, 3, 9)
        J[:, :, 9:12] = weight_N * M @ np.swapaxes(R_base_flange, 1, 2)
        J[:, :, 12:15] = np.eye(3)
        return J, force_N - weight_N * turned @ M.T - bias

    x, covariance, chi2 = _fit(
        linearised,
        np.concatenate([start.R_flange_sensor.T.ravel(), _unit(start.gravity_force_base_N), start.force_bias_N]),
        slice(9, 12),
        force_cov,
        "force gain: tilt the tool about two axes and turn it about its own, over as wide a range as possible.",
    )
    if np.linalg.det(x[:9].reshape(3, 3)) <= 0:
        raise NotObservable("the estimated gain is a reflection: start from a calibration of the same poses.")
    scale = np.concatenate([np.ones(9), np.full(3, weight_N), np.ones(3)])
    return ForceGain(
        x[:9].reshape(3, 3), weight_N * x[9:12], x[12:], covariance * np.outer(scale, scale), chi2, 3 * n - 14
    )


def estimate_wrench_gain(
    start: Parameters,
    R_base_flange: Array,
    wrench: Array,
    wrench_cov: Array,
    payload_of_pose: Sequence[int],
    payloads: Sequence[Payload],
) -> WrenchGain:
    """Wrench gain, direction of gravity and bias from three known payloads: 44 numbers.

    Parameters
    ----------
    start : Parameters
        An ordinary calibration: its `R_flange_sensor` fixes the sensor axes, its gravity and biases start the fit.
    R_base_flange : array, shape (n, 3, 3)
    wrench : array, shape (n, 6)
        Mean readings as measured, N and N·m, in the sensor frame, without any tare between the payloads.
    wrench_cov : array, shape (n, 6, 6)
        Covariance of those means.
    payload_of_pose : sequence of n int
        Index into `payloads`.
    payloads : sequence of Payload

    Raises
    ------
    BadDataset
        Shapes that do not fit each other.
    NotObservable
        Fewer than three payloads, their centres of mass unknown or on one line, or too few poses.
    """
    n = len(wrench)
    R_base_flange = finite("R_base_flange", R_base_flange, (n, 3, 3))
    wrench, wrench_cov = finite("wrench", wrench, (n, 6)), finite("wrench_cov", wrench_cov, (n, 6, 6))
    index = np.asarray(payload_of_pose)
    if index.shape != (n,) or not np.isin(index, np.arange(len(payloads))).all():
        raise BadDataset(f"payload_of_pose must give one of 0..{len(payloads) - 1} for each of the {n} poses.")
    for payload in payloads:
        _require_weight(payload.weight_N)
    unknown = [k for k, payload in enumerate(payloads) if payload.p_sensor_com_m is None]
    if unknown:
        raise NotObservable(
            f"the centre of mass of payload {', '.join(str(k) for k in unknown)} is unknown. Without any of them, 4 "
            "parameters are undetermined, the origin of torques (3) and their scale (1): measure the centres of mass."
        )
    weight_N = np.array([payload.weight_N for payload in payloads])
    p_sensor_com_m = np.array([payload.p_sensor_com_m for payload in payloads])
    used = np.unique(index)
    free = 6 * (6 - _wrenches_spanned(p_sensor_com_m[used]))
    if free:
        raise NotObservable(
            f"{len(used)} known payload{'s' if len(used) > 1 else ''} do not determine {free} of 44 "
            "parameters: use three whose centres of mass are not on one line."
        )

    def linearised(x: Array) -> tuple[Array, Array]:
        return wrench_gain_linearised(
            x, start.R_flange_sensor, R_base_flange, wrench, weight_N[index], p_sensor_com_m[index]
        )

    x, covariance, chi2 = _fit(
        linearised,
        np.concatenate(
            [np.eye(6).ravel(), _unit(start.gravity_force_base_N), start.force_bias_N, start.torque_bias_Nm]
        ),
        slice(36, 39),
        wrench_cov,
        "wrench gain: tilt the tool about two axes and turn it about its own with each payload.",
    )
    return WrenchGain(x[:36].reshape(6, 6), x[36:39], x[39:], covariance, chi2, 6 * n - 44)


def _wrenches_spanned(p_sensor_com_m: Array) -> int:
    """Dimension of the wrenches that weights at these points (k, 3) can exert: 3, 5 or 6 of 6."""
    arms = np.linalg.svd(p_sensor_com_m - p_sensor_com_m.mean(axis=0), compute_uv=False)
    significant = int((arms > 1e-3).sum())  # points within 1 mm of each other, or of one line, count as coincident
    return (3, 5, 6, 6)[significant]


def wrench_gain_linearised(
    x: Array, R_flange_sensor: Array, R_base_flange: Array, wrench: Array, weight_N: Array, p_sensor_com_m: Array
) -> tuple[Array, Array]:
    """Jacobian (n, 6, 45) and residual (n, 6); weight and centre of mass are those of each pose."""
    n = len(wrench)
    C, d, bias = x[:36].reshape(6, 6), x[36:39], x[39:]
    by_d = weight_N[:, None, None] * np.swapaxes(R_base_flange @ R_flange_sensor, 1, 2)  # true force by direction
    by_d = np.concatenate([by_d, skew(p_sensor_com_m) @ by_d], axis=1)  # (n, 6, 3) true wrench by direction
    true = by_d @ d
    J = np.zeros((n, 6, 45))
    J[:, :, :36] = np.einsum("ij,nk->nijk", np.eye(6), true).reshape(n, 6, 36)
    J[:, :, 36:39] = C @ by_d
    J[:, :, 39:] = np.eye(6)
    return J, wrench - true @ C.T - bias


def _fit(linearised: Linearised, x: Array, unit: slice, cov: Array, advice: str) -> tuple[Array, Array, float]:
    """Gauss-Newton on parameters of which `unit` is a unit vector; returns parameters, covariance and chi2."""
    whiten = np.linalg.inv(np.linalg.cholesky(cov))
    for _ in range(MAX_STEPS):
        J, residual = linearised(x)
        e = (whiten @ residual[..., None]).ravel()
        tangent = np.linalg.svd(x[None, unit])[2][1:].T  # (3, 2) directions that keep the length
        N = np.delete(np.eye(len(x)), unit, axis=1)
        N = np.concatenate([N, np.zeros((len(x), 2))], axis=1)
        N[unit, -2:] = tangent
        JN = (whiten @ J).reshape(-1, len(x)) @ N
        scale = np.linalg.norm(JN, axis=0)
        scale[scale == 0] = 1.0
        eigenvalues, V = np.linalg.eigh(JN.T @ JN / np.outer(scale, scale))
        free = int((eigenvalues < RANK_TOLERANCE * eigenvalues[-1]).sum())
        if free:
            raise NotObservable(f"the poses do not determine {free} of {JN.shape[1]} parameters of the {advice}")
        root = V / np.sqrt(eigenvalues)  # of the inverse information
        projected = root.T @ (JN.T @ e / scale)
        x = x + N @ (root @ projected / scale)
        x[unit] = _unit(x[unit])
        moved = float(np.linalg.norm(projected))  # in standard deviations of the noise
        if moved <= CONVERGED:
            break
    if moved > 0.1:
        raise NotObservable(
            f"the fit did not converge in {MAX_STEPS} steps: start from a calibration of the same poses."
        )
    root = N @ (root / scale[:, None])
    residual = linearised(x)[1]
    chi2 = float(((whiten @ residual[..., None]) ** 2).sum())
    return x, root @ root.T, chi2


def _unit(v: Array) -> Array:
    length = float(np.linalg.norm(v))
    if length == 0:
        raise NotObservable("the calibration to start from has no weight: calibrate with something on the sensor.")
    return np.asarray(v / length)


def _require_weight(weight_N: float) -> None:
    if not (np.isfinite(weight_N) and weight_N > 0):
        raise BadDataset(f"a known weight is {weight_N} N, expected a positive number.")
