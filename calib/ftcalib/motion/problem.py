"""The unknowns of a load in motion, their priors, and the normal equations of one Gauss-Newton step.

The unknowns are the error vector x of the load (34 coordinates, `MovingLoad.moved`) and Gaussian random effects.
The wrench of row i at time t_i in orientation R_i is, with h of `ftcalib.motion.model`,

    y_i = h(x, motion(t_i - delay)) + B_i beta + Z_i u + e_i,    e_i: autoregressive noise, `RowNoise`

    beta   bias at knots every 5 s: a random walk with increments N(0, walk² dt) in each channel. The last knot is 0,
           so the bias in x is the bias at the end. Each zeroing adds an offset of the bias in the rows before it.
    u      slow      slow noise: an Ornstein-Uhlenbeck process with a time constant of 5 s, at knots every 2.5 s
           rotation  errors of the arm's orientation about the flange axes: smooth functions of R_i, cov(u) = size² I.
                     Parts that are constant in flange or base axes belong to x. A shift (3) of the flange, for links
                     of 0.3 m, is included
           yielding  rotation of a compliant mount in proportion to the torque, 3 x 3
           cable     wrench of a cable: smooth functions of R_i, for each channel
           load      gain that depends on the load: weight and its squares in sensor axes, for each channel
           lever     antisymmetric cross-talk (3): it shifts the centre of mass seen in the torques, not in the forces

Gain and cross-talk in x have priors of the same kind; inertia, height and delay have the priors of a usual tool. With
J the derivative of all y with respect to v = (x, beta, u), r = y - prediction, W the inverse covariance of the noise,
and P(s) the precision of the priors for the standard deviations s of the components, a step and its covariance are
(Henderson, Biometrics 31, 1975)

    H = J' W J + P(s),    b = J' W r - P(s) v,    step = H^-1 b,    cov = H^-1

and the restricted likelihood of s is (Patterson and Thompson, Biometrika 58, 1971)

    -2 log L(s) = r' W r + v' P v - b' H^-1 b + log det H - log det P(s).

Exact constraints of `Known` restrict x to a basis Z: H becomes Z' H Z. Rows (J, r) of a `CellPrior` add to H and b.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag, cho_factor, cho_solve

from ftcalib.known import RANGE_LEVER_M, Constraints, Known
from ftcalib.likelihood.rotation_minima import com_and_torque_bias, force_cost, given_rotation, minima
from ftcalib.model import Array, Parameters, cross, nearest_rotation
from ftcalib.motion.model import (
    CROSS_TALK,
    DELAY,
    GAINS,
    HEIGHT,
    INERTIA,
    SIZE,
    MovingLoad,
    RowNoise,
    SmoothFunctions,
    lever_columns,
    motion_jacobian,
    places_in_runs,
    turn_columns,
    wrench_of,
)
from ftcalib.motion.samples import Motion, MotionRows

# Prior sigmas of a tool: radius of gyration, height of the sensor, and delay that the rows are not yet corrected for.
GYRATION_M, HEIGHT_M, DELAY_S = 0.15, 0.3, 0.3
# Knots between which the drifting bias is interpolated: interval, s, and largest number.
KNOT_S, _MOST_KNOTS = 5.0, 25
# Lever that converts an orientation error of the arm to a shift of the flange, m.
_REACH_M = 0.3
# Slow noise: time constant, s, interval of the knots of its interpolation, s, and their largest number.
SLOW_S, _SLOW_KNOT_S, _MOST_SLOW = 5.0, 2.5, 48
# Prior sigma of what remains of the bias step of a zeroing after its removal from the rows.
_ZEROED_N, _ZEROED_NM = 10.0, 1.0
# Ridge term of the scaled equations: undetermined directions have a standard deviation of 1e6 times their scale.
RIDGE = 1e-12
# Expected standard deviations of the components that are always part of the model, because noise can hide them.
EXPECTED: Mapping[str, float] = {
    "slow_N": 5e-3,
    "slow_Nm": 2e-4,
    "yielding_rad": float(np.radians(0.05)),
    "rotation_rad": float(np.radians(0.05)),
    "cable_N": 0.01,
    "cable_Nm": 1e-3,
    "load_N": 0.01,
    "load_Nm": 1e-3,
}
NEVER: Array = np.zeros(0)

# Largest number of rows in a robust fit.
ROUGH_ROWS = 600
# Indices of the coordinates of a static result: parameters, then gain and cross-talk.
_RESPONDING = np.r_[0:15, GAINS.start : SIZE]
# Number of rows summed at once.
_CHUNK = 1000
# With more rows than this, the part of the noise that the fitted parameters absorb is neglected.
_MANY = 1000


class Problem:
    """Least-squares problem of the rows of a motion; arguments as in `ftcalib.motion.estimate.fit_motion`."""

    def __init__(
        self, rows: MotionRows, known: Known | None, g_m_s2: float, *, point_mass: bool, zeroed_s: Array = NEVER
    ) -> None:
        self.rows, self.g_m_s2, self.zeroed_s = rows, g_m_s2, zeroed_s
        self.constraints = Constraints(known or Known(), g_m_s2)
        self.duration_s = float(np.ptp(rows.t_s))
        self.fixed = np.zeros(SIZE, bool)
        self.fixed[INERTIA] = point_mass
        count = int(np.clip(round(self.duration_s / KNOT_S), 1, _MOST_KNOTS - 1)) + 1
        self.knots = np.linspace(rows.t_s[0], rows.t_s[-1], count)
        before_end = np.eye(count)[:, :-1]  # the drift ends at 0, so the bias of the load is the bias at the end
        steps = np.diff(np.eye(count), axis=0) @ before_end
        self.walk = steps.T @ steps / (self.knots[1] - self.knots[0])
        self.courses = count + len(zeroed_s)
        count = int(np.clip(round(self.duration_s / _SLOW_KNOT_S), 1, _MOST_SLOW - 1)) + 1
        self.slow_knots = np.linspace(rows.t_s[0], rows.t_s[-1], count)
        self.functions = SmoothFunctions.of(nearest_rotation(rows.motion.R_base_flange))
        self.groups, self.others = self._group()
        courses = block_diag(before_end, np.eye(len(zeroed_s)))
        self.basis = block_diag(np.kron(courses, np.eye(6)), np.eye(self.others))

    def _group(self) -> tuple[dict[str, tuple[NDArray[np.intp], Array]], int]:
        """Return each component's indices in (load, effects) and precision at size 1; also the number of other effects.

        The effects are the values of the bias (without the last knot), then the others: slow noise, rotations, cable
        and lever. The second result is the number of these other effects.
        """
        distance = self.slow_knots[1] - self.slow_knots[0]
        lags = np.abs(np.subtract.outer(self.slow_knots, self.slow_knots))
        slow = np.linalg.inv(np.exp(-lags / max(SLOW_S, 1e-3 * distance)))
        start = at = SIZE + 6 * (len(self.walk) + len(self.zeroed_s))
        groups = {"gain": (np.arange(SIZE)[GAINS], np.eye(GAINS.stop - GAINS.start))}
        turns = 3 * (len(self.functions) + 4)
        for name, first, precision in (
            ("walk", SIZE, self.walk),
            ("slow", start, slow),
            ("cable", start + 6 * len(slow) + turns, np.eye(len(self.functions))),
            ("load", start + 6 * (len(slow) + len(self.functions)) + turns, np.eye(9)),
        ):
            places = first + np.arange(6 * len(precision)).reshape(-1, 6)
            for unit, channels in (("N", slice(0, 3)), ("Nm", slice(3, 6))):
                groups[f"{name}_{unit}"] = places[:, channels].ravel(), np.kron(precision, np.eye(3))
            at = first + 6 * len(precision)
        of_turns = start + 6 * len(slow) + np.arange(turns)
        groups["yielding_rad"] = of_turns[-12:-3], np.eye(9)
        groups["rotation_rad"] = np.append(of_turns[:-12], of_turns[-3:]), np.eye(turns - 9)
        # An entry of the antisymmetric part has half the variance of a full entry.
        precision = np.diag(np.append(np.ones(CROSS_TALK.stop - CROSS_TALK.start), np.full(3, 2 / RANGE_LEVER_M**2)))
        groups["cross_talk"] = np.append(np.arange(SIZE)[CROSS_TALK], at + np.arange(3)), precision
        return groups, at + 3 - start

    def residuals(self, load: MovingLoad, effects: Array) -> Array:
        """Return the measured wrenches (n, 6) of all rows minus those predicted from load and random effects."""
        rows, others = self.rows, effects[6 * self.courses :]
        wrench = self.hats(rows.t_s) @ self.drift(effects)
        if others.any():
            for start in range(0, len(rows), _CHUNK):
                part = slice(start, start + _CHUNK)
                wrench[part] += self.columns(load, rows[part])[1] @ others
        return np.asarray(rows.wrench - self.predict(load, rows) - wrench)

    def hats(self, t_s: Array) -> Array:
        """Return the interpolation weights (n, courses) of the bias knots and of the offsets before each zeroing."""
        knots = _hats(self.knots, t_s)
        return np.hstack([knots, t_s[:, None] <= self.zeroed_s]) if len(self.zeroed_s) else knots

    def predict(self, load: MovingLoad, rows: MotionRows) -> Array:
        """Return the wrench (n, 6) that a load exerts according to the model, without random effects."""
        return wrench_of(load, rows.motion.earlier(load.delay_s, rows.rate))

    def smooth_columns(self, load: MovingLoad, motion: Motion) -> Array:
        """Return the wrench's derivative (n, 6, k) by the smooth effects: rotation, yielding, shift, cable, load."""
        R = nearest_rotation(motion.R_base_flange)
        turned = turn_columns(load, motion) @ self.turns(load, R)
        moved = _REACH_M * lever_columns(load, motion)
        share = load.static.down @ R @ load.static.R_flange_sensor
        gained = np.hstack([share, np.einsum("ni,nj->nij", share, share)[:, *np.triu_indices(3)]])
        return np.concatenate([turned, moved, _on_channels(self.functions(R)), _on_channels(gained)], axis=2)

    def turns(self, load: MovingLoad, R_base_flange: Array) -> Array:
        """Return orientation errors (n, 3, k) about the flange axes: smooth ones, and those of a compliant mount.

        Constant parts are removed, because they belong to the parameters: a rotation that is constant in flange axes
        to the mounting, one that is constant in base axes to the direction of gravity.
        """

        def of(R: Array) -> tuple[Array, Array]:
            torque = cross(load.lever_m / max(float(np.linalg.norm(load.lever_m)), 1e-12), load.static.down @ R)
            values = np.hstack([self.functions(R), torque])
            constant = np.concatenate([np.broadcast_to(np.eye(3), R.shape), R.swapaxes(1, 2)], axis=2)
            return np.einsum("nk,ij->nikj", values, np.eye(3)).reshape(len(R), 3, -1), constant

        smooth, constant = (each.reshape(-1, each.shape[2]) for each in of(self.functions.R_base_flange))
        share = np.linalg.lstsq(constant, smooth, rcond=1e-9)[0]
        smooth, constant = of(R_base_flange)
        return np.asarray(smooth - constant @ share)

    def columns(self, load: MovingLoad, rows: MotionRows) -> tuple[Array, Array]:
        """Return the wrench's derivatives with respect to the load (n, 6, 34) and to all effects except the bias."""
        motion = rows.motion.earlier(load.delay_s, rows.rate)
        J, slow = motion_jacobian(load, motion, rows.rate), _on_channels(_hats(self.slow_knots, rows.t_s))
        return J, np.concatenate([slow, self.smooth_columns(load, motion), lever_columns(load, motion)], axis=2)

    def drift(self, effects: Array) -> Array:
        """Return the bias (courses, 6) in the effects: at the knots, then the offset before each zeroing."""
        return effects[: 6 * self.courses].reshape(-1, 6)

    @property
    def smooth_effects(self) -> slice:
        """Slice of the smooth effects (rotation, yielding, shift, cable, load) in the columns of `basis`."""
        start = self.basis.shape[1] - self.others + 6 * len(self.slow_knots)
        return slice(start, self.basis.shape[1] - 3)

    def unseen(self, load: MovingLoad, residuals: Array) -> Array:
        """Return a matrix A (n, 6, k): A A' is the covariance of the rows due to smooth errors of arm and cable.

        The arm's error has its expected size, and that of the cable is the smooth excess of the residuals (n, 6).
        """
        motion = self.rows.motion.earlier(load.delay_s, self.rows.rate)
        values = np.linalg.qr(self.functions(nearest_rotation(motion.R_base_flange)))[0]
        noise = values.shape[1] * np.mean(residuals**2, axis=0)
        beyond = np.sum((values.T @ residuals) ** 2, axis=0) - noise
        pull = np.sqrt(np.maximum(beyond.reshape(2, 3).sum(axis=1) / beyond.size * 2, 0) / len(residuals))
        sizes = {"rotation_rad": EXPECTED["rotation_rad"], "cable_N": pull[0], "cable_Nm": pull[1]}
        variance = np.zeros(SIZE + self.basis.shape[1])
        for name, size in sizes.items():
            variance[self.groups[name][0]] = size**2
        return np.asarray(self.smooth_columns(load, motion) * np.sqrt(variance[SIZE:][self.smooth_effects]))

    def next_use(self, load: MovingLoad, effects: Array, solved: "Solution") -> Array:
        """Return the rms error (2,) of compensating a free tool at rest in the orientations of the rows, N and N·m.

        Orientation errors and the cable act as in the recording, and the compensation does not model them.
        """
        R = self.functions.R_base_flange
        still = Motion(R, np.zeros((len(R), 3)), np.zeros((len(R), 3, 3)))
        J = motion_jacobian(load, still, still.earlier(1.0, still))
        smooth = self.smooth_columns(load, still)
        error = smooth @ (self.basis.T @ effects)[self.smooth_effects]
        places = np.r_[0:SIZE, SIZE + np.arange(self.basis.shape[1])[self.smooth_effects]]
        basis, inverse_root = solved.root
        square = np.sum((np.concatenate([J, smooth], axis=2) @ basis[places] @ inverse_root) ** 2, axis=2) + error**2
        return np.asarray(np.sqrt(square.mean(axis=0).reshape(2, 3).sum(axis=1)))

    def prior(self, load: MovingLoad) -> tuple[Array, Array]:
        """Return the prior precision (34,) of inertia, height and delay, 0 for the others, and the current values."""
        sigma = np.full(SIZE, np.inf)
        sigma[INERTIA] = max(load.mass_kg, 0.1) * GYRATION_M**2
        sigma[HEIGHT], sigma[DELAY] = HEIGHT_M, DELAY_S
        return 1 / sigma**2, load.vector

    def starts(self) -> list[MovingLoad]:
        """Return starting loads: one for each mounting that explains the forces as a weight."""
        rows = self.rows[:: max(1, len(self.rows) // ROUGH_ROWS)]
        R, force, ones = nearest_rotation(rows.motion.R_base_flange), rows.wrench[:, :3], np.ones(len(rows))
        cost = force_cost(R, force, ones)
        loads = []
        for Q in self.constraints.rotations([minimum.R.T for minimum in minima(cost)], cost)[:4]:
            F_b, bias = given_rotation(Q.T, R, force, ones)
            c, torque_bias = com_and_torque_bias(F_b @ R @ Q, rows.wrench[:, 3:])
            loads.append(MovingLoad(self.constraints.satisfy(Parameters(Q, F_b, bias, c, torque_bias)), self.g_m_s2))
        return loads

    def free(self, load: MovingLoad) -> Array:
        """Return a basis (34, m) of the coordinates of the load that are not exactly known."""
        Z = block_diag(self.constraints.free(load.static), np.eye(SIZE - 15))
        return np.asarray(Z[:, ~np.concatenate([np.zeros(Z.shape[1] - (SIZE - 15), bool), self.fixed[15:]])])

    def estimated(self, load: MovingLoad, on: NDArray[np.bool_]) -> tuple[Array, NDArray[np.intp]]:
        """Return a basis (34, m) of the estimated coordinates of the load, and the indices of the estimated effects."""
        Z = self.free(load)
        return Z[:, on[np.argmax(np.abs(Z), axis=0)]], SIZE + np.flatnonzero(on[SIZE:])

    def sums(
        self, load: MovingLoad, effects: Array, noise: RowNoise, kept: NDArray[np.bool_], state: NDArray[np.intp]
    ) -> tuple[Array, Array, float]:
        """Return information matrix, gradient and chi2 of load and effects over the whitened kept rows."""
        rows, order = self.rows[kept], noise.filters.shape[0] - 1
        state, place = state[kept], places_in_runs(rows.t_s, rows.row_s)
        size = SIZE + len(self.basis)
        others = np.arange(SIZE + 6 * self.courses, size)
        H, b, chi2 = np.zeros((size, size)), np.zeros(size), 0.0
        for start in range(0, len(rows), _CHUNK):
            part = slice(max(start - order, 0), start + _CHUNK)
            some, hats = rows[part], self.hats(rows.t_s[part])
            near = np.flatnonzero(hats.any(axis=0))
            J, columns = self.columns(load, some)
            r = some.wrench - self.predict(load, some) - hats @ self.drift(effects)
            r -= columns @ effects[6 * self.courses :]
            X = np.concatenate([J, _on_channels(hats[:, near]), columns, r[:, :, None]], axis=2)
            X = noise.whiten(X, state[part], place[part])
            X = X[start - part.start :].reshape(-1, X.shape[2])
            places = np.concatenate([np.arange(SIZE), SIZE + (6 * near[:, None] + np.arange(6)).ravel(), others])
            gram = X.T @ X
            H[np.ix_(places, places)] += gram[:-1, :-1]
            b[places] += gram[:-1, -1]
            chi2 += float(gram[-1, -1])
        T = block_diag(np.eye(SIZE), self.basis)
        return T.T @ H @ T, T.T @ b, chi2

    def absorb(self, load: MovingLoad, rows: MotionRows, solved: "Solution") -> Array:
        """Return a matrix A (n, 6, k): A A' is the covariance of the predicted wrenches of the rows.

        A has no columns before the first solution, or if so many rows make the covariance negligible.
        """
        if not solved.step.size or len(rows) > _MANY:
            return np.zeros((len(rows), 6, 0))
        basis, inverse_root = solved.root
        J, others = self.columns(load, rows)
        by_effects = np.concatenate([_on_channels(self.hats(rows.t_s)), others], axis=2)
        return np.asarray(np.concatenate([J, by_effects @ self.basis], axis=2) @ (basis @ inverse_root))

    def components(self, sizes: Mapping[str, float], load: MovingLoad) -> tuple[Array, NDArray[np.bool_], float]:
        """Return prior precision, whether each unknown is estimated, and -log det of the components' precision."""
        total = SIZE + self.basis.shape[1]
        P, on, log_det = np.zeros((total, total)), np.ones(total, np.bool_), 0.0
        for name, (places, precision) in self.groups.items():
            if size := sizes.get(name, 0.0):
                P[np.ix_(places, places)] = precision / size**2
                log_det += 2 * len(places) * float(np.log(size)) - float(np.linalg.slogdet(precision)[1])
            else:
                on[places] = False
        precision, _ = self.prior(load)
        P[:SIZE, :SIZE] += np.diag(precision)
        last = total - self.others
        zeroed = range(last - 6 * len(self.zeroed_s), last)
        P[zeroed, zeroed] = np.tile(1 / np.repeat([_ZEROED_N, _ZEROED_NM], 3) ** 2, len(self.zeroed_s))
        return P, on, log_det

    def solve(
        self,
        sizes: Mapping[str, float],
        sums: tuple[Array, Array, float],
        load: MovingLoad,
        effects: Array,
        prior: tuple[Array, Array] | None = None,
    ) -> "Solution":
        """Solve the normal equations for load and effects, given the component sizes and optional rows of a prior."""
        H, b, chi2 = sums
        P, on, log_det = self.components(sizes, load)
        value = np.concatenate([load.vector, self.basis.T @ effects])
        removed = np.where(on, 0.0, -value)  # absent components: coefficients become 0
        chi2 += float(removed @ H @ removed - 2 * b @ removed)
        b, value = b - H @ removed, np.where(on, value, 0.0)
        rows, residuals = self.constraints.measurements(load.static)
        H, b = H + P, b - P @ value
        H[:15, :15] += rows.T @ rows
        b[:15] += rows.T @ residuals
        if prior is not None:
            rows, residuals = prior
            places = _RESPONDING[: rows.shape[1]]
            H[np.ix_(places, places)] += rows.T @ rows
            b[places] += rows.T @ residuals
        Z, rest = self.estimated(load, on)
        H = _among(H, Z, rest)
        scale = np.sqrt(np.diag(H))
        factor = cho_factor(H / np.outer(scale, scale) + RIDGE * np.eye(len(H)))
        basis = np.zeros((len(P), len(H)))
        basis[:SIZE, : Z.shape[1]], basis[rest, np.arange(Z.shape[1], len(H))] = Z, 1.0
        step = basis @ (cho_solve(factor, basis.T @ b / scale) / scale)
        cost = chi2 + float(value @ P @ value + residuals @ residuals - b @ step)
        criterion = cost + log_det
        criterion += 2 * float(np.log(np.diag(factor[0]) * scale).sum())
        return Solution(step + removed, cost, criterion, basis / scale, factor)

    def criteria(
        self,
        name: str,
        tried: Array,
        sizes: Mapping[str, float],
        sums: tuple[Array, Array, float],
        load: MovingLoad,
        effects: Array,
    ) -> Array:
        """Return -2 log restricted likelihood (k,) for trial standard deviations of one component, minus that for 0."""
        H, b, _ = sums
        places, precision = self.groups[name]
        P, on, _ = self.components({**sizes, name: 0.0}, load)
        value = np.concatenate([load.vector, self.basis.T @ effects])
        rows, residuals = self.constraints.measurements(load.static)
        # The model is linearised at the current load, with all random effects 0.
        value[:15] = 0.0
        b, H = b + H @ value, H + P
        H[:15, :15] += rows.T @ rows
        b[:15] += rows.T @ residuals
        Z, rest = self.estimated(load, on)
        among = _among(H, Z, rest)
        beside = np.vstack([Z.T @ H[:SIZE, places], H[np.ix_(rest, places)]])
        scale = np.sqrt(np.diag(among))
        factor = cho_factor(among / np.outer(scale, scale) + RIDGE * np.eye(len(among)))
        left = cho_solve(factor, np.column_stack([beside, np.append(Z.T @ b[:SIZE], b[rest])]) / scale[:, None])
        left = (beside / scale[:, None]).T @ left
        root = np.linalg.inv(np.linalg.cholesky(precision))
        information, vector = np.linalg.eigh(root @ (H[np.ix_(places, places)] - left[:, :-1]) @ root.T)
        along = vector.T @ root @ (b[places] - left[:, -1])
        grown = 1 + np.square(tried)[:, None] * np.maximum(information, 0.0)
        return np.asarray(np.sum(np.log(grown) - np.square(tried)[:, None] * along**2 / grown, axis=1))


@dataclass(frozen=True, slots=True, eq=False)
class Solution:
    """Solution of the normal equations for load and effects."""

    step: Array
    """(34 + effects,) step of the load's coordinates and of the random effects."""
    cost: float
    """Chi2 of rows and priors, as predicted for the load after the step."""
    criterion: float
    """-2 log restricted likelihood of the standard deviations of the components, up to a constant."""
    basis: Array
    """Scaled basis of the estimated unknowns: one column for each of them."""
    factor: tuple[Array, bool]
    """Cholesky factor of the scaled information matrix."""

    @classmethod
    def none(cls) -> Self:
        """Return an empty solution, for use before the first step."""
        nothing = np.zeros((0, 0))
        return cls(np.zeros(0), 0.0, 0.0, nothing, (nothing, False))

    @property
    def root(self) -> tuple[Array, Array]:
        """Matrices A and B for which A B (A B)' is the covariance of load and effects."""
        return self.basis, np.asarray(np.linalg.inv(np.triu(self.factor[0])))

    @property
    def covariance(self) -> Array:
        """Covariance of all unknowns: coordinates of the load and random effects."""
        return np.asarray(self.basis @ cho_solve(self.factor, self.basis.T))


def _among(H: Array, Z: Array, rest: NDArray[np.intp]) -> Array:
    """Return the information matrix of the estimated unknowns: the load in the basis Z, and the effects `rest`."""
    beside = Z.T @ H[:SIZE, rest]
    return np.block([[Z.T @ H[:SIZE, :SIZE] @ Z, beside], [beside.T, H[np.ix_(rest, rest)]]])


def _hats(knots: Array, t_s: Array) -> Array:
    """Return the weights (n, k) of linear interpolation between evenly spaced knots."""
    return np.asarray(np.maximum(1 - np.abs(t_s[:, None] - knots) / (knots[1] - knots[0]), 0))


def _on_channels(values: Array) -> Array:
    """Return the derivative (n, 6, 6 k) of a wrench whose channels are independent combinations of values (n, k)."""
    return np.asarray(np.einsum("nk,ij->nikj", values, np.eye(6)).reshape(len(values), 6, -1))
