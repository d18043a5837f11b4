"""Is something touching the tool? A test that knows how well the calibration knows the free tool."""

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
    """Squared distance of a wrench from what the free tool should give, in standard deviations: chi-square, 6 dof.

    The uncertainty of the calibration counts besides the noise. Judged by the noise alone, 16 % of readings of a free
    tool calibrated with six poses break a limit meant for 1 %.

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
        Wrench, with the same noise, and R_base_flange of a pose in which nothing touched the tool. Errors common to
        both poses, such as a drifted bias, cancel.

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
    """Limit for `contact_chi2` that a free tool breaks at this rate."""
    return float(chi2_isf(6, false_alarm_rate))
