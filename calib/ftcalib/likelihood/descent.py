"""Down to every minimum of the joint cost of forces and torques, for noise that is independent from pose to pose."""

from dataclasses import dataclass

import numpy as np
from scipy.linalg.lapack import dposv

from ftcalib.known import Constraints
from ftcalib.likelihood import rotation_minima
from ftcalib.likelihood.session_noise import CHUNK
from ftcalib.likelihood.sufficient_statistics import Statistics, coefficients, features, wrench_gram
from ftcalib.model import Array, Parameters, angle_between

MAX_STEPS = 100
SMALL_STEP = 1e-4  # in standard deviations of the noise: a descent that ends with one is slow, not lost
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
            start = self.constraints.satisfied(_linear_start(start_from, R_flange_sensor))
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
            step = np.asarray(_solved(Hz / (scale[:, None] * scale), gz / scale, damping) / scale)
            moved = float(np.sqrt(max(float(step @ Hz @ step), 0.0)))  # in standard deviations of the noise
            trial = p.moved(step if Z is None else Z @ step)
            if Z is not None:
                trial = self.constraints.satisfied(trial)
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


def _solved(H: Array, g: Array, damping: float) -> Array:
    """Solve `(H + damping) x = g`; where the matrix lacks rank, the shortest such step."""
    _, x, failed = dposv(H + damping * np.eye(len(H)) if damping else H, g)
    if failed:
        eigenvalues, V = np.linalg.eigh(H)
        x = V @ (V.T @ g / np.maximum(eigenvalues + damping, 1e-14 * eigenvalues[-1]))
    return np.asarray(x)


def column_scale(information: Array) -> Array:
    """Root of the diagonal, 1 where it vanishes: dividing by it makes eigenvalues independent of units."""
    diagonal = np.sqrt(information.diagonal())
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
