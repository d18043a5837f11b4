"""The command line as a user runs it: in this process where that makes no difference, else in one of its own."""

import io
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from pathlib import Path
from subprocess import CompletedProcess
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner

from ftdrive import cli
from ftdrive.cell.config import FORMAT
from ftdrive.cell.emulated import Station
from ftdrive.terminal.console import answer, messages

_LONG_S = 90
"""What takes so long hangs; no computer is that busy."""
AVERAGE_S = 0.1
"""Of each pose: a session shows the same with a quarter of the usual samples, and its sigmas say so."""


class CommandLine:
    """Runs `ftdrive` in a folder of its own."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._environment = {
            "COLUMNS": "200",
            "XDG_STATE_HOME": str(folder / "state"),
            "XDG_DATA_HOME": str(folder / "data"),
            "PYTHONFAULTHANDLER": "1",  # `exit_code_of` has a process that hangs print where
        }
        self._started: list[subprocess.Popen[str]] = []

    def connect(self, station: Station) -> Path:
        """Write the file that describes the cell of a station, as a user would; commands then keep its time."""
        self.keep_time_of(station)
        cell, path = station.cell, self.folder / "cell.toml"
        path.write_text(
            f'format = "{FORMAT}"\n'
            f'[robot]\nhost = "{cell.robot.host}"\nmodel = "{cell.robot.model}"\n'
            f"speed_deg_s = {cell.robot.speed_deg_s}\nacceleration_deg_s2 = {cell.robot.acceleration_deg_s2}\n"
            f'control = "{cell.robot.control}"\napi_port = {cell.robot.api_port}\n'
            f'[sensor]\nurl = "{cell.sensor.url}"\n'
            f"[tool]\ncylinders_mm = {[list(row) for row in cell.tool.cylinders_mm]}\n"
            f'[workcell]\nmounting = "{cell.workcell.mounting}"\nmeasured = true\n'
            f"[sampling]\naverage_s = {AVERAGE_S}\nnoise_record_s = {cell.sampling.noise_record_s}\n"
        )
        return path

    def keep_time_of(self, station: Station) -> None:
        """Have the commands keep the time of a station, as the computer's may be too fast for it."""
        self._environment["FTDRIVE_CLOCK"] = station.endpoints["clock"]

    def run(self, *arguments: str | Path, typed: str = "", is_read: bool = True) -> CompletedProcess[str]:
        """Run it in this process to its end: a process of its own would only import the same modules again.

        Unless `is_read`, stdout is a pipe whose reader has ended.
        """
        runner = CliRunner()
        with pytest.MonkeyPatch.context() as here, runner.isolation(typed, self._environment) as (out, err, _):
            here.chdir(self.folder)
            here.setattr(messages, "quiet", False)
            if not is_read:
                reader, writer = os.pipe()
                os.close(reader)
                here.setattr(sys, "stdout", os.fdopen(writer, "w"))
            try:
                code = cli.run([*map(str, arguments)])
            except SystemExit as ended:
                code = int(ended.code or 0)
            if is_read:
                sys.stdout.flush()
            else:
                with suppress(BrokenPipeError):
                    sys.stdout.close()
                here.setattr(sys, "stdout", io.StringIO())
                answer.print(end="")  # it keeps what could not be written
            sys.stderr.flush()
            return CompletedProcess(arguments, code, out.getvalue().decode(), err.getvalue().decode())

    def json(self, *arguments: str | Path, typed: str = "") -> dict[str, Any]:
        """Run it with --json; return its answer, the last line where it prints events before."""
        outcome = self.run(*arguments, "--json", typed=typed)
        assert outcome.returncode == 0, outcome.stderr
        answer: dict[str, Any] = json.loads(outcome.stdout.splitlines()[-1])
        return answer

    def start(self, *arguments: str | Path, **how: Any) -> subprocess.Popen[str]:
        """Start it as a process: for signals, and for what happens while it runs. `how` is for `Popen`."""
        pipes = dict.fromkeys(("stdin", "stdout", "stderr"), subprocess.PIPE)
        process: subprocess.Popen[str] = subprocess.Popen(
            [sys.executable, "-m", "ftdrive", *map(str, arguments)],
            cwd=self.folder,
            text=True,
            env=os.environ | self._environment,
            **{**pipes, **how},
        )
        self._started.append(process)
        return process

    def end(self) -> None:
        """End what a failed test has left running."""
        for process in self._started:
            process.kill()
            process.communicate()

    def wait_for_poses(self, process: subprocess.Popen[str], count: int) -> None:
        """Return when so many poses are on disk."""
        wait_until(lambda: len(self.poses()) >= count, process)

    def poses(self) -> list[Path]:
        """Return the poses on disk, of the only run in the folder."""
        return sorted(self.folder.glob("runs/*/poses/*.npz"))


def say(process: subprocess.Popen[str], words: str) -> None:
    """Type into a process."""
    assert process.stdin is not None
    process.stdin.write(words)
    process.stdin.flush()


def listen_for(process: subprocess.Popen[str], words: str) -> str:
    """Read what a process prints for people until it has said this."""
    assert process.stderr is not None
    said = ""
    while words not in said:
        said += (letter := process.stderr.read(1))
        assert letter, said
    return said


def wait_until(condition: Callable[[], bool], process: subprocess.Popen[str] | None = None) -> None:
    """Look again and again, as long as the process lives."""
    deadline_s = time.monotonic() + _LONG_S
    while not condition():
        assert process is None or process.poll() is None, process.communicate()
        assert time.monotonic() < deadline_s, "it never happens"
        time.sleep(0.02)


def exit_code_of(process: "subprocess.Popen[str]", err: Path) -> int:
    """Wait for the end of a process, whose stderr is a file; one that hangs prints the stacks of its threads."""
    try:
        return process.wait(_LONG_S)
    except subprocess.TimeoutExpired:
        process.send_signal(signal.SIGABRT)
        process.wait()
        pytest.fail(f"it hangs: {err.read_text()[-20_000:]}")


def end_of(process: subprocess.Popen[str], typed: str = "") -> tuple[int, str]:
    """Return the exit code and what was printed for people since; the input stays open, as in a terminal."""
    if typed:
        say(process, typed)
    stdin, process.stdin = process.stdin, None
    _, said = process.communicate(timeout=_LONG_S)
    if stdin is not None:
        with suppress(BrokenPipeError):
            stdin.close()
    return process.returncode, said


def left_at_a_hold(process: subprocess.Popen[str]) -> tuple[int, str]:
    """Let the input end at the question of a hold; return the exit code and what was printed for people since."""
    said = listen_for(process, "resume: ")
    _, more = process.communicate(timeout=_LONG_S)
    return process.returncode, said + more


def assert_found(errors_in_sigma: Mapping[str, Any]) -> None:
    """Each parameter within six of its sigmas.

    The noise of a session differs from run to run, and a CI run checks some hundred numbers: a limit of four sigmas
    would fail one CI run in fifty without a defect, six fail none. That the sigmas are right is tested in `calib`.
    """
    for key, errors in errors_in_sigma.items():
        assert np.abs(errors).max() < 6, (key, errors)


def assert_demo_found_the_truth(demo: dict[str, Any]) -> None:
    """Each parameter within its sigmas, the compensation within its prediction."""
    assert demo["schema_version"] == 1
    assert_found(demo["error_in_sigma"])
    for key, error in demo["compensation_error"].items():
        assert error < 3 * demo["result"]["predicted_error"][key]
    assert demo["result"]["verdict"] == "good"
