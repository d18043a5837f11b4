"""Tare: the bias from half a second of a free tool, whose weight is known."""

from collections.abc import Mapping

import numpy as np

from ftcalib.after.state import Calibrated, Update, compare_with_prediction, tare
from ftcalib.data.dwell_mean import LEAST_SAMPLES, is_stationary, mean_and_covariance
from ftcalib.errors import BadDataset
from ftcalib.files import JSON
from ftdrive.live.samples import Paired

TARE_S = 0.5
TARE_DRIFT_N, TARE_DRIFT_NM = 0.5, 0.015
"""A tare accepts this much drift of the bias since the calibration or the tare before, one standard deviation."""

_STILL_RAD, _STILL_M = 5e-4, 5e-4
"""Largest motion of the flange during a tare."""


def try_tare(rows: Paired, current: Calibrated) -> tuple[Update | None, str, Mapping[str, JSON]]:
    """Estimate the bias again, or refuse.

    It is refused when arm or reading are not still, and when the reading differs from the prediction of a free tool by
    more than noise, calibration and a usual drift explain once in a thousand tares.

    Parameters
    ----------
    rows : Paired
        The last `TARE_S` seconds.
    current : CalibrationResult or Update
        The calibration after earlier tares.

    Returns
    -------
    update : Update or None
        None if refused.
    text : str
        What was found, or why it was refused and what to do.
    values : mapping
        `change` of the bias (6,), its `force_N` and `torque_Nm`, and the distance from the free tool in `sigmas`.
    """
    again = "tare again when arm and tool have rested for half a second"
    if len(rows) < LEAST_SAMPLES or rows.t_host_ns[-1] - rows.t_host_ns[0] < 0.5e9 * TARE_S:
        return None, f"tare refused: only {len(rows)} samples; {again}", {}
    R = rows.R_base_flange[-1:]
    if not is_still(rows):
        return None, f"tare refused: the arm moves; {again}", {}
    dwell = mean_and_covariance(rows.raw)
    (change,), (sigmas,) = compare_with_prediction(
        current, R, dwell.mean[None], dwell.covariance[None], TARE_DRIFT_N, TARE_DRIFT_NM
    )
    force_N, torque_Nm = float(np.linalg.norm(change[:3])), float(np.linalg.norm(change[3:]))
    values: dict[str, JSON] = {
        "change": change.tolist(),
        "force_N": force_N,
        "torque_Nm": torque_Nm,
        "sigmas": float(sigmas),
    }
    found = f"{force_N:.2f} N and {torque_Nm:.3f} N·m ({sigmas:.1f} sigma)"
    if not is_stationary(rows.raw):
        return None, f"tare refused: the reading changes; {again}", values
    try:
        update = tare(current, R, [rows.raw], drift_N=TARE_DRIFT_N, drift_Nm=TARE_DRIFT_NM)
    except BadDataset:
        why = f"{found} from the free tool, more than drift explains"
        return None, f"tare refused: {why}; take hand or contact away, or calibrate again", values
    return update, f"tare: the bias has changed by {found}", values


def is_still(rows: Paired) -> bool:
    """Check whether the arm rests; an unknown position counts as still."""
    R, p = rows.R_base_flange[-1:], rows.p_base_flange_m[-1]
    return not (
        np.abs(rows.R_base_flange - R).max() > _STILL_RAD or (np.abs(rows.p_base_flange_m - p) > _STILL_M).any()
    )
