"""Verification: whether new poses agree with a calibration and, if not, what has changed.

All residuals are tested jointly. Their covariance contains the noise of the readings, the errors of each pose that the
fit found (`components`), the drift of the bias since the fit, and the uncertainty of the fit, common to all poses:

    S = noise + J C J' + drift,    chi2 = r' S^-1 r

The noise model of a fit to few poses is uncertain. Two explanations of its residuals are therefore considered:

* The components that the fit found (`CalibrationResult.components`), as if the new poses continued the tour.
* The measured noise times a factor, and usual errors of sensor, arm and cable (`response_columns`,
  `_smooth_error_covariance`). The fit shows the size of these errors, but not how they depend on joint angles.

Under the second explanation, for given ratios of the variances, the squared distance of new readings from their
prediction, relative to the mean square residual of the fit, has exactly an F distribution (predictive test of Chow,
Econometrica 28, 1960). Its probability is averaged over the ratios with weights from their restricted likelihood
(posterior predictive probability), so an error that the fit cannot detect widens the limit as far as the data allow.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from itertools import product
from typing import Literal

import numpy as np
from scipy.linalg import block_diag, solve_triangular
from scipy.special import chdtrc as chi2_sf
from scipy.special import fdtrc as f_sf

from ftcalib.after.state import BLOCKS, Update, reestimate, with_bias_change
from ftcalib.compensation import Compensator
from ftcalib.data.dataset import CalibrationDataset, pooled_covariance, require_finite
from ftcalib.errors import BadDataset, NotObservable
from ftcalib.files import JSON
from ftcalib.likelihood.descent import column_scale
from ftcalib.likelihood.structure import alike, hysteresis_columns
from ftcalib.model import (
    BIASES,
    Array,
    Parameters,
    angle_between_vectors,
    gravity_wrench,
    jacobian,
    predict,
    read_only,
    skew,
)
from ftcalib.result import CalibrationResult
from ftcalib.sensor_matrix import SIZE, USUAL, response_columns

Change = Literal["bias", "payload", "centre of mass", "mounting", "base", "several"]

# The change of the robot cell that each kind of update accounts for.
_SINGLE: Mapping[str, Change] = {
    "bias": "bias",
    "weight": "payload",
    "payload": "payload",
    "centre of mass": "centre of mass",
    "mounting": "mounting",
    "base": "base",
}
_SEVERAL = ("bias and payload", "all")
# Required reduction of chi2 per parameter of a change; one in 200 passes by chance.
_COST = 8.0
# A change explains the readings if the p-value of the remaining misfit is at least this.
_UNEXPLAINED = 1e-3
# Smallest difference in chi2 by which one change is preferred to another: odds of 100 to 1.
_INDISTINCT = 9.2
FEWEST = 2

# Trial sizes, relative to the usual ones, of gain and cross-talk that the fit did not find, and of smooth errors.
_USUAL_GAINS = np.array([0.1, 1.0])
_USUAL_SMOOTH = np.geomspace(0.15, 2, 3)
# Share of smooth errors that depends on joint angles rather than on the orientation, if the fit can detect it.
_OTHER_JOINTS = 0.8
# If the fit cannot, errors at other joint angles: variance relative to that in the fit, and to that of a usual arm.
_BEYOND, _LEAST_BEYOND = 2.0, np.array([1.0, 0.0])
# Largest number of poses of the fit for which smooth errors are estimated.
_FEW_TO_SMOOTH = 100
# Smallest factor of the measured noise: readings of a coarse sensor may agree much better than their stated noise.
_LEAST_FACTOR = 0.1
# Usual smooth errors, standard deviation per axis: orientation of a calibrated arm, force and torque of a cable.
_TURN_RAD, _CABLE = float(np.deg2rad(0.1)), np.repeat([0.05, 0.012], 3)

_AXES = {name: [k] for k, name in enumerate(("fx_N", "fy_N", "fz_N", "tx_Nm", "ty_Nm", "tz_Nm"))}
_CHANNELS = _AXES | {"force_N": [0, 1, 2], "torque_Nm": [3, 4, 5]}


@dataclass(frozen=True, slots=True, eq=False)
class Expected:
    """Predictive distribution of the readings if the robot cell has not changed, for one model of the errors."""

    calibration: Update
    """Calibration whose covariance includes the drift of the bias since it was made."""
    noise: Array
    """(6n, 6n) covariance of the new readings: measured noise, errors of each pose, drift since the first new pose."""
    freedom: float
    """Degrees of freedom of the estimate of the noise, or of its factor; infinite if it was not estimated."""
    factor: float = 1.0
    """Factor by which all variances, of noise and calibration, are multiplied; it is not included in chi2."""
    weight: float = 1.0
    """Probability of this distribution among the alternatives for other sizes of the errors; they sum to 1."""

    def distance(self, R_base_flange: Array, wrench: Array) -> tuple[Array, Array, float]:
        """Return the residuals (n, 6), their sigma (n, 6), and their joint chi2."""
        p, response = self.calibration.parameters, self.calibration.response
        residual = np.asarray(Compensator(p, response=response).batch(wrench, R_base_flange), dtype=np.float64)
        S = self.noise + self.common(R_base_flange)
        chi2 = float(residual.ravel() @ np.linalg.solve(S, residual.ravel()))
        return residual, np.sqrt(self.factor * np.diag(S)).reshape(residual.shape), chi2

    def common(self, R_base_flange: Array) -> Array:
        """Return the covariance (6n, 6n) of the predictions due to errors of the calibration, without `factor`."""
        K = self.calibration.jacobian(R_base_flange).reshape(6 * len(R_base_flange), -1)
        return np.asarray(K @ self.calibration.joint_covariance @ K.T)

    def p_value(self, chi2: float, dof: int) -> float:
        """Return the probability of a larger `chi2` if the cell has not changed."""
        chi2 /= self.factor
        return float(chi2_sf(dof, chi2) if np.isinf(self.freedom) else f_sf(dof, self.freedom, chi2 / dof))

    def deviance(self, chi2: float, dof: int) -> float:
        """Return -2 log likelihood up to a constant: chi2, or the value of Student's t if the noise was estimated."""
        chi2 /= self.factor
        return chi2 if np.isinf(self.freedom) else (self.freedom + dof) * float(np.log1p(chi2 / self.freedom))

    def bias_change(self, R_base_flange: Array, wrench: Array) -> tuple[Array, Array, Array]:
        """Return the change (6,) of the biases, if nothing else has changed, and both sigmas as in `Verification`.

        The residuals are r = H b + K e + noise, with the change b, H the identity for each pose, and the errors e of
        the calibration, common to all its verifications. By generalised least squares,

            b = G r,    G = (H' S^-1 H)^-1 H' S^-1,    S = noise + K C K',

        with the covariance G noise G' due to this verification, and G K C K' G' due to the calibration.
        """
        residual, _, _ = self.distance(R_base_flange, wrench)
        common = self.common(R_base_flange)
        H = np.tile(np.eye(6), (len(wrench), 1))
        weighted = np.linalg.solve(self.noise + common, H).T
        G = np.linalg.solve(weighted @ H, weighted)
        noise, calibration = (np.sqrt(self.factor * np.diag(G @ part @ G.T).clip(0.0)) for part in (self.noise, common))
        return G @ residual.ravel(), noise, calibration


def expected_as_found(calibration: CalibrationResult, R_base_flange: Array, wrench_cov: Array) -> Expected:
    """Return the distribution of new readings with the components of the fit, as if the new poses continued the tour.

    A random walk with variance q² per pose adds q² up to the first new pose, or q² (N / 3 + 1) to the mean bias of N
    poses, as in earlier files. A linear drift continues as long as the tour. Without components the factor is chi2/dof.
    """
    n, later = len(wrench_cov), np.arange(len(wrench_cov), dtype=np.float64)
    n_used = calibration.n_poses - len(calibration.rejected_poses)
    measured = np.zeros((n, 6, n, 6))
    measured[range(n), :, range(n)] = wrench_cov
    parts, gap, to_end = [], np.zeros(6), 0.0 if calibration.mean_bias is not None else n_used / 3
    for name, sigma in _components(calibration).items():
        kind, _, channels = name.partition("_")
        part, since = np.zeros((n, 6, n, 6)), np.zeros(6)
        c = _CHANNELS.get(channels, [])
        freedom = len(c) * calibration.dof / 6
        if kind == "walk":
            part[:, c, :, c], since[c] = sigma**2 * np.minimum.outer(later, later), sigma**2 * (to_end + 1)
            freedom = len(c) * (n_used - 1) / 2  # the other half of them belongs to white noise
        elif kind == "slope":
            part[:, c, :, c], since[c] = sigma**2 * np.outer(later, later) / n_used**2, sigma**2
            freedom = len(c)
        elif kind == "rotation":  # rotations about gravity have no effect
            turn = jacobian(calibration.parameters, R_base_flange)[..., :3]
            part[range(n), :, range(n)] = sigma**2 * (turn @ np.swapaxes(turn, 1, 2))
            freedom = max(2 * n_used - 6, 2)
        elif kind == "white":  # if the noise was not measured, this component contains all of it
            known = np.zeros_like(wrench_cov) if calibration.noise_source == "measured" else wrench_cov
            for k in c:
                part[range(n), k, range(n), k] = np.maximum(sigma**2 - known[:, k, k], 0.0)
        elif kind == "hysteresis":  # hysteresis: one coefficient for each of the six axes
            T = hysteresis_columns(calibration.parameters, R_base_flange).reshape(6 * n, -1)
            part, freedom = (sigma**2 * T @ T.T).reshape(n, 6, n, 6), 6
        else:  # gain and cross-talk are in `response`, not in the noise
            continue
        gap += since
        part[:, range(6), :, range(6)] += since[:, None, None]
        parts.append((part.reshape(6 * n, 6 * n), freedom))
    total = measured.reshape(6 * n, 6 * n) + sum((part for part, _ in parts), np.zeros((6 * n, 6 * n)))
    noise = total - np.kron(np.ones((n, n)), np.diag(gap))
    drifted = with_bias_change(calibration, np.zeros(6), gap)
    if not (parts or calibration.components) and calibration.noise_source == "measured":
        factor = max(calibration.chi2 / calibration.dof, _LEAST_FACTOR)
        return Expected(drifted, noise, calibration.dof, factor)
    # Satterthwaite's degrees of freedom, with each component weighted by its share of the noise
    inverse = np.linalg.inv(total)
    spread = sum((float(np.vdot(inverse, part)) / (6 * n)) ** 2 / freedom for part, freedom in parts)
    return Expected(drifted, noise, 1 / spread if spread else np.inf)


def expected_with_smooth_errors(
    calibration: CalibrationResult, fitted: CalibrationDataset, R_base_flange: Array, wrench_cov: Array
) -> list[Expected]:
    """Return distributions of new readings with scaled measured noise, and usual errors of sensor, arm and cable.

    The list covers various sizes of the errors, with weights that sum to 1. It is empty if the noise was not measured,
    if parameters were known, or if they were not estimated by maximum likelihood. Gain and cross-talk that the fit
    found have their estimated variance.

    The errors at the new poses are predicted from those of the fit, with a variance that increases with the distance in
    orientation. A part depends on joint angles alone; a fit to wrist rotations does not show this part.
    """
    p = calibration.parameters
    kept = np.ones(len(fitted), bool) if calibration.weights is None else calibration.weights > 0
    complete = calibration.method == "ml" and calibration.dof == 6 * int(kept.sum()) - 15
    if not complete or fitted.wrench_cov is None:
        return []
    rows = np.flatnonzero(kept)[:: -(-int(kept.sum()) // _FEW_TO_SMOOTH)]
    R, dof = fitted.R_base_flange[rows], 6 * len(rows) - 15
    D = block_diag(*pooled_covariance(fitted.wrench_cov, fitted.n_samples)[rows])
    e = (fitted.wrench[rows] - predict(p, R)).ravel()
    J, J_new = (jacobian(p, poses).reshape(-1, 15) for poses in (R, R_base_flange))
    T, T_new = (response_columns(p, poses).reshape(-1, SIZE) for poses in (R, R_base_flange))
    pairs = (R, R), (R_base_flange, R), (R_base_flange, R_base_flange)
    smooth, between, new = (_smooth_error_covariance(p, *pair) for pair in pairs)
    alone, alone_new = (whole * np.kron(np.eye(whole.shape[1] // 6), np.ones((6, 6))) for whole in (smooth, new))
    sizes = np.repeat([calibration.components.get(name, 0.0) for name in ("gain", "cross_talk")], [5, 6])
    coefficients = calibration.shown_response.coefficients
    stored = calibration.jacobian(R_base_flange).reshape(len(J_new), -1)
    stored = stored @ calibration.joint_covariance @ stored.T
    explanations, likelihood = [], []
    for share, of_gain, *of_kinds in product((0.0, _OTHER_JOINTS), _USUAL_GAINS, _USUAL_SMOOTH, _USUAL_SMOOTH):
        square = np.square(of_kinds)
        alike, gain = (1 - share) * square, np.where(sizes > 0, sizes, of_gain * USUAL) ** 2
        S = D + np.tensordot(alike, smooth, 1) + np.tensordot(share * square, alone, 1) + (T * gain) @ T.T
        to_new = np.tensordot(alike, between, 1) + (T_new * gain) @ T.T
        L = np.linalg.cholesky(S)
        white = solve_triangular(L, np.column_stack([J, e, to_new.T]), lower=True)
        white_J, white_e, white_new = white[:, :15], white[:, 15], white[:, 16:]
        H = white_J.T @ white_J
        scale = column_scale(H)
        H = H / np.outer(scale, scale)
        C = np.linalg.inv(H) / np.outer(scale, scale)
        x = C @ (white_J.T @ white_e)
        left = white_e - white_J @ x
        chi2 = float(left @ left)
        logdet = 2 * float(np.log(np.diag(L)).sum() + np.log(scale).sum()) + float(np.linalg.slogdet(H)[1])
        likelihood.append(-0.5 * (logdet + dof * np.log(chi2)))
        factor = max(chi2 / dof, _LEAST_FACTOR)
        off, B = white_new.T @ left + J_new @ x - T_new @ coefficients, J_new - white_new.T @ white_J
        total = block_diag(*wrench_cov) + np.tensordot(alike, new, 1) + (T_new * gain) @ T_new.T
        total -= white_new.T @ white_new
        # If joint angles follow from the orientation in the fit, other joint angles may have larger errors.
        total += np.tensordot(share * square if share else _BEYOND * square + _LEAST_BEYOND, alone_new, 1)
        # Under this explanation the estimates move, so the stored prediction has an additional error.
        total += B @ C @ B.T + np.outer(off, off) / factor
        value, vector = np.linalg.eigh(total - stored / factor)
        noise = (vector * np.maximum(value, 1e-6 * value[-1])) @ vector.T
        joint = calibration.with_joint(calibration.joint_covariance / factor)
        update = Update(p, calibration.covariance / factor, 0.0, 0, response=joint)
        explanations.append(Expected(update, noise, dof, factor))
    weights = np.exp(np.array(likelihood) - max(likelihood))
    return [replace(each, weight=weight) for each, weight in zip(explanations, weights / weights.sum(), strict=True)]


def _components(calibration: CalibrationResult) -> Mapping[str, float]:
    """Return the variance components of the fit by name; a linear drift, if modelled, is one of them."""
    found = dict(calibration.components)
    if calibration.drift is not None and not any(name.startswith(("walk", "slope")) for name in found):
        found |= {f"slope_{name}": float(abs(calibration.drift.change[c[0]])) for name, c in _AXES.items()}
    return found


def _smooth_error_covariance(p: Parameters, R_base_flange: Array, others: Array) -> Array:
    """Return the covariances (2, 6n, 6m) between two sets of orientations, for smooth errors of arm and cable."""
    correlated = alike(R_base_flange, others)
    turn, turn_other = (jacobian(p, R)[..., :3] * _TURN_RAD for R in (R_base_flange, others))
    of_arm = np.einsum("nm,nik,mjk->nimj", correlated, turn, turn_other)
    return np.array([of_arm.reshape(6 * len(R_base_flange), -1), np.kron(correlated, np.diag(_CABLE**2))])


@dataclass(frozen=True, slots=True, eq=False)
class Verification:
    """Result of a verification; arrays are read-only."""

    residual: Array
    """(n, 6) measured minus predicted, N and N·m, in the sensor frame."""
    predicted_sigma: Array
    """(n, 6) standard deviation of the residuals from noise, drift and uncertainty of the calibration, N and N·m."""
    chi2: float
    """Joint chi2 of all residuals: their squared Mahalanobis distance from the prediction."""
    dof: int
    p_value: float
    """Probability of a larger chi2 if nothing has changed."""
    passed: bool
    change: Change | None
    """The change that explains the readings; None if the verification passed, or if no change explains them."""
    reason: str
    bias_change: Array
    """(6,) change of the bias since the calibration if nothing else has changed; force first, N and N·m."""
    bias_sigma: Array
    """(6,) standard deviation of `bias_change` due to this verification, independent of other verifications."""
    calibration_sigma: Array
    """(6,) standard deviation of `bias_change` due to the calibration, nearly common to all its verifications."""
    alternatives: tuple[Change, ...] = ()
    """Other changes that explain the readings equally well."""
    update: Update | None = None
    """Smallest update that accounts for the change; None if the verification passed, or if no update does."""

    def __post_init__(self) -> None:
        for name in ("residual", "predicted_sigma", "bias_change", "bias_sigma", "calibration_sigma"):
            object.__setattr__(self, name, read_only(getattr(self, name)))

    def to_dict(self) -> dict[str, JSON]:
        """Return the verification as a JSON object; `update` contains only its kind, chi2 and dof."""
        update = self.update
        bias = {"value": self.bias_change, "sigma": self.bias_sigma, "calibration_sigma": self.calibration_sigma}
        return {
            "passed": self.passed,
            "change": self.change,
            "alternatives": list(self.alternatives),
            "reason": self.reason,
            "chi2": self.chi2,
            "dof": self.dof,
            "p_value": self.p_value,
            "residual": self.residual.tolist(),
            "predicted_sigma": self.predicted_sigma.tolist(),
            "bias_change": {name: value.tolist() for name, value in bias.items()},
            "update": None if update is None else {"kind": update.kind, "chi2": update.chi2, "dof": update.dof},
        }


def verify_calibration(
    calibration: CalibrationResult,
    R_base_flange: Array,
    wrench: Array,
    wrench_cov: Array,
    *,
    fitted: CalibrationDataset | None = None,
    false_alarms: float = 0.01,
) -> Verification:
    """Return whether new poses agree with a calibration; on an alarm, also the change and the smallest update.

    An alarm is a p-value below `false_alarms` under both explanations of the residuals of the fit: the components that
    it found, and smooth errors of sensor, arm and cable. The likelier one for the new readings determines the change.

    Each kind of change re-estimates some parameters and keeps the others with their uncertainty. It explains the
    readings unless its misfit exceeds that of 999 in 1000 good fits. Among these, the change with the lowest chi2 plus
    8 per parameter is reported. If there is none, bias and payload together are tried, then all parameters.

    Parameters
    ----------
    R_base_flange : array, shape (n, 3, 3)
        n >= 2 poses that were not used in the calibration, in the order of measurement. 6 poses separate all causes.
    wrench : array, shape (n, 6)
        Mean readings of the free tool as measured, N and N·m, in the sensor frame.
    wrench_cov : array, shape (n, 6, 6)
        Covariances of the means, pooled if they are from fewer than 100 samples (`ftcalib.data.dataset`).
    fitted : CalibrationDataset, optional
        Poses of the calibration, which show the uncertainty of its noise model.
    false_alarms : float
        Share of unchanged cells that fail, in poses like those of the calibration. In other poses it is up to about
        three times as large, if errors of arm, cable or sensor are larger than usual.

    Raises
    ------
    BadDataset
        Fewer than two poses, or inconsistent shapes.
    """
    n = len(wrench)
    if n < FEWEST:
        raise BadDataset(f"{n} {'pose is' if n == 1 else 'poses are'} too few for a verification: record 2 or more.")
    R_base_flange = require_finite("R_base_flange", R_base_flange, (n, 3, 3))
    wrench = require_finite("wrench", wrench, (n, 6))
    wrench_cov = require_finite("wrench_cov", wrench_cov, (n, 6, 6))
    if not 0 < false_alarms < 1:
        raise ValueError(f"false_alarms is {false_alarms}, expected a fraction between 0 and 1")
    if fitted is not None and len(fitted) != calibration.n_poses:
        raise BadDataset(
            f"`fitted` has {len(fitted)} poses, but the calibration has {calibration.n_poses}: pass its dataset."
        )
    explanations = [[expected_as_found(calibration, R_base_flange, wrench_cov)]]

    def probability(kind: list[Expected]) -> float:
        return sum(each.weight * each.p_value(each.distance(R_base_flange, wrench)[2], 6 * n) for each in kind)

    p_values = [probability(explanations[0])]
    # The explanation with smooth errors has larger sigmas, so it is evaluated only if that with components fails.
    if fitted is not None and p_values[0] < false_alarms:
        smooth = expected_with_smooth_errors(calibration, fitted, R_base_flange, wrench_cov)
        if smooth:
            explanations.append(smooth)
            p_values.append(probability(smooth))
    likeliest = [max(kind, key=lambda each: each.weight) for kind in explanations]
    # An alarm requires that both explanations fail, because a cell that passes under one of them may be unchanged.
    p_value = max(p_values)
    if p_value >= false_alarms:
        return _compare(likeliest[p_values.index(p_value)], p_value, R_base_flange, wrench, passed=True)
    changes = [_possible_updates(calibration, expected, R_base_flange, wrench) for expected in likeliest]
    best = min(range(len(changes)), key=lambda k: min((cost for cost, _ in changes[k].values()), default=np.inf))
    alarm = _compare(likeliest[best], p_value, R_base_flange, wrench, passed=False)
    return _explain_alarm(alarm, calibration, changes[best])


def _compare(expected: Expected, p_value: float, R_base_flange: Array, wrench: Array, *, passed: bool) -> Verification:
    residual, sigma, chi2 = expected.distance(R_base_flange, wrench)
    n, (change, bias_sigma, calibration_sigma) = len(wrench), expected.bias_change(R_base_flange, wrench)
    return Verification(
        residual=residual,
        predicted_sigma=sigma,
        chi2=chi2,
        dof=6 * n,
        p_value=p_value,
        passed=passed,
        change=None,
        reason=f"the {n} poses agree with the calibration (chi2 {chi2:.0f} for {6 * n} readings, p {p_value:.2g})",
        bias_change=change,
        bias_sigma=bias_sigma,
        calibration_sigma=calibration_sigma,
    )


def _possible_updates(
    calibration: CalibrationResult, expected: Expected, R_base_flange: Array, wrench: Array
) -> dict[str, tuple[float, Update]]:
    """Return the changes that explain the readings, each with its penalised -2 log likelihood and its update."""
    dof = wrench.size
    unchanged = expected.deviance(expected.distance(R_base_flange, wrench)[2], dof)
    logdet = float(np.linalg.slogdet(expected.noise + expected.common(R_base_flange))[1])
    logdet += dof * float(np.log(expected.factor))
    updates = {}
    for kind in (*_SINGLE, *_SEVERAL):
        try:
            update = reestimate(expected.calibration, R_base_flange, wrench, expected.noise, kind)
            if "centre of mass" in BLOCKS[kind] and calibration.gain_sigma:
                noise = expected.noise + _turned_shift(calibration, update.parameters, R_base_flange)
                update = reestimate(expected.calibration, R_base_flange, wrench, noise, kind)
        except NotObservable:
            continue
        cost = expected.deviance(update.chi2, dof) + _COST * (dof - update.dof)
        if cost < unchanged and expected.p_value(update.chi2, update.dof) > _UNEXPLAINED:
            updates[kind] = logdet + cost, update
    return updates


def _explain_alarm(
    alarm: Verification, calibration: CalibrationResult, found: Mapping[str, tuple[float, Update]]
) -> Verification:
    """Return the alarm with the change that explains it, and with the corresponding update."""
    misfit = f"chi2 {alarm.chi2:.0f} for {alarm.dof} readings"
    single = sorted((kind for kind in found if kind in _SINGLE), key=lambda kind: found[kind][0])
    if single:
        least, update = found[single[0]]
        change = _SINGLE[single[0]]
        blocks = set(BLOCKS[single[0]])
        # A change that includes the reported one, or is included in it (as weight in payload), is no alternative to it.
        apart = [kind for kind in single if not (blocks <= set(BLOCKS[kind]) or blocks >= set(BLOCKS[kind]))]
        others = tuple(dict.fromkeys(_SINGLE[kind] for kind in apart if found[kind][0] < least + _INDISTINCT))
        reason = f"{_describe_update(calibration, update)} ({misfit}, {update.chi2:.0f} after the update)"
        if others:
            reason += (
                f"; these poses do not distinguish it from a change of {' or '.join(others)}: verify with more poses"
            )
        return replace(alarm, change=change, alternatives=others, update=update, reason=reason)
    for kind in _SEVERAL:
        if kind in found:
            update = found[kind][1]
            names = "bias and payload" if kind == "bias and payload" else "several quantities"
            reason = f"{names} have changed: {_describe_update(calibration, update)} ({misfit})"
            return replace(alarm, change="several", update=update, reason=reason)
    worst = int(np.argmax(np.linalg.norm(alarm.residual / alarm.predicted_sigma, axis=1)))
    force_N, torque_Nm = (float(np.linalg.norm(alarm.residual[worst, c])) for c in (slice(3), slice(3, 6)))
    return replace(
        alarm,
        reason=f"no change of bias, payload, mounting or base explains the readings ({misfit}; pose {worst + 1} "
        f"deviates most, by {force_N:.2g} N and {torque_Nm:.2g} N·m): free tool and cables and verify again with 6 "
        "poses or more, or calibrate again",
    )


def _turned_shift(calibration: CalibrationResult, new: Parameters, R_base_flange: Array) -> Array:
    """Return the covariance (6n, 6n) of the readings due to the gain after a shift of the centre of mass.

    The antisymmetric part a of the gain rotates all forces like the mounting, and the calibration cannot separate them.
    The torque is not rotated: for a shift d it is d x (u - a x u), with u the weight as measured.
    """
    shift = skew(new.p_sensor_com_m - calibration.p_sensor_com_m)
    columns = np.zeros((len(R_base_flange), 6, 3))
    columns[:, 3:] = shift @ skew(gravity_wrench(new, R_base_flange)[:, :3])
    columns = calibration.gain_sigma * columns.reshape(-1, 3)
    return np.asarray(columns @ columns.T)


def _describe_update(calibration: CalibrationResult, update: Update) -> str:
    old, new = calibration.parameters, update.parameters
    error = old.difference(new)
    words = []
    before_N, after_N = old.weight_N, new.weight_N
    if before_N != after_N and update.kind != "base":
        words.append(f"the payload has changed by {1e3 * (after_N - before_N) / calibration.g_m_s2:+.0f} g")
    if error[9:12].any():
        words.append(f"the centre of mass has moved by {1e3 * np.linalg.norm(error[9:12]):.1f} mm")
    if error[BIASES].any():
        force_N, torque_Nm = np.linalg.norm(error[6:9]), np.linalg.norm(error[12:15])
        words.append(f"the bias has changed by {force_N:.2g} N and {torque_Nm:.2g} N·m")
    if error[:3].any():
        words.append(f"the sensor has turned on the flange by {np.rad2deg(np.linalg.norm(error[:3])):.2g}°")
    if update.kind in ("base", "all"):
        turned_rad = angle_between_vectors(old.gravity_force_base_N, new.gravity_force_base_N)
        words.append(f"gravity has turned in base axes by {np.rad2deg(turned_rad):.2g}°")
    return ", ".join(words)
