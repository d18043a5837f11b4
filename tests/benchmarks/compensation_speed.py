"""Speed of the compensation, relative to naive numpy and to copying the same bytes.

    python tests/benchmarks/compensation_speed.py [rows]

Prints one line per figure: the figure, the ratio the target is about, the target, and pass or FAIL. Every ratio is of
two times measured in the same run, alternating, the best of several, so that other load on the machine mostly cancels.
"""

import sys
import time
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from ftcalib import Parameters
from ftcalib.compensation import Compensator
from ftcalib.model import Array

Floats = NDArray[np.floating[Any]]

SAMPLE_TARGET = 0.1  # of the naive version's time
BATCH_TARGET = 0.35  # of copy bandwidth
NUMBERS_PER_ROW = 6 + 9 + 6  # wrench and rotation in, contact out
REPEATS = 40


def naive(parameters: Parameters, wrench: Array, R_base_flange: Array) -> Array:
    """Compensate one sample with the formulas as they stand on paper."""
    force_N = parameters.R_flange_sensor.T @ R_base_flange.T @ parameters.gravity_force_base_N + parameters.force_bias_N
    torque_Nm = np.cross(parameters.p_sensor_com_m, force_N - parameters.force_bias_N) + parameters.torque_bias_Nm
    return np.asarray(wrench - np.concatenate([force_N, torque_Nm]))


def best_seconds(*calls: Callable[[], object]) -> list[float]:
    """Shortest time of each call over rounds in which each runs once."""
    best = [float("inf")] * len(calls)
    for _ in range(REPEATS):
        for i, call in enumerate(calls):
            start = time.perf_counter()
            call()
            best[i] = min(best[i], time.perf_counter() - start)
    return best


def report(name: str, figure: str, ratio: float, target: str, passed: bool) -> None:
    sys.stdout.write(
        f"{name:34} {figure:>20}   ratio {ratio:5.3f}   target {target:7} {'pass' if passed else 'FAIL'}\n"
    )


def one_sample(parameters: Parameters, wrench: Array, R_base_flange: Array) -> None:
    sample, out, calls = Compensator(parameters).sample, np.empty(6), 2000

    def repeat_naive() -> None:
        for _ in range(calls):
            naive(parameters, wrench, R_base_flange)

    def repeat_new() -> None:
        for _ in range(calls):
            sample(wrench, R_base_flange)

    def repeat_into() -> None:
        for _ in range(calls):
            sample(wrench, R_base_flange, out)

    slow, new, into = best_seconds(repeat_naive, repeat_new, repeat_into)
    sys.stdout.write(f"{'one sample, naive numpy':34} {slow / calls * 1e6:17.2f} µs\n")
    for name, seconds in (("one sample", new), ("one sample into a buffer", into)):
        ratio = seconds / slow
        report(name, f"{seconds / calls * 1e6:.2f} µs", ratio, f"<= {SAMPLE_TARGET:.2f}", ratio <= SAMPLE_TARGET)


def many_samples(parameters: Parameters, rows: int, dtype: type[np.float64 | np.float32]) -> None:
    rng = np.random.default_rng(0)
    wrench: Floats = rng.normal(size=(rows, 6)).astype(dtype)
    R_base_flange: Floats = np.tile(Rotation.random(1000, rng=rng).as_matrix(), (rows // 1000 + 1, 1, 1))[:rows].astype(
        dtype
    )
    out = np.zeros((rows, 6), dtype)
    compensator = Compensator(parameters, dtype)
    source = np.ones(rows * NUMBERS_PER_ROW // 2, dtype)  # written once, else all of it is one page of zeros
    target = np.ones_like(source)
    copy, batch = best_seconds(lambda: np.copyto(target, source), lambda: compensator.batch(wrench, R_base_flange, out))
    name = np.dtype(dtype).name
    sys.stdout.write(f"{f'{name}, copy of the same bytes':34} {rows / copy / 1e6:9.0f} M samples/s\n")
    ratio = copy / batch
    report(name, f"{rows / batch / 1e6:.0f} M samples/s", ratio, f">= {BATCH_TARGET:.2f}", ratio >= BATCH_TARGET)


def main() -> None:
    rng = np.random.default_rng(0)
    parameters = Parameters(Rotation.random(rng=rng).as_matrix(), *rng.normal(size=(4, 3)))
    rows = int(sys.argv[1]) if len(sys.argv) > 1 else 1_000_000
    one_sample(parameters, rng.normal(size=6), Rotation.random(rng=rng).as_matrix())
    many_samples(parameters, rows, np.float64)
    many_samples(parameters, rows, np.float32)


if __name__ == "__main__":
    main()
