"""Descent to every minimum of the joint cost of forces and torques, and rejection of poses that do not belong to it.

The noise is independent from pose to pose.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import NDArray
from scipy.linalg.lapack import dposv
from scipy.special import chdtri as chi2_isf

from ftcalib.known import Constraints
from ftcalib.likelihood import rotation_minima
from ftcalib.likelihood.session_noise import CHUNK, Noise
from ftcalib.model import Array, Parameters, angle_between, skew

# Sufficient statistics: a cost that is quadratic in the sixty coefficients of the model, however many poses there are.
#
# The model is linear in `features`, phi = (R_base_flange row by row, 1): predicted wrench = Theta phi with
#
#     Theta = [[b^T (x) R, F0], [[P]x (b^T (x) R), T0]]    (6, 10),    R = R_flange_sensor.T, b = gravity_force_base_N
#
# so the weighted squares of a million poses are one 60 x 60 matrix, and a Gauss-Newton step costs the same for any
# number of them.

# Rows of 100 products per matrix product, so that they stay in the cache.
FEW = 256

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
    """Sum up all that the model needs to know of poses with common noise; sums of disjoint data add up.

    Of `reference` (6, 10) only the last column may differ from zero: an offset. Returns the sum (16, 16) of row.T @
    row with row = (wrench - offset, features).
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


MAX_STEPS = 100
# In standard deviations of the noise: a descent that ends with one is slow, not lost.
SMALL_STEP = 1e-4
MOST_MINIMA = 6
SAME_ROTATION_RAD = np.deg2rad(1.0)


@dataclass(frozen=True, slots=True, eq=False)
class Minimum:
    """One solution that fits better than all of its neighbours."""

    parameters: Parameters
    chi2: float
    """Under the noise model of the fit, on the same poses for all minima."""
    information: Array
    """(15, 15) Fisher information there, priors included."""
    settled: bool = True
    """Whether the descent came to rest."""


class Descent:
    """The ways down for one set of poses.

    Parameters
    ----------
    R_base_flange : array, shape (n, 3, 3)
    wrench : array, shape (n, 6)
    constraints : Constraints
    """

    def __init__(self, R_base_flange: Array, wrench: Array, constraints: Constraints) -> None:
        self.R, self.wrench, self.constraints = R_base_flange, wrench, constraints

    def minima(self, weights: Array) -> list[Minimum]:
        """Find all minima of the joint cost that lie below minima of the force cost, lowest first.

        Parameters
        ----------
        weights : array, shape (n, 6, 6) or (1, 6, 6)
            Inverse noise covariances.
        """
        n = len(self.wrench)
        reference = np.zeros((6, 10))
        common = len(weights) == 1 or weights.strides[0] == 0
        separate = _without_correlation(weights[:1] if common else weights)
        if common and n > CHUNK:
            # Sums about a mean keep the digits that a large bias would take.
            reference[:, 9] = self.wrench[:CHUNK].mean(axis=0)
            gram = wrench_gram(self.R, self.wrench, reference)
            rows = [0, 1, 2, *range(6, 16)]
            Q = rotation_minima.force_cost_from_gram(gram[np.ix_(rows, rows)])
            statistics, start_from = (Statistics.of_gram(gram, W[0], reference) for W in (weights, separate))
        else:
            weights, separate = (np.broadcast_to(W, (n, 6, 6)) for W in (weights, separate))
            Q = rotation_minima.force_cost(self.R, self.wrench[:, :3], separate[:, :3, :3])
            phi = features(self.R)
            reference[:, 9] = self.wrench.mean(axis=0)
            statistics, start_from = (Statistics.of(phi, self.wrench, W, reference) for W in (weights, separate))
        ends = []
        for R_flange_sensor in self.constraints.rotations([m.R.T for m in rotation_minima.minima(Q)[:MOST_MINIMA]], Q):
            start = self.constraints.satisfy(_linear_start(start_from, R_flange_sensor))
            ends.append(self.down(statistics, start))
        found = self.distinct(ends)
        if n <= CHUNK:  # once more from close by: without noise every digit counts
            statistics = Statistics.of(phi, self.wrench, weights, coefficients(found[0].parameters))
            found[0] = self.down(statistics, found[0].parameters)
        return found

    @staticmethod
    def distinct(ends: list[Minimum]) -> list[Minimum]:
        """Sort, and leave out those that ended in the same minimum."""
        found: list[Minimum] = []
        for end in sorted(ends, key=lambda end: end.chi2):
            if not any(Descent.same(end.parameters, other.parameters) for other in found):
                found.append(end)
        return found

    @staticmethod
    def same(p: Parameters, q: Parameters) -> bool:
        """Whether two points belong to one minimum."""
        return bool(angle_between(p.R_flange_sensor, q.R_flange_sensor) <= SAME_ROTATION_RAD)

    def normal_equations(self, statistics: Statistics, p: Parameters) -> tuple[Array, Array, float]:
        """Add what was known before."""
        H, g, cost = statistics.normal_equations(p)
        if self.constraints.any:
            A, residual = self.constraints.measurements(p)
            return H + A.T @ A, g + A.T @ residual, cost + float(residual @ residual)
        return H, g, cost

    def down(self, statistics: Statistics, p: Parameters, steps: int = MAX_STEPS) -> Minimum:
        """Levenberg-Marquardt with scaled columns."""
        H, g, cost = self.normal_equations(statistics, p)
        b, F0, T0 = p.gravity_force_base_N, p.force_bias_N, p.torque_bias_Nm
        prediction = np.concatenate([np.zeros(3), b, F0, np.zeros(3), T0])  # times the Jacobian is the predicted wrench
        rounding = 1e-14 * float(np.sqrt(max(prediction @ H @ prediction, 0.0)))
        damping, moved, settled = 0.0, np.inf, False
        for _ in range(steps):
            Z = self.constraints.free(p) if self.constraints.any else None
            Hz, gz = (H, g) if Z is None else (Z.T @ H @ Z, Z.T @ g)
            scale = column_scale(Hz)
            step = np.asarray(_solve(Hz / (scale[:, None] * scale), gz / scale, damping) / scale)
            moved = float(np.sqrt(max(float(step @ Hz @ step), 0.0)))  # in standard deviations of the noise
            trial = p.moved(step if Z is None else Z @ step)
            if Z is not None:
                trial = self.constraints.satisfy(trial)
            ahead = self.normal_equations(statistics, trial)
            improved = ahead[2] < cost
            if improved:
                p, (H, g, cost) = trial, ahead
                damping = damping / 10 if damping > 1e-6 else 0.0
            else:
                damping = max(10 * damping, 1e-3)
            small = 1e-8 * float(np.sqrt(max(cost, 0.0))) + rounding
            settled = moved <= (small if improved else 100 * small)
            if settled:
                break
        return Minimum(p, cost, H, settled or moved < SMALL_STEP)


def _solve(H: Array, g: Array, damping: float) -> Array:
    """Solve `(H + damping) x = g`; where the matrix lacks rank, the shortest such step."""
    _, x, failed = dposv(H + damping * np.eye(len(H)) if damping else H, g)
    if failed:
        eigenvalues, V = np.linalg.eigh(H)
        x = V @ (V.T @ g / np.maximum(eigenvalues + damping, 1e-14 * eigenvalues[-1]))
    return np.asarray(x)


def column_scale(information: Array) -> Array:
    """Root of the diagonal, 1 where it vanishes: dividing by it makes eigenvalues independent of units."""
    diagonal = np.sqrt(np.maximum(information.diagonal(), 0.0))
    return np.asarray(np.where(diagonal > 0, diagonal, 1.0))


def _without_correlation(weights: Array) -> Array:
    """Inverse covariances as they would be for forces alone and torques alone; poses without weight keep none."""
    if not weights[:, :3, 3:].any():
        return weights
    separate = np.zeros_like(weights)
    for own, other in ((slice(0, 3), slice(3, 6)), (slice(3, 6), slice(0, 3))):
        between, block = weights[:, own, other], weights[:, other, other]
        block = block + (np.trace(block, axis1=1, axis2=2) == 0)[:, None, None] * np.eye(3)
        separate[:, own, own] = weights[:, own, own] - between @ np.linalg.solve(block, np.swapaxes(between, 1, 2))
    return separate


def _linear_start(statistics: Statistics, R_flange_sensor: Array) -> Parameters:
    """For a fixed rotation: gravity force and force bias, then centre of mass and torque bias, each linear."""
    p = Parameters(R_flange_sensor, *np.zeros((4, 3)))
    for unknowns in (slice(3, 9), slice(9, 15)):
        H, g, _ = statistics.normal_equations(p)
        step = np.zeros(15)
        step[unknowns] = np.linalg.lstsq(H[unknowns, unknowns], g[unknowns], rcond=1e-12)[0]
        p = p.moved(step)
    return p


# Poses that belong to no rigid tool at rest: bumped, touched, or taken while something slipped.
#
# Graduated non-convexity with the Geman-McClure cost (Yang, Antonante, Tzoumas, Carlone 2020), from every minimum of
# the plain cost, then a plain fit of the poses that remain. The basin with the lowest truncated cost wins.

Kept = NDArray[np.bool_]

# Share of good poses that are rejected.
FALSE_REJECTION = 1e-3
# Squared distance, in noise, beyond which a pose is rejected: 22.5.
FARTHEST = float(chi2_isf(6, FALSE_REJECTION))
# With fewer poses, one that disagrees with the others and others that disagree with it look alike.
FEWEST_TO_REJECT_FROM = 8
ANNEALING = 1.6


def fewest_kept(n: int) -> int:
    """Give the number of poses that must agree with each other before the rest may be called wrong."""
    return n if n < FEWEST_TO_REJECT_FROM else max(FEWEST_TO_REJECT_FROM - 1, int(np.ceil(0.6 * n)))


def agreeing_poses(descent: Descent, weights: Array, starts: Sequence[Parameters]) -> tuple[Parameters, Kept] | None:
    """Find the largest set of poses that one calibration explains, from several starts.

    `weights` (n, 6, 6) are inverse noise covariances. Returns the parameters and which poses are kept (n,), or None
    for these when fewer than `fewest_kept` agree, from every start.
    """
    phi, wrench = features(descent.R), descent.wrench

    def squared_distances(p: Parameters) -> Array:
        e = wrench - phi @ coefficients(p).T
        return np.asarray(((weights @ e[..., None])[..., 0] * e).sum(axis=1))

    def down(w: Array, p: Parameters, steps: int) -> Parameters:
        statistics = Statistics.of(phi, wrench, w[:, None, None] * weights, coefficients(p))
        return descent.down(statistics, p, steps).parameters

    best: tuple[float, Parameters, Kept] | None = None
    for start in starts:
        p = start
        d2 = squared_distances(p)
        # So soft at first that the cost is convex; then poses that do not fit lose their weight.
        softness = max(1.0, 2 * float(d2.max()) / FARTHEST)
        while softness > 1:
            soft = softness * FARTHEST
            p = down((soft / (d2 + soft)) ** 2, p, 1)
            d2 = squared_distances(p)
            softness /= ANNEALING
        kept = d2 < FARTHEST
        for _ in range(10):
            if kept.sum() < fewest_kept(len(kept)):
                break
            p = down(kept.astype(np.float64), p, 5)
            d2 = squared_distances(p)
            before, kept = kept, d2 < FARTHEST
            if (before == kept).all():
                break
        cost = float(np.minimum(d2, FARTHEST).sum())
        if kept.sum() >= fewest_kept(len(kept)) and (best is None or cost < best[0]):
            best = cost, p, kept
    return best and best[1:]
