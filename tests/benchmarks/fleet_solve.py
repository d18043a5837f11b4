"""Many runs solved again: speed-up, memory, a killed worker, identical bytes.

    uv run python -m tests.benchmarks.fleet_solve [--runs 10000] [--workers N] [--dask]

Prints one row per figure: name, figure, target, pass or FAIL. The exit code is the number of rows that failed. The run
folders are copies of few distinct tours of 24 poses. Free cores are those that nothing else used during the pass, but
not more than workers.
`--dask` uses a scheduler and as many workers of one thread instead, as processes on this computer.
"""

import os

os.environ["OPENBLAS_NUM_THREADS"] = "1"  # before numpy is loaded: the serial solve has one core, as a worker has

import argparse
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, ExitStack, contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from time import perf_counter

import psutil

from ftdrive.fleet.resolve import solve_again, solved, solved_path, task_of
from ftdrive.fleet.workers import Workers, cluster_workers, local_workers
from tests.calibrated_runs import calibrated_run
from tests.dask_cluster import dask_cluster, kill_busiest_worker

DISTINCT, POSES = 20, 24
SPEED_UP, GROWTH_MB = 0.8, 20.0
"""Targets: of the free cores; of the parent's memory between a fifth of the runs and all."""
MEGA = 1e6


@dataclass(frozen=True)
class Pass:
    """All runs solved once."""

    wall_s: float
    free_cores: float
    """Those that no other program used on average."""
    memory_MB: list[float]
    """Of this process, each second."""
    wrong: int
    """Runs without a result, or with other bytes than this process gives."""


def main() -> int:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=int, default=10_000)
    parser.add_argument("--workers", type=int, default=os.cpu_count() or 1)
    parser.add_argument("--dask", action="store_true")
    options = parser.parse_args()
    failed = 0
    with TemporaryDirectory(prefix="ftdrive-fleet-") as name, ExitStack() as stack:
        runs = [calibrated_run(Path(name), f"run-{i:05d}", i % DISTINCT, poses=POSES) for i in range(options.runs)]
        expected, serial_s = serial(runs[:DISTINCT])
        say(f"{len(runs)} runs of {POSES} poses, {serial_s * 1e3:.0f} ms a solve in this process")
        few = runs[: max(100, len(runs) // 10)]
        one = measure(few, lambda: local_workers(1), expected)
        say(f"one worker: {one.wall_s / len(few) * 1e3:.0f} ms a run over {len(few)} runs")
        words = f"{options.workers} processes"
        engine: Callable[[], AbstractContextManager[Workers]] = partial(local_workers, options.workers)
        if options.dask:
            cluster = stack.enter_context(dask_cluster())
            for _ in range(options.workers):
                cluster.start_worker()
            words, engine = f"Dask, {options.workers} workers", partial(cluster_workers, cluster.address)
        for killed in (False, True):
            found = measure(runs, engine, expected, kill=killed)
            speed_up = serial_s * len(runs) / found.wall_s
            what = f"{words}, one killed" if killed else words
            if not killed:
                free = min(found.free_cores, options.workers)
                share = speed_up / free
                failed += row(f"{what}: speed-up {speed_up:.2f} over {free:.2f} free cores", share, SPEED_UP, 1)
            else:
                say(f"{what}: speed-up {speed_up:.2f}")
            fifth, last = found.memory_MB[len(found.memory_MB) // 5], found.memory_MB[-1]
            say(f"{what}: memory {fifth:.0f} MB after a fifth, {last:.0f} MB at the end")
            failed += row(f"{what}: memory, MB of growth", last - fifth, GROWTH_MB, -1)
            failed += row(f"{what}: runs without result or with other bytes", found.wrong, 0, -1)
        failed += row("one worker: runs without result or with other bytes", one.wrong, 0, -1)
    return failed


def serial(runs: list[Path]) -> tuple[list[str], float]:
    """Solve one run of each tour in this process; return the results and the mean time, s.

    The mean, because one tour in 20 takes seven times as long as the others.
    """
    solved(*task_of(runs[0]))  # imports and first calls
    start_s = perf_counter()
    expected = [solved(*task_of(run)).decode() for run in runs]
    return expected, (perf_counter() - start_s) / len(runs)


def measure(
    runs: list[Path],
    engine: Callable[[], AbstractContextManager[Workers]],
    expected: list[str],
    *,
    kill: bool = False,
) -> Pass:
    """Solve all runs, kill a worker half way if wanted, and take the results away."""
    with watched_memory() as memory_MB:
        start_s, start_others_s = perf_counter(), others_s()
        with engine() as workers:
            for number, (_, found) in enumerate(solve_again(runs, workers), 1):
                if isinstance(found, str):
                    say(found)
                if kill and number == len(runs) // 2:
                    kill_busiest_worker()
            wall_s = perf_counter() - start_s
            free_cores = (os.cpu_count() or 1) - (others_s() - start_others_s) / wall_s
    wrong = 0
    for i, run in enumerate(runs):
        path = solved_path(run)
        right = expected[i % DISTINCT].replace(runs[i % DISTINCT].name, run.name)
        wrong += not (path.exists() and path.read_text() == right)
        path.unlink(missing_ok=True)
    return Pass(wall_s, free_cores, memory_MB, wrong)


def others_s() -> float:
    """Return the computing time of all programs but this one and the processes below it."""
    all_s = psutil.cpu_times()
    this = psutil.Process()
    ours = [one.cpu_times() for one in (this, *this.children(recursive=True))]
    return float(all_s.user + all_s.nice + all_s.system - sum(one.user + one.system for one in ours))


@contextmanager
def watched_memory() -> Iterator[list[float]]:
    """Yield a list that gets the resident memory of this process each second, MB."""
    found, ended, this = list[float](), threading.Event(), psutil.Process()

    def watch() -> None:
        found.append(this.memory_info().rss / MEGA)
        while not ended.wait(1.0):
            found.append(this.memory_info().rss / MEGA)

    thread = threading.Thread(target=watch)
    thread.start()
    try:
        yield found
    finally:
        ended.set()
        thread.join()
        found.append(this.memory_info().rss / MEGA)


def say(words: str) -> None:
    """Print a line at once."""
    sys.stdout.write(f"{words}\n")
    sys.stdout.flush()


def row(name: str, figure: float, target: float, sign: int) -> bool:
    """Print a figure that must not be below (1) or above (-1) its target; return whether it is."""
    failed = sign * (figure - target) < 0
    say(f"{name:70} {figure:8.2f} {'>=' if sign > 0 else '<='} {target:g} {'FAIL' if failed else 'pass'}")
    return failed


if __name__ == "__main__":
    sys.exit(main())
