"""Speed of `ftdrive fleet status`: 200 cells with a year of daily verifications, beside reading the run folders.

    uv run python -m tests.benchmarks.fleet_status [--cells 200] [--days 365] [--postgres] [--folders]

It fills a store: an SQLite file in a temporary folder, or a private PostgreSQL server. `--folders` also writes every
verification as a run folder, and reads them all (200 cells: 73 000 folders, 1 GB).
"""

import argparse
import json
import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from datetime import UTC, datetime, timedelta
from pathlib import Path
from tempfile import TemporaryDirectory

import click
import numpy as np

from ftdrive.fleet.status import fleet_state
from ftdrive.runs.run import RUN_FORMAT
from ftdrive.store.records import Record, StoredCell, StoredResult, StoredVerification, read_records, record_paths
from ftdrive.store.store import Store
from tests.postgres import Server, find_programs
from tests.unit.ftdrive.live.simulated import calibrated
from tests.unit.ftdrive.store.run_folders import new_run, result

NOW = datetime.now(UTC)
SIGMA = np.repeat([0.01, 0.0005], 3)
EVERY_DAYS = 90
"""Between two calibrations."""
FIELDS = ("R_flange_sensor", "gravity_force_base_N", "force_bias_N", "p_sensor_com_m", "torque_bias_Nm")


def records(cell: int, days: int, rng: np.random.Generator) -> Iterator[Record]:
    """Calibrations and daily verifications of one cell."""
    base = calibrated()
    name, made = f"cell-{cell:03d}", ""
    for day in range(days):
        created = (NOW - timedelta(days=days - day, hours=-1)).isoformat(timespec="microseconds")
        if day % EVERY_DAYS == 0:
            made = f"{cell:06d}{day:06d}"
            parameters = base.parameters.moved(rng.multivariate_normal(np.zeros(15), base.covariance))
            numbers = {key: getattr(parameters, key).tolist() for key in FIELDS}
            yield StoredResult(
                id=made, path=f"/runs/{name}/{day}-calibrate/calibration.json", run=f"{day}-calibrate",
                created_utc=created, tool="gripper", arm_serial=f"arm-{cell}", arm_model="UR5e",
                sensor_serial=f"ft-{cell}", sensor_model="Mini45", robot_host=f"10.0.{cell // 250}.{cell % 250}",
                mount=None, verdict="good", n_poses=24, mass_kg=base.mass_kg, g_m_s2=9.80665,
                numbers={**numbers, "covariance": base.covariance.tolist()}, dataset_sha256="0" * 64, parent=None,
                update=None, temperature_C=25.0, payload_kg=1.9, payload_com_m=[0.0, 0.0, 0.05],
            )  # fmt: skip
        yield StoredVerification(
            id=f"v{cell:05d}{day:06d}", path=f"/runs/{name}/{day}-verify/verification.json", run=f"{day}-verify",
            calibration_id=made, created_utc=created, passed=True, change=None,
            reason="the 6 poses agree with the calibration (chi2 35 for 36 readings, p 0.52)",
            temperature_C=float(22 + 6 * rng.random()), bias_change=(SIGMA * rng.normal(size=6)).tolist(),
            bias_change_sigma=SIGMA.tolist(), calibration_sigma=(SIGMA / 2).tolist(),
        )  # fmt: skip


def fill(store: Store, cells: int, days: int) -> None:
    """Write the fleet into a store, without run folders."""
    rng = np.random.default_rng(1)
    store.put_cells(
        StoredCell(
            name=f"cell-{n:03d}",
            config=f"/cells/{n}.toml",
            verify_every_days=1.0,
            arm_serial=f"arm-{n}",
            robot_host=f"10.0.{n // 250}.{n % 250}",
            sensor_url="ati-can://can0",
            tool="gripper",
        )
        for n in range(cells)
    )
    with store._database.writing() as connection:
        for n in range(cells):
            store._write(connection, list(records(n, days, rng)))


def write_folders(parent: Path, cells: int, days: int) -> None:
    """Write the verifications as run folders, each with a file of the usual size."""
    rng = np.random.default_rng(1)
    pose = {"q_rad": [0.1] * 6, "R_base_flange": [[0.1] * 3] * 3, "measured": [0.123456789012] * 6}
    pose |= {name: [0.123456789012] * 6 for name in ("predicted", "residual", "sigma")}
    header = json.dumps({"format": RUN_FORMAT, "created_utc": NOW.isoformat(), "config": {"robot": {"host": "a"}}})
    for n in range(cells):
        for one in records(n, days, rng):
            if not isinstance(one, StoredVerification):
                continue
            (folder := parent / f"cell-{n:03d}" / one.run).mkdir(parents=True)
            (folder / "run.json").write_text(header)
            change = (one.bias_change, one.bias_change_sigma, one.calibration_sigma)
            document = {
                "format": "ftdrive.verification/1", "calibration": {"id": one.calibration_id, "path": "a"},
                "created_utc": one.created_utc, "passed": True, "change": None, "reason": one.reason,
                "temperature_C": one.temperature_C, "poses": [pose] * 6, "argv": ["ftdrive", "verify"] * 4,
                "bias_change": dict(zip(("value", "sigma", "calibration_sigma"), change, strict=True)),
            }  # fmt: skip
            (folder / "verification.json").write_text(json.dumps(document, indent=1))


def main() -> None:
    """Fill a store, and print how long the status takes."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--cells", type=int, default=200)
    parser.add_argument("--days", type=int, default=365)
    parser.add_argument("--postgres", action="store_true", help="Use a private PostgreSQL server.")
    parser.add_argument("--folders", action="store_true", help="Also read the run folders.")
    options = parser.parse_args()
    with TemporaryDirectory(prefix="fleet-status-") as folder, ExitStack() as stack:
        url = f"sqlite:///{folder}/store.sqlite"
        if options.postgres:
            programs = find_programs()
            assert programs is not None, "install PostgreSQL 15 or newer"
            Path(folder).chmod(0o755)
            (data := Path(folder) / "postgres").mkdir()
            server = Server(programs, data)
            stack.callback(server.stop)
            url = server.url(server.new_database())
        store = Store(url)
        fill(store, options.cells, options.days)
        click.echo(f"{store.name}: {options.cells} cells, {options.days} daily verifications each; seconds, of CPU")
        environment = {**os.environ, "XDG_CONFIG_HOME": folder}
        command = [sys.executable, "-m", "ftdrive", "fleet", "status", "--store", url]
        rows = (
            ("`ftdrive fleet status`, whole process", lambda: _run(command, environment)),
            ("`ftdrive fleet status --html`", lambda: _run([*command, "--html", _new(folder)], environment)),
            ("`ftdrive --help`, whole process", lambda: _run([sys.executable, "-m", "ftdrive", "--help"], environment)),
            ("`fleet_state`, in the process of a server", lambda: fleet_state(store, NOW)),
            ("index one new run", lambda: store.index(_new_run(Path(folder)))),
        )
        for title, call in rows:
            best = [min(column) for column in zip(*(_seconds(call) for _ in range(5)), strict=True)]
            click.echo(f"  {title:45} {best[0]:.2f} {best[1]:.2f}")
        if options.folders:
            write_folders(runs := Path(folder) / "runs", options.cells, options.days)
            cells = sorted(runs.iterdir())
            click.echo(f"  {'reading the run folders':45} {_seconds(lambda: read_records(record_paths(cells)))[0]:.2f}")


def _new(folder: str) -> str:
    return f"{folder}/{time.monotonic_ns()}.html"


def _new_run(folder: Path) -> Path:
    day = time.time() % 1e6
    return new_run(folder / "new", f"{time.monotonic_ns()}", result(day))


def _run(command: list[str], environment: dict[str, str]) -> object:
    return subprocess.run(command, check=True, capture_output=True, env=environment)


def _seconds(call: Callable[[], object]) -> tuple[float, float]:
    """Return the time that a call takes, and the CPU time of this process and of those that have ended in it."""
    start, used = time.perf_counter(), os.times()
    call()
    ended = os.times()
    return time.perf_counter() - start, sum(ended[:4]) - sum(used[:4])


if __name__ == "__main__":
    main()
