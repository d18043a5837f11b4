"""`ftdrive export calibration` and `ftdrive export formats`: options, the run's configuration, JSON, files."""

import json
from pathlib import Path

import pytest
import yaml
from click.testing import CliRunner, Result

from ftdrive.cli import cli
from ftdrive.errors import ConfigError, exit_code
from ftdrive.exports.formats import FORMATS
from ftdrive.runs.run import Run
from tests.unit.ftdrive.exports.example import calibration, tilted
from tests.unit.ftdrive.store.run_folders import new_run, verified


def export(*arguments: object) -> Result:
    return CliRunner().invoke(cli, ["export", *map(str, arguments)])


@pytest.fixture
def saved(tmp_path: Path) -> Path:
    calibration().save(tmp_path / "calibration.json")
    return tmp_path / "calibration.json"


@pytest.fixture
def run(tmp_path: Path) -> Path:
    config = {"sensor": {"url": "x", "height_mm": 40.0, "mass_kg": 0.0}}
    folder = Run.create(tmp_path, "tool", {"config": config}).folder
    calibration().save(folder / "calibration.json")
    return folder


def height_m(outcome: Result) -> float:
    words = outcome.stdout.split()
    return float(words[words.index("--z") + 1])


def test_formats_are_listed_for_people_and_programs() -> None:
    answer = json.loads(export("formats", "--json").stdout)
    assert answer["schema_version"] == 1
    assert [one["name"] for one in answer["formats"]] == list(FORMATS)
    assert answer["formats"][0].keys() >= {"name", "description", "file"}
    assert len(export("formats").stdout.splitlines()) == len(FORMATS)


def test_a_file_is_new_and_complete_or_absent(saved: Path, tmp_path: Path) -> None:
    path = tmp_path / "ft.yaml"
    first = export("calibration", saved, "--format", "admittance", "-o", path)
    assert (first.exit_code, first.stdout) == (0, f" Saved {path}\n")
    text = path.read_text()
    again = export("calibration", saved, "--format", "admittance", "-o", path)
    assert isinstance(again.exception, ConfigError)
    assert path.read_text() == text
    tilted(3).save(tmp_path / "tilted.json")
    refused = export("calibration", tmp_path / "tilted.json", "--format", "admittance", "-o", tmp_path / "new.yaml")
    assert refused.exception is not None
    assert exit_code(refused.exception) == 7
    assert not list(tmp_path.glob("new*"))
    limit = ("--max-force-error", "1.1", "-o", tmp_path / "new.yaml")
    assert export("calibration", tmp_path / "tilted.json", "--format", "admittance", *limit).exit_code == 0


def test_height_and_mass_come_from_the_run_unless_an_option_has_them(run: Path, saved: Path) -> None:
    arguments = "calibration", run, "--format", "static-transform"
    assert height_m(export(*arguments)) == pytest.approx(0.04)
    assert height_m(export(*arguments, "--height", "33")) == pytest.approx(0.033)
    payload = yaml.safe_load(export("calibration", run, "--format", "franka").stdout)
    assert payload["mass"] == pytest.approx(2.0)
    assert payload["F_x_Cload"][2] == pytest.approx(0.09)
    alone = export("calibration", saved, "--format", "static-transform")
    assert isinstance(alone.exception, ConfigError)


def test_three_numbers_are_wanted_for_a_place(saved: Path) -> None:
    outcome = export("calibration", saved, "--format", "franka", "--height", "1", "--sensor-com", "0,0")
    assert isinstance(outcome.exception, ConfigError)
    assert "--sensor-com is '0,0'" in str(outcome.exception)


def test_the_last_verification_stands_in_the_file_and_a_failed_one_in_a_note(run: Path, tmp_path: Path) -> None:
    assert "not verified" in export("calibration", run, "--format", "ft-tools").stdout.splitlines()[0]
    document = json.loads(export("calibration", run, "--format", "json").stdout)
    assert document["verification"] is None
    verified(new_run(tmp_path, "verify"), calibration().id, passed=False)
    outcome = export("calibration", run, "--format", "ft-tools")
    assert "VERIFICATION FAILED 2026-03-02" in outcome.stdout.splitlines()[0]
    assert "failed: the force bias has changed by 0.5 N" in " ".join(outcome.stderr.split())
    found = json.loads(export("calibration", run, "--format", "json").stdout)["verification"]
    assert (found["passed"], found["change"]) == (False, "bias")
