"""How far readings of an unchanged cell may be from their prediction, under each explanation of the fit's residuals.

What is estimated by a fit of few poses is uncertain, and so is what acts on its readings. Two explanations are kept:

* The components that the fit found (`CalibrationResult.components`), as if the new poses continued the tour.
* The measured noise, by a factor that only the residuals of the fit show, and what sensor, arm and cable usually do
  (`sensor_error_columns`, `_smooth_errors`). The residuals show its size, but not what other joint angles do in one
  orientation.

Under the second, with the ratio of both variances given, the squared distance of new readings from their prediction
over the mean square of the fit's residuals has exactly an F distribution (predictive test of Chow, Econometrica 28,
1960). Its probability is averaged over the ratios, each weighted by its restricted likelihood in the fit (posterior
predictive probability), so an error that the fit cannot find widens the limit as much as the data allow.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from itertools import product

import numpy as np
from scipy.linalg import block_diag, solve_triangular
from scipy.special import chdtrc as chi2_sf
from scipy.special import fdtrc as f_sf

from ftcalib.after.state import Update
from ftcalib.compensation import Compensator
from ftcalib.data.dataset import CalibrationDataset, pooled_covariance
from ftcalib.files import JSON
from ftcalib.known import CROSS_TALK_SHARE, RANGE_LEVER_M, USUAL_GAIN
from ftcalib.likelihood.descent import column_scale
from ftcalib.likelihood.structure import alike, hysteresis_columns
from ftcalib.model import BIASES, Array, Parameters, gravity_wrench, jacobian, predict, read_only, skew
from ftcalib.result import CalibrationResult
from ftcalib.sensor_matrix import (
    SIZE,
    USUAL,
    Response,
    joint_covariance,
    joint_jacobian,
    response_columns,
    with_covariance,
)

# Sizes of gain and cross-talk that the fit did not find, and of smooth errors of arm and cable, relative to usual ones.
USUAL_GAINS = np.array([0.1, 1.0])
USUAL_SMOOTH = np.geomspace(0.15, 2, 3)
# Share of smooth errors that is not one of the orientation, where a fit reaches orientations with various joint angles.
OTHER_JOINTS = 0.8
# Else what other joint angles add: variances of the size that the fit shows, and at least those of a usual arm.
BEYOND, LEAST_BEYOND = 2.0, np.array([1.0, 0.0])
# Of more poses every second, third, ... shows smooth errors.
FEW_TO_SMOOTH = 100
# Least share of the measured noise: readings of a coarse sensor may agree far better than their stated noise, by luck.
LEAST_FACTOR = 0.1

# A mounted or aged sensor before its fit, one sigma: its diagonal, and the rest of its range (levers of 50 mm).
GAIN, CROSS = USUAL_GAIN, CROSS_TALK_SHARE * USUAL_GAIN
# What of the gain depends on the load.
LOAD = 0.005
# Smooth errors, one sigma an axis: of the orientations of a calibrated arm, and of the pull of a cable.
TURN_RAD, CABLE = float(np.deg2rad(0.1)), np.repeat([0.05, 0.012], 3)

_AXES = {name: [k] for k, name in enumerate(("fx_N", "fy_N", "fz_N", "tx_Nm", "ty_Nm", "tz_Nm"))}
_CHANNELS = _AXES | {"force_N": [0, 1, 2], "torque_Nm": [3, 4, 5]}


@dataclass(frozen=True, slots=True, eq=False)
class Expected:
    """What unchanged readings scatter by, under one explanation."""

    calibration: Update
    """The calibration, with the drift of the bias since then in its covariance."""
    noise: Array
    """(6n, 6n) of the new readings: measured noise, errors of each pose, drift from the first to each."""
    freedom: float
    """Degrees of freedom from which the fit estimated this noise, or its factor; infinite if neither."""
    factor: float = 1.0
    """By which all variances are multiplied, noise and calibration; chi2 is without it."""
    weight: float = 1.0
    """Probability of the explanation, relative to the others of its kind."""

    def distance(self, R_base_flange: Array, wrench: Array) -> tuple[Array, Array, float]:
        """Return the residuals (n, 6), their sigma (n, 6), and chi2 of all of them together."""
        p, response = self.calibration.parameters, self.calibration.response
        residual = np.asarray(Compensator(p, response=response).batch(wrench, R_base_flange), dtype=np.float64)
        S = self.noise + self.common(R_base_flange)
        chi2 = float(residual.ravel() @ np.linalg.solve(S, residual.ravel()))
        return residual, np.sqrt(self.factor * np.diag(S)).reshape(residual.shape), chi2

    def common(self, R_base_flange: Array) -> Array:
        """Return the covariance (6n, 6n) of the predictions: the uncertainty of the calibration, without `factor`."""
        p, response = self.calibration.parameters, self.calibration.response
        C = joint_covariance(self.calibration.covariance, response)
        K = joint_jacobian(p, response, R_base_flange).reshape(6 * len(R_base_flange), -1)
        return np.asarray(K @ C @ K.T)

    def p_value(self, chi2: float, dof: int) -> float:
        """Probability of a larger chi2."""
        chi2 /= self.factor
        return float(chi2_sf(dof, chi2) if np.isinf(self.freedom) else f_sf(dof, self.freedom, chi2 / dof))

    def deviance(self, chi2: float, dof: int) -> float:
        """-2 log likelihood: chi2, or that of Student's distribution if the noise was estimated."""
        chi2 /= self.factor
        return chi2 if np.isinf(self.freedom) else (self.freedom + dof) * float(np.log1p(chi2 / self.freedom))


def expected_as_found(calibration: CalibrationResult, R_base_flange: Array, wrench_cov: Array) -> Expected:
    """Add up what the fit found beyond the measured noise, as if the new poses continued the tour.

    A random walk of variance q² a pose moves the bias by q² to the first new pose, and from the mean of the N poses of
    the tour, which earlier files have, by q² (N / 3 + 1). A linear drift goes on for as long as the tour. If the fit
    found nothing, the measured noise has the factor chi2 / dof of the fit.
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
            freedom = len(c) * (n_used - 1) / 2  # the other half is that of the white noise
        elif kind == "slope":
            part[:, c, :, c], since[c] = sigma**2 * np.outer(later, later) / n_used**2, sigma**2
            freedom = len(c)
        elif kind == "rotation":  # turns about gravity do not show
            turn = jacobian(calibration.parameters, R_base_flange)[..., :3]
            part[range(n), :, range(n)] = sigma**2 * (turn @ np.swapaxes(turn, 1, 2))
            freedom = max(2 * n_used - 6, 2)
        elif kind == "white":  # with unmeasured noise all of it
            known = np.zeros_like(wrench_cov) if calibration.noise_source == "measured" else wrench_cov
            for k in c:
                part[range(n), k, range(n), k] = np.maximum(sigma**2 - known[:, k, k], 0.0)
        elif kind == "hysteresis":  # six shares, one for each axis
            T = hysteresis_columns(calibration.parameters, R_base_flange).reshape(6 * n, -1)
            part, freedom = (sigma**2 * T @ T.T).reshape(n, 6, n, 6), 6
        else:  # gain and cross-talk act through the response
            continue
        gap += since
        part[:, range(6), :, range(6)] += since[:, None, None]
        parts.append((part.reshape(6 * n, 6 * n), freedom))
    total = measured.reshape(6 * n, 6 * n) + sum((part for part, _ in parts), np.zeros((6 * n, 6 * n)))
    noise = total - np.kron(np.ones((n, n)), np.diag(gap))
    if not (parts or calibration.components) and calibration.noise_source == "measured":
        factor = max(calibration.chi2 / calibration.dof, LEAST_FACTOR)
        return Expected(_add_drift(calibration, gap), noise, calibration.dof, factor)
    # Satterthwaite: the variances of independent estimates add up, each by its share of the noise
    inverse = np.linalg.inv(total)
    spread = sum((float(np.vdot(inverse, part)) / (6 * n)) ** 2 / freedom for part, freedom in parts)
    return Expected(_add_drift(calibration, gap), noise, 1 / spread if spread else np.inf)


def expected_with_smooth_errors(
    calibration: CalibrationResult, fitted: CalibrationDataset, R_base_flange: Array, wrench_cov: Array
) -> list[Expected]:
    """Explain the fit by scaled measured noise, and by usual errors of sensor, arm and cable of various sizes.

    Empty if the noise was not measured, for parameters that were known or not estimated by maximum likelihood. The
    weights sum to 1. Gain and cross-talk that the fit found have the variance that it gave them.

    What they do to the new poses follows from what they have done to those of the fit, and grows with the distance.
    Where joint angles vary for themselves, a part of it does not follow from the orientation. Either the fit shows that
    part, or its poses turn the wrist alone and cannot.
    """
    p, response = calibration.parameters, calibration.response
    kept = np.ones(len(fitted), bool) if calibration.weights is None else calibration.weights > 0
    complete = calibration.method == "ml" and calibration.dof == 6 * int(kept.sum()) - 15
    if not complete or fitted.wrench_cov is None:
        return []
    rows = np.flatnonzero(kept)[:: -(-int(kept.sum()) // FEW_TO_SMOOTH)]
    R, dof = fitted.R_base_flange[rows], 6 * len(rows) - 15
    D = block_diag(*pooled_covariance(fitted.wrench_cov, fitted.n_samples)[rows])
    e = (fitted.wrench[rows] - predict(p, R)).ravel()
    J, J_new = (jacobian(p, one).reshape(-1, 15) for one in (R, R_base_flange))
    T, T_new = (response_columns(p, one).reshape(-1, SIZE) for one in (R, R_base_flange))
    smooth, between, new = (_smooth_errors(p, *pair) for pair in ((R, R), (R_base_flange, R), (R_base_flange,) * 2))
    alone, alone_new = (whole * np.kron(np.eye(whole.shape[1] // 6), np.ones((6, 6))) for whole in (smooth, new))
    sizes = np.repeat([calibration.components.get(name, 0.0) for name in ("gain", "cross_talk")], [5, 6])
    coefficients = calibration.shown_response.coefficients
    stored = joint_jacobian(p, response, R_base_flange).reshape(len(J_new), -1)
    stored = stored @ joint_covariance(calibration.covariance, response) @ stored.T
    explanations, likelihood = [], []
    for share, of_gain, *of_kinds in product((0.0, OTHER_JOINTS), USUAL_GAINS, USUAL_SMOOTH, USUAL_SMOOTH):
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
        factor = max(chi2 / dof, LEAST_FACTOR)
        off, B = white_new.T @ left + J_new @ x - T_new @ coefficients, J_new - white_new.T @ white_J
        total = block_diag(*wrench_cov) + np.tensordot(alike, new, 1) + (T_new * gain) @ T_new.T
        total -= white_new.T @ white_new
        # Where joint angles follow from the orientation in the fit, others may do more than it shows.
        total += np.tensordot(share * square if share else BEYOND * square + LEAST_BEYOND, alone_new, 1)
        # The prediction as stored is off by what this explanation moves it.
        total += B @ C @ B.T + np.outer(off, off) / factor
        value, vector = np.linalg.eigh(total - stored / factor)
        noise = (vector * np.maximum(value, 1e-6 * value[-1])) @ vector.T
        joint = with_covariance(response, joint_covariance(calibration.covariance, response) / factor)
        update = Update(p, calibration.covariance / factor, 0.0, 0, response=joint)
        explanations.append(Expected(update, noise, dof, factor))
    weights = np.exp(np.array(likelihood) - max(likelihood))
    return [replace(one, weight=weight) for one, weight in zip(explanations, weights / weights.sum(), strict=True)]


def _components(calibration: CalibrationResult) -> Mapping[str, float]:
    """Components of the noise, and a linear drift that was part of the model."""
    found = dict(calibration.components)
    if calibration.drift is not None and not any(name.startswith(("walk", "slope")) for name in found):
        found |= {f"slope_{name}": float(abs(calibration.drift.change[c[0]])) for name, c in _AXES.items()}
    return found


def _add_drift(calibration: CalibrationResult, gap: Array) -> Update:
    """Add variances (6,) of the bias to the covariance of a calibration."""
    covariance = calibration.covariance.copy()
    joint = joint_covariance(calibration.covariance, calibration.response).copy()
    covariance[BIASES, BIASES] += gap
    joint[BIASES, BIASES] += gap
    return Update(calibration.parameters, covariance, 0.0, 0, response=with_covariance(calibration.response, joint))


# Change of the six biases since a calibration, from the readings of one verification.
#
# The residuals are r = H b + K e + noise, with b the change, H the identity for each pose, and e the errors of the
# calibration, which all its verifications share. Their mean is that of generalised least squares,
#
#     b = G r,    G = (H' S^-1 H)^-1 H' S^-1,    S = noise + K C K',
#
# and its covariance has two parts: G noise G' is that of this verification, G K C K' G' that of the calibration.


@dataclass(frozen=True, slots=True, eq=False)
class BiasChange:
    """New bias minus that of the calibration, in the sensor frame; force first, N and N·m. Arrays are read-only."""

    value: Array
    """(6,)"""
    sigma: Array
    """(6,) one standard deviation from the readings of this verification, independent of any other."""
    calibration_sigma: Array
    """(6,) one standard deviation from the calibration: nearly the same error in all its verifications."""

    def __post_init__(self) -> None:
        for name in ("value", "sigma", "calibration_sigma"):
            object.__setattr__(self, name, read_only(getattr(self, name)))

    def to_dict(self) -> dict[str, JSON]:
        """Return the content as JSON."""
        return {name: getattr(self, name).tolist() for name in ("value", "sigma", "calibration_sigma")}


def bias_change(expected: Expected, R_base_flange: Array, wrench: Array) -> BiasChange:
    """Estimate the change of the six biases, as if nothing else had changed.

    Parameters
    ----------
    expected : Expected
        What unchanged readings of these poses scatter by.
    R_base_flange : array, shape (n, 3, 3)
    wrench : array, shape (n, 6)
        Mean readings as measured, N and N·m, in the sensor frame.
    """
    residual, _, _ = expected.distance(R_base_flange, wrench)
    common = expected.common(R_base_flange)
    H = np.tile(np.eye(6), (len(wrench), 1))
    weighted = np.linalg.solve(expected.noise + common, H).T
    G = np.linalg.solve(weighted @ H, weighted)
    noise, calibration = (
        np.sqrt(expected.factor * np.diag(G @ part @ G.T).clip(0.0)) for part in (expected.noise, common)
    )
    return BiasChange(G @ residual.ravel(), noise, calibration)


def sensor_error_columns(tool: Parameters, known: Response, p: Parameters, R_base_flange: Array) -> Array:
    """Give what errors of the sensor do to the reading of a load, for one sigma of each, beyond those of the tool.

    The response to the tool is that to any load at its centre of mass. A load at another has a torque beside, to which
    the sensor responds by errors of its own, as large as those that the tool shows.

    Parameters
    ----------
    tool : Parameters
        Of the calibration.
    known : Response
        To the tool, as of `known_response`.
    p : Parameters
        Of the load.
    R_base_flange : array, shape (n, 3, 3)

    Returns
    -------
    array, shape (n, 6, 38)
        Independent columns, the errors of `known` not among them.
    """
    square = known.coefficients**2 + np.diag(known.covariance)[15:]
    in_force, in_torque = (float(np.sqrt(np.mean(part))) for part in np.split(square / USUAL**2, [5]))
    u, lever = gravity_wrench(p, R_base_flange)[:, :3], skew(p.p_sensor_com_m - tool.p_sensor_com_m)
    entries = np.where(np.eye(3) > 0, GAIN, CROSS)
    columns = np.zeros((len(u), 6, 27))
    columns[:, :3, :9] = _products(np.eye(3), u @ lever.T, np.full((3, 3), in_force * CROSS / RANGE_LEVER_M))
    columns[:, 3:, 9:18] = _products(np.eye(3), u @ lever.T, in_torque * entries)
    columns[:, 3:, 18:] = _products(lever, u, in_force * entries)
    # A gain of one load is that of another but for what depends on the load.
    other = min(abs(p.weight_N / tool.weight_N - 1), 1.0) if tool.weight_N else 1.0
    loads = response_columns(p, R_base_flange) * np.minimum(np.sqrt(square), LOAD) * other
    return np.concatenate([columns, loads], axis=2)


def _products(A: Array, v: Array, sigma: Array) -> Array:
    """Derivative (n, 3, 9) of A E v by the entries of E, times their sigma (3, 3), for vectors v (n, 3)."""
    return np.asarray(np.einsum("ri,nj,ij->nrij", A, v, sigma).reshape(len(v), 3, 9))


def _smooth_errors(p: Parameters, R_base_flange: Array, others: Array) -> Array:
    """Give the covariances (2, 6n, 6m) that smooth errors of the arm, and of a cable, cause between orientations."""
    correlated = alike(R_base_flange, others)
    turn, turn_other = (jacobian(p, R)[..., :3] * TURN_RAD for R in (R_base_flange, others))
    of_arm = np.einsum("nm,nik,mjk->nimj", correlated, turn, turn_other)
    return np.array([of_arm.reshape(6 * len(R_base_flange), -1), np.kron(correlated, np.diag(CABLE**2))])
