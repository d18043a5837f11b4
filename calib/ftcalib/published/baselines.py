"""Earlier methods that assume more: the mounting of the sensor, or all of it but a yaw, and the direction of gravity.

The papers are not freely available. The forms below rest on the description of these methods by Yu, Shi, Lou 2021
(introduction and section IV-B), for Vougioukas also on public programs that cite him. What such a method assumes is not
checked by it. With 20 N of weight and 24 poses in all directions, the rms error of a compensated force axis is

* 0.82 N for a sensor that is turned by 5 deg about flange z (Vougioukas, Wang),
* 0.33 N for one that is tilted by 2 deg (all three),
* 0.40 N for a base that is tilted by 2 deg (Vougioukas),

where maximum likelihood has 0.013 N from the same noise. All three take the force bias from the poses.
"""

import numpy as np
from scipy.spatial.transform import Rotation

from ftcalib.errors import NotObservable
from ftcalib.model import Array, Parameters, skew
from ftcalib.published.carlson import (
    ForceEquations,
    ForceFit,
    force_equations,
    require_turns_and_weight,
    require_weight,
    spanned_dimensions,
)


def vougioukas(
    R_base_flange: Array, wrench: Array, *, R_flange_sensor: Array, gravity_direction_base: Array
) -> Parameters:
    """Weight, centre of mass and biases by one linear least squares; mounting and direction of gravity are known.

    Source: S. Vougioukas, "Bias estimation and gravity compensation for force-torque sensors", 2001. With the unit
    vectors u_i of gravity in the sensor frame, `F_i = w u_i + F0` and `T_i = (w P) x u_i + T0` are 6n linear equations
    for the ten unknowns w, w P, F0 and T0.

    Parameters
    ----------
    R_base_flange : array, shape (n, 3, 3)
        Three poses or more, which tilt the tool about two axes.
    wrench : array, shape (n, 6)
        N and N·m, in the sensor frame.
    R_flange_sensor : array, shape (3, 3)
        Taken as exact.
    gravity_direction_base : array, shape (3,)
        Down, in base axes, of any length. Taken as exact.

    Raises
    ------
    NotObservable
        Fewer than three poses, gravity that changes along one flange axis only, or no weight.
    BadDataset
        A pose or force is not finite.
    """
    eq = force_equations(R_base_flange, wrench[:, :3], bias=True, method="vougioukas", min_poses=2)
    down = gravity_direction_base / np.linalg.norm(gravity_direction_base)
    u = down @ R_base_flange @ R_flange_sensor
    spanned = spanned_dimensions(u - u.mean(axis=0), len(u) ** 0.5)
    if spanned < 2:
        raise NotObservable(
            f"gravity changes along only {spanned} of the 2 flange axes needed: add poses that tilt the tool about "
            "another axis"
        )
    require_weight(eq)
    rows = np.zeros((len(u), 6, 10))
    rows[:, :3, 0] = u
    rows[:, 3:, 1:4] = -skew(u)
    rows[:, :, 4:] = np.eye(6)
    weight_N, *others = np.linalg.lstsq(rows.reshape(-1, 10), wrench.ravel())[0]
    moment_Nm, force_bias_N, torque_bias_Nm = np.array(others).reshape(3, 3)
    return Parameters(R_flange_sensor, weight_N * down, force_bias_N, moment_Nm / weight_N, torque_bias_Nm)


def wang(R_base_flange: Array, force_N: Array, *, R_flange_sensor: Array) -> ForceFit:
    """Weight, tilt of the base and force bias by linear least squares; the mounting is known.

    Source: N. Wang, J. Zhou, X. Zhang, "Research on the estimation of sensor bias and parameters of load based on
    force-feedback", 2018. `F_i = R A_i F_b + F0` is linear in F_b and F0. Centre of mass and torque bias follow from
    the torques, as in eqs 43-45 of Yu.

    Parameters
    ----------
    R_base_flange : array, shape (n, 3, 3)
        Three poses or more, turned about two base axes.
    force_N : array, shape (n, 3)
        In the sensor frame.
    R_flange_sensor : array, shape (3, 3)
        Taken as exact.

    Raises
    ------
    NotObservable
        Fewer than three poses, poses turned about one base axis only, or no weight.
    BadDataset
        A pose or force is not finite.
    """
    eq = _equations(R_base_flange, force_N, "wang")
    return eq.fit(R_flange_sensor, eq.gravity(R_flange_sensor))


def yang(R_base_flange: Array, force_N: Array, *, R_flange_sensor: Array) -> ForceFit:
    """Weight, tilt of the base, force bias and yaw of the sensor; the mounting is known but for that yaw.

    Source: X. Yang, F. Li, R. Gao, R. Song, Y. Li, "Force perception of industrial robot based on multi-parameter
    coupled model", 2019. Given the yaw about flange z, the problem is that of `wang`, so what is left is a quadratic
    form in its cosine and sine. Its stationary points are the roots of a quartic, which gives the minimum exactly.
    Centre of mass and torque bias follow from the torques, as in eqs 43-45 of Yu.

    Parameters
    ----------
    R_base_flange : array, shape (n, 3, 3)
        Three poses or more, turned about two base axes.
    force_N : array, shape (n, 3)
        In the sensor frame.
    R_flange_sensor : array, shape (3, 3)
        Mounting up to a turn about flange z: the result is Rz(yaw) times it.

    Raises
    ------
    NotObservable
        As of `wang`, or forces that leave the yaw open: they do not change across flange z, or a second yaw explains
        them nearly as well (costs less than 12 noise variances apart, estimated from the residuals).
    BadDataset
        A pose or force is not finite.
    """
    eq = _equations(R_base_flange, force_N, "yang")
    x, y, z = (eq.f @ R_flange_sensor.T).T
    zero = np.zeros_like(x)
    # Rz(yaw) (x, y, z) = cos (x, y, 0) + sin (-y, x, 0) + (0, 0, z), minus what gravity explains
    parts = np.stack([[x, y, zero], [-y, x, zero], [zero, zero, z]], axis=-1).transpose(1, 0, 2).reshape(-1, 3)
    Q_D = np.linalg.qr(eq.D)[0]
    parts -= Q_D @ (Q_D.T @ parts)
    yaw = _best_yaw(parts.T @ parts, float(np.sum(eq.f**2)), 3 * len(force_N) - 7)
    R = Rotation.from_rotvec([0.0, 0.0, yaw]).as_matrix() @ R_flange_sensor
    return eq.fit(R, eq.gravity(R))


def _equations(R_base_flange: Array, force_N: Array, method: str) -> ForceEquations:
    eq = force_equations(R_base_flange, force_N, bias=True, method=method, min_poses=2)
    require_turns_and_weight(eq)
    return eq


def _best_yaw(M: Array, size: float, dof: int) -> float:
    """Yaw that minimises v^T M v for v = (cos, sin, 1); `size` is the square of all forces."""

    def derivatives(yaw: float) -> tuple[float, float, float]:
        v = np.array([np.cos(yaw), np.sin(yaw), 1.0])
        turned = np.array([-v[1], v[0], 0.0])
        return float(v @ M @ v), float(turned @ M @ v), float(turned @ M @ turned - v[:2] @ (M @ v)[:2])

    second, first = (2 * M[0, 1] - 1j * (M[1, 1] - M[0, 0])) / 4, (M[1, 2] + 1j * M[0, 2]) / 2  # of exp(i yaw)
    stationary = np.angle(np.roots([second, first, 0, np.conj(first), np.conj(second)]))
    minima = list[tuple[float, float]]()
    for yaw in stationary.tolist():
        cost, slope, curvature = derivatives(yaw)
        if abs(slope) <= 1e-6 * size and curvature > 1e-9 * size:  # the angle of a root off the unit circle is none
            minima.append((cost, yaw - slope / curvature))
    if not minima:
        raise NotObservable("the forces leave the yaw of the sensor open: add poses that tilt the tool")
    (cost, best), *others = sorted(minima)
    if others and others[0][0] - cost <= max(12 * cost / max(dof, 1), 1e-12 * size):
        apart = np.degrees(abs(np.angle(np.exp(1j * (others[0][1] - best)))))
        raise NotObservable(
            f"two yaws of the sensor {apart:.0f} deg apart explain the forces about equally well: add poses, at least "
            "one with another angle between tool axis and gravity"
        )
    return best
