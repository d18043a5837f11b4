"""The command line as a user runs it: a process of its own."""

import json
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from ftdrive.config import FORMAT, CellConfig


class CommandLine:
    """Runs `ftdrive` in a folder of its own."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def start(self, *arguments: str | Path) -> subprocess.Popen[str]:
        return subprocess.Popen(
            [sys.executable, "-m", "ftdrive", *map(str, arguments)],
            cwd=self.folder,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            env=os.environ | {"COLUMNS": "200", "XDG_STATE_HOME": str(self.folder / "state")},
        )

    def run(self, *arguments: str | Path, typed: str = "") -> subprocess.CompletedProcess[str]:
        process = self.start(*arguments)
        out, err = process.communicate(typed, timeout=100)
        return subprocess.CompletedProcess(process.args, process.returncode, out, err)

    def json(self, *arguments: str | Path, typed: str = "") -> dict[str, Any]:
        outcome = self.run(*arguments, "--json", typed=typed)
        assert outcome.returncode == 0, outcome.stderr
        answer: dict[str, Any] = json.loads(
            outcome.stdout.splitlines()[-1]
        )  # after the events, where a command tells them
        return answer

    def poses(self) -> list[Path]:
        """Poses on disk, of the only run in the folder."""
        return sorted(self.folder.glob("runs/*/poses/*.npz"))


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
