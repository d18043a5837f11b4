"""What a report says of age and last verification, whatever the state of the store."""

import json
import sqlite3
from pathlib import Path

import pytest
from click.testing import CliRunner, Result

from ftdrive.cli import cli
from ftdrive.report.page import render_page
from ftdrive.store.database import default_file
from ftdrive.store.store import Store
from tests.unit.ftdrive.store.run_folders import new_run, result, verified


@pytest.fixture
def calibrated(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path / "data"))
    folder = tmp_path / "runs" / "calibrate"
    folder.mkdir(parents=True)
    result(0).save(folder / "calibration.json")
    return folder


def report(*arguments: str | Path) -> Result:
    return CliRunner().invoke(cli, ["report", *map(str, arguments)])


def test_a_failed_verification_is_in_every_format_and_changes_the_next_step(
    calibrated: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("ftdrive.report.figures.draw_figure", lambda *_: "")
    verified(new_run(tmp_path / "runs", "verify"), result(0).id, passed=False)
    path = calibrated / "calibration.json"
    document = json.loads(report(path, "--format", "json").stdout)
    assert document["trust"]["last_verification"]["reason"] == "the force bias has changed by 0.5 N"
    assert "accept the proposed update" in document["next_step"]
    text = render_page(document)
    assert "VERIFICATION FAILED" in text
    assert "the force bias has changed by 0.5 N" in text


@pytest.mark.parametrize("trouble", ["damaged store", "locked store", "damaged configuration"])
def test_a_store_that_cannot_be_read_costs_a_sentence(
    trouble: str, calibrated: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    if trouble == "damaged store":
        default_file().parent.mkdir(parents=True)
        default_file().write_bytes(b"not a database" * 100)
    elif trouble == "locked store":
        verified(new_run(tmp_path / "elsewhere", "verify"), result(0).id)
        Store().index(tmp_path / "elsewhere")
        locker = sqlite3.connect(default_file())
        locker.execute("BEGIN EXCLUSIVE")
        monkeypatch.setattr(Store.__init__, "__kwdefaults__", {"wait_s": 0.01})
    else:
        Path("ftdrive.toml").write_text("[store]\nurl = 5")
    outcome = report(calibrated / "calibration.json", "--format", "json")
    assert outcome.exit_code == 0, outcome.output
    document = json.loads(outcome.stdout)["trust"]
    assert document["store_error"]
    assert "a later verification may be missing" in " ".join(outcome.stderr.split())
    assert document["words"].endswith("not verified")
