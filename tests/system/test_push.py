"""`ftdrive push` to an emulated cell, and back."""

import json
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from ftdrive.cell.emulated import Station
from tests.system.command_line import CommandLine

pytestmark = pytest.mark.slow

SENSOR_KG, HEIGHT_MM = 0.25, 40.0


@pytest.fixture
def run(demo: dict[str, Any], tmp_path: Path) -> Path:
    """A copy of the run of the demo, to which receipts are added."""
    folder = tmp_path / "run"
    shutil.copytree(demo["run"], folder)
    return folder


@pytest.fixture
def station(run: Path, ftdrive: CommandLine) -> Iterator[Station]:
    """The cell of that run, described by a file as a user would."""
    made_by = json.loads((run / "run.json").read_text())["station"]
    with Station(made_by["sensor"], made_by["options"]) as station:
        describe(station, ftdrive)
        yield station


def describe(station: Station, ftdrive: CommandLine) -> None:
    path = ftdrive.connect(station)
    sensor = f"[sensor]\nmass_kg = {SENSOR_KG}\nheight_mm = {HEIGHT_MM}\n"
    path.write_text(path.read_text().replace("[sensor]\n", sensor))


def payload(station: Station) -> tuple[float, list[float]]:
    state = station.control(do="state")
    assert state["bad_inputs"] == []
    return state["payload_kg"], state["payload_cog_m"]


def test_a_payload_is_pushed_read_back_and_restored(station: Station, run: Path, ftdrive: CommandLine) -> None:
    before = payload(station)
    tried = ftdrive.run("push", run, "--config", "cell.toml", "--dry-run")
    assert tried.returncode == 0, tried.stderr
    assert "nothing was sent" in tried.stdout
    declined = ftdrive.run("push", run, "--config", "cell.toml", typed="no\n")
    assert declined.returncode == 130
    assert payload(station) == before
    assert not list(run.glob("push*"))

    pushed = ftdrive.run("push", run, "--config", "cell.toml", typed="push\nPUSH\n")
    assert pushed.returncode == 0, pushed.stderr
    assert "'push' is not PUSH: type it in capital letters" in pushed.stderr
    assert "zeroes the arm's own force sensor" in pushed.stderr
    assert f"undo: ftdrive push --restore {run / 'push.json'}" in pushed.stdout
    truth_kg = station.truth["mass_kg"]
    mass_kg, com_m = payload(station)
    assert mass_kg == pytest.approx(truth_kg + SENSOR_KG, abs=0.05 * truth_kg)  # 3 sigma of the sensor's scale
    receipt = json.loads((run / "push.json").read_text())
    assert receipt["read_back"]["mass_kg"] == mass_kg
    assert receipt["read_back"]["p_flange_com_m"] == com_m == pytest.approx(receipt["new"]["p_flange_com_m"])
    assert receipt["calibration"]["id"] == json.loads((run / "calibration.json").read_text())["id"]

    restored = ftdrive.run("push", "--restore", run, "--config", "cell.toml", "--json", typed="PUSH\n")
    assert restored.returncode == 0, restored.stderr
    proposal, question, answer = map(json.loads, restored.stdout.splitlines())
    assert proposal["new"]["mass_kg"] == pytest.approx(before[0])
    assert question["answers"] == ["PUSH"]
    assert answer["file"] == str(run / "push-2.json")
    assert payload(station) == before


def test_what_cannot_be_pushed_is_refused_with_the_reason(station: Station, run: Path, ftdrive: CommandLine) -> None:
    def refused(*arguments: str | Path) -> tuple[int, str]:
        outcome = ftdrive.run("push", *arguments, "--config", "cell.toml", typed="PUSH\n")
        return outcome.returncode, outcome.stderr

    station.control(do="remote-control", on=False)
    code, words = refused(run)
    assert (code, "local control" in words) == (7, True)
    station.control(do="remote-control", on=True)
    station.control(do="foreign-program", seconds=600)
    code, words = refused(run)
    assert (code, "another program is active on the controller" in words) == (7, True)
    station.control(do="dashboard-stop")
    described = ftdrive.folder / "cell.toml"
    described.write_text(described.read_text().replace(f"mass_kg = {SENSOR_KG}\n", ""))
    code, words = refused(run / "calibration.json")
    assert (code, "[sensor] mass_kg is not set" in words) == (2, True)
    assert refused("--restore", run)[0] == 6
    assert refused()[0] == 2
    assert not list(run.glob("push*"))
