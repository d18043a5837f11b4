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
CLEARLY = 0.5
"""A lasting change must bring the mean square misfit below this share of what any other explanation leaves."""

_STILL_RAD = np.radians(0.05)
_SIGNIFICANT = 4.0


@dataclass(frozen=True, slots=True, eq=False)
class _Change:
    what: str
    row: int
    step: Array
    misfit: float
    criterion: float


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
    """Find what changed for good between two poses, if that explains the residuals far better than anything else.

    Linear least squares of the residuals with the parameters free, and some of them different from a pose on. It must
    beat no change, a steady drift, and single poses that are off, unless those are all at one end of the tour.
    """
    n, sigma = len(records), result.measured_sigma
    if sigma is None or n < 2 * FEWEST_ON_A_SIDE + 2:
        return None
    y = result.residuals / sigma
    J = jacobian(result.parameters, np.array([record.before.R_base_flange for record in records])) / sigma[:, None]
    everything = np.ones(n, bool)

    def fit(columns: Array, rows: NDArray[np.bool_] = everything) -> tuple[float, Array]:
        """Mean square misfit per degree of freedom, and the estimates of the added columns."""
        X = np.concatenate([J, columns], axis=2)[rows].reshape(6 * int(rows.sum()), -1)
        scale = np.linalg.norm(X, axis=0)
        scale[scale == 0] = 1.0
        x, *_ = np.linalg.lstsq(X / scale, y[rows].ravel(), rcond=1e-10)
        left = y[rows].ravel() - X / scale @ x
        return float(left @ left) / max(len(X) - X.shape[1], 1), (x / scale)[15:]

    t = np.array([record.t_mid_ns for record in records], dtype=np.float64)
    ramp = ((t - t.mean()) / (np.ptp(t) or 1.0))[:, None, None] * (np.eye(6) / sigma[:, None])
    others = [fit(np.zeros((n, 6, 0)))[0], fit(ramp)[0]]
    used = everything.copy()
    used[_out_of_line(result)] = False
    at_one_end = np.count_nonzero(np.diff(used)) == 1 and np.count_nonzero(~used) >= FEWEST_ON_A_SIDE
    if not at_one_end and not used.all() and used.sum() > FEWEST_ON_A_SIDE:
        others.append(fit(np.zeros((n, 6, 0)), used)[0])

    changes = _changes(result)
    found = []
    for row in range(FEWEST_ON_A_SIDE, n - FEWEST_ON_A_SIDE + 1):
        after = (np.arange(n) >= row)[:, None, None]
        for what, directions in changes.items():
            misfit, step = fit(J @ directions * after)
            criterion = 6 * n * np.log(misfit) + directions.shape[1] * np.log(6 * n)
            found.append(_Change(what, row, step, misfit, float(criterion)))
    best = min(found, key=lambda change: change.criterion)
    return best if max(best.misfit, 1.0) < CLEARLY * min(others) else None


def _changes(result: CalibrationResult) -> dict[str, Array]:
    """What can change between two poses: directions (15, k) in the error coordinates of the model."""
    e = np.eye(15)
    down = result.gravity_force_base_N / (result.weight_N or 1.0)
    return {
        "centre of mass": e[:, 9:12],
        "load": np.column_stack([e[:, 3:6] @ down, e[:, 9:12]]),
        "force": e[:, 6:9],
        "torque": e[:, 12:15],
        "force and torque": e[:, [6, 7, 8, 12, 13, 14]],
        "mounting": e[:, 0:3],
    }


def _change_in_words(change: _Change, names: Sequence[str]) -> str:
    step, size = change.step, float(np.linalg.norm(change.step))
    tared = "was the sensor tared, or does a cable pull? Check it"
    what = {
        "centre of mass": f"the centre of mass is {1e3 * size:.2g} mm elsewhere: did the load shift? Fix it",
        "load": f"the load weighs {abs(step[0]):.2g} N {'less' if step[0] < 0 else 'more'}: was something lost or "
        "picked up? Check the tool",
        "force": f"the force reads {size:.2g} N otherwise: {tared}",
        "torque": f"the torque reads {size:.2g} N·m otherwise: {tared}",
        "force and torque": f"force and torque read {np.linalg.norm(step[:3]):.2g} N and "
        f"{np.linalg.norm(step[3:]):.2g} N·m otherwise: {tared}",
        "mounting": f"the sensor sits {np.degrees(size):.2g}° otherwise: is a screw loose? Fasten it",
    }[change.what]
    return f"from {names[change.row]} on {what} and calibrate again"
