"""`history` and `diff` as commands, and the call with which other commands add their runs to the store."""

import json
import sqlite3
from collections.abc import Callable
from datetime import UTC, datetime, timedelta
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from ftcalib import CalibrationResult
from ftdrive.cell.config import user_folder
from ftdrive.runs.run import Run
from ftdrive.runs.weighings import FOLDER, append_weighings
from ftdrive.store.database import SCHEMA, default_file
from ftdrive.store.store import Store
from tests.unit.ftdrive.store.run_folders import new_run, result, verified
from tests.unit.ftdrive.stream.simulated import calibrated

Ran = tuple[int, str, str]


@pytest.fixture
def runs(tmp_path: Path) -> Path:
    """Four results of one tool whose force bias drifts, one of another, and a failed verification."""
    runs = tmp_path / "runs"
    sigma = np.sqrt(np.diag(calibrated().covariance))
    rng = np.random.default_rng(1)
    for month in range(4):
        step = rng.normal(size=15) * sigma + np.eye(15)[6] * 40 * month * sigma[6]
        new_run(runs, f"gripper-{month}", result(30 * month, step))
    new_run(runs, "drill", result(5, tool="drill"))
    newest = CalibrationResult.load(runs / "gripper-3" / "calibration.json")
    verified(new_run(runs, "verify"), newest.id, 91, passed=False)
    return runs


def test_as_json_it_is_one_object(run: Callable[..., Ran], runs: Path) -> None:
    found = json.loads(run("history", "--index", runs, "--json")[1])
    assert found["store"] == str(default_file())
    assert [one["run"] for one in found["results"]] == ["gripper-0", "drill", "gripper-1", "gripper-2", "gripper-3"]
    last = found["results"][-1]
    truth = CalibrationResult.load(Path(last["path"]))
    assert last["force_bias_N"] == truth.force_bias_N.tolist()
    # What arm and mounts hide is the same in all results of the cell.
    assert last["bias_sigma"]["torque_Nm"] == np.sqrt(np.diag(truth.covariance)[12:]).tolist()
    assert last["last_verification"]["change"] == "bias"
    assert found["results"][0]["last_verification"] is None
    assert {trend["quantity"]: trend["significant"] for trend in found["trends"]}["force bias"]
    assert json.loads(run("history", runs, "--json")[1])["store"] is None


def test_the_last_weighing_of_each_tool_is_a_line_and_days_are_a_table(run: Callable[..., Ran], runs: Path) -> None:
    assert "No weighings. Add them with `ftdrive weigh`" in run("history", "--weighings")[2]
    run("history", "--index", runs)
    days = [(datetime.now(UTC) - timedelta(days=27 - n)).date().isoformat() for n in range(28)]
    for n, day in enumerate(days):
        origin: dict[str, Any] = {"tool": "gripper", "arm_serial": "arm-1"}
        part = {"t_utc": f"{day}T10:15:00+00:00", "is_something": True, "mass_sigma_kg": 1e-3, "mass_kg": 0.2 + n / 1e3}
        lines: list[dict[str, Any]] = [part, {"refused": "cable"}, {"refused": "cable"}]
        append_weighings(user_folder("data") / FOLDER, origin, day, lines)
    run("history", "--index", user_folder("data") / FOLDER)
    (line,) = [one for one in run("history")[1].splitlines() if one.startswith("last weighing: ")]
    assert line == f"last weighing: gripper, {days[-1]} 10:15: 0.2270 ± 0.0010 kg; 1 part, 2 refused on this day"
    assert "last weighing" not in run("history", "--tool", "drill")[1]
    table = run("history", "--weighings")[1].splitlines()
    assert len(table) == 1 + 20
    assert table[-1].split()[:7] == [days[-1], "arm-1", "gripper", "1", "2", "cable", "10:15:00"]
    found = json.loads(run("history", "--weighings", "--json")[1])["weighings"]
    assert [one["day"] for one in found] == days[-20:]
    assert found[-1]["refusals"]["cable"] == 2
    assert json.loads(run("history", "--json")[1])["last_weighings"][0]["mass_kg"] == 0.227
    assert run("history", runs, "--weighings")[0] == 2


def test_rebuilt_a_deleted_run_is_gone_and_a_damaged_one_is_named(run: Callable[..., Ran], runs: Path) -> None:
    run("history", "--index", runs)
    (runs / "gripper-0" / "calibration.json").write_text("{")
    (runs / "drill" / "calibration.json").unlink()
    code, out, err = run("history", "--rebuild")
    # the damaged one is still there, and no reason to forget its result
    assert (code, len(out.splitlines())) == (0, 5 + 4 + 1)
    assert "left out: " in err
    assert "gripper-0/calibration.json" in err
    assert run("history", runs, "--rebuild")[0] == 2


def test_a_store_that_cannot_be_used_is_one_sentence(
    run: Callable[..., Ran], runs: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    Store().index(runs)
    with sqlite3.connect(default_file()) as connection:
        connection.execute(f"UPDATE ftdrive_schema SET version = {SCHEMA + 1}")
    connection.close()
    for arguments in (["history"], ["history", "--index", runs], ["diff", "abcd", "abcd"]):
        code, out, err = run(*arguments)
        assert (code, out) == (6, "")
        assert f"has version {SCHEMA + 1}, but this ftdrive uses version {SCHEMA}: install a newer ftdrive" in err
    monkeypatch.setenv("FTDRIVE_STORE_URL", "mysql://host/db")
    code, _, err = run("history")
    assert (code, "begins with mysql" in err) == (2, True)


def test_two_calibrations_are_compared_by_file_run_and_id(run: Callable[..., Ran], runs: Path) -> None:
    Store().index(runs)
    first, second = (CalibrationResult.load(runs / f"gripper-{n}" / "calibration.json") for n in (0, 3))
    by_id = json.loads(run("diff", first.id, second.id[:5], "--json")[1])
    by_path = json.loads(run("diff", runs / "gripper-0", runs / "gripper-3" / "calibration.json", "--json")[1])
    assert by_id["joint"] == by_path["joint"]
    assert by_id["joint"]["dof"] == 15
    assert by_id["significant"] is True
    assert by_id["groups"]["force_bias_N"]["p_value"] < 1e-6
    (bias_x,) = (one for one in by_id["parameters"] if one["name"] == "force_bias_N.x")
    assert bias_x["change"] == second.force_bias_N[0] - first.force_bias_N[0]
    assert bias_x["in_sigmas"] == pytest.approx(120 / np.sqrt(2), rel=0.05)
    code, out, _ = run("diff", first.id, second.id)
    assert code == 0
    assert out.splitlines()[-1].startswith("They differ significantly (chi2 ")
    scales = np.repeat([np.degrees(1), 1.0, 1.0, 1e3, 1.0], 3)  # of the rows, in °, N, N, mm, N·m
    for line, one, scale in zip(out.splitlines()[4:19], by_id["parameters"], scales, strict=True):
        assert float(line[34:46]) == pytest.approx(scale * one["sigma"], rel=0.06)
        change = 0.0 if "same" in line else float(line[22:34])
        assert change == pytest.approx(scale * one["change"], abs=0.06 * scale * one["sigma"])
    assert out.splitlines()[-1].endswith("): force bias.")
    assert run("diff", first.id, first.id)[1].splitlines()[-1] == "The calibrations are the same."


@pytest.mark.parametrize(
    ("text", "code", "words"),
    [
        ("nothing", 2, "neither a file nor an id"),
        ("abc", 2, "at least 4 digits"),
        ("0000", 2, "has no result 0000"),
        ("notes.txt", 6, "not valid JSON"),
    ],
)
def test_what_is_no_calibration_is_named(run: Callable[..., Ran], text: str, code: int, words: str) -> None:
    Path("notes.txt").write_text("notes")
    found, out, err = run("diff", text, "abcd")
    assert (found, out) == (code, "")
    assert words in err


def calibrate_with(monkeypatch: pytest.MonkeyPatch, folder: Path) -> None:
    loaded = CalibrationResult.load(folder / "calibration.json")
    outcome = SimpleNamespace(run=Run(folder), result=loaded, drift=None)
    monkeypatch.setattr("ftdrive.commands.calibrate.run_calibration", lambda *_: outcome)


def test_a_calibration_never_fails_for_the_store_and_is_caught_up(
    run: Callable[..., Ran], runs: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The store is locked during one calibration, and comes back before the next."""
    cell = '[robot]\nhost = "h"\n[sensor]\nurl = "ati-can://can0"\n'
    (tmp_path / "ftdrive.toml").write_text(f'format = "ftdrive.config/1"\n{cell}[store]\nurl = "sqlite:///s.sqlite"\n')
    monkeypatch.setattr(Store.__init__, "__kwdefaults__", {"wait_s": 0.05})
    store = Store("sqlite:///s.sqlite")
    store.index(runs / "gripper-0")
    other = sqlite3.connect("s.sqlite")
    other.execute("BEGIN EXCLUSIVE")
    calibrate_with(monkeypatch, runs / "gripper-1")
    code, out, err = run("calibrate")
    assert (code, out.endswith("calibration.json\n")) == (0, True)
    assert "The run is saved, but not yet in the history, because the store s.sqlite cannot be" in err
    assert "(database is locked)" in err
    other.close()
    calibrate_with(monkeypatch, runs / "gripper-2")
    code, _, err = run("calibrate")
    assert (code, "history" in err) == (0, False)
    assert len(store.results()) == 5  # everything in the folder of the run
    assert not default_file().exists()


@pytest.mark.parametrize("command", [["record", "-o", "a.csv"], ["weigh"]])
@pytest.mark.parametrize(
    ("more", "words"),
    [
        (["--tool", "gripper", "--calibration", "."], "--calibration and --tool are mutually exclusive"),
        (["--tool", "gripper", "--simulate"], "--tool cannot be combined with --simulate"),
        (["--robot", "10.0.0.2", "--simulate"], "--robot cannot be combined with --simulate"),
    ],
)
def test_options_that_name_another_cell_or_calibration_are_refused(
    run: Callable[..., Ran], command: list[str], more: list[str], words: str
) -> None:
    code, _, err = run(*command, *more)
    assert (code, words in err) == (2, True)
