"""Which components of the noise the data show: added, dropped and exchanged by restricted likelihood."""

from collections.abc import Sequence

import numpy as np

from ftcalib.likelihood.variance_components import (
    FORCE,
    HYSTERESIS,
    NEGLIGIBLE,
    RESPONSE,
    ROTATION,
    TORQUE,
    Component,
    Linearised,
    Point,
    component,
    maximise,
    point,
    score,
    units,
)
from ftcalib.model import Array

SURE = 20.0  # a gain or loss that no other component can regain
WORTH_A_TRY = 1.0  # gain predicted from slope and curvature at zero
USUAL_HYSTERESIS = 0.001
SMALL_RESPONSE, USUAL_RESPONSE = 0.005, 0.02  # gain and cross-talk of real sensors


def select(
    problem: Linearised,
    components: Sequence[Component],
    theta: Array,
    candidates: Sequence[Component],
    needed: int | None = None,
) -> Point:
    """Add the candidates that raise the likelihood, one by one, then drop those that others make needless.

    Parameters
    ----------
    problem : Linearised
    components : sequence of Component
        To start from.
    theta : array, shape (k,)
        Their variances.
    candidates : sequence of Component
    needed : int, optional
        How many of the components, the first, are part of the model; by default all.
    """
    needed = len(components) if needed is None else needed
    best = _pruned(problem, maximise(problem, components, theta), needed)
    waiting = [c for c in candidates if c not in best.components]
    while waiting:
        gains, start = predicted_gains(problem, best, waiting)
        k = int(np.argmax(gains))
        if gains[k] < WORTH_A_TRY:
            break
        # What is as good as certain comes in together: the needless among them are dropped in the end.
        wanted = best.loglik + waiting[k].needed
        for together in ([int(i) for i in np.argsort(-gains) if i == k or gains[i] > SURE], [k]):
            components = [*best.components, *(waiting[i] for i in together)]
            trial = maximise(problem, components, np.append(best.theta, start[together]), wanted)
            if not trial.too_large:
                break
        if trial.loglik > wanted and not trial.too_large:
            best = trial
        waiting = [c for i, c in enumerate(waiting) if i not in together]
    return best if len(best.components) - needed <= 1 else _pruned(problem, best, needed)


def with_response_instead(problem: Linearised, best: Point, candidates: Sequence[Component], needed: int) -> Point:
    """Try gain and cross-talk together in place of white noise as large as a small gain.

    A mounting that fits the torques alone makes the forces look noisy, and the gain that would explain them useless.
    """
    added = [c for c in RESPONSE if c in candidates]
    if not added or all(c.kind != "white" for c in best.components):
        return best
    if len(problem.r) * max(units(problem, best, added)) < SMALL_RESPONSE**2:
        return best
    rest = [k for k, c in enumerate(best.components) if c not in added and (k < needed or c.kind != "white")]
    quiet = [best.theta[k] * (1e-2 if best.components[k].kind == "white" else 1.0) for k in rest]
    start = np.append(quiet, np.full(len(added), USUAL_RESPONSE**2))
    return _better(problem, best, [*(best.components[k] for k in rest), *added], start, needed)


def with_walks_instead(problem: Linearised, best: Point, candidates: Sequence[Component], needed: int) -> Point:
    """Try a walk, gain and cross-talk together in place of the white noise of a group.

    One at a time they may bring less than white noise, which then takes their place.
    """
    for group in (FORCE, TORQUE):
        walk = component("walk", group)
        drifts = any(c.kind in ("walk", "slope") and c.share[group[0]] for c in best.components)
        noisy = any(c.kind == "white" and c.share[group[0]] for c in best.components)
        if walk not in candidates or drifts or not noisy or len(best.components) == needed:
            continue
        rest = [k for k, c in enumerate(best.components) if k < needed or c.kind != "white" or not c.share[group[0]]]
        kept = [best.components[k] for k in rest]
        added = [walk, *(c for c in RESPONSE if c in candidates and c not in kept)]
        start = np.append(best.theta[rest], units(problem, best, added))
        best = _better(problem, best, [*kept, *added], start, needed)
    return best


def with_slopes_instead(problem: Linearised, best: Point, needed: int) -> Point:
    """Try a linear drift of the same groups in place of random walks; keep what is likelier."""
    walks = [k for k, c in enumerate(best.components) if c.kind == "walk"]
    if not walks:
        return best
    rest = [k for k in range(len(best.components)) if k not in walks]
    groups = [g for g in (FORCE, TORQUE) if any(best.components[k].share[c] for k in walks for c in g)]
    slopes = [component("slope", group) for group in groups]
    start = [
        len(problem.r) * max(best.theta[k] for k in walks if any(best.components[k].share[c] for c in g))
        for g in groups
    ]
    # Without the walk white noise is larger.
    noise = [
        best.theta[k] + sum(best.theta[w] for w in walks if np.dot(best.components[w].share, best.components[k].share))
        for k in rest
    ]
    components = [*(best.components[k] for k in rest), *slopes]
    trial = maximise(problem, components, np.append(noise, start), best.loglik)
    return _pruned(problem, trial, needed) if trial.loglik > best.loglik else best


def _better(problem: Linearised, best: Point, components: Sequence[Component], theta: Array, needed: int) -> Point:
    """Try other components; keep what is worth more."""
    trial = maximise(problem, components, theta, best.worth)
    if trial.loglik > best.worth:
        trial = _pruned(problem, trial, needed)
    return trial if trial.worth > best.worth and not trial.too_large else best


def _pruned(problem: Linearised, best: Point, needed: int) -> Point:
    """Drop components that raise the likelihood too little: those without effect at once, then one at a time."""
    if best.components:
        seen = best.theta >= NEGLIGIBLE * units(problem, best, best.components)
        seen[:needed] = True
        if not seen.all():
            without = point(problem, [best.components[i] for i in np.flatnonzero(seen)], best.theta[seen], best)
            best = without if without.worth > best.worth else best
    k = needed
    while k < len(best.components):
        rest = [i for i in range(len(best.components)) if i != k]
        components, theta = [best.components[i] for i in rest], best.theta[rest]
        without = point(problem, components, theta, best)  # the others can regain a part of what is lost
        if best.loglik - without.loglik < SURE:
            without = maximise(problem, components, theta, best.loglik - best.components[k].needed)
        if without.worth > best.worth:
            best, k = without, needed
        else:
            k += 1
    return best


def predicted_gains(problem: Linearised, best: Point, waiting: Sequence[Component]) -> tuple[Array, Array]:
    """Gain in log-likelihood that each candidate alone promises, and where to start climbing."""
    start = units(problem, best, waiting)
    components, theta = [*best.components, *waiting], np.concatenate([best.theta, NEGLIGIBLE * start])
    at = point(problem, components, theta) if best.own.walks else best
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


def rivals(problem: Linearised, best: Point, candidates: Sequence[Component]) -> list[tuple[Point, float]]:
    """Give other explanations that the data do not exclude, with their shares of the probability; `best` has the rest.

    They are: all candidates that were not found, as large as slope and curvature at zero promise; gain and cross-talk
    as large as the larger of both; hysteresis in place of inexact orientations.
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
    odds = [float(np.exp(min(one.loglik - best.loglik + bonus, 0.0))) for one, bonus in others]
    return [(one, odd / (1 + sum(odds))) for (one, _), odd in zip(others, odds, strict=True)]


def _with_all(problem: Linearised, best: Point, waiting: Sequence[Component]) -> Point:
    """Add the candidates whose variance is positive where the likelihood, as a parabola from zero, is largest."""
    start = NEGLIGIBLE * units(problem, best, waiting)
    components, theta = [*best.components, *waiting], np.concatenate([best.theta, start])
    at = point(problem, components, theta) if best.own.walks else best
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
