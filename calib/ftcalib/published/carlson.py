"""Carlson's methods, which use only forces: first those for an unknown gravity vector, then those for a known one.

F. Bagge Carlson, "On the Calibration of Force/Torque Sensors in Robotics", 2019, sections 2 (`relaxation` on) and 3.

In the paper's letters `A_i = R_TF^RB = R_base_flange[i].T`, `X = R_TF^S = R_flange_sensor`, `g = gravity_force_base_N`
(including the mass), so at every pose `X f_i = A_i g` (eq. 13), stacked `F vec(X) = D g` (eq. 17). vec stacks
columns: `vec(X) = R_flange_sensor.T.ravel()`. Without noise all methods find the same solution. With noise they do so
(section 4.2) only if the forces are distributed isotropically. Prefer `polynomial`, which is least squares.

The paper has no sensor bias. Every method has two forms:

* `bias=False` is the paper's model. A bias then causes an unreported error: with 20 N of weight, 24 random poses and
  0.05 N of noise, a bias of 0, 0.1, 1, 5 and 20 N makes the rotation wrong by 0.07, 0.10, 0.75, 3.7 and 10 to 20 deg
  (rms) and the gravity force by 0.1, 0.14, 1.0, 5 and 21 %, with little difference between the methods.
* `bias=True` estimates the bias too: `X f_i = A_i g + h` with `h = X f_0`. Subtracting the mean over the poses
  eliminates h exactly, so each method runs on `f_i - mean f` and `A_i - mean A`.
"""

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from ftcalib.errors import BadDataset, NotObservable
from ftcalib.likelihood import rotation_minima
from ftcalib.model import Array, angle_between, nearest_rotation, skew

MOST_ITERATIONS = 20_000


@dataclass(frozen=True, slots=True, eq=False)
class ForceFit:
    """Result of a method that uses forces only: mounting of the sensor, weight and force bias."""

    R_flange_sensor: Array
    """(3, 3) mounting of the sensor: maps sensor to flange coordinates."""
    gravity_force_base_N: Array
    """(3,) weight of the load on the sensor, in base axes."""
    force_bias_N: Array
    """(3,) force bias in sensor axes; zero in the form without bias."""


@dataclass(frozen=True, slots=True, eq=False)
class ForceEquations:
    """Equations `X f_i = A_i g` of all poses, centred in the form with bias."""

    A: Array
    """(n, 3, 3) orientations that map base to flange coordinates; in the form with bias minus `A_mean`."""
    f: Array
    """(n, 3) forces in sensor axes, N; in the form with bias minus `f_mean`."""
    A_mean: Array
    """(3, 3) mean of the orientations; zero in the form without bias."""
    f_mean: Array
    """(3,) mean of the forces, N; zero in the form without bias."""

    @property
    def D(self) -> Array:
        """(3n, 3) matrix D of Carlson's eq. 17: the stacked orientations."""
        return self.A.reshape(-1, 3)

    @property
    def F(self) -> Array:
        """(3n, 9) matrix F of eq. 17, with rows `f_i^T (x) I`."""
        return kron_identity(self.f)

    def gravity(self, R_flange_sensor: Array) -> Array:
        """Return the least-squares gravity force (3,), N, for a given mounting (eq. 20)."""
        return np.asarray(np.linalg.lstsq(self.D, (self.f @ R_flange_sensor.T).ravel())[0], dtype=np.float64)

    def fit(self, R_flange_sensor: Array, gravity_N: Array) -> ForceFit:
        """Return the fit with the bias that follows from the means."""
        return ForceFit(R_flange_sensor, gravity_N, self.f_mean - R_flange_sensor.T @ self.A_mean @ gravity_N)


def force_equations(R_base_flange: Array, force_N: Array, *, bias: bool, method: str, min_poses: int) -> ForceEquations:
    """Return the equations of a method after checking its input; estimating a `bias` needs one more pose.

    Raises `NotObservable` for fewer than `min_poses`, `BadDataset` for a non-finite value, `ValueError` for shapes.
    """
    n = len(force_N)
    if R_base_flange.shape != (n, 3, 3) or force_N.shape != (n, 3):
        raise ValueError(f"expected shapes (n, 3, 3) and (n, 3), got {R_base_flange.shape} and {force_N.shape}")
    finite = np.isfinite(force_N).all(axis=1) & np.isfinite(R_base_flange).all(axis=(1, 2))
    if not finite.all():
        raise BadDataset(f"the force or orientation in row {np.argmin(finite)} is not finite: leave that pose out")
    needed = min_poses + bias
    if n < needed:
        form = "with a force bias" if bias else "without bias"
        raise NotObservable(f"{method} {form} needs {needed} poses or more, got {n}: record {needed - n} more")
    A = R_base_flange.transpose(0, 2, 1)
    if not bias:
        return ForceEquations(A, force_N, np.zeros((3, 3)), np.zeros(3))
    A_mean, f_mean = A.mean(axis=0), force_N.mean(axis=0)
    return ForceEquations(A - A_mean, force_N - f_mean, A_mean, f_mean)


def eigen(R_base_flange: Array, force_N: Array, *, bias: bool) -> ForceFit:
    """Return the fit for unknown gravity by eigendecomposition (theorem 1).

    vec(X) is the eigenvector of `K = F^+ D D^+ F` with the largest eigenvalue, which is 1 without noise. That is the
    smallest principal angle between the ranges of F and D, the form computed here. It minimises `|F r - D g| / |F r|`.
    The noise in the denominator makes it inconsistent if the forces do not point equally in all directions: with 8
    orientations within 40 deg, each 2000 times at a signal-to-noise ratio of 10, R remains wrong by 3.5 deg, where
    `nullspace` has 0.3 deg. With random orientations instead (tool axis within 40 deg, any turn of the wrist) both
    errors fall: 1.7, 0.5 and 0.1 deg with 100, 1,000 and 16,000 poses. (With the bias as columns `[D, I]` instead of
    centring, a bias as large as the weight is in that denominator too, and R remains wrong by 30 deg.)

    Corrections: the eigenvector is that of the largest eigenvalue (appendix B takes the first, which Julia from 1.2 on
    sorts to be the least), with length sqrt(3) and positive determinant. That the eigenvalue 1 is single does not
    follow from full rank of F and D, as the theorem claims (all poses turned about one axis), so it is checked.

    Parameters
    ----------
    R_base_flange : array, shape (n, 3, 3)
    force_N : array, shape (n, 3)
        Sensor axes.
    bias : bool
        Whether to estimate the force bias, or to assume zero like the paper (see the module).

    Raises
    ------
    NotObservable
        Fewer than 4 poses (5 with bias), or poses that leave a family of solutions.
    """
    eq = _linear_equations(R_base_flange, force_N, bias=bias, method="the eigendecomposition")
    Q_F, R_F = np.linalg.qr(eq.F)
    Q_D = np.linalg.qr(eq.D)[0]
    principal = np.linalg.svd(Q_F.T @ Q_D)[0][:, 0]
    return _fit_vec(eq, np.linalg.solve(R_F, principal))


def nullspace(R_base_flange: Array, force_N: Array, *, bias: bool) -> ForceFit:
    """Return the fit for unknown gravity by the nullspace method (section 3.2) in O(n).

    The sum of squares over all pairwise differences is exactly n times `|(I - D D^+) F r|^2`, so the least singular
    vector of `(I - D D^+) F` is the published solution (eqs. 22-26) without its n^2 blocks. With bias it is the LROM of
    Yu et al. The estimate is consistent for isotropic noise.

    Parameters
    ----------
    R_base_flange, force_N, bias
        As in `eigen`.

    Raises
    ------
    NotObservable
        As in `eigen`.
    """
    eq = _linear_equations(R_base_flange, force_N, bias=bias, method="the nullspace method")
    return _fit_vec(eq, _least_singular_vector(eq.D, eq.F))


def iterative(R_base_flange: Array, force_N: Array, *, bias: bool) -> ForceFit:
    """Return the fit for unknown gravity by iterative linear least squares (section 3.4, algorithm 1).

    Alternates between the rotation of a given gravity, projected onto SO(3), and the gravity of a given rotation. The
    error shrinks in each step by the second eigenvalue of K: 0.04 for 100 random orientations, but without bias 0.78,
    0.90 and 0.98 for orientations within 60, 40 and 20 deg (about 0.5 with bias, thanks to the centring). So it runs
    until the rotation converges, instead of 6 times as in appendix B.

    Corrections: a matrix with negative determinant is negated before the projection. As printed, the
    limit is correct in only 39 % (start at R = I) or 52 % (random gravity) of cases with 100 random orientations;
    with the negation, in all. With few poses there are still false fixed points: from a random gravity, without
    noise, 37, 12, 3 and 0.3 % of cases with 5, 8, 12 and 24 random poses (and bias) converge to one of them. From the
    gravity of theorem 1, which is the start here, it is 1 % with 5 poses and none with more.

    Parameters
    ----------
    R_base_flange, force_N, bias
        As in `eigen`.

    Raises
    ------
    NotObservable
        As in `eigen`, or the rotation has not converged.
    """
    eq = _linear_equations(R_base_flange, force_N, bias=bias, method="the iterative method")
    rotation_of_gravity = np.linalg.lstsq(eq.F, eq.D)[0]
    gravity_of_rotation = np.linalg.lstsq(eq.D, eq.F)[0]
    eigenvalues, vectors = np.linalg.eig(gravity_of_rotation @ rotation_of_gravity)
    gravity = vectors[:, np.argmax(eigenvalues.real)].real
    X = np.zeros((3, 3))
    for _ in range(MOST_ITERATIONS):
        previous, X = X, _rotation_of_vec(rotation_of_gravity @ gravity)
        gravity = gravity_of_rotation @ X.T.ravel()
        if np.linalg.norm(X - previous) <= 1e-13:
            _require_single_null_vector(eq, gravity)
            return eq.fit(X, gravity)
    raise NotObservable(
        f"the iterative method has not converged in {MOST_ITERATIONS} steps: add poses turned about other axes"
    )


def polynomial(R_base_flange: Array, force_N: Array, *, bias: bool) -> ForceFit:
    """Return the fit for unknown gravity by polynomial optimisation (section 3.3, eq. 27).

    For a given rotation gravity and bias are linear, so eq. 27 is the minimum of a quadratic form in vec(X) over SO(3):
    the least-squares solution, which is the maximum likelihood solution for isotropic noise. The paper follows 2^18
    homotopy paths in 10 minutes. The form has only 40 complex critical rotations, and
    `ftcalib.likelihood.rotation_minima` finds all minima in milliseconds. (The residual in eq. 27 must be
    `R_TF^S f - A g`, or the number of paths is not that of the paper.)

    Parameters
    ----------
    R_base_flange, force_N, bias
        As in `eigen`.

    Raises
    ------
    NotObservable
        Fewer than 3 poses (4 with bias), poses that leave a family of solutions, or a second rotation that explains
        the forces nearly as well (costs less than 12 noise variances apart, estimated from the residuals).
    """
    eq = force_equations(R_base_flange, force_N, bias=bias, method="polynomial optimisation", min_poses=3)
    require_turns_and_weight(eq)
    Q = rotation_minima.force_cost(R_base_flange, force_N, np.ones(len(force_N)), with_bias=bias)
    best, *others = rotation_minima.minima(Q)
    X = best.R.T
    gravity = eq.gravity(X)
    _require_locally_unique(eq, gravity)
    degrees_of_freedom = 3 * len(force_N) - (9 if bias else 6)
    indistinguishable = max(12 * best.cost / degrees_of_freedom, 1e-12 * float(np.sum(eq.f**2)))
    if others and others[0].cost - best.cost <= indistinguishable:
        apart = np.degrees(angle_between(best.R, others[0].R))
        raise NotObservable(
            f"two sensor orientations {apart:.0f} deg apart explain the forces about equally well: add poses, at least "
            "one with another angle between tool axis and gravity"
        )
    return eq.fit(X, gravity)


def kron_identity(f: Array) -> Array:
    """Return the stack (3n, 9) of `f_i^T (x) I` for vectors (n, 3); its product with vec(X) is the stack of `X f_i`."""
    return np.asarray(np.einsum("nj,ik->nijk", f, np.eye(3)).reshape(-1, 9))


def _linear_equations(R_base_flange: Array, force_N: Array, *, bias: bool, method: str) -> ForceEquations:
    """Return the equations of a method that is linear in the nine entries of the rotation; raise for too few poses."""
    eq = force_equations(R_base_flange, force_N, bias=bias, method=method, min_poses=4)
    require_turns_and_weight(eq)
    _require_varied_forces(eq.f, 0)
    return eq


def _rotation_of_vec(r: Array) -> Array:
    """Return the rotation closest to a multiple of the matrix with columns r (9,) (theorem 1, eqs. 28-29)."""
    X = r.reshape(3, 3).T
    return nearest_rotation(X if np.linalg.det(X) > 0 else -X)


def _fit_vec(eq: ForceEquations, r: Array) -> ForceFit:
    X = _rotation_of_vec(r)
    gravity = eq.gravity(X)
    _require_single_null_vector(eq, gravity)
    return eq.fit(X, gravity)


def _complement(eliminated: Array, kept: Array) -> Array:
    """Return a small matrix with the Gram matrix of `kept` minus its projection on the columns of `eliminated`."""
    k = eliminated.shape[1]
    return np.linalg.qr(np.hstack([eliminated, kept])).R[k:, k:]


def _least_singular_vector(eliminated: Array, kept: Array) -> Array:
    return np.asarray(np.linalg.svd(_complement(eliminated, kept))[2][-1])


# --- observability ---
# The checks use the forces `A_i g` of the fitted gravity, because noise increases the singular values of measured
# forces, so degenerate pose sets would pass. One kind still passes: if all poses tilt the tool equally, noise in
# the fitted direction hides it. Only a comparison with the second solution, as in `polynomial`, detects this.


def spanned_dimensions(rows: Array, size: float) -> int:
    """Return the number of dimensions spanned by rows; `size` is their norm before centring, for rounding errors."""
    singular = np.linalg.svd(rows, compute_uv=False)
    return int(np.sum(singular > max(3e-5 * singular[0], 1e-9 * size)))


def require_weight(eq: ForceEquations) -> None:
    """Raise `NotObservable` for forces that are zero or, with a bias, constant."""
    if not spanned_dimensions(eq.f, float(np.linalg.norm(eq.f + eq.f_mean))):
        raise NotObservable("the forces show no weight: attach a tool or a mass to the sensor")


def require_turns_and_weight(eq: ForceEquations) -> None:
    """Raise `NotObservable` if all poses turn about one base axis, along which weight and bias cannot be separated.

    Also raises whatever `require_weight` raises.
    """
    if spanned_dimensions(eq.D, len(eq.A) ** 0.5) < 3:
        raise NotObservable(
            "all poses turn about one base axis, and a weight along it cannot be separated from a bias: add poses "
            "turned about another axis"
        )
    require_weight(eq)


def _require_varied_forces(f: Array, size: float) -> None:
    spanned = spanned_dimensions(f, size)
    if spanned < 3:
        raise NotObservable(
            f"the weight changes the force along only {spanned} of 3 sensor axes: add poses with another angle between "
            "tool axis and gravity"
        )


def _require_single_null_vector(eq: ForceEquations, gravity: Array) -> None:
    """Raise `NotObservable` unless the equations, relaxed to any matrix X, have a unique solution."""
    f = eq.A @ gravity
    size = len(f) ** 0.5 * float(np.linalg.norm(gravity))
    _require_varied_forces(f, size)
    missing = 8 - spanned_dimensions(_complement(eq.D, kron_identity(f)), size)
    if missing > 0:
        raise NotObservable(
            f"the poses leave {missing} unknowns of the linear equations undetermined: add poses turned about "
            "other axes"
        )


def _require_locally_unique(eq: ForceEquations, gravity: Array) -> None:
    """Raise `NotObservable` unless the Jacobian for rotation and gravity, scaled by 1 rad and weight, has full rank."""
    weight = float(np.linalg.norm(gravity))
    J = np.concatenate([skew(eq.A @ gravity), weight * eq.A], axis=2).reshape(-1, 6)
    missing = 6 - spanned_dimensions(J, len(eq.A) ** 0.5 * weight)
    if missing > 0:
        raise NotObservable(
            f"the poses leave {missing} of 6 unknowns of rotation and weight undetermined: "
            "add poses turned about another axis"
        )


# Carlson's methods for a known gravity vector (section 2), from forces alone.
#
# Letters and the two forms, without and with bias, are the same as above. A bias has the same effect on the form
# without bias (Cayley transform: 22 deg if the bias is as large as the weight).
#
# Gravity must be known exactly: with the base tilted by 2 deg more than assumed, the result is wrong without a warning.


def relaxation(R_base_flange: Array, force_N: Array, gravity_direction_base: Array, *, bias: bool) -> ForceFit:
    """Return weight and rotation by convex relaxation, for a known direction of gravity (eq. 3 and appendix A).

    The linear unknown is the matrix `X / weight`, nine free numbers, with `(X / weight) f_i = A_i d`. (Eq. 3 calls it
    mR; it is (1/m) R_TF^S, and R_TF^S is the inverse of the R_S^TF of eq. 1.) The noise of the regressor f shrinks it
    by a symmetric factor, which the projection on SO(3) removes; the weight is then the least-squares one given X.
    The estimate is consistent, but not efficient if the tool cannot be turned in all directions.

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
    eq, down = _equations_of_known_direction(
        R_base_flange, force_N, gravity_direction_base, 3, bias=bias, method="the relaxation"
    )
    a = eq.A @ down
    R_sensor_flange = nearest_rotation(np.asarray(np.linalg.lstsq(eq.f, a)[0], dtype=np.float64))
    return eq.fit(R_sensor_flange.T, _least_squares_factor(eq.f, a, R_sensor_flange) * down)


def cayley(
    R_base_flange: Array, force_N: Array, gravity_force_base_N: Array, *, bias: bool, as_published: bool = False
) -> ForceFit:
    """Return the rotation by the Cayley transform, for known direction of gravity and weight (eqs. 6-11).

    The transform fails for rotations by 180 deg and is poor near them, so it is applied after each of four turns of
    the flange axes (by 0, and by 180 deg about x, y and z) and the best fit is kept. An error of the weight affects the
    rotation: an error of 10 % leaves |dR|_F^2 at 1e-5 however small the noise is. `relaxation` needs no weight.

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
    eq, _ = _equations_of_known_direction(R_base_flange, force_N, gravity, 2, bias=bias, method="the Cayley transform")
    a = eq.A @ gravity
    turns = [np.diag(signs) for signs in ((1.0, 1.0, 1.0), (1.0, -1.0, -1.0), (-1.0, 1.0, -1.0), (-1.0, -1.0, 1.0))]
    candidates = [cayley_rotation(eq.f, a @ turn) @ turn for turn in turns[: 1 if as_published else 4]]
    R_sensor_flange = min(candidates, key=lambda R: float(np.sum((eq.f - a @ R.T) ** 2)))
    return eq.fit(R_sensor_flange.T, gravity)


def cayley_rotation(f: Array, a: Array) -> Array:
    """Return the rotation R with `f_i = R a_i` by one Cayley transform, as published (eqs. 7-11).

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
    """Return the centre of mass for known rotation and gravity force, without torque bias (eqs. 4-5).

    `R_TF^S tau_i = r x A_i g` is linear in r. (The matrix of eq. 5 is -<A_i g>, because `<a> b = -<b> a`, as in eq. 11;
    as printed it gives -r.) The paper's r is in the flange frame; the result is in the sensor frame.

    Parameters
    ----------
    R_base_flange : array, shape (n, 3, 3)
    torque_Nm : array, shape (n, 3)
        Sensor axes.

    Returns
    -------
    array, shape (3,)
    """
    weight_flange_N = fit.gravity_force_base_N @ R_base_flange
    torque_flange_Nm = torque_Nm @ fit.R_flange_sensor.T
    r = np.linalg.lstsq(-skew(weight_flange_N).reshape(-1, 3), torque_flange_Nm.ravel())[0]
    return np.asarray(r @ fit.R_flange_sensor, dtype=np.float64)


def _equations_of_known_direction(
    R_base_flange: Array, force_N: Array, gravity_base: Array, needed: int, *, bias: bool, method: str
) -> tuple[ForceEquations, Array]:
    """Return the equations of a method that needs `needed` poses and axes of gravity, and the unit vector of gravity.

    The spread is judged by the known directions, because noise of the forces would hide a degenerate pose set.
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


def _least_squares_factor(f: Array, a: Array, R_sensor_flange: Array) -> float:
    """Return the least-squares factor between R a_i and f_i."""
    return float(np.sum(f * (a @ R_sensor_flange.T)) / np.sum(a**2))


def _require_pull_downwards(f: Array, a: Array) -> None:
    """Raise `BadDataset` if a rotation explains the forces f (n, 3) much better with gravity -a than with a (n, 3)."""
    residual, reversed_residual = (
        float(np.sum((f - _least_squares_factor(f, side, R) * side @ R.T) ** 2))
        for side, R in ((a, nearest_rotation(f.T @ a)), (-a, nearest_rotation(-f.T @ a)))
    )
    if residual > 4 * reversed_residual + 1e-12 * float(np.sum(f**2)):
        raise BadDataset(
            "the forces point against the given gravity: check the sign of the sensor and the mounting of the base"
        )
