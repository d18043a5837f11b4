"""The clock of an emulated cell: it follows real time, and waits for everything that has to keep up with it.

The time is published in a page of shared memory. A client that must not miss a stretch of it, such as the thread that
reads a stream, claims a slot in the page and writes there the time up to which it need not be waited for. The clock
never passes the slowest slot by more than `LEAD_NS`: a computer that stalls makes an emulated cell slow, never late.

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
"""

import fcntl
import mmap
import os
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

PAGE_VERSION = 1
SLOTS = 126
LEAD_NS = 10_000_000
"""Less than any limit a client may have, and more than the period of the slowest sensor."""
DEBT_NS = 200_000_000
"""Of real time that could not be followed, so much is made up for."""
SUSPECT_S = 0.1
PATIENCE_S = 10.0
"""A living process that does not follow for so long is not waited for until it does again."""
_HEAD = 4


class CellClock:
    """The clock. Any thread of the station may read it; reading moves it on."""

    def __init__(self) -> None:
        self._descriptor = os.memfd_create("emulated-cell-clock")
        os.ftruncate(self._descriptor, 8 * (_HEAD + 2 * SLOTS))
        fcntl.flock(self._descriptor, fcntl.LOCK_EX)
        self._page = memoryview(mmap.mmap(self._descriptor, 0)).cast("q")
        self._now_ns = time.monotonic_ns()
        self._page[1] = self._now_ns
        self._page[2] = SLOTS
        self._page[0] = PAGE_VERSION
        self._lost_ns = 0
        self._lock = threading.Lock()
        self._own: dict[int, int] = {}
        """What the station's own threads have followed up to, by thread."""
        self._held_by: tuple[int, int] | None = None
        self._held_since_s = 0.0
        self._given_up: dict[int, int] = {}

    @property
    def path(self) -> str:
        """Where a process of the same user opens the page, as long as this one lives."""
        return f"/proc/{os.getpid()}/fd/{self._descriptor}"

    def now_ns(self) -> int:
        """Move the clock on as far as real time and the slowest follower allow, and return it."""
        with self._lock:
            wall_ns = time.monotonic_ns() - self._lost_ns
            now_ns = max(self._now_ns, min(wall_ns, self._slowest_ns() + LEAD_NS))
            self._lost_ns += max(0, wall_ns - now_ns - DEBT_NS)
            self._now_ns = self._page[1] = now_ns
            thread = threading.get_ident()
            if thread in self._own:
                self._own[thread] = now_ns
            return now_ns

    def now_s(self) -> float:
        """Return the same in seconds."""
        return self.now_ns() * 1e-9

    @contextmanager
    def keeping_up(self) -> Iterator[None]:
        """Let the clock wait for this thread, which reads it at least every 5 ms."""
        thread = threading.get_ident()
        with self._lock:
            self._own[thread] = self._now_ns
        try:
            yield
        finally:
            with self._lock:
                del self._own[thread]

    def close(self) -> None:
        """End the clock; clients see that the station has ended."""
        descriptor, self._descriptor = self._descriptor, -1
        if descriptor >= 0:
            fcntl.flock(descriptor, fcntl.LOCK_UN)  # the mapping holds a descriptor of its own
            os.close(descriptor)

    def _slowest_ns(self) -> int:
        """Return how far the slowest follower is; the present time plus a debt where there is none."""
        slowest_ns = min(self._own.values(), default=self._now_ns + DEBT_NS)
        slots = self._page[_HEAD:].tolist()
        for k in range(SLOTS):
            pid, seen_ns = slots[2 * k], slots[2 * k + 1]
            if pid and seen_ns < slowest_ns and self._given_up.get(k) != seen_ns:
                if seen_ns + LEAD_NS <= self._now_ns and self._is_gone(k, pid, seen_ns):
                    continue
                slowest_ns = seen_ns
        return slowest_ns

    def _is_gone(self, k: int, pid: int, seen_ns: int) -> bool:
        """Whether the owner of a slot that holds the clock up has ended, or has not followed for too long."""
        now_s = time.monotonic()
        if self._held_by != (k, seen_ns):
            self._held_by, self._held_since_s = (k, seen_ns), now_s
        held_s = now_s - self._held_since_s
        if held_s > SUSPECT_S and not _lives(pid):
            self._page[_HEAD + 2 * k] = 0
            return True
        if held_s > PATIENCE_S:
            self._given_up[k] = seen_ns
            return True
        return False


def _lives(pid: int) -> bool:
    """Whether a process exists and is no zombie."""
    with suppress(OSError):
        state = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]
        return state not in ("Z", "X")
    return False
