"""The clock of a cell: it follows real time, waits for its followers, and survives those that end or stop."""

import mmap
import os
import subprocess
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path

import pytest

from ftmocks.clock import (
    LEAD_NS,
    SLOTS,
    SUSPECT_S,
    CellClock,
)
from tests.unit.mocks.real_time import RealTime

S = 1_000_000_000


@pytest.fixture
def real() -> RealTime:
    return RealTime()


@pytest.fixture
def clock(real: RealTime) -> Iterator[CellClock]:
    clock = CellClock(real)
    yield clock
    clock.close()


class Client:
    """A slot of the page, as another process claims it."""

    def __init__(self, clock: CellClock, slot: int, pid: int | None = None) -> None:
        with Path(clock.path).open("r+b") as page:
            self._page = memoryview(mmap.mmap(page.fileno(), 0)).cast("q")
        self._at = 4 + 2 * slot
        self.follow()
        self._page[self._at] = os.getpid() if pid is None else pid

    @property
    def pid(self) -> int:
        return self._page[self._at]

    def follow(self) -> None:
        self._page[self._at + 1] = self._page[1]

    def leave(self) -> None:
        self._page[self._at] = 0


@pytest.fixture
def start_process() -> Iterator[Callable[[], subprocess.Popen[bytes]]]:
    """Start processes that do nothing."""
    with ExitStack() as stack:

        def start() -> subprocess.Popen[bytes]:
            process = stack.enter_context(subprocess.Popen(["sleep", "60"]))
            stack.callback(process.kill)
            return process

        yield start


def kill(process: subprocess.Popen[bytes]) -> None:
    """Make it a zombie."""
    process.kill()
    os.waitid(os.P_PID, process.pid, os.WEXITED | os.WNOWAIT)


def pass_in_steps(real: RealTime, clock: CellClock, duration_s: float, step_s: float = 0.01) -> None:
    """Let real time pass while the station looks at its clock often."""
    for _ in range(round(duration_s / step_s)):
        real.pass_s(step_s)
        clock.now_ns()


def test_it_does_not_pass_the_slowest_follower_by_more_than_its_lead(real: RealTime, clock: CellClock) -> None:
    clients = [Client(clock, slot) for slot in (0, 3, SLOTS - 1)]
    begun_ns = real.ns
    real.pass_s(2.0)
    assert clock.now_ns() == begun_ns + LEAD_NS
    for client in clients:
        assert clock.now_ns() == begun_ns + LEAD_NS, "one of them has not followed yet"
        client.follow()
    assert clock.now_ns() == begun_ns + 2 * LEAD_NS
    clients[1].leave()
    for client in (clients[0], clients[2]):
        client.follow()
    assert clock.now_ns() == begun_ns + 3 * LEAD_NS


def test_a_thread_of_the_station_is_waited_for_until_it_follows(real: RealTime, clock: CellClock) -> None:
    begun_ns = real.ns
    with clock.keeping_up():
        real.pass_s(2.0)
        for _ in range(3):
            assert clock.now_ns() == begun_ns + LEAD_NS, "to read the time is not to follow"
        assert clock.follow() == begun_ns + LEAD_NS
        with clock.keeping_up():
            assert clock.follow() == begun_ns + 2 * LEAD_NS
        assert clock.now_ns() == begun_ns + 3 * LEAD_NS, "the outer block goes on"
        assert clock.now_ns() == begun_ns + 3 * LEAD_NS
    real.pass_s(1.0)
    assert clock.now_ns() > begun_ns + S, "no follower is left"


def test_the_slots_of_dead_processes_are_released(
    real: RealTime, clock: CellClock, start_process: Callable[[], subprocess.Popen[bytes]]
) -> None:
    processes = [start_process(), start_process()]
    clients = [Client(clock, slot, process.pid) for slot, process in enumerate(processes)]
    for process in processes:
        kill(process)
    pass_in_steps(real, clock, 2 * SUSPECT_S + 0.05)
    assert [client.pid for client in clients] == [0, 0]
    begun_ns = clock.now_ns()
    real.pass_s(1.0)
    assert clock.now_ns() > begun_ns + 0.9 * S
