"""The command line as a user runs it: in this process where that makes no difference, else in one of its own."""

import json
import os
import subprocess
import sys
from pathlib import Path
from subprocess import CompletedProcess
from typing import Any

import pytest
from click.testing import CliRunner

from ftdrive import cli
from ftdrive.talk import talk


class CommandLine:
    """Runs `ftdrive` in a folder of its own."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._environment = {"COLUMNS": "200", "XDG_STATE_HOME": str(folder / "state")}

    def run(self, *arguments: str | Path, typed: str = "") -> CompletedProcess[str]:
        """Run it in this process to its end: a process of its own would only import the same modules again."""
        runner = CliRunner()
        with pytest.MonkeyPatch.context() as here, runner.isolation(typed, self._environment) as (out, err, _):
            here.chdir(self.folder)
            here.setattr(talk, "quiet", False)
            try:
                code = cli.run([*map(str, arguments)])
            except SystemExit as ended:
                code = int(ended.code or 0)
            sys.stdout.flush()
            sys.stderr.flush()
            return CompletedProcess(arguments, code, out.getvalue().decode(), err.getvalue().decode())

    def json(self, *arguments: str | Path, typed: str = "") -> dict[str, Any]:
        """Run it with --json; return its answer, the last line where it prints events before."""
        outcome = self.run(*arguments, "--json", typed=typed)
        assert outcome.returncode == 0, outcome.stderr
        answer: dict[str, Any] = json.loads(outcome.stdout.splitlines()[-1])
        return answer

    def start(self, *arguments: str | Path) -> subprocess.Popen[str]:
        """Start it as a process: for signals, and for what happens while it runs."""
        return subprocess.Popen(
            [sys.executable, "-m", "ftdrive", *map(str, arguments)],
            cwd=self.folder,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            env=os.environ | self._environment,
        )

    def poses(self) -> list[Path]:
        """Return the poses on disk, of the only run in the folder."""
        return sorted(self.folder.glob("runs/*/poses/*.npz"))
