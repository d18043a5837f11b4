"""Probable causes of poses that fit badly."""

from collections.abc import Sequence

import numpy as np

from ftcalib import CalibrationResult
from ftcalib.assessment.load_shift import Change, lasting_change
from ftcalib.assessment.verdict import out_of_line
from ftcalib.model import Array
from ftcalib.routine import MOVED_RAD, DriftCheck, PoseRecord, drift_check, is_return, turned_rad
from ftdrive.checks.controller_settings import mismatches

_SIGNIFICANT = 4.0


def names_of(records: Sequence[PoseRecord]) -> tuple[str, ...]:
    """Name the rows of a run's dataset: R and the number of the orientation."""
    return tuple(f"R{record.pose.number:02d}" for record in _in_dataset(records))


def hints(result: CalibrationResult, records: Sequence[PoseRecord]) -> tuple[str, ...]:
    """Explain outlying poses, most important first, then controller settings that differ from the result.

    Empty for a quiet run of a level arm whose controller has the right payload.

    Parameters
    ----------
    result : CalibrationResult
        Of the dataset of these records.
    records : sequence of PoseRecord
        In the order of the tour.
    """
    again = drift_check(records)
    records = _in_dataset(records)
    if len(records) != result.n_poses:
        raise ValueError(f"{len(records)} records do not belong to a result of {result.n_poses} poses")
    names = names_of(records)
    out = _out_of_line(result)
    change = _lasting_change(result, records)
    if change is not None:
        what, row = change
        return (what.in_words(names[row]), *moved(records), *mismatches(result))
    words = moved(records)
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
    if again is not None and np.abs(again.change / again.sigma).max() > _SIGNIFICANT:
        if _drifts_alike(result, again):
            words.append("the sensor drifts: let it warm up for 15 to 30 min, then calibrate again")
        elif np.abs(again.change / _sigma(result)).max() > np.sqrt(2) * _SIGNIFICANT:
            words.append(
                f"{names[0]} reads otherwise at the end, and the poses between do not drift: was it touched then? "
                "Repeat the last stop"
            )
    return (*words, *mismatches(result))


def _in_dataset(records: Sequence[PoseRecord]) -> list[PoseRecord]:
    return [record for record in records if not is_return(record, records)]


def _steady(record: PoseRecord) -> bool:
    return record.steady and turned_rad(record.before, record.after) < MOVED_RAD


def moved(records: Sequence[PoseRecord]) -> list[str]:
    """Name the poses that were not steady; each row of a dataset has one record."""
    words = []
    for record, name in zip(records, names_of(records), strict=True):
        turn_rad = turned_rad(record.before, record.after)
        if turn_rad >= MOVED_RAD:
            words.append(f"{name} turned by {np.degrees(turn_rad):.2f}° while it was averaged: repeat it")
        elif not record.steady:
            words.append(f"{name} was not steady while it was averaged: something swung or was touched, repeat it")
    return words


def _out_of_line(result: CalibrationResult) -> list[int]:
    spread = np.asarray(result.quality["residual_sigma"], dtype=np.float64)
    return out_of_line(spread, np.ones(len(spread), bool) if result.weights is None else result.weights > 0.5)


def _sigma(result: CalibrationResult) -> Array:
    """(6,) noise of a pose: as measured, or the typical residual if that is larger."""
    typical = 1.4826 * np.median(np.abs(result.residuals), axis=0)
    least = np.zeros(6) if result.measured_sigma is None else result.measured_sigma
    return np.maximum(np.maximum(typical, least), 1e-9)


def _pulled(result: CalibrationResult, row: int) -> bool:
    return bool(np.abs(result.residuals[row, :3] / _sigma(result)[:3]).max() > _SIGNIFICANT)


def _drifts_alike(result: CalibrationResult, again: DriftCheck) -> bool:
    """Check whether the drift in the fit is at least half of the largest change of the first pose."""
    if result.drift is None:
        return False
    k = np.abs(again.change / again.sigma).argmax()
    return bool(result.drift.change[k] / again.change[k] > 0.5)


def _lasting_change(result: CalibrationResult, records: Sequence[PoseRecord]) -> tuple[Change, int] | None:
    """Find a lasting change, and the row of the first pose after it, in the order of taking."""
    if result.measured_sigma is None:
        return None
    t_ns = np.array([record.t_mid_ns for record in records])
    order = np.argsort(t_ns, kind="stable")
    change = lasting_change(
        result.parameters,
        np.array([record.before.R_base_flange for record in records])[order],
        result.residuals[order],
        result.measured_sigma,
        (t_ns[order] - t_ns.min()) * 1e-9,
        np.flatnonzero(np.isin(order, _out_of_line(result))).tolist(),
    )
    return None if change is None else (change, int(order[change.position]))
