"""Bias and part, followed and weighed beside an emulated production program with the imperfections of a real cell.

    uv run python -m tests.benchmarks.tracking [--seeds 8] [--seconds 240]

The program picks, places and touches without rest. Parts have up to 3 kg, and the bias drifts by 1 N an hour. The
calibration is one at rest, or one in motion, which knows the inertia. The last row has the weighings in motion: of each
part from .2 kg on the first answer, which comes while the arm carries it, and the worst of all answers while the load
is the same, those of contacts included. Exit code: rows that fail.
"""

import sys
from dataclasses import replace

import click
import numpy as np

from ftcalib.result import MotionResult
from ftdrive.live.processing import Processor
from ftdrive.live.samples import StreamEvent, Tracked
from ftmocks.ur.production import Job
from ftmocks.world import Truth
from tests.emulated_arm import HEIGHT_M, PERIOD_S, Array, Recorded, cell, record
from tests.unit.ftdrive.live.simulated import calibrated_from, info

DELAY_S, BLOCK, NEAR_S = 0.003, 10, 4.0
LEAST_KG, STEADY_S = 0.2, 0.3


def followed(truth: Truth, recorded: Recorded, *, in_motion: bool) -> tuple[Array, list[StreamEvent], list[Tracked]]:
    """Return the largest error of the bias in each window, in sigmas, the events, and what was known."""
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
    off, known = list[float](), list[Tracked]()
    for i in range(0, len(rows), BLOCK):
        processor.process(rows.rows(slice(i, i + BLOCK)))
        tracked = processor._following.tracked
        if tracked is not None and not (known and tracked is known[-1]):
            off.append(float(np.abs((believed + tracked.bias - recorded.bias[i]) / tracked.sigma).max()))
            known.append(tracked)
    return np.array(off), processor.take_events(), known


def weighed(recorded: Recorded, known: list[Tracked]) -> tuple[list[float], list[float]]:
    """Return error over sigma of the first answer to each part, and of all answers."""
    first, every, seen = list[float](), list[float](), -1
    changes = recorded.t_s[1:][np.diff(recorded.part_kg) != 0]
    for one in known:
        t_s = one.t_s - 1000
        part, after = np.searchsorted(changes, [t_s - STEADY_S, t_s + STEADY_S])
        part_kg = float(np.interp(t_s, recorded.t_s, recorded.part_kg))
        if part != after or not one.part_known or part_kg < LEAST_KG:
            continue
        every.append((one.part_kg - part_kg) / one.part_sigma_kg)
        if part != seen:
            seen = part
            first.append(every[-1])
    return first, every


@click.command()
@click.option("--seeds", type=int, default=8, show_default=True)
@click.option("--seconds", type=float, default=240.0, show_default=True)
def main(seeds: int, seconds: float) -> None:
    """Print the rows."""
    failed, first, every = 0, list[float](), list[float]()
    for seed in range(1, seeds + 1):
        drift = np.random.default_rng([seed, 5]).normal(size=3)
        drift /= 60 * np.linalg.norm(drift)
        truth = cell(seed, force_drift_N_min=drift, torque_drift_Nm_min=0.03 * drift)
        recorded = record(truth, seconds, seed, job=Job(None, seed))
        changes = np.flatnonzero(np.diff(recorded.part_kg))
        steps = [(recorded.t_s[k + 1], recorded.part_kg[k + 1] - recorded.part_kg[k]) for k in changes]
        steps = [step for step in steps if step[0] < seconds - NEAR_S]
        for in_motion in (False, True):
            off, events, known = followed(truth, recorded, in_motion=in_motion)
            answers = weighed(recorded, known)
            first += answers[0]
            every += answers[1]
            loads = [(e.t_host_ns * 1e-9 - 1000, e.values["mass_kg"]) for e in events if e.kind == "load-step"]
            loads = [load for load in loads if load[0] < seconds - NEAR_S]
            found = sum(any(abs(t - at) < NEAR_S and abs(m - kg) < 0.05 for t, m in loads) for at, kg in steps)
            failed += not (off < 3).all() or found < len(steps)
            click.echo(
                f"seed {seed}, calibrated {'in motion' if in_motion else 'at rest':9}: bias within 3 sigma in "
                f"{np.mean(off < 3):.1%} (largest {off.max():.1f}), steps {found} of {len(steps)}, "
                f"others {len(loads) - found}"
            )
    ratio, worst = float(np.sqrt(np.mean(np.square(first)))), float(np.abs(every).max())
    failed += not (0.8 <= ratio <= 1.25 and worst < 4)
    click.echo(
        f"weighed in motion: {len(first)} parts, error / sigma {ratio:.2f}; of {len(every)} answers the worst "
        f"{worst:.1f} sigma"
    )
    sys.exit(failed)


if __name__ == "__main__":
    main()
