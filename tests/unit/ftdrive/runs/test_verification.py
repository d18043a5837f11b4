"""The last verification of a calibration is found by its id, wherever the files are; damaged files are ignored."""

import json
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ftcalib import CalibrationDataset, CalibrationResult
from ftdrive.runs.verification import (
    FORMAT,
    fitted_dataset,
    verification_near,
)
from ftdrive.store.records import read_records
from tests.unit.ftdrive.recorded import calibration

NOW = datetime(2026, 11, 22, 12, tzinfo=UTC)


def saved(folder: Path, result: CalibrationResult | None = None) -> Path:
    folder.mkdir(parents=True)
    (result or calibration()).save(path := folder / "calibration.json")
    return path


def verify(folder: Path, hours_ago: float, **different: Any) -> Path:
    """Write what a verification leaves."""
    folder.mkdir(parents=True)
    document = {
        "format": FORMAT,
        "calibration": {"id": calibration().id, "path": "elsewhere/calibration.json"},
        "created_utc": (NOW - timedelta(hours=hours_ago)).isoformat(),
        "passed": True,
        "change": None,
        "reason": "the calibration holds",
        "force_max_N": 0.1,
        "torque_max_Nm": 0.01,
        "later": 1,
    }
    (path := folder / "verification.json").write_text(json.dumps(document | different))
    return path


@pytest.mark.parametrize("beside", ["runs/b-verify", "runs/a-calibrate/runs/b-verify"])
def test_the_newest_verification_of_this_calibration_counts(tmp_path: Path, beside: str) -> None:
    path = saved(tmp_path / "runs/a-calibrate")
    verify(tmp_path / "runs/c-verify", 5.0)
    other = {"id": "0" * 12, "path": str(path)}
    verify(tmp_path / "runs/d-verify", 0.5, calibration=other)
    newest = verify(tmp_path / beside, 2.0, passed=False, change="bias")
    for place in (path, path.parent):
        found = verification_near(place, calibration().id)
        assert found is not None
        assert (found.path, found.passed, found.change) == (str(newest), False, "bias")


def test_damaged_and_newer_files_are_ignored(tmp_path: Path) -> None:
    path = saved(tmp_path / "runs/a-calibrate")
    for name, text in (("b", "{"), ("c", "[]"), ("d", '{"format": "ftdrive.verification/1"}')):
        (tmp_path / "runs" / name).mkdir()
        (tmp_path / "runs" / name / "verification.json").write_text(text)
    verify(tmp_path / "runs/e", 1.0, format="ftdrive.verification/2")
    verify(tmp_path / "runs/f", 1.0, force_max_N="much")
    assert verification_near(path, calibration().id) is None
    (words,) = read_records([tmp_path / "runs/f/verification.json"])[1]
    assert "f/verification.json: verification.json lacks" in words


def test_the_poses_of_a_calibration_are_found_by_their_hash(tmp_path: Path) -> None:
    poses = CalibrationDataset(
        np.tile(np.eye(3), (4, 1, 1)), np.zeros((4, 6)), None, np.zeros(4, np.int64), np.full(4, np.nan)
    )
    poses.save(tmp_path / "dataset-2.json")
    (tmp_path / "dataset.json").write_text("damaged")
    made = replace(calibration(), provenance={"dataset_sha256": poses.sha256()})
    for place in (tmp_path, tmp_path / "calibration.json"):
        found = fitted_dataset(made, place)
        assert found is not None
        assert found.sha256() == poses.sha256()
    assert fitted_dataset(calibration(), tmp_path) is None
