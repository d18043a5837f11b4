"""Variance components by restricted maximum likelihood: what acts on the wrenches beyond the measured noise.

Restricted likelihood (Patterson, Thompson 1971) allows for the parameters fitted to the same data. It is maximised over
the logarithms of the variances with average information (Gilmour, Thompson, Cullis 1995), all in O(n).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from ftcalib.likelihood.session_noise import Noise, centred, summed_products, walk_times
from ftcalib.model import Array

GAIN = 2.0
"""A component stays when it raises the restricted log-likelihood by more than this: 2 % come in by chance."""
GAIN_OF_RESPONSE = 3.0
"""The same for gain and cross-talk of the sensor, whose 5 and 6 numbers come in by chance in 0.4 %."""
SETTLED = 1e-4  # squared distance from the best variances, in their standard deviations
NEGLIGIBLE = 1e-4  # of the white noise: where slope and curvature "at zero" are taken
LARGEST = {"rotation": float(np.deg2rad(3.0)) ** 2, "gain": 0.05**2, "cross_talk": 0.05**2}
"""Variances that no arm or sensor in working order exceeds. A larger one has another cause."""
POSES_THAT_SHOW_THE_NOISE = 1000  # fewer leave its size uncertain enough to matter
_AXES = ("fx_N", "fy_N", "fz_N", "tx_Nm", "ty_Nm", "tz_Nm")

Kind = Literal["white", "walk", "slope", "rotation", "gain", "cross_talk"]


@dataclass(frozen=True, slots=True)
class Component:
    """One unknown variance, common to some channels."""

    name: str
    kind: Kind
    share: tuple[float, ...]
    """(6,) by which the variance is multiplied in each channel."""

    @property
    def needed(self) -> float:
        """The gain in log-likelihood that it must bring."""
        return GAIN_OF_RESPONSE if self.kind in ("gain", "cross_talk") else GAIN


def component(kind: Kind, channels: Sequence[int]) -> Component:
    """Name a component of one channel or of a group of three."""
    what = _AXES[channels[0]] if len(channels) == 1 else "force_N" if channels[0] == 0 else "torque_Nm"
    return Component(f"{kind}_{what}", kind, tuple(float(c in channels) for c in range(6)))


FORCE, TORQUE = range(3), range(3, 6)
ROTATION = Component("rotation_rad", "rotation", (0.0,) * 6)
RESPONSE = tuple(Component(kind, kind, (0.0,) * 6) for kind in ("gain", "cross_talk"))


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
    """(n, 6, 6) measured noise of each pose, or a lower bound where the noise is unknown."""
    time: Array
    """(n,) ascending, in mean intervals."""
    kept: NDArray[np.bool_]
    """(n,)"""
    slope: Array | None
    """(6,) as in `Noise`, for linear drift that is part of the model."""
    response: Array
    """(n, 6, 11) derivative by gain and cross-talk of the sensor."""

    def columns(self, c: Component) -> Array | None:
        """(n, 6, k) derivative by what acts on all poses at once; None for what acts on each by itself."""
        if c.kind == "slope":
            return np.asarray(centred(self.time)[:, None, None] * np.eye(6)[:, np.flatnonzero(c.share)])
        if c.kind == "gain":
            return self.response[..., :5]
        return self.response[..., 5:] if c.kind == "cross_talk" else None


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

    @property
    def worth(self) -> float:
        """The log-likelihood less what each component must bring."""
        return self.loglik - sum(c.needed for c in self.components)

    @property
    def too_large(self) -> bool:
        """Whether a variance is at the limit of what has this cause."""
        return any(v >= LARGEST.get(c.kind, np.inf) for c, v in zip(self.components, self.theta, strict=True))

    def left_out(self) -> tuple[Array, Array]:
        """Residual (n, 6) of each pose when all others predict it, and its covariance (n, 6, 6)."""
        return left_out(self.noise, self.WJ, self.u, self.C)


def left_out(noise: Noise, WJ: Array, u: Array, C: Array) -> tuple[Array, Array]:
    """Predict every pose from all others, drift and correlation included, without fitting again.

    The exact leave-one-out of the linear model, and the prediction of poses that do not count: `P_kk^-1 (P y)_k` with
    `P = W - W J C J' W`, W the inverse noise.

    Parameters
    ----------
    noise : Noise
    WJ : array, shape (n, 6, m)
    u : array, shape (n, 6)
        Inverse noise times the residuals.
    C : array, shape (m, m)

    Returns
    -------
    residuals : array, shape (n, 6)
    covariance : array, shape (n, 6, 6)
        Noise of the pose and uncertainty of its prediction: very large where the others determine nothing.
    """
    P = noise.blocks - WJ @ C @ np.swapaxes(WJ, 1, 2)
    rejected = ~noise.kept
    P[~rejected] += 1e-10 * noise.W[~rejected]  # however badly the others determine it
    S = np.linalg.inv(P)
    e = (S @ u[..., None])[..., 0]
    if rejected.any():
        S[rejected] -= np.linalg.inv(noise.W[rejected]) - noise.D[rejected]
    return np.asarray(e), np.asarray(S + np.swapaxes(S, 1, 2)) / 2


def squared_length(e: Array, S: Array) -> Array:
    """Square residuals (n, 6) in units of their covariance (n, 6, 6)."""
    return np.asarray((np.linalg.solve(S, e[..., None])[..., 0] * e).sum(axis=1))


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
    D, walk, white, slope = problem.D, np.zeros(6), np.zeros(6), problem.slope
    effects = []
    for c, value in zip(components, theta, strict=True):
        columns = problem.columns(c)
        if columns is not None:
            effects.append((columns, np.full(columns.shape[2], value)))
        elif c.kind == "walk":
            walk += value * np.array(c.share)
        elif c.kind == "rotation":
            D = D + value * problem.turn @ np.swapaxes(problem.turn, 1, 2)
        else:
            white += value * np.array(c.share)
    if white.any():
        D = D + np.diag(white) if D.strides[0] else np.broadcast_to(D[0] + np.diag(white), D.shape)
    joined = [np.concatenate(parts, axis=-1) for parts in zip(*effects, strict=True)]
    together = (joined[0], joined[1]) if joined else None
    return Noise(D, problem.time, np.sqrt(walk), slope, together, problem.kept)


def score(problem: Linearised, at: Point, components: Sequence[Component], theta: Array) -> tuple[Array, Array]:
    """Derivative (k,) of the restricted log-likelihood by the log variances, and average information (k, k).

    The noise at this point need not contain all of the components: for the others it is the derivative at zero, times
    `theta`.
    """
    u, WJ, C, noise = at.u, at.WJ, at.C, at.noise
    WJC = WJ @ C
    P = noise.blocks - WJC @ np.swapaxes(WJ, 1, 2)
    of_all = {c: T for c in components if (T := problem.columns(c)) is not None}
    WT = {c: (noise.solve(T), summed_products(WJ, T)) for c, T in of_all.items()}
    Ku = walk_times(problem.time, u) if any(c.kind == "walk" for c in components) else u
    white_square, white_trace, walk_square = (u**2).sum(axis=0), np.einsum("ncc->c", P), (u * Ku).sum(axis=0)
    kept = int(problem.kept.sum())
    slope, Vu = [], np.empty((*u.shape, len(components)))
    for k, (c, variance) in enumerate(zip(components, theta, strict=True)):
        share = np.array(c.share)
        if c in of_all:
            T = of_all[c]
            along = np.tensordot(u, T, 2)
            solved, JWT = WT[c]
            square, trace = float(along @ along), float(np.vdot(T, solved) - np.vdot(JWT, C @ JWT))
            Vu[..., k] = variance * (T @ along)
        elif c.kind == "white":
            square, trace = float(white_square @ share), float(white_trace @ share)
            Vu[..., k] = variance * share * u
        elif c.kind == "rotation":
            turned = (u[:, None] @ problem.turn)[:, 0]
            square, trace = float((turned**2).sum()), float(np.vdot(problem.turn, P @ problem.turn))
            Vu[..., k] = variance * (problem.turn @ turned[..., None])[..., 0]
        else:
            square = float(walk_square @ share)
            own = np.flatnonzero(share)
            if c in at.components:
                # K P = (V - D - effects) P, and V P = 1 - J C J' W.
                others = np.einsum("nck,nck->", problem.J[:, own], WJC[:, own])
                others += np.einsum("ncd,ndc->", noise.D[:, own], P[:, :, own])
                for other, value in zip(components, theta, strict=True):
                    if other in of_all:
                        solved, JWT = WT[other]
                        others += value * np.vdot(of_all[other][:, own], solved[:, own] - WJC[:, own] @ JWT)
                trace = (kept * len(own) - float(others)) / variance
            else:
                trace = noise.walk_trace(problem.time, own, (WJ, -C))
            Vu[..., k] = variance * share * Ku
        slope.append(variance * (square - trace) / 2)
    JWX = summed_products(WJ, Vu)
    information = (summed_products(Vu, noise.solve(Vu)) - JWX.T @ C @ JWX) / 2
    return np.array(slope), np.asarray(information)


def maximise(problem: Linearised, components: Sequence[Component], theta: Array) -> Point:
    """Climb to the best variances from these (k,), all positive."""
    if not components:
        return point(problem, components, theta)
    most = np.array([LARGEST.get(c.kind, np.inf) for c in components])
    best = point(problem, components, np.minimum(theta, most))
    least = np.minimum(1e-3 * NEGLIGIBLE * units(problem, best, components), most)
    caution = 1e-3
    for _ in range(60):
        slope, information = score(problem, best, best.components, best.theta)
        if float(slope @ np.linalg.lstsq(information, slope)[0]) < SETTLED:
            break
        gained = 0.0
        while caution < 1e6:
            damped = information + np.diag(caution * (np.diag(information) + 1e-3))
            step = np.clip(np.linalg.solve(damped, slope), -2.5, 2.5)
            trial = point(problem, components, np.clip(best.theta * np.exp(step), least, most))
            gained = trial.loglik - best.loglik
            if gained >= 0 or np.abs(step).max() < 1e-4:
                break
            caution *= 10
        if gained > 0:
            best, caution = trial, max(caution / 10, 1e-6)
        if (gained < 1e-3 and np.abs(step).max() < 0.05) or gained < 1e-6:
            break
        # A variance that sinks without changing the likelihood will be dropped.
        if gained < 1e-2 and (slope < 0.05).all():
            break
    return best


def estimates(problem: Linearised, at: Point) -> tuple[Array, Array]:
    """Estimate parameters, and gain and cross-talk of the sensor, under given variances.

    Returns
    -------
    values : array, shape (m + 11,)
        Step of the free parameters; best linear prediction of the coefficients, zero where none were found.
    covariance : array, shape (m + 11, m + 11)
    """
    m, size = len(at.C), problem.response.shape[2]
    found = dict(zip(at.components, at.theta, strict=True))
    variance = np.repeat([found.get(c, 0.0) for c in RESPONSE], [5, 6])
    values, covariance = np.zeros(m + size), np.zeros((m + size, m + size))
    values[:m], covariance[:m, :m] = at.step, at.C
    if variance.any():
        T = problem.response
        TWJ = summed_products(T, at.WJ)
        TPT = summed_products(T, at.noise.solve(T)) - TWJ @ at.C @ TWJ.T
        values[m:] = variance * np.tensordot(at.u, T, 2)
        covariance[m:, :m] = -variance[:, None] * TWJ @ at.C
        covariance[:m, m:] = covariance[m:, :m].T
        covariance[m:, m:] = np.diag(variance) - variance[:, None] * TPT * variance
    return values, covariance


def estimates_of_unknown_variances(problem: Linearised, at: Point) -> tuple[Array, Array]:
    """Give the `estimates` with a covariance for variances that were estimated too.

    To first order in the uncertainty of the variances: estimates move with them, and the covariance at the best
    variances is as much too small (Kenward, Roger 1997; Prasad, Rao 1990). The covariance itself is uncertain: as the
    95 % interval of Student's distribution is wider by (z² + 1) / (4 nu), so is sigma, nu by Satterthwaite (1946).
    """
    x, C = estimates(problem, at)
    if not at.components or len(problem.r) >= POSES_THAT_SHOW_THE_NOISE:
        return x, C
    _, information = score(problem, at, at.components, at.theta)
    uncertainty = np.linalg.pinv(information, rcond=1e-6, hermitian=True)
    k, h = len(at.theta), 1e-3
    around = [estimates(problem, point(problem, at.components, at.theta * np.exp(h * row))) for row in np.eye(k)]
    moves, changes = ([(part[i] - own) / h for part in around] for i, own in enumerate((x, C)))
    scale = np.sqrt(np.diag(C))
    scale[scale == 0] = 1.0
    inverse = np.linalg.pinv(C / np.outer(scale, scale), rcond=1e-10, hermitian=True) / np.outer(scale, scale)
    wider = (1.96**2 + 1) / 4 * np.einsum("ij,iab,bc,jcd->ad", uncertainty, changes, inverse, changes, optimize=True)
    return x, C + 2 * np.transpose(moves) @ uncertainty @ np.array(moves) + wider


def units(problem: Linearised, best: Point, components: Sequence[Component]) -> Array:
    """Variances (k,) at which each component is about as large as the white noise."""
    kept, n = problem.kept, int(problem.kept.sum())
    variance = np.einsum("ncc,n->c", best.noise.D, kept) / n
    units = []
    for c in components:
        columns = problem.columns(c) if c.kind != "slope" else None
        if columns is not None or c.kind == "rotation":
            columns = problem.turn if columns is None else np.sqrt(n) * columns
            square = np.einsum("ncd,ncd,n->c", columns, columns, kept.astype(np.float64)) / (n * columns.shape[2])
            units.append(float(1 / np.max(square / variance)))
        else:
            share = np.array(c.share)
            units.append(float((variance @ share) / share.sum()) / (n if c.kind == "walk" else 1))
    return np.array(units)
