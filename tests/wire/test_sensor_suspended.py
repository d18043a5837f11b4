"""A program that is suspended (Ctrl-Z, debugger, busy host) and goes on: what has piled up meanwhile is no measurement.

A child process reads an emulated sensor in two threads and is stopped; the sensor is pushed; the child goes on. Every
value it is then given must be pushed, or stamped with a time before the stop.
"""

import json
import os
import queue
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from ftdrive.cell.emulated import SENSORS, Station

PROGRAM = """
import json, sys, threading, time
import numpy as np
from ftdrivers.errors import DeviceError
from ftdrivers.registry import sensor_from_url

one_line = threading.Lock()

def send(**what):
    with one_line:
        print(json.dumps(what), flush=True)

def report(what, call):
    while True:
        begin_ns = time.monotonic_ns()
        try:
            samples = call()
            push_N = np.linalg.norm(samples.wrench[:, :3] - still_N, axis=1)
            outcome = {"rows": len(samples), "unpushed_ns": samples.t_host_ns[push_N < 90].tolist()}
        except DeviceError as exc:
            outcome = {"error": type(exc).__name__, "says": str(exc)}
        send(what=what, begin_ns=begin_ns, end_ns=time.monotonic_ns(), **outcome)
        if what == "latest" or "error" in outcome:
            time.sleep(0.01)

sensor = sensor_from_url(sys.argv[1])
sensor.open()
still = sensor.collect(0.2)
still_N = still.wrench[:, :3].mean(axis=0)
threading.Thread(target=report, args=("latest", lambda: sensor.latest(timeout_s=0.5)), daemon=True).start()
threading.Thread(target=report, args=("collect", lambda: sensor.collect(0.2)), daemon=True).start()
sys.stdin.readline()
send(what="health", stale=sensor.health().stale, events=sensor.health().events)
sensor.close()
"""
pytestmark = pytest.mark.realtime

BEFORE_PUSH_S, AFTER_PUSH_S = 1.2, 0.4
"""Each more than may count as new; together eight times a collection, and more than a port holds of most streams."""


class Child:
    """The program above, and all it has said."""

    def __init__(self, url: str) -> None:
        self.process = subprocess.Popen(
            [sys.executable, "-c", PROGRAM, url],
            cwd=Path(__file__).parents[2],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )
        self.said: list[dict[str, Any]] = []
        self._lines: queue.Queue[str] = queue.Queue()
        self._listener = threading.Thread(target=self._listen)
        self._listener.start()

    def _listen(self) -> None:
        assert self.process.stdout
        for line in self.process.stdout:
            self._lines.put(line)

    def close(self) -> None:
        with self.process:
            self.process.kill()
            self._listener.join()

    def ask_health(self) -> None:
        """Ask it to end."""
        assert self.process.stdin
        self.process.stdin.write("\n")
        self.process.stdin.flush()

    def listen_until(self, enough: Callable[[dict[str, Any]], bool], within_s: float = 10.0) -> dict[str, Any]:
        """Listen up to a line that is enough."""
        deadline = time.monotonic() + within_s
        while True:
            self.said.append(json.loads(self._lines.get(timeout=max(0.0, deadline - time.monotonic()))))
            if enough(self.said[-1]):
                return self.said[-1]

    def stop(self) -> int:
        """Suspend it; returns a time by which it was."""
        os.kill(self.process.pid, signal.SIGSTOP)
        os.waitpid(self.process.pid, os.WUNTRACED)
        return time.monotonic_ns()


@contextmanager
def suspended_child(url: str) -> Iterator[Child]:
    child = Child(url)
    try:
        yield child
    finally:
        child.close()


def is_collected(line: dict[str, Any], after_ns: int = 0) -> bool:
    return line["what"] == "collect" and "error" not in line and line["begin_ns"] > after_ns


@pytest.mark.parametrize("name", SENSORS)
def test_nothing_old_after_a_pause(name: str) -> None:
    with Station(name, ["--time-scale", "1"]) as station, suspended_child(station.cell.sensor.url) as child:
        rows = max(child.listen_until(is_collected)["rows"] for _ in range(3))  # of a polled sensor: as the machine can
        stopped_ns = child.stop()
        time.sleep(BEFORE_PUSH_S)
        station.control(do="push", wrench=[100, 0, 0, 0, 0, 0])
        pushed_ns = time.monotonic_ns()
        time.sleep(AFTER_PUSH_S)
        os.kill(child.process.pid, signal.SIGCONT)
        for _ in range(3):  # the second and the third see a stream in its stride
            child.listen_until(lambda line: is_collected(line, pushed_ns))
        child.ask_health()
        health = child.listen_until(lambda line: line["what"] == "health")

    later = [line for line in child.said if line.get("end_ns", 0) > pushed_ns]
    for line in later:
        assert all(t_ns <= stopped_ns for t_ns in line.get("unpushed_ns", [])), line
    # none was under way when the child stopped between two of them
    across = [line for line in later if line["what"] == "collect" and line["begin_ns"] < stopped_ns]
    assert all(line.get("error") == "DeviceTimeout" and "suspended" in line["says"] for line in across)
    collected = [line["rows"] for line in later if is_collected(line, pushed_ns)]
    assert max(collected) < 3 * rows + 5, "what had piled up is in it"
    assert collected[-1] > 0.3 * rows
    assert {line["error"] for line in later if "error" in line} <= {"DeviceTimeout"}
    assert health["stale"] >= 1
    assert any("dropped" in what for _, what in health["events"])
