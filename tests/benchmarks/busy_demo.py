"""Every emulated sensor, ten seeds and every command on a computer that has no time for them.

uv run python -m tests.benchmarks.busy_demo              # beside three busy loops
uv run python -m tests.benchmarks.busy_demo --loops 0    # on an idle computer, to compare

A row passes if the exit code is 0 and, of a demo, the verdict is good. It may take as long as it likes.
"""

import argparse
import json
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence

from ftdrive.cell.emulated import SENSORS
from tests.busy_loops import busy_loops

SEEDS = range(10)
COMMANDS = (
    ("init", "--yes", "--height", "33", "--tool", "0:60:90"),
    ("config", "show"),
    ("plan",),
    ("calibrate", "--minimal", "--yes"),
    ("doctor",),
    ("devices",),
    ("solve",),
    ("live", "--once"),
    ("replay",),
    ("export", "plan", "--format", "csv"),
    ("transcript", "record", "--output", "sensor.jsonl", "--duration", "1"),
    ("transcript", "play"),
)


def passes(arguments: Sequence[str]) -> bool:
    """Run one command, print its row."""
    began_s = time.monotonic()
    with tempfile.TemporaryDirectory() as folder:
        outcome = subprocess.run(
            [sys.executable, "-m", "ftdrive", *arguments, "--simulate", "--json"],
            cwd=folder,
            stdin=subprocess.DEVNULL,
            capture_output=True,
            text=True,
            check=False,
        )
    took_s = time.monotonic() - began_s
    verdict = ""
    if arguments[0] == "demo" and outcome.returncode == 0:
        verdict = str(json.loads(outcome.stdout)["result"]["verdict"])
    passed = outcome.returncode == 0 and verdict in {"", "good"}
    sys.stdout.write(
        f"{' '.join(arguments):64} {outcome.returncode:4} {verdict:8} {took_s:6.1f}  {'pass' if passed else 'FAIL'}\n"
    )
    if not passed:
        sys.stdout.writelines(f"    {line}\n" for line in outcome.stderr.splitlines()[-3:])
    sys.stdout.flush()
    return passed


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--loops", type=int, default=3, help="busy loops beside it (%(default)s)")
    loops = parser.parse_args().loops
    rows = [("demo", "--seed", str(seed)) for seed in SEEDS]
    rows += [("demo", "--sensor", sensor) for sensor in SENSORS]
    sys.stdout.write(f"{'command':64} exit verdict  seconds\n")
    with busy_loops(loops):
        failed = [row for row in (*rows, *COMMANDS) if not passes(row)]
    sys.stdout.write(f"{len(failed)} of {len(rows) + len(COMMANDS)} rows failed\n")
    return len(failed)


if __name__ == "__main__":
    raise SystemExit(main())
