"""The load that explains rows in motion: Gauss-Newton from each mounting that forces allow, contact left out."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Self

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag, cho_factor, cho_solve
from scipy.special import chdtri as chi2_isf
from scipy.special import ndtri

from ftcalib.after.new_tool import WHOLE, CellPrior
from ftcalib.known import RANGE_LEVER_M, Constraints, Known
from ftcalib.likelihood.rotation_minima import com_and_torque_bias, force_cost, given_rotation, minima
from ftcalib.model import Array, DriftResult, Parameters, angle_between, cross, nearest_rotation
from ftcalib.motion.model import (
    CROSS_TALK,
    DELAY,
    GAINS,
    HEIGHT,
    INERTIA,
    ORDER,
    SIZE,
    Load,
    PoseError,
    RowNoise,
    SmoothFunctions,
    jacobian,
    lever_columns,
    runs,
    states,
    turn_columns,
    wrench_of,
)
from ftcalib.motion.samples import Motion, Rows

# What is expected of a tool before any data, one sigma: radius of gyration, sensor height, delay beyond the rows.
GYRATION_M, HEIGHT_M, DELAY_S = 0.15, 0.3, 0.3
# Squared distance of a row in contact.
CONTACT = float(chi2_isf(6, 1e-7))
# Least residual of a row in contact, in a motion that a guard has watched.
TOUCH_N, TOUCH_NM = 2.0, 0.2
# Share of the rows of a state that is free of contact.
QUIET = 0.4
# Share of rows; beyond it the model does not fit at all.
MOST_CONTACT = 0.8
# Rows left out on both sides of a contact, which the filter spreads.
MARGIN = 2
# Distance and number of the knots of the bias.
KNOT_S, MOST_KNOTS = 5.0, 25
# Length of the links that turn: how far the flange moves.
REACH_M = 0.3
# Time constant, and distance and number of the knots, of the noise of seconds.
SLOW_S, SLOW_KNOT_S, MOST_SLOW = 5.0, 2.5, 48
# What the steps of zeroings, removed before, may be wrong by: one sigma.
ZEROED_N, ZEROED_NM = 10.0, 1.0
# Keeps what is not determined finite: its sigma becomes a million times as large as its scale.
RIDGE = 1e-12
# A component is kept if it lowers -2 log restricted likelihood by this.
WORTH = 4.0

# Sizes of components at first.
ROUGH: Mapping[str, float] = {"gain": 0.02, "cross_talk": 0.02}
_ROUGH_ROWS = 600
# Places of the coordinates of a result at rest, gain and cross-talk last.
_RESPONDING = np.r_[0:15, GAINS.start : SIZE]
_CHUNK = 1000
# Rows beside which what the fit absorbs is small.
_MANY = 1000
_SAME_RAD = 0.2
# Rows that show the noise of the one in their middle, and how many of its state count with them.
_AROUND, _PRIOR_ROWS = 3, 1.0
# Steps of the fit with a prior, and the change of its cost that ends it.
_PRIOR_STEPS, _SETTLED = 20, 1e-4
# Solutions, each with the noise and the contacts of the one before, and those before which components are chosen.
_STAGES, _CHOICES = 6, (1, 2, 4)
# The stage from which what noise hides is part of the model: before, contact would be taken for it.
_ALWAYS = 1
# Sizes that are tried: of the entries of gain and cross-talk, and of the walk of the bias in a second.
_SIZES: Mapping[str, Array] = {
    "gain": np.geomspace(5e-4, 5e-2, 9),
    "cross_talk": np.geomspace(5e-4, 2e-1, 11),
    "walk_N": np.geomspace(3e-4, 3e-1, 10),
    "walk_Nm": np.geomspace(6e-6, 6e-3, 10),
    "slow_N": np.geomspace(1e-4, 1.0, 41),
    "slow_Nm": np.geomspace(2e-6, 2e-2, 41),
    "yielding_rad": np.geomspace(1e-6, 1e-2, 41),
    "rotation_rad": np.geomspace(1e-6, 1e-2, 41),
    "cable_N": np.geomspace(1e-4, 1.0, 41),
    "cable_Nm": np.geomspace(4e-6, 4e-2, 41),
    "load_N": np.geomspace(1e-4, 1.0, 41),
    "load_Nm": np.geomspace(4e-6, 4e-2, 41),
}
# Probability that a cell has none of it, and the factor within which it is of the expected size otherwise: one sigma.
ABSENT, WITHIN = 0.7, 3.0
# Sizes that are expected of components that are always part of the model, because noise hides them: the orientation
# of a calibrated arm, a cable, and the noise of seconds.
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

# Squared distance of a row that counts a quarter where a robust fit has settled.
LIMIT = 22.0
NEVER: Array = np.zeros(0)


@dataclass(frozen=True, slots=True, eq=False)
class MotionFit:
    """The best fit."""

    load: Load
    covariance: Array
    """(34, 34)"""
    kept: NDArray[np.bool_]
    """(n,) rows without contact."""
    residuals: Array
    """(n, 6) of all rows, drift included in the prediction, and of the other effects none."""
    next_use: Array
    """(2,) root mean square error of compensating a free tool at rest in these poses, N and N·m."""
    sigma: Array
    """(n, 6) of a row's noise."""
    distance: Array
    """(n,) squared, of each residual from 0: chi2 with 6 degrees of freedom without contact."""
    drift: DriftResult | None
    """From the first row to the last, with the course of the bias minus that of the load, which is the last one; None
    without a walk."""
    mean_bias: Array | None = None
    """(6,) with drift, over the rows."""
    components: Mapping[str, float] = field(default_factory=dict)
    second_basin_chi2: float | None = None
    chi2: float = 0.0
    """Chi2 of the kept rows, made independent: about 6 a row."""
    contradiction: str = ""
    """What rows and prior contradict each other in; empty where they agree."""

    @property
    def prior_share(self) -> Array:
        """Sigma (8,) of inertia, height and delay, in that of what is expected of any tool."""
        expected = np.r_[np.full(6, max(self.load.mass_kg, 0.1) * GYRATION_M**2), HEIGHT_M, DELAY_S]
        return np.asarray(np.sqrt(np.diag(self.covariance)[15:23]) / expected)


class _Problem:
    def __init__(
        self, rows: Rows, known: Known | None, g_m_s2: float, *, point_mass: bool, zeroed_s: Array = NEVER
    ) -> None:
        self.rows, self.g_m_s2, self.zeroed_s = rows, g_m_s2, zeroed_s
        self.constraints = Constraints(known or Known(), g_m_s2)
        self.duration_s = float(np.ptp(rows.t_s))
        self.fixed = np.zeros(SIZE, bool)
        self.fixed[INERTIA] = point_mass
        count = int(np.clip(round(self.duration_s / KNOT_S), 1, MOST_KNOTS - 1)) + 1
        self.knots = np.linspace(rows.t_s[0], rows.t_s[-1], count)
        before_end = np.eye(count)[:, :-1]  # a drift that ends at 0: the bias is that of the end
        steps = np.diff(np.eye(count), axis=0) @ before_end
        self.walk = steps.T @ steps / (self.knots[1] - self.knots[0])
        self.courses = count + len(zeroed_s)
        count = int(np.clip(round(self.duration_s / SLOW_KNOT_S), 1, MOST_SLOW - 1)) + 1
        self.slow_knots = np.linspace(rows.t_s[0], rows.t_s[-1], count)
        self.functions = SmoothFunctions.of(nearest_rotation(rows.motion.R_base_flange))
        self.groups, self.others = self._group()
        courses = block_diag(before_end, np.eye(len(zeroed_s)))
        self.basis = block_diag(np.kron(courses, np.eye(6)), np.eye(self.others))

    def _group(self) -> tuple[dict[str, tuple[NDArray[np.intp], Array]], int]:
        """Places of each component in load and effects, with their precision at size 1, and how many effects are other.

        Effects are the courses of the bias without its end, then the others: noise of seconds, turns, cable and lever.
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
        # An antisymmetric entry has half the variance of an entry.
        precision = np.diag(np.append(np.ones(CROSS_TALK.stop - CROSS_TALK.start), np.full(3, 2 / RANGE_LEVER_M**2)))
        groups["cross_talk"] = np.append(np.arange(SIZE)[CROSS_TALK], at + np.arange(3)), precision
        return groups, at + 3 - start

    def hats(self, t_s: Array) -> Array:
        """Weight (n, courses) of each knot, and of the bias before each zeroing."""
        knots = _hats(self.knots, t_s)
        return np.hstack([knots, t_s[:, None] <= self.zeroed_s]) if len(self.zeroed_s) else knots

    def predict(self, load: Load, rows: Rows) -> Array:
        return wrench_of(load, rows.motion.earlier(load.delay_s, rows.rate))

    def smooth_columns(self, load: Load, motion: Motion) -> Array:
        """Derivative (n, 6, k) of the wrench by turns, by what they move, by a cable and by the gain of the load."""
        R = nearest_rotation(motion.R_base_flange)
        turned = turn_columns(load, motion) @ self.turns(load, R)
        moved = REACH_M * lever_columns(load, motion)
        share = load.static.down @ R @ load.static.R_flange_sensor
        gained = np.hstack([share, np.einsum("ni,nj->nij", share, share)[:, *np.triu_indices(3)]])
        return np.concatenate([turned, moved, _on_channels(self.functions(R)), _on_channels(gained)], axis=2)

    def turns(self, load: Load, R_base_flange: Array) -> Array:
        """Turns (n, 3, k) of poses, in flange axes: smooth ones, and those of a mount that yields to the torque.

        What no session can separate belongs to the parameters: a turn that is constant in flange axes to the mounting,
        and one in base to the direction of gravity.
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

    def columns(self, load: Load, rows: Rows) -> tuple[Array, Array]:
        """Derivative (n, 6, 34) of the wrench by the load, and by the effects without the courses of the bias."""
        motion = rows.motion.earlier(load.delay_s, rows.rate)
        J, slow = jacobian(load, motion, rows.rate), _on_channels(_hats(self.slow_knots, rows.t_s))
        return J, np.concatenate([slow, self.smooth_columns(load, motion), lever_columns(load, motion)], axis=2)

    def effect(self, load: Load, rows: Rows, effects: Array) -> Array:
        """Wrench (n, 6) of the effects."""
        wrench = self.hats(rows.t_s) @ self.drift(effects)
        others = effects[6 * self.courses :]
        if others.any():
            for start in range(0, len(rows), _CHUNK):
                part = slice(start, start + _CHUNK)
                wrench[part] += self.columns(load, rows[part])[1] @ others
        return np.asarray(wrench)

    def drift(self, effects: Array) -> Array:
        """Bias (courses, 6) at the knots and before each zeroing."""
        return effects[: 6 * self.courses].reshape(-1, 6)

    @property
    def smooth_effects(self) -> slice:
        """Places of turns and cable among the numbers of `basis`."""
        start = self.basis.shape[1] - self.others + 6 * len(self.slow_knots)
        return slice(start, self.basis.shape[1] - 3)

    def unseen(self, load: Load, residuals: Array) -> Array:
        """Root (n, 6, k) of the covariance that smooth errors give the rows: of an arm, and of a cable.

        The arm has the expected one, and the cable pulls by as much as residuals (n, 6) are smooth beyond noise.
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

    def next_use(self, load: Load, effects: Array, solved: "_Step") -> Array:
        """Root mean square error (2,) of compensating a free tool at rest in the poses of the rows, N and N·m.

        Turns and cable act then as they did in the recording, and no compensation knows them.
        """
        R = self.functions.R_base_flange
        still = Motion(R, np.zeros((len(R), 3)), np.zeros((len(R), 3, 3)))
        J = jacobian(load, still, still.earlier(1.0, still))
        smooth = self.smooth_columns(load, still)
        error = smooth @ (self.basis.T @ effects)[self.smooth_effects]
        places = np.r_[0:SIZE, SIZE + np.arange(self.basis.shape[1])[self.smooth_effects]]
        basis, inverse_root = solved.root
        square = np.sum((np.concatenate([J, smooth], axis=2) @ basis[places] @ inverse_root) ** 2, axis=2) + error**2
        return np.asarray(np.sqrt(square.mean(axis=0).reshape(2, 3).sum(axis=1)))

    def prior(self, load: Load) -> tuple[Array, Array]:
        """Precision (34,) of the values that are not static, beside that of the components, and the present values."""
        sigma = np.full(SIZE, np.inf)
        sigma[INERTIA] = max(load.mass_kg, 0.1) * GYRATION_M**2
        sigma[HEIGHT], sigma[DELAY] = HEIGHT_M, DELAY_S
        return 1 / sigma**2, load.vector

    def starts(self) -> list[Load]:
        """Loads for each mounting that explains the forces as a weight."""
        rows = self.rows[:: max(1, len(self.rows) // _ROUGH_ROWS)]
        R, force, ones = nearest_rotation(rows.motion.R_base_flange), rows.wrench[:, :3], np.ones(len(rows))
        cost = force_cost(R, force, ones)
        found = []
        for Q in self.constraints.rotations([one.R.T for one in minima(cost)], cost)[:4]:
            F_b, bias = given_rotation(Q.T, R, force, ones)
            c, torque_bias = com_and_torque_bias(F_b @ R @ Q, rows.wrench[:, 3:])
            found.append(Load(self.constraints.satisfy(Parameters(Q, F_b, bias, c, torque_bias)), self.g_m_s2))
        return found

    def free(self, load: Load) -> Array:
        """Basis (34, m) of what is estimated, without the response."""
        Z = block_diag(self.constraints.free(load.static), np.eye(SIZE - 15))
        return np.asarray(Z[:, ~np.concatenate([np.zeros(Z.shape[1] - (SIZE - 15), bool), self.fixed[15:]])])

    def estimated(self, load: Load, on: NDArray[np.bool_]) -> tuple[Array, NDArray[np.intp]]:
        """Basis (34, m) of what is estimated of the load, and places of the effects that are."""
        Z = self.free(load)
        return Z[:, on[np.argmax(np.abs(Z), axis=0)]], SIZE + np.flatnonzero(on[SIZE:])

    def rough(self, load: Load) -> tuple[Load, float]:
        """Fit robustly with white noise; return the load and the logarithm of its residuals' size."""
        rows = self.rows[:: max(1, len(self.rows) // _ROUGH_ROWS)]
        limit, size = np.inf, SIZE + self.basis.shape[1]
        no_effects, H, b = np.zeros(len(self.basis)), np.zeros((size, size)), np.zeros(size)
        for _ in range(40):
            r = rows.wrench - self.predict(load, rows)
            scale, weight, limit = robust_weights(r, limit)
            J = jacobian(load, rows.motion.earlier(load.delay_s, rows.rate), rows.rate) / scale[:, None]
            weighted = (J * weight[:, None, None]).reshape(-1, SIZE)
            H[:SIZE, :SIZE], b[:SIZE] = weighted.T @ J.reshape(-1, SIZE), weighted.T @ (r / scale).ravel()
            step = self.solve(ROUGH, (H, b, 0.0), load, no_effects).step
            load = load.moved(step[:SIZE])
            if limit == LIMIT and np.abs(step[:6]).max() < 1e-6:
                break
        return load, float(np.log(scale[::3]).sum())

    def sums(
        self, load: Load, effects: Array, noise: RowNoise, kept: NDArray[np.bool_], state: NDArray[np.intp]
    ) -> tuple[Array, Array, float]:
        """Information, gradient and chi2 of load and effects, over kept rows as the noise weighs them."""
        rows, order = self.rows[kept], noise.filters.shape[0] - 1
        state, place = state[kept], runs(rows.t_s, rows.row_s)
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

    def absorb(self, load: Load, rows: Rows, solved: "_Step") -> Array:
        """Root (n, 6, k) of the covariance of the prediction; none before the first solution, nor for so many rows."""
        if not solved.step.size or len(rows) > _MANY:
            return np.zeros((len(rows), 6, 0))
        basis, inverse_root = solved.root
        J, others = self.columns(load, rows)
        by_effects = np.concatenate([_on_channels(self.hats(rows.t_s)), others], axis=2)
        return np.asarray(np.concatenate([J, by_effects @ self.basis], axis=2) @ (basis @ inverse_root))

    def components(self, sizes: Mapping[str, float], load: Load) -> tuple[Array, NDArray[np.bool_], float]:
        """Prior precision of load and effects, which of them are estimated, and -log det of that of the components."""
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
        P[zeroed, zeroed] = np.tile(1 / np.repeat([ZEROED_N, ZEROED_NM], 3) ** 2, len(self.zeroed_s))
        return P, on, log_det

    def solve(
        self,
        sizes: Mapping[str, float],
        sums: tuple[Array, Array, float],
        load: Load,
        effects: Array,
        prior: tuple[Array, Array] | None = None,
    ) -> "_Step":
        """Solve the sums for load and effects with these sizes of the components, and rows of a prior."""
        H, b, chi2 = sums
        P, on, log_det = self.components(sizes, load)
        value = np.concatenate([load.vector, self.basis.T @ effects])
        removed = np.where(on, 0.0, -value)  # a component that is off goes to 0
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
        return _Step(step + removed, cost, criterion, basis / scale, factor)

    def criteria(
        self,
        name: str,
        tried: Array,
        sizes: Mapping[str, float],
        sums: tuple[Array, Array, float],
        load: Load,
        effects: Array,
    ) -> Array:
        """-2 log restricted likelihood (k,) of a component's sizes beside those of the others, less that of size 0."""
        H, b, _ = sums
        places, precision = self.groups[name]
        P, on, _ = self.components({**sizes, name: 0.0}, load)
        value = np.concatenate([load.vector, self.basis.T @ effects])
        rows, residuals = self.constraints.measurements(load.static)
        # About the present load and effects of 0.
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
class _Step:
    step: Array
    # Chi2 of rows and priors after the step.
    cost: float
    criterion: float
    basis: Array
    factor: tuple[Array, bool]

    @classmethod
    def none(cls) -> Self:
        """Before the first one."""
        nothing = np.zeros((0, 0))
        return cls(np.zeros(0), 0.0, 0.0, nothing, (nothing, False))

    @property
    def root(self) -> tuple[Array, Array]:
        """Two matrices; their product times its transpose is the covariance."""
        return self.basis, np.asarray(np.linalg.inv(np.triu(self.factor[0])))

    @property
    def covariance(self) -> Array:
        return np.asarray(self.basis @ cho_solve(self.factor, self.basis.T))


def fit(
    rows: Rows,
    known: Known | None,
    g_m_s2: float,
    *,
    prior: CellPrior | None = None,
    point_mass: bool = False,
    guarded: bool = False,
    zeroed_s: Array = NEVER,
) -> MotionFit:
    """Fit all unknowns to rows.

    Parameters
    ----------
    rows : Rows
    known : Known, optional
        As for `ftcalib.solve`.
    g_m_s2 : float
    prior : CellPrior, optional
        It joins the last stage: noise and contact are those of the rows alone, so a wrong prior leaves no row out.
    point_mass : bool
        Whether the inertia about the centre of mass is known to be 0.
    guarded : bool
        Whether a contact guard has watched the motion. Then bursts of noise, as of gears at the reversal of a joint,
        are no contact: only rows above `TOUCH_N` or `TOUCH_NM` are, and each row has the noise of its surroundings.
    zeroed_s : array, shape (k,)
        Times after which the sensor has another bias, all but removed from the rows. That of the load is the last.
    """
    problem = _Problem(rows, known, g_m_s2, point_mass=point_mass, zeroed_s=zeroed_s)
    # Forces alone allow several mountings: the residuals of a robust fit, with the torques, decide.
    roughs = sorted((problem.rough(start) for start in problem.starts()), key=lambda one: one[1])
    load, _ = roughs[0]
    r = rows.wrench - problem.predict(load, rows)
    kept = _untouched(r) if guarded else _first_kept(problem, load)
    effects, sizes = np.zeros(len(problem.basis)), {**ROUGH, "walk_N": 3e-3, "walk_Nm": 6e-5}
    solved = _Step.none()
    for stage in range(_STAGES):
        state = states(rows.speed_rad_s, kept)
        r = rows.wrench - problem.predict(load, rows) - problem.effect(load, rows, effects)
        absorbed = problem.absorb(load, rows[kept], solved)
        # An autoregression would take the noise of seconds before its size is chosen.
        order = ORDER if stage > _ALWAYS else 0
        noise = RowNoise.of(r[kept], absorbed, state[kept], runs(rows.t_s[kept], rows.row_s), order=order)
        if guarded:
            local = _local(r / noise.scale[state], kept)[:, None]
            place = runs(rows.t_s[kept], rows.row_s)
            noise = RowNoise.of((r / local)[kept], absorbed / local[kept][:, :, None], state[kept], place, bursts=True)
            noise, state = replace(noise, scale=noise.scale[state] * local), np.arange(len(rows))
        sums = problem.sums(load, effects, noise, kept, state)
        if stage == _ALWAYS:
            sizes = {**sizes, **EXPECTED}
        if stage in _CHOICES:
            sizes = _choose_sizes(problem, sizes, sums, load, effects)
        solved = problem.solve(sizes, sums, load, effects)
        load = load.moved(solved.step[:SIZE])
        effects = effects + problem.basis @ solved.step[SIZE:]
        r = rows.wrench - problem.predict(load, rows) - problem.effect(load, rows, effects)
        distance = np.sum((r / noise.scale[state] @ noise.root.T) ** 2, axis=1)
        kept = _untouched(r) if guarded else _without_contact(distance)
    contradiction = ""
    if prior is not None:
        if prior.has_response:
            sizes |= {"gain": np.inf, "cross_talk": np.inf}
        load, effects, solved, contradiction = _join(problem, prior, sizes, (load, effects), (noise, kept, state))
        r = rows.wrench - problem.predict(load, rows) - problem.effect(load, rows, effects)
        distance = np.sum((r / noise.scale[state] @ noise.root.T) ** 2, axis=1)
    chi2, others = problem.sums(load, effects, noise, kept, state)[2], []
    for other, _ in roughs[1:] if prior is None else ():
        if angle_between(other.static.R_flange_sensor, load.static.R_flange_sensor) > _SAME_RAD:
            there = problem.sums(other, effects, noise, kept, state)
            # What one linear step would leave at the other mounting, less the chi2 of this one.
            others.append(there[2] - float(there[1] @ problem.solve(sizes, there, other, effects).step) - chi2)
    walk, course = None, problem.hats(rows.t_s) @ problem.drift(effects)
    if sizes.get("walk_N") or sizes.get("walk_Nm"):
        last = len(problem.knots) - 1
        ends = np.zeros((6, SIZE + len(problem.basis)))
        ends[:, SIZE + 6 * last : SIZE + 6 * last + 6] += np.eye(6)
        ends[:, SIZE : SIZE + 6] -= np.eye(6)
        ends = ends @ block_diag(np.eye(SIZE), problem.basis)
        sigma = np.sqrt(np.einsum("ij,jk,ik->i", ends, solved.covariance, ends))
        drift = problem.drift(effects)
        walk = DriftResult(drift[last] - drift[0], sigma, course)
    return MotionFit(
        load=load,
        covariance=solved.covariance[:SIZE, :SIZE],
        kept=kept,
        residuals=rows.wrench - problem.predict(load, rows) - course,
        next_use=problem.next_use(load, effects, solved),
        sigma=noise.scale[state],
        distance=distance,
        drift=walk,
        mean_bias=None if walk is None else load.static.bias + course.mean(axis=0),
        components={name: size for name, size in sizes.items() if 0 < size < np.inf},
        second_basin_chi2=max(min(others), 0.0) if others else None,
        chi2=chi2,
        contradiction=contradiction,
    )


def _join(
    problem: _Problem,
    prior: CellPrior,
    sizes: Mapping[str, float],
    start: tuple[Load, Array],
    weighed: tuple[RowNoise, NDArray[np.bool_], NDArray[np.intp]],
) -> tuple[Load, Array, _Step, str]:
    """Fit rows and a prior from the load and effects of the rows alone, and name what they contradict in the prior.

    `weighed` is the noise, with the rows that count and their states, as the rows show it alone.
    """

    def fitted(kept: Sequence[int]) -> tuple[Load, Array, _Step]:
        """Fit; `kept` as of `CellPrior.rows`."""
        (load, effects), before = start, np.inf
        for _ in range(_PRIOR_STEPS):
            sums = problem.sums(load, effects, *weighed)
            known = prior.rows(load.static, load.response[: 11 * prior.has_response], kept)
            solved = problem.solve(sizes, sums, load, effects, known)
            load = load.moved(solved.step[:SIZE])
            effects = effects + problem.basis @ solved.step[SIZE:]
            if abs(before - solved.cost) < _SETTLED:
                break
            before = solved.cost
        return load, effects, solved

    load, effects, solved = fitted(WHOLE)
    alone = fitted(())[2].cost

    def refit(kept: Sequence[int]) -> tuple[float, int, Parameters]:
        load, _, solved = fitted(kept)
        return solved.cost - alone, prior.count(kept), load.static

    misfit, words = solved.cost - alone, "calibrate this tool alone, without --from"
    contradiction = prior.contradiction(misfit, prior.count(WHOLE), refit, "the rows of the recording", words)
    return load, effects, solved, contradiction


def robust_weights(residuals: Array, limit: float, *, alike: int = 3) -> tuple[Array, Array, float]:
    """Weigh rows for the next step of a robust fit, which begins with a limit of infinity and ends at `LIMIT`.

    `limit` is the squared distance of a row that counted a quarter in the step before. `alike` successive channels
    have one scale: 3 for forces and torques, 1 for each by itself. Returns the standard deviations (6,) by the median,
    the weights (n,), and the next limit.
    """
    size = np.median(np.abs(residuals).reshape(len(residuals), -1, alike), axis=(0, 2))
    scale = np.repeat(1.4826 * size + 1e-12, alike)
    distance = np.sum((residuals / scale) ** 2, axis=1)
    limit = max(min(limit, float(distance.max(initial=0.0))) / 2, LIMIT)
    return scale, (limit / (limit + distance)) ** 2, limit


def rough_delay(rows: Rows, known: Known | None, g_m_s2: float) -> float:
    """Delay of the wrench beyond that of the rows, by a robust fit."""
    problem = _Problem(rows, known, g_m_s2, point_mass=False)
    return min((problem.rough(start) for start in problem.starts()), key=lambda one: one[1])[0].delay_s


@dataclass(frozen=True, slots=True, eq=False)
class FreeFit:
    """A robust fit in which the poses may have an error."""

    load: Load
    error: PoseError
    covariance: Array
    """(37, 37) of the load, as of `Load.moved`, then of scale and aside, with what smooth errors do to them."""
    residual: Array
    """(2,) of force and torque: the median, as a standard deviation."""


def fit_freely(rows: Rows, known: Known | None, g_m_s2: float) -> FreeFit:
    """Fit load and error of the poses, robustly and with white noise, from each mounting that forces allow."""
    problem = _Problem(rows[:: max(1, len(rows) // _ROUGH_ROWS)], known, g_m_s2, point_mass=False)
    return min(
        (_freely(problem, start) for start in problem.starts()), key=lambda one: float(np.log(one.residual).sum())
    )


def _freely(problem: _Problem, load: Load) -> FreeFit:
    rows, limit = problem.rows, np.inf
    X = np.column_stack([np.ones(len(rows)), rows.motion.columns()])
    by_acceleration = np.linalg.lstsq(X, rows.wrench[:, :3], rcond=1e-9)[0][10:13]
    first = -float(np.sum(by_acceleration * load.static.R_flange_sensor)) / (3 * max(load.mass_kg, 1e-9))
    error = PoseError(first)
    for _ in range(40):
        now = error.corrected(rows)
        r = rows.wrench - problem.predict(load, now)
        scale, weight, limit = robust_weights(r, limit)
        of_load = jacobian(load, now.motion.earlier(load.delay_s, now.rate), now.rate)
        of_error = PoseError.jacobian(load, rows.motion.earlier(load.delay_s, rows.rate))
        J = np.concatenate([of_load, of_error], axis=2) / scale[:, None]
        weighted = (J * weight[:, None, None]).reshape(-1, SIZE + 3)
        precision, value = problem.prior(load)
        H = weighted.T @ J.reshape(-1, SIZE + 3) + np.diag(np.append(precision, np.zeros(3)))
        b = weighted.T @ (r / scale).ravel() - np.append(precision * value, np.zeros(3))
        known, residuals = problem.constraints.measurements(load.static)
        H[:15, :15] += known.T @ known
        b[:15] += known.T @ residuals
        basis = problem.free(load)
        # Gain and cross-talk stay 0: they would take part of a scale.
        Z = block_diag(basis[:, ~basis[GAINS.start :].any(axis=0)], np.eye(3))
        H = Z.T @ H @ Z
        size = np.sqrt(np.diag(H)) + 1e-12
        covariance = np.linalg.inv(H / np.outer(size, size) + RIDGE * np.eye(len(H))) / np.outer(size, size)
        step = Z @ covariance @ (Z.T @ b)
        load = load.moved(step[:SIZE])
        error = replace(error, scale=error.scale + float(step[SIZE]), aside_m=error.aside_m + step[SIZE + 1 :])
        if limit == LIMIT and np.abs(step[:6]).max() < 1e-6:
            break
    unseen = (problem.unseen(load, r * weight[:, None]) / scale[:, None]).reshape(6 * len(rows), -1)
    hidden = Z @ covariance @ (Z.T @ weighted.T @ unseen)
    return FreeFit(load, error, Z @ covariance @ Z.T + hidden @ hidden.T, scale[::3])


def _first_kept(problem: _Problem, load: Load) -> NDArray[np.bool_]:
    """Rows without contact, by the quiet rows of each state; at rest there is no more noise than in motion."""
    rows = problem.rows
    r = rows.wrench - problem.predict(load, rows)
    state = states(rows.speed_rad_s, np.ones(len(rows), bool))
    size = np.abs(r).reshape(-1, 2, 3)
    quiet = np.array([np.quantile(size[state == k], QUIET, axis=(0, 2)) for k in np.unique(state)])
    scale = np.minimum.accumulate(quiet[::-1], axis=0)[::-1] / ndtri((1 + QUIET) / 2) + 1e-12
    distance = np.sum((r / np.repeat(scale, 3, axis=1)[state]) ** 2, axis=1)
    return _without_contact(distance / 2)


def _untouched(residuals: Array) -> NDArray[np.bool_]:
    """Rows without contact in a motion that a guard has watched."""
    force_N, torque_Nm = (np.linalg.norm(residuals[:, k : k + 3], axis=1) for k in (0, 3))
    return _without_contact(np.where((force_N > TOUCH_N) | (torque_Nm > TOUCH_NM), np.inf, 0.0))


def _local(unit: Array, kept: NDArray[np.bool_]) -> Array:
    """Noise (n,) of each row in that of its state, from the residuals around it."""
    square, window = np.where(kept, np.mean(unit**2, axis=1), 0.0), np.ones(_AROUND)
    rows = np.convolve(kept.astype(np.float64), window, "same")
    return np.asarray(np.sqrt((_PRIOR_ROWS + np.convolve(square, window, "same")) / (_PRIOR_ROWS + rows)))


def _without_contact(distance: Array) -> NDArray[np.bool_]:
    near = distance > CONTACT
    for _ in range(MARGIN):
        near = near | np.append(near[1:], False) | np.append(False, near[:-1])
    return ~near if near.mean() < MOST_CONTACT else np.ones(len(near), bool)  # nothing fits: all is of no use alike


def _choose_sizes(
    problem: _Problem, sizes: Mapping[str, float], sums: tuple[Array, Array, float], load: Load, effects: Array
) -> dict[str, float]:
    """Choose the sizes of the components by restricted likelihood, one after the other.

    What is always part of the model has its mean square, as the data and what is expected allow it.
    """
    chosen = dict(sizes)

    def values(name: str, **others: float) -> Array:
        return problem.criteria(name, _SIZES[name], {**chosen, **others}, sums, load, effects)

    for name, tried in _SIZES.items():
        if name not in chosen:
            continue
        if name in EXPECTED:
            expected = np.exp(-np.square(np.log(tried / EXPECTED[name]) / np.log(WITHIN)) / 2)
            of_sizes = values(name)
            least = min(of_sizes.min(), 0.0)
            likely = (1 - ABSENT) * expected / expected.sum() * np.exp((least - of_sizes) / 2)
            chosen[name] = float(np.sqrt(likely @ tried**2 / (likely.sum() + ABSENT * np.exp(least / 2))))
            continue
        worth, slow = -WORTH, name.replace("walk", "slow")
        of_sizes = values(name, **{slow: 0.0})
        if name != slow:  # noise of seconds looks like a walk
            worth = min(worth, float(values(slow, **{name: 0.0}).min()))
        best = int(np.argmin(of_sizes))
        chosen[name] = float(tried[best]) if of_sizes[best] < worth else 0.0
    return chosen


def _among(H: Array, Z: Array, rest: NDArray[np.intp]) -> Array:
    """Information of what is estimated: of the load in the basis Z, and of these effects."""
    beside = Z.T @ H[:SIZE, rest]
    return np.block([[Z.T @ H[:SIZE, :SIZE] @ Z, beside], [beside.T, H[np.ix_(rest, rest)]]])


def _hats(knots: Array, t_s: Array) -> Array:
    """Weight (n, k) of each knot."""
    return np.asarray(np.maximum(1 - np.abs(t_s[:, None] - knots) / (knots[1] - knots[0]), 0))


def _on_channels(values: Array) -> Array:
    """Derivative (n, 6, 6 k) of a wrench that is the sum of values (n, k), each with weights of its own a channel."""
    return np.asarray(np.einsum("nk,ij->nikj", values, np.eye(6)).reshape(len(values), 6, -1))
