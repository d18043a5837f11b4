"""Maximum likelihood: joint weighted least squares of forces and torques, under the noise the data show.

From all minima of the force equations down to the minima of the joint cost; when the residuals or the restricted
likelihood ask for it, without the poses that belong to none, and with drift, more noise, or inexact orientations.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtri as chi2_isf
from scipy.special import fdtri as f_ppf

from calib.covariance import Noise, summed_products
from calib.descent import MAX_STEPS, Descent, Equations, Minimum, column_scale
from calib.errors import NotObservable
from calib.gram import Statistics, features
from calib.known import Constraints, Known
from calib.model import STANDARD_GRAVITY_M_S2, Array, Parameters, jacobian, predict
from calib.robust import FARTHEST, FEWEST_TO_REJECT_FROM, Kept, agreeing_poses, fewest_kept
from calib.variance import (
    FORCE,
    ROTATION,
    TORQUE,
    WORTH_A_TRY,
    Component,
    Linearised,
    Point,
    component,
    maximise,
    noise_of,
    point,
    predicted_gains,
    select,
    with_slopes_instead,
)

Drift = Literal["auto", "none", "linear", "random-walk"]

RANK_TOLERANCE = 1e-9
LEVER_M = 0.025  # usual ratio of torque noise to force noise
LEVER_BOUNDS_M = (1e-3, 1.0)  # what any sensor has
FEW_POSES = 6  # fewer cannot tell force noise from torque noise: the usual ratio is taken
FEW_POSES_WITHOUT_NOISE = 12  # fewer cannot tell drift from noise that nobody measured
POSES_FOR_EACH_AXIS = 50  # fewer cannot tell the drift of one axis from that of another of its group
MANY_POSES = 20_000  # from here on single poses are looked at only when chi2 or `drift` asks for it
FLOOR = 0.03  # of the residuals: white noise that is surely there when nobody measured it
SUSPICIOUS = 0.01  # p-value below which more than the measured noise is looked for
LIGHT_TAIL = 0.6  # the median of squared distances relative to their mean, in units of what Gaussian noise has
LARGE_ROTATION_RAD = np.deg2rad(1.0)  # few kinematics are worse
WORST_ROTATION_RAD = np.deg2rad(3.0)  # none is
LARGE_WHITE = 3.0  # times the measured variance
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
    """The same poses, best fit without drift, weighted by the measured noise alone; NaN when nobody measured it."""
    weights: Array
    """(n,) 1 = used, 0 = rejected because it fits none of what the others tell."""
    components: Mapping[str, float]
    """Standard deviations of what was found, by name and unit: beyond the measured noise, or all of the noise when
    nobody measured it. A `walk` is per mean interval between poses, a `slope` per session."""
    drift: DriftEstimate | None
    noise: Noise
    """Covariance of all wrenches under the noise model, poses in the order of `order`."""
    order: NDArray[np.intp]
    """(n,) row numbers by time."""
    R_base_flange: Array
    """(n, 3, 3)"""
    wrench: Array
    """(n, 6)"""

    @cached_property
    def covariance(self) -> Array:
        """(15, 15) zero along what is exactly known; without meaning where the information lacks rank."""
        Z = self.free
        return np.asarray(Z @ _inverse(Z.T @ self.information @ Z) @ Z.T)

    @property
    def wrench_cov(self) -> Array:
        """(n, 6, 6) noise of each pose by itself, without drift; of rejected poses that of the others."""
        cov = np.empty_like(self.noise.D)
        cov[self.order] = self.noise.D
        rejected = self.weights == 0
        cov[rejected] = cov[~rejected].mean(axis=0)
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
        """(n, 6) measured minus `predict(parameters)`: the plain model, without drift."""
        return np.asarray(self.wrench - predict(self.parameters, self.R_base_flange))

    @cached_property
    def jacobian(self) -> Array:
        """(n, 6, 15) derivative of the prediction."""
        return jacobian(self.parameters, self.R_base_flange)

    @property
    def left_out_residuals(self) -> Array:
        """(n, 6) measured minus what all other poses predict for this one, drift and correlation included.

        The exact leave-one-out of the linearised model: `P_kk^-1 (P y)_k`, `P = W - W J C J' W`, W the inverse noise.
        """
        return self._left_out[0]

    @property
    def left_out_cov(self) -> Array:
        """(n, 6, 6) covariance of these, `P_kk^-1`: noise of the pose and uncertainty of its prediction."""
        return self._left_out[1]

    @cached_property
    def _left_out(self) -> tuple[Array, Array]:
        order = self.order
        J, r = self.jacobian[order], self.residuals[order]
        WX = self.noise.solve(np.concatenate([J, r[..., None]], axis=2))
        WJ = WX[..., :15]
        P = self.noise.blocks - WJ @ self.covariance @ np.swapaxes(WJ, 1, 2)
        # With a prior the best parameters leave some of J' W r.
        e, cov = np.empty_like(r), np.linalg.inv(P)
        e[order] = (cov @ WX[..., 15:])[..., 0]
        S = np.empty_like(cov)
        S[order] = cov
        rejected = self.weights == 0
        if rejected.any():
            # The fit sees them with a huge covariance, which keeps them out.
            D = np.empty_like(self.noise.D)
            D[order] = self.noise.D
            S[rejected] += self.wrench_cov[rejected] - D[rejected]
        return e, S

    @cached_property
    def standardized_residuals(self) -> Array:
        """(n, 6) `left_out_residuals` whitened by `left_out_cov`: independent within a pose, standard deviation 1."""
        L = np.linalg.cholesky(self.left_out_cov)
        return np.asarray(np.linalg.solve(L, self.left_out_residuals[..., None])[..., 0])

    @cached_property
    def left_out_distances(self) -> Array:
        """(n,) squared length of `standardized_residuals`: chi-square with 6 degrees of freedom for a good pose."""
        return np.asarray((self.standardized_residuals**2).sum(axis=1))


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
    """Fit all 15 parameters and, as far as the data ask for it, the noise.

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
        How the bias may move: as the restricted likelihood decides, not at all, or surely so.
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

    minima: list[Minimum]
    kept: Kept
    cov: Array
    """(n, 6, 6) measured noise of each pose, or what is surely there when nobody measured it."""
    components: tuple[Component, ...] = ()
    theta: Array = field(default_factory=lambda: np.zeros(0))
    criterion: float = np.inf
    """-2 log restricted likelihood; a rejected pose costs what one at the limit of rejection would."""


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

    def solve(self) -> Fit:
        weights = _inverses(self.cov if self.measured else np.broadcast_to(_white(1.0, LEVER_M), self.cov.shape))
        everything = _Explanation(self.descent.minima(weights), np.ones(self.n, bool), self.cov)
        best = everything.minima[0]
        if self._lacks_rank(best):
            return self._fit(everything, best.chi2)
        if self._exact(best.parameters):
            exact = self.descent.minima(_inverses(self.cov))
            return self._fit(replace(everything, minima=exact), exact[0].chi2)
        static_chi2 = best.chi2
        if self.measured and self.n > MANY_POSES and self.drift == "none" and self._fits(everything):
            return self._fit(everything, static_chi2)  # a pose that could do harm among so many would show in chi2
        chosen = self._chosen(everything, weights)
        if self.measured and not chosen.kept.all():
            static_chi2 = self.descent.minima(weights * chosen.kept[:, None, None])[0].chi2
        return self._fit(chosen, static_chi2)

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

    def _least_noise(self, p: Parameters, kept: Kept) -> Array:
        """Give the measured noise, or a share of the residuals, so that a random walk never explains them all."""
        if self.measured:
            return self.cov
        e = (self.wrench - predict(p, self.R))[kept]
        force_N, torque_Nm = (FLOOR * float(np.sqrt(np.mean(e[:, c] ** 2))) for c in (slice(0, 3), slice(3, 6)))
        force_N = max(force_N, torque_Nm / LEVER_BOUNDS_M[1])
        return np.broadcast_to(_white(force_N, max(torque_Nm, LEVER_BOUNDS_M[0] * force_N)), self.cov.shape)

    def _fits(self, everything: _Explanation) -> bool:
        """Tell whether the measured noise explains chi2."""
        return everything.minima[0].chi2 < float(chi2_isf(self._dof(everything.kept), SUSPICIOUS))

    # Explanations

    def _chosen(self, everything: _Explanation, weights: Array) -> _Explanation:
        """Take the likeliest explanation; the plain one unless something speaks against it."""
        p = everything.minima[0].parameters
        always = self._always()
        problem = self._linearised(p, everything.kept, self._least_noise(p, everything.kept))
        at = maximise(problem, always, self._start(problem, always))
        plain = self.measured and not always and self.drift != "linear"
        quiet = plain and self._fits(everything)
        distances = self._distances(problem, at)
        reject = self._may_reject(distances)
        candidates = self._candidates()
        if (
            quiet
            and not reject
            and not (candidates and predicted_gains(problem, at, candidates)[0].max() > WORTH_A_TRY)
        ):
            return everything
        found = [self._explained(p, everything.kept)]
        if self._masks_outliers(found[0], reject):
            starts = [m.parameters for m in everything.minima]
            if not self.measured:
                weights = np.asarray(at.noise.W, dtype=np.float64)
            for scaled in (False, True):
                robust = self._agreeing(weights, starts, distances, scaled=scaled)
                if robust is not None:
                    found.append(self._explained(*robust))
        if all(e.criterion == np.inf for e in found):
            found = [self._explained(p, everything.kept, may_reject=False)]
        return self._with_all_minima(min(found, key=lambda e: e.criterion), everything, weights)

    def _masks_outliers(self, e: _Explanation, suspected: bool) -> bool:
        """Tell whether noise may have been blamed for what a few bumped poses did."""
        if self.n < FEWEST_TO_REJECT_FROM:
            return False
        if self._may_reject(self._distances_of(e)):
            return True
        found = {c.name: v for c, v in zip(e.components, e.theta, strict=True)}
        measured = np.diagonal(self.cov, axis1=1, axis2=2).mean(axis=0)
        white = max(found.get("white_force_N", 0.0) / measured[0], found.get("white_torque_Nm", 0.0) / measured[3])
        inexact = found.get(ROTATION.name, 0.0) > LARGE_ROTATION_RAD**2
        return suspected and (inexact or (self.measured and white > LARGE_WHITE))

    def _may_reject(self, distances: Array) -> bool:
        """Tell whether poses stand out, or so many of them that none does."""
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
            return self.descent.down(statistics.normal_equations, p, steps).parameters

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

    def _explained(self, p: Parameters, kept: Kept, *, may_reject: bool = True) -> _Explanation:
        """Alternate between parameters, variance components and rejection until they agree."""
        always = self._always()
        readmitted = np.zeros(self.n, bool)
        choose = True
        cov = self._least_noise(p, kept)
        for _ in range(12):
            problem = self._linearised(p, kept, cov)
            if choose:
                at = self._selected(problem, always)
                if self.drift == "auto":
                    at = with_slopes_instead(problem, at, len(always))
            else:
                at = maximise(problem, at.components, at.theta)
            distances = self._distances(problem, at)
            criterion = self._criterion(problem, at)
            p = self._moved(p, at.step)
            before = kept
            if may_reject:
                kept = self._membership(kept, distances, readmitted, at)
            readmitted |= kept & ~before
            choose = bool((kept != before).any())
            if not choose and float(at.step @ np.linalg.solve(at.C, at.step)) < 1e-4:
                break
        if not self.measured and not before.all() and self._white_is_gone(at, cov):
            criterion = np.inf  # rejecting until the rest fits exactly explains nothing
        return _Explanation([Minimum(p, np.nan, np.zeros((15, 15)))], before, cov, at.components, at.theta, criterion)

    @staticmethod
    def _white_is_gone(at: Point, cov: Array) -> bool:
        floor = cov[0, [0, 3], [0, 3]]
        white = [value for c, value in zip(at.components, at.theta, strict=True) if c.kind == "white"]
        return any(value < least for value, least in zip(white, floor, strict=False))

    def _selected(self, problem: Linearised, always: list[Component]) -> Point:
        start, candidates = self._start(problem, always), self._candidates()
        at = select(problem, always, start, candidates)
        found = dict(zip(at.components, at.theta, strict=True))
        if found.get(ROTATION, 0.0) > WORST_ROTATION_RAD**2:  # something else, which no orientation error explains
            at = select(problem, always, start, [c for c in candidates if c is not ROTATION])
        return at

    def _moved(self, p: Parameters, step: Array) -> Parameters:
        if not self.constraints.any:
            return p.moved(step)
        return self.constraints.satisfied(p.moved(self.constraints.free(p) @ step))

    def _membership(self, kept: Kept, distances: Array, readmitted: Kept, at: Point) -> Kept:
        """Reject the poses that stand out, the worst first; take back those that do not any more, once."""
        estimated = any(c.kind == "white" for c in at.components)
        inside = 6 * float(f_ppf(6, self._dof(kept), 1 - 1e-3)) if estimated else FARTHEST
        worst = float(distances[kept].max())
        out = kept & (distances > max(FARTHEST, worst / 4)) & ~readmitted
        after = (kept & ~out) | (~kept & (distances < inside))
        return after if after.sum() >= fewest_kept(self.n) else kept

    def _distances(self, problem: Linearised, at: Point) -> Array:
        """Squared leave-one-out residuals (n,) in units of their covariance."""
        P = at.noise.blocks - at.WJ @ at.C @ np.swapaxes(at.WJ, 1, 2)
        S = np.asarray(np.linalg.inv(P), dtype=np.float64)
        e = (S @ at.u[..., None])[..., 0]
        self._replace_far(problem, at, S)
        return np.asarray((np.linalg.solve(S, e[..., None])[..., 0] * e).sum(axis=1))

    @staticmethod
    def _replace_far(problem: Linearised, at: Point, S: Array) -> None:
        """Give rejected poses the noise of the others in place of the huge one that keeps them out."""
        rejected = ~problem.kept
        if rejected.any():
            S[rejected] += at.noise.D[problem.kept].mean(axis=0) - at.noise.D[rejected]

    def _distances_of(self, e: _Explanation) -> Array:
        problem = self._linearised(e.minima[0].parameters, e.kept, e.cov)
        return self._distances(problem, point(problem, e.components, e.theta))

    def _criterion(self, problem: Linearised, at: Point) -> float:
        rejected = ~problem.kept
        value = -2 * at.loglik
        if rejected.any():
            P = at.noise.blocks - at.WJ @ at.C @ np.swapaxes(at.WJ, 1, 2)
            S = np.asarray(np.linalg.inv(P), dtype=np.float64)
            self._replace_far(problem, at, S)
            far = np.linalg.slogdet(at.noise.D[rejected])[1].sum()
            value += float(np.linalg.slogdet(S[rejected])[1].sum() - far) + FARTHEST * int(rejected.sum())
        return value

    def _start(self, problem: Linearised, components: Sequence[Component]) -> Array:
        """Give variances to start from: the mean square residual of the group, or its noise where that is more."""
        noise = np.diagonal(problem.D, axis1=1, axis2=2)
        size = np.maximum(problem.r**2, noise)[problem.kept]
        scale = [np.mean(size[:, np.array(c.share) > 0]) for c in components]
        return np.array([s / (10 * self.n if c.kind == "walk" else 1) for c, s in zip(components, scale, strict=True)])

    def _with_all_minima(self, e: _Explanation, everything: _Explanation, weights: Array) -> _Explanation:
        """Find the minima again, under the noise of the explanation."""
        p = e.minima[0].parameters
        others = everything.minima if e.kept.all() else self.descent.minima(weights * e.kept[:, None, None])
        logdet = self._noise(e, p).logdet
        ends = []
        for start in (p, *(minimum.parameters for minimum in others)):
            q = start
            for _ in range(3 if ROTATION in e.components else 1):  # its noise depends on the parameters
                noise = self._noise(e, q)
                end = self.descent.down(self._equations(noise), q)
                q = end.parameters
            ends.append(replace(end, chi2=end.chi2 + noise.logdet - logdet))
        return replace(e, minima=self.descent.distinct(ends))

    def _noise(self, e: _Explanation, p: Parameters) -> Noise:
        return noise_of(self._linearised(p, e.kept, e.cov), e.components, e.theta)

    def _equations(self, noise: Noise) -> Equations:
        """Weighted least squares for any noise."""

        def equations(p: Parameters) -> tuple[Array, Array, float]:
            X = np.concatenate([jacobian(p, self.R), (self.wrench - predict(p, self.R))[..., None]], axis=2)
            G = summed_products(X, noise.solve(X))
            return G[:15, :15], G[:15, 15], float(G[15, 15])

        return equations

    def _fit(self, e: _Explanation, static_chi2: float) -> Fit:
        best = e.minima[0]
        if not best.settled:
            weight_N = np.linalg.norm(best.parameters.gravity_force_base_N)
            raise NotObservable(
                f"the fit has not settled in {MAX_STEPS} steps, at a weight of {weight_N:.2g} N: "
                "hang something heavier on the sensor, or add poses with other orientations."
            )
        if not e.components and e.kept.all() and self.drift != "linear":
            noise = Noise(self.cov)
        else:
            noise = self._noise(e, best.parameters)
        weights = np.empty(self.n)
        weights[self.order] = e.kept
        drifts = self.drift == "linear" or any(c.kind in ("walk", "slope") for c in e.components)
        return Fit(
            parameters=best.parameters,
            information=best.information,
            free=self.constraints.free(best.parameters),
            minima=tuple(e.minima),
            chi2=best.chi2,
            dof=self._dof(e.kept),
            measured_chi2=static_chi2 if self.measured else float("nan"),
            weights=weights,
            components={c.name: float(np.sqrt(v)) for c, v in zip(e.components, e.theta, strict=True)},
            drift=self._drift(best, noise) if drifts else None,
            noise=noise,
            order=self.order,
            R_base_flange=self.given[0],
            wrench=self.given[1],
        )

    def _drift(self, best: Minimum, noise: Noise) -> DriftEstimate:
        """Best linear prediction of the bias at every pose, and the error of its change."""
        J, r = jacobian(best.parameters, self.R), self.wrench - predict(best.parameters, self.R)
        bias = np.empty((self.n, 6))
        bias[self.order] = r - (noise.D @ noise.solve(r[..., None]))[..., 0]
        ends = [0, -1]
        select_ends = np.zeros((self.n, 6, 6))
        select_ends[ends] = [-np.eye(6), np.eye(6)]
        Z = self.constraints.free(best.parameters)
        C = Z @ _inverse(Z.T @ best.information @ Z) @ Z.T
        Y = noise.D @ select_ends
        WY = noise.solve(Y)
        E = np.einsum("nik,nil->kl", select_ends, J) - np.einsum("nik,nil->kl", WY, J)
        cov = np.einsum("nik,nil->kl", select_ends, Y) - np.einsum("nik,nil->kl", Y, WY) + E @ C @ E.T
        change = bias[self.order[-1]] - bias[self.order[0]]
        return DriftEstimate(change, np.sqrt(np.maximum(np.diag(cov), 0.0)), bias)

    def _linearised(self, p: Parameters, kept: Kept, cov: Array) -> Linearised:
        J = jacobian(p, self.R)
        turn = J[..., :3]
        r = self.wrench - predict(p, self.R)
        H, g = np.zeros((15, 15)), np.zeros(15)
        if self.constraints.any:
            A, residual = self.constraints.measurements(p)
            Z = self.constraints.free(p)
            J, H, g = J @ Z, Z.T @ A.T @ A @ Z, Z.T @ A.T @ residual
        slope = np.full(6, np.inf) if self.drift == "linear" else None
        return Linearised(J, r, (H, g), turn, cov, self.time, kept, slope)

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
        if self.n < (FEW_POSES if self.measured else FEW_POSES_WITHOUT_NOISE):
            return []
        white = [component("white", FORCE), component("white", TORQUE)] if self.measured else []
        walks = [component("walk", group) for group in self._groups()] if self.drift == "auto" else []
        return [*white, ROTATION, *walks]


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
