"""Findings that name the probable cause if single poses fit badly, such as a pulling cable."""

from collections.abc import Sequence

import numpy as np

from ftcalib import CalibrationResult, Finding
from ftcalib.judge.verdict import out_of_line
from ftcalib.model import Array
from ftcalib.routine import MOVED_RAD, DriftCheck, PoseRecord, drift_check, is_return, turned_rad

_SIGNIFICANT = 4.0
# Codes of findings that report a change of tool or sensor between two poses.
_CHANGES = {"com_shifted", "load_changed", "bias_stepped", "sensor_turned", "sensor_changed"}


def pose_names(records: Sequence[PoseRecord]) -> tuple[str, ...]:
    """Return a name for each row of a run's dataset: R and the orientation number, such as "R05"."""
    return tuple(f"R{number:02d}" for number in numbers_in_dataset(records))


def numbers_in_dataset(records: Sequence[PoseRecord]) -> tuple[int, ...]:
    """Return the orientation number in the plan for each row of a run's dataset."""
    return tuple(record.pose.number for record in _in_dataset(records))


def hints(result: CalibrationResult, records: Sequence[PoseRecord]) -> tuple[Finding, ...]:
    """Return findings about poses of a tour that moved, fit badly or drifted; empty if `records` is.

    `result` is the calibration from the dataset of these records, which are in the order of the tour.
    """
    if not records:
        return ()
    again = drift_check(records)
    records = _in_dataset(records)
    if len(records) != result.n_poses:
        raise ValueError(f"{len(records)} records do not belong to a result of {result.n_poses} poses")
    names, findings = pose_names(records), find_moved(records)
    if any(finding.code in _CHANGES for finding in result.findings):  # which explains the badly fitting poses
        return tuple(findings)
    odd = [row for row in _out_of_line(result) if _steady(records[row])]
    pulled = [row for row in odd if np.abs(result.residuals[row] / _sigma(result))[:3].max() > _SIGNIFICANT]
    for row in odd:
        force_N, torque_Nm = np.linalg.norm(result.residuals[row, :3]), np.linalg.norm(result.residuals[row, 3:])
        code = "load_swings" if row not in pulled else "pose_touched" if len(pulled) == 1 else "pose_off"
        findings.append(Finding.of(code, pose=names[row], force_N=force_N, torque_Nm=torque_Nm))
    if len(pulled) > 1:
        findings.append(Finding.of("cable_pulls", poses=[names[row] for row in pulled]))
    if again is not None and np.abs(again.change / again.sigma).max() > _SIGNIFICANT:
        if _drifts_alike(result, again):
            findings.append(Finding.of("sensor_drifts"))
        elif np.abs(again.change / _sigma(result)).max() > np.sqrt(2) * _SIGNIFICANT:
            findings.append(Finding.of("return_differs", pose=names[0]))
    return tuple(findings)


def _in_dataset(records: Sequence[PoseRecord]) -> list[PoseRecord]:
    return [record for record in records if not is_return(record, records)]


def _steady(record: PoseRecord) -> bool:
    return record.steady and turned_rad(record.before, record.after) < MOVED_RAD


def find_moved(records: Sequence[PoseRecord]) -> list[Finding]:
    """Return findings about poses that were not steady, or turned during the measurement."""
    findings = []
    for record, name in zip(records, pose_names(records), strict=True):
        turn_rad = turned_rad(record.before, record.after)
        if turn_rad >= MOVED_RAD:
            findings.append(Finding.of("pose_turned", pose=name, turn_deg=np.degrees(turn_rad)))
        elif not record.steady:
            findings.append(Finding.of("pose_unsteady", pose=name))
    return findings


def _out_of_line(result: CalibrationResult) -> list[int]:
    if "residual_sigma" not in result.quality:  # missing in updates and results for a new tool
        return []
    spread = np.asarray(result.quality["residual_sigma"], dtype=np.float64)
    return out_of_line(spread, np.ones(len(spread), bool) if result.weights is None else result.weights > 0.5)


def _sigma(result: CalibrationResult) -> Array:
    """Return the standard deviation (6,) at a pose: the larger of measured noise and typical residual."""
    typical = 1.4826 * np.median(np.abs(result.residuals), axis=0)
    least = np.zeros(6) if result.measured_sigma is None else result.measured_sigma
    return np.maximum(np.maximum(typical, least), 1e-9)


def _drifts_alike(result: CalibrationResult, again: DriftCheck) -> bool:
    """Return whether the fitted drift explains at least half of the repeated first pose's most significant change."""
    if result.drift is None:
        return False
    k = np.abs(again.change / again.sigma).argmax()
    return bool(result.drift.change[k] / again.change[k] > 0.5)
