"""A Dask scheduler and its workers as processes on this computer."""

import json
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

Process = subprocess.Popen[bytes]


@dataclass(frozen=True)
class Cluster:
    """What was started."""

    address: str
    """dask://HOST:PORT"""
    scheduler: Process
    nannies: Sequence[Process]
    """Each has one worker of one thread below it, and starts another if that is killed."""


@contextmanager
def dask_cluster(workers: int = 2) -> Iterator[Cluster]:
    """Start a scheduler and workers."""
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
        yield Cluster(address, scheduler, [start("worker", *limits) for _ in range(workers)])
