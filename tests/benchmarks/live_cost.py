"""Cost of pairing and processing: CPU seconds per second of a 7 kHz stream, and samples per second of a recording.

    uv run python tests/benchmarks/live_cost.py [--profile]

The loop beside it compensates one sample after the other with numpy, without frame, sigma and contact.
"""

import argparse
import cProfile
import pstats
import sys
import time

import numpy as np

from ftcalib.model import gravity_wrench
from ftdrive.live.delay import DelayEstimator
from ftdrive.live.pairing import Pairing
from ftdrive.live.processing import Processor
from ftdrive.live.samples import Paired, Stages, WrenchFrame
from ftdrivers.interfaces import ArmStates, FtSamples
from tests.unit.ftdrive.live.simulated import NOISE, P_FLANGE_SENSOR_M, T0_NS, Motion, calibrated, info, paired

RATE_HZ = 7000.0
SECONDS = 10


def stream(samples: FtSamples, states: ArmStates, stages: Stages, frame: WrenchFrame, block_ns: int) -> float:
    """CPU seconds per second of data."""
    pairing = Pairing(RATE_HZ, DelayEstimator(calibrated(), P_FLANGE_SENSOR_M))
    processor = Processor(info(calibrated(), RATE_HZ), frame, stages)
    ends = np.arange(T0_NS, T0_NS + SECONDS * 10**9, block_ns)
    cuts = [np.searchsorted(rows.t_host_ns, ends).tolist() for rows in (samples, states)]
    pieces = [
        (samples.rows(slice(*ij[:2])), states.rows(slice(*ij[2:])))
        for ij in zip(cuts[0][:-1], cuts[0][1:], cuts[1][:-1], cuts[1][1:], strict=True)
    ]
    begin_s = time.process_time()
    for block, poses in pieces:
        pairing.add_states(poses)
        pairing.add_samples(block)
        if (found := pairing.take()) is not None:
            processor.process(found)
    return (time.process_time() - begin_s) / SECONDS


def recording(rows: Paired, frame: WrenchFrame) -> float:
    """Samples per CPU second, a recording at once, best of three."""
    best_s = float("inf")
    for _ in range(3):
        processor = Processor(info(calibrated(), RATE_HZ), frame)
        begin_s = time.process_time()
        processor.process(rows, last=True)
        best_s = min(best_s, time.process_time() - begin_s)
    return len(rows) / best_s


def loop(rows: Paired) -> float:
    """Samples per CPU second of a plain loop."""
    parameters, n = calibrated().parameters, 20_000
    bias = np.concatenate([parameters.force_bias_N, parameters.torque_bias_Nm])
    begin_s = time.process_time()
    for i in range(n):
        rows.raw[i] - gravity_wrench(parameters, rows.R_base_flange[i]) - bias
    return n / (time.process_time() - begin_s)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--profile", action="store_true")
    profile = parser.parse_args().profile
    samples, states = Motion().links(SECONDS, 0.005, rate_Hz=RATE_HZ)
    base = WrenchFrame("base", "tcp")
    for block_ms, stages, frame in (
        (10, Stages(), WrenchFrame()),
        (10, Stages(lowpass_Hz=40.0), base),
        (10, Stages(inertia=True, lowpass_Hz=40.0), base),
        (5, Stages(), WrenchFrame()),
        (2, Stages(), WrenchFrame()),
    ):
        cost = stream(samples, states, stages, frame, block_ms * 1_000_000)
        name = f"7 kHz in blocks of {block_ms} ms, inertia {stages.inertia}, low-pass {stages.lowpass_Hz}, {frame.axes}"
        sys.stdout.write(f"{name:75} {100 * cost:5.1f} % of a core\n")
    t_s = np.arange(0, 1_000_000 / RATE_HZ, 1 / RATE_HZ)[:1_000_000]
    R = np.concatenate([Motion().pose(piece)[0] for piece in np.array_split(t_s, 20)])
    rows = paired(R, RATE_HZ)
    assert rows.raw.std() > NOISE[0]
    for frame in (WrenchFrame(), base):
        sys.stdout.write(
            f"a recording of {len(rows)} samples at once, {frame.axes:45} {recording(rows, frame):.3g} /s\n"
        )
    sys.stdout.write(f"a loop over samples in numpy {'':54} {loop(rows):.3g} /s\n")
    if profile:
        with cProfile.Profile() as profiler:
            stream(samples, states, Stages(), WrenchFrame(), 10_000_000)
        pstats.Stats(profiler).sort_stats("tottime").print_stats(25)


if __name__ == "__main__":
    main()
