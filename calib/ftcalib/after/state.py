"""Update or tare of a calibration after a change of bias, payload, mounting or base, from a few new poses.

Parameters that are not estimated keep their values and their uncertainty. Their errors are common to all readings, and
are part of the weights (generalised least squares) and of the covariance of the result.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal

import numpy as np
from scipy.linalg import block_diag
from scipy.special import chdtrc as chi2_sf
from scipy.special import chdtri as chi2_isf

from ftcalib.compensation import Compensator
from ftcalib.data.dataset import require_finite
from ftcalib.data.dwell_mean import is_stationary, mean_and_covariance
from ftcalib.errors import BadDataset, NotObservable
from ftcalib.findings import Finding
from ftcalib.model import BIASES, Array, Parameters, read_only, skew
from ftcalib.result import CalibrationResult
from ftcalib.sensor_matrix import Calibrated, Response

SIGNIFICANT_SIGMAS = 5.0
# Convergence: squared step in standard deviations.
SETTLED = 1e-20
MOST_STEPS = 30
# Smallest accepted ratio of the singular values of the scaled equations.
UNDETERMINED = 1e-6

Block = Literal["weight", "centre of mass", "bias", "gravity direction", "mounting"]
# Kinds of update, and the parameters that each estimates.
BLOCKS: Mapping[str, tuple[Block, ...]] = {
    "bias": ("bias",),
    "weight": ("weight",),
    "centre of mass": ("centre of mass",),
    "payload": ("weight", "centre of mass"),
    "mounting": ("mounting",),
    "base": ("gravity direction",),
    "bias and payload": ("weight", "centre of mass", "bias"),
    "all": ("weight", "centre of mass", "bias", "gravity direction", "mounting"),
}


@dataclass(frozen=True, slots=True, eq=False)
class Update(Calibrated):
    """Updated parameters with covariance; an update can be updated again."""

    parameters: Parameters
    covariance: Array
    """(15, 15) covariance of the error coordinates `PARAMETER_NAMES`, including kept parameters."""
    chi2: float
    """Chi2 of the new readings; about `dof` if they agree with noise and previous uncertainty."""
    dof: int
    """Degrees of freedom of `chi2`; 0 if no reading is left for a check."""
    kind: str = ""
    """Kind of update, a key of `BLOCKS`."""
    residuals: Array = field(default_factory=lambda: np.zeros((0, 6)))
    """(n, 6) residuals of the new readings, N and N·m, in the sensor frame."""
    response: Response | None = None
    """Gain and cross-talk of the sensor, which are kept, with their joint covariance after the update."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "covariance", read_only(self.covariance))
        object.__setattr__(self, "residuals", read_only(self.residuals))


def with_bias_change(calibration: Calibrated, change: Array, variance: Array, *, measured: bool = False) -> Update:
    """Return a calibration, or an update of it, with a changed bias.

    Parameters
    ----------
    change, variance : array, shape (6,)
        Change of the bias in N and N·m, sensor axes, and its variance.
    measured : bool
        Whether `variance` is the total variance of the new bias, instead of the variance of the change.
    """

    def changed(covariance: Array) -> Array:
        covariance = np.array(covariance)
        if measured:
            covariance[BIASES], covariance[:, BIASES] = 0.0, 0.0
        covariance[BIASES, BIASES] += variance
        return covariance

    p = calibration.parameters
    new = replace(p, force_bias_N=p.force_bias_N + change[:3], torque_bias_Nm=p.torque_bias_Nm + change[3:])
    response = calibration.with_joint(changed(calibration.joint_covariance))
    return Update(new, changed(calibration.covariance), 0.0, 0, "bias", response=response)


def reestimate(calibration: Calibrated, R_base_flange: Array, wrench: Array, noise: Array, kind: str) -> Update:
    """Return an update in which some parameters are re-estimated by generalised least squares, and the others kept.

    With the parameters x of `kind` (a key of `BLOCKS`) and the errors e of the old calibration, the readings are h(x) +
    K e + noise, where `noise` (6n, 6n) is the covariance of all mean readings, pose by pose. The weights are the
    inverse of noise + K C K'. The error of the new parameters is G (noise - K e) + kept e, with the estimator matrix G.

    Raises `BadDataset` for wrong shapes, `NotObservable` for undetermined parameters or an insignificant weight.
    """
    n, old, response = len(wrench), calibration.parameters, calibration.response
    R_base_flange = require_finite("R_base_flange", R_base_flange, (n, 3, 3))
    wrench = require_finite("wrench", wrench, (n, 6))
    C = calibration.joint_covariance
    if not old.gravity_force_base_N.any() and kind != "bias":
        raise NotObservable("the tool has no weight, so the direction of gravity is unknown: calibrate again.")
    new = old
    for _ in range(MOST_STEPS):
        estimated, kept = _directions(new, BLOCKS[kind]), _kept_derivative(old, new, BLOCKS[kind], len(C))
        J = calibration.jacobian(R_base_flange, new)
        K = J.reshape(6 * n, -1) @ kept
        H = J[..., :15].reshape(6 * n, 15) @ estimated
        S = noise + K @ C @ K.T
        weighted = np.linalg.solve(S, H).T
        information = weighted @ H
        inverse = _invert_information(information, kind, n)
        G = inverse @ weighted
        left = np.asarray(Compensator(new, response=response).batch(wrench, R_base_flange), dtype=np.float64).ravel()
        x = G @ left
        if "weight" in BLOCKS[kind]:
            weight_N, sigma_N = float(new.weight_N + x[0]), float(np.sqrt(inverse[0, 0]))
            if not weight_N > SIGNIFICANT_SIGMAS * sigma_N:
                raise NotObservable(
                    f"the weight of the payload, {weight_N:.3g} N, is less than {SIGNIFICANT_SIGMAS:g} times its "
                    f"uncertainty of {sigma_N:.2g} N: hang something heavier on the sensor, or check the sign and the "
                    "tare."
                )
        chi2 = float(left @ np.linalg.solve(S, left))
        if float(x @ information @ x) < SETTLED * max(1.0, chi2):
            break
        new = _move(new, estimated, x, BLOCKS[kind])
    else:
        raise NotObservable(f"the update of {kind} has not converged in {MOST_STEPS} steps: calibrate again.")
    estimated_15 = np.zeros((len(C), len(x)))
    estimated_15[:15] = estimated
    gain = estimated_15 @ G
    mixed = kept - gain @ K
    # The errors of kept parameters affect the new parameters, so the two are correlated.
    covariance = gain @ noise @ gain.T + mixed @ C @ mixed.T
    covariance = (covariance + covariance.T) / 2
    joint, dof = calibration.with_joint(covariance), 6 * n - len(x)
    return Update(new, covariance[:15, :15], chi2, dof, kind, left.reshape(n, 6), joint)


def apply_update(
    calibration: CalibrationResult, update: Update, provenance: Mapping[str, Any] | None = None
) -> CalibrationResult:
    """Return a new calibration from an update.

    `residuals`, `chi2`, `dof` and `p_value` are those of the new readings. Components of the noise and the verdict are
    taken from the old calibration, because the new readings are too few for them. The matrix of the sensor is kept, and
    the weighed mass too, unless the weight was re-estimated.

    Parameters
    ----------
    calibration : CalibrationResult
        Calibration from which the update was made.
    provenance : mapping, optional
        Origin of the new readings. The id of the old calibration becomes its `parent`, and the kind of update `update`.

    Raises
    ------
    NotObservable
        No reading is left for a check.
    """
    if update.dof == 0:
        raise NotObservable("one pose is not enough to check the new bias: use 2 poses or more.")
    provenance = dict(provenance or {})
    note = Finding.of("updated", kind=update.kind, n_poses=len(update.residuals), parent=calibration.id)
    return CalibrationResult(
        parameters=update.parameters,
        covariance=update.covariance,
        hidden_covariance=calibration.hidden_covariance,
        residuals=update.residuals,
        chi2=update.chi2,
        dof=update.dof,
        noise_source="measured",
        g_m_s2=calibration.g_m_s2,
        method=calibration.method,
        findings=(*calibration.findings, note),
        provenance={
            **provenance,
            "parent": {**provenance.get("parent", {}), "id": calibration.id},
            "update": update.kind,
        },
        p_value=float(chi2_sf(update.dof, update.chi2)),
        components=calibration.components,
        response=None if calibration.response is None else update.response,
        gain_sigma=calibration.gain_sigma,
        cable_shift=calibration.cable_shift,
        second_basin_chi2=calibration.second_basin_chi2,
        sensor=calibration.sensor,
        weighed_kg=None if "weight" in BLOCKS.get(update.kind, ("weight",)) else calibration.weighed_kg,
    )


def _directions(p: Parameters, blocks: Sequence[Block]) -> Array:
    """Return a basis (15, k) of the estimated error coordinates.

    With a new weight, the product of weight and centre of mass is estimated, in which the readings are linear.
    """
    weight_N = p.weight_N
    columns = []
    if "weight" in blocks:
        weight = np.zeros((15, 1))
        weight[3:6, 0] = p.down
        if "centre of mass" in blocks:
            weight[9:12, 0] = -p.p_sensor_com_m / weight_N
        columns.append(weight)
    if "centre of mass" in blocks:
        columns.append(np.eye(15)[:, 9:12] / weight_N)
    if "bias" in blocks:
        columns.append(np.eye(15)[:, BIASES])
    if "gravity direction" in blocks:
        direction = np.zeros((15, 2))
        direction[3:6] = weight_N * np.linalg.svd(skew(p.gravity_force_base_N))[0][:, :2]
        columns.append(direction)
    if "mounting" in blocks:
        columns.append(np.eye(15)[:, :3])
    return np.concatenate(columns, axis=1)


def _kept_derivative(old: Parameters, new: Parameters, blocks: Sequence[Block], size: int) -> Array:
    """Return the derivative (size, size) of the new errors with respect to the errors of kept parameters."""
    kept = np.eye(size)
    if "mounting" in blocks:
        kept[:3, :3] = 0.0
    if "bias" in blocks:
        kept[BIASES, BIASES] = 0.0
    if "centre of mass" in blocks:
        kept[9:12, 9:12] = 0.0
    before, after = old.gravity_force_base_N, new.gravity_force_base_N
    if "weight" in blocks:
        across = np.eye(3) - np.outer(after, after) / (after @ after)
        kept[3:6, 3:6] = np.linalg.norm(after) / np.linalg.norm(before) * across
    if "gravity direction" in blocks:
        kept[3:6, 3:6] = 0.0 if "weight" in blocks else np.outer(after, before) / (before @ before)
    return kept


def _move(p: Parameters, estimated: Array, x: Array, blocks: Sequence[Block]) -> Parameters:
    step = estimated @ x
    weight_N = p.weight_N
    if "weight" in blocks:
        step[9:12] *= weight_N / (weight_N + x[0])
    elif "gravity direction" in blocks:  # keep the norm of the gravity force
        moved = p.gravity_force_base_N + step[3:6]
        step[3:6] = moved * weight_N / np.linalg.norm(moved) - p.gravity_force_base_N
    return p.moved(step)


def _invert_information(information: Array, kind: str, n: int) -> Array:
    """Return the inverse of an information matrix; raise `NotObservable` if a parameter is not determined."""
    scale = np.sqrt(np.diag(information))
    units = np.outer(scale, scale)
    try:
        value = np.linalg.eigvalsh(information / units) if (scale > 0).all() else np.zeros(1)
        if value[0] > UNDETERMINED**2 * value[-1] and len(scale) <= 6 * n:
            return np.asarray(np.linalg.inv(information / units) / units)
    except np.linalg.LinAlgError:  # singular, although rounding made the eigenvalues look acceptable
        pass
    raise NotObservable(
        f"{n} {'pose does' if n == 1 else 'poses do'} not determine {kind}: add poses with other tilts of the tool."
    )


# Tare: a new estimate of the biases from a few seconds of readings of the free tool.

# Share of good tares that are rejected.
FALSE_ALARMS = 1e-3
# Usual drift of the bias of a wrist sensor over hours, due to temperature, mounting, wear; one standard deviation.
USUAL_DRIFT_N, USUAL_DRIFT_NM = 1.0, 0.03


def compare_with_prediction(
    calibration: Calibrated, R_base_flange: Array, wrench: Array, wrench_cov: Array, drift_N: float, drift_Nm: float
) -> tuple[Array, Array]:
    """Return residuals (n, 6) of mean readings of a free tool, and their Mahalanobis distances (n,).

    `wrench` (n, 6) are mean readings as measured with covariances `wrench_cov` (n, 6, 6). `drift_N` and `drift_Nm` are
    standard deviations per axis of the drift of the biases. The distances account for noise, drift and calibration.
    """
    p, response = calibration.parameters, calibration.response
    change = np.asarray(Compensator(p, response=response).batch(wrench, R_base_flange), dtype=np.float64)
    drift = np.diag(np.repeat([drift_N**2, drift_Nm**2], 3))
    S = wrench_cov + drift + calibration.wrench_covariance(R_base_flange)
    return change, np.sqrt(np.einsum("ni,ni->n", change, np.linalg.solve(S, change[..., None])[..., 0]))


def tare(
    calibration: Calibrated,
    R_base_flange: Array,
    dwells: Sequence[Array],
    *,
    drift_N: float = USUAL_DRIFT_N,
    drift_Nm: float = USUAL_DRIFT_NM,
) -> Update:
    """Return an update of the biases from readings of the free tool; raise for readings under load.

    The test is the squared Mahalanobis distance d² of each reading from its prediction. The covariance contains the
    noise of the reading, the uncertainty of the calibration, and a drift of the bias of `drift_N`, `drift_Nm` (standard
    deviation per axis). The limit is the 99.9 % quantile of chi-square with 6 degrees of freedom, 22.5. With two or
    more poses, the readings must also agree on one bias, at the same significance.

    Parameters
    ----------
    R_base_flange : array, shape (n, 3, 3)
        One pose is enough.
    dwells : sequence of n arrays, shape (N, 6)
        Consecutive samples in each pose, N >= 20, as measured, N and N·m, in the sensor frame.
    drift_N, drift_Nm : float
        Expected drift of the biases since the calibration. A push of up to about four times this size is not detected.

    Raises
    ------
    BadDataset
        The reading changes during a dwell, is too far from the prediction, or differs between poses: the tool is in
        contact, or the payload has changed.
    """
    if len(dwells) == 0:
        raise BadDataset("no dwell was given: record at least one pose.")
    # The covariance of a mean is valid only for a stationary reading.
    for i, dwell in enumerate(dwells):
        if not is_stationary(dwell):
            raise BadDataset(f"pose {i + 1}: the reading changes during the dwell: keep arm and tool still.")
    means = [mean_and_covariance(dwell) for dwell in dwells]
    wrench, wrench_cov = np.array([m.mean for m in means]), np.array([m.covariance for m in means])
    R_base_flange = require_finite("R_base_flange", R_base_flange, (len(means), 3, 3))
    change, sigmas = compare_with_prediction(calibration, R_base_flange, wrench, wrench_cov, drift_N, drift_Nm)
    limit = float(chi2_isf(6, FALSE_ALARMS))
    for i in np.flatnonzero(sigmas**2 > limit).tolist():
        raise BadDataset(
            f"pose {i + 1}: the reading differs from the prediction by {np.linalg.norm(change[i, :3]):.2g} N and "
            f"{np.linalg.norm(change[i, 3:]):.2g} N·m, more than drift explains (test value {sigmas[i] ** 2:.0f}, "
            f"limit {limit:.1f}): free the tool, or calibrate again if the payload has changed."
        )
    # Gain and cross-talk are kept, with their uncertainty, for parts that are weighed after the tare.
    known = Calibrated(calibration.parameters, calibration.covariance, calibration.shown_response)
    update = reestimate(known, R_base_flange, wrench, block_diag(*wrench_cov), "bias")
    if update.dof and update.chi2 > chi2_isf(update.dof, FALSE_ALARMS):
        raise BadDataset(
            f"the {len(means)} poses do not agree on one bias (chi2 {update.chi2:.0f} for {update.dof} degrees of "
            "freedom): free the tool, or calibrate again if the payload has changed."
        )
    return update
