"""What an unchanged cell may do to readings beyond what its fit shows: errors of the sensor, the arm and a cable.

The errors of a sensor are those of its 6 x 6 matrix, of which one tool shows gain and cross-talk at its centre of mass
alone. Their size is what the fit found, else what its poses and its residuals leave of the prior. Those of arm and
cable are smooth over the orientations: two poses near each other have nearly the same.
"""

import numpy as np

from ftcalib.after.series import Estimated
from ftcalib.known import CROSS_TALK_SHARE, USUAL_GAIN
from ftcalib.likelihood.response import LEVER_M, USUAL, Response, response_columns
from ftcalib.likelihood.structure import alike
from ftcalib.model import Array, Parameters, gravity_wrench, jacobian, skew
from ftcalib.result import CalibrationResult

# A mounted or aged sensor before its fit, one sigma: its diagonal, and the rest of its range (levers of 50 mm).
GAIN, CROSS = USUAL_GAIN, CROSS_TALK_SHARE * USUAL_GAIN
# What of the gain depends on the load.
LOAD = 0.005
# Smooth errors, one sigma an axis: of the orientations of a calibrated arm, and of the pull of a cable.
TURN_RAD, CABLE = float(np.deg2rad(0.1)), np.repeat([0.05, 0.012], 3)


def known_response(calibration: Estimated, found: Response | None) -> Response | None:
    """Return gain and cross-talk as found, or zero with the covariance that the fit leaves of the prior.

    None for an update of a calibration that has none.
    """
    return calibration.shown_response if found is None and isinstance(calibration, CalibrationResult) else found


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
    columns[:, :3, :9] = _products(np.eye(3), u @ lever.T, np.full((3, 3), in_force * CROSS / LEVER_M))
    columns[:, 3:, 9:18] = _products(np.eye(3), u @ lever.T, in_torque * entries)
    columns[:, 3:, 18:] = _products(lever, u, in_force * entries)
    # A gain of one load is that of another but for what depends on the load.
    other = min(abs(p.weight_N / tool.weight_N - 1), 1.0) if tool.weight_N else 1.0
    loads = response_columns(p, R_base_flange) * np.minimum(np.sqrt(square), LOAD) * other
    return np.concatenate([columns, loads], axis=2)


def _products(A: Array, v: Array, sigma: Array) -> Array:
    """Derivative (n, 3, 9) of A E v by the entries of E, times their sigma (3, 3), for vectors v (n, 3)."""
    return np.asarray(np.einsum("ri,nj,ij->nrij", A, v, sigma).reshape(len(v), 3, 9))


def smooth_errors(p: Parameters, R_base_flange: Array, others: Array) -> Array:
    """Give the covariances (2, 6n, 6m) that smooth errors of the arm, and of a cable, cause between orientations."""
    correlated = alike(R_base_flange, others)
    turn, turn_other = (jacobian(p, R)[..., :3] * TURN_RAD for R in (R_base_flange, others))
    of_arm = np.einsum("nm,nik,mjk->nimj", correlated, turn, turn_other)
    return np.array([of_arm.reshape(6 * len(R_base_flange), -1), np.kron(correlated, np.diag(CABLE**2))])
