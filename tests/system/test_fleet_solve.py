"""Runs solved again in processes and on a Dask cluster: the same bytes, whatever is killed."""

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from ftdrive.fleet.resolve import solve_again, solve_run, solved_path
from ftdrive.fleet.workers import Workers, cluster_workers, local_workers
from ftdrivers.errors import Unreachable
from tests.calibrated_runs import calibrated_run
from tests.dask_cluster import dask_cluster, kill_busiest_worker
from tests.system.command_line import CommandLine, end_of, wait_until

pytestmark = pytest.mark.slow


@pytest.fixture
def runs(tmp_path: Path) -> list[Path]:
    """Eight calibrations of four tours."""
    return [calibrated_run(tmp_path / "runs", f"run-{number}", seed=number % 4) for number in range(8)]


def solved_by(workers: Workers, runs: list[Path], *, kill: bool = False) -> list[bytes]:
    """Solve runs and take the results away; kill a worker after the second result if wanted."""
    for number, (_, found) in enumerate(solve_again(runs, workers), 1):
        assert not isinstance(found, str), found
        if kill and number == 2:
            kill_busiest_worker()
    results = [solved_path(run).read_bytes() for run in runs]
    for run in runs:
        solved_path(run).unlink()
    return results


def test_processes_give_the_same_bytes_also_if_one_is_killed(runs: list[Path]) -> None:
    with local_workers(2) as workers:
        assert solved_by(workers, runs, kill=True) == [solve_run(run) for run in runs]


def test_a_cluster_gives_the_same_bytes_also_if_a_worker_is_killed(runs: list[Path]) -> None:
    with pytest.raises(Unreachable, match=r"dask://127\.0\.0\.1:1 .*start the scheduler"):
        solved_on("dask://127.0.0.1:1", runs)
    with dask_cluster() as cluster:
        with pytest.raises(Unreachable, match="no worker; start one: dask worker tcp://"):
            solved_on(cluster.address, runs, timeout_s=3)  # a busy scheduler needs longer than the first address
        cluster.start_worker()
        cluster.start_worker()
        found = solved_on(cluster.address, runs, timeout_s=60, kill=True)
    assert found == [solve_run(run) for run in runs]


def solved_on(address: str, runs: list[Path], *, timeout_s: float = 0.1, kill: bool = False) -> list[bytes]:
    with cluster_workers(address, timeout_s=timeout_s) as workers:
        return solved_by(workers, runs, kill=kill)


def test_ctrl_c_keeps_what_is_solved_and_the_command_continues(runs: list[Path], ftdrive: CommandLine) -> None:
    command = [sys.executable, "-m", "ftdrive", "fleet", "solve", str(runs[0].parent), "--workers", "1"]
    process = subprocess.Popen(
        command, cwd=ftdrive.folder, start_new_session=True, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    kept = runs[0].parent
    wait_until(lambda: len(list(kept.glob("*/solved-*.json"))) >= 2, process)
    os.killpg(process.pid, signal.SIGINT)  # a terminal sends it to the workers too
    code, printed = end_of(process)
    assert (code, printed.strip()) == (130, "interrupted")
    assert list(kept.glob("*/*.partial")) == []
    before = len(list(kept.glob("*/solved-*.json")))
    assert 2 <= before < 8
    found = ftdrive.json("fleet", "solve", kept, "--workers", "1")
    assert (found["runs"], found["solved_before"], found["unchanged"]) == (8, before, 8)
    assert [solved_path(run).read_bytes() for run in runs] == [solve_run(run) for run in runs]
