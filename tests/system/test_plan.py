"""`ftdrive plan` as a person and as a script calls it."""

from pathlib import Path

import pytest
from click.testing import CliRunner, Result

from ftdrive.cli import cli
from ftdrive.errors import ConfigError, exit_code
from ftdrive.planning.plan import Plan

UR5E = ["plan", "--model", "ur5e", "--tool", "0:200:100"]


def run(*arguments: str) -> Result:
    return CliRunner().invoke(cli, arguments)


def test_the_table_is_the_answer_and_the_file_is_the_plan(tmp_path: Path) -> None:
    path = tmp_path / "plan.json"
    outcome = run(*UR5E, "--mounting", "ceiling", "--box", "600:600:0:800:800:200", "--output", str(path))
    assert outcome.exit_code == 0, outcome.output
    for word in ("wrist 3", "within 0.35 m", "proven clear", "Predicted"):
        assert word in outcome.stdout
    assert len(Plan.load(path).steps) == 24


@pytest.mark.parametrize("option", ["--output", "--png"])
@pytest.mark.parametrize(("name", "words"), [("there", "never overwritten"), ("no/there", "create it first")])
def test_a_file_that_cannot_be_made_is_refused_before_any_work(
    option: str, name: str, words: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "there").touch()
    monkeypatch.setattr("ftdrive.planning.planner.plan_for", lambda *_, **__: pytest.fail("it was planned"))
    error = run(*UR5E, option, str(tmp_path / name)).exception
    assert isinstance(error, ConfigError)
    assert str(tmp_path / name).removesuffix("/there") in str(error)
    assert words in str(error)


@pytest.mark.parametrize(
    ("workcell", "measured"),
    [("measured = false", False), ("measured = true", True), ("planes_mm = [[-1, 0, 0, -900]]", False), (None, True)],
)
def test_the_plan_says_whether_its_cell_was_measured(
    workcell: str | None, measured: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    tool = ["--tool", "0:200:100"]
    if workcell is not None:
        tool = []
        Path("ftdrive.toml").write_text(
            f'format = "ftdrive.config/1"\n[tool]\ncylinders_mm = [[0, 200, 100]]\n[workcell]\n{workcell}\n'
        )
    outcome = run("plan", "--model", "ur5e", *tool, "--output", "plan.json")
    assert outcome.exit_code == 0, outcome.output
    assert ("for inspection only" in outcome.stderr) is not measured
    assert Plan.load(Path("plan.json")).measured is measured
    exported = run("export", "plan", "plan.json", "--format", "urscript")
    assert (exported.exit_code == 0) is measured


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["--tool", "0:200"], "3 or 5 numbers"),
        (["--tool", "200:100:50"], "[200.0, 100.0, 50.0] is not"),
        (["--quick", "--minimal"], "not both"),
        (["--mounting", "sideways"], "mounting"),
        (["--plane", "0:0:0:1"], "the normal of [0.0, 0.0, 0.0, 1.0] is zero"),
        (["--tip-speed-limit", "-1"], "1 to 250"),
        (["--tip-speed-limit", "fast"], "'fast': give mm/s, such as 250, or none"),
        (["--posture", "45,-100"], "3 numbers"),
        (["--free-box", "-3"], "the box is -3 mm to each side: give 0 to 1000"),
        (["--free-box", "nan"], "the box is nan mm"),
        (["--mass", "0"], "0.001 to 100"),
    ],
)
def test_what_cannot_be_used_is_said_in_a_sentence(arguments: list[str], said: str) -> None:
    error = run(*UR5E, *arguments).exception
    assert error is not None
    assert said in str(error)
    assert exit_code(error) == 2
