"""Variance components by restricted maximum likelihood: what acts on the wrenches beyond the measured noise.

Restricted likelihood (Patterson, Thompson 1971) allows for the parameters fitted to the same data. It is maximised over
the logarithms of the variances with average information (Gilmour, Thompson, Cullis 1995), all in O(n).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from calib.covariance import Noise, centred, summed_products, walk_square, walk_times
from calib.model import Array

GAIN = 2.0
"""A component stays when it raises the restricted log-likelihood by more than this."""
SURE = 20.0  # a gain or loss that no other component makes good
WORTH_A_TRY = 1.0  # gain predicted from slope and curvature at zero
NEGLIGIBLE = 1e-4  # of the white noise: where slope and curvature "at zero" are taken
FAR = 1e12  # a rejected pose counts as this much noisier
_AXES = ("fx_N", "fy_N", "fz_N", "tx_Nm", "ty_Nm", "tz_Nm")

Kind = Literal["white", "walk", "slope", "rotation"]


@dataclass(frozen=True, slots=True)
class Component:
    """One unknown variance, common to some channels."""

    name: str
    kind: Kind
    share: tuple[float, ...]
    """(6,) by which the variance is multiplied in each channel."""


def component(kind: Kind, channels: Sequence[int]) -> Component:
    """Name a component of one channel or of a group of three."""
    what = _AXES[channels[0]] if len(channels) == 1 else "force_N" if channels[0] == 0 else "torque_Nm"
    return Component(f"{kind}_{what}", kind, tuple(float(c in channels) for c in range(6)))


FORCE, TORQUE = range(3), range(3, 6)
ROTATION = Component("rotation_rad", "rotation", (0.0,) * 6)


@dataclass(frozen=True, slots=True, eq=False)
class Linearised:
    """The estimation problem near its solution."""

    J: Array
    """(n, 6, m) derivative by the free parameters."""
    r: Array
    """(n, 6)"""
    prior: tuple[Array, Array]
    """Information (m, m) and right-hand side (m,) of what was known before."""
    turn: Array
    """(n, 6, 3) derivative by the orientation of each pose."""
    D: Array
    """(n, 6, 6) measured noise of each pose, or what is surely there when nobody measured it."""
    time: Array
    """(n,) ascending, in mean intervals."""
    kept: NDArray[np.bool_]
    """(n,)"""
    slope: Array | None
    """(6,) as in `Noise`, for linear drift that is part of the model."""


@dataclass(frozen=True, slots=True, eq=False)
class Point:
    """Restricted likelihood for given variances, and what it was made from."""

    components: tuple[Component, ...]
    theta: Array
    noise: Noise
    WJ: Array
    """(n, 6, m) inverse covariance times derivative."""
    u: Array
    """(n, 6) inverse covariance times residuals of the best parameters."""
    C: Array
    """(m, m) covariance of the free parameters."""
    step: Array
    """(m,) from where the problem was linearised to the best parameters."""
    loglik: float


def point(problem: Linearised, components: Sequence[Component], theta: Array) -> Point:
    """Evaluate the restricted likelihood."""
    noise = noise_of(problem, components, theta)
    m = problem.J.shape[2]
    X = np.concatenate([problem.J, problem.r[..., None]], axis=2)
    WX = noise.solve(X)
    G = summed_products(X, WX)
    H, g = G[:m, :m] + problem.prior[0], G[:m, m] + problem.prior[1]
    scale = np.sqrt(np.diag(H))
    value, vector = np.linalg.eigh(H / np.outer(scale, scale))
    value = np.maximum(value, 1e-14 * value[-1])
    root = vector / np.sqrt(value) / scale[:, None]
    C = root @ root.T
    step = C @ g
    logdet = noise.logdet + float(np.log(value).sum() + 2 * np.log(scale).sum())
    loglik = -0.5 * (logdet + float(G[m, m] - g @ step))
    return Point(tuple(components), theta, noise, WX[..., :m], WX[..., m] - WX[..., :m] @ step, C, step, loglik)


def noise_of(problem: Linearised, components: Sequence[Component], theta: Array) -> Noise:
    """Give the covariance with these variances."""
    D = problem.D.copy() if components or not problem.kept.all() else problem.D
    variances = {kind: np.zeros(6) for kind in ("white", "walk", "slope")}
    for c, value in zip(components, theta, strict=True):
        if c.kind == "rotation":
            D += value * problem.turn @ np.swapaxes(problem.turn, 1, 2)
        else:
            variances[c.kind] += value * np.array(c.share)
    if variances["white"].any():
        D[:, range(6), range(6)] += variances["white"]
    if not problem.kept.all():
        typical = D[problem.kept].mean(axis=0)
        D[~problem.kept] = FAR * np.diag(np.diag(typical))
    slope = problem.slope if problem.slope is not None else np.sqrt(variances["slope"])
    return Noise(D, problem.time, np.sqrt(variances["walk"]), slope)


def _score(problem: Linearised, at: Point) -> tuple[Array, Array]:
    """Derivative (k,) of the restricted log-likelihood by the log variances, and average information (k, k)."""
    u, WJ, C, noise = at.u, at.WJ, at.C, at.noise
    WJC = WJ @ C
    P = noise.blocks - WJC @ np.swapaxes(WJ, 1, 2)
    t = centred(problem.time)
    slope, Vu = [], []
    for c, theta in zip(at.components, at.theta, strict=True):
        share = np.array(c.share)
        if c.kind == "white":
            square, trace = float((u**2).sum(axis=0) @ share), float(np.einsum("ncc,c->", P, share))
            Vu.append(theta * share * u)
        elif c.kind == "rotation":
            turned = (u[:, None] @ problem.turn)[:, 0]
            square, trace = float((turned**2).sum()), float(np.vdot(problem.turn, P @ problem.turn))
            Vu.append(theta * (problem.turn @ turned[..., None])[..., 0])
        elif c.kind == "walk":
            square = float(walk_square(problem.time, u) @ share)
            # K P = (V - D) P, and V P = 1 - J C J' W.
            own = np.flatnonzero(share)
            explained = np.einsum("nck,nck->c", problem.J[:, own], WJC[:, own])
            white = np.einsum("ncd,ndc->c", noise.D[:, own], P[:, :, own])
            trace = float(np.sum(len(u) - explained - white)) / theta
            Vu.append(theta * share * walk_times(problem.time, u))
        else:
            T = t[:, None, None] * np.eye(6)
            PT = noise.solve(T)
            JWT = np.einsum("nik,nil->kl", WJ, T)
            tPt = np.einsum("nic,nic->c", T, PT) - np.einsum("kc,kl,lc->c", JWT, C, JWT)
            along = t @ u
            square, trace = float(along**2 @ share), float(tPt @ share)
            Vu.append(theta * share * np.outer(t, along))
        slope.append(theta * (square - trace) / 2)
    X = np.stack(Vu, axis=-1)
    WX = noise.solve(X)
    JWX = summed_products(WJ, X)
    information = (summed_products(X, WX) - JWX.T @ C @ JWX) / 2
    return np.array(slope), np.asarray(information)


def maximise(problem: Linearised, components: Sequence[Component], theta: Array) -> Point:
    """Climb to the best variances from these (k,), all positive."""
    best = point(problem, components, theta)
    if not components:
        return best
    least = 1e-3 * NEGLIGIBLE * np.array([_unit(problem, best, c) for c in components])
    caution = 1e-3
    for _ in range(60):
        slope, information = _score(problem, best)
        gained = 0.0
        while caution < 1e6:
            damped = information + np.diag(caution * (np.diag(information) + 1e-3))
            step = np.clip(np.linalg.solve(damped, slope), -2.5, 2.5)
            trial = point(problem, components, np.maximum(best.theta * np.exp(step), least))
            gained = trial.loglik - best.loglik
            if gained >= 0 or np.abs(step).max() < 1e-4:
                break
            caution *= 10
        if gained > 0:
            best, caution = trial, max(caution / 10, 1e-6)
        if (gained < 1e-3 and np.abs(step).max() < 0.05) or gained < 1e-6:
            break
        # What sinks without changing the likelihood has left: it will be dropped.
        if gained < 1e-2 and (slope < 0.05).all():
            break
    return best


def select(problem: Linearised, always: Sequence[Component], theta: Array, candidates: Sequence[Component]) -> Point:
    """Add the candidates that the data ask for, one by one, then drop those that others make needless."""
    best = maximise(problem, always, theta)
    waiting = list(candidates)
    while waiting:
        gains, start = predicted_gains(problem, best, waiting)
        k = int(np.argmax(gains))
        if gains[k] < WORTH_A_TRY:
            break
        # Walks that are as good as certain come in together: each channel has its own.
        certain = gains > SURE if waiting[k].kind == "walk" else np.zeros(len(gains), bool)
        together = [i for i, c in enumerate(waiting) if i == k or (c.kind == "walk" and certain[i])]
        trial = maximise(
            problem, [*best.components, *(waiting[i] for i in together)], np.append(best.theta, start[together])
        )
        waiting = [c for i, c in enumerate(waiting) if i not in together]
        if trial.loglik > best.loglik + GAIN:
            best = trial
    return _pruned(problem, best, len(always))


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
    components = [*(best.components[k] for k in rest), *slopes]
    trial = maximise(problem, components, np.append(best.theta[rest], start))
    return _pruned(problem, trial, needed) if trial.loglik > best.loglik else best


def _pruned(problem: Linearised, best: Point, needed: int) -> Point:
    k = needed
    while needed < len(best.components) - 1 and k < len(best.components):
        rest = [i for i in range(len(best.components)) if i != k]
        if best.components[k].kind == "walk" and _loss(problem, best, rest) > SURE:
            k += 1
            continue
        without = maximise(problem, [best.components[i] for i in rest], best.theta[rest])
        if without.loglik > best.loglik - GAIN:
            best, k = without, needed
        else:
            k += 1
    return best


def _loss(problem: Linearised, best: Point, rest: list[int]) -> float:
    """How much worse it gets with only the rest of the components, the others as they are."""
    return best.loglik - point(problem, [best.components[i] for i in rest], best.theta[rest]).loglik


def predicted_gains(problem: Linearised, best: Point, waiting: Sequence[Component]) -> tuple[Array, Array]:
    """Gain in log-likelihood that each candidate alone promises, and where to start climbing."""
    small = NEGLIGIBLE * np.array([_unit(problem, best, c) for c in waiting])
    at = point(problem, [*best.components, *waiting], np.concatenate([best.theta, small]))
    slope, information = _score(problem, at)
    k = len(best.components)
    curvature = np.diag(information)[k:]
    known = information[:k, k:]
    if k:
        curvature = curvature - np.einsum("ki,ki->i", known, np.linalg.lstsq(information[:k, :k], known)[0])
        slope_k = slope[k:] - known.T @ np.linalg.lstsq(information[:k, :k], slope[:k])[0]
    else:
        slope_k = slope
    safe = np.maximum(curvature, 1e-300)
    gains = np.where(slope_k > 0, slope_k**2 / (2 * safe), 0.0)
    return gains, small / NEGLIGIBLE


def _unit(problem: Linearised, best: Point, c: Component) -> float:
    """Variance at which a component is about as large as the white noise."""
    variance = np.diagonal(best.noise.D[problem.kept], axis1=1, axis2=2).mean(axis=0)
    n = int(problem.kept.sum())
    if c.kind == "rotation":
        size = (problem.turn[problem.kept] ** 2).mean(axis=(0, 2))
        return float(1 / np.max(size / variance))
    share = np.array(c.share)
    return float((variance * share).sum() / share.sum()) / (n if c.kind == "walk" else 1)
