"""A sweep of 20 s against the tour of 24 poses, in the same emulated cells with vibration.

    python -m tests.benchmarks.sweep --seeds 10      # about 20 minutes
    python -m tests.benchmarks.sweep --seeds 10 --sensor netft

Seed k draws the load, the mounting, the biases and the noise of cell k. The tour runs in a cell whose arm is 20 times
faster, with averages of 2 s at each pose as in a real cell; the sweep runs at real speed. Errors are those of a free
tool over all orientations, against the truth of the cell. Prints one row a cell, then the ratios and the worst times.
"""

import argparse
import sys
from collections.abc import Mapping
from dataclasses import replace
from datetime import datetime
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from ftdrive.cell.config import SamplingConfig
from ftdrive.cell.emulated import REAL_PACE, Station
from ftdrive.runs.outcome import Outcome
from ftdrive.session.options import SessionOptions
from ftdrive.session.rehearsal import NoOperator, described
from ftdrive.session.session import calibrate
from ftdrive.terminal.report import compensation_error, errors_in_sigma

RATIO, SESSION_S = 1.5, 30.0


def calibrated(sensor: str, seed: int, folder: Path, mode: Any) -> tuple[Outcome, Mapping[str, Any]]:
    """Calibrate one cell; also return its truth."""
    options = ["--seed", str(seed), *(REAL_PACE if mode == "sweep" else ())]
    with Station(sensor, options, control_path="script") as station:
        cell = replace(station.cell, sampling=SamplingConfig())
        chosen = SessionOptions(folder, mode=mode, real=False, questions=False, description=described(station))
        outcome = calibrate(cell, NoOperator(), chosen)
        assert outcome is not None
        return outcome, station.truth


def motion_to_verdict_s(outcome: Outcome) -> float:
    """From the first motion of a run to its result, by the computer's clock."""
    begin = next(
        event["t_utc"] for event in outcome.run.events() if event.get("state") in {"approach", "move", "sweep"}
    )
    end = outcome.run.calibration_path.stat().st_mtime
    return end - datetime.fromisoformat(begin).timestamp()


def main() -> int:
    """Print the table; return the number of targets that were missed."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--sensor", default="netft")
    options = parser.parse_args()
    show = sys.stdout.write
    show("seed  tour N     mN·m   sweep N    mN·m   verdict  inertia sigma, g·m²  delay ms        s  findings\n")
    rows, ratios_of = [], list[Mapping[str, Any]]()
    with TemporaryDirectory() as folder:
        for seed in range(options.seeds):
            tour, truth = calibrated(options.sensor, seed, Path(folder), "auto")
            sweep, _ = calibrated(options.sensor, seed, Path(folder), "sweep")
            errors = [value for one in (tour, sweep) for value in compensation_error(one.result, truth).values()]
            motion, seconds = sweep.result.motion, motion_to_verdict_s(sweep)
            assert motion is not None
            inertia = 1e3 * float(np.sqrt(np.diag(motion.covariance)[15:18].max()))
            rows.append([*errors, seconds])
            ratios_of.append(errors_in_sigma(sweep.result, truth))
            codes = " ".join(one.code for one in sweep.result.findings if one.severity != "note")
            show(
                f"{seed:4}{errors[0]:8.4f}{1e3 * errors[1]:9.3f}{errors[2]:10.4f}{1e3 * errors[3]:8.3f}"
                f"{sweep.result.verdict:>10}{inertia:14.3f}{1e3 * motion.delay_s:17.2f}{seconds:11.1f}  {codes}\n"
            )
            sys.stdout.flush()
    force_N, torque_Nm, swept_N, swept_Nm = np.sqrt(np.mean(np.square(np.array(rows)[:, :4]), axis=0))
    ratios = swept_N / force_N, swept_Nm / torque_Nm
    longest_s = max(row[4] for row in rows)
    show(f"rms: tour {force_N:.4f} N, {1e3 * torque_Nm:.3f} mN·m; sweep {swept_N:.4f} N, {1e3 * swept_Nm:.3f} mN·m\n")
    show(f"ratio: force {ratios[0]:.2f}, torque {ratios[1]:.2f} (target {RATIO})\n")
    show(f"first motion to verdict: {longest_s:.1f} s at most (target {SESSION_S:.0f} s)\n")
    for name in ratios_of[0]:
        values = np.array([one[name] for one in ratios_of])
        inside = np.mean(np.abs(values) < 2)
        show(f"error / sigma of {name:24}{np.sqrt(np.mean(values**2)):6.2f}, {100 * inside:.0f} % within 2\n")
    return sum(value > limit for value, limit in ((*zip(ratios, (RATIO, RATIO), strict=True), (longest_s, SESSION_S))))


if __name__ == "__main__":
    sys.exit(main())
