"""Variance components by restricted maximum likelihood: error sources beyond the measured noise of each pose.

The residuals r of all poses at the current parameters follow a linear mixed model,

    r = J x + T u + e,    e ~ N(0, V),    u_k ~ N(0, theta_k I),    V = blockdiag(D_i + white + rotation) + walk

with x the step of the parameters, u the coefficients of errors common to all poses (`EFFECTS`), and V linear in the
variances theta of its components. With X = (J, T), W = V^-1 and the prior information H0, g0 of x, the mixed model
equations (Henderson, Biometrics 31, 1975) estimate x and u together,

    H = X' W X + blockdiag(H0, I / theta_k),    C = H^-1,    (x, u) = C g,    g = X' W r + (g0, 0)

and the restricted likelihood (Patterson and Thompson, Biometrika 58, 1971), which corrects for the estimation of x, is

    -2 log L(theta) = log det V + sum_k size_k log theta_k + log det H + r' W r - g' C g.

It is maximised over log theta with score and average information (Gilmour, Thompson and Cullis, Biometrics 51, 1995),

    P = W - W X C X' W,    V_k = theta_k dV / dtheta_k, or theta_k T_k T_k' for a component of u
    score_k = (r' P V_k P r - tr(P V_k)) / 2,    information_kl = r' P V_k P V_l P r / 2,

all in O(n). A linear drift of unknown size is a part of u with infinite variance.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.linalg.lapack import dpotrf, dtrtri

from ftcalib.likelihood.descent import column_scale
from ftcalib.likelihood.session_noise import Noise, centre, summed_products, walk_times
from ftcalib.model import Array

# Smallest gain in restricted log-likelihood for keeping a component; 2 % of absent components pass by chance.
GAIN = 2.0
# Smallest gain of components with several coefficients, such as gain and cross-talk; 0.4 % pass by chance.
GAIN_OF_RESPONSE = 3.0
# Convergence: squared distance to the maximum, in standard deviations of the log variances.
SETTLED = 1e-2
# Levenberg-Marquardt damping above which a step is noticeably shortened.
CAREFUL = 0.3
# Upper bound of what an ascent can still gain, as a multiple of the quadratic prediction from score and information.
HOPE = 10.0
# Variance, relative to the white noise, at which score and information of an absent component are evaluated.
NEGLIGIBLE = 1e-4
# Upper bounds of the variances of an arm and a sensor in working order. A larger variance has another cause.
LARGEST = {
    "rotation": float(np.deg2rad(3.0)) ** 2,
    "gain": 0.05**2,
    "cross_talk": 0.05**2,
    "hysteresis": 0.03**2,
    "kinematics": float(np.deg2rad(1.0)) ** 2,
    "load": 0.05**2,
}
# With fewer poses than this, the covariance of the estimates includes the uncertainty of the variances.
POSES_THAT_SHOW_THE_NOISE = 1000
_AXES = ("fx_N", "fy_N", "fz_N", "tx_Nm", "ty_Nm", "tz_Nm")

Kind = Literal["white", "walk", "slope", "rotation", "gain", "cross_talk", "hysteresis", "load", "cable", "kinematics"]
# Kinds of variance components whose coefficients are common to all poses, except the slope of a drift.
EFFECTS = ("gain", "cross_talk", "hysteresis", "load", "cable", "kinematics")


@dataclass(frozen=True, slots=True)
class Component:
    """Variance component: one unknown variance, shared by some channels."""

    name: str
    kind: Kind
    share: tuple[float, ...]
    """(6,) factors with which the variance acts on each channel; 0 for channels without it."""

    @property
    def needed(self) -> float:
        """Smallest gain in restricted log-likelihood for which the component is kept in the model."""
        return GAIN_OF_RESPONSE if self.kind in EFFECTS else GAIN


def channel_component(kind: Kind, channels: Sequence[int]) -> Component:
    """Return the component of a kind for one channel, or for the three channels of force or torque."""
    name = _AXES[channels[0]] if len(channels) == 1 else "force_N" if channels[0] == 0 else "torque_Nm"
    return Component(f"{kind}_{name}", kind, tuple(float(c in channels) for c in range(6)))


FORCE, TORQUE = range(3), range(3, 6)
ROTATION = Component("rotation_rad", "rotation", (0.0,) * 6)
HYSTERESIS = Component("hysteresis", "hysteresis", (0.0,) * 6)
RESPONSE = tuple(Component(kind, kind, (0.0,) * 6) for kind in ("gain", "cross_talk"))
# Structured errors (`ftcalib.likelihood.structure`), which the compensation does not model.
STRUCTURE = (
    Component("kinematics_rad", "kinematics", (0.0,) * 6),
    Component("load_force", "load", channel_component("load", FORCE).share),
    Component("load_torque", "load", channel_component("load", TORQUE).share),
    channel_component("cable", FORCE),
    channel_component("cable", TORQUE),
)


@dataclass(frozen=True, eq=False)
class Linearised:
    """Estimation problem of one session, linearised at given parameters, without the variances."""

    J: Array
    """(n, 6, m) derivative of the predicted wrench with respect to the free parameters."""
    r: Array
    """(n, 6) residuals at the point of linearisation, N and N·m."""
    prior: tuple[Array, Array]
    """Information matrix (m, m) and right-hand side (m,) of the priors."""
    turn: Array
    """(n, 6, 3) derivative of the wrench with respect to the orientation of each pose."""
    D: Array
    """(n, 6, 6) measured noise covariance of each pose, or a lower bound if the noise is unknown."""
    time: Array
    """(n,) ascending times of the poses, in mean intervals between poses."""
    kept: NDArray[np.bool_]
    """(n,) whether a pose is used."""
    slope: bool
    """Whether a linear drift of the bias, of unknown size, is part of the model."""
    effects: Mapping[str, Array]
    """(n, 6, k) derivative with respect to the coefficients of each kind of `EFFECTS`."""
    lever: float = 0.0
    """Distance of the centre of mass from the sensor origin, in units of `RANGE_LEVER_M`."""
    least: Mapping[str, float] = field(default_factory=dict)
    """Lower bounds of variances, by kind, where the data are too few to show smaller ones."""
    origin: int | None = None
    """Index of the pose whose bias is a parameter; None: the parameter is the mean bias of all poses."""

    @cached_property
    def X(self) -> Array:
        """(n, 6, M) derivatives with respect to parameters, slopes and effects; the last column holds the residuals."""
        time = centre(self.time, self.origin)
        slopes = np.broadcast_to(time[:, None, None] * np.eye(6), (len(time), 6, 6))
        return np.concatenate([self.J, slopes, *self.effects.values(), self.r[..., None]], axis=2)

    def with_only(self, components: Sequence[Component]) -> "Linearised":
        """Return the problem without the effects that no component needs, to save time; gain and cross-talk stay."""
        kinds = frozenset(c.kind for c in (*RESPONSE, *components)).intersection(self.effects)
        if kinds == self.effects.keys():
            return self
        if kinds not in self._parts:
            self._parts[kinds] = replace(
                self, effects={kind: self.effects[kind] for kind in self.effects if kind in kinds}
            )
        return self._parts[kinds]

    @cached_property
    def _parts(self) -> "dict[frozenset[str], Linearised]":
        return {}

    @cached_property
    def places(self) -> Mapping[str, NDArray[np.intp]]:
        """Column indices of `X` by the name of the effect."""
        first = self.J.shape[2] + 6
        ends = first + np.cumsum([0, *(columns.shape[2] for columns in self.effects.values())])
        return {kind: np.arange(ends[k], ends[k + 1]) for k, kind in enumerate(self.effects)}

    def columns(self, c: Component) -> NDArray[np.intp] | None:
        """Return the indices of a component's columns of `X`; None if it has no coefficients common to all poses."""
        m = self.J.shape[2]
        if c.kind == "slope":
            return np.asarray(m + np.flatnonzero(c.share))
        places = self.places.get(c.kind)
        if places is None or not any(c.share):
            return places
        return np.asarray(places.reshape(6, -1)[np.array(c.share) > 0].ravel())

    def size(self, c: Component) -> float:
        """Return the number of independent random numbers that have the variance of this component."""
        columns = self.columns(c)
        if columns is not None:
            return float(len(columns))
        return int(self.kept.sum()) * (2.0 if c.kind == "rotation" else float(np.count_nonzero(c.share)))

    def largest(self, c: Component) -> float:
        """Return the upper bound of a component's variance for an arm and a sensor in working order.

        A gain error also changes the torque of the weight, like cross-talk at the lever of the centre of mass.
        """
        at_lever = (1 + self.lever) ** 2 if c.kind == "cross_talk" else 1.0
        return LARGEST.get(c.kind, np.inf) * at_lever

    def smallest(self, c: Component) -> float:
        """Return the lower bound of a component's variance; 0 if it has none."""
        return self.least.get(c.kind, 0.0)


@dataclass(frozen=True, slots=True, eq=False)
class Point:
    """Restricted likelihood at given variances, and the solution of the mixed model equations."""

    problem: Linearised
    components: tuple[Component, ...]
    theta: Array
    of_poses: list[tuple[Component, float]]
    """Components with their variances, except the components with coefficients common to all poses."""
    own: Noise
    """Covariance of the measured noise and of the components in `of_poses`."""
    WX: Array
    """(n, 6, M) inverse of the covariance `own` times `Linearised.X`."""
    G: Array
    """(M, M) products X' W X with the inverse covariance W of `own`."""
    unknown: NDArray[np.intp]
    """(k,) indices of the columns of X whose coefficients are estimated."""
    C: Array
    """(k, k) covariance of the estimated coefficients."""
    x: Array
    """(k,) estimated coefficients, relative to the point of linearisation."""
    chi2: float
    loglik: float
    """Restricted log-likelihood of the variances, up to a constant."""

    @property
    def worth(self) -> float:
        """Penalised log-likelihood: `loglik` minus the smallest gain required of each component."""
        return self.loglik - sum(c.needed for c in self.components)

    @property
    def too_large(self) -> bool:
        """Whether any variance has reached its upper bound, so the model is not plausible."""
        return any(v >= self.problem.largest(c) for c, v in zip(self.components, self.theta, strict=True))

    @property
    def step(self) -> Array:
        """(m,) estimated step of the free parameters."""
        return self.x[: self.problem.J.shape[2]]

    @property
    def squared_step(self) -> float:
        """Squared length of the step, in standard deviations of the estimates."""
        m = len(self.step)
        return float(self.step @ np.linalg.solve(self.C[:m, :m], self.step))

    @property
    def noise(self) -> Noise:
        """Covariance of the wrenches due to measured noise and all components together."""
        return noise_of(self.problem, self.components, self.theta)

    def weigh_columns(self) -> tuple[Array, Array]:
        """Return the inverse covariance times the estimated columns (n, 6, k), and times the residuals (n, 6)."""
        WX = self.WX[..., self.unknown]
        return WX, self.WX[..., -1] - WX @ self.x

    def effect(self, c: Component) -> Array:
        """Return the best linear prediction (n, 6) of the contribution of a component of `EFFECTS` to each pose."""
        columns = self.problem.columns(c)
        own = np.arange(0) if columns is None else np.flatnonzero(np.isin(self.unknown, columns))
        return np.asarray(self.problem.X[..., self.unknown[own]] @ self.x[own])

    def squares(self, J: Array, effects: Mapping[str, Array]) -> Array:
        """Return the mean square error (6,) of a prediction with gain and cross-talk, but without structured errors.

        Parameters
        ----------
        J : array, shape (n, 6, m)
            Derivative with respect to the free parameters in the orientations of the prediction.
        effects : mapping
            Derivatives with respect to the coefficients of effects in these orientations.
        """
        X, modelled = np.zeros((*J.shape[:2], self.problem.X.shape[2] - 1)), np.zeros(self.problem.X.shape[2] - 1)
        X[..., : J.shape[2]] = J
        for kind, columns in effects.items():
            X[..., self.problem.places[kind]] = columns
        for c in STRUCTURE:
            if c in self.components:
                modelled[self.problem.columns(c)] = 1.0
        X, modelled = X[..., self.unknown], modelled[self.unknown]
        variance = np.einsum("nci,ij,ncj->c", X, self.C, X, optimize=True) / len(J)
        return np.asarray(variance + np.mean((X @ (modelled * self.x)) ** 2, axis=0))

    def left_out(self) -> tuple[Array, Array]:
        """Return the leave-one-out residuals (n, 6) of the poses, and their covariances (n, 6, 6)."""
        return left_out(self.own, *self.weigh_columns(), self.C)


def left_out(noise: Noise, WJ: Array, u: Array, C: Array) -> tuple[Array, Array]:
    """Return the leave-one-out residuals of all poses in closed form, for noise with drift and correlation.

    The result is exact in the linear model: the residual of pose k is `P_kk^-1 (P y)_k` with `P = W - W J C J' W` and
    the inverse noise W. Rejected poses are predicted from the kept ones.

    Parameters
    ----------
    WJ : array, shape (n, 6, m)
    u : array, shape (n, 6)
        Inverse noise covariance times the residuals.
    C : array, shape (m, m)

    Returns
    -------
    residuals : array, shape (n, 6)
    covariance : array, shape (n, 6, 6)
        Noise of the pose plus uncertainty of its prediction; very large if the other poses do not determine it.
    """
    P = noise.blocks - WJ @ C @ np.swapaxes(WJ, 1, 2)
    rejected = ~noise.kept
    P[~rejected] += 1e-10 * noise.W[~rejected]  # stays invertible even if the other poses do not determine this one
    S = np.linalg.inv(P)
    e = (S @ u[..., None])[..., 0]
    if rejected.any():
        S[rejected] -= np.linalg.inv(noise.W[rejected]) - noise.D[rejected]
    return np.asarray(e), np.asarray(S + np.swapaxes(S, 1, 2)) / 2


def squared_length(e: Array, S: Array) -> Array:
    """Return the squared Mahalanobis distances (n,) of residuals (n, 6) with covariances (n, 6, 6)."""
    return np.asarray((np.linalg.solve(S, e[..., None])[..., 0] * e).sum(axis=1))


def point(problem: Linearised, components: Sequence[Component], theta: Array, near: Point | None = None) -> Point:
    """Return the restricted likelihood at given variances; sums of the `Point` `near` are reused for equal noise."""
    m, effects, of_poses = problem.J.shape[2], [], []
    for c, value in zip(components, theta, strict=True):
        columns = problem.columns(c)
        if columns is None:
            of_poses.append((c, value))
        else:
            effects.append((columns, value))
    if near is None or near.problem is not problem or near.of_poses != of_poses:
        own = _own_noise_of(problem, of_poses)
        WX = own.solve(problem.X)
        G = summed_products(problem.X, WX)
    else:
        own, WX, G = near.own, near.WX, near.G
    unknown = np.concatenate([np.arange(m + 6 * problem.slope), *(columns for columns, _ in effects)])
    H, g = G[np.ix_(unknown, unknown)], G[unknown, -1]
    H[:m, :m] += problem.prior[0]
    g[:m] += problem.prior[1]
    logdet, at = own.logdet, m + 6 * problem.slope
    for columns, value in effects:
        own_rows = np.arange(at, at + len(columns))
        H[own_rows, own_rows] += 1 / value
        logdet += len(columns) * float(np.log(value))
        at += len(columns)
    C, logdet_H = _inverse_and_logdet(H)
    x = C @ g
    chi2 = float(G[-1, -1] - g @ x)
    loglik = -0.5 * (logdet + logdet_H + chi2)
    return Point(problem, tuple(components), theta, of_poses, own, WX, G, unknown, C, x, chi2, loglik)


def _inverse_and_logdet(H: Array) -> tuple[Array, float]:
    """Return inverse and log-determinant of an information matrix; undetermined directions get a large variance."""
    scale = column_scale(H)
    scaled = H / np.outer(scale, scale)
    L, failed = dpotrf(scaled, lower=1)
    if not failed and np.diag(L).min() > 1e-7:
        half = dtrtri(L, lower=1)[0] / scale
        return np.asarray(half.T @ half), 2 * float(np.log(np.diag(L)).sum() + np.log(scale).sum())
    value, vector = np.linalg.eigh(scaled)
    value = np.maximum(value, 1e-14 * value[-1])
    root = vector / np.sqrt(value) / scale[:, None]
    return np.asarray(root @ root.T), float(np.log(value).sum() + 2 * np.log(scale).sum())


def _own_noise_of(problem: Linearised, of_poses: Sequence[tuple[Component, float]]) -> Noise:
    """Return the covariance of the measured noise and of the components without common coefficients."""
    D, walk, white = problem.D, np.zeros(6), np.zeros(6)
    for c, value in of_poses:
        if c.kind == "walk":
            walk += value * np.array(c.share)
        elif c.kind == "rotation":
            D = D + value * problem.turn @ np.swapaxes(problem.turn, 1, 2)
        else:
            white += value * np.array(c.share)
    if white.any():
        D = D + np.diag(white) if D.strides[0] else np.broadcast_to(D[0] + np.diag(white), D.shape)
    return Noise(D, problem.time, np.sqrt(walk), kept=problem.kept, origin=problem.origin)


def noise_of(problem: Linearised, components: Sequence[Component], theta: Array) -> Noise:
    """Return the covariance of all components together, at these variances."""
    pairs = list(zip(components, theta, strict=True))
    own = _own_noise_of(problem, [pair for pair in pairs if problem.columns(pair[0]) is None])
    effects = [(columns, value) for c, value in pairs if (columns := problem.columns(c)) is not None]
    if problem.slope:
        m = problem.J.shape[2]
        effects.append((np.arange(m, m + 6), np.inf))
    for columns, value in effects:
        own.add_effects(problem.X[..., columns], np.full(len(columns), value))
    return own


def score(problem: Linearised, at: Point, components: Sequence[Component], theta: Array) -> tuple[Array, Array]:
    """Return the score (k,), the gradient of the restricted log-likelihood in the log variances, and the information.

    The average information is (k, k). The score of other components is the derivative at variance zero times `theta`.
    """
    noise, C, G = at.own, at.C, at.G
    WX, u = at.weigh_columns()
    WXC = WX @ C
    P = noise.blocks - WXC @ np.swapaxes(WX, 1, 2)
    of_poses = [k for k, c in enumerate(components) if problem.columns(c) is None]
    Ku = walk_times(problem.time, u) if any(components[k].kind == "walk" for k in of_poses) else u
    slope, Vu, E = np.empty(len(components)), np.empty((*u.shape, len(of_poses))), np.zeros((len(G), len(components)))
    for k, (c, variance) in enumerate(zip(components, theta, strict=True)):
        columns = problem.columns(c)
        if columns is not None:  # the component has common coefficients: use their moments
            along = G[columns, -1] - G[np.ix_(columns, at.unknown)] @ at.x
            between = G[np.ix_(columns, at.unknown)]
            trace = float(np.trace(G[np.ix_(columns, columns)]) - np.vdot(between, between @ C))
            E[columns, k] = variance * along
            slope[k] = variance * (float(along @ along) - trace) / 2
            continue
        share, part = np.array(c.share), Vu[..., of_poses.index(k)]
        if c.kind == "white":
            part[...] = variance * share * u
            trace = float(np.einsum("ncc,c->", P, share))
        elif c.kind == "rotation":
            part[...] = variance * (problem.turn @ (u[:, None] @ problem.turn).swapaxes(1, 2))[..., 0]
            trace = float(np.vdot(problem.turn, P @ problem.turn))
        else:
            part[...] = variance * share * Ku
            own = np.flatnonzero(share)
            if c in at.components:
                # K P = (V - D) P, and V P = 1 - X C X' W.
                others = np.einsum("nck,nck->", problem.X[:, own[:, None], at.unknown], WXC[:, own])
                others += np.einsum("ncd,ndc->", noise.D[:, own], P[:, :, own])
                trace = (int(problem.kept.sum()) * len(own) - float(others)) / variance
            else:
                trace = noise.walk_trace(problem.time, own, (WX, -C))
        slope[k] = (float(np.vdot(u, part)) - variance * trace) / 2
    GE = G @ E
    XV = summed_products(at.WX, Vu)
    square = E.T @ GE
    square[:, of_poses] += E.T @ XV
    square[of_poses] += XV.T @ E
    square[np.ix_(of_poses, of_poses)] += summed_products(Vu, noise.solve(Vu))
    known = GE[at.unknown]
    known[:, of_poses] += XV[at.unknown]
    information = np.asarray(square - known.T @ C @ known) / 2
    # Noise-free data with wrong orientations leave residuals of 1e10 sigma, whose powers overflow: return no ascent.
    if not (np.isfinite(slope).all() and np.isfinite(information).all()):
        return np.zeros_like(slope), np.zeros_like(information)
    return slope, information


def maximise(problem: Linearised, components: Sequence[Component], theta: Array, worse_than: float = -np.inf) -> Point:
    """Maximise the restricted likelihood, starting from positive variances (k,).

    The ascent stops early if it cannot be expected to reach the log-likelihood `worse_than`.
    """
    problem = problem.with_only(components)
    if not components:
        return point(problem, components, theta)
    most = np.array([problem.largest(c) for c in components])
    best = point(problem, components, np.clip(theta, [problem.smallest(c) for c in components], most))
    least = np.minimum(1e-3 * NEGLIGIBLE * unit_variances(problem, best, components), most)
    least = np.maximum(least, [problem.smallest(c) for c in components])
    size = np.array([problem.size(c) for c in components])
    caution = 1e-3
    for _ in range(60):
        slope, information = score(problem, best, best.components, best.theta)
        promised = float(slope @ np.linalg.lstsq(information, slope)[0])
        if promised < SETTLED or best.loglik + HOPE * promised < worse_than:
            break
        gained = 0.0
        while caution < 1e6:
            # Levenberg-Marquardt: average information is the curvature only near the best variances.
            damped = information + np.diag(caution * (np.diag(information) + 1e-3))
            step = np.clip(np.linalg.solve(damped, slope), -2.5, 2.5)
            if caution < CAREFUL:  # far from the optimum the EM step is longer
                step = np.where(slope > 0, np.maximum(step, np.log1p(2 * np.maximum(slope, 0) / size)), step)
            trial = point(problem, components, np.clip(best.theta * np.exp(step), least, most))
            gained = trial.loglik - best.loglik
            if gained >= 0 or np.abs(step).max() < 1e-4:
                break
            caution = max(10 * caution, CAREFUL)
        if gained > 0:
            best, caution = trial, max(caution / 10, 1e-6)
        if gained < 1e-3 or (gained < 1e-2 and np.abs(step).max() < 0.05):
            break
        # Stop if only variances decrease, without effect on the likelihood: their components are dropped later.
        if gained < 1e-2 and (slope < 0.05).all():
            break
    return best


def expected_variances(problem: Linearised, at: Point) -> Array:
    """Return the variances (k,), with the posterior mean of the white noise instead of its mode, which may be 0.

    A drift that varies from pose to pose absorbs most of the noise, whose likelihood is then flat down to zero. The
    prior of the standard deviation is uniform (Gelman 2006), and the likelihood of the variance is taken as normal.
    """
    slope, information = score(problem, at, at.components, at.theta)
    scale = column_scale(information)
    value, vector = np.linalg.eigh(information / np.outer(scale, scale))
    # Rounding can make eigenvalues negative.
    spread = at.theta / scale * np.sqrt((vector**2 / np.maximum(value, 1e-9)).sum(axis=1))
    mode = at.theta / spread + spread * slope / at.theta
    variance = (np.linspace(0.0, 1.0, 200)[:, None] * np.sqrt(np.maximum(mode, 0.0) + 6.0)) ** 2
    density = np.exp(variance * np.minimum(mode, 0.0) - (variance - np.maximum(mode, 0.0)) ** 2 / 2)
    mean = spread * (variance * density).sum(axis=0) / density.sum(axis=0)
    white = np.array([c.kind == "white" for c in at.components])
    return np.where(white & (mean > at.theta), mean, at.theta)


def parameter_estimates(at: Point) -> tuple[Array, Array]:
    """Return the estimates of parameters, gain and cross-talk at given variances.

    Returns
    -------
    values : array, shape (m + 11,)
        Step of the free parameters, then the coefficients of gain and cross-talk, zero if they are not modelled.
    covariance : array, shape (m + 11, m + 11)
    """
    problem = at.problem
    every = problem.X.shape[2] - 1
    values, covariance = np.zeros(every), np.zeros((every, every))
    values[at.unknown], covariance[np.ix_(at.unknown, at.unknown)] = at.x, at.C
    shown = np.r_[: problem.J.shape[2], *(problem.columns(c) for c in RESPONSE)]
    return values[shown], covariance[np.ix_(shown, shown)]


def estimates_of_unknown_variances(at: Point) -> tuple[Array, Array]:
    """Return `parameter_estimates` with a covariance that includes the uncertainty of the variances.

    The correction is of first order. Estimates change with the variances, and the covariance at the best variances is
    too small by twice that contribution (Kenward, Roger 1997; Prasad, Rao 1990). The covariance itself is uncertain, so
    sigma is widened by (z² + 1) / (4 nu), like the 95 % interval of Student's distribution (nu: Satterthwaite 1946).
    """
    x, C = parameter_estimates(at)
    if not at.components or len(at.problem.r) >= POSES_THAT_SHOW_THE_NOISE:
        return x, C
    # A variance that is at its assumed lower bound is treated as known exactly.
    free = np.flatnonzero(at.theta > 1.001 * np.array([at.problem.smallest(c) for c in at.components]))
    if not free.size:
        return x, C
    _, information = score(at.problem, at, at.components, at.theta)
    uncertainty = np.linalg.pinv(information[np.ix_(free, free)], rcond=1e-6, hermitian=True)
    h, steps = 1e-3, np.eye(len(at.theta))[free]
    around = [parameter_estimates(point(at.problem, at.components, at.theta * np.exp(h * row), at)) for row in steps]
    moves, changes = ([(part[i] - own) / h for part in around] for i, own in enumerate((x, C)))
    scale = np.sqrt(np.diag(C))
    scale[scale == 0] = 1.0
    inverse = np.linalg.pinv(C / np.outer(scale, scale), rcond=1e-10, hermitian=True) / np.outer(scale, scale)
    wider = (1.96**2 + 1) / 4 * np.einsum("ij,iab,bc,jcd->ad", uncertainty, changes, inverse, changes, optimize=True)
    return x, C + 2 * np.transpose(moves) @ uncertainty @ np.array(moves) + wider


def mixture_covariance(at: Point, others: Sequence[tuple[Point, float]]) -> Array:
    """Return the covariance (m + 11, m + 11) to add to `parameter_estimates` for rival models with probabilities."""
    x, C = parameter_estimates(at)
    total = np.zeros_like(C)
    for rival, share in others:
        other, cov = parameter_estimates(rival)
        total += share * (cov - C + np.outer(other - x, other - x))
    return total


def unit_variances(problem: Linearised, best: Point, components: Sequence[Component]) -> Array:
    """Return the variances (k,) at which each component contributes about as much as the white noise."""
    kept, n = problem.kept, int(problem.kept.sum())
    variance = np.einsum("ncc,n->c", best.own.D, kept) / n
    variances = []
    for c in components:
        places = problem.columns(c) if c.kind != "slope" else None
        if places is not None or c.kind == "rotation":
            columns = problem.turn if places is None else np.sqrt(n) * problem.X[..., places]
            square = np.einsum("ncd,ncd,n->c", columns, columns, kept.astype(np.float64)) / (n * columns.shape[2])
            variances.append(float(1 / np.max(square / variance)))
        else:
            share = np.array(c.share)
            variances.append(float((variance @ share) / share.sum()) / (n if c.kind == "walk" else 1))
    return np.array(variances)
