"""Output for people: texts are printed unchanged, -q omits them, errors of the system become sentences."""

import logging
import os
import signal
import subprocess
import sys
from errno import ENOSPC, EPIPE
from pathlib import Path

import pytest
from click.testing import CliRunner, Result
from rich.table import Table
from rich.text import Text
from syrupy.assertion import SnapshotAssertion

import ftdrive.cli as cli_module
from ftdrive.cli import cli
from ftdrive.cli import run as cli_run
from ftdrive.errors import Declined, in_a_sentence
from ftdrive.terminal.console import answer, messages
from ftdrive.terminal.lines import Line
from ftdrive.terminal.text import echo, in_whole_words, print_table
from ftdrive.words.text import visible

HELD = ["calibrate", "--robot", "10.0.0.1", "--sensor", "ati-can://can0"]


@pytest.fixture(autouse=True)
def _put_back(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(messages, "quiet", False)
    monkeypatch.setattr(logging, "basicConfig", lambda **_: None)


def run(*arguments: str) -> Result:
    return CliRunner().invoke(cli, arguments)


def test_brackets_and_colons_are_no_markup(monkeypatch: pytest.MonkeyPatch) -> None:
    text = "'Free? [yes/no]' in [bold]my [old] runs:cat:"

    def guide(*_: object) -> None:
        raise Declined(text)

    monkeypatch.setattr("ftdrive.commands.calibrate.run_calibration", guide)
    assert text in run(*HELD).stderr


def test_help_breaks_no_address_and_cuts_no_sentence() -> None:
    assert {"ati-can://can0?bitrate=250000,", "bota:///dev/ttyUSB0"} <= set(run("record", "--help").stdout.split())
    assert "or play them to the driver" in run("transcript", "--help").stdout
    for command in ("export", "fleet", "loads", "transcript", "config"):
        assert "..." not in run(command, "--help").stdout.replace("[ARGS]...", "")


def test_errors_of_the_system_name_the_file_and_what_to_look_at(tmp_path: Path, snapshot: SnapshotAssertion) -> None:
    with pytest.raises(OSError, match="No such file") as error:
        (tmp_path / "gone").read_text()
    assert in_a_sentence(error.value).removeprefix(f"{tmp_path}/gone: ") == snapshot
    assert in_a_sentence(OSError(ENOSPC, "No space left on device")) == snapshot
    own = FileExistsError("it is there: choose another name")
    assert in_a_sentence(own) == str(own)


NAME = "\x1b]0;owned\x07 gripper\x9b2J \u202epilf\r0\udcff\ttab\nline\r\n"
SHOWN = "\\x1b]0;owned\\x07 gripper\\x9b2J \\u202epilf\\r0\\udcff\ttab\nline\r\n"


def test_no_name_commands_the_terminal(capsys: pytest.CaptureFixture[str]) -> None:
    assert visible(NAME) == SHOWN
    assert in_whole_words(NAME, sys.stderr) == SHOWN
    assert str(Line(NAME)) == SHOWN
    echo(NAME)
    echo(NAME, err=True)
    assert capsys.readouterr() == (f"{SHOWN}\n", f"{SHOWN}\n")


def test_no_name_in_a_table_commands_the_terminal(capsys: pytest.CaptureFixture[str]) -> None:
    table = Table()
    table.add_column("tool", min_width=20)
    table.add_row(Text("a\x1b[2Jb", "bold"))
    answer.print(table)
    print_table(["tool"], [["a\x1b[2Jb"]], [])
    shown = capsys.readouterr().out
    assert shown.count("a\\x1b[2Jb") == 2
    assert "\x1b[2J" not in shown


def ended(code: str, *arguments: str) -> tuple[int, str]:
    read, write = os.pipe()
    os.close(read)
    try:
        done = subprocess.run(
            [sys.executable, "-c", code, *arguments], stdout=write, stderr=subprocess.PIPE, text=True, check=False
        )
    finally:
        os.close(write)
    return done.returncode, done.stderr


MAIN = "import sys; from ftdrive.cli import main; sys.exit(main())"


@pytest.mark.skipif(sys.platform == "win32", reason="no terminal closes by a signal there")
@pytest.mark.parametrize("ignored", [False, True], ids=["", "nohup"])
def test_a_terminal_that_closes_ends_a_command_unless_it_may(ignored: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    handlers: dict[int, object] = {signal.SIGHUP: signal.SIG_IGN if ignored else signal.SIG_DFL}
    monkeypatch.setattr(signal, "getsignal", handlers.__getitem__)
    monkeypatch.setattr(signal, "signal", handlers.__setitem__)
    monkeypatch.setattr(cli_module, "run", lambda _: 3)
    assert cli_module.main() == 3
    assert (handlers.pop(signal.SIGHUP) == signal.SIG_IGN) == ignored
    assert handlers == dict.fromkeys((signal.SIGINT, signal.SIGTERM), signal.default_int_handler)


@pytest.mark.skipif(sys.platform == "win32", reason="pipes end otherwise there")
def test_a_closed_pipe_ends_a_command_quietly() -> None:
    assert ended(MAIN, "--help") == (141, "")


def test_a_broken_pipe_of_a_device_is_no_closed_output(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def lose(*_: object) -> None:
        raise BrokenPipeError(EPIPE, "Broken pipe")

    monkeypatch.setattr("ftdrive.commands.calibrate.run_calibration", lose)
    assert cli_run(HELD) == 4
    assert "closed its connection" in capsys.readouterr().err
