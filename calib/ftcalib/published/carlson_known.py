"""Carlson's methods for a known gravity vector, from forces alone.

F. Bagge Carlson, "On the Calibration of Force/Torque Sensors in Robotics", 2019, section 2. Letters and the two forms,
without and with a bias, are those of `ftcalib.published.carlson`. A bias has the same effect on the form without bias
(Cayley transform: 22 deg if the bias is as large as the weight).

"Known" means exact: if the base is tilted by 2 deg more than assumed, the result is wrong without any sign of it.
"""

import numpy as np
from scipy.spatial.transform import Rotation

from ftcalib.errors import BadDataset, NotObservable
from ftcalib.model import Array, nearest_rotation, skew
from ftcalib.published.carlson import ForceEquations, ForceFit, force_equations, require_weight, spanned_dimensions


def relaxation(R_base_flange: Array, force_N: Array, gravity_direction_base: Array, *, bias: bool) -> ForceFit:
    """Weight and rotation by convex relaxation, gravity known in direction (eq. 3 and appendix A).

    The linear unknown is the matrix `X / weight`, nine free numbers, with `(X / weight) f_i = A_i d`. (Eq. 3 calls it
    mR; it is (1/m) R_TF^S, and R_TF^S is the inverse of the R_S^TF of eq. 1.) The noise of the regressor f shrinks it
    by a symmetric factor, which the projection on SO(3) removes; the weight is then the least-squares one given X.
    Consistent, but not efficient if the tool cannot be turned in all directions.

    Parameters
    ----------
    R_base_flange : array, shape (n, 3, 3)
    force_N : array, shape (n, 3)
        Sensor axes.
    gravity_direction_base : array, shape (3,)
        Down, in base axes, of any length.
    bias : bool
        Whether to estimate the force bias, or to assume zero like the paper (see the module).

    Raises
    ------
    NotObservable
        Fewer than 3 poses (4 with bias), or gravity that does not change along all three flange axes.
    BadDataset
        The forces point against the given gravity.
    """
    eq, down = _equations(R_base_flange, force_N, gravity_direction_base, 3, bias=bias, method="the relaxation")
    a = eq.A @ down
    R_sensor_flange = nearest_rotation(np.asarray(np.linalg.lstsq(eq.f, a)[0], dtype=np.float64))
    return eq.fit(R_sensor_flange.T, _weight(eq.f, a, R_sensor_flange) * down)


def cayley(
    R_base_flange: Array, force_N: Array, gravity_force_base_N: Array, *, bias: bool, as_published: bool = False
) -> ForceFit:
    """Rotation by the Cayley transform, gravity known with the weight (eqs. 6-11).

    The transform fails for rotations by 180 deg and is poor near them, so it is applied after each of four turns of
    the flange axes (by 0, and by 180 deg about x, y and z) and the best fit is kept. An error of the weight goes into
    the rotation: 10 % leave |dR|_F^2 at 1e-5 however small the noise. `relaxation` needs no weight.

    Parameters
    ----------
    R_base_flange : array, shape (n, 3, 3)
    force_N : array, shape (n, 3)
        Sensor axes.
    gravity_force_base_N : array, shape (3,)
        Weight of the load on the sensor, in base axes; returned unchanged.
    bias : bool
        Whether to estimate the force bias, or to assume zero like the paper (see the module).
    as_published : bool
        Whether to apply the transform once, without turns.

    Raises
    ------
    NotObservable
        Fewer than 2 poses (3 with bias), or gravity that changes along one flange axis only.
    BadDataset
        The forces point against the given gravity.
    """
    gravity = np.array(gravity_force_base_N, dtype=np.float64)
    eq, _ = _equations(R_base_flange, force_N, gravity, 2, bias=bias, method="the Cayley transform")
    a = eq.A @ gravity
    turns = [np.diag(signs) for signs in ((1.0, 1.0, 1.0), (1.0, -1.0, -1.0), (-1.0, 1.0, -1.0), (-1.0, -1.0, 1.0))]
    candidates = [cayley_rotation(eq.f, a @ turn) @ turn for turn in turns[: 1 if as_published else 4]]
    R_sensor_flange = min(candidates, key=lambda R: float(np.sum((eq.f - a @ R.T) ** 2)))
    return eq.fit(R_sensor_flange.T, gravity)


def cayley_rotation(f: Array, a: Array) -> Array:
    """Rotation R with `f_i = R a_i` by one Cayley transform, as published (eqs. 7-11).

    `R = (I + <s>)^-1 (I - <s>)` makes the problem linear in s: `<f_i + a_i> s = f_i - a_i`. (Eq. 11 has the opposite
    right-hand side because `<a> b = <b> a` lacks a sign; as printed it gives the transpose.) The noise of f is in the
    regressor too, hence total least squares: the least singular vector of `[<f + a>, a - f]` is (s, 1) times a factor.
    Either way (-s, 1) is the quaternion of R, scalar last, up to its length.

    Parameters
    ----------
    f, a : array, shape (n, 3)
        With a bias, both minus their means.

    Returns
    -------
    array, shape (3, 3)
    """
    regressor = skew(f + a).reshape(-1, 3)
    s = np.linalg.svd(np.column_stack([regressor, (a - f).ravel()]), full_matrices=False)[2][-1]
    return Rotation.from_quat([*-s[:3], s[3]]).as_matrix()


def centre_of_mass(R_base_flange: Array, torque_Nm: Array, fit: ForceFit) -> Array:
    """Centre of mass of a known rotation and gravity force, without torque bias (eqs. 4-5).

    `R_TF^S tau_i = r x A_i g` is linear in r. (The matrix of eq. 5 is -<A_i g>, because `<a> b = -<b> a`, as in eq. 11;
    as printed it gives -r.) The paper's r is in the flange frame; the result is in the sensor frame.

    Parameters
    ----------
    R_base_flange : array, shape (n, 3, 3)
    torque_Nm : array, shape (n, 3)
        Sensor axes.
    fit : ForceFit

    Returns
    -------
    array, shape (3,)
    """
    weight_flange_N = fit.gravity_force_base_N @ R_base_flange
    torque_flange_Nm = torque_Nm @ fit.R_flange_sensor.T
    r = np.linalg.lstsq(-skew(weight_flange_N).reshape(-1, 3), torque_flange_Nm.ravel())[0]
    return np.asarray(r @ fit.R_flange_sensor, dtype=np.float64)


def _equations(
    R_base_flange: Array, force_N: Array, gravity_base: Array, needed: int, *, bias: bool, method: str
) -> tuple[ForceEquations, Array]:
    """Form the equations of a method that needs as many poses and gravity axes; also the unit vector (3,) of gravity.

    The spread is judged on the known directions, because noise of the forces would hide a degenerate pose set.
    """
    length = np.linalg.norm(gravity_base)
    if not length > 0:
        raise ValueError(f"a gravity direction must have a length, got {gravity_base}")
    down = np.asarray(gravity_base / length)
    eq = force_equations(R_base_flange, force_N, bias=bias, method=method, min_poses=needed)
    spanned = spanned_dimensions(eq.A @ down, len(eq.A) ** 0.5)
    if spanned < needed:
        raise NotObservable(
            f"gravity changes along only {spanned} of the {needed} flange axes needed: add poses that tilt the tool "
            "about another axis"
        )
    require_weight(eq)
    _require_pull_downwards(eq.f, eq.A @ down)
    return eq, down


def _weight(f: Array, a: Array, R_sensor_flange: Array) -> float:
    """Least-squares factor from R a_i to f_i."""
    return float(np.sum(f * (a @ R_sensor_flange.T)) / np.sum(a**2))


def _require_pull_downwards(f: Array, a: Array) -> None:
    """Reject forces f (n, 3) that a rotation explains much better with gravity -a than with a (n, 3)."""
    residual, reversed_residual = (
        float(np.sum((f - _weight(f, side, R) * side @ R.T) ** 2))
        for side, R in ((a, nearest_rotation(f.T @ a)), (-a, nearest_rotation(-f.T @ a)))
    )
    if residual > 4 * reversed_residual + 1e-12 * float(np.sum(f**2)):
        raise BadDataset(
            "the forces point against the given gravity: check the sign of the sensor and the mounting of the base"
        )
