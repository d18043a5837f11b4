"""Descent to every minimum of the joint cost of forces and torques, and rejection of outlier poses.

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

# Sufficient statistics: the cost is quadratic in the sixty coefficients of the model, for any number of poses.
#
# The model is linear in `features`, phi = (R_base_flange row by row, 1): predicted wrench = Theta phi with
#
#     Theta = [[b^T (x) R, F0], [[P]x (b^T (x) R), T0]]    (6, 10),    R = R_flange_sensor.T, b = gravity_force_base_N
#
# so the weighted squares of a million poses are one 60 x 60 matrix, and a Gauss-Newton step takes the same time.

# Number of poses per matrix product, so that their products stay in the cache.
FEW = 256

_CROSS = skew(np.eye(3))
_CONSTANT = np.zeros((15, 6, 10))
_CONSTANT[range(6, 9), range(3), 9] = _CONSTANT[range(12, 15), range(3, 6), 9] = 1.0


def features(R_base_flange: Array) -> Array:
    """Return the features phi (n, 10) of the linear model."""
    return np.concatenate([R_base_flange.reshape(-1, 9), np.ones((len(R_base_flange), 1))], axis=1)


def coefficients(p: Parameters) -> Array:
    """Return the coefficients Theta (6, 10) of the linear model."""
    Theta = np.empty((6, 10))
    Theta[:3, :9] = _kron(p.gravity_force_base_N, p.R_flange_sensor.T)
    Theta[3:, :9] = skew(p.p_sensor_com_m) @ Theta[:3, :9]
    Theta[:3, 9], Theta[3:, 9] = p.force_bias_N, p.torque_bias_Nm
    return Theta


def coefficients_derivative(p: Parameters) -> Array:
    """Return the derivative (15, 6, 10) of Theta with respect to the error vector of `Parameters.moved`."""
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
    """Weighted sum of squared residuals as a function of Theta = reference + D: `square - 2 B.D + D.A.D`."""

    reference: Array
    """(6, 10) value of Theta close to the solution, so that no digits are lost."""
    A: Array
    """(60, 60) quadratic coefficients of the cost in D."""
    B: Array
    """(60,) linear coefficients of the cost in D."""
    square: float

    @classmethod
    def of(cls, phi: Array, wrench: Array, weights: Array, reference: Array) -> Self:
        """Return the statistics of poses with independent noise.

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
        """Return the statistics of poses whose noise may be correlated between poses."""
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
        """Return the statistics from the sums of `wrench_gram`, for one common inverse noise covariance (6, 6)."""
        A = np.einsum("cd,ml->cdml", weight, gram[6:, 6:]).reshape(36, 100)
        return cls(reference, _sixty(A), (weight @ gram[:6, 6:]).ravel(), float(np.vdot(weight, gram[:6, :6])))

    def normal_equations(self, p: Parameters) -> tuple[Array, Array, float]:
        """Return information matrix (15, 15), right-hand side (15,) and cost at given parameters."""
        T = coefficients_derivative(p).reshape(15, 60)
        D = (coefficients(p) - self.reference).ravel()
        rest = self.B - self.A @ D
        return T @ self.A @ T.T, T @ rest, self.square - float(D @ (self.B + rest))


def _sixty(A: Array) -> Array:
    return np.ascontiguousarray(A.reshape(6, 6, 10, 10).transpose(0, 2, 1, 3)).reshape(60, 60)


def wrench_gram(R_base_flange: Array, wrench: Array, reference: Array) -> Array:
    """Return the sum (16, 16) of row.T @ row with row = (wrench - offset, features), for poses with common noise.

    The offset is the last column of `reference` (6, 10), whose other columns are zero. Sums of disjoint data add up.
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
# Convergence: length of the last step of a descent, in standard deviations of the noise.
SMALL_STEP = 1e-4
MOST_MINIMA = 6
SAME_ROTATION_RAD = np.deg2rad(1.0)


@dataclass(frozen=True, slots=True, eq=False)
class Minimum:
    """Local minimum of the joint cost of forces and torques."""

    parameters: Parameters
    chi2: float
    """Chi2 under the noise model of the fit, for the same poses at all minima."""
    information: Array
    """(15, 15) Fisher information at the minimum, including priors."""
    settled: bool = True
    """Whether the descent to this minimum converged."""


class Descent:
    """Descent of the joint cost for one set of poses.

    Parameters
    ----------
    R_base_flange : array, shape (n, 3, 3)
    wrench : array, shape (n, 6)
    """

    def __init__(self, R_base_flange: Array, wrench: Array, constraints: Constraints) -> None:
        self.R, self.wrench, self.constraints = R_base_flange, wrench, constraints

    def minima(self, weights: Array) -> list[Minimum]:
        """Return the minima of the joint cost reached from the minima of the force cost, lowest first.

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
            # Sums of differences from a mean keep the digits that a large bias would cost.
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
        minima = self.distinct(ends)
        if n <= CHUNK:  # repeat with the solution as reference, so that data without noise are fitted to the last digit
            statistics = Statistics.of(phi, self.wrench, weights, coefficients(minima[0].parameters))
            minima[0] = self.down(statistics, minima[0].parameters)
        return minima

    @staticmethod
    def distinct(ends: list[Minimum]) -> list[Minimum]:
        """Return the minima by ascending chi2, without duplicates."""
        minima: list[Minimum] = []
        for end in sorted(ends, key=lambda end: end.chi2):
            if not any(Descent.same(end.parameters, other.parameters) for other in minima):
                minima.append(end)
        return minima

    @staticmethod
    def same(p: Parameters, q: Parameters) -> bool:
        """Whether two parameter sets belong to the same minimum: their mountings differ by less than 1°."""
        return bool(angle_between(p.R_flange_sensor, q.R_flange_sensor) <= SAME_ROTATION_RAD)

    def normal_equations(self, statistics: Statistics, p: Parameters) -> tuple[Array, Array, float]:
        """Return the normal equations of statistics and priors: information, right-hand side and cost."""
        H, g, cost = statistics.normal_equations(p)
        if self.constraints.any:
            A, residual = self.constraints.measurements(p)
            return H + A.T @ A, g + A.T @ residual, cost + float(residual @ residual)
        return H, g, cost

    def down(self, statistics: Statistics, p: Parameters, steps: int = MAX_STEPS) -> Minimum:
        """Return the minimum that Levenberg-Marquardt steps reach from given parameters."""
        H, g, cost = self.normal_equations(statistics, p)
        b, F0, T0 = p.gravity_force_base_N, p.force_bias_N, p.torque_bias_Nm
        prediction = np.concatenate([np.zeros(3), b, F0, np.zeros(3), T0])  # Jacobian times this: predicted wrench
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
    """Return the solution of `(H + damping) x = g`, the shortest one if the matrix lacks rank."""
    _, x, failed = dposv(H + damping * np.eye(len(H)) if damping else H, g)
    if failed:
        eigenvalues, V = np.linalg.eigh(H)
        x = V @ (V.T @ g / np.maximum(eigenvalues + damping, 1e-14 * eigenvalues[-1]))
    return np.asarray(x)


def column_scale(information: Array) -> Array:
    """Return the square root of the diagonal, 1 where it is 0: scaling by it makes eigenvalues independent of units."""
    diagonal = np.sqrt(np.maximum(information.diagonal(), 0.0))
    return np.asarray(np.where(diagonal > 0, diagonal, 1.0))


def _without_correlation(weights: Array) -> Array:
    """Return the inverse covariances without the correlation of forces and torques; zero weights stay zero."""
    if not weights[:, :3, 3:].any():
        return weights
    separate = np.zeros_like(weights)
    for own, other in ((slice(0, 3), slice(3, 6)), (slice(3, 6), slice(0, 3))):
        between, block = weights[:, own, other], weights[:, other, other]
        block = block + (np.trace(block, axis1=1, axis2=2) == 0)[:, None, None] * np.eye(3)
        separate[:, own, own] = weights[:, own, own] - between @ np.linalg.solve(block, np.swapaxes(between, 1, 2))
    return separate


def _linear_start(statistics: Statistics, R_flange_sensor: Array) -> Parameters:
    """Return the parameters for a given mounting: first gravity and force bias, then centre of mass and torque bias.

    Both steps are linear.
    """
    p = Parameters(R_flange_sensor, *np.zeros((4, 3)))
    for unknowns in (slice(3, 9), slice(9, 15)):
        H, g, _ = statistics.normal_equations(p)
        step = np.zeros(15)
        step[unknowns] = np.linalg.lstsq(H[unknowns, unknowns], g[unknowns], rcond=1e-12)[0]
        p = p.moved(step)
    return p


# Outliers: poses in which the tool was bumped or touched, or something slipped.
#
# Graduated non-convexity with the Geman-McClure cost (Yang, Antonante, Tzoumas, Carlone 2020) starts from every minimum
# of the least-squares cost. A least-squares fit of the other poses follows. The lowest truncated cost is chosen.

Kept = NDArray[np.bool_]

# Share of good poses that are rejected.
FALSE_REJECTION = 1e-3
# Squared Mahalanobis distance beyond which a pose is rejected: 22.5.
FARTHEST = float(chi2_isf(6, FALSE_REJECTION))
# With fewer poses than this, an outlier cannot be distinguished from good poses.
FEWEST_TO_REJECT_FROM = 8
ANNEALING = 1.6


def fewest_kept(n: int) -> int:
    """Return the number of poses, of n, that must agree with each other before the others may be rejected."""
    return n if n < FEWEST_TO_REJECT_FROM else max(FEWEST_TO_REJECT_FROM - 1, int(np.ceil(0.6 * n)))


def agreeing_poses(descent: Descent, weights: Array, starts: Sequence[Parameters]) -> tuple[Parameters, Kept] | None:
    """Return parameters and the poses (n,) that agree with them, by a robust fit from several starts.

    `weights` (n, 6, 6) are inverse noise covariances. None if, from every start, fewer poses agree than `fewest_kept`.
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
        # The robust cost is convex at first. It is then made less convex in steps, and outliers lose their weight.
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
