"""`ftdrive config show`, and a configuration as the other commands see it."""

import json
from pathlib import Path

import pytest
from click.testing import CliRunner, Result

from ftdrive.cell.config import load
from ftdrive.cli import cli
from ftdrive.errors import exit_code

CELL = """format = "ftdrive.config/1"
[robot]
model = "ur5e"
speed_deg_s = 30
[tool]
cylinders_mm = [[0, 200, 100]]
[workcell]
boxes_mm = [[600, 600, 0, 800, 800, 200]]
"""


@pytest.fixture(autouse=True)
def _here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)


def run(*arguments: str) -> Result:
    return CliRunner().invoke(cli, arguments)


def test_what_is_shown_can_be_used_in_its_place(monkeypatch: pytest.MonkeyPatch) -> None:
    Path("ftdrive.toml").write_text(CELL)
    monkeypatch.setenv("FTDRIVE_ROBOT_HOST", "10.0.0.2")
    monkeypatch.setenv("FTDRIVE_SENSOR_URL", 'ati-can://can0?x="\\')
    monkeypatch.setenv("FTDRIVE_TOOL_NAME", "gripper ü #2")
    for options in ((), ("--origin",)):
        shown = run("config", "show", *options)
        assert shown.exit_code == 0, shown.output
        Path("copy.toml").write_text(shown.stdout, encoding="utf-8")
        with monkeypatch.context() as alone:
            cell = load()
            for name in ("ROBOT_HOST", "SENSOR_URL", "TOOL_NAME"):
                alone.delenv(f"FTDRIVE_{name}")
            assert load(Path("copy.toml")) == cell


def plan(*arguments: str) -> dict[str, object]:
    outcome = run("plan", "--json", *arguments)
    assert outcome.exit_code == 0, (outcome.output, outcome.exception)
    document: dict[str, object] = json.loads(outcome.stdout)
    return document


def test_a_plan_takes_the_cell_from_the_configuration_and_options_override_it() -> None:
    Path("ftdrive.toml").write_text(CELL)
    cell = plan()["description"]
    assert isinstance(cell, dict)
    assert cell["model"] == "UR5e"
    assert cell["speeds"]["joint_rad_s"] == pytest.approx(0.5236, abs=1e-4)
    assert len(cell["scene"]["boxes"]) == 1
    other = plan("--model", "ur10e", "--tool", "0:100:80", "--box", "900:900:0:950:950:10", "--tip-speed-limit", "none")
    cell = other["description"]
    assert isinstance(cell, dict)
    assert cell["model"] == "UR10e"
    assert [part["to_m"] for part in cell["tool"]] == [0.1]
    assert cell["scene"]["boxes"][0]["high_m"] == [0.95, 0.95, 0.01]
    assert cell["speeds"]["tip_m_s"] is None


def test_placeholders_are_named_as_such() -> None:
    Path("ftdrive.toml").write_text(CELL)
    assert "ftdrive.toml" in run("plan").stderr
    assert "Placeholders" in run("plan", "--tool", "0:200:100").stderr
    assert "Placeholders" not in run("plan", "--tool", "0:200:100", "--box", "900:900:0:950:950:10").stderr
    Path("ftdrive.toml").write_text(CELL + "measured = true\n")
    assert "Placeholders" not in run("plan").stderr


@pytest.mark.parametrize(("arguments", "said"), [(["--tool", "0:200:100"], "--model"), (["--model", "ur5e"], "--tool")])
def test_without_a_configuration_a_plan_needs_arm_and_tool(arguments: list[str], said: str) -> None:
    error = run("plan", *arguments).exception
    assert error is not None
    assert exit_code(error) == 2
    assert f"give {said}" in str(error)


def test_a_password_is_left_out(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("FTDRIVE_STORE_URL", "postgresql+psycopg://lab:secret@host/db")
    for options in ((), ("--origin",), ("--json",)):
        shown = run("config", "show", *options)
        assert "postgresql+psycopg://lab@host/db" in shown.output
        assert "secret" not in shown.output
