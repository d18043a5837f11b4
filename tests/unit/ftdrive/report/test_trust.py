"""What a report says of age and last verification, whatever the state of the store."""

import json
import sqlite3
from collections.abc import Callable
from datetime import timedelta
from pathlib import Path
from typing import Any

import pytest
from click.testing import CliRunner, Result

from ftcalib import CalibrationResult
from ftdrive.cli import cli
from ftdrive.report.page import render_page
from ftdrive.report.subject import trust_facts
from ftdrive.store.database import default_file
from ftdrive.store.store import Store
from tests.unit.ftdrive.store.run_folders import FIRST, new_run, result, verified

NOW = FIRST + timedelta(days=10)


@pytest.fixture
def calibrated(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path / "data"))
    folder = tmp_path / "runs" / "calibrate"
    folder.mkdir(parents=True)
    result(0).save(folder / "calibration.json")
    return folder


def known(source: Path, store_url: Callable[[], str | None] = lambda: None) -> dict[str, Any]:
    loaded = CalibrationResult.load(source / "calibration.json" if source.is_dir() else source)
    return trust_facts(loaded, source, store_url, NOW)


def test_the_later_of_run_folders_and_store_counts(calibrated: Path, tmp_path: Path) -> None:
    assert known(calibrated) == {"words": "10 d old, not verified", "last_verification": None, "store_error": ""}
    verified(new_run(tmp_path / "runs", "verify-1"), result(0).id, 2)
    for source in (calibrated, calibrated / "calibration.json"):
        found = known(source)
        assert found["words"] == "10 d old, verified 8 d ago"
        assert found["last_verification"]["path"] == str(tmp_path / "runs/verify-1/verification.json")
    verified(new_run(tmp_path / "elsewhere", "verify-2"), result(0).id, 9.5, passed=False)
    Store().index(tmp_path / "elsewhere")
    assert known(calibrated)["words"] == "10 d old, VERIFICATION FAILED 12 h ago (bias)"
    verified(new_run(tmp_path / "runs", "verify-3"), result(0).id, 9.75)
    verified(new_run(tmp_path / "runs", "verify-4"), result(1).id, 9.9, passed=False)
    assert known(calibrated)["words"] == "10 d old, verified 6 h ago"


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
