"""Every command of the tree works without any hardware, and prints its findings as one JSON object."""

import importlib
import json
import subprocess
import sys
from collections.abc import Callable, Iterator, Mapping
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import click
import pytest
from click.testing import CliRunner

from ftdrive.cli import cli
from ftdrive.errors import ConfigError
from ftdrive.recording import Recorder
from tests.system.command_line import CommandLine
from tests.unit.ftdrive.recorded import block, calibration, info


def names(command: click.Command, path: tuple[str, ...] = ()) -> Iterator[str]:
    """Walk the tree down to what can be called."""
    if not isinstance(command, click.Group):
        yield " ".join(path)
        return
    context = click.Context(command)
    for name in command.list_commands(context):
        child = command.get_command(context, name)
        assert child is not None
        yield from names(child, (*path, name))


NEEDED: Mapping[str, tuple[str, ...]] = {
    "init": ("--yes", "--height", "33", "--tool", "0:60:90"),
    "calibrate": ("--minimal", "--yes"),
    "live": ("--once",),
    "weigh": ("--once",),
    "export calibration": ("--format", "json"),
    "export plan": ("--format", "csv"),
    "report": ("--format", "json"),
    "record": ("--output", "a.csv", "--count", "500"),
    "verify": ("--yes", "--quick", "--max-force", "0.5"),
    "transcript record": ("--output", "sensor.jsonl", "--duration", "0.5"),
}
"""What a command cannot do without; any other must work with --simulate and --json alone."""

FLEET = tuple(name for name in names(cli) if name.startswith("fleet "))
OFFLINE = ("completion", "convert", "compensate", "history", "diff", "export formats", *FLEET)
"""They know no cell, or many."""

REHEARSED = ("bundle", "replay", "report", "solve", "export calibration")
"""They calibrate an emulated cell first, as do live, weigh, push (test_push.py) and demo (test_demo.py)."""

GUIDED = ("calibrate", "verify")
"""They print their events too: test_session.py and test_verify.py."""

ELSEWHERE = {"demo", "ros2", "serve-load", "verify", "stream", "weigh", "fleet serve", "fleet verify"}
ELSEWHERE |= {"loads check", "loads drop", "loads show", "loads solve"}
"""Long sessions, servers without an answer, and a question at a terminal: see their tests."""

SHOWN: Mapping[str, Callable[[dict[str, Any]], bool]] = {
    "bundle": lambda answer: answer["file"].endswith(".zip") and not answer["left_out"],
    "calibrate": lambda answer: answer["verdict"] != "rejected",
    "config show": lambda answer: (
        answer["config"]["robot"]["model"] == "UR5e" and answer["config"]["workcell"]["measured"]
    ),
    "devices": lambda answer: len(answer["serial"]) == 2,
    "doctor": lambda answer: all(check["state"] != "failed" for check in answer["checks"]),
    "export calibration": lambda answer: json.loads(answer["text"])["id"] == answer["calibration"],
    "export plan": lambda answer: answer["text"].startswith("# ftdrive.targets/1") and answer["file"] is None,
    "init": lambda answer: answer["config"]["tool"]["cylinders_mm"] == [[0, 60, 90]] and "UR5e" in answer["robot"],
    "live": lambda answer: sum(f**2 for f in answer["compensated"]["force_N"]) ** 0.5 < 0.2,
    "plan": lambda answer: answer["description"]["model"] == "UR5e" and answer["poses"] == 24,
    "record": lambda answer: answer["samples"] == 500,
    "replay": lambda answer: answer["n_poses"] >= 6,
    "report": lambda answer: answer["result"]["n_poses"] >= 6 and answer["tour"]["emulated"] and answer["file"] is None,
    "solve": lambda answer: answer["n_poses"] >= 6,
    "transcript play": lambda answer: answer["played"]["samples"] > 1000,
    "weigh": lambda answer: not answer["is_something"] and answer["refused"] is None,
    "verify": lambda answer: answer["passed"] and len(answer["poses"]) == 2,
    "transcript record": lambda answer: answer["recorded"]["error"] is None,
}


@pytest.mark.parametrize("command", ["", *names(cli)])
def test_help_fits_into_80_columns(command: str) -> None:
    outcome = CliRunner().invoke(cli, [*command.split(), "--help"], terminal_width=80)
    assert outcome.exit_code == 0
    assert max(map(len, outcome.stdout.splitlines())) <= 80


@pytest.mark.parametrize(
    "arguments",
    [
        ("doctor", "--simulate", "--mass-kg", "nan"),
        ("export", "plan", "--simulate", "--format", "urscript", "--dwell", "nan"),
        ("solve", "--simulate", "--level-deg", "nan"),
        ("transcript", "record", "--simulate", "-o", "sensor.jsonl", "--duration", "nan"),
        ("demo", "--seed", "-1"),
    ],
)
def test_a_number_of_no_use_is_refused_before_any_work(
    arguments: tuple[str, ...], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    outcome = CliRunner().invoke(cli, arguments)
    assert outcome.exit_code == 2
    assert f"Invalid value for '{arguments[-2]}'" in outcome.stderr
    assert outcome.stdout == ""
    assert not list(tmp_path.iterdir())


@pytest.mark.skipif(sys.platform != "linux", reason="needs /dev/full")
def test_a_full_disk_is_no_crash() -> None:
    command = [sys.executable, "-m", "ftdrive", "config", "show", "--json"]
    with Path("/dev/full").open("w") as full:
        outcome = subprocess.run(command, stdout=full, stderr=subprocess.PIPE, text=True, check=False)
    assert outcome.returncode == 6
    assert outcome.stderr.startswith("error: No space left on device")
    assert outcome.stderr.count("\n") == 1


@pytest.mark.slow
@pytest.mark.parametrize(
    "command",
    [name for name in names(cli) if name not in ("live", "push", "record", *ELSEWHERE, *GUIDED, *REHEARSED, *OFFLINE)],
)
def test_every_command_works_with_simulate_and_json(
    command: str, ftdrive: CommandLine, capfd: pytest.CaptureFixture[str]
) -> None:
    works_with_simulate_and_json(command, ftdrive, capfd)


@pytest.mark.slow
@pytest.mark.parametrize("command", REHEARSED)
def test_a_command_that_needs_a_run_works_with_simulate_and_json(
    command: str,
    demo: dict[str, Any],
    ftdrive: CommandLine,
    capfd: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    rehearse_with(demo, command, monkeypatch)
    works_with_simulate_and_json(command, ftdrive, capfd)


@pytest.mark.slow
def test_a_command_that_needs_a_calibration_makes_one(ftdrive: CommandLine, capfd: pytest.CaptureFixture[str]) -> None:
    works_with_simulate_and_json("live", ftdrive, capfd)


@pytest.mark.slow
def test_an_empty_gripper_is_weighed(
    demo: dict[str, Any], ftdrive: CommandLine, capfd: pytest.CaptureFixture[str]
) -> None:
    works_with_simulate_and_json("weigh", ftdrive, capfd, "--calibration", demo["run"])


def rehearse_with(demo: dict[str, Any], command: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Give a command the run of the demo instead of one of its own."""
    for module in (f"ftdrive.commands.{command.replace(' ', '.')}", "ftdrive.session.rehearsal"):
        found = importlib.import_module(module)
        monkeypatch.setattr(found, "rehearsed_run", lambda *_, **__: nullcontext(Path(demo["run"])), raising=False)


def works_with_simulate_and_json(
    command: str, ftdrive: CommandLine, capfd: pytest.CaptureFixture[str], *more: str
) -> None:
    outcome = ftdrive.run(*command.split(), *NEEDED.get(command, ()), *more, "--simulate", "--json")
    assert outcome.returncode == 0, outcome.stderr
    assert "Exception" not in outcome.stderr + capfd.readouterr().err
    answer = json.loads(outcome.stdout)
    assert answer["schema_version"] == 1
    assert SHOWN.get(command, bool)(answer)


ANSWERED: Mapping[str, tuple[str, str]] = {
    "bundle": ("--simulate -o {n}.zip", "Saved "),
    "calibrate": ("--simulate --minimal --dry-run", "Dry run: nothing has moved."),
    "compensate": ("{csv}", "compensated "),
    "completion": ("bash", "_ftdrive_completion"),
    "config show": ("--simulate", "[robot]"),
    "convert": ("{csv} {n}.csv", "Saved "),
    "devices": ("--simulate", "/dev/pts/"),
    "diff": ("{run} {run}", "The calibrations are the same."),
    "doctor": ("--simulate", "Usable; see the lines with !"),
    "export calibration": ("{run} --format json", '"ftdrive.export/1"'),
    "export formats": ("", "ros2-control"),
    "export plan": ("--simulate --format csv", "# ftdrive.targets/1"),
    "fleet add": ("cells.toml", "1 added"),
    "fleet index": ("{run}", "added to"),
    "fleet remove": ("press", "removed"),
    "fleet solve": ("{run}", "run"),
    "fleet status": ("", "never calibrated"),
    "history": ("{run}/..", "verdict"),
    "init": ("--simulate --yes --height 33 --tool 0:60:90 -o {n}.toml", "Wrote "),
    "export urscript": ("", "def ftd_weigh():"),
    "live": ("--replay {csv} --once", "N·m"),
    "plan": ("--simulate", "Predicted for"),
    "push": ("{run} --simulate --dry-run", "nothing was sent"),
    "record": ("--simulate --calibration {run} -o {n}.csv --count 100", "Saved "),
    "replay": ("{run}", "equal to the last digit"),
    "report": ("{run} --format json", '"ftdrive.report/1"'),
    "solve": ("{run}", "compensation error"),
    "transcript play": ("--simulate", "played "),
    "transcript record": ("--simulate -o {n}.jsonl --duration 0.2", " samples, mean "),
}
"""What each prints on stdout without --json, also with -q."""


def test_no_command_is_forgotten() -> None:
    assert ANSWERED.keys() | ELSEWHERE == set(names(cli))


@pytest.mark.slow
@pytest.mark.parametrize("command", ANSWERED)
def test_a_file_gets_the_answer_and_a_reader_that_ends_ends_the_command(
    command: str, demo: dict[str, Any], ftdrive: CommandLine, monkeypatch: pytest.MonkeyPatch
) -> None:
    if command in REHEARSED:
        rehearse_with(demo, command, monkeypatch)
    recorder = Recorder([csv := ftdrive.folder / "peg.csv"], info(), {})
    recorder.add(block(100), [])
    recorder.end()
    calibration().save(ftdrive.folder / "calibration.json")
    press = '[cells.press]\nconfig = "cell.toml"\nverify_every_days = 7\n'
    (ftdrive.folder / "cells.toml").write_text(f'format = "ftdrive.cells/1"\n{press}')
    (ftdrive.folder / "cell.toml").write_text('format = "ftdrive.config/1"\n[robot]\nhost = "10.0.0.1"\n')
    arguments, words = ANSWERED[command]
    for quiet in (True, False):
        if command in ("fleet status", "fleet remove"):
            assert ftdrive.run("fleet", "add", "cells.toml").returncode == 0
        typed = [*command.split(), *arguments.format(n=quiet, run=demo["run"], csv=csv).split()]
        outcome = ftdrive.run(*["-q"] * quiet, *typed, is_read=quiet)
        assert outcome.returncode == (0 if quiet else 141), outcome.stderr
        assert words not in outcome.stderr
        if quiet:
            assert words in outcome.stdout
            assert outcome.stderr == ""


@pytest.mark.slow
@pytest.mark.parametrize(
    ("command", "url"),
    [
        (("config", "show"), lambda answer: answer["config"]["sensor"]["url"]),
        (("transcript", "record", "-o", "bota.jsonl", "--duration", "0.3"), lambda answer: answer["url"]),
        (("transcript", "play"), lambda answer: answer["url"]),
    ],
    ids=["config show", "record", "play"],
)
def test_the_sensor_that_is_named_is_emulated(
    command: tuple[str, ...],
    url: Callable[[dict[str, Any]], str],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(tmp_path)
    outcome = CliRunner().invoke(cli, [*command, "--simulate", "--sensor", "emulated://bota", "--json"])
    assert outcome.exit_code == 0, (outcome.output, outcome.exception)
    assert url(json.loads(outcome.stdout)).startswith("bota:///dev/pts/")


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("doctor", "--simulate", "--sensor", "bota:///dev/nope"), "bota:///dev/nope"),
        (("doctor", "--simulate", "--robot", "10.0.0.2"), "--robot cannot be combined with --simulate"),
        (("solve", "--simulate", "."), "DATASET cannot be combined with --simulate"),
        (("solve", "--sensor", "emulated://bota", "."), "--sensor is only for --simulate"),
        *(((command,), "--simulate") for command in ("solve", "replay", "report", "bundle", "live", "push")),
        (("push", ".", "--restore", "."), "--restore uses only the receipt"),
        (("record", "-o", "a.csv"), "--simulate"),
        (("transcript", "play"), "--simulate"),
        (("export", "plan", "--format", "csv"), "--simulate"),
        (("export", "calibration", "--format", "json"), "--simulate"),
    ],
)
def test_what_would_be_ignored_or_is_missing_is_refused(arguments: tuple[str, ...], words: str) -> None:
    outcome = CliRunner().invoke(cli, arguments)
    assert isinstance(outcome.exception, ConfigError)
    assert words in str(outcome.exception)
    assert outcome.stdout == ""
