"""Every file that an earlier version has written is read by this one."""

import numpy as np
import pytest

import ftdrive
from ftcalib.sensor_matrix import SensorMatrix
from ftdrive.planning.plan import Plan
from ftdrive.runs.run import Run
from tests.baselines.pack import unpack
from tests.system.command_line import CommandLine


@pytest.fixture(scope="module")
def old(tmp_path_factory: pytest.TempPathFactory) -> CommandLine:
    return unpack(tmp_path_factory.mktemp("old"))


@pytest.mark.parametrize(
    ("run", "records", "verdict", "mass_kg"),
    [
        ("quick", 13, "good", 0.650842),
        ("minimal", 7, "usable", 0.650930),
        ("new-tool", 5, "good", 0.650358),
        ("sweep", 0, "usable", 0.487141),
    ],
)
def test_a_run_has_its_poses_and_its_result(
    old: CommandLine, run: str, records: int, verdict: str, mass_kg: float
) -> None:
    folder = Run(old.folder / run)
    assert (folder.header()["command"], len(folder.records())) == ("calibrate", records)
    result = ftdrive.read_calibration(folder.folder)
    assert (result.verdict, round(result.mass_kg, 6)) == (verdict, mass_kg)


@pytest.mark.parametrize("name", ["rest.mcap", "rest.csv", "rest.parquet", "pushed.mcap", "held.mcap", "moving.csv"])
def test_a_recording_has_its_samples_and_its_calibration(old: CommandLine, name: str) -> None:
    recording = ftdrive.read_recording(old.folder / name)
    assert (len(recording.rows), recording.cut) == (400, "")
    assert recording.header.info.calibration.verdict == "good"
    assert np.isfinite(recording.rows["wrench"]).all()


@pytest.mark.slow
def test_the_matrix_of_the_sensor_the_plan_and_the_store_are_read(old: CommandLine) -> None:
    error = SensorMatrix.load(old.folder / "sensor.json").error
    assert 0 < np.abs(error.diagonal()).max() < 0.05
    assert old.json("loads", "solve", "quick", "loaded")["verdict"] == "good"
    assert len(Plan.load(old.folder / "plan.json").stops) == 13
    listed = old.json("history")
    assert len(listed["results"]) == 5
    assert len(listed["last_weighings"]) == 1
