"""Test for contact of the tool, with the uncertainty of the calibration taken into account."""

import numpy as np
from scipy.special import chdtri as chi2_isf

from calib.model import Array, Parameters, jacobian, predict


def contact_chi2(
    wrench: Array,
    R_base_flange: Array,
    parameters: Parameters,
    covariance: Array,
    noise_cov: Array,
    *,
    tare: tuple[Array, Array] | None = None,
) -> Array:
    """Squared distance of a wrench from the prediction for a free tool, in standard deviations: chi-square, 6 dof.

    It includes the uncertainty of the calibration. With the noise alone, 16 % of the readings of a free tool calibrated
    with six poses would exceed the limit for 1 %.

    Parameters
    ----------
    wrench : array, shape (..., 6)
        As measured, N and N·m, in the sensor frame.
    R_base_flange : array, shape (..., 3, 3)
    parameters : Parameters
    covariance : array, shape (15, 15)
        Of the error coordinates.
    noise_cov : array, shape (6, 6) or (..., 6, 6)
        Of one reading of `wrench`.
    tare : tuple of array (..., 6) and array (..., 3, 3), optional
        Wrench, with the same noise, and R_base_flange of a pose without contact. Errors common to both poses cancel,
        such as drift of the bias.

    Returns
    -------
    array, shape (...)
        Compare with `contact_threshold`.
    """
    J, contact = jacobian(parameters, R_base_flange), wrench - predict(parameters, R_base_flange)
    if tare is not None:
        wrench_0, R_0 = tare
        contact = contact - (wrench_0 - predict(parameters, R_0))
        J, noise_cov = J - jacobian(parameters, R_0), 2 * noise_cov
    total = noise_cov + J @ covariance @ np.swapaxes(J, -1, -2)
    return np.asarray(np.einsum("...i,...i->...", contact, np.linalg.solve(total, contact[..., None])[..., 0]))


def contact_threshold(false_alarm_rate: float = 0.01) -> float:
    """Limit for `contact_chi2` that a free tool exceeds at this rate."""
    return float(chi2_isf(6, false_alarm_rate))
