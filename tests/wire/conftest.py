"""The emulated UR controller, as the tests of its driver use it."""

import json
import select
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from math import radians
from pathlib import Path
from typing import Any

import pytest

from drivers.ur.arm import UrArm

ROOT = Path(__file__).parents[2]


class Station:
    """The emulator's process and its control lines."""

    def __init__(self, *options: str) -> None:
        command = [sys.executable, "-m", "mocks", "station", "--sensor", "none", *options]
        self.process = subprocess.Popen(
            command, cwd=ROOT, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True
        )
        self.host: str = self._line()["arm"]["host"]

    def _line(self) -> dict[str, Any]:
        assert self.process.stdout
        assert select.select([self.process.stdout], [], [], 20)[0], "the station says nothing"
        answer: dict[str, Any] = json.loads(self.process.stdout.readline())
        assert "error" not in answer, answer
        return answer

    def do(self, verb: str, /, **how: object) -> dict[str, Any]:
        assert self.process.stdin
        self.process.stdin.write(json.dumps({"do": verb} | how) + "\n")
        self.process.stdin.flush()
        return self._line()

    def wait_for(self, condition: Callable[[dict[str, Any]], bool], within_s: float = 2.0) -> None:
        deadline = time.monotonic() + within_s
        while not condition(state := self.do("state")):
            assert time.monotonic() < deadline, state
            time.sleep(0.01)

    def dashboard(self, command: str) -> str:
        """Ask as another client does."""
        with socket.create_connection((self.host, 29999), timeout=2) as sock, sock.makefile("rw") as lines:
            lines.readline()
            lines.write(command + "\n")
            lines.flush()
            return lines.readline().strip()

    def as_new(self) -> bool:
        if self.process.poll() is not None:
            return False
        state = self.do("state")
        return bool(
            (state["safety_mode"], state["robot_mode"], state["remote_control"]) == ("NORMAL", "RUNNING", True)
            and not any(state["tcp_offset"])
        )

    def close(self) -> None:
        self.process.kill()
        self.process.communicate()


@pytest.fixture(scope="module")
def start_station() -> Iterator[Callable[..., Station]]:
    stations: list[Station] = []

    def start(*options: str) -> Station:
        stations.append(Station(*options))
        return stations[-1]

    yield start
    for station in stations:
        station.close()


@pytest.fixture(scope="module")
def kept() -> list[Station]:
    """The station at hand, in a list: a test may break it, and the next gets another."""
    return []


@pytest.fixture
def station(kept: list[Station], start_station: Callable[..., Station]) -> Iterator[Station]:
    if not kept or not kept[0].as_new():
        kept[:] = [start_station()]
    yield kept[0]
    if kept[0].process.poll() is None:
        assert kept[0].do("state")["bad_inputs"] == []


@pytest.fixture
def new_arm(station: Station) -> Iterator[Callable[..., UrArm]]:
    """Make arms at the station, and close them after the test."""
    arms: list[UrArm] = []

    def make(host: str = station.host, model: str | None = None) -> UrArm:
        arms.append(UrArm(host, model=model, speed_rad_s=radians(60), acceleration_rad_s2=radians(200)))
        return arms[-1]

    yield make
    for arm in arms:
        t0 = time.monotonic()
        arm.close()
        assert time.monotonic() - t0 < 1.5


@pytest.fixture
def arm(new_arm: Callable[..., UrArm]) -> UrArm:
    arm = new_arm()
    arm.open(control=True)
    return arm
