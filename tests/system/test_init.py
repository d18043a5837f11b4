"""`ftdrive init` against an emulated cell: as a script calls it, as answers typed, and in a real terminal."""

import json
import re
import shlex
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import click
import numpy as np
import pytest
from click.testing import CliRunner, Result

from ftdrive.cell.config import load
from ftdrive.cell.emulated import Station
from ftdrive.cli import cli
from ftdrive.errors import ConfigError, exit_code
from ftdrive.planning.geometry.arm_model import SHAPES
from ftdrivers.errors import ConnectError

TOOL = ["--height", "33", "--tool", "0:33:80", "--tool", "33:200:100:0:5"]


@pytest.fixture(scope="module")
def station() -> Iterator[Station]:
    with Station("both", ["--time-scale", "1"]) as station:
        yield station


def serial_port(station: Station) -> str:
    return str(station.endpoints["sensors"]["serial"]["port"])


@pytest.fixture
def addresses(station: Station) -> list[str]:
    return ["--robot", station.cell.robot.host, "--sensor", f"ati-serial://{serial_port(station)}"]


@pytest.fixture(autouse=True)
def _here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, station: Station) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("FTDRIVE_CLOCK", station.endpoints["clock"])


def run(*arguments: str, typed: str = "") -> Result:
    return CliRunner().invoke(cli, ["init", *arguments], input=typed)


@pytest.mark.slow
def test_a_script_needs_no_questions(station: Station) -> None:
    addresses = ["--robot", station.cell.robot.host, "--sensor", serial_port(station)]
    more = [
        "--sensor-mass",
        "0.255",
        "--tool-mass",
        "1.2",
        "--plane",
        "-1:0:0:-900",
        "--box",
        "500:500:0:900:900:90",
        "--speed",
        "45",
    ]
    outcome = run(*addresses, *TOOL, *more, "--mounting", "12.5", "--tool-name", "gripper", "--yes")
    assert outcome.exit_code == 0, (outcome.output, outcome.exception)
    assert outcome.stdout.startswith("Wrote ftdrive.toml. Measure tool")
    cell = load()
    assert (cell.robot.host, cell.robot.model, cell.robot.speed_deg_s) == (station.cell.robot.host, "UR5e", 45)
    assert cell.sensor.url == f"ati-serial://{serial_port(station)}"  # the port was asked what is there
    assert (cell.sensor.height_mm, cell.sensor.mass_kg) == (33, 0.255)
    assert cell.tool.cylinders_mm == ((0, 33, 80), (33, 200, 100, 0, 5))
    assert (cell.tool.name, cell.tool.mass_kg, cell.workcell.mounting) == ("gripper", 1.2, "12.5")
    assert cell.workcell.planes_mm == ((-1, 0, 0, -900),)
    assert cell.workcell.boxes_mm == ((500, 500, 0, 900, 900, 90),)


SILENT = ["127.99.99.9", "", "ur10e", "ati-serial:///dev/no-such-port", ""]


def typed(*answers: str) -> str:
    return "".join(f"{answer}\n" for answer in answers)


@pytest.mark.parametrize("signal", ["end of input", "Ctrl-C"])
def test_answers_are_kept_in_a_draft_that_goes_on(monkeypatch: pytest.MonkeyPatch, signal: str) -> None:
    """After Ctrl-D or Ctrl-C nothing has to be typed twice, not even a row."""
    prompt = click.prompt

    def until_the_second_cylinder(text: str, **options: Any) -> Any:
        if text.startswith("  next"):
            raise click.Abort
        return prompt(text, **options)

    answers = typed(*SILENT, "3.3 cm", "", "gripper left", "0:33:80")
    with monkeypatch.context() as here:
        if signal == "Ctrl-C":
            here.setattr(click, "prompt", until_the_second_cylinder)
        outcome = run("-o", "left.toml", typed=answers)
    assert isinstance(outcome.exception, ConfigError if signal == "end of input" else SystemExit)
    text = str(outcome.exception) if signal == "end of input" else outcome.output
    assert ".left.toml.draft" in text
    command = next(line.strip() for line in text.splitlines() if "ftdrive init" in line)
    assert shlex.split(command)[-4:] == ["ftdrive", "init", "-o", "left.toml"]
    outcome = run("-o", "left.toml", typed=typed("yes", "33:90:100", *[""] * 7))
    assert outcome.exit_code == 0, (outcome.output, outcome.exception)
    cell = load(Path("left.toml"))
    assert (cell.robot.host, cell.robot.model, cell.sensor.height_mm) == ("127.99.99.9", "ur10e", 33)
    assert cell.tool.cylinders_mm == ((0, 33, 80), (33, 90, 100))
    assert not Path(".left.toml.draft").exists()


def test_a_draft_can_be_left_and_a_broken_one_is_named() -> None:
    run(typed=typed(*SILENT, "33"))
    outcome = run(typed=typed("perhaps", "back", "no", "127.99.99.8"))
    assert outcome.output.count("Enter yes or no.") == 2
    assert not Path(".ftdrive.toml.draft").exists()
    Path(".ftdrive.toml.draft").write_text("{}")
    error = run(typed=typed("yes")).exception
    assert isinstance(error, ConfigError)
    assert "delete it" in str(error)


def test_back_and_the_summary_change_answers() -> None:
    answers = [*SILENT, "33", "200 g", "back", "250 g", "", "0 33 80", "33 90 100", "back", "33 110 100 45 0", ""]
    answers += ["1,2", "", "+x 80 cm", "0.6:0:0.8:-400", "", "400 400 0 800 800 300", "back", "", ""]
    answers += ["13", "4", "34", "12", "back", "back", "+y 31,5 in", "", "", "", "4", "120", "", "4", "33", ""]
    outcome = run(typed=typed(*answers))
    assert outcome.exit_code == 0, (outcome.output, outcome.exception)
    for words in ("'13' is not a number of 1 to 12", "the tool ends 110 mm from the flange"):
        assert words in outcome.stderr
    cell = load()
    assert (cell.sensor.height_mm, cell.sensor.mass_kg, cell.tool.mass_kg) == (33, 0.25, 1.2)
    assert cell.tool.cylinders_mm == ((0, 33, 80), (33, 110, 100, 45, 0))
    assert cell.workcell.planes_mm == ((-1, 0, 0, -800), (0.6, 0, 0.8, -400), (0, -1, 0, -800.1))
    assert cell.workcell.boxes_mm == ()


@pytest.mark.slow
def test_an_arm_without_a_measured_shape_is_reported(addresses: list[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delitem(SHAPES, "UR5e")
    outcome = run(*addresses, *TOOL, "--yes")
    assert outcome.exit_code == 0, outcome.output
    assert "calibrate --manual" in outcome.output


@pytest.mark.slow
def test_a_bus_is_asked_what_is_there(station: Station) -> None:
    can = station.endpoints["sensors"]["can"]
    bus = f"slcan://{can['channel']}?bitrate={can['bitrate']}"
    outcome = run("--robot", station.cell.robot.host, "--sensor", bus, *TOOL, "--yes")
    assert outcome.exit_code == 0, (outcome.output, outcome.exception)
    assert load().sensor.url == f"ati-can://{can['channel']}?interface=slcan&bitrate={can['bitrate']}"


@pytest.mark.slow
def test_nothing_counts_as_measured_until_the_operator_sets_it(addresses: list[str]) -> None:
    assert run(*addresses, *TOOL, "--yes").exit_code == 0
    text = Path("ftdrive.toml").read_text()
    assert load().workcell.measured is False
    said = re.sub(r"^# ?", "", text, flags=re.MULTILINE).replace("\n", " ")
    assert "PLACEHOLDERS until measured" in said
    assert "until then nothing moves" in said
    Path("ftdrive.toml").write_text(text.replace("measured = false", "measured = true"))
    assert load().workcell.measured is True


def test_an_existing_file_is_never_overwritten() -> None:
    Path("ftdrive.toml").write_text("mine")
    outcome = run("--yes")
    assert isinstance(outcome.exception, ConfigError)
    assert str(outcome.exception).startswith("--output: ftdrive.toml")
    assert Path("ftdrive.toml").read_text() == "mine"


@pytest.mark.parametrize(("without", "said"), [("--height", "--height is missing"), ("--tool", "--tool is missing")])
def test_a_measured_number_has_no_default(without: str, said: str, addresses: list[str]) -> None:
    kept = [
        word for flag, value in zip(TOOL[::2], TOOL[1::2], strict=True) if flag != without for word in (flag, value)
    ]
    error = run(*addresses, *kept, "--yes").exception
    assert error is not None
    assert exit_code(error) == 2
    assert said in str(error)
    assert not Path("ftdrive.toml").exists()


def test_a_robot_that_does_not_answer_is_exit_code_3(station: Station) -> None:
    error = run("--robot", "127.99.99.9", "--sensor", station.cell.sensor.url, *TOOL, "--yes").exception
    assert isinstance(error, ConnectError)
    assert exit_code(error) == 3
    assert not Path("ftdrive.toml").exists()


@pytest.mark.slow
def test_answers_that_cannot_be_used_are_asked_again(station: Station) -> None:
    answers = ["127.99.99.9", station.cell.robot.host, "ati-nonsense://x", serial_port(station)]
    answers += ["high", "3300", "33", "", ""]
    answers += ["0:x:33", "0:0.2:0.1", "0:20:80", "", "20:33:80", "33:20:100", "33:200:100", "", "", ""]
    answers += ["1:0:0:800", "+x 20", "+x 1,200", "x 800", "-1:0:0:-800", ""]
    answers += ["-50:-50:0:50:50:400", "300:300:0:500:500:400", "", "", ""]
    outcome = run(typed="\n".join(answers) + "\n")
    assert outcome.exit_code == 0, (outcome.output, outcome.exception)
    for words in (
        "cannot be reached",
        "unknown sensor",
        "is not a number",
        "out of range",
        "3 or 5 numbers",
        "'0:x:33'",
        "not a cylinder",
        "in mm",
        "ends 20 mm from the flange",
        "wrong side of the plane [1, 0, 0, 800]",
        "the plane [-1, 0, 0, -20] (+x 20 mm) is 0 mm from the arm's shoulder",
        "write 1200 or 1.200",
        "give a side and a distance",
        "the box [-50, -50, 0, 50, 50, 400]",
    ):
        assert words in outcome.stderr
    cell = load()
    assert cell.robot.host == station.cell.robot.host
    assert cell.tool.cylinders_mm == ((0, 20, 80), (20, 33, 80), (33, 200, 100))
    assert cell.workcell.planes_mm == ((-1, 0, 0, -800),)
    assert cell.workcell.boxes_mm == ((300, 300, 0, 500, 500, 400),)
    assert (cell.sensor.height_mm, cell.sensor.mass_kg) == (33, None)


def test_the_operator_may_keep_addresses_that_do_not_answer() -> None:
    silent, no_bus = "ati-serial:///dev/no-such-port", "slcan:///dev/no-such-port?bitrate=250000"
    answers = ["127.99.99.9", "", "ur10e", no_bus, silent, "", "33", "", "", "0:50:80", *[""] * 7]
    outcome = run(typed=typed(*answers))
    assert outcome.exit_code == 0, (outcome.output, outcome.exception)
    cell = load()
    assert (cell.robot.host, cell.robot.model, cell.sensor.url) == ("127.99.99.9", "ur10e", silent)
    assert Path("ftdrive.toml").read_text().count("not read when this file was written") == 2


@pytest.mark.slow
def test_an_emulated_cell_is_that_of_the_file_and_no_real_command_takes_it() -> None:
    more = ["--tool-name", "gripper", "--tool-mass", "1.3", "--mounting", "30", "--box", "500:500:0:900:900:90"]
    assert run("--simulate", "--sensor", "emulated://robotiq", "--yes", *TOOL, *more).exit_code == 0
    with Station.of(None) as emulated:
        cell, truth = emulated.cell, emulated.truth
    again = Station.of(json.loads(json.dumps({"sensor": "robotiq", "values": emulated.values})))
    assert (again.sensor, again.values) == ("robotiq", emulated.values)
    assert (emulated.sensor, cell.tool.name, cell.tool.mass_kg) == ("robotiq", "gripper", 1.3)
    assert cell.tool.cylinders_mm == ((0, 33, 80), (33, 200, 100, 0, 5))
    assert (cell.workcell.mounting, cell.workcell.boxes_mm) == ("30", ((500, 500, 0, 900, 900, 90),))
    assert (truth["mass_kg"], truth["p_flange_sensor_m"]) == (1.3, [0, 0, 0.033])
    assert truth["tilt_beta_rad"] == pytest.approx(np.radians(30))
    for command in ("doctor", "calibrate"):
        error = CliRunner().invoke(cli, [command]).exception
        assert isinstance(error, ConfigError)
        assert "describes an emulated cell ([robot] simulate = true): add --simulate" in str(error)
