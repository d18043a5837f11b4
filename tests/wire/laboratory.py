"""Emulated sensors in one child process, and the time of their cell: `python -m tests.wire.laboratory [WRENCH NOISE]`.

They measure that wrench with that noise, or else a number that counts their samples, coded into all six axes so that
parts of two samples never look like one.
"""

import json
import subprocess
import sys
import threading
import time
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ftdrive.cell.emulated_clock import EmulatedClock
from ftmocks.clock import CellClock
from ftmocks.sensors.netft import Calibration
from ftmocks.sensors.robotous import Model
from ftmocks.wires.faults import Faults
from tests.wire.sensor_kinds import KINDS

Array = NDArray[np.float64]
ROOT = Path(__file__).parents[2]
STEPS = 400
UNIT = np.array([0.1] * 3 + [0.01] * 3)
"""N and N·m per step: more than any sensor's resolution, less than its range when there are 400."""
MIX = ((137, 11), (173, 29), (211, 71), (263, 113))


def numbers_in(wrench: Array) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
    """Return which sample each row (n, 6) is, modulo 160 000, and whether it is one at all."""
    steps = wrench / UNIT + STEPS // 2
    whole = np.rint(steps).astype(np.int64) % STEPS
    number = whole[:, 0] + STEPS * whole[:, 1]
    expected = np.column_stack([whole[:, 0], whole[:, 1], *(number * a + b for a, b in MIX)]) % STEPS
    return number, np.abs(steps - expected).max(axis=1) < 0.5


class Laboratory:
    """The child process.

    Parameters
    ----------
    measured
        Wrench and noise (6,); by default samples are counted.
    """

    def __init__(self, *measured: Array) -> None:
        command = [sys.executable, "-m", "tests.wire.laboratory", *(json.dumps(one.tolist()) for one in measured)]
        self.process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, cwd=ROOT)
        self._lock = threading.Lock()
        assert self.process.stdout
        self.clock = EmulatedClock(json.loads(self.process.stdout.readline()))

    def request(self, word: str, argument: str | int, options: dict[str, Any] | None = None) -> Any:
        assert self.process.stdin
        assert self.process.stdout
        with self._lock:
            self.process.stdin.write(json.dumps([word, argument, options]) + "\n")
            self.process.stdin.flush()
            return json.loads(self.process.stdout.readline())

    def close(self) -> None:
        self.process.communicate(timeout=5)


class Counter:
    """Readings that carry their number."""

    def __init__(self) -> None:
        self.made, self._lock = 0, threading.Lock()

    def __call__(self, count: int) -> Array:
        with self._lock:
            number = np.arange(self.made, self.made + count)
            self.made += count
        steps = np.column_stack([number, number // STEPS, *(number * a + b for a, b in MIX)]) % STEPS
        return np.asarray((steps - STEPS // 2) * UNIT)


def serve(*measured: Array) -> None:
    """Start, disturb and stop sensors as the lines on standard input say."""
    rng = np.random.default_rng(1)
    parts = {"faults": Faults, "model": Model, "calibration": Calibration}
    devices, counters, clock = list[Any](), list[Any](), CellClock()

    def constant(count: int) -> Array:
        return measured[0] + rng.normal(size=(count, 6)) * measured[1]

    def tick() -> None:
        while True:
            clock.now_ns()
            time.sleep(0.001)

    threading.Thread(target=tick, daemon=True).start()
    sys.stdout.write(json.dumps(clock.path) + "\n")
    sys.stdout.flush()
    for line in sys.stdin:
        word, argument, options = json.loads(line)
        answer = None
        if word == "start":
            given = {
                key: parts[key](**value) if key in parts else tuple(value) if isinstance(value, list) else value
                for key, value in options.items()
            }
            counters.append(constant if measured else Counter())
            module, _, name = KINDS[argument].emulator.partition(":")
            make = getattr(import_module(module), name)
            devices.append(make(counters[-1], seed=2 + len(devices), clock=clock, **given))
            answer = [len(devices) - 1, devices[-1].start()]
        elif word == "faults":
            for key, value in options.items():
                setattr(devices[argument].faults, key, value)
        elif word == "made":
            answer = counters[argument].made
        else:
            getattr(devices[argument], word)()
        sys.stdout.write(json.dumps(answer) + "\n")
        sys.stdout.flush()


if __name__ == "__main__":
    serve(*(np.array(json.loads(text)) for text in sys.argv[1:]))
