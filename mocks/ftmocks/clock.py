"""The clock of an emulated cell: it follows real time, and waits for every thread that must keep up with it.

A page of shared memory holds the time. A client that must not miss a stretch of it, such as the thread that reads a
stream, claims a slot in the page and writes there the time up to which it has followed. The clock never passes the
slowest slot by more than `LEAD_NS`: a computer that stalls makes an emulated cell slow, never late.

The page holds signed 64-bit integers in native order:

| index | content |
|---|---|
| 0 | version, `PAGE_VERSION` |
| 1 | the time, ns |
| 2 | number of slots |
| 4 + 2 k | slot k: process id of its owner, 0 where the slot is free |
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
"""Less than any limit a client may have, and no less than the period of the slowest sensor."""
DEBT_NS = 200_000_000
"""The clock makes up for at most so much of the real time in which it was held."""
PATIENCE_S = 10.0
"""The clock no longer waits for a process that has not followed for so long, until it follows again."""
SUSPECT_S = 0.1
"""After each such time in which a slot holds the clock, the clock checks whether its owner lives."""
LOOK_S = 0.005
"""A thread that keeps up reads the clock at least this often."""
REST_S = 0.0005
"""It waits at least so long between two readings, or it would spin while the clock is held."""
_HEAD = 4


class CellClock:
    """The clock of one cell. Every method may be called from any thread.

    Parameters
    ----------
    real_ns
        The computer's clock; a test passes one that it moves itself.
    """

    def __init__(self, real_ns: Callable[[], int] = time.monotonic_ns) -> None:
        self.real_ns = real_ns
        """The computer's clock, for limits of clients that count in real time."""
        self._descriptor = os.memfd_create("emulated-cell-clock")
        os.ftruncate(self._descriptor, 8 * (_HEAD + 2 * SLOTS))
        fcntl.flock(self._descriptor, fcntl.LOCK_EX)
        self._page = memoryview(mmap.mmap(self._descriptor, 0)).cast("q")
        self._now_ns = self._looked_ns = real_ns()
        self._page[1] = self._now_ns
        self._page[2] = SLOTS
        self._page[0] = PAGE_VERSION
        self._lost_ns = 0
        """How far the real clock is ahead, without the time to be made up for."""
        self._lock = threading.Lock()
        self._own: dict[int, int] = {}
        """Time up to which the station's own threads have followed, by thread."""
        self._held: dict[int, tuple[int, int]] = {}
        """Slots that hold the clock: the time at which they stand, and for how long (real time, ns)."""
        self._end = weakref.finalize(self, _end, self._descriptor)

    @property
    def path(self) -> str:
        """Path under which a process of the same user opens the page, until this process ends."""
        return f"/proc/{os.getpid()}/fd/{self._descriptor}"

    def now_ns(self) -> int:
        """Move the clock on as far as real time and the slowest follower allow, publish the time and return it."""
        with self._lock:
            return self._move_on()

    def now_s(self) -> float:
        """Return the same in seconds."""
        return self.now_ns() * 1e-9

    def follow(self) -> int:
        """Return `now_ns()`; a thread that keeps up confirms by this that it has done all that was due before."""
        with self._lock:
            now_ns = self._move_on()
            thread = threading.get_ident()
            if thread in self._own:
                self._own[thread] = now_ns
            return now_ns

    @contextmanager
    def keeping_up(self) -> Iterator[None]:
        """Let the clock wait for this thread, which calls `follow` every `LOOK_S`; blocks may be nested."""
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
        """End the clock: clients see that the station has ended. May be called twice."""
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
        """Return how far the owners of the slots have followed, without those the clock has given up."""
        # A stall of this process is not a delay of the others.
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
    """Return how long a thread that keeps up may wait, when the next thing to do is due in `wait_s` (None: nothing)."""
    return LOOK_S if wait_s is None else min(max(wait_s, REST_S), LOOK_S)


def _end(descriptor: int) -> None:
    fcntl.flock(descriptor, fcntl.LOCK_UN)  # the mapping has a copy of the descriptor, which would keep the lock
    os.close(descriptor)


def _lives(pid: int) -> bool:
    """Whether a process exists and is no zombie."""
    with suppress(OSError):
        state = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]
        return state not in ("Z", "X")
    return False
