"""Model selection: which poses are outliers, and which variance components act on the others.

With the maximum L of the restricted likelihood of `variance_components` on the kept poses, the criterion of an
explanation is

    -2 (log L - sum_k gain_k) + sum_j (log det S_j + c + 6 log(max(d_j², c) / c))

over the components k and the rejected poses j. gain_k is the smallest gain required of a component, a penalty like that
of an information criterion. S_j is the leave-one-out covariance of pose j, d_j its Mahalanobis distance, and c the
limit that one good pose in a thousand exceeds. A rejected pose has an inflated variance of its own (Cook, Holschuh and
Weisberg, Technometrics 24, 1982). At the limit, its cost is the same as that of a kept pose.

Parameters, variances, components (forward selection, then backward elimination) and rejected poses are improved in turn
until nothing changes, starting from all poses and from those that a robust fit keeps.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np
from scipy.special import chdtr as chi2_cdf
from scipy.special import chdtri as chi2_isf
from scipy.special import fdtri as f_ppf

from ftcalib.likelihood.descent import (
    FALSE_REJECTION,
    FARTHEST,
    FEWEST_TO_REJECT_FROM,
    Kept,
    Minimum,
    agreeing_poses,
    fewest_kept,
)
from ftcalib.likelihood.session import LEVER_M, SessionData, inverses, white
from ftcalib.likelihood.session_noise import Noise
from ftcalib.likelihood.structure import MOST_POSES as STRUCTURED_POSES
from ftcalib.likelihood.variance_components import (
    EFFECTS,
    FORCE,
    HYSTERESIS,
    NEGLIGIBLE,
    RESPONSE,
    ROTATION,
    STRUCTURE,
    TORQUE,
    Component,
    Linearised,
    Point,
    channel_component,
    expected_variances,
    maximise,
    noise_of,
    point,
    score,
    squared_length,
    unit_variances,
)
from ftcalib.model import Array, Parameters, predict

# Selection of the variance components: forward, backward and by exchange.

# A component that changes the log-likelihood by more is certain: no other component can compensate its absence.
SURE = 20.0
# A component is tried if the log-likelihood gain predicted for it, from score and information at zero, exceeds this.
WORTH_A_TRY = 1.0
USUAL_HYSTERESIS = 0.001
# Standard deviations of gain and cross-talk of real sensors: a small one, and the usual one.
SMALL_RESPONSE, USUAL_RESPONSE = 0.005, 0.02


def select_explanation(
    problem: Linearised,
    components: Sequence[Component],
    theta: Array,
    candidates: Sequence[Component],
    needed: int | None = None,
) -> Point:
    """Add candidates that increase the likelihood, one by one, then drop components that have become unnecessary.

    Parameters
    ----------
    components : sequence of Component
        Components of the initial model.
    theta : array, shape (k,)
        Variances of these components.
    needed : int, optional
        Number of initial components, the first ones, that must not be dropped; by default all.
    """
    needed = len(components) if needed is None else needed
    best = _prune(problem, maximise(problem, components, theta), needed)
    waiting = [c for c in candidates if c not in best.components]
    while waiting:
        gains, start = _predicted_gains(problem, best, waiting)
        k = int(np.argmax(gains))
        if gains[k] < WORTH_A_TRY:
            break
        # Almost certain components are added together; the unnecessary ones among them are dropped at the end.
        wanted = best.loglik + waiting[k].needed
        for together in ([int(i) for i in np.argsort(-gains) if i == k or gains[i] > SURE], [k]):
            components = [*best.components, *(waiting[i] for i in together)]
            trial = maximise(problem, components, np.append(best.theta, start[together]), wanted)
            if not trial.too_large:
                break
        if trial.loglik > wanted and not trial.too_large:
            best = trial
        waiting = [c for i, c in enumerate(waiting) if i not in together]
    return best if len(best.components) - needed <= 1 else _prune(problem, best, needed)


def _with_response_instead(problem: Linearised, best: Point, candidates: Sequence[Component], needed: int) -> Point:
    """Return the better of the model and one with gain and cross-talk instead of its white noise.

    A mounting that fits only the torques makes the forces look noisy, so a gain that would explain them does not help.
    The exchange is tried if the white noise is at least as large as a small gain.
    """
    added = [c for c in RESPONSE if c in candidates]
    if not added or all(c.kind != "white" for c in best.components):
        return best
    if len(problem.r) * max(unit_variances(problem, best, added)) < SMALL_RESPONSE**2:
        return best
    rest = [k for k, c in enumerate(best.components) if c not in added and (k < needed or c.kind != "white")]
    quiet = [best.theta[k] * (1e-2 if best.components[k].kind == "white" else 1.0) for k in rest]
    start = np.append(quiet, np.full(len(added), USUAL_RESPONSE**2))
    return _better(problem, best, [*(best.components[k] for k in rest), *added], start, needed)


def with_walks_instead(problem: Linearised, best: Point, candidates: Sequence[Component], needed: int) -> Point:
    """Return the better of the model and one with a walk, gain and cross-talk instead of the white noise of a group.

    Added one at a time, they may increase the likelihood less than white noise, and would not be selected.
    """
    for group in (FORCE, TORQUE):
        walk = channel_component("walk", group)
        drifts = any(c.kind in ("walk", "slope") and c.share[group[0]] for c in best.components)
        noisy = any(c.kind == "white" and c.share[group[0]] for c in best.components)
        if walk not in candidates or drifts or not noisy or len(best.components) == needed:
            continue
        rest = [k for k, c in enumerate(best.components) if k < needed or c.kind != "white" or not c.share[group[0]]]
        kept = [best.components[k] for k in rest]
        added = [walk, *(c for c in RESPONSE if c in candidates and c not in kept)]
        start = np.append(best.theta[rest], unit_variances(problem, best, added))
        best = _better(problem, best, [*kept, *added], start, needed)
    return best


def with_slopes_instead(problem: Linearised, best: Point, needed: int) -> Point:
    """Return the likelier of two models: the given one, and one with linear drifts instead of its random walks."""
    walks = [k for k, c in enumerate(best.components) if c.kind == "walk"]
    if not walks:
        return best
    rest = [k for k in range(len(best.components)) if k not in walks]
    groups = [g for g in (FORCE, TORQUE) if any(best.components[k].share[c] for k in walks for c in g)]
    slopes = [channel_component("slope", group) for group in groups]
    start = [
        len(problem.r) * max(best.theta[k] for k in walks if any(best.components[k].share[c] for c in g))
        for g in groups
    ]
    # Without the random walk, white noise has to explain its share too.
    noise = [
        best.theta[k] + sum(best.theta[w] for w in walks if np.dot(best.components[w].share, best.components[k].share))
        for k in rest
    ]
    components = [*(best.components[k] for k in rest), *slopes]
    trial = maximise(problem, components, np.append(noise, start), best.loglik)
    return _prune(problem, trial, needed) if trial.loglik > best.loglik else best


def _better(problem: Linearised, best: Point, components: Sequence[Component], theta: Array, needed: int) -> Point:
    """Return the better of two models, `best` and one with other `components`, by penalised log-likelihood."""
    trial = maximise(problem, components, theta, best.worth)
    if trial.loglik > best.worth:
        trial = _prune(problem, trial, needed)
    return trial if trial.worth > best.worth and not trial.too_large else best


def _prune(problem: Linearised, best: Point, needed: int) -> Point:
    """Drop components that increase the likelihood too little: negligible ones together, then one at a time."""
    if best.components:
        seen = best.theta >= NEGLIGIBLE * unit_variances(problem, best, best.components)
        seen[:needed] = True
        if not seen.all():
            visible = [best.components[i] for i in np.flatnonzero(seen)]
            without = point(best.problem, visible, best.theta[seen], best)
            best = without if without.worth > best.worth else best
    k = needed
    while k < len(best.components):
        rest = [i for i in range(len(best.components)) if i != k]
        components, theta = [best.components[i] for i in rest], best.theta[rest]
        without = point(best.problem, components, theta, best)  # others may compensate the loss in part
        if best.loglik - without.loglik < SURE:
            without = maximise(problem, components, theta, best.loglik - best.components[k].needed)
        if without.worth > best.worth:
            best, k = without, needed
        else:
            k += 1
    return best


def _predicted_gains(problem: Linearised, best: Point, waiting: Sequence[Component]) -> tuple[Array, Array]:
    """Return the log-likelihood gain (k,) predicted for adding each candidate alone, and initial variances (k,)."""
    start = unit_variances(problem, best, waiting)
    components, theta = [*best.components, *waiting], np.concatenate([best.theta, NEGLIGIBLE * start])
    problem = problem.with_only(components)
    at = _where_all_are_seen(problem, best, components, theta)
    slope, information = score(problem, at, components, theta)
    k = len(best.components)
    curvature, slope_k = np.diag(information)[k:], slope[k:]
    if k:
        known = np.linalg.lstsq(information[:k, :k], np.column_stack([information[:k, k:], slope[:k]]))[0]
        curvature = curvature - np.einsum("ki,ki->i", information[:k, k:], known[:, :-1])
        slope_k = slope_k - information[:k, k:].T @ known[:, -1]
    gains = np.where(slope_k > 0, slope_k**2 / (2 * np.maximum(curvature, 1e-300)), 0.0)
    square = np.mean(problem.r[problem.kept] ** 2, axis=0)
    for i, c in enumerate(waiting):
        if c.kind == "white":
            share = np.array(c.share)
            start[i] = max(0.1 * start[i], float(square @ share) / share.sum() - start[i])
    return gains, start


def _where_all_are_seen(problem: Linearised, best: Point, components: Sequence[Component], theta: Array) -> Point:
    """Return the best `Point` in a form at which the score of the further `components` can be evaluated."""
    if best.own.walks:
        return point(problem, components, theta)
    return best if best.problem is problem else point(problem, best.components, best.theta)


def rivals(problem: Linearised, best: Point, candidates: Sequence[Component]) -> list[tuple[Point, float]]:
    """Return rival models that the data do not exclude, with their probabilities; the remaining one is that of `best`.

    The rivals are: all candidates that were not selected, with variances from score and information at zero; gain and
    cross-talk with equal variances; hysteresis instead of orientation errors; no drift, or white noise instead.
    """
    waiting = [c for c in candidates if c not in best.components]
    found = dict(zip(best.components, best.theta, strict=True))
    others = [(_with_all(problem, best, waiting), 0.0)]
    if any(c in found for c in RESPONSE):
        alike = max(found.get(c, 0.0) for c in RESPONSE)
        both = {c: min(alike, problem.largest(c)) for c in RESPONSE}
        others.append((point(problem, tuple(found | both), np.array(list((found | both).values())), best), 0.0))
    if ROTATION in found and HYSTERESIS in waiting:
        components = [HYSTERESIS if c == ROTATION else c for c in best.components]
        start = np.where([c == HYSTERESIS for c in components], USUAL_HYSTERESIS**2, best.theta)
        others.append((maximise(problem, components, start), ROTATION.needed - HYSTERESIS.needed))
    drifts = [c for c in best.components if c.kind == "slope" or (c.kind == "walk" and c in candidates)]
    if drifts:
        noise = {w for c in drifts for w in waiting if w.kind == "white" and np.dot(c.share, w.share)}
        for instead in ([], [c for c in candidates if c in noise]):
            components = [*(c for c in best.components if c not in drifts), *instead]
            start = np.array([found.get(c, 0.0) for c in components])
            start = np.where(start > 0, start, NEGLIGIBLE * unit_variances(problem, best, components))
            bonus = sum(c.needed for c in drifts) - sum(c.needed for c in instead)
            others.append((maximise(problem, components, start), bonus))
    odds = [float(np.exp(min(rival.loglik - best.loglik + bonus, 0.0))) for rival, bonus in others]
    return [(rival, odd / (1 + sum(odds))) for (rival, _), odd in zip(others, odds, strict=True)]


def _with_all(problem: Linearised, best: Point, waiting: Sequence[Component]) -> Point:
    """Add the candidates with a positive variance at the maximum of the quadratic model of the likelihood at zero."""
    start = NEGLIGIBLE * unit_variances(problem, best, waiting)
    components, theta = [*best.components, *waiting], np.concatenate([best.theta, start])
    at = _where_all_are_seen(problem, best, components, theta)
    slope, information = score(problem, at, components, theta)
    acting = np.arange(len(components))
    while True:
        promised = np.linalg.lstsq(information[np.ix_(acting, acting)], slope[acting])[0]
        sure = acting < len(best.components)
        if (sure | (promised > 1)).all():
            break
        acting = acting[sure | (promised > 1)]
    variances = (promised * theta[acting])[~sure]
    chosen = [components[i] for i in acting[~sure]]
    variances = np.minimum(variances, [problem.largest(c) for c in chosen])
    return point(problem, [*best.components, *chosen], np.append(best.theta, variances))


# With more poses than this, outliers are searched for only if chi2 or the setting `drift` requires it.
MANY_POSES = 20_000
# Size of the subset of more than 1000 poses that is searched for walks and structured errors.
SEARCHED = 300
# With fewer poses than this, the distribution of the Mahalanobis distances is not tested.
POSES_FOR_THE_SHAPE = 500
# If the p-value of chi2 is below this, variance components are searched for.
SUSPICIOUS = 0.01
# Ratio of median to mean of the squared Mahalanobis distances, relative to Gaussian noise; less suggests outliers.
LIGHT_TAIL = 0.6
# Largest number of iterations of each loop of the search.
ROUNDS = 20
# Convergence of the search: squared step of the estimates, in their standard deviations.
SETTLED = 1e-4
# A minimum whose chi2 is larger by more than this than the lowest is excluded, whatever the noise model.
FAR = 1000.0
MEDIAN_DISTANCE = float(chi2_isf(6, 0.5))


@dataclass(frozen=True, slots=True, eq=False)
class Explanation:
    """One explanation of the data: parameters, kept poses and variance components."""

    parameters: Parameters
    kept: Kept
    components: tuple[Component, ...] = ()
    theta: Array = field(default_factory=lambda: np.zeros(0))
    criterion: float = np.inf
    """-2 log restricted likelihood plus the penalties of components and rejected poses."""
    noticed: bool = False
    """Whether the kept poses may still contain outliers, so that the search should also start from a robust fit."""
    noise: Noise | None = None
    """Noise model of this explanation, evaluated at `parameters`."""

    @property
    def noise_moves(self) -> bool:
        """Whether the noise model depends on the parameters, as it does with orientation errors, gain or cross-talk."""
        return not {"rotation", *EFFECTS}.isdisjoint(c.kind for c in self.components)


def explain(session: SessionData) -> tuple[Explanation, list[Minimum], float]:
    """Return the best explanation, its minima by ascending chi2, and chi2 of its poses without variance components."""
    weights = inverses(session.cov if session.measured else np.broadcast_to(white(1.0, LEVER_M), session.cov.shape))
    minima = session.once("minima", lambda: session.descent.minima(weights))
    plain = Explanation(minima[0].parameters, session.everything)
    if session.lacks_rank(minima[0]):
        return plain, minima, minima[0].chi2
    if session.is_exact(minima[0].parameters):
        if not session.measured:
            session.cov = session.noise_left(minima[0].parameters)
            minima = session.descent.minima(inverses(session.cov))
        return plain, minima, minima[0].chi2
    if not session.measured:
        session.cov = session.least_noise(minima[0].parameters)
    if _is_quiet(session, minima[0]):
        return plain, minima, minima[0].chi2
    of_some = _explanation_of_some(session) if session.n > STRUCTURED_POSES else None
    if of_some is None:
        chosen = _with_expected_noise(session, min(_explanations(session, minima, weights), key=lambda e: e.criterion))
    else:
        chosen = _of_all_poses(session, of_some)
    of_kept, key = weights * chosen.kept[:, None, None], chosen.kept.tobytes()
    static = minima if chosen.kept.all() else session.once(key, lambda: session.descent.minima(of_kept))
    for _ in range(len(static)):
        ends = _with_all_minima(session, chosen, static)
        if session.descent.same(ends[0].parameters, chosen.parameters):
            break
        if of_some is None:
            other = _with_expected_noise(session, _improve(session, ends[0].parameters, chosen.kept))
        else:
            other = _of_all_poses(session, replace(chosen, parameters=ends[0].parameters))
        if other.criterion > chosen.criterion:
            break
        chosen = other
    return chosen, ends, static[0].chi2


def _explanation_of_some(session: SessionData) -> Explanation | None:
    """Explain a subset of many poses; return None if the subset shows neither a walk nor structured errors.

    Structured errors look like walks of many axes. With many poses they are slow to fit and not determined better.
    """
    some = session.some(SEARCHED)
    e, _, _ = explain(some)
    few_enough = session.n <= MANY_POSES
    session.shown = tuple(c for c in e.components if few_enough or c not in STRUCTURE)
    smooth = {"walk", "slope", *(c.kind for c in STRUCTURE)}
    if not few_enough or smooth.isdisjoint(c.kind for c in e.components):
        return None
    # The variance of a walk is per mean interval, which is shorter with more poses.
    shorter = np.array([(some.n - 1) / (session.n - 1) if c.kind == "walk" else 1.0 for c in e.components])
    return Explanation(e.parameters, session.everything, e.components, e.theta * shorter)


def _of_all_poses(session: SessionData, e: Explanation) -> Explanation:
    """Return an explanation of all poses with given components: estimate parameters and variances, reject outliers."""
    p, kept = e.parameters, e.kept
    problem = session.linearise(p, kept)
    at = select_explanation(problem, e.components, e.theta, (), len(session.always()))
    for _ in range(ROUNDS):
        distances = squared_length(*at.left_out())
        before, kept = kept, _membership(session, kept, distances, at)
        if (kept != before).any():
            problem = session.linearise(p, kept)
            at = point(problem.with_only(at.components), at.components, at.theta)
        elif at.squared_step >= SETTLED:
            p, problem, at = _settle(session, p, kept, problem, at)
        else:
            break
    return Explanation(p, before, at.components, at.theta, _criterion(session, at, distances), noise=at.noise)


def _with_expected_noise(session: SessionData, e: Explanation) -> Explanation:
    """Replace the likeliest white noise by its posterior mean, if the noise was not measured."""
    if session.measured:
        return e
    problem = session.linearise(e.parameters, e.kept)
    theta = expected_variances(problem, point(problem, e.components, e.theta))
    return replace(e, theta=theta, noise=None)


def _is_quiet(session: SessionData, best: Minimum) -> bool:
    """Whether the measured noise explains the residuals, which means that no component or outlier would be found."""
    always, candidates = session.always(), [*session.candidates(), *session.structure()]
    if not session.measured or always or session.drift == "linear":
        return False
    if best.chi2 > float(chi2_isf(session.dof(session.everything), SUSPICIOUS)):
        return False
    if session.n > MANY_POSES and session.drift == "none":
        return True  # among so many poses, an outlier that matters would increase chi2
    problem = session.linearise(best.parameters, session.everything)
    at = maximise(problem, (), np.zeros(0))
    if _stand_out(session, squared_length(*at.left_out())):
        return False
    return not candidates or bool(_predicted_gains(problem, at, candidates)[0].max() < WORTH_A_TRY)


def _explanations(session: SessionData, minima: list[Minimum], weights: Array) -> list[Explanation]:
    """Return explanations that start from all poses and, if these may contain outliers, from poses that agree."""
    p = minima[0].parameters
    explanations = [_improve(session, p, session.everything)]
    if explanations[0].noticed:
        tried = [(p, session.everything), (explanations[0].parameters, explanations[0].kept)]
        for robust in session.once("agreeing", lambda: _find_agreeing(session, weights, minima)):
            if any(session.descent.same(robust[0], q) and (robust[1] == k).all() for q, k in tried):
                continue
            explanations.append(_improve(session, *robust))
            tried += [robust, (explanations[-1].parameters, explanations[-1].kept)]
    return explanations


def _improve(session: SessionData, p: Parameters, kept: Kept) -> Explanation:
    """Improve parameters, variances, components and rejected poses in turn, until nothing changes."""
    always, candidates, structure = session.always(), session.candidates(), session.structure()
    best, problem, at = session.once((p, kept.tobytes()), lambda: _first_explanation(session, p, kept))
    tried = not structure
    for _ in range(ROUNDS):
        chosen, kept = set(at.components), problem.kept
        best, p, problem, at, ends = session.once((best, at), partial(_improve_once, session, best, p, problem, at))
        if (problem.kept != kept).any():
            continue
        if ends or (tried and set(at.components) == chosen):
            break
        # What the compensation models (gain, cross-talk, drift) is tried first: structured errors would displace it.
        tried = True
        again = select_explanation(problem, at.components, at.theta, [*candidates, *structure], len(always))
        if set(again.components) == set(at.components):
            break
        at = again
    return best


def _first_explanation(session: SessionData, p: Parameters, kept: Kept) -> tuple[Explanation, Linearised, Point]:
    """Return the explanation from which the search starts, after a first selection of variance components."""
    problem, always = session.linearise(p, kept), session.always()
    at = select_explanation(problem, always, session.start(problem, always), session.candidates(), len(always))
    return Explanation(p, kept), problem, at


def _improve_once(
    session: SessionData, best: Explanation, p: Parameters, problem: Linearised, at: Point
) -> tuple[Explanation, Parameters, Linearised, Point, bool]:
    """Improve all but the choice of further components; the last value returned tells whether the search may stop."""
    candidates, needed, kept = session.candidates(), len(session.always()), problem.kept
    at = _with_response_instead(problem, at, candidates, needed)
    if session.drift == "auto":
        at = with_walks_instead(problem, at, candidates, needed)
        at = with_slopes_instead(problem, at, needed)
    p, problem, at = _settle(session, p, kept, problem, at)
    distances = squared_length(*at.left_out())
    criterion = _criterion(session, at, distances)
    if not criterion < best.criterion - 1e-3:
        return best, p, problem, at, False
    # If many poses have Gaussian residuals, no outliers are hidden among them.
    if kept.all() and _are_gaussian(session, distances):
        return Explanation(p, kept, at.components, at.theta, criterion, noise=at.noise), p, problem, at, True
    noise_found = {"white", "rotation"} & {c.kind for c in at.components[needed:]}
    noticed = session.n >= FEWEST_TO_REJECT_FROM and (bool(noise_found) or _stand_out(session, distances))
    best = Explanation(p, kept, at.components, at.theta, criterion, noticed, at.noise)
    kept = _membership(session, kept, distances, at)
    if (kept != best.kept).any():
        problem = session.linearise(p, kept)
        at = select_explanation(problem, at.components, at.theta, (), needed)
    return best, p, problem, at, False


def _settle(
    session: SessionData, p: Parameters, kept: Kept, problem: Linearised, at: Point
) -> tuple[Parameters, Linearised, Point]:
    """Alternate between a descent of the parameters and an estimate of the variances, until convergence."""
    for _ in range(ROUNDS):
        if at.squared_step < SETTLED:
            break
        p = session.descent.down(session.statistics(at.noise, p), p).parameters
        problem = session.linearise(p, kept)
        at = maximise(problem, at.components, at.theta)
        if at.squared_step < SETTLED and not kept.all():  # drop components needed only for rejected poses
            at = select_explanation(problem, at.components, at.theta, (), len(session.always()))
    return p, problem, at


def _membership(session: SessionData, kept: Kept, distances: Array, at: Point) -> Kept:
    """Return which poses are kept: reject outliers, the worst first, and readmit poses that fit again."""
    limit = _limit(session, at)
    # The worst first, because an outlier distorts the fit and makes good poses look wrong.
    out = kept & (distances > max(limit, float(distances[kept].max()) / 4))
    after = (kept & ~out) | (~kept & (distances < limit))
    return after if after.sum() >= fewest_kept(session.n) else kept


def _limit(session: SessionData, at: Point) -> float:
    """Return the squared Mahalanobis distance that one good pose in a thousand exceeds."""
    estimated = any(c.kind == "white" for c in at.components)
    return 6 * float(f_ppf(6, session.dof(at.problem.kept), 1 - FALSE_REJECTION)) if estimated else FARTHEST


def _criterion(session: SessionData, at: Point, distances: Array) -> float:
    """Return the criterion of the module docstring: penalised -2 log likelihood plus the costs of rejected poses."""
    value, rejected, limit = -2 * at.worth, ~at.problem.kept, _limit(session, at)
    if rejected.any():
        far = np.maximum(distances[rejected], limit)
        value += float(np.linalg.slogdet(at.left_out()[1][rejected])[1].sum())
        value += float(np.sum(limit + 6 * np.log(far / limit)))
    return value


def _with_all_minima(session: SessionData, e: Explanation, others: list[Minimum]) -> list[Minimum]:
    """Return all minima of the joint cost under the noise model of the explanation."""
    noise = noise_under(session, e, e.parameters)
    statistics, logdet = session.statistics(noise, e.parameters), noise.logdet
    ends = [
        session.descent.down(statistics, start) for start in (e.parameters, *(minimum.parameters for minimum in others))
    ]
    if e.noise_moves:  # compare the minima, each under the noise model that belongs to it
        least = ends[0].chi2
        ends = [_under_own_noise(session, e, end, logdet) if end.chi2 < least + FAR else end for end in ends]
    return session.descent.distinct(ends)


def _under_own_noise(session: SessionData, e: Explanation, end: Minimum, logdet: float) -> Minimum:
    """Descend with the noise model at the minimum; the change of its log-determinant from `logdet` is added to chi2."""
    for _ in range(2):
        noise = noise_under(session, e, end.parameters)
        end = session.descent.down(session.statistics(noise, end.parameters), end.parameters)
    return replace(end, chi2=end.chi2 + noise.logdet - logdet)


def noise_under(session: SessionData, e: Explanation, p: Parameters) -> Noise:
    """Return the noise model of an explanation at given parameters."""
    if e.noise is not None and not e.noise_moves:
        return e.noise
    return noise_of(session.linearise(p, e.kept), e.components, e.theta)


def _are_gaussian(session: SessionData, distances: Array) -> bool:
    """Whether the squared distances have a chi-square distribution (Kolmogorov-Smirnov test); False for few poses."""
    if session.n < POSES_FOR_THE_SHAPE or _stand_out(session, distances):
        return False
    share = chi2_cdf(6, np.sort(distances))
    apart = float(np.abs(share - (np.arange(session.n) + 0.5) / session.n).max())
    return apart < float(np.sqrt(np.log(2 / SUSPICIOUS) / (2 * session.n)))


def _stand_out(session: SessionData, distances: Array) -> bool:
    """Whether there are outliers among the poses: single ones, or so many that no single one stands out."""
    if session.n < FEWEST_TO_REJECT_FROM:
        return False
    tail = float(np.median(distances)) / MEDIAN_DISTANCE / (float(distances.mean()) / 6)
    return bool(distances.max() > chi2_isf(6, 2 * SUSPICIOUS / session.n)) or tail < LIGHT_TAIL


def _find_agreeing(session: SessionData, weights: Array, minima: list[Minimum]) -> list[tuple[Parameters, Kept]]:
    """Return sets of poses that agree within the noise, and within a noise scaled so that half of all poses fit."""
    starts = [m.parameters for m in minima]
    problem, always = session.linearise(starts[0], session.everything), session.always()
    at = maximise(problem, always, session.start(problem, always))
    sets = [agreeing_poses(session.descent, weights, starts)] if session.measured else []
    if not session.measured:
        weights = np.asarray(at.own.W, dtype=np.float64)
    scale, robust = float(np.median(squared_length(*at.left_out()))) / MEDIAN_DISTANCE, None
    for _ in range(4):
        agreeing = agreeing_poses(session.descent, weights / scale, starts)
        if agreeing is None:
            break
        robust = agreeing
        e = session.wrench - predict(robust[0], session.R)
        d2 = np.einsum("ni,nij,nj->n", e, weights, e, optimize=True)
        before, scale = scale, float(np.median(d2)) / MEDIAN_DISTANCE * session.n / (session.n - 2.5)
        if scale > 0.7 * before:
            break
    return [agreeing for agreeing in (*sets, robust) if agreeing is not None]
