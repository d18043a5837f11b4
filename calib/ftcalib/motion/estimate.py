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
from ftcalib.known import Constraints, Known
from ftcalib.likelihood.rotation_minima import force_cost, given_rotation, minima
from ftcalib.model import Array, DriftResult, Parameters, angle_between, nearest_rotation
from ftcalib.motion.model import (
    CROSS_TALK,
    DELAY,
    GAINS,
    HEIGHT,
    INERTIA,
    SIZE,
    Load,
    PoseError,
    RowNoise,
    jacobian,
    runs,
    states,
    wrench_of,
)
from ftcalib.motion.samples import Rows
from ftcalib.published.yu import com_and_torque_bias

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
# Sizes that are tried: of the entries of gain and cross-talk, and of the walk of the bias in a second.
_SIZES: Mapping[str, Array] = {
    "gain": np.geomspace(5e-4, 5e-2, 9),
    "cross_talk": np.geomspace(5e-4, 2e-1, 11),
    "walk_N": np.geomspace(3e-4, 3e-1, 10),
    "walk_Nm": np.geomspace(6e-6, 6e-3, 10),
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
    """(n, 6) of all rows, drift included in the prediction."""
    sigma: Array
    """(n, 6) of a row's noise."""
    distance: Array
    """(n,) squared, of each residual from 0: chi2 with 6 degrees of freedom without contact."""
    drift: DriftResult | None
    """From the first row to the last, with the course of the bias minus that of the load; None without a walk."""
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
    """Rows with what is known of their load."""

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
        centred = np.linalg.svd(np.ones((1, count)))[2][1:].T  # a drift of mean 0: the bias is that of the mean
        steps = np.diff(np.eye(count), axis=0) @ centred
        self.walk = steps.T @ steps / (self.knots[1] - self.knots[0])
        self.courses = count + len(zeroed_s)
        self.centred = np.kron(block_diag(centred, np.eye(len(zeroed_s))), np.eye(6))

    def hats(self, t_s: Array) -> Array:
        """Weight (n, courses) of each knot, and of the bias before each zeroing."""
        step = self.knots[1] - self.knots[0]
        knots = np.maximum(1 - np.abs(t_s[:, None] - self.knots) / step, 0)
        return np.hstack([knots, t_s[:, None] <= self.zeroed_s]) if len(self.zeroed_s) else np.asarray(knots)

    def predict(self, load: Load, rows: Rows) -> Array:
        return wrench_of(load, rows.motion.earlier(load.delay_s, rows.rate))

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
            start = self.constraints.satisfy(Parameters(Q, F_b, bias, c, torque_bias))
            found.append(Load(start, self.g_m_s2))
        return found

    def free(self, load: Load) -> Array:
        """Basis (34, m) of what is estimated, without the response."""
        Z = block_diag(self.constraints.free(load.static), np.eye(SIZE - 15))
        return np.asarray(Z[:, ~np.concatenate([np.zeros(Z.shape[1] - (SIZE - 15), bool), self.fixed[15:]])])

    def rough(self, load: Load) -> tuple[Load, float]:
        """Fit robustly with white noise; return the load and the logarithm of its residuals' size."""
        rows = self.rows[:: max(1, len(self.rows) // _ROUGH_ROWS)]
        limit, no_drift = np.inf, np.zeros((self.courses, 6))
        nothing = np.zeros(self.centred.shape[1])
        for _ in range(40):
            r = rows.wrench - self.predict(load, rows)
            scale, weight, limit = robust_weights(r, limit)
            J = jacobian(load, rows.motion.earlier(load.delay_s, rows.rate), rows.rate) / scale[:, None]
            weighted = (J * weight[:, None, None]).reshape(-1, SIZE)
            H, b = block_diag(weighted.T @ J.reshape(-1, SIZE), np.diag(nothing)), weighted.T @ (r / scale).ravel()
            step = self.solve(ROUGH, (H, np.append(b, nothing), 0.0), load, no_drift).step
            load = load.moved(step[:SIZE])
            if limit == LIMIT and np.abs(step[:6]).max() < 1e-6:
                break
        return load, float(np.log(scale[::3]).sum())

    def sums(
        self, load: Load, drift: Array, noise: RowNoise, kept: NDArray[np.bool_], state: NDArray[np.intp]
    ) -> tuple[Array, Array, float]:
        """Information, gradient and chi2 of load and drift, over kept rows as the noise weighs them."""
        rows, order = self.rows[kept], noise.filters.shape[0] - 1
        state, place = state[kept], runs(rows.t_s, rows.row_s)
        size = SIZE + 6 * self.courses
        H, b, chi2 = np.zeros((size, size)), np.zeros(size), 0.0
        for start in range(0, len(rows), _CHUNK):
            part = slice(max(start - order, 0), start + _CHUNK)
            some, hats = rows[part], self.hats(rows.t_s[part])
            near = np.flatnonzero(hats.any(axis=0))
            r = some.wrench - self.predict(load, some) - hats @ drift
            J = jacobian(load, some.motion.earlier(load.delay_s, some.rate), some.rate)
            on_knots = np.einsum("nk,ij->nikj", hats[:, near], np.eye(6)).reshape(len(some), 6, -1)
            X = noise.whiten(np.concatenate([J, on_knots, r[:, :, None]], axis=2), state[part], place[part])
            X = X[start - part.start :].reshape(-1, X.shape[2])
            places = np.concatenate([np.arange(SIZE), SIZE + (6 * near[:, None] + np.arange(6)).ravel()])
            gram = X.T @ X
            H[np.ix_(places, places)] += gram[:-1, :-1]
            b[places] += gram[:-1, -1]
            chi2 += float(gram[-1, -1])
        T = block_diag(np.eye(SIZE), self.centred)
        return T.T @ H @ T, T.T @ b, chi2

    def absorb(self, load: Load, rows: Rows, solved: "_Step") -> Array:
        """Root (n, 6, k) of the covariance of the prediction; none before the first solution, nor for so many rows."""
        if not solved.step.size or len(rows) > _MANY:
            return np.zeros((len(rows), 6, 0))
        basis, inverse_root = solved.root
        J = jacobian(load, rows.motion.earlier(load.delay_s, rows.rate), rows.rate)
        on_knots = np.einsum("nk,ij->nikj", self.hats(rows.t_s), np.eye(6)).reshape(len(rows), 6, -1) @ self.centred
        return np.asarray(np.concatenate([J, on_knots], axis=2) @ basis @ inverse_root)

    def components(self, sizes: Mapping[str, float], load: Load) -> tuple[Array, Array, float]:
        """Prior precision of response and drift, which of them are estimated, and -log det of the precision."""
        total = SIZE + self.centred.shape[1]
        P, on, log_det = np.zeros((total, total)), np.ones(total, bool), 0.0
        for name, places in (("gain", GAINS), ("cross_talk", CROSS_TALK)):
            if size := sizes.get(name, 0.0):
                count = places.stop - places.start
                P[places, places] = np.eye(count) / size**2
                log_det += 2 * count * float(np.log(size))
            else:
                on[places] = False
        at = SIZE + np.arange(len(self.walk) * 6).reshape(-1, 6)
        for name, channels in (("walk_N", range(3)), ("walk_Nm", range(3, 6))):
            size = sizes.get(name, 0.0)
            for channel in channels:
                knots = at[:, channel]
                if size:
                    P[np.ix_(knots, knots)] = self.walk / size**2
                    log_det -= float(np.linalg.slogdet(self.walk / size**2)[1])
                else:
                    on[knots] = False
        precision, _ = self.prior(load)
        P[:SIZE, :SIZE] += np.diag(precision)
        zeroed = range(total - 6 * len(self.zeroed_s), total)
        P[zeroed, zeroed] = np.tile(1 / np.repeat([ZEROED_N, ZEROED_NM], 3) ** 2, len(self.zeroed_s))
        return P, on, log_det

    def solve(
        self,
        sizes: Mapping[str, float],
        sums: tuple[Array, Array, float],
        load: Load,
        drift: Array,
        prior: tuple[Array, Array] | None = None,
    ) -> "_Step":
        """Solve the sums for load and drift with these sizes of the components, and rows of a prior."""
        H, b, chi2 = sums
        P, on, log_det = self.components(sizes, load)
        value = np.concatenate([load.vector, self.centred.T @ drift.ravel()])
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
        Z = block_diag(self.free(load), np.eye(len(P) - SIZE))
        Z = Z[:, on[np.argmax(np.abs(Z), axis=0)]]
        H = Z.T @ H @ Z
        scale = np.sqrt(np.diag(H))
        factor = cho_factor(H / np.outer(scale, scale) + RIDGE * np.eye(len(H)))
        step = Z @ (cho_solve(factor, Z.T @ b / scale) / scale)
        cost = chi2 + float(value @ P @ value + residuals @ residuals - b @ step)
        criterion = cost + log_det
        criterion += 2 * float(np.log(np.diag(factor[0]) * scale).sum())
        return _Step(step + removed, cost, criterion, Z / scale, factor)


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
    drift, sizes = np.zeros((problem.courses, 6)), {**ROUGH, "walk_N": 3e-3, "walk_Nm": 6e-5}
    solved = _Step.none()
    for stage in range(_STAGES):
        state = states(rows.speed_rad_s, kept)
        r = rows.wrench - problem.predict(load, rows) - problem.hats(rows.t_s) @ drift
        absorbed = problem.absorb(load, rows[kept], solved)
        noise = RowNoise.of(r[kept], absorbed, state[kept], runs(rows.t_s[kept], rows.row_s))
        if guarded:
            local = _local(r / noise.scale[state], kept)[:, None]
            place = runs(rows.t_s[kept], rows.row_s)
            noise = RowNoise.of((r / local)[kept], absorbed / local[kept][:, :, None], state[kept], place, bursts=True)
            noise, state = replace(noise, scale=noise.scale[state] * local), np.arange(len(rows))
        sums = problem.sums(load, drift, noise, kept, state)
        if stage in _CHOICES:
            sizes = _choose_sizes(problem, sizes, sums, load, drift)
        solved = problem.solve(sizes, sums, load, drift)
        load = load.moved(solved.step[:SIZE])
        drift = drift + (problem.centred @ solved.step[SIZE:]).reshape(-1, 6)
        r = rows.wrench - problem.predict(load, rows) - problem.hats(rows.t_s) @ drift
        distance = np.sum((r / noise.scale[state] @ noise.root.T) ** 2, axis=1)
        kept = _untouched(r) if guarded else _without_contact(distance)
    contradiction = ""
    if prior is not None:
        if prior.has_response:
            sizes |= {"gain": np.inf, "cross_talk": np.inf}
        load, drift, solved, contradiction = _join(problem, prior, sizes, (load, drift), (noise, kept, state))
        r = rows.wrench - problem.predict(load, rows) - problem.hats(rows.t_s) @ drift
        distance = np.sum((r / noise.scale[state] @ noise.root.T) ** 2, axis=1)
    chi2, others = problem.sums(load, drift, noise, kept, state)[2], []
    for other, _ in roughs[1:] if prior is None else ():
        if angle_between(other.static.R_flange_sensor, load.static.R_flange_sensor) > _SAME_RAD:
            there = problem.sums(other, drift, noise, kept, state)
            # What one linear step would leave at the other mounting, less the chi2 of this one.
            others.append(there[2] - float(there[1] @ problem.solve(sizes, there, other, drift).step) - chi2)
    walk = None
    if sizes.get("walk_N") or sizes.get("walk_Nm"):
        last = len(problem.knots) - 1
        ends = np.zeros((6, SIZE + 6 * problem.courses))
        ends[:, SIZE + 6 * last : SIZE + 6 * last + 6] += np.eye(6)
        ends[:, SIZE : SIZE + 6] -= np.eye(6)
        ends = ends @ block_diag(np.eye(SIZE), problem.centred)
        sigma = np.sqrt(np.einsum("ij,jk,ik->i", ends, solved.covariance, ends))
        walk = DriftResult(drift[last] - drift[0], sigma, problem.hats(rows.t_s) @ drift)
    return MotionFit(
        load=load,
        covariance=solved.covariance[:SIZE, :SIZE],
        kept=kept,
        residuals=r,
        sigma=noise.scale[state],
        distance=distance,
        drift=walk,
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
    """Fit rows and a prior from the load and drift of the rows alone, and name what they contradict in the prior.

    `weighed` is the noise, with the rows that count and their states, as the rows show it alone.
    """

    def fitted(kept: Sequence[int]) -> tuple[Load, Array, _Step]:
        """Fit; `kept` as of `CellPrior.rows`."""
        (load, drift), before = start, np.inf
        for _ in range(_PRIOR_STEPS):
            sums = problem.sums(load, drift, *weighed)
            known = prior.rows(load.static, load.response[: 11 * prior.has_response], kept)
            solved = problem.solve(sizes, sums, load, drift, known)
            load = load.moved(solved.step[:SIZE])
            drift = drift + (problem.centred @ solved.step[SIZE:]).reshape(-1, 6)
            if abs(before - solved.cost) < _SETTLED:
                break
            before = solved.cost
        return load, drift, solved

    load, drift, solved = fitted(WHOLE)
    alone = fitted(())[2].cost

    def refit(kept: Sequence[int]) -> tuple[float, int, Parameters]:
        load, _, solved = fitted(kept)
        return solved.cost - alone, prior.count(kept), load.static

    misfit, words = solved.cost - alone, "calibrate this tool alone, without --from"
    contradiction = prior.contradiction(misfit, prior.count(WHOLE), refit, "the rows of the recording", words)
    return load, drift, solved, contradiction


def robust_weights(residuals: Array, limit: float, *, alike: int = 3) -> tuple[Array, Array, float]:
    """Weigh rows for the next step of a robust fit, which begins with a limit of infinity and ends at `LIMIT`.

    Parameters
    ----------
    residuals : array, shape (n, 6)
    limit : float
        Squared distance of a row that counted a quarter in the step before.
    alike : {3, 1}
        Successive channels that have one scale: forces and torques, or each by itself.

    Returns
    -------
    scale : array, shape (6,)
        Standard deviations by the median.
    weight : array, shape (n,)
    limit : float
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
    """(37, 37) of the load, as of `Load.moved`, then of scale and aside."""
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
    return FreeFit(load, error, Z @ covariance @ Z.T, scale[::3])


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
    problem: _Problem, sizes: Mapping[str, float], sums: tuple[Array, Array, float], load: Load, drift: Array
) -> dict[str, float]:
    """Choose the sizes of the components by restricted likelihood, one after the other."""
    chosen = dict(sizes)
    for name, tried in _SIZES.items():
        values = [problem.solve({**chosen, name: size}, sums, load, drift).criterion for size in (0.0, *tried)]
        best = int(np.argmin(values[1:]))
        chosen[name] = float(tried[best]) if values[1 + best] < values[0] - WORTH else 0.0
    return chosen
