"""Lines that a user may mistype: each is answered with a line, an option or a value to type, never with a traceback."""

import importlib.util
import json
import shlex
import sys
import zipfile
from pathlib import Path

import pytest

from ftdrive import cli
from ftdrive.terminal.console import messages
from tests.unit.ftdrive.recorded import calibration, dataset

# The line, its exit code, and what the answer has to type instead.
TYPOS = [
    ("hlep", 2, "'help'"),
    ("clibrate --simulate", 2, "'calibrate'"),
    ("--verion", 2, "--version"),
    ("live --calibratoin run", 2, "--calibration"),
    ("solve run --outpt x.json", 2, "--output"),
    ("--simulate live", 2, "ftdrive live --simulate"),
    ("doctor --sensor can0", 2, "ati-can://can0"),
    ("live --simulate --sensor acme-usb://1", 2, "ftdrive live --sensor acme-usb://1 --raw"),
    ("live --replay rec.cvs", 2, "'rec.csv'"),
    ("solve nowhere", 2, "ftdrive history"),
    ("live --raw --sensor ati-serial:///dev/nothing", 3, "plug it in"),
]
MISSING = [
    ("live", 2, "--calibration PATH"),
    ("live --replay", 2, "ftdrive live --replay RUN|RECORDING"),
    ("doctor", 2, "--robot"),
    ("calibrate", 2, "ftdrive init"),
    ("replay", 2, "--simulate"),
    ("compensate poses.csv", 2, "--calibration PATH"),
    ("compensate --wrench poses.csv", 2, "ftdrive compensate --wrench poses.csv --orientation-file FILE --calibration"),
    ("record", 2, "ftdrive record --output FILE --calibration PATH"),
]
KINDS = [
    ("replay rec.csv", 6, "ftdrive live --replay rec.csv"),
    ("replay runs", 6, "ftdrive replay runs/2"),
    ("replay empty", 6, "ftdrive history"),
    ("live --replay run.zip --calibration run", 6, "ftdrive replay run.zip"),
    ("live --calibration rec.csv --simulate", 6, "ftdrive live --replay rec.csv"),
    ("convert calibration.json out.csv", 6, "ftdrive report calibration.json"),
    ("solve calibration.json", 6, "ftdrive report calibration.json"),
    ("export urscript run", 2, "ftdrive export calibration run"),
    ("live --calibration begun --simulate", 6, "ftdrive solve begun --output begun/calibration.json"),
    ("live --replay run", 2, "give --calibration run"),
    ("calibrate --simulate --resume empty", 6, "ftdrive calibrate --runs empty"),
]
VALUES = [
    ("solve run --method mll", 2, "'ml'"),
    ("calibrate --set A+Z", 2, "A+E"),
    ("plan --model ur5e --tool 1:2", 2, "3 or 5 numbers"),
    ("live --simulate --about here", 2, "--about"),
    ("live --raw --simulate --view", 2, "leave one of the two out"),
    ("serve-load --simulate --first 3", 2, "24 to 33"),
]
EXTRAS = [
    ("plan --simulate --png a.png", 2, "viz"),
    ("report --simulate", 2, "report"),
    ("convert rec.csv out.mcap", 2, "record"),
    ("ros2", 2, "ros2"),
]
# A file of the right kind that has another fault: the kind is not the cause.
OTHER_FAULTS = [
    "solve rec.csv",
    "live --replay rec.csv",
    "transcript play sensor.jsonl",
]


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Make a file of each kind, most of them only begun."""
    folder = tmp_path_factory.mktemp("files")
    for run in ("run", "runs/1", "runs/2"):
        (folder / run).mkdir(parents=True)
        (folder / run / "run.json").write_text('{"format": "ftdrive.run/1"}')
        calibration().save(folder / run / "calibration.json")
    calibration().save(folder / "calibration.json")
    dataset().save(folder / "dataset.json")
    (folder / "begun").mkdir()
    (folder / "begun" / "run.json").write_text('{"format": "ftdrive.run/1"}')
    (folder / "empty").mkdir()
    (folder / "rec.csv").write_text("# ftdrive.recording/1: raw\n")
    (folder / "plan.json").write_text('{"format": "ftdrive.plan/2"}')
    (folder / "sensor.jsonl").write_text('{"format": "ftdrive.transcript/1"}\n')
    (folder / "cell.toml").write_text('[robot]\nhost = "192.0.2.1"\n')
    (folder / "poses.csv").write_text(
        "r11,r12,r13,r21,r22,r23,r31,r32,r33,fx,fy,fz,tx,ty,tz\n" + "1,0,0,0,1,0,0,0,1,0,0,9,0,0,0\n" * 8
    )
    with zipfile.ZipFile(folder / "run.zip", "w") as archive:
        archive.writestr("bundle.json", json.dumps({"format": "ftdrive.bundle/1"}))
    return folder


@pytest.fixture
def _here(files: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(files)
    for name in ("XDG_DATA_HOME", "XDG_STATE_HOME", "XDG_CONFIG_HOME"):
        monkeypatch.setenv(name, str(tmp_path))
    monkeypatch.delenv("UV_RUN_RECURSION_DEPTH", raising=False)
    # a line with -v or -q changes them
    monkeypatch.setattr(messages, "quiet", messages.quiet)
    monkeypatch.setattr(messages, "verbose", messages.verbose)
    monkeypatch.setattr(
        "ftdrive.cell.emulated.Station.__enter__", lambda _: pytest.fail("an emulated cell has started")
    )


@pytest.fixture
def _without_extras(monkeypatch: pytest.MonkeyPatch) -> None:
    find = importlib.util.find_spec
    extras = {"jinja2", "matplotlib", "uplot"}
    monkeypatch.setattr(importlib.util, "find_spec", lambda name, *_: None if name in extras else find(name))
    for name in ("mcap", "rclpy"):
        monkeypatch.setitem(sys.modules, name, None)


@pytest.mark.usefixtures("_here")
@pytest.mark.parametrize(("line", "code", "to_type"), [*TYPOS, *MISSING, *KINDS, *VALUES])
def test_a_mistake_is_answered_with_what_to_type(
    line: str, code: int, to_type: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert cli.run(shlex.split(line)) == code
    assert to_type in capsys.readouterr().err


@pytest.mark.usefixtures("_here", "_without_extras")
@pytest.mark.parametrize(("line", "code", "extra"), EXTRAS)
def test_a_missing_extra_is_answered_with_its_command(
    line: str, code: int, extra: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert cli.run(shlex.split(line)) == code
    answer = capsys.readouterr().err
    assert "install" in answer or "sync" in answer
    assert extra in answer.rpartition("`")[0].rpartition("`")[2]


@pytest.mark.usefixtures("_here")
@pytest.mark.parametrize("line", OTHER_FAULTS)
def test_a_file_of_the_right_kind_is_no_mistake(line: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.run(shlex.split(line)) in {2, 6, 7}
    assert "does not take" not in capsys.readouterr().err


@pytest.mark.usefixtures("_here")
def test_a_name_of_a_file_cannot_be_a_command(files: Path, capsys: pytest.CaptureFixture[str]) -> None:
    name = "a\nftdrive push x.csv"
    (files / name).write_text("# ftdrive.recording/1")
    assert cli.run(["replay", name]) == 6
    assert "--replay" not in capsys.readouterr().err
    (files / name).unlink()
