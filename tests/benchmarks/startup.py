"""Start-up of commands: how long each takes, relative to importing what a solver needs at least.

    uv run python -m tests.benchmarks.startup [--rounds 7] [COMMAND ...]

Each round imports numpy, scipy.optimize, scipy.spatial.transform and click alone, then runs the help of each command
and its smallest real call. The figure is the least processor time of all rounds, and its ratio to that import, so that
other programs count little. Bytecode is written first, as an installation does. Exit code 1 if a limit is exceeded.
"""

import argparse
import os
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

from ftdrive.recording import Recorder
from ftdrive.words.text import COMMANDS
from tests.unit.ftdrive.recorded import block, info

_PEER = ("-c", "import numpy, scipy.optimize, scipy.spatial.transform, click")
_POSES = str(Path(__file__).parents[2] / "examples" / "poses.csv")
_CALLS = {
    "config": ("config", "show"),
    "plan": ("plan", "--model", "ur5e", "--minimal", "--tool", "0:60:90"),
    "devices": ("devices",),
    "solve": ("solve", "17.csv"),
    "report": ("report", "17.csv", "--output", "{new}.html"),
    "history": ("history",),
    "fleet": ("fleet", "status"),
    "diff": ("diff", "a.json", "a.json"),
    "convert": ("convert", "recording.csv", "{new}.csv"),
    "compensate": ("compensate", "recording.csv", "--bias", "estimate"),
    "export": ("export", "calibration", "a.json", "--format", "json"),
}
"""The smallest call that needs no device; the folder has 17 poses, their calibration, a store and a short recording."""
_LIMITS = {"solve": 1.5, "report": 2.0 / 0.45, "history": 0.35 / 0.45, "devices": 0.35 / 0.45}
"""Ratios: the times of the last three were set on a machine that takes 0.45 s for the import."""


def seconds(arguments: Sequence[str], folder: Path) -> float:
    """Run Python once; return the time of the processor."""
    environment = {**os.environ, "XDG_DATA_HOME": str(folder), "OMP_NUM_THREADS": "1"}
    environment.pop("PYTHONDONTWRITEBYTECODE", None)
    before = os.times()
    done = subprocess.run([sys.executable, *arguments], cwd=folder, env=environment, capture_output=True, check=False)
    if done.returncode:
        sys.exit(f"{' '.join(arguments)}: {done.stderr.decode()}")
    after = os.times()
    return after.children_user + after.children_system - before.children_user - before.children_system


def main() -> int:
    """Print the table."""
    parser = argparse.ArgumentParser()
    parser.add_argument("commands", nargs="*", default=list(COMMANDS))
    parser.add_argument("--rounds", type=int, default=7)
    given = parser.parse_args()
    calls: dict[str, Sequence[str]] = {"import": _PEER}
    for name in given.commands:
        calls[f"{name} --help"] = ("-m", "ftdrive", name, "--help")
        if name in _CALLS:
            calls[name] = ("-m", "ftdrive", *_CALLS[name])
    best = dict.fromkeys(calls, float("inf"))
    with tempfile.TemporaryDirectory() as made:
        folder = Path(made)
        lines = Path(_POSES).read_text("utf-8").splitlines(keepends=True)
        (folder / "17.csv").write_text("".join(lines[:18]), "utf-8")
        recorder = Recorder([folder / "recording.csv"], info(), {})
        recorder.add(block(2500), [])
        recorder.end()
        run = folder / "runs" / "a"
        run.mkdir(parents=True)
        seconds(("-m", "ftdrive", "solve", _POSES, "--output", str(run / "calibration.json")), folder)
        (run / "run.json").write_text('{"format": "ftdrive.run/1"}', "utf-8")
        (folder / "a.json").write_bytes((run / "calibration.json").read_bytes())
        seconds(("-m", "ftdrive", "history", "--index", "runs"), folder)
        for number in range(given.rounds + 1):  # the first writes bytecode
            for name, call in calls.items():
                took = seconds([part.replace("{new}", f"{number}") for part in call], folder)
                best[name] = min(best[name], took) if number else best[name]
    failed = 0
    for name, took in best.items():
        ratio, limit = took / best["import"], _LIMITS.get(name)
        failed += limit is not None and ratio > limit
        target = "" if limit is None else f"   limit {limit:.2f}{'' if ratio <= limit else '   FAIL'}"
        sys.stdout.write(f"{name:22}{took:6.2f} s   ratio {ratio:5.2f}{target}\n")
    return int(failed > 0)


if __name__ == "__main__":
    sys.exit(main())
