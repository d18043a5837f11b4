"""`ftdrive solve` of recordings in motion, and of files of other programs."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner
from scipy.spatial.transform import Rotation

from ftcalib import CalibrationResult
from ftcalib.errors import FtdriveError
from ftdrive.commands.solve import solve_command
from ftdrive.recording.files import write_recording
from ftdrive.recording.recording import ROW, Header, Recording
from ftdrive.stream.samples import Stages, WrenchFrame
from tests.moving_load import Recorded, Truth, record, sweep
from tests.unit.ftdrive.recorded import info
from tests.unit.ftdrive.stream.simulated import calibrated_from

SECONDS = 7.0
TRUTH = Truth(height_m=0.04)


@pytest.fixture(scope="module")
def swept() -> Recorded:
    return record(TRUTH, sweep(SECONDS), SECONDS, 1)


def table(path: Path, names: str, *columns: np.ndarray) -> Path:
    np.savetxt(path, np.column_stack(columns), delimiter=",", header=names, comments="", fmt="%.9g")
    return path


def run(*arguments: object) -> dict[str, Any]:
    result = CliRunner().invoke(solve_command, [*map(str, arguments), "--json"], catch_exceptions=False)
    document: dict[str, Any] = json.loads(result.stdout)
    return document


@pytest.mark.slow
def test_a_recording_is_solved_from_its_motion(tmp_path: Path, swept: Recorded) -> None:
    rows = np.zeros(len(swept.t_s), ROW)
    rows["t_host_ns"], rows["seq"] = np.rint(swept.t_s * 1e9) + 10**12, np.arange(len(rows))
    rows["raw"], rows["p_base_flange_m"] = swept.wrench, swept.p_base_flange_m
    rows["quaternion_base_flange"] = Rotation.from_matrix(swept.R_base_flange).as_quat()
    delay_s = TRUTH.delay_s + swept.t_pose_s[0] - swept.t_s[0]  # a row has one time
    header = Header(replace(info(), p_flange_sensor_m=np.array([0, 0, 0.06])), WrenchFrame(), Stages())
    write_recording(tmp_path / "sweep.csv", Recording(header, rows, []))
    saved = tmp_path / "calibration.json"
    document = run(tmp_path / "sweep.csv", "-o", saved)
    assert document["method"] == "motion"
    assert document["delay_s"] == pytest.approx(delay_s, abs=1e-4)
    np.testing.assert_allclose(document["inertia_kg_m2"], TRUTH.inertia_kg_m2, atol=1e-4)
    assert {"height_differs"} == {one["code"] for one in document["findings"]}
    loaded = CalibrationResult.load(saved)
    assert loaded.motion is not None
    assert loaded.provenance["devices"]["sensor"]["serial"] == "FT1"


@pytest.fixture
def files(tmp_path: Path, swept: Recorded) -> tuple[object, ...]:
    vectors = Rotation.from_matrix(swept.R_base_flange).as_rotvec()
    wrench = table(tmp_path / "w.csv", "t,fx,fy,fz,tx,ty,tz", swept.t_s, swept.wrench)
    poses = table(tmp_path / "p.csv", "t,rx,ry,rz,x,y,z", swept.t_pose_s, vectors, swept.p_base_flange_m)
    return "--wrench", wrench, "--orientation-file", poses


@pytest.mark.slow
def test_files_of_another_program_are_joined_with_an_earlier_result(tmp_path: Path, files: tuple[object, ...]) -> None:
    earlier = calibrated_from({**TRUTH.to_dict(), "noise_force_N": 0.05, "noise_torque_Nm": 0.002})
    earlier.save(tmp_path / "earlier.json")
    alone, joined = run(*files), run(*files, "--from", tmp_path / "earlier.json")
    assert joined["provenance"]["parent"] == {"id": earlier.id}
    assert joined["covariance"][0][0] < alone["covariance"][0][0]


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--wrench", "w.csv"], "give both"),
        (["--wrench", "w.csv", "--orientation-file", "w.csv"], r"w.csv: no orientation among the columns t, fx"),
        (["--wrench", "back.csv", "--orientation-file", "back.csv"], r"back.csv: the time goes back"),
        (["--wrench", "w.csv", "--orientation-file", "w.csv", "--method", "srom"], "poses at rest"),
    ],
)
def test_files_that_cannot_be_used_are_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, arguments: list[str], words: str
) -> None:
    monkeypatch.chdir(tmp_path)
    table(Path("w.csv"), "t,fx,fy,fz,tx,ty,tz", np.arange(14.0).reshape(2, 7))
    table(Path("back.csv"), "t,fx,fy,fz,tx,ty,tz", np.arange(14.0)[::-1].reshape(2, 7))
    with pytest.raises(FtdriveError, match=words):
        CliRunner().invoke(solve_command, arguments, catch_exceptions=False)
