"""What the benchmarks share: rows of figures against targets, simulations on two workers, times beside each other."""

import argparse
import os
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from multiprocessing import get_context
from multiprocessing.pool import Pool

import numpy as np
from numpy.typing import NDArray

from ftcalib import NotObservable

Array = NDArray[np.float64]
Record = dict[str, Array]
Worker = Callable[[int], dict[str, object]]


@dataclass(frozen=True)
class Row:
    """One line of a table; a row without a target always passes."""

    name: str
    figure: str
    target: str
    passed: bool
    runs: int = 1


def band(name: str, value: float, low: float, high: float, runs: int, unit: str = "", digits: int = 3) -> Row:
    """Compare with an interval; `low` of minus infinity or `high` of infinity disables that side."""
    if low == -np.inf:
        target = f"<= {high:.{digits}g}"
    elif high == np.inf:
        target = f">= {low:.{digits}g}"
    else:
        target = f"{low:.{digits}g} to {high:.{digits}g}"
    return Row(name, f"{value:.{digits}g}{unit}", target + unit, bool(low <= value <= high), runs)


def most(name: str, value: float, high: float, runs: int, unit: str = "", digits: int = 3) -> Row:
    """Compare with an upper limit."""
    return band(name, value, -np.inf, high, runs, unit, digits)


def all_within(name: str, values: Array, low: float, high: float, runs: int) -> Row:
    """Compare each of several figures, in the order of the parameter blocks, with one interval."""
    figure = "/".join(f"{v:.2f}" for v in values)
    target = f"{low:.2f} to {high:.2f}" if low > 0 else f"<= {high:.2f}"
    return Row(name, figure, target, bool(((values >= low) & (values <= high)).all()), runs)


def show(line: str) -> None:
    """Print a line at once, also into a pipe."""
    print(line, flush=True)  # noqa: T201


def show_rows(rows: Iterable[Row]) -> int:
    """Print rows as they come; return how many failed."""
    failed = 0
    for row in rows:
        failed += not row.passed
        mark = "pass" if row.passed else "FAIL"
        show(f"{row.name:75} {row.figure:>28}   {row.target:24} {mark} {row.runs:8}")
    return failed


class Lab:
    """Runs simulations on two workers."""

    def __init__(self, pool: Pool, *, quick: bool) -> None:
        self.pool, self.quick = pool, quick
        self.refused = 0

    def count(self, full: int, quick: int) -> int:
        """Choose the number of runs for the available time."""
        return quick if self.quick else full

    def simulate(self, worker: Worker, runs: int, seed: int = 0) -> Record:
        """Run a worker for consecutive seeds and stack the results; `refused` counts the refused runs."""
        jobs = self.pool.imap(partial(_attempt, worker), range(seed, seed + runs), chunksize=max(1, min(20, runs // 8)))
        records = [record for record in jobs if record is not None]
        self.refused = runs - len(records)
        return {key: np.array([record[key] for record in records], dtype=np.float64) for key in records[0]}


def _attempt(worker: Worker, seed: int) -> dict[str, object] | None:
    try:
        return worker(seed)
    except NotObservable:
        return None


def two_workers() -> Pool:
    """Start two processes with one thread of linear algebra each.

    They read that when they import numpy; two with a thread for each core would disturb each other.
    """
    os.environ["OPENBLAS_NUM_THREADS"] = os.environ["OMP_NUM_THREADS"] = "1"
    return get_context("spawn").Pool(2)


def run(parts: Mapping[str, Callable[[Lab], Iterator[Row]]], description: str, after: Sequence[str] = ()) -> int:
    """Print the rows of all parts, or of those named on the command line; return how many failed."""
    parser = argparse.ArgumentParser(description=description)
    parser.add_argument("--quick", action="store_true", help="few runs, wider targets")
    parser.add_argument("--only", choices=parts, action="append", help="one part; may be repeated")
    options = parser.parse_args()
    failed, start = 0, time.perf_counter()
    with two_workers() as pool:
        lab = Lab(pool, quick=options.quick)
        for name in options.only or parts:
            failed += show_rows(parts[name](lab))
    for line in after:
        show(line)
    show(f"{failed} rows failed; {time.perf_counter() - start:.0f} s")
    return failed


def restart_with_one_thread() -> None:
    """Start this script again with one thread of linear algebra, which numpy reads before its first import."""
    if os.environ.get("OPENBLAS_NUM_THREADS") != "1":
        os.environ["OPENBLAS_NUM_THREADS"] = "1"
        os.execv(sys.executable, sys.orig_argv)


def best_seconds(repeats: int, *calls: Callable[[], object]) -> list[float]:
    """Shortest time of each call over rounds in which each runs once: other load then cancels in ratios."""
    best = [float("inf")] * len(calls)
    for _ in range(repeats):
        for i, call in enumerate(calls):
            start = time.perf_counter()
            call()
            best[i] = min(best[i], time.perf_counter() - start)
    return best
