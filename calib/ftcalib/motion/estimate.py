"""Gauss-Newton fit of a moving load: started from each mounting that the forces allow, rows in contact left out.

Each stage solves the normal equations of `ftcalib.motion.problem`, with the noise and the rows without contact from the
previous stage. Some stages also choose the standard deviations of the components: those of walk, gain and cross-talk by
restricted likelihood, those of `EXPECTED` by their posterior mean square (log-normal prior with a probability of 0).
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag
from scipy.special import chdtri as chi2_isf
from scipy.special import ndtri

from ftcalib.after.new_tool import WHOLE, CellPrior
from ftcalib.known import Known
from ftcalib.model import Array, DriftResult, Parameters, angle_between
from ftcalib.motion.model import (
    GAINS,
    ORDER,
    SIZE,
    MovingLoad,
    PoseError,
    RowNoise,
    motion_jacobian,
    motion_states,
    places_in_runs,
)
from ftcalib.motion.problem import DELAY_S, EXPECTED, GYRATION_M, HEIGHT_M, NEVER, RIDGE, ROUGH_ROWS, Problem, Solution
from ftcalib.motion.samples import MotionRows

# Squared Mahalanobis distance above which a row is taken for contact.
_CONTACT = float(chi2_isf(6, 1e-7))
# Smallest force or torque residual of a row in contact, in a motion with a contact guard.
TOUCH_N, TOUCH_NM = 2.0, 0.2
# Share of the rows of each state of motion, those with the smallest residuals, that are assumed to have no contact.
QUIET = 0.4
# Largest share of rows in contact; if there are more, the model itself does not fit.
_MOST_CONTACT = 0.8
# Number of rows left out on both sides of a contact, because the filter spreads the contact.
_MARGIN = 2
# A component of the noise model is kept if it lowers -2 log restricted likelihood by at least this much.
_WORTH = 4.0

# Initial standard deviations of gain and cross-talk.
_ROUGH: Mapping[str, float] = {"gain": 0.02, "cross_talk": 0.02}
_SAME_RAD = 0.2
# Local noise: window of its moving average, and weight of the mean noise of the state as a prior, both in rows.
_AROUND, _PRIOR_ROWS = 3, 1.0
# Largest number of steps of the fit with a prior, and the change of its cost at which the fit has converged.
_PRIOR_STEPS, _SETTLED = 20, 1e-4
# Number of stages of the fit, and the stages that begin by choosing the sizes of the components.
_STAGES, _CHOICES = 6, (1, 2, 4)
# First stage of the fit whose model has the components of `EXPECTED`. Earlier, they would absorb contacts.
_ALWAYS = 1
# Candidate standard deviations of each component; of a walk, the change of the bias per square root of a second.
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
# Prior of a standard deviation: probability that it is 0, and one sigma of its logarithm otherwise, as a factor.
_ABSENT, _WITHIN = 0.7, 3.0
# Final limit of the robust fit: a row at this squared distance has the weight 1/4.
LIMIT = 22.0


@dataclass(frozen=True, slots=True, eq=False)
class MotionFit:
    """Best fit of a moving load to the rows of a recording."""

    load: MovingLoad
    covariance: Array
    """(34, 34) covariance of the error vector of `MovingLoad.moved`."""
    kept: NDArray[np.bool_]
    """(n,) whether a row is free of contact, so that the fit uses it."""
    residuals: Array
    """(n, 6) measured minus predicted wrench of all rows; the prediction has the drift, but no other random effect."""
    next_use: Array
    """(2,) rms error of compensating a free tool at rest in the recorded orientations, N and N·m."""
    sigma: Array
    """(n, 6) standard deviation of the noise of each row, N and N·m."""
    distance: Array
    """(n,) squared Mahalanobis distance of each residual: chi-square with 6 degrees of freedom without contact."""
    drift: DriftResult | None
    """Drift of the bias; `course` is relative to the last bias, which is that of `load`. None without a random walk."""
    mean_bias: Array | None = None
    """(6,) mean of the bias over the rows, N and N·m; None without drift."""
    components: Mapping[str, float] = field(default_factory=dict)
    """Standard deviations of the components of the noise model, by name and unit."""
    second_basin_chi2: float | None = None
    """Increase of chi2 at the second best mounting; None if there is no other."""
    chi2: float = 0.0
    """Chi2 of the whitened residuals of the kept rows: about 6 per row."""
    contradiction: str = ""
    """Sentence naming the contradiction between rows and prior; empty if they agree."""

    @property
    def prior_share(self) -> Array:
        """(8,) ratio of posterior to prior standard deviation, for inertia (6), height and delay."""
        expected = np.r_[np.full(6, max(self.load.mass_kg, 0.1) * GYRATION_M**2), HEIGHT_M, DELAY_S]
        return np.asarray(np.sqrt(np.diag(self.covariance)[15:23]) / expected)


def fit_motion(
    rows: MotionRows,
    known: Known | None,
    g_m_s2: float,
    *,
    prior: CellPrior | None = None,
    point_mass: bool = False,
    guarded: bool = False,
    zeroed_s: Array = NEVER,
) -> MotionFit:
    """Fit a load, the drift of the bias and other random effects to the rows of a motion.

    Parameters
    ----------
    known : Known, optional
        Known values, as in `ftcalib.solve`.
    prior : CellPrior, optional
        Earlier calibration of the cell, added after the last stage, so a wrong prior causes no row to be left out.
    point_mass : bool
        Whether the inertia about the centre of mass is known to be 0.
    guarded : bool
        Whether a contact guard watched the motion. Then bursts of noise, for example from gears where a joint
        reverses, are not taken for contact: only rows with residuals above `TOUCH_N` or `TOUCH_NM` are, and the noise
        of each row is estimated from its neighbours.
    zeroed_s : array, shape (k,)
        Times at which the sensor was zeroed. The rows are nearly free of these steps; the bias of `load` is the last.
    """
    problem = Problem(rows, known, g_m_s2, point_mass=point_mass, zeroed_s=zeroed_s)
    # Forces alone allow several mountings: the robust fit of forces and torques with the smallest residuals is chosen.
    roughs = sorted((_rough(problem, start) for start in problem.starts()), key=lambda rough: rough[1])
    load, _ = roughs[0]
    r = rows.wrench - problem.predict(load, rows)
    kept = _untouched(r) if guarded else _first_kept(problem, load)
    effects, sizes = np.zeros(len(problem.basis)), {**_ROUGH, "walk_N": 3e-3, "walk_Nm": 6e-5}
    solved = Solution.none()
    for stage in range(_STAGES):
        state = motion_states(rows.speed_rad_s, kept)
        r = problem.residuals(load, effects)
        absorbed = problem.absorb(load, rows[kept], solved)
        # In the first stages no autoregression: it would absorb the slow noise, whose size is chosen later.
        order = ORDER if stage > _ALWAYS else 0
        noise = RowNoise.of(r[kept], absorbed, state[kept], places_in_runs(rows.t_s[kept], rows.row_s), order=order)
        if guarded:
            local = _local_noise(r / noise.scale[state], kept)[:, None]
            place = places_in_runs(rows.t_s[kept], rows.row_s)
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
        r = problem.residuals(load, effects)
        distance = np.sum((r / noise.scale[state] @ noise.root.T) ** 2, axis=1)
        kept = _untouched(r) if guarded else _without_contact(distance)
    contradiction = ""
    if prior is not None:
        if prior.has_response:
            sizes |= {"gain": np.inf, "cross_talk": np.inf}
        load, effects, solved, contradiction = _join(problem, prior, sizes, (load, effects), (noise, kept, state))
        r = problem.residuals(load, effects)
        distance = np.sum((r / noise.scale[state] @ noise.root.T) ** 2, axis=1)
    chi2, others = problem.sums(load, effects, noise, kept, state)[2], []
    for other, _ in roughs[1:] if prior is None else ():
        if angle_between(other.static.R_flange_sensor, load.static.R_flange_sensor) > _SAME_RAD:
            there = problem.sums(other, effects, noise, kept, state)
            # Chi2 of the other mounting after one linear step, minus chi2 of the fitted mounting.
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
    problem: Problem,
    prior: CellPrior,
    sizes: Mapping[str, float],
    start: tuple[MovingLoad, Array],
    weighed: tuple[RowNoise, NDArray[np.bool_], NDArray[np.intp]],
) -> tuple[MovingLoad, Array, Solution, str]:
    """Fit rows and prior together, starting from the fit of the rows alone; also return how they contradict the prior.

    `weighed` holds the noise, the kept rows and the states of motion, as determined from the rows alone.
    """

    def fitted(kept: Sequence[int]) -> tuple[MovingLoad, Array, Solution]:
        """Fit with the prior. Return the load, its other effects and the solution; `kept` is as in `CellPrior.rows`."""
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
    contradiction = prior.contradiction(misfit, prior.count(WHOLE), refit, "the data of the recording", words)
    return load, effects, solved, contradiction


def _rough(problem: Problem, load: MovingLoad) -> tuple[MovingLoad, float]:
    """Fit a load robustly, with white noise; return it and the sum of the logarithms of the residual scales."""
    rows = problem.rows[:: max(1, len(problem.rows) // ROUGH_ROWS)]
    limit, size = np.inf, SIZE + problem.basis.shape[1]
    no_effects, H, b = np.zeros(len(problem.basis)), np.zeros((size, size)), np.zeros(size)
    for _ in range(40):
        r = rows.wrench - problem.predict(load, rows)
        scale, weight, limit = robust_weights(r, limit)
        J = motion_jacobian(load, rows.motion.earlier(load.delay_s, rows.rate), rows.rate) / scale[:, None]
        weighted = (J * weight[:, None, None]).reshape(-1, SIZE)
        H[:SIZE, :SIZE], b[:SIZE] = weighted.T @ J.reshape(-1, SIZE), weighted.T @ (r / scale).ravel()
        step = problem.solve(_ROUGH, (H, b, 0.0), load, no_effects).step
        load = load.moved(step[:SIZE])
        if limit == LIMIT and np.abs(step[:6]).max() < 1e-6:
            break
    return load, float(np.log(scale[::3]).sum())


def robust_weights(residuals: Array, limit: float, *, alike: int = 3) -> tuple[Array, Array, float]:
    """Return scales (6,), weights (n,) and the next limit of a robust fit, for the residuals (n, 6) of its last step.

    A row whose squared distance equals the limit has weight 1/4. The fit starts with an infinite `limit` and ends at
    `LIMIT`. The scales are standard deviations from the median; `alike` successive channels share one: 3 for one
    scale of the forces and one of the torques, 1 for a scale of each channel.
    """
    size = np.median(np.abs(residuals).reshape(len(residuals), -1, alike), axis=(0, 2))
    scale = np.repeat(1.4826 * size + 1e-12, alike)
    distance = np.sum((residuals / scale) ** 2, axis=1)
    limit = max(min(limit, float(distance.max(initial=0.0))) / 2, LIMIT)
    return scale, (limit / (limit + distance)) ** 2, limit


def rough_delay(rows: MotionRows, known: Known | None, g_m_s2: float) -> float:
    """Return the delay of the wrench in addition to that of the rows, s, from a robust fit."""
    problem = Problem(rows, known, g_m_s2, point_mass=False)
    return min((_rough(problem, start) for start in problem.starts()), key=lambda rough: rough[1])[0].delay_s


@dataclass(frozen=True, slots=True, eq=False)
class FreeFit:
    """Robust fit of a moving load and of an error of the recorded poses (`PoseError`)."""

    load: MovingLoad
    error: PoseError
    covariance: Array
    """(37, 37) covariance of the errors of `MovingLoad.moved`, scale and lateral offset, including smooth errors."""
    residual: Array
    """(2,) standard deviation of the force and torque residuals, from their median, N and N·m."""


def fit_freely(rows: MotionRows, known: Known | None, g_m_s2: float) -> FreeFit:
    """Fit a load and an error of the poses, robustly and with white noise, from each mounting that the forces allow."""
    problem = Problem(rows[:: max(1, len(rows) // ROUGH_ROWS)], known, g_m_s2, point_mass=False)
    return min(
        (_freely(problem, start) for start in problem.starts()), key=lambda free: float(np.log(free.residual).sum())
    )


def _freely(problem: Problem, load: MovingLoad) -> FreeFit:
    rows, limit = problem.rows, np.inf
    X = np.column_stack([np.ones(len(rows)), rows.motion.columns()])
    by_acceleration = np.linalg.lstsq(X, rows.wrench[:, :3], rcond=1e-9)[0][10:13]
    first = -float(np.sum(by_acceleration * load.static.R_flange_sensor)) / (3 * max(load.mass_kg, 1e-9))
    error = PoseError(first)
    for _ in range(40):
        now = error.corrected(rows)
        r = rows.wrench - problem.predict(load, now)
        scale, weight, limit = robust_weights(r, limit)
        of_load = motion_jacobian(load, now.motion.earlier(load.delay_s, now.rate), now.rate)
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
        # Gain and cross-talk stay 0, because they would absorb part of the scale.
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


def _first_kept(problem: Problem, load: MovingLoad) -> NDArray[np.bool_]:
    """Return which rows (n,) have no contact, judged by the quiet rows of each state of motion.

    A slower state is assumed to have no more noise than a faster one.
    """
    rows = problem.rows
    r = rows.wrench - problem.predict(load, rows)
    state = motion_states(rows.speed_rad_s, np.ones(len(rows), bool))
    size = np.abs(r).reshape(-1, 2, 3)
    quiet = np.array([np.quantile(size[state == k], QUIET, axis=(0, 2)) for k in np.unique(state)])
    scale = np.minimum.accumulate(quiet[::-1], axis=0)[::-1] / ndtri((1 + QUIET) / 2) + 1e-12
    distance = np.sum((r / np.repeat(scale, 3, axis=1)[state]) ** 2, axis=1)
    return _without_contact(distance / 2)


def _untouched(residuals: Array) -> NDArray[np.bool_]:
    """Return which rows (n,) have no contact, in a motion with a contact guard."""
    force_N, torque_Nm = (np.linalg.norm(residuals[:, k : k + 3], axis=1) for k in (0, 3))
    return _without_contact(np.where((force_N > TOUCH_N) | (torque_Nm > TOUCH_NM), np.inf, 0.0))


def _local_noise(unit: Array, kept: NDArray[np.bool_]) -> Array:
    """Return the noise (n,) of each row relative to the noise of its state, from the neighbouring residuals."""
    square, window = np.where(kept, np.mean(unit**2, axis=1), 0.0), np.ones(_AROUND)
    rows = np.convolve(kept.astype(np.float64), window, "same")
    return np.asarray(np.sqrt((_PRIOR_ROWS + np.convolve(square, window, "same")) / (_PRIOR_ROWS + rows)))


def _without_contact(distance: Array) -> NDArray[np.bool_]:
    near = distance > _CONTACT
    for _ in range(_MARGIN):
        near = near | np.append(near[1:], False) | np.append(False, near[:-1])
    return ~near if near.mean() < _MOST_CONTACT else np.ones(len(near), bool)  # then the model is wrong: keep all


def _choose_sizes(
    problem: Problem, sizes: Mapping[str, float], sums: tuple[Array, Array, float], load: MovingLoad, effects: Array
) -> dict[str, float]:
    """Return the standard deviations of the components, chosen one after the other by restricted likelihood.

    The components of `EXPECTED` get their posterior root mean square instead.
    """
    chosen = dict(sizes)

    def values(name: str, **others: float) -> Array:
        return problem.criteria(name, _SIZES[name], {**chosen, **others}, sums, load, effects)

    for name, tried in _SIZES.items():
        if name not in chosen:
            continue
        if name in EXPECTED:
            expected = np.exp(-np.square(np.log(tried / EXPECTED[name]) / np.log(_WITHIN)) / 2)
            of_sizes = values(name)
            least = min(of_sizes.min(), 0.0)
            likely = (1 - _ABSENT) * expected / expected.sum() * np.exp((least - of_sizes) / 2)
            chosen[name] = float(np.sqrt(likely @ tried**2 / (likely.sum() + _ABSENT * np.exp(least / 2))))
            continue
        worth, slow = -_WORTH, name.replace("walk", "slow")
        of_sizes = values(name, **{slow: 0.0})
        if name != slow:  # a walk must explain more than slow noise does
            worth = min(worth, float(values(slow, **{name: 0.0}).min()))
        best = int(np.argmin(of_sizes))
        chosen[name] = float(tried[best]) if of_sizes[best] < worth else 0.0
    return chosen
