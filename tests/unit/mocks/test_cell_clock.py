"""The clock of a cell: it follows real time, waits for its followers, and survives those that end or stop."""

import mmap
import os
import signal
import subprocess
import threading
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path

import pytest

from ftmocks.clock import (
    DEBT_NS,
    LEAD_NS,
    PAGE_VERSION,
    PATIENCE_S,
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
    def published_ns(self) -> int:
        return self._page[1]

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


def test_the_page_is_laid_out_as_documented(clock: CellClock) -> None:
    with Path(clock.path).open("rb") as page:
        content = memoryview(page.read()).cast("q").tolist()
    assert content[:3] == [PAGE_VERSION, clock.now_ns(), SLOTS]
    assert content[4:] == [0] * 2 * SLOTS


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


def test_a_short_hold_is_made_up_for_and_a_long_one_is_lost(real: RealTime, clock: CellClock) -> None:
    client = Client(clock, 0)
    for held_s, lost_s in ((0.1, 0.0), (3.0, 3.0 - 1e-9 * (LEAD_NS + DEBT_NS))):
        behind_ns = real.ns - clock.now_ns()
        real.pass_s(held_s)
        clock.now_ns()
        steps_ns = []
        for _ in range(100):
            before_ns = clock.now_ns()
            client.follow()
            steps_ns.append(clock.now_ns() - before_ns)
        assert max(steps_ns) <= LEAD_NS
        assert real.ns - clock.now_ns() - behind_ns == pytest.approx(lost_s * S)


def test_it_never_goes_back(real: RealTime, clock: CellClock) -> None:
    client = Client(clock, 0)
    real.pass_s(0.5)
    now_ns = clock.now_ns()
    client._page[client._at + 1] = now_ns - S  # a slot that is behind, such as one that was claimed with an old reading
    assert clock.now_ns() == now_ns
    real.pass_s(0.5)
    assert clock.now_ns() == now_ns


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


def test_a_living_process_that_stops_is_waited_for_with_patience(
    real: RealTime, clock: CellClock, start_process: Callable[[], subprocess.Popen[bytes]]
) -> None:
    process = start_process()
    process.send_signal(signal.SIGSTOP)
    client = Client(clock, 0, process.pid)
    held_ns = real.ns + LEAD_NS
    pass_in_steps(real, clock, PATIENCE_S)
    assert clock.now_ns() == held_ns
    pass_in_steps(real, clock, 1.0)
    assert clock.now_ns() > held_ns + 0.9 * S
    assert client.pid == process.pid, "it keeps its slot"
    client.follow()
    held_ns = clock.now_ns() + LEAD_NS
    pass_in_steps(real, clock, PATIENCE_S / 2)
    assert clock.now_ns() <= held_ns, "it follows again, so it is waited for again"


def test_threads_read_one_rising_time_and_publish_it() -> None:
    clock = CellClock()
    try:
        client = Client(clock, 0)
        client.leave()
        wrong: list[str] = []

        def read(follow: bool) -> None:
            step: Callable[[], int] = clock.follow if follow else clock.now_ns
            before_ns = client.published_ns
            for _ in range(3000):
                now_ns = step()
                published_ns = client.published_ns
                if not before_ns <= now_ns <= published_ns:
                    wrong.append(f"{before_ns} {now_ns} {published_ns}")
                before_ns = published_ns

        def keep_up() -> None:
            with clock.keeping_up():
                read(follow=True)

        threads = [threading.Thread(target=keep_up) for _ in range(3)]
        threads += [threading.Thread(target=read, args=(False,)) for _ in range(3)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        assert wrong == []
    finally:
        clock.close()
