"""Bias and part, followed beside an emulated production program with the imperfections of a real cell.

    uv run python -m tests.benchmarks.tracking [--seeds 8] [--seconds 240]

The program picks, places and touches without rest. Parts have up to 3 kg, and the bias drifts by 1 N an hour. The
calibration is one at rest, or one in motion, which knows the inertia. Exit code: rows that fail.
"""

import sys
from dataclasses import replace

import click
import numpy as np

from ftcalib.result import MotionResult
from ftdrive.live.processing import Processor
from ftdrive.live.samples import StreamEvent
from ftmocks.ur.production import Job
from ftmocks.world import Truth
from tests.emulated_arm import HEIGHT_M, PERIOD_S, Array, Recorded, cell, record
from tests.unit.ftdrive.live.simulated import calibrated_from, info

DELAY_S, BLOCK, NEAR_S = 0.003, 10, 4.0


def followed(truth: Truth, recorded: Recorded, *, in_motion: bool) -> tuple[Array, list[StreamEvent]]:
    """Return the largest error of the bias in each window, in sigmas, and the events."""
    calibration = calibrated_from(truth.to_json())
    if in_motion:
        assert truth.inertia_kg_m2 is not None
        motion = MotionResult(truth.inertia_kg_m2, DELAY_S, HEIGHT_M, 1e-8 * np.eye(23), 1.0)
        calibration = replace(calibration, motion=motion)
    at = recorded.t_s - DELAY_S
    q_rad = np.stack([np.interp(at, recorded.t_s, column) for column in recorded.q_rad.T], axis=1)
    rows = replace(recorded, q_rad=q_rad).paired()
    processor = Processor(info(calibration, 1 / PERIOD_S))
    processor.track, processor.delay_sigma_s = "show", 5e-4
    believed = np.concatenate([calibration.force_bias_N, calibration.torque_bias_Nm])
    off, before = list[float](), None
    for i in range(0, len(rows), BLOCK):
        processor.process(rows.rows(slice(i, i + BLOCK)))
        tracked = processor._following.tracked
        if tracked is not None and tracked is not before:
            off.append(float(np.abs((believed + tracked.bias - recorded.bias[i]) / tracked.sigma).max()))
            before = tracked
    return np.array(off), processor.take_events()


@click.command()
@click.option("--seeds", type=int, default=8, show_default=True)
@click.option("--seconds", type=float, default=240.0, show_default=True)
def main(seeds: int, seconds: float) -> None:
    """Print the rows."""
    failed = 0
    for seed in range(1, seeds + 1):
        drift = np.random.default_rng([seed, 5]).normal(size=3)
        drift /= 60 * np.linalg.norm(drift)
        truth = cell(seed, force_drift_N_min=drift, torque_drift_Nm_min=0.03 * drift)
        recorded = record(truth, seconds, seed, job=Job(None, seed))
        changes = np.flatnonzero(np.diff(recorded.part_kg))
        steps = [(recorded.t_s[k + 1], recorded.part_kg[k + 1] - recorded.part_kg[k]) for k in changes]
        steps = [step for step in steps if step[0] < seconds - NEAR_S]
        for in_motion in (False, True):
            off, events = followed(truth, recorded, in_motion=in_motion)
            loads = [(e.t_host_ns * 1e-9 - 1000, e.values["mass_kg"]) for e in events if e.kind == "load-step"]
            loads = [load for load in loads if load[0] < seconds - NEAR_S]
            found = sum(any(abs(t - at) < NEAR_S and abs(m - kg) < 0.05 for t, m in loads) for at, kg in steps)
            failed += not (off < 3).all() or found < len(steps)
            click.echo(
                f"seed {seed}, calibrated {'in motion' if in_motion else 'at rest':9}: bias within 3 sigma in "
                f"{np.mean(off < 3):.1%} (largest {off.max():.1f}), steps {found} of {len(steps)}, "
                f"others {len(loads) - found}"
            )
    sys.exit(failed)


if __name__ == "__main__":
    main()
