"""A Dask scheduler and its workers as processes on this computer, and how to kill a worker."""

import json
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory

import psutil

Process = subprocess.Popen[bytes]


@dataclass(frozen=True)
class Cluster:
    """What was started."""

    address: str
    """dask://HOST:PORT"""
    start_worker: Callable[[], Process]
    """Gives a process that has one worker of one thread below it, and starts another if that is killed."""


@contextmanager
def dask_cluster() -> Iterator[Cluster]:
    """Start a scheduler."""
    with TemporaryDirectory(prefix="ftdrive-dask-") as folder, ExitStack() as stack:
        log = stack.enter_context((Path(folder) / "log").open("wb"))

        def start(*arguments: str) -> Process:
            command = [sys.executable, "-m", "dask", *arguments, "--no-dashboard", "--scheduler-file", str(file)]
            process = subprocess.Popen(command, stdout=log, stderr=log, cwd=folder)
            stack.callback(process.wait)
            stack.callback(process.terminate)
            return process

        file = Path(folder) / "scheduler.json"
        scheduler = start("scheduler", "--host", "127.0.0.1", "--port", "0")
        while not file.exists():
            if scheduler.poll() is not None:
                raise RuntimeError((Path(folder) / "log").read_text())
            time.sleep(0.05)
        address = str(json.loads(file.read_text())["address"]).replace("tcp://", "dask://")
        limits = ("--nthreads", "1", "--memory-limit", "0", "--host", "127.0.0.1", "--local-directory", folder)
        yield Cluster(address, partial(start, "worker", *limits))


def kill_busiest_worker() -> None:
    """Kill the process below this one that has computed most, be it of a pool or of a cluster."""
    below = psutil.Process().children(recursive=True)
    workers = []
    for one in below:
        with suppress(psutil.Error):  # it has ended meanwhile
            if "dask" not in one.cmdline():  # neither the scheduler nor what starts workers
                workers.append(one)
    max(workers, key=lambda one: one.cpu_times().user).kill()
