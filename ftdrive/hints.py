"""What probably happened at poses that fit badly, in words that name them."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from calib import CalibrationResult
from calib.model import jacobian
from calib.routine import PoseRecord, is_return, turned_rad

Array = NDArray[np.float64]

SURE = 1e-3
"""Probability of a false remark."""
FEWEST_ON_A_SIDE = 3
"""Poses before and after something that changed for good."""
CLEARLY = 10.0
"""How much likelier, in units of twice the logarithm, a change must be than all that explains the poses otherwise."""

_STILL_RAD = np.radians(0.05)
_SIGNIFICANT = 4.0

# What can change for good between two poses, by the error coordinates of `calib.model.PARAMETER_NAMES`.
_CHANGES: tuple[tuple[str, tuple[int, ...]], ...] = (
    ("centre of mass", (9, 10, 11)),
    ("force bias", (6, 7, 8)),
    ("torque bias", (12, 13, 14)),
    ("mounting", (0, 1, 2)),
)


@dataclass(frozen=True, slots=True, eq=False)
class _Change:
    what: str
    row: int
    step: Array
    evidence: float


def names_of(records: Sequence[PoseRecord]) -> tuple[str, ...]:
    """Name the rows of a run's dataset: R and the number of the orientation."""
    return tuple(f"R{record.pose.number:02d}" for record in _in_dataset(records))


def hints(result: CalibrationResult, records: Sequence[PoseRecord]) -> tuple[str, ...]:
    """Explain what stands out, most important first; nothing for a quiet run.

    Parameters
    ----------
    result : CalibrationResult
        Of the dataset of these records.
    records : sequence of PoseRecord
        In the order of the tour.
    """
    records = _in_dataset(records)
    if len(records) != result.n_poses:
        raise ValueError(f"{len(records)} records do not belong to a result of {result.n_poses} poses")
    names = names_of(records)
    out = _out_of_line(result)
    change = _lasting_change(result, records)
    if change is not None:
        return (_change_in_words(change, names), *_moved(records, names, range(len(records))))
    words = [*_moved(records, names, range(len(records)))]
    odd = [row for row in out if _steady(records[row])]
    pulled = [row for row in odd if _pulled(result, row)]
    for row in odd:
        force_N, torque_Nm = np.linalg.norm(result.residuals[row, :3]), np.linalg.norm(result.residuals[row, 3:])
        off = f"{names[row]} is off by {force_N:.2g} N and {torque_Nm:.2g} N·m"
        if row not in pulled:
            words.append(f"{off}, torque without force: did the load tilt or swing?")
        elif len(pulled) == 1:
            words.append(f"{off}: touched, bumped or pulled by a cable? Repeat it")
        else:
            words.append(off)
    if len(pulled) > 1:
        together = ", ".join(names[row] for row in pulled)
        words.append(f"something pulls in {together}: a cable that is too short there? Give it slack, repeat these")
    return tuple(words)


def _in_dataset(records: Sequence[PoseRecord]) -> list[PoseRecord]:
    return [record for record in records if not is_return(record, records)]


def _steady(record: PoseRecord) -> bool:
    return record.steady and turned_rad(record.before, record.after) < _STILL_RAD


def _moved(records: Sequence[PoseRecord], names: Sequence[str], rows: Sequence[int]) -> list[str]:
    words = []
    for row in rows:
        record = records[row]
        turned_deg = np.degrees(turned_rad(record.before, record.after))
        if turned_deg >= np.degrees(_STILL_RAD):
            words.append(f"{names[row]} turned by {turned_deg:.2f}° while it was averaged: repeat it")
        elif not record.steady:
            words.append(
                f"{names[row]} was not steady while it was averaged: something swung or was touched, repeat it"
            )
    return words


def _out_of_line(result: CalibrationResult) -> list[int]:
    """Rows that were left out, or that the others predict badly."""
    spread = np.asarray(result.quality["residual_sigma"], dtype=np.float64)
    used = np.ones(len(spread), bool) if result.weights is None else result.weights > 0
    typical = max(float(np.median(spread[used] ** 2)), 1.0)
    limit = stats.chi2.isf(SURE / len(spread), 6) / 6 * typical
    return np.flatnonzero(~used | (spread**2 > limit)).tolist()


def _sigma(result: CalibrationResult) -> Array:
    """(6,) noise of a pose: as measured, or as the typical residual says where that is more."""
    typical = 1.4826 * np.median(np.abs(result.residuals), axis=0)
    least = np.zeros(6) if result.measured_sigma is None else result.measured_sigma
    return np.maximum(np.maximum(typical, least), 1e-9)


def _pulled(result: CalibrationResult, row: int) -> bool:
    return bool(np.abs(result.residuals[row, :3] / _sigma(result)[:3]).max() > _SIGNIFICANT)


def _lasting_change(result: CalibrationResult, records: Sequence[PoseRecord]) -> _Change | None:
    """Find what changed for good between two poses, if that explains the residuals better than anything else.

    Linear least squares of the residuals, with the parameters free and some of them different from a pose on, compared
    by the Bayesian information criterion with no change, with a steady drift, and with single poses that are off.
    """
    n, r = len(records), result.residuals
    sigma = result.measured_sigma
    if sigma is None or n < 2 * FEWEST_ON_A_SIDE + 2:
        return None
    J = jacobian(result.parameters, np.array([record.before.R_base_flange for record in records])) / sigma[:, None]
    y = r / sigma
    price = float(np.log(6 * n))

    def misfit(columns: Array, rows: NDArray[np.bool_] | None = None) -> tuple[float, Array]:
        X, target = np.concatenate([J, columns], axis=2), y
        if rows is not None:
            X, target = X[rows], y[rows]
        X, flat = X.reshape(-1, X.shape[2]), target.ravel()
        scale = np.linalg.norm(X, axis=0)
        scale[scale == 0] = 1.0
        x, *_ = np.linalg.lstsq(X / scale, flat, rcond=1e-10)
        return float(np.sum((flat - X / scale @ x) ** 2)), (x / scale)[15:]

    nothing = np.zeros((n, 6, 0))
    t = np.array([record.t_mid_ns for record in records], dtype=np.float64)
    ramp = ((t - t.mean()) / (np.ptp(t) or 1.0))[:, None, None] * (np.eye(6) / sigma[:, None])
    others = [misfit(nothing)[0], misfit(ramp)[0] + 6 * price]
    out = np.zeros(n, bool)
    out[_out_of_line(result)] = True
    if 0 < out.sum() < n - FEWEST_ON_A_SIDE:
        others.append(misfit(nothing, ~out)[0] + 6 * int(out.sum()) * price)
    best = None
    for row in range(FEWEST_ON_A_SIDE, n - FEWEST_ON_A_SIDE + 1):
        after = (np.arange(n) >= row)[:, None, None]
        for what, coordinates in _CHANGES:
            chi2, step = misfit(J[:, :, coordinates] * after)
            score = chi2 + (len(coordinates) + 1) * price
            if best is None or score < best.evidence:
                best = _Change(what, row, step, score)
    # Measured noise is less than all noise: differences count in units of what the best explanation leaves.
    if best is None:
        return None
    unit = max(best.evidence / (6 * n), 1.0)
    return best if (min(others) - best.evidence) / unit > CLEARLY else None


def _change_in_words(change: _Change, names: Sequence[str]) -> str:
    size = float(np.linalg.norm(change.step))
    since = f"from {names[change.row]} on"
    return {
        "centre of mass": f"{since} the centre of mass is {1e3 * size:.2g} mm elsewhere: did the load shift in the "
        "gripper? Fix it and calibrate again",
        "force bias": f"{since} the force reads {size:.2g} N more or less: was the sensor tared, or knocked, or does "
        "something touch it? Calibrate again",
        "torque bias": f"{since} the torque reads {size:.2g} N·m more or less: does a cable pull since then, or was "
        "the sensor tared? Calibrate again",
        "mounting": f"{since} the sensor sits {np.degrees(size):.2g}° otherwise: is a screw loose? Fasten it and "
        "calibrate again",
    }[change.what]
