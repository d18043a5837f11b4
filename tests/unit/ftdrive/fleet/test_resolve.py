"""Runs solved again, in this process."""

from collections.abc import Callable
from concurrent.futures import BrokenExecutor, Future
from pathlib import Path
from typing import Any
from unittest.mock import ANY

import pytest

from ftcalib import CalibrationResult
from ftdrive.errors import ConfigError
from ftdrive.fleet.resolve import Comparison, is_calibration, solve_again, solve_run, solved_path
from ftdrive.fleet.workers import Workers
from ftdrive.runs import run_folders
from tests.calibrated_runs import FIRST, calibrated_run, swept_run


def at_once(function: Callable[..., bytes], *arguments: Any) -> "Future[bytes]":
    future = Future[bytes]()
    try:
        future.set_result(function(*arguments))
    except Exception as error:
        future.set_exception(error)
    return future


def again(*folders: Path, submit: Any = at_once) -> dict[Path, Comparison | str]:
    return dict(solve_again(folders, Workers(1, submit, BrokenExecutor)))


@pytest.mark.slow
def test_the_result_is_that_of_the_run_and_replaces_nothing(tmp_path: Path) -> None:
    folder = calibrated_run(tmp_path, "run")
    before = (folder / "calibration.json").read_bytes()
    assert again(folder) == {folder: Comparison("good", "good", None, "R_flange_sensor.x", 0.0)}
    own, new = CalibrationResult.load(folder / "calibration.json"), CalibrationResult.load(solved_path(folder))
    assert new.id == own.id
    assert new.provenance == {**own.provenance, "created_utc": FIRST.isoformat(), "run": "run"}
    assert new.provenance["setup"]["tool"] == "gripper"
    assert (folder / "calibration.json").read_bytes() == before
    assert solved_path(folder).read_bytes() == solve_run(folder)


@pytest.mark.slow
def test_a_run_in_motion_is_solved_here_and_from_its_files_to_the_same_bytes(tmp_path: Path) -> None:
    folder = swept_run(tmp_path, "swept")
    assert again(folder).keys() == {folder}
    solved_path(folder).rename(folder / "calibration.json")
    with_folder = Workers(1, at_once, BrokenExecutor, share_files=True)
    new = CalibrationResult.load(folder / "calibration.json")
    expected = Comparison(new.verdict, new.verdict, ANY, "R_flange_sensor.x", 0.0)
    assert dict(solve_again([folder], with_folder)) == {folder: expected}
    assert solved_path(folder).read_bytes() == (folder / "calibration.json").read_bytes()
    assert new.provenance["created_utc"] == FIRST.isoformat()
    assert [new.provenance[name] for name in ("run", "recording")] == ["swept", "motion.npz"]


def test_a_failure_has_its_reason_and_concerns_one_run(tmp_path: Path) -> None:
    few = calibrated_run(tmp_path, "few", poses=3)
    damaged, edited = (calibrated_run(tmp_path, name) for name in ("damaged", "edited"))
    (damaged / "dataset.json").write_text('{"format": "ftdrive.data')
    (edited / "dataset.json").write_text((edited / "dataset.json").read_text().replace("200", "201", 1))
    lost = calibrated_run(tmp_path, "lost")
    (lost / "run.json").unlink()
    fine = calibrated_run(tmp_path, "fine")
    found = again(few, damaged, edited, lost, fine)
    assert "3 poses are too few" in str(found[few])
    assert "not valid JSON" in str(found[damaged])
    assert "differs from its checksum" in str(found[edited])
    assert "no run.json" in str(found[lost])
    assert isinstance(found[fine], Comparison)
    assert [one.name for one in tmp_path.glob("*/solved-*")] == [solved_path(fine).name]


def test_a_worker_of_another_version_ends_it(tmp_path: Path) -> None:
    folder = calibrated_run(tmp_path, "run")
    with pytest.raises(ConfigError, match=r"ftdrive 0\.0\.1: install the same"):
        again(folder, submit=lambda *_: at_once(solve_run, folder, "0.0.1"))
    assert not solved_path(folder).exists()


def test_which_runs_are_calibrations_of_that_time(tmp_path: Path) -> None:
    old, new = calibrated_run(tmp_path, "old"), calibrated_run(tmp_path, "new", day=40)
    verification = calibrated_run(tmp_path, "verification", day=40, header={"command": "verify"})
    damaged = calibrated_run(tmp_path, "damaged")
    (damaged / "run.json").write_text("{")
    (tmp_path / "other").mkdir()
    assert run_folders([tmp_path, new]) == [damaged, new, old, verification]
    since = FIRST.replace(month=9)
    assert [is_calibration(one, since) for one in (old, new, verification, damaged)] == [False, True, False, True]
    assert [is_calibration(one, None) for one in (old, new, verification, damaged)] == [True, True, False, True]
