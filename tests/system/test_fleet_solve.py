"""Runs solved again in processes and on a Dask cluster: the same bytes, whatever is killed."""

import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import psutil
import pytest

from drivers.errors import Unreachable
from ftdrive.fleet.resolve import solve_again, solved, solved_path, task_of
from ftdrive.fleet.workers import WorkerDied, Workers, answers, cluster_workers, local_workers
from tests.calibrated_runs import calibrated_run
from tests.dask_cluster import Cluster, dask_cluster
from tests.system.command_line import CommandLine, end_of, wait_until

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def cluster() -> Iterator[Cluster]:
    with dask_cluster(2) as cluster:
        yield cluster


@pytest.fixture
def runs(tmp_path: Path) -> list[Path]:
    """Eight calibrations of four tours."""
    return [calibrated_run(tmp_path / "runs", f"run-{number}", seed=number % 4) for number in range(8)]


def solved_by(workers: Workers, runs: list[Path], *, kill_below: int | None = None) -> list[bytes]:
    """Solve runs and take the results away; kill the worker of a process after the second result."""
    for number, (_, found) in enumerate(solve_again(runs, workers), 1):
        assert not isinstance(found, str), found
        if kill_below is not None and number == 2:
            below = psutil.Process(kill_below).children(recursive=True)
            max(below, key=lambda one: one.cpu_times().user).kill()
    results = [solved_path(run).read_bytes() for run in runs]
    for run in runs:
        solved_path(run).unlink()
    return results


def test_processes_give_the_same_bytes_also_if_one_is_killed(runs: list[Path]) -> None:
    expected = [solved(*task_of(run)) for run in runs]
    with local_workers(1) as one:
        assert solved_by(one, runs[:4]) == expected[:4]
    with local_workers(2) as two:
        assert solved_by(two, runs, kill_below=os.getpid()) == expected


def test_a_cluster_gives_the_same_bytes_also_if_a_worker_is_killed(runs: list[Path], cluster: Cluster) -> None:
    expected = [solved(*task_of(run)) for run in runs]
    with cluster_workers(cluster.address) as workers:
        assert workers.count == 2
        assert solved_by(workers, runs, kill_below=cluster.nannies[0].pid) == expected


def test_a_call_that_kills_its_worker_is_given_up_and_the_others_are_answered() -> None:
    def script(item: Path) -> tuple[str]:
        return ("__import__('os').kill(__import__('os').getpid(), 9)" if item.name in "37" else repr(item.name),)

    with local_workers(2) as workers:
        found = {item.name: answer for item, answer in answers(eval, script, map(Path, "0123456789"), workers)}
    assert {name for name, answer in found.items() if isinstance(answer, WorkerDied)} == {"3", "7"}
    assert all(answer == name for name, answer in found.items() if name not in "37")


def test_ctrl_c_keeps_what_is_solved_and_the_command_continues(runs: list[Path], ftdrive: CommandLine) -> None:
    command = [sys.executable, "-m", "ftdrive", "fleet", "solve", str(runs[0].parent), "--workers", "1"]
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    process = subprocess.Popen(command, cwd=ftdrive.folder, start_new_session=True, **pipes)
    kept = runs[0].parent
    wait_until(lambda: len(list(kept.glob("*/solved-*.json"))) >= 2, process)
    os.killpg(process.pid, signal.SIGINT)  # a terminal sends it to the workers too
    code, talk = end_of(process)
    assert (code, talk.strip()) == (130, "interrupted")
    assert list(kept.glob("*/*.partial")) == []
    before = len(list(kept.glob("*/solved-*.json")))
    assert 2 <= before < 8
    found = ftdrive.json("fleet", "solve", kept, "--workers", "1")
    assert (found["runs"], found["solved_before"], found["unchanged"]) == (8, before, 8)


def test_a_cluster_that_does_not_answer_or_has_no_worker_is_an_error_with_its_address() -> None:
    with (
        pytest.raises(Unreachable, match=r"dask://127\.0\.0\.1:1 .*start it"),
        cluster_workers("dask://127.0.0.1:1", timeout_s=0.1),
    ):
        pass
    with (
        dask_cluster(0) as empty,
        pytest.raises(Unreachable, match=r"no worker; start one: dask worker tcp://"),
        cluster_workers(empty.address, timeout_s=1),
    ):
        pass
