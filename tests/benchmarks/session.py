"""A whole session at the pace of a real cell, questions answered at once: wall time, and the truth against its sigma.

uv run python -m tests.benchmarks.session
"""

import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path

import numpy as np

from ftcalib.sampling import Sampling
from ftdrive.cell.emulated import Station
from ftdrive.session.options import SessionOptions
from ftdrive.session.session import calibrate
from ftdrive.terminal.operators import PlainOperator
from ftdrive.terminal.report import errors_in_sigma

TARGETS_S = {24: 150.0, 12: 84.0}
"""By poses."""


def main() -> int:
    failed = 0
    for poses, target_s in TARGETS_S.items():
        with Station("can", ["--seed", "2", "--time-scale", "1"]) as station, tempfile.TemporaryDirectory() as folder:
            cell = replace(station.cell, sampling=Sampling())
            options = SessionOptions(Path(folder), poses=poses, real=False, questions=False)
            start_s = time.perf_counter()
            outcome = calibrate(cell, PlainOperator(), options)
            took_s = time.perf_counter() - start_s
            if outcome is None:
                raise RuntimeError("this is no dry run")
            worst = max(np.abs(errors).max() for errors in errors_in_sigma(outcome.result, station.truth).values())
        passed = took_s <= target_s and worst < 4
        failed += not passed
        sys.stdout.write(
            f"{poses} poses: {took_s:.1f} s (target {target_s:.0f}), worst error {worst:.1f} sigma"
            f"  {'pass' if passed else 'FAIL'}\n"
        )
    return failed


if __name__ == "__main__":
    raise SystemExit(main())
