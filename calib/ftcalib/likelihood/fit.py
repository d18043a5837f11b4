"""Maximum likelihood: joint weighted least squares of forces and torques, with noise estimated from the data."""

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

# If structured errors lower the criterion by more than this, they are certain; real ones give 250 or more in 24 poses.
_SURE = 40.0
# Significant difference between the logarithms of two mean square leave-one-out errors.
_CLEARLY = 0.05
# Leave-one-out mean squares below this value are rounding errors of data without noise.
_EXACT = 1e-18
# Variance components whose effect the compensation cannot subtract.
UNCOMPENSATED = (HYSTERESIS, *STRUCTURE)


@dataclass(frozen=True, eq=False, kw_only=True)
class Estimate(Calibrated):
    """Estimates by any method, with the residuals of all poses. Rejected poses appear only in arrays with n rows.

    Poses have independent noise here; a `Fit` may have further components.
    """

    parameters: Parameters
    """Estimates; with drift, the biases are those at the last used pose."""
    on_average: Parameters
    """Estimates with the mean bias over the poses instead of the last bias."""
    covariance: Array
    """(15, 15) covariance of the error coordinates `PARAMETER_NAMES`; zero along exactly known directions, meaningless
    if the information matrix lacks rank."""
    free: Array
    """(15, m) orthonormal basis of the directions that are not exactly known; the identity without a `Known`."""
    noise: Noise
    """Covariance of all wrenches under the noise model; in a `Fit` its poses are sorted by time, see `order`."""
    R_base_flange: Array
    """(n, 3, 3) orientations of the flange."""
    wrench: Array
    """(n, 6) measured wrenches, N and N·m."""
    weights: Array
    """(n,) 1 = used, 0 = rejected because it does not fit the others."""
    chi2: float
    """Chi2 under the noise model, white noise plus `components`; about `dof` by construction."""
    dof: int
    measured_chi2: float
    """Chi2 of the same poses weighted by the measured noise alone, for the best fit without drift, with gain and
    cross-talk if they were found; NaN if the noise was not measured."""
    second_basin_chi2: float | None = None
    """Increase of chi2 at the second best minimum, whose odds are exp(-increase / 2); None if there is no other."""
    components: Mapping[str, float] = field(default_factory=dict)
    """Standard deviations of the variance components, by name and unit: beyond the measured noise, or all of the noise
    if it was not measured. A `walk` is per mean interval between poses, a `slope` per session."""
    drift: DriftResult | None = None
    response: Response | None = None
    """Gain and cross-talk of the sensor as best linear prediction; None if they were not found."""
    may_bend: bool = False
    """Whether the data weakly show a nonlinear response, which this fit treats as noise."""

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
        """Return the estimates of another method, for poses with independent noise `wrench_cov` (n, 6, 6).

        `measured` is true if the noise was measured, and false if it was estimated from the residuals. The columns of
        `free` (15, m) span the estimated parameters; it is the identity unless the method assumes mounting or gravity.
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
        """(n, 6) measured minus predicted wrench; the prediction includes the mean bias, gain and cross-talk."""
        added = 0.0 if self.response is None else self.response.wrench(self.parameters, self.R_base_flange)
        return np.asarray(self.wrench - predict(self.on_average, self.R_base_flange) - added)

    @cached_property
    def _left_out(self) -> tuple[Array, Array]:
        """Leave-one-out residuals and their covariance, without refitting: exact for a linear model."""
        J = jacobian(self.parameters, self.R_base_flange) @ self.free
        WJ = self.noise.solve(J)
        information = summed_products(J, WJ)
        # The parameters have different units: without scaling the smallest eigenvalues would be taken for zero.
        scale = column_scale(information)
        C = np.asarray(np.linalg.pinv(information / np.outer(scale, scale), hermitian=True)) / np.outer(scale, scale)
        return left_out(self.noise, WJ, self.noise.solve(self.residuals[..., None])[..., 0], C)

    @property
    def left_out_residuals(self) -> Array:
        """(n, 6) leave-one-out residuals: measured minus predicted from all other poses, with drift."""
        return self._left_out[0]

    @property
    def left_out_cov(self) -> Array:
        """(n, 6, 6) covariance of the leave-one-out residuals: noise of the pose plus uncertainty of its prediction."""
        return self._left_out[1]

    @cached_property
    def elsewhere(self) -> Array:
        """(6,) mean square error of predictions over all orientations minus that over the orientations of the poses."""
        return np.zeros(6)


@dataclass(frozen=True, eq=False, kw_only=True)
class Fit(Estimate):
    """Estimates by maximum likelihood, with variance components from the data."""

    information: Array
    """(15, 15) Fisher information of the error coordinates `PARAMETER_NAMES`, including priors."""
    order: NDArray[np.intp]
    """(n,) indices that sort the poses by time."""
    given_noise: Array
    """(15, 15) covariance of the parameters if the noise model is taken as known."""
    lag: tuple[Array, Array] | None
    """Hysteresis and structured errors (n, 6) of each pose with their variance (n, 6, 6), which the compensation does
    not model; None if there are none."""
    at: Point | None
    """Restricted likelihood at the solution; None for many poses, to save memory."""

    @property
    def wrench_cov(self) -> Array:
        """(n, 6, 6) noise covariance of each pose, without drift."""
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
            # With a prior, the gradient J' W r of the data is not zero at the best parameters.
            e[rows], S[rows] = left_out(noise, WX[..., :15], WX[..., 15], self.given_noise)
        if self.lag is not None:
            e, S = e + self.lag[0], S + self.lag[1]
        return e, S

    @cached_property
    def elsewhere(self) -> Array:
        """(6,) see `Estimate.elsewhere`; zero for many poses, where the difference is small."""
        if self.at is None:
            return np.zeros(6)
        R, middle = Rotation.create_group("O").as_matrix(), self.R_base_flange[self.order].mean(axis=0)
        effects = sensor_columns(self.parameters, R) | structure_columns(self.parameters, R, middle)
        problem = self.at.problem
        effects = {kind: columns for kind, columns in effects.items() if kind in problem.effects}
        everywhere = self.at.squares(jacobian(self.parameters, R) @ self.free, effects)
        return everywhere - self.at.squares(problem.J, {kind: problem.effects[kind] for kind in effects})

    def hidden_covariance(self, orientation_rad: float) -> Array:
        """Return the covariance (15, 15) of the estimates due to errors of arm and mounts that the poses do not show.

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
        """Minus twice the restricted log-likelihood, plus the penalties of components and rejected poses."""
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
    """Return residuals (n, 6) divided by a root of their covariance (n, 6, 6): independent, with unit variance."""
    unit = np.empty_like(residuals)
    for first in range(0, len(residuals), CHUNK):
        part = slice(first, first + CHUNK)
        unit[part] = np.linalg.solve(_root(covariance[part]), residuals[part, :, None])[..., 0]
    return unit


def _root(covariance: Array) -> Array:
    """Return matrices A (n, 6, 6) with A A' = covariance; a covariance that rounding made indefinite is allowed."""
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
    """Fit all 15 parameters, and variance components that increase the likelihood enough.

    Parameters
    ----------
    R_base_flange : array, shape (n, 3, 3)
        Rotation matrices, assumed to be valid.
    wrench : array, shape (n, 6)
        N and N·m, in the sensor frame.
    wrench_cov : array, shape (n, 6, 6) or (6, 6), or None
        Covariance of the wrench of each pose, or one covariance for all poses. Without it, one standard deviation of
        all forces and one of all torques are estimated; with fewer than six poses their ratio is assumed.
    t_s : array, shape (n,), optional
        Time of each pose. Without times, or if one is NaN, the poses are taken as equally spaced in their order.
    drift : {"auto", "none", "linear", "random-walk"}
        Model of the bias during the session. "auto": chosen by restricted likelihood.
    g_m_s2 : float
        Used only to convert a known mass to a weight.
    gain_sigma : float
        One standard deviation of the entries of the sensor's gain, used with fewer than 12 poses.

    Raises
    ------
    NotObservable
        The descent did not converge. A singular information matrix is not rejected here: see `Fit.information`.
    """
    session = SessionData(
        R_base_flange, wrench, wrench_cov, t_s, drift, Constraints(known or Known(), g_m_s2), gain_sigma
    )
    e, minima, static_chi2 = explain(session)
    has_structure = any(c in STRUCTURE for c in e.components)
    # Structured errors can explain wrong data so well that no weight of the tool remains.
    best = _fit_of(session, e, minima, static_chi2) if minima[0].settled or not session.structure() else None
    if best is not None and not (has_structure and session.n <= STRUCTURED_POSES):
        return best
    session.structured = False
    without, minima, static_chi2 = explain(session)
    plain = _fit_of(session, without, minima, static_chi2)
    if best is None:
        return plain
    # Structured errors that are not certain may only displace gain and cross-talk, which the compensation does model.
    is_unsure = without.criterion - e.criterion < _SURE
    displaced = is_unsure and _left_out_error(plain) < _left_out_error(best) - _CLEARLY
    return _beside(plain, best) if displaced else best


def _beside(found: Fit, other: Fit) -> Fit:
    """Return a fit with a covariance enlarged to include a second fit that is equally probable."""
    off, Z = found.parameters.difference(other.parameters), found.free
    more = Z.T @ (other.covariance - found.covariance + np.outer(off, off)) @ Z / 2
    scale = column_scale(Z.T @ found.covariance @ Z)
    value, vector = np.linalg.eigh(more / np.outer(scale, scale))
    root = Z @ (scale[:, None] * vector * np.sqrt(np.maximum(value, 0.0)))
    more = root @ root.T
    joint = found.joint_covariance.copy()
    joint[:15, :15] += more
    response = found.with_joint(joint)
    bends = any(name.startswith("load") for name in other.components)
    return replace(found, covariance=found.covariance + more, response=response, may_bend=bends)


def _left_out_error(found: Fit) -> float:
    """Return the sum of the logarithms of the mean square leave-one-out errors of force and torque."""
    square = (found.left_out_residuals[found.weights > 0] ** 2).reshape(-1, 2, 3).mean(axis=(0, 2))
    return float(np.log(np.maximum(square, _EXACT)).sum())


def _fit_of(session: SessionData, e: Explanation, minima: list[Minimum], static_chi2: float) -> Fit:
    """Return the `Fit` with estimates and covariance for an explanation; the arguments are the results of `explain`."""
    best = minima[0]
    if not best.settled:
        weight_N = best.parameters.weight_N
        raise NotObservable(
            f"the fit has not converged in {MAX_STEPS} steps, at a weight of {weight_N:.2g} N: "
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
        if drifts:  # the estimates contain the bias at the end of the session
            problem = replace(problem, origin=int(np.flatnonzero(e.kept)[-1]))
        at = point(problem, e.components, e.theta)
    if session.measured and found.keys() & {*RESPONSE}:
        of_sensor = [c for c in e.components if c in RESPONSE]
        measured_chi2 = point(problem, of_sensor, np.array([found[c] for c in of_sensor])).chi2
    # With many poses the uncertainty of the variances is negligible.
    parameters = best.parameters
    if drifts or found.keys() & {*RESPONSE, *UNCOMPENSATED} or (found and session.n < POSES_THAT_SHOW_THE_NOISE):
        x, C = estimates_of_unknown_variances(at)
        step = Z @ x[:-SIZE]
        if session.n < POSES_THAT_SHOW_THE_NOISE:
            others = rivals(problem, at, [*session.candidates(), *session.structure()])
            C = C + mixture_covariance(at, others)
            # Models without a drift that are almost as likely contribute to the estimate with their probability.
            step = step + sum(share * (Z @ rival.step - step) for rival, share in others)
        if drifts:
            parameters = parameters.moved(np.where(np.isin(np.arange(15), BIASES), step, 0.0))
        Z = block_diag(Z, np.eye(SIZE))
        covariance = (Z @ C @ Z.T)[:15, :15]
        response = Response(x[-SIZE:], Z @ C @ Z.T) if x[-SIZE:].any() else None
    # The order of the components is used, because the last digit of a sum over a set may differ between processes.
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
        second_basin_chi2=_second_basin_chi2([minimum.chi2 for minimum in minima], components, dof),
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
    """Return the difference between the two smallest minima of chi2; None if there is only one.

    If white noise was estimated from the same residuals, a larger noise would compensate part of the difference.
    """
    if len(minima) == 1:
        return None
    best, second = minima[:2]
    return float(dof * np.log(second / best)) if any(name.startswith("white") for name in components) else second - best


def _deviation(session: SessionData, c: Component, variance: float) -> float:
    """Return the standard deviation of a variance component; for estimated white noise, with its lower bound added."""
    least = 0.0 if session.measured or c.kind != "white" else session.cov[0][np.argmax(c.share), np.argmax(c.share)]
    return float(np.sqrt(variance + least))


def _drift_result(
    session: SessionData, best: Minimum, noise: Noise, C: Array, found: Mapping[Component, float]
) -> DriftResult:
    """Return the best linear prediction of the bias at every pose, and the standard deviation of its total change."""
    J, r = jacobian(best.parameters, session.R), session.wrench - predict(best.parameters, session.R)
    problem = session.linearise(best.parameters, noise.kept)
    others = [(problem.columns(c), value) for c, value in found.items() if c in (*RESPONSE, *UNCOMPENSATED)]

    def not_drift(X: Array) -> Array:
        """Return the product of X and the noise covariance of all variance components except the drift."""
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
