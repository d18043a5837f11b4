"""The clock of an emulated cell, as the program reads it; the station's side is `ftmocks.clock`, in this process."""

import os
import threading
import time
from collections.abc import Iterator

import pytest

from ftdrive.cell.emulated_clock import EmulatedClock, LocalClock
from ftdrivers.errors import ConnectError
from ftmocks.clock import LEAD_NS, CellClock


@pytest.fixture
def cell() -> Iterator[CellClock]:
    cell = CellClock()
    yield cell
    cell.close()


@pytest.fixture
def clock(cell: CellClock) -> EmulatedClock:
    return EmulatedClock(cell.path)


@pytest.fixture
def running(cell: CellClock) -> Iterator[None]:
    """Let a thread move the cell's time on, as a station does."""
    ended = threading.Event()

    def run() -> None:
        while not ended.wait(0.001):
            cell.now_ns()

    thread = threading.Thread(target=run)
    thread.start()
    yield
    ended.set()
    thread.join()


def test_the_cell_waits_for_a_thread_that_keeps_up(cell: CellClock, clock: EmulatedClock) -> None:
    with clock.keeping_up():
        seen = clock.now_ns()
        time.sleep(0.05)
        assert cell.now_ns() == seen + LEAD_NS
        assert cell.now_ns() == seen + LEAD_NS
        clock.now_ns()
        assert cell.now_ns() > seen + LEAD_NS
    seen = cell.now_ns()
    time.sleep(0.05)
    assert cell.now_ns() > seen + LEAD_NS


def test_the_end_of_an_inner_block_does_not_end_the_outer_one(cell: CellClock, clock: EmulatedClock) -> None:
    with clock.keeping_up():
        with clock.keeping_up():
            pass
        seen = clock.now_ns()
        time.sleep(0.05)
        assert cell.now_ns() == seen + LEAD_NS


def test_the_time_of_a_played_device_waits_for_the_threads_of_its_process() -> None:
    clock, passed = LocalClock(), threading.Event()

    def sleep() -> None:
        clock.sleep(0.05)
        passed.set()

    other = threading.Thread(target=sleep)
    with clock.keeping_up():
        other.start()
        seen = clock.now_ns()
        time.sleep(0.1)
        assert not passed.is_set()
        for _ in range(10):
            before, now = clock.now_ns(), clock.now_ns()
            assert seen <= before <= now <= before + LEAD_NS
            time.sleep(0.02)
        clock.sleep(0.01)
    assert passed.wait(5.0)
    other.join()


@pytest.mark.usefixtures("running")
def test_waiting_ends_by_the_time_of_the_cell_or_by_what_is_waited_for(clock: EmulatedClock) -> None:
    event = threading.Event()
    with clock.keeping_up():
        begin = clock.now_ns()
        assert not clock.wait(event, 0.03)
        assert clock.now_ns() >= begin + 30_000_000
    threading.Timer(0.01, event.set).start()
    assert clock.wait(event, 60.0)


def test_time_goes_on_with_the_computer_when_the_station_has_ended(cell: CellClock, clock: EmulatedClock) -> None:
    last = clock.now_ns()
    cell.close()
    clock.sleep(0.01)
    assert clock.now_ns() >= last + 10_000_000


def test_a_page_that_is_not_there_or_of_another_version_is_an_error(cell: CellClock) -> None:
    with pytest.raises(ConnectError):
        EmulatedClock("/proc/self/fd/99999")
    descriptor = os.open(cell.path, os.O_RDWR)
    os.pwrite(descriptor, (7).to_bytes(8, "little"), 0)
    os.close(descriptor)
    with pytest.raises(ConnectError, match="7"):
        EmulatedClock(cell.path)
