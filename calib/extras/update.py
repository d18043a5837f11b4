"""Update a calibration after a change of payload or bias.

Parameters that are not estimated keep their values and their uncertainty. The uncertainty counts as an error common to
all readings, both in the weights (generalised least squares) and in the covariance of the result.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from scipy.linalg import block_diag
from scipy.special import chdtri as chi2_isf

from calib.data.dataset import finite
from calib.data.dwell_mean import is_stationary, mean_and_covariance
from calib.errors import BadDataset, NotObservable
from calib.model import Array, Parameters, jacobian, predict, read_only, skew

LEAST_SPREAD = 0.025  # of the gravity directions in the sensor frame, rms; two poses 3° apart have it
SIGNIFICANT_SIGMAS = 5.0
FALSE_ALARMS = 1e-3  # share of good tares that are rejected
USUAL_DRIFT_N, USUAL_DRIFT_NM = 1.0, 0.03  # a wrist sensor over hours: temperature, mounting, wear

BIASES = np.r_[6:9, 12:15]  # where force and torque bias stand in `PARAMETER_NAMES`


class Calibrated(Protocol):
    """A calibration, or an earlier update of it."""

    @property
    def parameters(self) -> Parameters:
        """Estimates."""

    @property
    def covariance(self) -> Array:
        """(15, 15) of the error coordinates `calib.model.PARAMETER_NAMES`."""


@dataclass(frozen=True, slots=True, eq=False)
class Update:
    """Parameters after an update, which can be updated again."""

    parameters: Parameters
    covariance: Array
    """(15, 15) of the error coordinates `PARAMETER_NAMES`, kept parameters included."""
    chi2: float
    """Misfit of the new readings; about `dof` if only noise and the old uncertainty act."""
    dof: int
    """0 if no reading is left for a check."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "covariance", read_only(self.covariance))


def update_payload(
    calibration: Calibrated, R_base_flange: Array, wrench: Array, wrench_cov: Array, *, retare: bool = False
) -> Update:
    """Estimate weight and centre of mass of another payload; keep mounting, tilt and (unless `retare`) biases.

    With u_i the unit vector of gravity in the sensor frame, the readings are linear in the weight w and in w P:
    F_i = w u_i + F0, T_i = (w P) x u_i + T0.

    Parameters
    ----------
    calibration : CalibrationResult or Update
    R_base_flange : array, shape (n, 3, 3)
        n >= 2 poses between which the tool is tilted; with `retare` n >= 3.
    wrench : array, shape (n, 6)
        Mean readings as measured, N and N·m, in the sensor frame.
    wrench_cov : array, shape (n, 6, 6)
        Covariance of those means.
    retare : bool
        Estimate the biases too, if the sensor has drifted since the calibration.

    Raises
    ------
    BadDataset
        Shapes that do not fit each other.
    NotObservable
        Too few poses, gravity along one line in all of them, or a weight that is not significant.
    """
    old, n = calibration.parameters, len(wrench)
    R_base_flange, wrench = finite("R_base_flange", R_base_flange, (n, 3, 3)), finite("wrench", wrench, (n, 6))
    wrench_cov = finite("wrench_cov", wrench_cov, (n, 6, 6))
    old_weight_N = float(np.linalg.norm(old.gravity_force_base_N))
    if old_weight_N == 0:
        raise NotObservable("the calibration has no weight, so the direction of gravity is unknown: calibrate first.")
    direction = old.gravity_force_base_N / old_weight_N
    u = direction @ (R_base_flange @ old.R_flange_sensor)
    _require_tilt(u, retare)

    size = 10 if retare else 4
    derivative = np.zeros((n, 6, 10))  # by weight, weight times centre of mass, biases
    derivative[:, :3, 0] = u
    derivative[:, 3:, 1:4] = -skew(u)
    derivative[:, :, 4:] = np.eye(6)
    H = derivative[:, :, :size].reshape(6 * n, size)
    bias = np.concatenate([old.force_bias_N, old.torque_bias_Nm])
    y = (wrench if retare else wrench - bias).ravel()

    kept = np.zeros((15, 15))  # derivative of the new errors by the old ones
    kept[:3, :3] = np.eye(3)
    if not retare:
        kept[BIASES, BIASES] = 1.0
    noise = block_diag(*wrench_cov)
    S = noise
    for _ in range(3):  # the weights depend on the payload, weakly
        G = _gain(H, S)
        x = G @ y
        weight_N, sigma_N = float(x[0]), float(np.sqrt((G @ S @ G.T)[0, 0]))
        if not weight_N > SIGNIFICANT_SIGMAS * sigma_N:
            raise NotObservable(
                f"the weight of the payload, {weight_N:.3g} N, is not {SIGNIFICANT_SIGMAS:g} times its uncertainty of "
                f"{sigma_N:.2g} N: hang something heavier on the sensor, or check the sign and the tare."
            )
        new_bias = x[4:] if retare else bias
        new = Parameters(old.R_flange_sensor, weight_N * direction, new_bias[:3], x[1:4] / weight_N, new_bias[3:])
        kept[3:6, 3:6] = weight_N / old_weight_N * (np.eye(3) - np.outer(direction, direction))
        K = jacobian(new, R_base_flange).reshape(6 * n, 15) @ kept
        S = noise + K @ calibration.covariance @ K.T

    estimated = np.zeros((15, size))  # derivative of the new errors by those of the estimates
    estimated[3:6, 0] = direction
    estimated[9:12, 0] = -new.p_sensor_com_m / weight_N
    estimated[9:12, 1:4] = np.eye(3) / weight_N
    if retare:
        estimated[BIASES, np.arange(4, 10)] = 1.0
    return _update(new, calibration.covariance, estimated @ _gain(H, S), kept, K, noise, y - H @ x, 6 * n - size)


def tare(
    calibration: Calibrated,
    R_base_flange: Array,
    dwells: Sequence[Array],
    *,
    drift_N: float = USUAL_DRIFT_N,
    drift_Nm: float = USUAL_DRIFT_NM,
) -> Update:
    """Estimate the biases again, with the weight of the tool subtracted; reject readings under load.

    The test is the Mahalanobis distance d² of each reading from its prediction. Its covariance holds the noise of the
    reading, the uncertainty of the calibration, and a bias drift of `drift_N`, `drift_Nm` (one standard deviation an
    axis). The limit is the 99.9 % quantile of chi-square with 6 degrees of freedom, 22.5. From two poses on, the
    readings must also agree on one bias, with the same probability.

    Parameters
    ----------
    calibration : CalibrationResult or Update
    R_base_flange : array, shape (n, 3, 3)
        One pose is enough.
    dwells : sequence of n arrays, shape (N, 6)
        Consecutive samples in each pose, N >= 20, as measured, N and N·m, in the sensor frame.
    drift_N, drift_Nm : float
        Expected drift of the biases since the calibration. A push of up to about four times this passes for drift,
        because one pose does not distinguish them.

    Raises
    ------
    BadDataset
        The reading changes during a dwell, is too far from the prediction, or differs between poses: the tool is in
        contact, or the payload has changed.
    """
    if len(dwells) == 0:
        raise BadDataset("there is no dwell: record at least one pose.")
    for i, dwell in enumerate(dwells):
        if not is_stationary(dwell):
            raise BadDataset(f"pose {i + 1}: the reading changes during the dwell: keep arm and tool still.")
    means = [mean_and_covariance(dwell) for dwell in dwells]
    wrench, wrench_cov = np.array([m.mean for m in means]), np.array([m.covariance for m in means])
    old, n = calibration.parameters, len(means)
    R_base_flange = finite("R_base_flange", R_base_flange, (n, 3, 3))
    residual = wrench - predict(old, R_base_flange)
    J = jacobian(old, R_base_flange)
    drift = np.diag(np.repeat([drift_N**2, drift_Nm**2], 3))
    limit = float(chi2_isf(6, FALSE_ALARMS))
    for i in range(n):
        innovation = wrench_cov[i] + J[i] @ calibration.covariance @ J[i].T + drift
        distance = float(residual[i] @ np.linalg.solve(innovation, residual[i]))
        if distance > limit:
            raise BadDataset(
                f"pose {i + 1}: the reading is {np.linalg.norm(residual[i, :3]):.2g} N and "
                f"{np.linalg.norm(residual[i, 3:]):.2g} N·m from the prediction, more than drift explains "
                f"(d² {distance:.0f}, limit {limit:.1f}): free the tool, or calibrate again if the payload has changed."
            )

    kept = np.eye(15)
    kept[BIASES, BIASES] = 0.0
    K = J.reshape(6 * n, 15) @ kept
    H = np.tile(np.eye(6), (n, 1))
    noise = block_diag(*wrench_cov)
    S = noise + K @ calibration.covariance @ K.T
    G = _gain(H, S)
    change = G @ residual.ravel()
    new = Parameters(
        old.R_flange_sensor,
        old.gravity_force_base_N,
        old.force_bias_N + change[:3],
        old.p_sensor_com_m,
        old.torque_bias_Nm + change[3:],
    )
    estimated = np.zeros((15, 6))
    estimated[BIASES, np.arange(6)] = 1.0
    left = (residual - change).ravel()
    update = _update(new, calibration.covariance, estimated @ G, kept, K, noise, left, 6 * n - 6)
    if update.dof and update.chi2 > chi2_isf(update.dof, FALSE_ALARMS):
        raise BadDataset(
            f"the {n} poses do not agree on one bias (chi2 {update.chi2:.0f} for {update.dof} degrees of freedom): "
            "free the tool, or calibrate again if the payload has changed."
        )
    return update


def _gain(H: Array, S: Array) -> Array:
    """Generalised least squares: the matrix that maps readings of covariance S to the estimates."""
    weighted = np.linalg.solve(S, H).T
    return np.asarray(np.linalg.solve(weighted @ H, weighted))


def _update(
    new: Parameters, old_cov: Array, G: Array, kept: Array, K: Array, noise: Array, left: Array, dof: int
) -> Update:
    """Propagate: error of the new parameters = G (noise - K old error) + kept old error."""
    S, mixed = noise + K @ old_cov @ K.T, kept - G @ K
    covariance = G @ noise @ G.T + mixed @ old_cov @ mixed.T
    return Update(new, (covariance + covariance.T) / 2, float(left @ np.linalg.solve(S, left)), dof)


def _require_tilt(u: Array, retare: bool) -> None:
    """Raise `NotObservable` if the gravity directions u (n, 3), in the sensor frame, leave a parameter free."""
    n, least = len(u), 3 if retare else 2
    if n < least:
        raise NotObservable(
            f"{n} {'pose is' if n == 1 else 'poses are'} too few, at least {least} are needed: add {least - n} or more "
            "with other tilts of the tool."
        )
    spread = np.linalg.svd(u - u.mean(axis=0) if retare else u, compute_uv=False)[1] / np.sqrt(n)
    if spread < LEAST_SPREAD:
        found = "fewer than three clearly different directions" if retare else "nearly one line"
        raise NotObservable(
            f"gravity has {found} in the sensor in these {n} poses (spread {spread:.3f}, at least {LEAST_SPREAD:g} "
            f"needed): tilt the tool {'to two sides ' if retare else ''}by 30° or more."
        )
