"""Maximum likelihood: joint weighted least squares of forces and torques over SO(3) x R^12."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from calib.errors import NotObservable
from calib.model import Array, Parameters, jacobian, predict, skew
from calib.yu import SPECIAL_R_flange_base, com_and_torque_bias, reduced_equations

MAX_STEPS = 100
MOST_STARTS = 6
SAME_ROTATION_RAD = np.deg2rad(1.0)
LEVER_M = 0.025  # usual ratio of torque noise to force noise
LEVER_BOUNDS_M = (1e-3, 1.0)  # what any sensor has
FEW_POSES = 6  # fewer cannot tell force noise from torque noise: the usual ratio is taken


@dataclass(frozen=True, slots=True, eq=False)
class Fit:
    """The lowest minimum found."""

    parameters: Parameters
    information: Array
    """(15, 15) Fisher information of the error coordinates; its inverse is their covariance."""
    chi2: float
    wrench_cov: Array
    """(n, 6, 6) the noise the fit was weighted with."""
    second_chi2: float
    """chi2 of the best other minimum, with R_flange_sensor more than 1° away; infinite when there is none."""


def refine(R_base_flange: Array, wrench: Array, wrench_cov: Array | None, starts: Sequence[Parameters] = ()) -> Fit:
    """Fit all 15 parameters, from the given starts and from every minimum of the force equations.

    Without a covariance one standard deviation for all forces and one for all torques are estimated from the
    residuals by restricted maximum likelihood: sum of squares divided by the residual degrees of freedom of each
    group; from fewer than six poses a single one for both.

    Parameters
    ----------
    R_base_flange : array, shape (n, 3, 3)
    wrench : array, shape (n, 6)
        N and N·m, in the sensor frame.
    wrench_cov : array, shape (n, 6, 6), or None
    starts : sequence of Parameters

    Raises
    ------
    NotObservable
        The lowest point reached is not a minimum.
    """
    starts = [*starts, *force_only_minima(R_base_flange, wrench)]
    if wrench_cov is not None:
        return _lowest(R_base_flange, wrench, wrench_cov, starts)
    n = len(wrench)
    sigma = 1.0, LEVER_M
    for _ in range(50):
        fit = _lowest(R_base_flange, wrench, np.tile(_white(*sigma), (n, 1, 1)), starts)
        before, sigma = sigma, _residual_sigma(fit, R_base_flange, wrench)
        if np.allclose(before, sigma, rtol=1e-3, atol=0):
            break
        starts = [fit.parameters, *starts]
    return fit


def _white(sigma_N: float, sigma_Nm: float) -> Array:
    return np.diag(np.repeat([sigma_N**2, sigma_Nm**2], 3))


def _residual_sigma(fit: Fit, R_base_flange: Array, wrench: Array) -> tuple[float, float]:
    """One step of restricted maximum likelihood for the noise of forces and torques."""
    n = len(wrench)
    residuals = wrench - predict(fit.parameters, R_base_flange)
    force, torque = (residuals[:, :3] ** 2).sum(), (residuals[:, 3:] ** 2).sum()
    least_N = 1e-12 * float(np.abs(wrench[:, :3]).max())  # of exact data
    if n < FEW_POSES:
        sigma_N = max(float(np.sqrt((force + torque / LEVER_M**2) / (6 * n - 15))), least_N)
        return sigma_N, LEVER_M * sigma_N
    J = jacobian(fit.parameters, R_base_flange)
    explained = J @ np.linalg.pinv(fit.information, hermitian=True) @ np.swapaxes(J, 1, 2)
    leverage = np.diagonal(explained, axis1=1, axis2=2).sum(axis=0) / np.diag(fit.wrench_cov[0])
    sigma_N = max(float(np.sqrt(force / (3 * n - leverage[:3].sum()))), least_N)
    sigma_Nm = float(np.sqrt(torque / (3 * n - leverage[3:].sum())))
    return sigma_N, float(np.clip(sigma_Nm, LEVER_BOUNDS_M[0] * sigma_N, LEVER_BOUNDS_M[1] * sigma_N))


def force_only_minima(R_base_flange: Array, wrench: Array) -> list[Parameters]:
    """Local minima of the force residual over SO(3), lowest first, with the other parameters that follow from each.

    For a fixed rotation F_b and F0 are linear, so the force equations alone are |H vec(R^T)|² over SO(3)
    (H of `reduced_equations`). Levenberg-Marquardt from the 24 rotations of the cube at once finds its few minima.

    Parameters
    ----------
    R_base_flange : array, shape (n, 3, 3)
    wrench : array, shape (n, 6)

    Returns
    -------
    list of Parameters, at most six
    """
    A = np.swapaxes(R_base_flange, 1, 2)
    H, x6_of_x9 = reduced_equations(A, wrench[:, :3])
    Rt = SPECIAL_R_flange_base
    residual = Rt.reshape(24, 9) @ H.T
    damping = np.full(24, 1e-3)
    for _ in range(30):
        turns = -skew(np.eye(3))[None] @ Rt[:, None]  # R exp([delta]x) transposed, derivative by delta
        J = turns.reshape(24, 3, 9) @ H.T
        JJ = J @ np.swapaxes(J, 1, 2)
        regular = JJ + ((damping + 1e-12) * (np.trace(JJ, axis1=1, axis2=2) + 1e-300))[:, None, None] * np.eye(3)
        delta = -np.linalg.solve(regular, np.einsum("kim,km->ki", J, residual)[..., None])[..., 0]
        trial = Rotation.from_rotvec(-delta).as_matrix() @ Rt
        trial_residual = trial.reshape(24, 9) @ H.T
        better = (trial_residual**2).sum(axis=1) < (residual**2).sum(axis=1)
        Rt = np.where(better[:, None, None], trial, Rt)
        residual = np.where(better[:, None], trial_residual, residual)
        damping = np.where(better, damping / 10, damping * 10)

    minima: list[Parameters] = []
    for i in np.argsort((residual**2).sum(axis=1)):
        if any(_angle(Rt[i], other.R_flange_sensor) < SAME_ROTATION_RAD for other in minima):
            continue
        x6 = x6_of_x9 @ Rt[i].ravel()
        p_sensor_com_m, torque_bias_Nm = com_and_torque_bias(A @ x6[:3] @ Rt[i], wrench[:, 3:])
        minima.append(Parameters(Rt[i], x6[:3], x6[3:] @ Rt[i], p_sensor_com_m, torque_bias_Nm))
        if len(minima) == MOST_STARTS:
            break
    return minima


def _angle(R1: Array, R2: Array) -> float:
    return float(Rotation.from_matrix(R1 @ R2.T).magnitude())


def _lowest(R_base_flange: Array, wrench: Array, wrench_cov: Array, starts: Sequence[Parameters]) -> Fit:
    whiten = np.linalg.inv(np.linalg.cholesky(wrench_cov))
    found = [_descend(R_base_flange, wrench, whiten, start) for start in starts]
    parameters, information, chi2, settled = min(found, key=lambda end: end[2])
    if not settled:
        weight_N = np.linalg.norm(parameters.gravity_force_base_N)
        raise NotObservable(
            f"the fit has not settled in {MAX_STEPS} steps, at a weight of {weight_N:.2g} N: "
            "hang something heavier on the sensor, or add poses with other orientations."
        )
    others = (c for p, _, c, _ in found if _angle(p.R_flange_sensor, parameters.R_flange_sensor) > SAME_ROTATION_RAD)
    return Fit(parameters, information, chi2, wrench_cov, min(others, default=float("inf")))


def _descend(
    R_base_flange: Array, wrench: Array, whiten: Array, parameters: Parameters
) -> tuple[Parameters, Array, float, bool]:
    """Levenberg-Marquardt with scaled columns; gives parameters, information, chi2 and whether it came to rest."""

    def residual(p: Parameters) -> Array:
        return np.asarray((whiten @ (wrench - predict(p, R_base_flange))[..., None]).ravel())

    def weighted_jacobian(p: Parameters) -> Array:
        return np.asarray((whiten @ jacobian(p, R_base_flange)).reshape(-1, 15))

    rounding = 1e-14 * float(np.linalg.norm(whiten @ wrench[..., None]))
    damping, settled = 0.0, False
    e = residual(parameters)
    for _ in range(MAX_STEPS):
        J = weighted_jacobian(parameters)
        information = J.T @ J
        scale = column_scale(information)
        eigenvalues, V = np.linalg.eigh(information / np.outer(scale, scale))
        step = V @ (V.T @ (J.T @ e / scale) / np.maximum(eigenvalues + damping, 1e-14 * eigenvalues[-1])) / scale
        trial = parameters.moved(step)
        e_trial = residual(trial)
        improved = e_trial @ e_trial < e @ e
        if improved:
            parameters, e, damping = trial, e_trial, damping / 10 if damping > 1e-6 else 0.0
        else:
            damping = max(10 * damping, 1e-3)
        moved = float(np.linalg.norm(J @ step))  # in standard deviations of the noise
        small = 1e-8 * float(np.linalg.norm(e)) + rounding
        settled = moved <= (small if improved else 100 * small)
        if settled:
            break
    J = weighted_jacobian(parameters)
    return parameters, J.T @ J, float(e @ e), settled


def column_scale(information: Array) -> Array:
    """Root of the diagonal, 1 where it vanishes: dividing by it makes eigenvalues independent of units."""
    diagonal = np.sqrt(np.diag(information))
    return np.asarray(np.where(diagonal > 0, diagonal, 1.0))
