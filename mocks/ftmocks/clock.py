"""The clock of an emulated cell, which follows real time and waits for every thread that must keep up with it.

A page of shared memory holds the time. A client that must see time advance in small steps, such as the thread that
reads a stream, claims a slot in the page and writes into it the time up to which it has followed. The clock never
passes the slowest slot by more than `LEAD_NS`. A busy computer therefore slows the emulated cell down, but no data are
late.

The page holds signed 64-bit integers in native order:

| index | content |
|---|---|
| 0 | version, `PAGE_VERSION` |
| 1 | the time, ns |
| 2 | number of slots |
| 4 + 2 k | slot k: process id of its owner, 0 if the slot is free |
| 5 + 2 k | slot k: the time up to which its owner has followed, ns |

To claim a slot, take a POSIX record lock (`lockf`) on the first 8 bytes, write the time, then the process id, and
unlock. To release it, write 0 as process id. The station holds an exclusive `flock` on the page as long as it lives.
A slot whose owner has ended is released by the station.
"""

import fcntl
import mmap
import os
import threading
import time
import weakref
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

PAGE_VERSION = 1
SLOTS = 30
LEAD_NS = 10_000_000
"""Lead of the clock over the slowest slot, ns: less than any time-out, at least the period of the slowest sensor."""
DEBT_NS = 200_000_000
"""Delay behind real time that the clock can catch up, ns; a longer delay is lost time."""
PATIENCE_S = 10.0
"""Time after which the clock no longer waits for a process, until the process follows again, s of real time."""
SUSPECT_S = 0.1
"""Interval at which the clock checks whether the owner of a slot that holds it is alive, s of real time."""
LOOK_S = 0.005
"""Longest time between two readings of the clock by a thread that keeps up, s of real time."""
REST_S = 0.0005
"""Shortest time between two readings, s: without it, a thread would wait in a busy loop while the clock is held."""
_HEAD = 4


class CellClock:
    """The clock of one cell. Every method may be called from any thread.

    Parameters
    ----------
    real_ns
        Returns the time of the computer's clock, ns. A test passes a clock that it advances itself.
    """

    def __init__(self, real_ns: Callable[[], int] = time.monotonic_ns) -> None:
        self.real_ns = real_ns
        """Returns the time of the computer's clock, ns, for time-outs in real time."""
        self._descriptor = os.memfd_create("emulated-cell-clock")
        os.ftruncate(self._descriptor, 8 * (_HEAD + 2 * SLOTS))
        fcntl.flock(self._descriptor, fcntl.LOCK_EX)
        self._page = memoryview(mmap.mmap(self._descriptor, 0)).cast("q")
        self._now_ns = self._looked_ns = real_ns()
        self._page[1] = self._now_ns
        self._page[2] = SLOTS
        self._page[0] = PAGE_VERSION
        self._lost_ns = 0
        """Real time that the clock has lost by waiting for threads and does not catch up, ns."""
        self._lock = threading.Lock()
        self._own: dict[int, int] = {}
        """Time up to which each thread of the station, by its identifier, has followed the clock, ns."""
        self._held: dict[int, tuple[int, int]] = {}
        """For each slot that holds the clock back: its time, and since when it has not advanced, ns of real time."""
        self._end = weakref.finalize(self, _end, self._descriptor)

    @property
    def path(self) -> str:
        """Path with which a process of the same user opens the page while this process lives."""
        return f"/proc/{os.getpid()}/fd/{self._descriptor}"

    def now_ns(self) -> int:
        """Advance the clock as far as real time and the slowest follower allow; publish the time and return it, ns."""
        with self._lock:
            return self._move_on()

    def now_s(self) -> float:
        """Return `now_ns()` in seconds."""
        return self.now_ns() * 1e-9

    def follow(self) -> int:
        """Return `now_ns()`. With this call a thread that keeps up confirms that it has done all its work so far."""
        with self._lock:
            now_ns = self._move_on()
            thread = threading.get_ident()
            if thread in self._own:
                self._own[thread] = now_ns
            return now_ns

    @contextmanager
    def keeping_up(self) -> Iterator[None]:
        """Let the clock wait for this thread, which must call `follow` every `LOOK_S`. Blocks may be nested."""
        thread = threading.get_ident()
        if thread in self._own:
            yield
            return
        with self._lock:
            self._own[thread] = self._now_ns
        try:
            yield
        finally:
            with self._lock:
                del self._own[thread]

    def close(self) -> None:
        """End the clock, which shows clients that the station has ended. Idempotent."""
        self._end()

    def _move_on(self) -> int:
        real_ns = self.real_ns()
        target_ns = real_ns - self._lost_ns
        slowest_ns = min((*self._own.values(), *self._slots(real_ns)), default=target_ns)
        now_ns = max(self._now_ns, min(target_ns, slowest_ns + LEAD_NS))
        self._lost_ns += max(0, target_ns - now_ns - DEBT_NS)
        self._now_ns = self._page[1] = now_ns
        return now_ns

    def _slots(self, real_ns: int) -> list[int]:
        """Return the times up to which the owners of slots have followed, except those that are no longer awaited."""
        # The time for which this process itself was suspended is not counted against other processes.
        elapsed_ns = min(real_ns - self._looked_ns, round(SUSPECT_S * 1e9))
        self._looked_ns = real_ns
        slots = self._page[_HEAD:].tolist()
        return [
            slots[k + 1]
            for k in range(0, 2 * SLOTS, 2)
            if slots[k] and not self._is_given_up(k, slots[k], slots[k + 1], elapsed_ns)
        ]

    def _is_given_up(self, k: int, pid: int, seen_ns: int, elapsed_ns: int) -> bool:
        """Whether the owner of a slot has ended, or has held the clock for too long."""
        if seen_ns + LEAD_NS > self._now_ns:
            return False
        held_at_ns, before_ns = self._held.get(k, (seen_ns, 0))
        held_ns = before_ns + elapsed_ns if held_at_ns == seen_ns else 0
        self._held[k] = seen_ns, held_ns
        suspect_ns = round(SUSPECT_S * 1e9)
        if held_ns // suspect_ns > before_ns // suspect_ns and not _lives(pid):
            self._page[_HEAD + k] = 0
            del self._held[k]
            return True
        return held_ns > PATIENCE_S * 1e9


def time_out_s(wait_s: float | None) -> float:
    """Return the longest wait of a thread that keeps up, whose next task is due in `wait_s` (None: no task), s."""
    return LOOK_S if wait_s is None else min(max(wait_s, REST_S), LOOK_S)


def _end(descriptor: int) -> None:
    fcntl.flock(descriptor, fcntl.LOCK_UN)  # explicitly, because the mapping holds a copy of the descriptor
    os.close(descriptor)


def _lives(pid: int) -> bool:
    """Return whether a process exists and is not a zombie."""
    with suppress(OSError):
        state = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]
        return state not in ("Z", "X")
    return False
