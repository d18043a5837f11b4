"""Maximum likelihood: joint weighted least squares of forces and torques, under the noise the data show."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Self

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag
from scipy.spatial.transform import Rotation

from ftcalib.errors import NotObservable
from ftcalib.known import USUAL_GAIN, Constraints, Known
from ftcalib.likelihood.descent import FARTHEST, MAX_STEPS, Minimum, column_scale
from ftcalib.likelihood.explanation import Explanation, explain, noise_under, rivals
from ftcalib.likelihood.session import Drift, SessionData
from ftcalib.likelihood.session_noise import CHUNK, Noise, summed_products
from ftcalib.likelihood.structure import MOST_POSES as STRUCTURED_POSES
from ftcalib.likelihood.structure import hidden_columns, hidden_in_any_poses, structure_columns
from ftcalib.likelihood.variance_components import (
    EFFECTS,
    GAIN,
    GAIN_OF_RESPONSE,
    HYSTERESIS,
    POSES_THAT_SHOW_THE_NOISE,
    RESPONSE,
    STRUCTURE,
    Component,
    Point,
    estimates_of_unknown_variances,
    left_out,
    mixture_covariance,
    point,
    squared_length,
)
from ftcalib.model import BIASES, STANDARD_GRAVITY_M_S2, Array, DriftResult, Parameters, jacobian, predict
from ftcalib.sensor_matrix import SIZE, Calibrated, Response, sensor_columns

# From this difference of the criterion on the data show a structure: real ones have 250 and more in 24 poses.
_SURE = 40.0
# Difference of two left-out errors that is no accident, as the logarithm of their squares.
_CLEARLY = 0.05
# Such squares are rounding of data without noise.
_EXACT = 1e-18
# Compensation does not know them.
UNCOMPENSATED = (HYSTERESIS, *STRUCTURE)


@dataclass(frozen=True, eq=False, kw_only=True)
class Estimate(Calibrated):
    """Estimates by any method, and what they leave of each pose. Rejected poses count only in arrays with n rows.

    A pose is off by its own noise alone; a `Fit` may have found more.
    """

    parameters: Parameters
    """With drift the biases are those at the last pose that counts."""
    on_average: Parameters
    """The same with the mean of the bias over the poses."""
    covariance: Array
    """(15, 15) of the error coordinates `PARAMETER_NAMES`; zero along what is exactly known, without meaning where the
    information lacks rank."""
    free: Array
    """(15, m) orthonormal basis of what is not exactly known: the identity without a `Known`."""
    noise: Noise
    """Covariance of all wrenches under the noise model; of a `Fit`, poses in the order of `order`."""
    R_base_flange: Array
    """(n, 3, 3)"""
    wrench: Array
    """(n, 6)"""
    weights: Array
    """(n,) 1 = used, 0 = rejected because it does not fit the others."""
    chi2: float
    """Under the noise model: measured or estimated white noise plus `components`. About dof by construction."""
    dof: int
    measured_chi2: float
    """Chi2 of the same poses, best fit without drift, with gain and cross-talk where they were found, weighted by the
    measured noise alone; NaN without it."""
    second_basin_chi2: float | None = None
    """How much worse the second best minimum fits: it is right with the odds exp(-half of this). None: no other."""
    components: Mapping[str, float] = field(default_factory=dict)
    """Standard deviations of what was found, by name and unit: beyond the measured noise, or all of the noise
    where it was not measured. A `walk` is per mean interval between poses, a `slope` per session."""
    drift: DriftResult | None = None
    response: Response | None = None
    """Gain and cross-talk of the sensor, best linear prediction; None where none was found."""
    may_bend: bool = False
    """Whether noise stands for a response that is not linear, which the data show, but not clearly."""

    @classmethod
    def independent(  # noqa: PLR0913 - what an estimate rests on
        cls,
        parameters: Parameters,
        covariance: Array,
        R_base_flange: Array,
        wrench: Array,
        wrench_cov: Array,
        weights: Array,
        *,
        measured: bool,
        second_basin_chi2: float | None = None,
        components: Mapping[str, float] | None = None,
        free: Array | None = None,
    ) -> Self:
        """Take the estimates of another method, for poses with independent noise `wrench_cov` (n, 6, 6).

        `measured` says whether this was measured, not estimated from the residuals. `free` (15, m) is the identity
        unless the method assumes mounting or gravity.
        """
        r = np.asarray(wrench - predict(parameters, R_base_flange))[..., None]
        chi2 = float(weights @ np.sum(r * np.linalg.solve(wrench_cov, r), axis=(1, 2)))
        free = np.eye(15) if free is None else free
        return cls(
            parameters=parameters,
            on_average=parameters,
            covariance=covariance,
            free=free,
            noise=Noise(wrench_cov, kept=weights > 0),
            R_base_flange=R_base_flange,
            wrench=wrench,
            weights=weights,
            chi2=chi2,
            dof=6 * int(weights.sum()) - int(free.shape[1]),
            measured_chi2=chi2 if measured else float("nan"),
            second_basin_chi2=second_basin_chi2,
            components=components or {},
        )

    @cached_property
    def residuals(self) -> Array:
        """(n, 6) measured minus predicted with the mean bias, gain and cross-talk included."""
        added = 0.0 if self.response is None else self.response.wrench(self.parameters, self.R_base_flange)
        return np.asarray(self.wrench - predict(self.on_average, self.R_base_flange) - added)

    @cached_property
    def _left_out(self) -> tuple[Array, Array]:
        """Left-out residuals and their covariance, without fitting again: exact for a linear model."""
        J = jacobian(self.parameters, self.R_base_flange) @ self.free
        WJ = self.noise.solve(J)
        information = summed_products(J, WJ)
        # Radians, newtons and metres stand side by side: without the scale the smallest eigenvalues count as zero.
        scale = column_scale(information)
        C = np.asarray(np.linalg.pinv(information / np.outer(scale, scale), hermitian=True)) / np.outer(scale, scale)
        return left_out(self.noise, WJ, self.noise.solve(self.residuals[..., None])[..., 0], C)

    @property
    def left_out_residuals(self) -> Array:
        """(n, 6) measured minus what all other poses predict for this one, drift included, hysteresis not."""
        return self._left_out[0]

    @property
    def left_out_cov(self) -> Array:
        """(n, 6, 6) covariance of these: noise of the pose and uncertainty of its prediction."""
        return self._left_out[1]

    @cached_property
    def elsewhere(self) -> Array:
        """(6,) mean square error of predicting the wrench in any orientation, less that in those of the poses."""
        return np.zeros(6)


@dataclass(frozen=True, eq=False, kw_only=True)
class Fit(Estimate):
    """Estimates by maximum likelihood, under the noise that the data show."""

    information: Array
    """(15, 15) Fisher information of the error coordinates `PARAMETER_NAMES`, priors included."""
    order: NDArray[np.intp]
    """(n,) row numbers by time."""
    given_noise: Array
    """(15, 15) covariance of the parameters if the noise model is taken as known."""
    lag: tuple[Array, Array] | None
    """Hysteresis and errors that have a structure (n, 6) of each pose, and their variance (n, 6, 6): compensation does
    not know them; None where none were found."""
    at: Point | None
    """Restricted likelihood of all unknowns; None in many poses."""

    @property
    def wrench_cov(self) -> Array:
        """(n, 6, 6) noise of each pose by itself, without drift."""
        cov = np.empty_like(self.noise.D)
        cov[self.order] = self.noise.D
        return cov

    @cached_property
    def _left_out(self) -> tuple[Array, Array]:
        e, S = np.empty((len(self.order), 6)), np.empty((len(self.order), 6, 6))
        for part, noise in self.noise.parts():
            rows = self.order[part]
            R = self.R_base_flange[rows]
            r = self.wrench[rows] - predict(self.on_average, R)
            WX = noise.solve(np.concatenate([jacobian(self.parameters, R), r[..., None]], axis=2))
            # With a prior the best parameters leave some of J' W r.
            e[rows], S[rows] = left_out(noise, WX[..., :15], WX[..., 15], self.given_noise)
        if self.lag is not None:
            e, S = e + self.lag[0], S + self.lag[1]
        return e, S

    @cached_property
    def elsewhere(self) -> Array:
        """(6,) as of an `Estimate`; zero in many poses, where it is small."""
        if self.at is None:
            return np.zeros(6)
        R, middle = Rotation.create_group("O").as_matrix(), self.R_base_flange[self.order].mean(axis=0)
        effects = sensor_columns(self.parameters, R) | structure_columns(self.parameters, R, middle)
        problem = self.at.problem
        effects = {kind: columns for kind, columns in effects.items() if kind in problem.effects}
        everywhere = self.at.squares(jacobian(self.parameters, R) @ self.free, effects)
        return everywhere - self.at.squares(problem.J, {kind: problem.effects[kind] for kind in effects})

    def hidden_covariance(self, orientation_rad: float) -> Array:
        """Return the covariance (15, 15) of the estimates from errors of arm and mounts, which the poses do not show.

        Parameters
        ----------
        orientation_rad : float
            One standard deviation of an axis of the arm's orientation; 0 for an exact arm with rigid mounts.
        """
        if self.at is None:
            Z = self.free
            return np.asarray(Z @ Z.T @ hidden_in_any_poses(self.parameters, orientation_rad) @ Z @ Z.T)
        R = self.R_base_flange[self.order]
        columns = hidden_columns(self.parameters, R, R.mean(axis=0), orientation_rad)
        moved = self.at.C @ summed_products(self.at.weigh_columns()[0], columns)
        moved = self.free @ moved[: self.free.shape[1]]
        return np.asarray(moved @ moved.T)

    @property
    def minus_two_log_likelihood(self) -> float:
        """Restricted, with what its components and its rejected poses cost."""
        information = self.free.T @ self.information @ self.free
        value = self.noise.logdet + float(np.linalg.slogdet(information)[1]) + self.chi2
        value += sum(2 * (GAIN_OF_RESPONSE if name.startswith(EFFECTS) else GAIN) for name in self.components)
        rejected = self.weights < 0.5
        if rejected.any():
            S = self.left_out_cov[rejected]
            far = np.maximum(squared_length(self.left_out_residuals[rejected], S), FARTHEST)
            value += float(np.linalg.slogdet(S)[1].sum() + np.sum(FARTHEST + 6 * np.log(far / FARTHEST)))
        return value


def standardize(residuals: Array, covariance: Array) -> Array:
    """Divide residuals (n, 6) by a root of their covariance (n, 6, 6): independent, of unit variance."""
    unit = np.empty_like(residuals)
    for first in range(0, len(residuals), CHUNK):
        part = slice(first, first + CHUNK)
        unit[part] = np.linalg.solve(_root(covariance[part]), residuals[part, :, None])[..., 0]
    return unit


def _root(covariance: Array) -> Array:
    """Give roots A with A A' = covariance (n, 6, 6), which rounding may have made indefinite."""
    try:
        return np.asarray(np.linalg.cholesky(covariance), dtype=np.float64)
    except np.linalg.LinAlgError:
        value, vector = np.linalg.eigh(covariance)
        return np.asarray(vector * np.sqrt(np.maximum(value, 1e-12 * value[:, -1:]))[:, None])


def fit(
    R_base_flange: Array,
    wrench: Array,
    wrench_cov: Array | None = None,
    *,
    t_s: Array | None = None,
    drift: Drift = "auto",
    known: Known | None = None,
    g_m_s2: float = STANDARD_GRAVITY_M_S2,
    gain_sigma: float = USUAL_GAIN,
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
    gain_sigma : float
        One standard deviation of the entries of the sensor's gain, for fewer than 12 poses.

    Raises
    ------
    NotObservable
        The lowest point reached is not a minimum. Poor information is not refused here: see `Fit.information`.
    """
    session = SessionData(
        R_base_flange, wrench, wrench_cov, t_s, drift, Constraints(known or Known(), g_m_s2), gain_sigma
    )
    e, minima, static_chi2 = explain(session)
    has_structure = any(c in STRUCTURE for c in e.components)
    # Structure explains wrong data so well that no weight remains.
    best = _fit_of(session, e, minima, static_chi2) if minima[0].settled or not session.structure() else None
    if best is not None and not (has_structure and session.n <= STRUCTURED_POSES):
        return best
    session.structured = False
    without, minima, static_chi2 = explain(session)
    plain = _fit_of(session, without, minima, static_chi2)
    if best is None:
        return plain
    # Compensation knows gain and cross-talk, and no structure. A few numbers more of it may only take their place.
    is_unsure = without.criterion - e.criterion < _SURE
    displaced = is_unsure and _left_out_error(plain) < _left_out_error(best) - _CLEARLY
    return _beside(plain, best) if displaced else best


def _beside(found: Fit, other: Fit) -> Fit:
    """Return a fit with a covariance that another one, which may be the right one as well, has a half of."""
    off, Z = found.parameters.difference(other.parameters), found.free
    more = Z.T @ (other.covariance - found.covariance + np.outer(off, off)) @ Z / 2
    scale = column_scale(Z.T @ found.covariance @ Z)
    value, vector = np.linalg.eigh(more / np.outer(scale, scale))
    root = Z @ (scale[:, None] * vector * np.sqrt(np.maximum(value, 0.0)))
    more = root @ root.T
    joint = found.joint_covariance.copy()
    joint[:15, :15] += more
    response = found.with_joint(joint)
    bends = any(name.startswith("load") for name in other.components)  # and adds to the bias
    return replace(found, covariance=found.covariance + more, response=response, may_bend=bends)


def _left_out_error(found: Fit) -> float:
    """Sum the logarithms of the left-out errors of force and torque, mean squares."""
    square = (found.left_out_residuals[found.weights > 0] ** 2).reshape(-1, 2, 3).mean(axis=(0, 2))
    return float(np.log(np.maximum(square, _EXACT)).sum())


def _fit_of(session: SessionData, e: Explanation, minima: list[Minimum], static_chi2: float) -> Fit:
    """Put together what follows from an explanation; arguments as `explain` returns them."""
    best = minima[0]
    if not best.settled:
        weight_N = best.parameters.weight_N
        raise NotObservable(
            f"the fit has not settled in {MAX_STEPS} steps, at a weight of {weight_N:.2g} N: "
            "hang something heavier on the sensor, or add poses with other orientations."
        )
    plain = not e.components and e.kept.all() and session.drift != "linear"
    noise = Noise(session.cov) if plain else noise_under(session, e, best.parameters)
    weights = np.empty(session.n)
    weights[session.order] = e.kept
    drifts = session.drift == "linear" or any(c.kind in ("walk", "slope") for c in e.components)
    found = dict(zip(e.components, e.theta, strict=True))
    Z = session.constraints.free(best.parameters)
    given_noise = covariance = np.asarray(Z @ _regular_inverse(Z.T @ best.information @ Z) @ Z.T)
    response = lag = None
    measured_chi2 = static_chi2 if session.measured else float("nan")
    if found or drifts or session.n <= STRUCTURED_POSES:
        problem = session.linearise(best.parameters, e.kept)
        if drifts:  # what is handed on is the bias at the end
            problem = replace(problem, origin=int(np.flatnonzero(e.kept)[-1]))
        at = point(problem, e.components, e.theta)
    if session.measured and found.keys() & {*RESPONSE}:
        of_sensor = [c for c in e.components if c in RESPONSE]
        measured_chi2 = point(problem, of_sensor, np.array([found[c] for c in of_sensor])).chi2
    # Many poses show the variances so well that their uncertainty does not widen that of the estimates.
    parameters = best.parameters
    if drifts or found.keys() & {*RESPONSE, *UNCOMPENSATED} or (found and session.n < POSES_THAT_SHOW_THE_NOISE):
        x, C = estimates_of_unknown_variances(at)
        step = Z @ x[:-SIZE]
        if session.n < POSES_THAT_SHOW_THE_NOISE:
            others = rivals(problem, at, [*session.candidates(), *session.structure()])
            C = C + mixture_covariance(at, others)
            # A drift that the data show hardly better than none counts for its share.
            step = step + sum(share * (Z @ one.step - step) for one, share in others)
        if drifts:
            parameters = parameters.moved(np.where(np.isin(np.arange(15), BIASES), step, 0.0))
        Z = block_diag(Z, np.eye(SIZE))
        covariance = (Z @ C @ Z.T)[:15, :15]
        response = Response(x[-SIZE:], Z @ C @ Z.T) if x[-SIZE:].any() else None
    # In the order of the components: a sum over a set would differ in the last digit from process to process.
    if hidden := [c for c in found if c in UNCOMPENSATED]:
        lag, square = np.zeros((session.n, 6)), np.zeros((session.n, 6, 6))
        for c in hidden:
            T = problem.X[..., problem.columns(c)]
            lag[session.order] += at.effect(c)
            square[session.order] += found[c] * T @ np.swapaxes(T, 1, 2)
    components, dof = {c.name: _deviation(session, c, v) for c, v in found.items()}, session.dof(e.kept)
    return Fit(
        parameters=parameters,
        on_average=best.parameters,
        information=best.information,
        free=session.constraints.free(best.parameters),
        chi2=best.chi2,
        dof=dof,
        measured_chi2=measured_chi2,
        second_basin_chi2=_second_basin_chi2([one.chi2 for one in minima], components, dof),
        weights=weights,
        components=components,
        drift=_drift_result(session, best, noise, given_noise, found) if drifts else None,
        noise=noise,
        order=session.order,
        R_base_flange=session.given[0],
        wrench=session.given[1],
        given_noise=given_noise,
        covariance=covariance,
        response=response,
        lag=None if lag is None else (lag, square),
        at=at if session.n <= STRUCTURED_POSES or session.structure() else None,
    )


def _second_basin_chi2(minima: Sequence[float], components: Iterable[str], dof: int) -> float | None:
    """Compare the two least minima of chi2; None if there is one.

    Where white noise was estimated from the same residuals a larger one makes up for part of the difference.
    """
    if len(minima) == 1:
        return None
    best, second = minima[:2]
    return float(dof * np.log(second / best)) if any(name.startswith("white") for name in components) else second - best


def _deviation(session: SessionData, c: Component, variance: float) -> float:
    """Standard deviation that the fit used: estimated white noise includes its lower bound."""
    least = 0.0 if session.measured or c.kind != "white" else session.cov[0][np.argmax(c.share), np.argmax(c.share)]
    return float(np.sqrt(variance + least))


def _drift_result(
    session: SessionData, best: Minimum, noise: Noise, C: Array, found: Mapping[Component, float]
) -> DriftResult:
    """Best linear prediction of the bias at every pose, and the error of its change."""
    J, r = jacobian(best.parameters, session.R), session.wrench - predict(best.parameters, session.R)
    problem = session.linearise(best.parameters, noise.kept)
    others = [(problem.columns(c), value) for c, value in found.items() if c in (*RESPONSE, *UNCOMPENSATED)]

    def not_drift(X: Array) -> Array:
        """Multiply by the covariance of all but the drift."""
        Y = np.asarray(noise.D @ X)
        for columns, value in others:
            T = problem.X[..., columns]
            Y = Y + value * T @ summed_products(T, X)
        return Y

    sorted_bias = r - not_drift(noise.solve(r[..., None]))[..., 0]
    if not noise.kept.all():
        at, seen = session.time[noise.kept], sorted_bias[noise.kept]
        sorted_bias = np.stack([np.interp(session.time, at, channel) for channel in seen.T], axis=1)
    bias = np.empty((session.n, 6))
    bias[session.order] = sorted_bias
    ends = np.flatnonzero(noise.kept)[[0, -1]]
    select_ends = np.zeros((session.n, 6, 6))
    select_ends[ends] = [-np.eye(6), np.eye(6)]
    Y = not_drift(select_ends)
    WY = noise.solve(Y)
    E = summed_products(select_ends, J) - summed_products(WY, J)
    cov = summed_products(select_ends, Y) - summed_products(Y, WY) + E @ C @ E.T
    change = sorted_bias[ends[1]] - sorted_bias[ends[0]]
    return DriftResult(change, np.sqrt(np.maximum(np.diag(cov), 0.0)), bias)


def _regular_inverse(information: Array) -> Array:
    scale = column_scale(information)
    value, vector = np.linalg.eigh(information / np.outer(scale, scale))
    value = np.maximum(value, 1e-14 * value[-1])
    return np.asarray(vector / value @ vector.T / np.outer(scale, scale))
