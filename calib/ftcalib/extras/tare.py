"""Tare: the biases again, from a few seconds of a free tool."""

from collections.abc import Sequence

import numpy as np
from scipy.linalg import block_diag
from scipy.special import chdtri as chi2_isf

from ftcalib.compensation import Compensator
from ftcalib.data.dataset import finite
from ftcalib.data.dwell_mean import is_stationary, mean_and_covariance
from ftcalib.errors import BadDataset
from ftcalib.extras.update import Calibrated, Update, reestimate
from ftcalib.likelihood.gain_and_cross_talk import predicted_covariance
from ftcalib.model import Array

FALSE_ALARMS = 1e-3  # share of good tares that are rejected
USUAL_DRIFT_N, USUAL_DRIFT_NM = 1.0, 0.03  # a wrist sensor over hours: temperature, mounting, wear


def bias_change(
    calibration: Calibrated, R_base_flange: Array, wrench: Array, wrench_cov: Array, drift_N: float, drift_Nm: float
) -> tuple[Array, Array]:
    """Compare readings of a free tool with the prediction.

    Parameters
    ----------
    calibration : CalibrationResult or Update
    R_base_flange : array, shape (n, 3, 3)
    wrench : array, shape (n, 6)
        Means, N and N·m, in the sensor frame.
    wrench_cov : array, shape (n, 6, 6)
        Of those means.
    drift_N, drift_Nm : float
        Expected drift of the biases, one standard deviation an axis.

    Returns
    -------
    change : array, shape (n, 6)
        Measured minus predicted.
    sigmas : array, shape (n,)
        Mahalanobis distance, with noise, drift and the uncertainty of the calibration.
    """
    p, response = calibration.parameters, calibration.response
    change = np.asarray(Compensator(p, response=response).batch(wrench, R_base_flange), dtype=np.float64)
    drift = np.diag(np.repeat([drift_N**2, drift_Nm**2], 3))
    S = wrench_cov + drift + predicted_covariance(p, calibration.covariance, response, R_base_flange)
    return change, np.sqrt(np.einsum("ni,ni->n", change, np.linalg.solve(S, change[..., None])[..., 0]))


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
    R_base_flange = finite("R_base_flange", R_base_flange, (len(means), 3, 3))
    change, sigmas = bias_change(calibration, R_base_flange, wrench, wrench_cov, drift_N, drift_Nm)
    limit = float(chi2_isf(6, FALSE_ALARMS))
    for i in np.flatnonzero(sigmas**2 > limit).tolist():
        raise BadDataset(
            f"pose {i + 1}: the reading is {np.linalg.norm(change[i, :3]):.2g} N and "
            f"{np.linalg.norm(change[i, 3:]):.2g} N·m from the prediction, more than drift explains "
            f"(d² {sigmas[i] ** 2:.0f}, limit {limit:.1f}): free the tool, or calibrate again if the payload has "
            "changed."
        )
    update = reestimate(calibration, R_base_flange, wrench, block_diag(*wrench_cov), "bias")
    if update.dof and update.chi2 > chi2_isf(update.dof, FALSE_ALARMS):
        raise BadDataset(
            f"the {len(means)} poses do not agree on one bias (chi2 {update.chi2:.0f} for {update.dof} degrees of "
            "freedom): free the tool, or calibrate again if the payload has changed."
        )
    return update
