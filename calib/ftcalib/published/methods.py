"""Published methods by name, with a common interface: from the wrenches of the poses to the parameters."""

from collections.abc import Callable, Mapping
from functools import partial

import numpy as np
from scipy.spatial.transform import Rotation

from ftcalib.errors import NotObservable
from ftcalib.likelihood.rotation_minima import com_and_torque_bias
from ftcalib.model import Array, Parameters, skew
from ftcalib.published import carlson
from ftcalib.published.carlson import (
    ForceEquations,
    ForceFit,
    force_equations,
    require_turns_and_weight,
    require_weight,
    spanned_dimensions,
)
from ftcalib.published.yu import lrom, mixed, special_numbers, srom

# Earlier methods that assume more: the mounting of the sensor, possibly up to a yaw, and the direction of gravity.
#
# The papers are not freely available. The implementations follow the description of these methods by Yu, Shi, Lou 2021
# (introduction and section IV-B), for Vougioukas also public programs that cite him. These methods do not check their
# assumptions. With 20 N of weight and 24 poses in all directions, the rms error of a compensated force axis is
#
# * 0.82 N for a sensor that is turned by 5 deg about flange z (Vougioukas, Wang),
# * 0.33 N for one that is tilted by 2 deg (all three),
# * 0.40 N for a base that is tilted by 2 deg (Vougioukas),
#
# compared with 0.013 N for maximum likelihood with the same noise. All three estimate the force bias from the poses.


def vougioukas(
    R_base_flange: Array, wrench: Array, *, R_flange_sensor: Array, gravity_direction_base: Array
) -> Parameters:
    """Return weight, centre of mass and biases by linear least squares, for known mounting and direction of gravity.

    Source: S. Vougioukas, "Bias estimation and gravity compensation for force-torque sensors", 2001. With the unit
    vectors u_i of gravity in the sensor frame, `F_i = w u_i + F0` and `T_i = (w P) x u_i + T0` are linear equations.

    Parameters
    ----------
    R_base_flange : array, shape (n, 3, 3)
        Three or more poses that tilt the tool about two axes.
    wrench : array, shape (n, 6)
        N and N·m, in the sensor frame.
    R_flange_sensor : array, shape (3, 3)
        Mounting, taken as exact.
    gravity_direction_base : array, shape (3,)
        Direction of gravity in base axes, of any length, taken as exact.

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
    """Return weight, tilt of the base and force bias by linear least squares, for a known mounting.

    Source: N. Wang, J. Zhou, X. Zhang, "Research on the estimation of sensor bias and parameters of load based on
    force-feedback", 2018. `F_i = R A_i F_b + F0` is linear in F_b and F0. The torques give the rest, eqs 43-45 of Yu.

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
    """Return weight, tilt of the base, force bias and yaw of the sensor, for a mounting known up to the yaw.

    Source: X. Yang, F. Li, R. Gao, R. Song, Y. Li, "Force perception of industrial robot based on multi-parameter
    coupled model", 2019. Given the yaw about flange z, the problem is that of `wang`, so the cost is a quadratic form
    in cosine and sine of the yaw. Its stationary points are the roots of a quartic, which gives the minimum exactly.
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
        As for `wang`, or forces that do not determine the yaw: they do not change perpendicular to flange z, or a
        second yaw explains them almost as well (difference of costs below 12 noise variances, from the residuals).
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
    """Return the yaw that minimises v^T M v for v = (cos, sin, 1); `size` is the sum of the squared forces."""

    def derivatives(yaw: float) -> tuple[float, float, float]:
        v = np.array([np.cos(yaw), np.sin(yaw), 1.0])
        turned = np.array([-v[1], v[0], 0.0])
        return float(v @ M @ v), float(turned @ M @ v), float(turned @ M @ turned - v[:2] @ (M @ v)[:2])

    second, first = (2 * M[0, 1] - 1j * (M[1, 1] - M[0, 0])) / 4, (M[1, 2] + 1j * M[0, 2]) / 2  # of exp(i yaw)
    stationary = np.angle(np.roots([second, first, 0, np.conj(first), np.conj(second)]))
    minima = list[tuple[float, float]]()
    for yaw in stationary.tolist():
        cost, slope, curvature = derivatives(yaw)
        if abs(slope) <= 1e-6 * size and curvature > 1e-9 * size:  # only roots on the unit circle are angles
            minima.append((cost, yaw - slope / curvature))
    if not minima:
        raise NotObservable("the forces do not determine the yaw of the sensor: add poses that tilt the tool")
    (cost, best), *others = sorted(minima)
    if others and others[0][0] - cost <= max(12 * cost / max(dof, 1), 1e-12 * size):
        apart = np.degrees(abs(np.angle(np.exp(1j * (others[0][1] - best)))))
        raise NotObservable(
            f"two yaws of the sensor {apart:.0f} deg apart explain the forces about equally well: add poses, at least "
            "one with another angle between tool axis and gravity"
        )
    return best


# Function from the mean wrenches (n, 6) of fixed poses to the parameters.
Estimator = Callable[[Array], Parameters]

_GRAVITY_UNKNOWN: Mapping[str, Callable[..., ForceFit]] = {
    "carlson-eigen": carlson.eigen,
    "carlson-nullspace": carlson.nullspace,
    "carlson-iterative": carlson.iterative,
    "carlson-polynomial": carlson.polynomial,
}

CARLSON = ("carlson-relaxation", "carlson-cayley", *_GRAVITY_UNKNOWN)
# Published methods that compute the gravity force from Yu's 24 special orientations.
SPECIAL = ("srom", "mixed")
BASELINES = ("vougioukas", "wang", "yang")
PUBLISHED = (*SPECIAL, "lrom", *CARLSON, *BASELINES)


def published(
    method: str,
    R_base_flange: Array,
    *,
    gravity_direction_base: Array,
    weight_N: float | None = None,
    R_flange_sensor: Array | None = None,
    as_published: bool = False,
) -> Estimator:
    """Return the estimator of a published method for a set of poses.

    The methods of Yu and Vougioukas are complete. Those of Wang and Yang use Yu's torque step (eqs 43-45). Carlson's
    methods run in their form with bias and the same torque step, or as published without bias.

    Parameters
    ----------
    method : str
        One of `PUBLISHED`.
    R_base_flange : array, shape (n, 3, 3)
    gravity_direction_base : array, shape (3,)
        For carlson-relaxation, carlson-cayley and vougioukas.
    weight_N : float, optional
        For carlson-cayley.
    R_flange_sensor : array, shape (3, 3), optional
        Known mounting for vougioukas, wang and, up to a turn about flange z, yang. Default: the identity.
    as_published : bool
        Run one of `CARLSON` as printed: without biases, the centre of mass from his eqs 4-5, one Cayley transform.

    Raises
    ------
    NotObservable
        The method needs other poses, or a weight.
    ValueError
        `as_published` for a method that has only one form.
    """
    if as_published:
        require_printed_form(method)
    mounting = np.eye(3) if R_flange_sensor is None else R_flange_sensor
    if method == "srom":
        return partial(srom, R_base_flange, numbered=special_numbers(R_base_flange))
    if method == "mixed":
        return partial(mixed, R_base_flange, numbered=special_numbers(R_base_flange, others=True))
    if method == "lrom":
        return partial(lrom, R_base_flange)
    if method == "vougioukas":
        known = {"R_flange_sensor": mounting, "gravity_direction_base": gravity_direction_base}
        return partial(vougioukas, R_base_flange, **known)
    if method in ("wang", "yang"):
        return _with_torques(partial(wang if method == "wang" else yang, R_flange_sensor=mounting), R_base_flange)
    forces = partial(_carlson(method, gravity_direction_base, weight_N, as_published), bias=not as_published)
    return _with_torques(forces, R_base_flange, as_published=as_published)


def _carlson(
    method: str, gravity_direction_base: Array, weight_N: float | None, as_published: bool
) -> Callable[..., ForceFit]:
    if method == "carlson-relaxation":
        return partial(carlson.relaxation, gravity_direction_base=gravity_direction_base)
    if method != "carlson-cayley":
        return _GRAVITY_UNKNOWN[method]
    if weight_N is None:
        raise NotObservable("the method needs the weight, which is unknown: give the mass on the sensor (--mass-kg).")
    gravity_N = weight_N * gravity_direction_base / np.linalg.norm(gravity_direction_base)
    return partial(carlson.cayley, gravity_force_base_N=gravity_N, as_published=as_published)


def require_printed_form(method: str) -> None:
    """Raise `ValueError` unless a method has a separate printed form, which only Carlson's methods have."""
    if method in CARLSON:
        return
    reason = "runs as published already" if method in PUBLISHED else "is not a published method"
    raise ValueError(f"{method} {reason}: use as_published with one of {', '.join(CARLSON)}")


def _with_torques(forces: Callable[..., ForceFit], R_base_flange: Array, *, as_published: bool = False) -> Estimator:
    def estimate(wrench: Array) -> Parameters:
        fit = forces(R_base_flange, wrench[:, :3])
        if as_published:
            com_m, torque_bias_Nm = carlson.centre_of_mass(R_base_flange, wrench[:, 3:], fit), np.zeros(3)
        else:
            com_m, torque_bias_Nm = com_and_torque_bias(wrench[:, :3] - fit.force_bias_N, wrench[:, 3:])
        return Parameters(fit.R_flange_sensor, fit.gravity_force_base_N, fit.force_bias_N, com_m, torque_bias_Nm)

    return estimate
