"""`ftdrive calibrate` before it opens anything: which options go together, and which settings count."""

import json
import shlex
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import Any

import pytest
from click.testing import CliRunner

from ftdrive.cell.config import CellConfig, RobotConfig, SensorConfig
from ftdrive.cell.emulated import REAL_PACE, Station
from ftdrive.cli import cli
from ftdrive.errors import ConfigError
from ftdrive.runs.load import Load
from ftdrive.runs.run import Run
from ftdrive.session import session
from ftdrive.session.open_session import SessionOptions
from ftdrive.session.session import Calibrating

CELL = """format = "ftdrive.config/1"
[robot]
host = "10.0.0.1"
[sensor]
url = "ati-can://can0"
[tool]
name = "gripper"
mass_kg = 1.3
cylinders_mm = [[0, 200, 100]]
[workcell]
planes_mm = [[-1, 0, 0, -800]]
measured = true
"""


class Opened(Exception):
    """The session would begin."""


@pytest.fixture
def cells(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> list[tuple[CellConfig, SessionOptions]]:
    """What the session would begin with."""
    found = list[tuple[CellConfig, SessionOptions]]()

    def guide(cell: CellConfig, operator: object, options: SessionOptions, load: Load | None) -> None:
        del operator, load
        found.append((cell, options))
        raise Opened

    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("ftdrive.commands.calibrate.run_calibration", guide)
    return found


def call(*arguments: str) -> BaseException:
    error = CliRunner().invoke(cli, ["calibrate", *arguments]).exception
    assert error is not None
    return error


@pytest.mark.parametrize(
    ("options", "both"),
    [
        (["--step", "--manual"], "--step and --manual"),
        (["--quick", "--minimal"], "--quick and --minimal"),
        (["--sweep", "--method", "srom"], "--method and --sweep"),
        (["--resume", "run", "--method", "srom"], "--method and --resume"),
        (["--plan", "plan.json", "--resume", "run"], "--plan and --resume"),
        (["--simulate", "--tool", "0:60:90"], "--simulate and --tool"),
    ],
)
def test_options_that_exclude_one_another_are_both_named(
    options: list[str], both: str, cells: list[Any], tmp_path: Path
) -> None:
    (tmp_path / "run").mkdir()
    (tmp_path / "plan.json").touch()
    error = call(*options)
    assert isinstance(error, ConfigError)
    assert str(error).startswith(f"{both} are mutually exclusive")
    assert cells == []


def test_a_tour_by_hand_has_not_the_orientations_of_srom(cells: list[Any]) -> None:
    Path("ftdrive.toml").write_text(CELL)
    for method in ("srom", "mixed"):
        assert f"24 orientations are taken, which {method} needs" in str(call("--manual", "--method", method))
    assert cells == []
    assert isinstance(call("--manual", "--method", "lrom"), Opened)


@pytest.mark.parametrize(
    "cell", [CELL.replace("measured = true", "measured = false"), CELL[: CELL.index("[workcell]")]]
)
def test_a_tool_on_the_command_line_does_not_make_the_cell_measured(cell: str, cells: list[Any]) -> None:
    Path("ftdrive.toml").write_text(cell.replace("planes_mm = [[-1, 0, 0, -800]]\n", ""))
    assert isinstance(call("--tool", "0:60:90"), Opened)
    assert not cells[0][0].workcell.measured


def test_a_tool_on_the_command_line_keeps_name_and_mass(cells: list[Any]) -> None:
    Path("ftdrive.toml").write_text(CELL)
    assert isinstance(call("--tool", "0:60:90", "--tool", "60:200:60:0:5"), Opened)
    tool = cells[0][0].tool
    assert (tool.name, tool.mass_kg) == ("gripper", 1.3)
    assert tool.cylinders_mm == ((0, 60, 90), (60, 200, 60, 0, 5))
    assert "give 3 or 5 numbers" in str(call("--tool", "0:60"))
    assert "not a cylinder" in str(call("--tool", "60:20:90"))


Begin = Callable[..., str]


@pytest.fixture
def begin(cells: list[Any], tmp_path: Path) -> Begin:
    """Begin a run with the cell the command line puts together, as the session writes it down; returns its folder."""

    def begun(*arguments: str) -> str:
        assert isinstance(call(*arguments), Opened)
        cell, options = cells.pop()
        description = session.describe_run(Calibrating(cell, options), options, {})
        run = Run.create(tmp_path / "runs", "calibrate", json.loads(json.dumps(description)))
        run.plan_path.touch()
        return str(run.folder)

    return begun


def test_a_resumed_run_takes_the_files_as_they_are_now(begin: Begin, cells: list[Any]) -> None:
    Path("ftdrive.toml").write_text(CELL)
    run = begin()
    Path("ftdrive.toml").write_text(CELL.replace("200, 100", "260, 100").replace("-800", "-500"))
    assert isinstance(call("--resume", run), Opened)
    cell, options = cells[0]
    assert cell.tool.cylinders_mm == ((0, 260, 100),)
    assert cell.workcell.planes_mm == ((-1, 0, 0, -500),)
    assert options.resume == Path(run)


@pytest.fixture
def stations(monkeypatch: pytest.MonkeyPatch) -> list[tuple[str, Sequence[str]]]:
    """Which emulated cells are started, by sensor and options; none is."""
    found = list[tuple[str, Sequence[str]]]()

    class Emulated(Station):
        cell = CellConfig(RobotConfig("127.0.0.1"), SensorConfig("emulated://"))
        truth: Mapping[str, Any] = MappingProxyType({})

        def __init__(self, sensor: str, options: Sequence[str] = (), **more: Any) -> None:
            super().__init__(sensor, options, **more)
            found.append((sensor, tuple(options)))

        def __enter__(self) -> "Emulated":
            return self

        def __exit__(self, *_: object) -> None: ...

    monkeypatch.setattr("ftdrive.commands.calibrate.Station", Emulated)
    return found


def test_an_emulated_run_goes_on_in_the_same_cell(cells: list[Any], stations: list[Any], tmp_path: Path) -> None:
    station = {"sensor": "serial", "options": ["--seed", "7"], "truth": {"sensor_error": [[0.01]]}}
    config = CellConfig(RobotConfig("127.0.0.1"), SensorConfig("ati-serial:///dev/pts/9")).to_dict()
    run = Run.create(tmp_path, "demo", {"station": station, "config": config})
    run.plan_path.touch()
    for words in (shlex.split(run.resume_command)[2:], ["--simulate", "--resume", str(run.folder)]):
        assert isinstance(call(*words), Opened)
        assert stations.pop() == ("serial", ("--seed", "7"))
        assert not cells.pop()[1].real
    assert isinstance(call("--resume", str(run.folder), "--robot", "10.0.0.9"), Opened)
    assert stations == []
    assert cells.pop()[1].real


@pytest.mark.parametrize(("place", "pace"), [(("--at", "tip=0,0,200"), REAL_PACE), (("--gripped",), ())])
@pytest.mark.usefixtures("cells")
def test_a_load_on_a_string_needs_the_pace_of_a_real_arm(place: Any, pace: Any, stations: list[Any]) -> None:
    call("--simulate", "--load", "2.0", *place)
    assert stations.pop()[1] == pace
