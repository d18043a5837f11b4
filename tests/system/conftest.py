"""What the tests of the command line share."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from ftdrive.config import FORMAT, CellConfig
from tests.system.command_line import CommandLine


@pytest.fixture(scope="session")
def demo(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """Answer of one `demo`. Its folder, `run`, is shared by all tests and only read."""
    folder = tmp_path_factory.mktemp("demo")
    answer = CommandLine(folder).json("demo", "--simulate")
    return answer | {"run": str(folder / answer["run"])}


@pytest.fixture
def ftdrive(tmp_path: Path) -> CommandLine:
    return CommandLine(tmp_path)


@pytest.fixture
def write_config(tmp_path: Path) -> Callable[[CellConfig], Path]:
    """Write the file that describes a cell, as a user would."""

    def write(cell: CellConfig) -> Path:
        path = tmp_path / "cell.toml"
        path.write_text(
            f'format = "{FORMAT}"\n'
            f'[robot]\nhost = "{cell.robot.host}"\nmodel = "{cell.robot.model}"\n'
            f"speed_deg_s = {cell.robot.speed_deg_s}\nacceleration_deg_s2 = {cell.robot.acceleration_deg_s2}\n"
            f'[sensor]\nurl = "{cell.sensor.url}"\n'
            f"[tool]\ncylinders_mm = {[list(row) for row in cell.tool.cylinders_mm]}\n"
            f'[workcell]\nmounting = "{cell.workcell.mounting}"\nmeasured = true\n'
            f"[sampling]\naverage_s = {cell.sampling.average_s}\n"
        )
        return path

    return write
