"""`fleet verify`: which cells it asks about, and that no session begins without a yes from a terminal."""

import io
import sys
from collections.abc import Sequence
from datetime import UTC, datetime, timedelta
from importlib import import_module
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from ftdrive import cli
from ftdrive.cell.config import CellConfig
from ftdrive.errors import Declined
from ftdrive.session.events import Question
from ftdrive.store.records import StoredCell
from ftdrive.store.store import Store
from ftdrivers.errors import ConnectError
from tests.unit.ftdrive.store.run_folders import FIRST, new_run, result

Ran = tuple[int, list[str], str]
NAMES = ("A", "B", "C")
command: Any = import_module("ftdrive.commands.fleet.verify")  # the group has a command of the same name


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


class Lab:
    def __init__(self, url: str, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        self.url, self.folder = url, folder
        self.answers: list[str | Exception] = []
        self.asked: list[str] = []
        self.outcomes: list[str | BaseException] = []
        """Of the sessions: empty for one that passes, the reason of one that fails, or what it raises."""
        self.sessions: list[tuple[CellConfig, Path, Any]] = []
        self._monkeypatch = monkeypatch
        monkeypatch.setattr(command, "_session", self._session)
        monkeypatch.setattr(command, "PlainOperator", lambda: self)
        self.store = Store(url)
        self.put(*map(self.cell, NAMES))

    def cell(self, name: str, tool: str = "gripper", host: str = "") -> StoredCell:
        host = host or f"10.0.0.{ord(name)}"
        config = self.folder / name / "ftdrive.toml"
        config.parent.mkdir(exist_ok=True)
        config.write_text(
            f'format = "ftdrive.config/1"\n[robot]\nhost = "10.0.0.{ord(name)}"\n[sensor]\nurl = "ati-can://can0"\n'
            f'[tool]\nname = "{tool}"\n'
        )
        return StoredCell(
            name=name,
            config=str(config),
            verify_every_days=7,
            arm_serial=f"arm-{name}",
            robot_host=host,
            sensor_url="ati-can://can0",
            tool=tool,
        )

    def put(self, *cells: StoredCell) -> None:
        self.store.put_cells(cells)

    def ask(self, question: Question) -> str:
        self.asked.append(question.text.split(",")[0].removeprefix("Cell "))
        assert "emergency stop within reach?" in question.text
        assert question.assumed is None
        answer = self.answers.pop(0)
        if isinstance(answer, Exception):
            raise answer
        return answer

    def _session(self, cell: CellConfig, path: Path, options: Any) -> Any:
        self.sessions.append((cell, path, options))
        outcome = self.outcomes.pop(0) if self.outcomes else ""
        if isinstance(outcome, BaseException):
            raise outcome
        return SimpleNamespace(passed=not outcome, failure=outcome)

    @property
    def verified(self) -> list[str]:
        return [path.parents[2].name for _, path, _ in self.sessions]

    def run(self, *arguments: str, answers: Sequence[str | Exception] = (), terminals: str = "ie") -> Ran:
        self.answers = list(answers)
        out, err = io.StringIO(), Terminal() if "e" in terminals else io.StringIO()
        with self._monkeypatch.context() as here:
            here.setattr(sys, "stdin", Terminal() if "i" in terminals else io.StringIO("yes\n" * 9))
            here.setattr(sys, "stdout", out)
            here.setattr(sys, "stderr", err)
            code = cli.run(["fleet", "verify", "--store", self.url, *arguments])
        assert self.answers == []
        return code, out.getvalue().splitlines(), " ".join(err.getvalue().split())


@pytest.fixture(scope="module")
def indexed(tmp_path_factory: pytest.TempPathFactory) -> tuple[str, Path]:
    """The URL of a store and a folder with a run of each cell, which no test changes."""
    folder = tmp_path_factory.mktemp("fleet")
    url = f"sqlite:///{folder / 'fleet.sqlite'}"
    for n, name in enumerate(NAMES):
        day = (datetime.now(UTC) - timedelta(days=20 * n) - FIRST) / timedelta(days=1)
        new_run(folder / name / "runs", f"run-{name}", result(day, serials=(f"arm-{name}", "ft-1")))
        Store(url).index(folder / name / "runs")
    return url, folder


@pytest.fixture
def lab(indexed: tuple[str, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Lab:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path / "data"))
    return Lab(*indexed, monkeypatch)


@pytest.mark.parametrize("terminals", ["", "e"])
def test_without_a_terminal_nothing_is_asked_and_nothing_moves(terminals: str, lab: Lab) -> None:
    code, out, err = lab.run(terminals=terminals)
    assert (code, out, lab.asked, lab.sessions) == (2, [], [], [])
    assert "needs a terminal" in err


def test_no_option_answers_for_the_operator() -> None:
    assert {one.name for one in command.fleet_verify.params} == {"names", "due", "url"}


@pytest.mark.parametrize("no", ["", "no", Declined("no answer")])
def test_only_yes_starts_a_session(no: str | Exception, lab: Lab) -> None:
    code, out, _ = lab.run(answers=[no, "yes", no])
    assert code == 0
    assert lab.asked == ["A", "B", "C"]
    assert lab.verified == ["B"]
    assert out == ["A: skipped", "B: passed", "C: skipped"]


def test_a_tool_that_was_never_calibrated_is_due_and_not_asked_about(lab: Lab) -> None:
    lab.put(lab.cell("A", tool="drill"))
    code, out, err = lab.run("--due", answers=["", ""])
    assert (code, lab.asked) == (2, ["B", "C"])
    assert out[0].startswith("A: not verified, no accepted calibration of the tool 'drill' is in the store")
    assert "calibrate this cell" in out[0]
    assert err == ""  # once


def test_a_failed_verification_ends_with_7_and_the_others_go_on(lab: Lab) -> None:
    lab.outcomes = ["the force bias has changed by 0.5 N", "", ConnectError("10.0.0.67 does not answer", "check it")]
    code, out, err = lab.run(answers=["yes"] * 3)
    assert code == 7
    assert out[:2] == ["A: FAILED, the force bias has changed by 0.5 N", "B: passed"]
    assert out[2].startswith("C: not verified, 10.0.0.67 does not answer")
    assert "error: the verification failed in A:" in err


def test_ctrl_c_in_a_session_ends_the_round(lab: Lab) -> None:
    lab.outcomes = ["", KeyboardInterrupt()]
    code, out, _ = lab.run(answers=["yes", "yes"])
    assert (code, lab.asked) == (130, ["A", "B"])
    assert out[0] == "A: passed"
    assert out[1].startswith("B: interrupted")


def test_a_robot_that_the_store_does_not_know_is_refused_before_the_question(lab: Lab) -> None:
    lab.put(lab.cell("A", host="10.0.0.99"))
    code, out, _ = lab.run("A")
    assert (code, lab.asked) == (2, [])
    assert out[0].startswith("A: not verified, its robot is 10.0.0.65, the store has 10.0.0.99")


@pytest.mark.parametrize("name", ["FTDRIVE_ROBOT_HOST", "FTDRIVE_TOOL_CYLINDERS_MM"])
def test_a_variable_that_would_describe_every_cell_is_refused(
    name: str, lab: Lab, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(name, "10.0.0.66")
    code, out, err = lab.run()
    assert (code, out, lab.asked) == (2, [], [])
    assert f"{name} is set" in err
