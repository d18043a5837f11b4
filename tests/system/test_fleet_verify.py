"""`fleet verify` in a terminal: an operator skips an emulated cell, and verifies it."""

import fcntl
import os
import pty
import re
import select
import shutil
import struct
import subprocess
import sys
import termios
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from ftdrive.cell.emulated import Station
from ftdrive.runs.source import read_calibration
from tests.system.command_line import CommandLine

_ESCAPES = re.compile(r"\x1b\[[0-9;?]*[A-Za-z]")
_LONG_S = 90


class InTerminal:
    """A command that an operator runs in a terminal, 200 columns wide."""

    def __init__(self, process: subprocess.Popen[bytes], keys: int) -> None:
        self.process, self._keys = process, keys
        self.screen = ""

    def answer(self, question: str, answer: str) -> None:
        """Type an answer when the question, and what may be typed, stand at the end of the screen."""
        self._read_until(lambda: re.search(rf"{question}[^\n]*(\] |: )$", self.screen))
        self.type(answer)

    def type(self, words: str) -> None:
        """Type a line, whatever the screen shows."""
        os.write(self._keys, f"{words}\n".encode())

    def end(self) -> int:
        """Read to its end; return the exit code."""
        while self._read():
            pass
        return self.process.returncode

    def _read_until(self, condition: Callable[[], object]) -> None:
        deadline_s = time.monotonic() + _LONG_S
        while not condition():
            assert time.monotonic() < deadline_s, self.screen
            if not self._read():
                break
        assert condition(), self.screen

    def _read(self) -> bool:
        """Wait for more; return whether there can be more."""
        if not select.select([self._keys], [], [], 0.1)[0]:
            return True
        try:
            more = os.read(self._keys, 65536).decode(errors="replace")
        except OSError:  # the process has ended
            self.process.wait(_LONG_S)
            return False
        self.screen += _ESCAPES.sub("", more).replace("\r", "")
        return True


@contextmanager
def in_terminal(ftdrive: CommandLine, *arguments: str) -> Iterator[InTerminal]:
    leader, follower = pty.openpty()
    fcntl.ioctl(follower, termios.TIOCSWINSZ, struct.pack("4H", 50, 200, 0, 0))
    environment = {**os.environ, **ftdrive._environment, "TERM": "xterm-256color"}
    command = [sys.executable, "-m", "ftdrive", *arguments]
    process = subprocess.Popen(
        command, stdin=follower, stdout=follower, stderr=follower, cwd=ftdrive.folder, env=environment
    )
    os.close(follower)
    try:
        yield InTerminal(process, leader)
    finally:
        process.kill()
        process.wait()
        os.close(leader)


@pytest.mark.slow
def test_an_operator_skips_a_cell_or_verifies_it(demo: dict[str, Any], ftdrive: CommandLine) -> None:
    runs = ftdrive.folder / "press" / "runs"
    calibrated = Path(shutil.copytree(demo["run"], runs / "calibrated"))
    with Station.of(read_calibration(calibrated).provenance["station"]) as station:
        config = ftdrive.connect(station)
        config.write_text(config.read_text().replace("[tool]", f'[tool]\nname = "{station.cell.tool.name}"'))
        (ftdrive.folder / "cells.toml").write_text(
            f'format = "ftdrive.cells/1"\n[cells.press]\nconfig = "{config.name}"\nverify_every_days = 7\n'
            f'arm_serial = "{demo["result"]["provenance"]["devices"]["arm"]["serial"]}"\n'
        )
        for arguments in (("add", "cells.toml"), ("index", str(runs))):
            outcome = ftdrive.run("fleet", *arguments)
            assert outcome.returncode == 0, outcome.stderr
        attended = r"Cell press, robot \S+, tool emulated: does an operator stand at this cell"
        with in_terminal(ftdrive, "fleet", "verify") as command:
            command.type("yes")  # before the question
            command.answer(attended, "")
            assert command.end() == 0, command.screen
        assert command.screen.endswith("press: skipped\n")
        assert list(runs.iterdir()) == [calibrated]
        with in_terminal(ftdrive, "fleet", "verify", "press") as command:
            command.answer(attended, "yes")
            command.answer("Is the tool free", "yes")
            command.answer("free of obstacles and people", "yes")
            command.answer("Is the emergency stop in reach, and tested", "yes")
            command.answer("Type MOVE", "MOVE")
            command.answer("Begin", "yes")
            assert command.end() == 0, command.screen
        assert command.screen.endswith("press: passed\n")
    (verified,) = (run for run in runs.iterdir() if run != calibrated)
    assert (verified / "verification.json").exists()
    (state,) = ftdrive.json("fleet", "status")["cells"]
    assert (state["cell"], state["passed"], state["is_due"]) == ("press", True, False)
