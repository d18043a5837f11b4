"""Output for people: texts are printed unchanged, -q omits them, errors of the system become sentences."""

import io
import logging
import re
from errno import ENOSPC
from pathlib import Path

import pytest
from click.testing import CliRunner, Result
from rich.console import Console
from syrupy.assertion import SnapshotAssertion

from ftdrive.checks.check import Check
from ftdrive.cli import cli, in_a_sentence
from ftdrive.commands.doctor import _print
from ftdrive.commands.live import _screen
from ftdrive.errors import Declined
from ftdrive.live.samples import WrenchFrame
from ftdrive.session import session
from ftdrive.session.events import Noted
from ftdrive.session.operator import Question
from ftdrive.terminal.console import answer, hanging, talk
from ftdrive.terminal.operators import PlainOperator
from ftdrive.terminal.screen import open_operator

PLAN = ["plan", "--model", "ur5e", "--tool", "0:200:100", "--minimal"]
HELD = ["calibrate", "--robot", "10.0.0.1", "--sensor", "ati-can://can0"]


@pytest.fixture(autouse=True)
def _put_back(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(talk, "quiet", False)
    monkeypatch.setattr(logging, "basicConfig", lambda **_: None)


def run(*arguments: str) -> Result:
    return CliRunner().invoke(cli, arguments)


def test_brackets_and_colons_are_no_markup(monkeypatch: pytest.MonkeyPatch) -> None:
    text = "'Free? [yes/no]' in [bold]my [old] runs:cat:"

    def guide(*_: object) -> None:
        raise Declined(text)

    monkeypatch.setattr(session, "calibrate", guide)
    assert text in run(*HELD).stderr


def test_the_live_screen_shows_a_path_as_it_is() -> None:
    numbers = {"force_N": [1.0, -2.0, 3.0], "torque_Nm": [0.1, 0.2, 0.3]}
    reading = {"verdict": "good", "rate_Hz": 100.0, "lost": 0, "contact": False, "stale": None}
    reading |= {"delay_s": {"value": 0.0, "sigma": 0.0}, "raw": numbers, "compensated": numbers, "sigma": numbers}
    reading |= {"contact": False, "stale": None, "delay_s": {"value": 0.0, "sigma": 0.0}}
    with talk.capture() as shown:
        talk.print(_screen(reading, WrenchFrame("base"), "my [old] runs/calibration.json"))
    assert "my [old] runs/calibration.json" in shown.get()
    assert "[/]" not in shown.get()


@pytest.mark.parametrize("width", [40, 80])
def test_what_is_longer_than_the_terminal_goes_on_under_its_first_word(width: int) -> None:
    console = Console(width=width, file=io.StringIO(), color_system=None)
    words = " ".join(f"word{k}" for k in range(30))
    console.print(hanging("  head: ", words, console))
    assert isinstance(console.file, io.StringIO)
    first, *others = console.file.getvalue().splitlines()
    assert first.startswith("  head: word0 ")
    assert others
    assert all(re.match(r" {8}word\d", line) and len(line) <= width for line in others)
    assert " ".join([first.removeprefix("  head: ").strip(), *map(str.strip, others)]) == words
    assert hanging("head: ", words, Console(width=width, soft_wrap=True)).plain == f"head: {words}"  # a file


def test_findings_of_doctor_and_their_cures_are_indented(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("TERM", "dumb")  # 80 columns, no colour
    monkeypatch.setattr(answer, "soft_wrap", False)  # as in a terminal
    _print([Check("robot.payload", "failed", "found [1] " * 20, "fix it " * 20)])
    first, *others = (line.rstrip() for line in capsys.readouterr().out.splitlines())
    assert first.startswith(" robot       ✘ found [1]")
    cure = next(k for k, line in enumerate(others) if line.startswith(" " * 15 + "fix: fix"))
    assert cure > 0
    assert all(re.match(r" {15}\S", line) for line in others[:cure])
    assert all(re.match(r" {20}\S", line) for line in others[cure + 1 : -1])
    assert others[-1] == " Not ready."
    assert others[cure + 1 :]


def test_quiet_leaves_only_errors_and_the_answer() -> None:
    shown, quiet = run(*PLAN, "--box", "900:900:0:950:950:10"), run("-q", *PLAN, "--box", "900:900:0:950:950:10")
    assert "Predicted" in shown.stdout
    assert (quiet.exit_code, quiet.stderr, quiet.stdout) == (0, "", shown.stdout)
    assert '"steps"' in run("-q", *PLAN, "--json").stdout


def test_quiet_asks_with_all_that_a_question_is_about(monkeypatch: pytest.MonkeyPatch) -> None:
    stderr = io.StringIO()
    operator = PlainOperator(stdin=io.StringIO("yes\n"), stderr=stderr, quiet=True)
    operator.show(Noted(words="the arm goes there"))
    assert stderr.getvalue() == ""
    assert operator.ask(Question("Go?")) == "yes"
    operator.show(Noted(words="it went"))
    assert stderr.getvalue().splitlines() == ["   the arm goes there", "Go? [yes/no] yes"]
    monkeypatch.setattr(talk, "quiet", True)
    with open_operator() as chosen:
        assert isinstance(chosen, PlainOperator)
        chosen.show(Noted(words="not printed"))


def test_errors_of_the_system_name_the_file_and_what_to_look_at(tmp_path: Path, snapshot: SnapshotAssertion) -> None:
    with pytest.raises(OSError, match="No such file") as error:
        (tmp_path / "gone").read_text()
    assert in_a_sentence(error.value).removeprefix(f"{tmp_path}/gone: ") == snapshot
    assert in_a_sentence(OSError(ENOSPC, "No space left on device")) == snapshot
    own = FileExistsError("it is there: choose another name")
    assert in_a_sentence(own) == str(own)
