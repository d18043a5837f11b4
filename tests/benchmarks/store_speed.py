"""Time to read and write a store of 200 cells with daily verifications of one year, on SQLite and PostgreSQL.

uv run python tests/benchmarks/store_speed.py
"""

import shutil
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path

import numpy as np

from ftdrive.store import tables
from ftdrive.store.records import Record, StoredCell, StoredResult, StoredVerification, read_record
from ftdrive.store.store import Store
from tests.postgres import Server, find_programs
from tests.unit.ftdrive.store.run_folders import new_run, result, verified

CELLS, DAYS, READ_DAYS = 200, 365, 90
NOW = datetime(2026, 11, 22, 6, tzinfo=UTC)


def records(example: StoredResult, check: StoredVerification) -> list[Record]:
    """Make one calibration and its verifications for each cell."""
    rng, found = np.random.default_rng(1), list[Record]()
    for cell in range(CELLS):
        made = (NOW - timedelta(days=DAYS + cell / CELLS)).isoformat(timespec="microseconds")
        of_cell = f"{cell:012x}"
        path = f"/data/cell-{cell:03d}/runs/calibrate/calibration.json"
        found.append(replace(example, id=of_cell, path=path, created_utc=made, arm_serial=f"2024{cell:06d}"))
        change = rng.normal(size=(DAYS, 18)) / 10
        for day, values in enumerate(change.tolist()):
            run = f"{(NOW - timedelta(days=day)):%Y-%m-%dT%H%M%SZ}-verify"
            found.append(
                replace(
                    check,
                    id=f"{cell:06x}{day:06x}",
                    path=f"/data/cell-{cell:03d}/runs/{run}/verification.json",
                    run=run,
                    calibration_id=of_cell,
                    created_utc=(NOW - timedelta(days=day, minutes=cell)).isoformat(timespec="microseconds"),
                    bias_change=values[:6],
                    bias_change_sigma=values[6:12],
                    calibration_sigma=values[12:],
                )
            )
    return found


def best_of(act: Callable[[], object], n: int = 3) -> float:
    """Return the shortest time of n calls, in s."""
    times = []
    for _ in range(n):
        start_s = time.perf_counter()
        act()
        times.append(time.perf_counter() - start_s)
    return min(times)


def measure(url: str, every: list[Record], runs: Path) -> None:
    """Fill an empty database, and print the times."""
    store = Store(url)
    store.put_cells(
        StoredCell(
            name=f"cell-{n:03d}",
            config=f"/cells/{n}.toml",
            verify_every_days=7,
            arm_serial=f"2024{n:06d}",
            robot_host=None,
            sensor_url=None,
            tool=None,
        )
        for n in range(CELLS)
    )
    with store._database.writing() as connection:
        for kind, table in tables.RECORDS.items():
            rows = [tables.to_row(one) for one in every if isinstance(one, kind)]
            connection.execute(store._database.upsert(table), rows)
    since = NOW - timedelta(days=READ_DAYS)
    n = len(store.fleet(3, since)[2])
    times = {
        f"{CELLS} cells, results, {n} verifications": best_of(lambda: store.fleet(3, since)),
        f"{CELLS} results": best_of(store.results),
        f"{CELLS} cells": best_of(store.cells),
        "index one new run": best_of(
            lambda: store.index(new_run(runs, f"{time.time_ns()}", result(time.time() % 1e6)))
        ),
    }
    sys.stdout.write(f"{url.partition(':')[0]}\n")
    for name, time_s in times.items():
        sys.stdout.write(f"  {name:36} {1000 * time_s:8.1f} ms\n")


def main() -> None:
    """Measure both."""
    folder = Path(tempfile.mkdtemp())
    run = new_run(folder / "example", "a", result())
    pose = {
        "R_base_flange": np.eye(3).tolist(),
        **{name: 6 * [1 / 3] for name in ("measured", "predicted", "residual")},
    }
    verified(run, "abc", bias_change={"value": 6 * [0.1], "sigma": 6 * [0.1]}, poses=12 * [pose])
    example, check = (read_record(run / name) for name in ("calibration.json", "verification.json"))
    assert isinstance(example, StoredResult)
    assert isinstance(check, StoredVerification)
    files = best_of(lambda: [read_record(Path(check.path)) for _ in range(1000)])
    sys.stdout.write(
        f"run folders: {files:.2f} ms for one verification, {files / 1000 * CELLS * READ_DAYS:.1f} s for all\n"
    )
    every = records(example, check)
    measure(f"sqlite:///{folder / 'store.sqlite'}", every, folder / "runs")
    if (programs := find_programs()) is None:
        sys.exit("PostgreSQL 15 or newer is not installed")
    server = Server(programs, Path(tempfile.mkdtemp()))
    measure(server.url(server.new_database()), every, folder / "runs")
    server.stop()
    shutil.rmtree(folder)


if __name__ == "__main__":
    main()
