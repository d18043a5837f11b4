"""Verifications on the fake cell: fresh poses, the outcome on disk, the update, plans that are driven again."""

import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from ftcalib import CalibrationResult
from ftcalib.errors import NotObservable
from ftcalib.model import Array
from ftcalib.routine import PoseRecord
from ftdrive.errors import ConfigError
from ftdrive.planning.plan import Plan
from ftdrive.runs.run import Reading, Run
from ftdrive.runs.verification import NO_LIMITS, Limits, Verified, save_update, verification_near, verify_run
from ftdrive.session.along_plan import has_completed
from ftdrive.session.events import Compared, Noted, PoseTaken
from ftdrive.session.open_session import SessionOptions
from ftdrive.session.session import take_poses
from ftdrive.session.verifying import RunningComparison, Verifying
from ftdrivers.interfaces import DeviceInfo
from tests.unit.ftdrive.fake_cell import Lab

TURNED = Rotation.from_euler("z", 5, degrees=True).as_matrix()


@pytest.fixture(scope="module")
def calibrated(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run folder of the fake cell; it is copied."""
    with pytest.MonkeyPatch.context() as patched:
        patched.setenv("XDG_STATE_HOME", str(tmp_path_factory.mktemp("state")))
        outcome = Lab(tmp_path_factory.mktemp("calibrated"), patched).calibrate()
    assert outcome is not None
    return outcome.run.folder


@pytest.fixture
def calibration(lab: Lab, calibrated: Path) -> CalibrationResult:
    """Of the fake cell, in its own run folder."""
    folder = lab.folder / "runs" / calibrated.name
    shutil.copytree(calibrated, folder)
    return CalibrationResult.load(folder / "calibration.json")


@pytest.fixture
def take(lab: Lab, calibration: CalibrationResult) -> Callable[..., Run]:
    """Take the poses of a verification."""

    def run(poses: int = 2, **options: Any) -> Run:
        path = lab.folder / "runs" / str(calibration.provenance["run"]) / "calibration.json"
        task = Verifying(lab.cell, calibration, path, poses, lab.folder / "runs")
        about = {"verification": {"id": calibration.id, "path": str(path), "poses": poses}}
        given = SessionOptions(lab.folder / "runs", "verify", poses=poses, description=about, **options)
        taken = take_poses(task, lab.operator, given)
        assert taken is not None
        return taken

    return run


def verified(run: Run, calibration: CalibrationResult, limits: Limits = NO_LIMITS) -> Verified:
    path = run.folder.parent / str(calibration.provenance["run"]) / "calibration.json"
    return verify_run(run, calibration, path, limits)


def records_of(lab: Lab, calibration: CalibrationResult) -> list[PoseRecord]:
    return Run(lab.folder / "runs" / str(calibration.provenance["run"])).records()


def turned(record: PoseRecord, R: Array) -> PoseRecord:
    """Return a record at another orientation."""
    before = record.before
    return replace(record, before=Reading(before.t_host_ns, before.q_rad, before.R_base_flange @ R))


def turn_deg(R: Any, others: Any) -> float:
    """Angle to the nearest of some orientations."""
    return float(np.degrees((Rotation.from_matrix(R) * Rotation.from_matrix(others).inv()).magnitude().min()))


@pytest.mark.slow
def test_an_unchanged_cell_passes_at_poses_that_were_not_used(
    lab: Lab, calibration: CalibrationResult, take: Callable[..., Run]
) -> None:
    used = [record.before.R_base_flange for record in records_of(lab, calibration)]
    lab.sensor.warm_C = 31.5
    run = take(4)
    assert [event.stop for event in lab.operator.of(Compared)] == [1, 2, 3, 4, 5]
    fresh = [record.before.R_base_flange for record in run.records()]
    assert min(turn_deg(R, used) for R in fresh) > 30
    found = verified(run, calibration)
    assert found.passed
    assert found.update is None
    document = json.loads(found.path.read_text())
    assert document["format"] == "ftdrive.verification/1"
    assert document["calibration"]["id"] == calibration.id
    assert len(document["poses"]) == 4
    assert (document["temperature_C"], calibration.provenance["temperature_C"]) == (31.5, None)
    change = document["bias_change"]
    for one, bias, sigma, common in zip(
        range(6), change["value"], change["sigma"], change["calibration_sigma"], strict=True
    ):
        assert abs(bias) < 6 * np.hypot(sigma, common), one
    last = verification_near(run.folder.parent / str(calibration.provenance["run"]), calibration.id)
    assert last is not None
    assert (last.passed, last.path) == (True, str(found.path.absolute()))
    with pytest.raises(NotObservable):
        save_update(found)


@pytest.mark.slow
def test_a_step_of_the_bias_is_named_and_the_update_names_its_parent(
    lab: Lab, calibration: CalibrationResult, take: Callable[..., Run]
) -> None:
    lab.sensor.push = np.array([0.3, 0.4, 0.0, 0.0, 0.0, 0.0])
    found = verified(take(4), calibration)
    assert not found.passed
    assert found.verification.change == "bias"
    saved = CalibrationResult.load(save_update(found))
    assert saved.provenance["parent"]["id"] == calibration.id
    assert Path(saved.provenance["parent"]["path"]).is_file()
    assert saved.provenance["update"] == "bias"
    assert saved.provenance["devices"] == calibration.provenance["devices"]
    step = saved.force_bias_N - calibration.force_bias_N
    assert step == pytest.approx([0.3, 0.4, 0.0], abs=6 * float(np.max(saved.sigma["force_bias_N"])))
    assert save_update(found).name == "calibration-2.json"
    last = verification_near(Path(saved.provenance["parent"]["path"]), calibration.id)
    assert last is not None
    assert not last.passed


@pytest.mark.slow
def test_a_completed_plan_is_driven_again_and_fast(lab: Lab, take: Callable[..., Run]) -> None:
    first = Plan.load(take(fast=True).plan_path)
    slowest = max(speed for _, speed, _ in lab.arm.moves)
    assert has_completed("A1", first.sha256)
    lab.arm.moves.clear()
    for name in ("2999-damaged", "2999-other"):  # newer folders that are of no use
        (lab.folder / "runs" / name).mkdir()
        (lab.folder / "runs" / name / "plan.json").write_text("{" if "damaged" in name else json.dumps(first.to_dict()))
    again = Plan.load(take(fast=True, yes=True).plan_path)
    assert again.sha256 == first.sha256
    assert max(speed for _, speed, _ in lab.arm.moves) > slowest
    lab.cell = replace(lab.cell, tool=replace(lab.cell.tool, cylinders_mm=((0.0, 150.0, 100.0),)))
    other = Plan.load(take(fast=True).plan_path)
    assert other.made_for["tool"] != first.made_for["tool"]


def test_another_sensor_is_refused_before_anything_moves(
    lab: Lab, take: Callable[..., Run], monkeypatch: pytest.MonkeyPatch
) -> None:
    lab.arm.moves.clear()
    monkeypatch.setattr(lab.sensor, "identify", lambda: DeviceInfo("fake", "S2", "1"))
    with pytest.raises(ConfigError, match="the sensor S2 is connected"):
        take()
    assert not lab.arm.moves


@pytest.mark.slow
def test_an_interrupted_verification_goes_on_as_one(lab: Lab, take: Callable[..., Run]) -> None:
    def unplug() -> None:
        lab.operator.answers["resume"] = ["quit"]
        lab.sensor.push = np.array([150.0, 0, 0, 0, 0, 0])

    lab.arm.moves.clear()
    lab.arm.at_move[3] = unplug
    with pytest.raises(Exception, match="unexpected contact"):
        take(4)
    run = Run(max((lab.folder / "runs").glob("*-verify")))
    assert 0 < len(run.stops()) < 5
    lab.sensor.push = np.zeros(6)
    with pytest.raises(ConfigError, match="ftdrive verify --resume"):
        lab.calibrate(resume=run.folder)
    assert take(4, resume=run.folder).stops() == [1, 2, 3, 4, 5]


def test_only_fresh_poses_count_by_hand(lab: Lab, calibration: CalibrationResult) -> None:
    records = records_of(lab, calibration)
    used = np.array([record.before.R_base_flange for record in records])
    comparison = RunningComparison(calibration, used, wanted=1)
    assert comparison.add(records[0]).light == "amber"
    assert comparison.add(records[0]).poses == 1
    near = comparison.add(turned(records[1], TURNED))
    assert (near.light, bool(near.hint)) == ("amber", True)
    tilted = Rotation.from_euler("x", 40, degrees=True).as_matrix()
    assert comparison.add(turned(records[2], tilted)).light == "green"


def test_a_calibration_without_its_poses_is_verified_with_a_warning(
    lab: Lab, calibration: CalibrationResult, take: Callable[..., Run]
) -> None:
    (lab.folder / "runs" / str(calibration.provenance["run"]) / "dataset.json").unlink()
    take()
    assert any("poses of the calibration are unknown" in note.words for note in lab.operator.of(Noted) if note.warning)
    assert lab.operator.of(PoseTaken)
