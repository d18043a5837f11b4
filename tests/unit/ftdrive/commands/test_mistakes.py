"""Lines that a user may mistype: each is answered with a line, an option or a value to type, never with a traceback."""

import importlib.util
import json
import shlex
import sys
import zipfile
from collections.abc import Iterator
from pathlib import Path

import click
import pytest

from ftdrive import cli, mistakes
from ftdrive.terminal.console import messages
from tests.unit.ftdrive.recorded import calibration, dataset

# The line, its exit code, and what the answer has to type instead.
TYPOS = [
    ("hlep", 2, "'help'"),
    ("clibrate --simulate", 2, "'calibrate'"),
    ("slove run", 2, "'solve'"),
    ("convrt rec.csv out.csv", 2, "'convert'"),
    ("help lvie", 2, "'live'"),
    ("--verion", 2, "--version"),
    ("live --calibratoin run", 2, "--calibration"),
    ("live --calib run", 2, "--calibration"),
    ("solve run --outpt x.json", 2, "--output"),
    ("devices --prob can0", 2, "--probe"),
    ("--simulate live", 2, "ftdrive live --simulate"),
    ("config --origin", 2, "ftdrive config show --origin"),
    ("fleet statu", 2, "status"),
    ("doctor --sensor can0", 2, "ati-can://can0"),
    ("live --raw --sensor ati-cam://can0", 2, "ati-can://"),
    ("live --raw --sensor acme-usb://1", 2, "ati-serial"),
    ("live --simulate --sensor acme-usb://1", 2, "ftdrive live --sensor acme-usb://1 --raw"),
    ("doctor --simulate --sensor emulated://cam", 2, "emulated://can"),
    ("solve runn", 2, "'run'"),
    ("live --replay rec.cvs", 2, "'rec.csv'"),
    ("solve nowhere", 2, "ftdrive history"),
    ("live --raw --sensor ati-serial:///dev/nothing", 3, "plug it in"),
]
MISSING = [
    ("live", 2, "--calibration PATH"),
    ("live --raw", 2, "--sensor URL"),
    ("live --replay", 2, "ftdrive live --replay RUN|RECORDING"),
    ("-v doctor --robot", 2, "ftdrive doctor --robot HOST"),
    ("doctor", 2, "--robot"),
    ("weigh", 2, "--calibration PATH"),
    ("stream", 2, "--calibration PATH"),
    ("serve-load", 2, "--calibration PATH"),
    ("verify", 2, "--calibration PATH"),
    ("calibrate", 2, "ftdrive init"),
    ("plan", 2, "--model"),
    ("solve", 2, "--simulate"),
    ("report", 2, "--simulate"),
    ("replay", 2, "--simulate"),
    ("push", 2, "--simulate"),
    ("bundle", 2, "--simulate"),
    ("convert", 2, "ftdrive convert IN -o NEW.csv"),
    ("convert rec.csv", 2, "ftdrive convert rec.csv -o NEW.csv"),
    ("compensate", 2, "ftdrive compensate RECORDING"),
    ("compensate poses.csv", 2, "--calibration PATH"),
    ("compensate --wrench poses.csv", 2, "ftdrive compensate --wrench poses.csv --orientation-file FILE --calibration"),
    ("record", 2, "ftdrive record --output FILE --calibration PATH"),
    ("record --simulate", 2, "ftdrive record --simulate --output FILE"),
    ("diff", 2, "ftdrive diff A B"),
    ("diff run", 2, "ftdrive diff run B"),
    ("transcript play", 2, "--simulate"),
    ("transcript record", 2, "ftdrive transcript record --output FILE --sensor URL"),
    ("loads check", 2, "ftdrive loads check MASS --calibration PATH"),
    ("completion", 2, "bash|zsh|fish"),
]
KINDS = [
    ("replay rec.csv", 6, "ftdrive live --replay rec.csv"),
    ("-v -q replay rec.csv", 6, "ftdrive live --replay rec.csv"),
    ("replay calibration.json", 6, "ftdrive live --calibration calibration.json"),
    ("replay runs", 6, "ftdrive replay runs/2"),
    ("replay run/run.json", 6, "ftdrive replay run"),
    ("replay empty", 6, "ftdrive history"),
    ("live rec.csv", 2, "ftdrive live --replay rec.csv"),
    ("live --replay run.zip --calibration run", 6, "ftdrive replay run.zip"),
    ("live --replay calibration.json --calibration run", 6, "ftdrive live --calibration calibration.json"),
    ("live --calibration rec.csv --simulate", 6, "ftdrive live --replay rec.csv"),
    ("live --calibration plan.json --simulate", 6, "ftdrive calibrate --plan plan.json"),
    ("convert calibration.json out.csv", 6, "ftdrive report calibration.json"),
    ("convert run out.csv", 6, "ftdrive solve run"),
    ("convert poses.csv -o out.csv", 6, "ftdrive compensate poses.csv --calibration PATH"),
    ("compensate cell.toml", 6, "ftdrive doctor --config cell.toml"),
    ("compensate run", 6, "ftdrive solve run"),
    ("compensate rec.csv --calibration cell.toml", 6, "ftdrive calibrate --config cell.toml"),
    ("solve calibration.json", 6, "ftdrive report calibration.json"),
    ("solve plan.json", 6, "ftdrive export plan plan.json"),
    ("solve sensor.jsonl", 6, "ftdrive transcript play sensor.jsonl"),
    ("report rec.csv", 6, "ftdrive compensate rec.csv"),
    ("push rec.csv", 6, "ftdrive live --replay rec.csv"),
    ("diff run rec.csv", 6, "ftdrive live --replay rec.csv"),
    ("bundle run --transcript cell.toml", 2, "ftdrive doctor --config cell.toml"),
    ("export urscript run", 2, "ftdrive export calibration run"),
    ("live --calibration begun --simulate", 6, "ftdrive solve begun --output begun/calibration.json"),
    ("live --replay run", 2, "give --calibration run"),
    ("diff run begun", 6, "ftdrive solve begun --output begun/calibration.json"),
    ("bundle rec.csv", 2, "ftdrive convert rec.csv -o NEW.csv"),
    ("plan cell.toml", 2, "ftdrive plan --config cell.toml"),
    ("loads rec.csv", 2, "ftdrive compensate rec.csv"),
    ("transcript play rec.csv", 6, "ftdrive live --replay rec.csv"),
    ("calibrate --plan run", 2, "ftdrive solve run"),
    ("calibrate --simulate --resume empty", 6, "ftdrive calibrate --runs empty"),
    ("fleet add cell.toml", 2, "ftdrive doctor --config cell.toml"),
    ("demo run", 2, "ftdrive solve run"),
]
VALUES = [
    ("solve run --method mll", 2, "'ml'"),
    ("calibrate --set A+Z", 2, "A+E"),
    ("plan --model ur99", 2, "UR5e"),
    ("plan --model ur5e --tool 1:2", 2, "3 or 5 numbers"),
    ("live --simulate --axes tool", 2, "'tcp'"),
    ("live --simulate --about here", 2, "--about"),
    ("live --raw --simulate --view", 2, "leave one of the two out"),
    ("live --speed 2", 2, "--speed is only for --replay"),
    ("live --raw --simulate --stages bias=false", 2, "--stages cannot be combined with --raw"),
    ("record -o x.txt --simulate", 2, ".mcap"),
    ("record -o x.csv --simulate --duration ten", 2, "60s"),
    ("convert rec.csv calibration.json", 2, "choose another name"),
    ("stream --port 99999", 2, "65535"),
    ("serve-load --simulate --first 3", 2, "24 to 33"),
    ("stream --simulate --udp here", 2, "127.0.0.1:9870"),
    ("completion tcsh", 2, "'bash'"),
    ("devices --probe nothing0", 3, "ftdrive devices"),
]
EXTRAS = [
    ("plan --simulate --png a.png", 2, "viz"),
    ("plan --simulate --view", 2, "viz"),
    ("calibrate --simulate --view", 2, "viz"),
    ("live --simulate --view", 2, "viz"),
    ("report --simulate", 2, "report"),
    ("fleet status --html a.html", 2, "fleet"),
    ("convert rec.csv out.mcap", 2, "record"),
    ("ros2", 2, "ros2"),
]
# A file of the right kind that has another fault: the kind is not the cause.
OTHER_FAULTS = [
    "solve rec.csv",
    "live --replay rec.csv",
    "compensate rec.csv",
    "report run",
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


def _read_parameters(command: click.Command, words: tuple[str, ...] = ()) -> Iterator[tuple[str, click.Parameter]]:
    """Yield each parameter that is an existing file or folder, with its place."""
    for one in command.params:
        if isinstance(one.type, click.Path) and one.type.exists:
            yield one.opts[0] if isinstance(one, click.Option) else " ".join(words), one
    if isinstance(command, click.Group):
        for name in command.list_commands(click.Context(command)):
            if (sub := command.get_command(click.Context(command), name)) is not None:
                yield from _read_parameters(sub, (*words, name))


def test_each_place_of_a_file_has_its_kinds() -> None:
    known = set().union(*(kind.places for kind in mistakes.KINDS.values()))
    assert {place for place, _ in _read_parameters(cli.cli)} <= known
    for kind in mistakes.KINDS.values():
        for line in kind.lines:
            command: click.Command | None = cli.cli
            for word in shlex.split(line.format("FILE")):
                if isinstance(command, click.Group):
                    command = command.get_command(click.Context(command), word)
                    assert command is not None, line
                elif word.startswith("-"):
                    assert command is not None
                    assert any(word in one.opts for one in command.params), line
