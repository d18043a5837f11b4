"""Maximum likelihood: joint weighted least squares of forces and torques, under the noise the data show.

The objective is the restricted likelihood at the best parameters, less what each component of the noise and each
rejected pose must bring. The descent starts from all minima of the force cost. Then the fit improves parameters,
variances, components and rejected poses in turn, until nothing changes.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag
from scipy.special import chdtr as chi2_cdf
from scipy.special import chdtri as chi2_isf
from scipy.special import fdtri as f_ppf

from calib.errors import NotObservable
from calib.known import Constraints, Known
from calib.likelihood.descent import MAX_STEPS, Descent, Minimum, column_scale
from calib.likelihood.gain_and_cross_talk import SIZE, Response, response_columns
from calib.likelihood.outliers import (
    FALSE_REJECTION,
    FARTHEST,
    FEWEST_TO_REJECT_FROM,
    Kept,
    agreeing_poses,
    fewest_kept,
)
from calib.likelihood.session_noise import Noise, summed_products
from calib.likelihood.sufficient_statistics import Statistics, coefficients, features
from calib.likelihood.variance_components import (
    FORCE,
    RESPONSE,
    ROTATION,
    TORQUE,
    WORTH_A_TRY,
    Component,
    Linearised,
    Point,
    component,
    estimates_of_unknown_variances,
    left_out,
    maximise,
    noise_of,
    point,
    predicted_gains,
    select,
    squared_length,
    with_slopes_instead,
    with_walks_instead,
)
from calib.model import STANDARD_GRAVITY_M_S2, Array, Parameters, jacobian, predict

Drift = Literal["auto", "none", "linear", "random-walk"]

RANK_TOLERANCE = 1e-9
LEVER_M = 0.025  # usual ratio of torque noise to force noise
FEW_POSES = 6  # fewer cannot separate force noise from torque noise: the usual ratio is taken
FEW_POSES_FOR_RESPONSE = 7  # fewer cannot separate gain and cross-talk from noise
FEW_POSES_WITHOUT_NOISE = 12  # fewer cannot separate drift from unknown noise
POSES_FOR_EACH_AXIS = 50  # fewer cannot separate the drifts of the axes of a group
MANY_POSES = 20_000  # from here on single poses are looked at only when chi2 or `drift` asks for it
FLOOR = 1e-3  # of the residuals: the least white noise where it was not measured
POSES_FOR_THE_SHAPE = 500  # fewer do not show that poses are bumped by the shape of the distribution
SUSPICIOUS = 0.01  # p-value below which more than the measured noise is looked for
LIGHT_TAIL = 0.6  # the median of squared distances relative to their mean, in units of what Gaussian noise has
ROUNDS = 20  # of the outer loop; it ends after a few
SETTLED = 1e-4  # squared step, in standard deviations of the estimates
MEDIAN_DISTANCE = float(chi2_isf(6, 0.5))


@dataclass(frozen=True, slots=True, eq=False)
class DriftEstimate:
    """How the bias moved."""

    change: Array
    """(6,) bias at the last pose minus bias at the first, N and N·m."""
    sigma: Array
    """(6,) standard deviation of that."""
    bias: Array
    """(n, 6) bias of each pose minus the mean bias, in the order of the poses given."""


@dataclass(frozen=True, eq=False)
class Fit:
    """Estimates and everything needed to judge them. Rejected poses count nowhere but in arrays with n rows."""

    parameters: Parameters
    """With drift the biases are the mean over the poses."""
    information: Array
    """(15, 15) Fisher information of the error coordinates `PARAMETER_NAMES`, priors included."""
    free: Array
    """(15, m) orthonormal basis of what is not exactly known: the identity without a `Known`."""
    minima: tuple[Minimum, ...]
    """By ascending chi2, R_flange_sensor at least 1° apart; the first is the answer."""
    chi2: float
    """Under the noise model: measured or estimated white noise plus `components`. About dof by construction."""
    dof: int
    measured_chi2: float
    """The same poses, best fit without drift, weighted by the measured noise alone; NaN without it."""
    weights: Array
    """(n,) 1 = used, 0 = rejected because it does not fit the others."""
    components: Mapping[str, float]
    """Standard deviations of what was found, by name and unit: beyond the measured noise, or all of the noise
    where it was not measured. A `walk` is per mean interval between poses, a `slope` per session."""
    drift: DriftEstimate | None
    noise: Noise
    """Covariance of all wrenches under the noise model, poses in the order of `order`."""
    order: NDArray[np.intp]
    """(n,) row numbers by time."""
    R_base_flange: Array
    """(n, 3, 3)"""
    wrench: Array
    """(n, 6)"""
    given_noise: Array
    """(15, 15) covariance of the parameters if the noise model is taken as known."""
    covariance: Array
    """(15, 15) zero along what is exactly known; without meaning where the information lacks rank."""
    response: Response | None
    """Gain and cross-talk of the sensor, best linear prediction; None where none was found."""

    @property
    def wrench_cov(self) -> Array:
        """(n, 6, 6) noise of each pose by itself, without drift."""
        cov = np.empty_like(self.noise.D)
        cov[self.order] = self.noise.D
        return cov

    @property
    def second_basin_chi2(self) -> float | None:
        """How much worse the second best minimum fits: it is right with the odds exp(-half of this). None: no other.

        Where white noise was estimated from the same residuals a larger one makes up for part of the difference.
        """
        if len(self.minima) == 1:
            return None
        best, second = self.minima[0].chi2, self.minima[1].chi2
        if any(name.startswith("white") for name in self.components):
            return float(self.dof * np.log(second / best))
        return second - best

    @cached_property
    def residuals(self) -> Array:
        """(n, 6) measured minus predicted, gain and cross-talk included, drift not."""
        added = 0.0 if self.response is None else self.response.wrench(self.parameters, self.R_base_flange)
        return np.asarray(self.wrench - predict(self.parameters, self.R_base_flange) - added)

    @cached_property
    def _pass(self) -> tuple[Array, Array, Array]:
        """One pass over the poses: left-out residuals, their covariance, and the normal equations (27, 27).

        These are of the 15 parameters, the residual and the 11 numbers of gain and cross-talk.
        """
        e, S, G = np.empty((len(self.order), 6)), np.empty((len(self.order), 6, 6)), np.zeros((27, 27))
        for part, noise in self.noise.parts():
            rows = self.order[part]
            R = self.R_base_flange[rows]
            r = self.wrench[rows] - predict(self.parameters, R)
            X = np.concatenate(
                [jacobian(self.parameters, R), r[..., None], response_columns(self.parameters, R)], axis=2
            )
            WX = noise.solve(X)
            G += summed_products(X, WX)
            # With a prior the best parameters leave some of J' W r.
            e[rows], S[rows] = left_out(noise, WX[..., :15], WX[..., 15], self.given_noise)
        return e, S, G

    @cached_property
    def gain_sigma(self) -> float:
        """Standard deviation of the entries of the gain: as found, else what the data leave room for, by moments."""
        if "gain" in self.components or len(self.weights) < FEW_POSES_FOR_RESPONSE:
            return self.components.get("gain", 0.0)
        G, own = self._pass[2], slice(16, 21)
        Tu, M = G[own, 15], G[own, own] - G[own, :15] @ self.given_noise @ G[:15, own]
        excess = float(Tu @ np.linalg.lstsq(M, Tu, rcond=1e-9)[0]) - len(M)
        return float(np.sqrt(max(excess, 0.0) / np.trace(M)))

    @property
    def left_out_residuals(self) -> Array:
        """(n, 6) measured minus what all other poses predict for this one, drift and correlation included."""
        return self._pass[0]

    @property
    def left_out_cov(self) -> Array:
        """(n, 6, 6) covariance of these: noise of the pose and uncertainty of its prediction."""
        return self._pass[1]


def fit(
    R_base_flange: Array,
    wrench: Array,
    wrench_cov: Array | None = None,
    *,
    t_s: Array | None = None,
    drift: Drift = "auto",
    known: Known | None = None,
    g_m_s2: float = STANDARD_GRAVITY_M_S2,
) -> Fit:
    """Fit all 15 parameters and, where the likelihood rises enough, components of the noise.

    Parameters
    ----------
    R_base_flange : array, shape (n, 3, 3)
        Rotations, not checked again.
    wrench : array, shape (n, 6)
        N and N·m, in the sensor frame.
    wrench_cov : array, shape (n, 6, 6) or (6, 6), or None
        Covariance of each pose's wrench, or of all of them. Without it one standard deviation for all forces and one
        for all torques are estimated; from fewer than six poses a single one for both.
    t_s : array, shape (n,), optional
        When each pose was taken; without it, or with NaN in it, their order counts.
    drift : {"auto", "none", "linear", "random-walk"}
        How the bias may move: "auto": the restricted likelihood decides. The others: not at all, or always.
    known : Known, optional
    g_m_s2 : float
        Only to turn a known mass into a weight.

    Raises
    ------
    NotObservable
        The lowest point reached is not a minimum. Poor information is not refused here: see `Fit.information`.
    """
    return _Problem(R_base_flange, wrench, wrench_cov, t_s, drift, Constraints(known or Known(), g_m_s2)).solve()


@dataclass(frozen=True, slots=True, eq=False)
class _Explanation:
    """One way to explain the data: which poses belong together, and what acts on them."""

    parameters: Parameters
    kept: Kept
    components: tuple[Component, ...] = ()
    theta: Array = field(default_factory=lambda: np.zeros(0))
    criterion: float = np.inf
    """-2 log restricted likelihood, plus what each component and each rejected pose must bring."""
    noticed: bool = False
    """Whether bumped poses may be hidden in it."""
    noise: Noise | None = None
    """At the parameters."""

    @property
    def noise_moves(self) -> bool:
        """Whether the noise depends on the parameters."""
        return not {"rotation", "gain", "cross_talk"}.isdisjoint(c.kind for c in self.components)


class _Problem:
    def __init__(
        self,
        R_base_flange: Array,
        wrench: Array,
        wrench_cov: Array | None,
        t_s: Array | None,
        drift: Drift,
        constraints: Constraints,
    ) -> None:
        self.n = len(wrench)
        self.given = R_base_flange, wrench
        self.drift, self.constraints = drift, constraints
        self.measured = wrench_cov is not None
        self.order = np.arange(self.n)
        self.time = np.arange(self.n, dtype=np.float64)
        if t_s is not None and not np.isnan(t_s).any() and np.ptp(t_s) > 0:
            self.order = np.argsort(t_s, kind="stable")
            self.time = (t_s[self.order] - t_s.min()) * (self.n - 1) / np.ptp(t_s)
        ordered = bool((self.order[1:] > self.order[:-1]).all())
        self.R, self.wrench = (x if ordered else x[self.order] for x in self.given)
        cov = _white(*self._least()) if wrench_cov is None else np.asarray(wrench_cov, dtype=np.float64)
        common = cov.ndim == 2
        self.cov = np.broadcast_to(cov, (self.n, 6, 6)) if common else cov if ordered else cov[self.order]
        self.descent = Descent(self.R, self.wrench, constraints)
        self.everything = np.ones(self.n, bool)

    def solve(self) -> Fit:
        weights = _inverses(self.cov if self.measured else np.broadcast_to(_white(1.0, LEVER_M), self.cov.shape))
        minima = self.descent.minima(weights)
        plain = _Explanation(minima[0].parameters, self.everything)
        if self._lacks_rank(minima[0]):
            return self._fit(plain, minima, minima[0].chi2)
        if self._exact(minima[0].parameters):
            minima = self.descent.minima(_inverses(self.cov))
            return self._fit(plain, minima, minima[0].chi2)
        if not self.measured:
            self.cov = self._least_noise(minima[0].parameters)
        if self._is_quiet(minima[0]):
            return self._fit(plain, minima, minima[0].chi2)
        chosen = min(self._explanations(minima, weights), key=lambda e: e.criterion)
        static = minima if chosen.kept.all() else self.descent.minima(weights * chosen.kept[:, None, None])
        for _ in range(len(static)):
            found = self._with_all_minima(chosen, static)
            if self.descent.same(found[0].parameters, chosen.parameters):
                break
            other = self._explained(found[0].parameters, chosen.kept)
            if other.criterion > chosen.criterion:
                break
            chosen = other
        return self._fit(chosen, found, static[0].chi2)

    def _dof(self, kept: Kept) -> int:
        return 6 * int(kept.sum()) - 15 + self.constraints.dof - (6 if self.drift == "linear" else 0)

    def _lacks_rank(self, minimum: Minimum) -> bool:
        Z = self.constraints.free(minimum.parameters)
        H = Z.T @ minimum.information @ Z
        scale = column_scale(H)
        eigenvalues = np.linalg.eigvalsh(H / np.outer(scale, scale))
        return bool(eigenvalues[0] < RANK_TOLERANCE * eigenvalues[-1]) or self._dof(np.ones(self.n, bool)) <= 0

    def _least(self) -> tuple[float, float]:
        """Noise of data that have none: their rounding."""
        least_N = 1e-12 * float(np.abs(self.wrench[:, :3]).max())
        return least_N, LEVER_M * least_N

    def _exact(self, p: Parameters) -> bool:
        if self.measured:
            return False
        residuals = self.wrench - predict(p, self.R)
        return float(np.abs(residuals[:, :3]).max()) < 100 * self._least()[0]

    def _least_noise(self, p: Parameters) -> Array:
        """Give a small share of the residuals, so that a random walk never explains them all."""
        e = self.wrench - predict(p, self.R)
        force_N, torque_Nm = (FLOOR * float(np.sqrt(np.mean(e[:, c] ** 2))) for c in (slice(0, 3), slice(3, 6)))
        least_N, least_Nm = self._least()
        return np.broadcast_to(_white(max(force_N, least_N), max(torque_Nm, least_Nm)), self.cov.shape)

    # Explanations

    def _is_quiet(self, best: Minimum) -> bool:
        """Whether the measured noise explains everything, so that nothing more would be found."""
        always, candidates = self._always(), self._candidates()
        if not self.measured or always or self.drift == "linear":
            return False
        if best.chi2 > float(chi2_isf(self._dof(self.everything), SUSPICIOUS)):
            return False
        if self.n > MANY_POSES and self.drift == "none":
            return True  # a pose that could do harm among so many would show in chi2
        problem = self._linearised(best.parameters, self.everything)
        at = maximise(problem, (), np.zeros(0))
        if self._stand_out(squared_length(*at.left_out())):
            return False
        return not candidates or bool(predicted_gains(problem, at, candidates)[0].max() < WORTH_A_TRY)

    def _explanations(self, minima: list[Minimum], weights: Array) -> list[_Explanation]:
        """Explain the data with all poses; and, where these may hide bumped ones, with those that agree."""
        p = minima[0].parameters
        found = [self._explained(p, self.everything)]
        if found[0].noticed:
            starts = [m.parameters for m in minima]
            problem, always = self._linearised(p, self.everything), self._always()
            at = maximise(problem, always, self._start(problem, always))
            if not self.measured:
                weights = np.asarray(at.noise.W, dtype=np.float64)
            distances = squared_length(*at.left_out())
            for scaled in (False, True):
                robust = self._agreeing(weights, starts, distances, scaled=scaled)
                if robust is not None:
                    found.append(self._explained(*robust))
        return found

    def _are_gaussian(self, distances: Array) -> bool:
        """Whether so many poses are distributed as the noise alone would have them (Kolmogorov and Smirnov)."""
        if self.n < POSES_FOR_THE_SHAPE or self._stand_out(distances):
            return False
        share = chi2_cdf(6, np.sort(distances))
        apart = float(np.abs(share - (np.arange(self.n) + 0.5) / self.n).max())
        return apart < float(np.sqrt(np.log(2 / SUSPICIOUS) / (2 * self.n)))

    def _stand_out(self, distances: Array) -> bool:
        """Whether poses stand out, or so many of them that none does."""
        if self.n < FEWEST_TO_REJECT_FROM:
            return False
        tail = float(np.median(distances)) / MEDIAN_DISTANCE / (float(distances.mean()) / 6)
        return bool(distances.max() > chi2_isf(6, 2 * SUSPICIOUS / self.n)) or tail < LIGHT_TAIL

    def _agreeing(
        self, weights: Array, starts: list[Parameters], distances: Array, *, scaled: bool
    ) -> tuple[Parameters, Kept] | None:
        """Find poses that agree within the noise, or within one that fits half of all poses."""
        phi = features(self.R)

        def down(statistics: Statistics, p: Parameters, steps: int) -> Parameters:
            return self.descent.down(statistics, p, steps).parameters

        if not scaled:
            return agreeing_poses(phi, self.wrench, weights, starts, down) if self.measured else None
        scale = float(np.median(distances)) / MEDIAN_DISTANCE
        found = None
        for _ in range(4):
            robust = agreeing_poses(phi, self.wrench, weights / scale, starts, down)
            if robust is None:
                break
            found = robust
            e = self.wrench - predict(robust[0], self.R)
            d2 = np.einsum("ni,nij,nj->n", e, weights, e, optimize=True)
            before, scale = scale, float(np.median(d2)) / MEDIAN_DISTANCE * self.n / (self.n - 2.5)
            if scale > 0.7 * before:
                break
        return found

    def _explained(self, p: Parameters, kept: Kept) -> _Explanation:
        """Improve parameters, variances, components and rejected poses in turn, until nothing changes."""
        always, candidates = self._always(), self._candidates()
        problem = self._linearised(p, kept)
        at = select(problem, always, self._start(problem, always), candidates, len(always))
        best = _Explanation(p, kept)
        for _ in range(ROUNDS):
            if self.drift == "auto":
                at = with_walks_instead(problem, at, candidates, len(always))
                at = with_slopes_instead(problem, at, len(always))
            p, problem, at = self._settled(p, kept, problem, at)
            distances = squared_length(*at.left_out())
            criterion = self._criterion(at, distances)
            if criterion < best.criterion - 1e-3:
                if kept.all() and self._are_gaussian(distances):
                    return _Explanation(p, kept, at.components, at.theta, criterion, noise=at.noise)
                noise_found = {c.kind for c in at.components[len(always) :]} - {"walk", "slope"}
                noticed = self.n >= FEWEST_TO_REJECT_FROM and (bool(noise_found) or self._stand_out(distances))
                best = _Explanation(p, kept, at.components, at.theta, criterion, noticed, at.noise)
                kept = self._membership(kept, distances, at)
                if not (kept == best.kept).all():
                    problem = self._linearised(p, kept)
                    at = maximise(problem, at.components, at.theta)
                    continue
            again = select(problem, at.components, at.theta, candidates, len(always))
            if set(again.components) == set(at.components):
                break
            at = again
        return best

    def _settled(
        self, p: Parameters, kept: Kept, problem: Linearised, at: Point
    ) -> tuple[Parameters, Linearised, Point]:
        """Go down with the noise as it is and estimate its variances again, until they agree."""
        for _ in range(ROUNDS):
            if float(at.step @ np.linalg.solve(at.C, at.step)) < SETTLED:
                break
            p = self.descent.down(self._statistics(at.noise, p), p).parameters
            problem = self._linearised(p, kept)
            at = maximise(problem, at.components, at.theta)
        return p, problem, at

    def _membership(self, kept: Kept, distances: Array, at: Point) -> Kept:
        """Reject the poses that stand out, the worst first; take back those that do not any more."""
        limit = self._limit(at)
        out = kept & (distances > max(limit, float(distances[kept].max()) / 4))
        after = (kept & ~out) | (~kept & (distances < limit))
        return after if after.sum() >= fewest_kept(self.n) else kept

    def _limit(self, at: Point) -> float:
        """Squared distance of a good pose that one in a thousand exceeds."""
        estimated = any(c.kind == "white" for c in at.components)
        return 6 * float(f_ppf(6, self._dof(at.noise.kept), 1 - FALSE_REJECTION)) if estimated else FARTHEST

    def _criterion(self, at: Point, distances: Array) -> float:
        """A rejected pose has noise of its own size. At the limit it costs what it would if it counted."""
        value, rejected, limit = -2 * at.worth, ~at.noise.kept, self._limit(at)
        if rejected.any():
            far = np.maximum(distances[rejected], limit)
            value += float(np.linalg.slogdet(at.left_out()[1][rejected])[1].sum())
            value += float(np.sum(limit + 6 * np.log(far / limit)))
        return value

    def _start(self, problem: Linearised, components: Sequence[Component]) -> Array:
        """Give variances to start from: the mean square residual of the group, or its noise where that is more."""
        noise = np.diagonal(problem.D, axis1=1, axis2=2)
        size = np.maximum(problem.r**2, noise)[problem.kept]
        scale = [np.mean(size[:, np.array(c.share) > 0]) for c in components]
        return np.array([s / (10 * self.n if c.kind == "walk" else 1) for c, s in zip(components, scale, strict=True)])

    def _with_all_minima(self, e: _Explanation, others: list[Minimum]) -> list[Minimum]:
        """Find the minima again, under the noise of the explanation."""
        noise = self._noise(e, e.parameters)
        statistics, logdet = self._statistics(noise, e.parameters), noise.logdet
        ends = []
        for start in (e.parameters, *(minimum.parameters for minimum in others)):
            q = start
            for _ in range(3 if e.noise_moves else 1):
                if e.noise_moves:
                    noise = self._noise(e, q)
                    statistics = self._statistics(noise, q)
                end = self.descent.down(statistics, q)
                q = end.parameters
            ends.append(replace(end, chi2=end.chi2 + noise.logdet - logdet))
        return self.descent.distinct(ends)

    def _noise(self, e: _Explanation, p: Parameters) -> Noise:
        if e.noise is not None and not e.noise_moves:
            return e.noise
        return noise_of(self._linearised(p, e.kept), e.components, e.theta)

    def _statistics(self, noise: Noise, p: Parameters) -> Statistics:
        """Sum up under any noise, around parameters."""
        return Statistics.of_noise(features(self.R), self.wrench, noise, coefficients(p))

    def _fit(self, e: _Explanation, minima: list[Minimum], static_chi2: float) -> Fit:
        best = minima[0]
        if not best.settled:
            weight_N = np.linalg.norm(best.parameters.gravity_force_base_N)
            raise NotObservable(
                f"the fit has not settled in {MAX_STEPS} steps, at a weight of {weight_N:.2g} N: "
                "hang something heavier on the sensor, or add poses with other orientations."
            )
        plain = not e.components and e.kept.all() and self.drift != "linear"
        noise = Noise(self.cov) if plain else self._noise(e, best.parameters)
        weights = np.empty(self.n)
        weights[self.order] = e.kept
        drifts = self.drift == "linear" or any(c.kind in ("walk", "slope") for c in e.components)
        found = dict(zip(e.components, e.theta, strict=True))
        Z = self.constraints.free(best.parameters)
        given_noise = covariance = np.asarray(Z @ _inverse(Z.T @ best.information @ Z) @ Z.T)
        response = None
        if e.components:
            problem = self._linearised(best.parameters, e.kept)
            x, C = estimates_of_unknown_variances(problem, point(problem, e.components, e.theta))
            Z = block_diag(Z, np.eye(SIZE))
            covariance = (Z @ C @ Z.T)[:15, :15]
            response = Response(x[-SIZE:], Z @ C @ Z.T) if x[-SIZE:].any() else None
        return Fit(
            parameters=best.parameters,
            information=best.information,
            free=self.constraints.free(best.parameters),
            minima=tuple(minima),
            chi2=best.chi2,
            dof=self._dof(e.kept),
            measured_chi2=static_chi2 if self.measured else float("nan"),
            weights=weights,
            components={c.name: self._deviation(c, v) for c, v in found.items()},
            drift=self._drift(best, noise, given_noise, found) if drifts else None,
            noise=noise,
            order=self.order,
            R_base_flange=self.given[0],
            wrench=self.given[1],
            given_noise=given_noise,
            covariance=covariance,
            response=response,
        )

    def _deviation(self, c: Component, variance: float) -> float:
        """Standard deviation that the fit used: estimated white noise includes its lower bound."""
        least = 0.0 if self.measured or c.kind != "white" else self.cov[0][np.argmax(c.share), np.argmax(c.share)]
        return float(np.sqrt(variance + least))

    def _drift(self, best: Minimum, noise: Noise, C: Array, found: Mapping[Component, float]) -> DriftEstimate:
        """Best linear prediction of the bias at every pose, and the error of its change."""
        J, r = jacobian(best.parameters, self.R), self.wrench - predict(best.parameters, self.R)
        T = response_columns(best.parameters, self.R)
        variance = np.repeat([found.get(c, 0.0) for c in RESPONSE], [5, 6])[:, None]

        def not_drift(X: Array) -> Array:
            """Multiply by the covariance of all but the drift."""
            Y = noise.D @ X
            return np.asarray(Y + T @ (variance * summed_products(T, X)) if variance.any() else Y)

        sorted_bias = r - not_drift(noise.solve(r[..., None]))[..., 0]
        if not noise.kept.all():
            at, seen = self.time[noise.kept], sorted_bias[noise.kept]
            sorted_bias = np.stack([np.interp(self.time, at, channel) for channel in seen.T], axis=1)
        bias = np.empty((self.n, 6))
        bias[self.order] = sorted_bias
        ends = np.flatnonzero(noise.kept)[[0, -1]]
        select_ends = np.zeros((self.n, 6, 6))
        select_ends[ends] = [-np.eye(6), np.eye(6)]
        Y = not_drift(select_ends)
        WY = noise.solve(Y)
        E = summed_products(select_ends, J) - summed_products(WY, J)
        cov = summed_products(select_ends, Y) - summed_products(Y, WY) + E @ C @ E.T
        change = sorted_bias[ends[1]] - sorted_bias[ends[0]]
        return DriftEstimate(change, np.sqrt(np.maximum(np.diag(cov), 0.0)), bias)

    def _linearised(self, p: Parameters, kept: Kept) -> Linearised:
        J = jacobian(p, self.R)
        turn = J[..., :3]
        r = self.wrench - predict(p, self.R)
        H, g = np.zeros((15, 15)), np.zeros(15)
        if self.constraints.any:
            A, residual = self.constraints.measurements(p)
            Z = self.constraints.free(p)
            J, H, g = J @ Z, Z.T @ A.T @ A @ Z, Z.T @ A.T @ residual
        slope = np.full(6, np.inf) if self.drift == "linear" else None
        return Linearised(J, r, (H, g), turn, self.cov, self.time, kept, slope, response_columns(p, self.R))

    def _groups(self) -> list[range]:
        return [range(c, c + 1) for c in range(6)] if self.n >= POSES_FOR_EACH_AXIS else [FORCE, TORQUE]

    def _always(self) -> list[Component]:
        always = []
        if not self.measured and self.n < FEW_POSES:
            always = [Component("white_force_N", "white", (1.0, 1.0, 1.0, *[LEVER_M**2] * 3))]
        elif not self.measured:
            always = [component("white", FORCE), component("white", TORQUE)]
        if self.drift == "random-walk":
            always += [component("walk", group) for group in (FORCE, TORQUE)]
        return always

    def _candidates(self) -> list[Component]:
        found = list(RESPONSE) if self.n >= FEW_POSES_FOR_RESPONSE else []
        if self.n >= (FEW_POSES if self.measured else FEW_POSES_WITHOUT_NOISE):
            white = [component("white", FORCE), component("white", TORQUE)] if self.measured else []
            walks = [component("walk", group) for group in self._groups()] if self.drift == "auto" else []
            found += [*white, ROTATION, *walks]
        return found


def _white(sigma_N: float, sigma_Nm: float) -> Array:
    return np.diag(np.repeat([sigma_N**2, sigma_Nm**2], 3))


def _inverses(cov: Array) -> Array:
    """Invert (n, 6, 6) matrices, once when they are all the same."""
    if cov.strides[0] == 0:
        return np.broadcast_to(np.linalg.inv(cov[:1]), cov.shape)
    return np.asarray(np.linalg.inv(cov))


def _inverse(information: Array) -> Array:
    scale = column_scale(information)
    value, vector = np.linalg.eigh(information / np.outer(scale, scale))
    value = np.maximum(value, 1e-14 * value[-1])
    return np.asarray(vector / value @ vector.T / np.outer(scale, scale))
