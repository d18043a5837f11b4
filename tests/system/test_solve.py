"""`ftdrive solve` on files, good and bad, as a user meets it."""

import json
from collections.abc import Callable
from functools import partial
from pathlib import Path
from subprocess import CompletedProcess

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tests.system.command_line import CommandLine

HEADER = "r11,r12,r13,r21,r22,r23,r31,r32,r33,fx,fy,fz,tx,ty,tz"


Solve = Callable[..., CompletedProcess[str]]


@pytest.fixture
def solve(ftdrive: CommandLine) -> Solve:
    return partial(ftdrive.run, "solve")


def rows(n: int) -> list[str]:
    """Rows of a made-up but consistent recording: 1.2 kg, sensor turned 40 degrees about z, R_base_flange."""
    rng = np.random.default_rng(3)
    R_flange_sensor = Rotation.from_rotvec([0, 0, np.radians(40)]).as_matrix()
    lines = []
    for R in Rotation.random(n, rng=rng).as_matrix():
        weight = R_flange_sensor.T @ R.T @ [0, 0, -1.2 * 9.80665]
        torque = np.cross([0.01, 0.0, 0.06], weight)
        wrench = np.r_[np.add(weight, (1, 2, 3)), np.add(torque, (0.1, 0.2, 0.3))] + rng.normal(0, 1e-3, 6)
        lines.append(",".join(f"{value:.9f}" for value in np.r_[R.ravel(), wrench]))
    return lines


@pytest.mark.slow
def test_real_recording_gives_the_published_result(solve: Solve, real_data: Path) -> None:
    folder = real_data / "agimus_mini45_b"
    outcome = solve(folder / "poses.csv", "--orientation", "R_flange_base", "--json")
    assert outcome.returncode == 0, outcome.stderr
    result = json.loads(outcome.stdout)
    published = json.loads((folder / "expected.json").read_text())["R_se_published_refined"]  # flange -> sensor
    angle = Rotation.from_matrix(np.array(published) @ np.array(result["R_flange_sensor"])).magnitude()
    assert result["mass_kg"] == pytest.approx(0.788, abs=0.004)
    assert np.degrees(angle) < 0.7
    assert result["residual"]["force_rms_N"] <= 0.25
    assert result["residual"]["torque_rms_Nm"] <= 0.007


@pytest.mark.slow
def test_a_drifting_recording_is_rejected(solve: Solve, real_data: Path) -> None:
    outcome = solve(real_data / "foamcutting_2013_06_12" / "poses.csv", "--orientation", "R_flange_base", "--json")
    assert outcome.returncode == 7
    result = json.loads(outcome.stdout)
    assert result["verdict"] == "rejected"
    assert result["residual"]["force_rms_N"] > 0.1 * result["weight_N"]


def test_output_is_a_calibration_that_is_never_overwritten(solve: Solve, tmp_path: Path) -> None:
    path, output = tmp_path / "poses.csv", tmp_path / "calibration.json"
    path.write_text("\n".join([HEADER, *rows(12)]))
    assert solve(path, "-o", output).returncode == 0
    saved = output.read_bytes()
    assert json.loads(saved)["format"] == "ftdrive.calibration/2"
    again = solve(path, "-o", output)
    assert again.returncode == 2
    assert "exists" in again.stderr
    assert output.read_bytes() == saved


def test_several_files_give_a_line_each_and_one_bad_file_does_not_hide_the_others(solve: Solve, tmp_path: Path) -> None:
    good, bad = tmp_path / "good.csv", tmp_path / "bad.csv"
    good.write_text("\n".join([HEADER, *rows(12)]))
    bad.write_text(HEADER)
    outcome = solve(bad, good, good, "--json")
    assert outcome.returncode == 6
    answers = [json.loads(line) for line in outcome.stdout.splitlines()]
    assert [answer["source"] for answer in answers] == [str(bad), str(good), str(good)]
    assert "error" in answers[0]
    assert answers[1]["mass_kg"] == answers[2]["mass_kg"]


@pytest.mark.slow
def test_a_rejected_result_is_saved_only_by_force_and_stays_marked(solve: Solve, tmp_path: Path) -> None:
    path, output = tmp_path / "poses.csv", tmp_path / "calibration.json"
    rng = np.random.default_rng(1)
    noisy = [",".join([*row.split(",")[:9], *(f"{v:.3f}" for v in rng.normal(0, 5, 6))]) for row in rows(12)]
    path.write_text("\n".join([HEADER, *noisy]))
    refused = solve(path, "-o", output)
    assert refused.returncode == 7, refused.stderr
    assert "rejected and was not saved" in refused.stderr
    assert "is rejected: " in solve(path).stderr  # without --output
    assert not output.exists()
    assert solve(path, "-o", output, "--force").returncode == 0
    assert json.loads(output.read_text())["verdict"] == "rejected"


BAD = {
    "two poses": ([HEADER, *rows(2)], 7, "4"),
    "all poses equal": ([HEADER, *(rows(1) * 8)], 7, "pose"),
    "empty file": ([], 6, "empty"),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_csv_gets_one_clear_sentence(solve: Solve, case: str, tmp_path: Path) -> None:
    lines, code, word = BAD[case]
    path = tmp_path / "poses.csv"
    path.write_text("\n".join(lines))
    outcome = solve(path, "-o", tmp_path / "calibration.json")
    assert outcome.returncode == code, outcome.stderr
    assert outcome.stdout == ""
    assert outcome.stderr.startswith("error: ")
    assert outcome.stderr.count("\n") == 1
    assert word in outcome.stderr
    assert [item.name for item in tmp_path.iterdir()] == ["poses.csv"]


def noisy(lines: list[str]) -> list[str]:
    """Add the standard errors that the rows have."""
    return [f"{HEADER},{','.join(f'sigma_{c}' for c in ('fx', 'fy', 'fz', 'tx', 'ty', 'tz'))}"] + [
        f"{line},{','.join(['0.001'] * 6)}" for line in lines
    ]


@pytest.mark.slow
def test_a_new_tool_takes_four_poses_and_two_runs_are_one(solve: Solve, tmp_path: Path) -> None:
    every = rows(24)
    for name, some in (("all", every[:16]), ("four", every[16:20]), ("more", every[16:])):
        (tmp_path / f"{name}.csv").write_text("\n".join(noisy(some)))
    assert solve("all.csv", "-o", "all.json").returncode == 0
    outcome = solve("four.csv", "--from", "all.json", "--json")
    assert outcome.returncode == 0, outcome.stderr
    result = json.loads(outcome.stdout)
    assert result["mass_kg"] == pytest.approx(1.2, abs=4 * result["sigma"]["mass_kg"])
    assert result["provenance"]["parent"]["id"] == json.loads((tmp_path / "all.json").read_text())["id"]
    both = json.loads(solve("all.csv", "more.csv", "--together", "--json").stdout)
    assert "together" in [one["code"] for one in both["findings"]]
    for arguments, words in (
        (("all.csv", "--together"), "two runs or more"),
        (("four.csv", "--from", "all.json", "--method", "srom"), "--method ml"),
    ):
        refused = solve(*arguments)
        assert refused.returncode == 2
        assert words in refused.stderr
