"""Speed of calibration and compensation: times, and ratios to numpy measured in the same run.

    uv run python -m tests.benchmarks.speed [--quick]

Every ratio is of two times measured alternately, the best of several, so that what else runs on the machine cancels as
far as it can. Linear algebra has one thread.
"""

import argparse
import sys
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import pyarrow.csv
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation, RotationSpline

from ftcalib import CalibrationDataset, Parameters, solve
from ftcalib.compensation import Compensator
from ftcalib.likelihood import fit as likelihood
from ftcalib.model import Array
from ftdrive.tables.table import Table
from tests.benchmarks import scenarios as sim
from tests.benchmarks.common import Row, best_seconds, restart_with_one_thread, show_rows

MANY = 1_000_000
Floats = NDArray[np.floating[Any]]


def few_poses(repeats: int) -> Iterator[Row]:
    """Time nine calibrations, because the time of one depends on its noise."""
    rng = np.random.default_rng(0)
    R, s = np.swapaxes(sim.CUBE, 1, 2), sim.sigma(100)
    cov = np.broadcast_to(np.diag(s**2), (24, 6, 6))
    datasets = []
    for _ in range(9):
        y = sim.readings(sim.tool(rng), R) + s * rng.normal(size=(24, 6))
        datasets.append(CalibrationDataset(R, y, cov, np.full(24, 500), np.arange(24.0)))
    columns, target = rng.normal(size=(144, 10)), datasets[0].wrench.ravel()

    def hundred_lstsq() -> None:
        for _ in range(100):
            np.linalg.lstsq(columns, target, rcond=None)

    *solves, plain = best_seconds(repeats, *(partial(solve, dataset) for dataset in datasets), hundred_lstsq)
    whole = float(np.median(solves))
    ratio = whole / (plain / 100)
    yield Row("whole solve, 24 poses", f"{1e3 * whole:.1f} ms", "<= 10 ms", whole <= 10e-3, repeats)
    yield Row("  the slowest of nine", f"{1e3 * max(solves):.1f} ms", "<= 40 ms", max(solves) <= 40e-3, repeats)
    yield Row("  over one plain 10-parameter lstsq", f"{ratio:.0f}", "<= 300", ratio <= 300, repeats)


def poses_of_own_covariance(repeats: int) -> Iterator[Row]:
    """Time 10⁴ poses whose noise is as measured, and 1.3 and 3 times as large: looking for the cause costs no more."""
    rng, n = np.random.default_rng(0), 10_000
    truth, s, R = sim.tool(rng), sim.sigma(100), Rotation.random(n, rng=rng).as_matrix()
    noise, cov = s * rng.normal(size=(n, 6)), np.tile(np.diag(s**2), (n, 1, 1))
    datasets = [
        CalibrationDataset(R, sim.readings(truth, R) + size * noise, cov, np.full(n, 500), np.arange(float(n)))
        for size in (1.0, 1.3, 3.0)
    ]
    columns = rng.normal(size=(6 * n, 10))
    times = best_seconds(
        repeats,
        *(partial(solve, dataset) for dataset in datasets),
        lambda: np.linalg.lstsq(columns, noise.ravel(), rcond=None),
    )
    good, *bad, plain = times
    yield Row(
        "10⁴ poses over one plain 10-parameter lstsq", f"{good / plain:.0f}", "<= 60", good / plain <= 60, repeats
    )
    for size, seconds in zip((1.3, 3.0), bad, strict=True):
        ratio = seconds / good
        yield Row(f"  noise {size:g} times the measured, over that", f"{ratio:.2f}", "<= 2", ratio <= 2, repeats)


def structured_poses(repeats: int) -> Iterator[Row]:
    """Time 5000 poses along a path under a gain, a cable and smooth errors of the orientations, beside 300 of them."""
    rng, n = np.random.default_rng(0), 5000
    truth, s = sim.tool(rng), sim.sigma(100)
    R = RotationSpline(np.arange(80.0), Rotation.random(80, rng=rng))(np.linspace(0, 79, n)).as_matrix()
    smooth = R.reshape(n, 9)
    turned = R @ Rotation.from_rotvec(smooth @ rng.normal(0, np.radians(0.2), (9, 3))).as_matrix()
    y = sim.readings(truth, turned) * rng.normal(1, 0.03, 6)
    y += smooth @ rng.normal(0, 3, (9, 6)) * s + s * rng.normal(size=(n, 6))
    every, some = (CalibrationDataset.of(R[part], y[part]) for part in (slice(None), np.arange(0, n, n // 300)))
    whole, part = best_seconds(repeats, partial(solve, every), partial(solve, some))
    yield Row("5000 poses with structured errors", f"{whole:.1f} s", "<= 5 s", whole <= 5, repeats)
    yield Row("  over every 16th of them", f"{whole / part:.1f}", "<= 10", whole / part <= 10, repeats)


def many_poses(repeats: int) -> Iterator[Row]:
    rng = np.random.default_rng(0)
    truth, s = sim.tool(rng), sim.sigma(100)
    R = np.tile(Rotation.random(1000, rng=rng).as_matrix(), (MANY // 1000, 1, 1))
    y = sim.readings(truth, R) + s * rng.normal(size=(MANY, 6))
    source = np.ones(R.size + y.size)
    copy = np.empty_like(source)
    cov = np.diag(s**2)
    whole, plain = best_seconds(
        repeats, lambda: likelihood.fit(R, y, cov, drift="none"), lambda: np.copyto(copy, source)
    )
    yield Row("10⁶ poses, covariance given, no drift", f"{1e3 * whole:.0f} ms", "<= 60 ms", whole <= 60e-3, repeats)
    ratio = whole / plain
    yield Row("  over np.copyto of the same bytes", f"{ratio:.1f}", "<= 8", ratio <= 8, repeats)


def naive(parameters: Parameters, wrench: Array, R_base_flange: Array) -> Array:
    """Compensate one sample with the formulas as they stand on paper."""
    force_N = parameters.R_flange_sensor.T @ R_base_flange.T @ parameters.gravity_force_base_N + parameters.force_bias_N
    torque_Nm = np.cross(parameters.p_sensor_com_m, force_N - parameters.force_bias_N) + parameters.torque_bias_Nm
    return np.asarray(wrench - np.concatenate([force_N, torque_Nm]))


def compensated_sample(repeats: int) -> Iterator[Row]:
    rng, calls = np.random.default_rng(0), 2000
    parameters = Parameters(Rotation.random(rng=rng).as_matrix(), *rng.normal(size=(4, 3)))
    wrench, R, out = rng.normal(size=6), Rotation.random(rng=rng).as_matrix(), np.empty(6)
    sample = Compensator(parameters).sample

    def repeated(call: Callable[[], object]) -> Callable[[], None]:
        def repeat() -> None:
            for _ in range(calls):
                call()

        return repeat

    slow, new, into = best_seconds(
        repeats,
        repeated(lambda: naive(parameters, wrench, R)),
        repeated(lambda: sample(wrench, R)),
        repeated(lambda: sample(wrench, R, out)),
    )
    for name, seconds in (("one sample", new), ("one sample into a buffer", into)):
        ratio = seconds / slow
        yield Row(f"compensation, {name}, over naive numpy", f"{ratio:.3f}", "<= 0.10", ratio <= 0.1, repeats)
    yield Row("  into a buffer", f"{1e6 * into / calls:.2f} µs", "<= 1.5 µs", into / calls <= 1.5e-6, repeats)


def compensated_samples(repeats: int, dtype: type[np.float64 | np.float32]) -> Iterator[Row]:
    rng, name = np.random.default_rng(0), np.dtype(dtype).name
    parameters = Parameters(Rotation.random(rng=rng).as_matrix(), *rng.normal(size=(4, 3)))
    wrench: Floats = rng.normal(size=(MANY, 6)).astype(dtype)
    R: Floats = np.tile(Rotation.random(1000, rng=rng).as_matrix(), (MANY // 1000, 1, 1)).astype(dtype)
    out, compensator = np.zeros((MANY, 6), dtype), Compensator(parameters, dtype)
    source = np.ones(MANY * (6 + 9 + 6) // 2, dtype)  # as many bytes as wrench, rotation and contact
    target = np.ones_like(source)
    copy, batch = best_seconds(repeats, lambda: np.copyto(target, source), lambda: compensator.batch(wrench, R, out))
    speed = MANY / batch / 1e6
    yield Row(
        f"compensation, {name}, of copy bandwidth", f"{copy / batch:.3f}", ">= 0.35", copy / batch >= 0.35, repeats
    )
    if dtype is np.float64:
        yield Row(f"  {name}", f"{speed:.0f} M/s", ">= 70 M/s", speed >= 70, repeats)


def text_table(repeats: int) -> Iterator[Row]:
    """Read a wrench of half a million rows, beside pyarrow on the whole file."""
    rows = np.round(np.random.default_rng(2).normal(size=(500_000, 7)), 6)
    rows[:, 0] = np.arange(len(rows)) / 7000
    with TemporaryDirectory() as folder:
        path = Path(folder, "wrench.csv")
        np.savetxt(path, rows, "%.6f", ",", header="t,fx,fy,fz,tx,ty,tz", comments="")

        def table() -> int:
            return sum(len(part.t_s) for part in Table(path).wrenches())

        def whole() -> object:
            return pyarrow.csv.read_csv(path, pyarrow.csv.ReadOptions(use_threads=False))

        ours, peer = best_seconds(repeats, table, whole)
    yield Row("text table, rows a second", f"{len(rows) / ours:.2g}", ">= 4e5", len(rows) / ours >= 4e5, repeats)
    yield Row("  over pyarrow of the whole file", f"{ours / peer:.1f}", "<= 3", ours / peer <= 3, repeats)


def measure(*, quick: bool = False) -> Iterator[Row]:
    """Measure everything."""
    yield from few_poses(5 if quick else 30)
    yield from poses_of_own_covariance(3 if quick else 10)
    yield from structured_poses(1 if quick else 3)
    yield from many_poses(3 if quick else 10)
    yield from compensated_sample(40)
    yield from compensated_samples(40, np.float64)
    yield from compensated_samples(40, np.float32)
    yield from text_table(3 if quick else 10)


def main() -> int:
    parser = argparse.ArgumentParser(description="Speed of calibration and compensation.")
    parser.add_argument("--quick", action="store_true", help="fewer repetitions")
    options = parser.parse_args()
    return show_rows(measure(quick=options.quick))


if __name__ == "__main__":
    restart_with_one_thread()
    sys.exit(main())
