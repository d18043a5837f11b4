"""What the list of dependencies and the commands without devices promise about other systems and Pythons."""

import json
import os
import re
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

from ftdrive.recording import Recorder
from ftdrive.stream.samples import StreamEvent
from tests.house.uv import run_uv
from tests.unit.ftdrive.recorded import block, calibration, dataset, info
from tests.unit.ftdrive.store.run_folders import new_run

ROOT = Path(__file__).resolve().parents[2]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
PYTHONS = re.findall(r"Python :: (3\.\d+)", "\n".join(PROJECT["classifiers"]))
LINUX, JETSON, MACOS, WINDOWS = (
    "x86_64-unknown-linux-gnu",
    "aarch64-unknown-linux-gnu",
    "aarch64-apple-darwin",
    "x86_64-pc-windows-msvc",
)


def test_the_classifiers_begin_with_the_oldest_python() -> None:
    assert PYTHONS == ["3.11", "3.12", "3.13", "3.14"]
    assert PROJECT["requires-python"] == f">={PYTHONS[0]}"


def compiled(python: str, system: str) -> str:
    """Resolve the default install, all extras and the tests from wheels; return the pinned requirements."""
    command = ["pip", "compile", "pyproject.toml", "--all-extras", "--group", "dev", "--only-binary", ":all:"]
    command += ["--no-binary", "empy"]  # pure Python without a wheel, which rclpy requires
    command += ["--python", sys.executable, "--python-version", python, "--python-platform", system, "--no-header"]
    return run_uv(*command, cwd=ROOT)


@pytest.mark.slow
@pytest.mark.parametrize("system", [LINUX, JETSON, MACOS, WINDOWS])
@pytest.mark.parametrize("python", PYTHONS)
def test_all_dependencies_have_wheels(python: str, system: str) -> None:
    pinned = compiled(python, system)
    assert "numpy==" in pinned
    assert ("ur-rtde==" in pinned) == (system == LINUX and python in {"3.11", "3.12"})


@pytest.mark.slow
def test_commands_without_devices_need_no_posix(tmp_path: Path) -> None:
    recorder = Recorder([tmp_path / "a.mcap"], info(), {})
    recorder.add(block(3000), [])
    recorder.add(None, [StreamEvent(0, "delay", "…", {"value": 0.0031, "sigma": 0.0002})])
    recorder.end()
    new_run(tmp_path / "runs", "day-1", calibration())
    dataset().save(tmp_path / "dataset.json")
    commands = [
        ["plan", "--model", "ur5e", "--tool", "0:200:100", "--minimal", "--output", "plan.json", "--png", "plan.png"],
        ["export", "plan", "plan.json", "--format", "csv"],
        ["export", "calibration", "runs/day-1", "--format", "json"],
        ["solve", "dataset.json", "--output", "c.json"],
        ["report", "dataset.json"],
        ["report", "c.json", "--format", "json"],
        ["diff", "c.json", "runs/day-1"],
        ["history", "runs"],
        ["history", "--index", "runs"],
        ["convert", "a.mcap", "b.csv"],
        ["compensate", "b.csv", "--bias", "estimate", "--output", "d.parquet"],
        ["live", "--replay", "a.mcap", "--speed", "1e9"],
        ["live", "--replay", "d.parquet", "--speed", "1e9", "--once"],
        ["config", "show"],
    ]
    page = {"PYTHONWARNDEFAULTENCODING": "1", "PYTHONIOENCODING": "cp1252"}  # of a pipe on Windows
    outcome = subprocess.run(
        [sys.executable, str(Path(__file__).with_name("without_posix.py")), json.dumps(commands)],
        cwd=tmp_path,
        env={**os.environ, **page, "PYTHONPATH": str(ROOT)},
        capture_output=True,
        check=False,
    )
    err = outcome.stderr.decode(errors="replace")
    assert outcome.returncode == 0, err
    assert "use Linux" in err
