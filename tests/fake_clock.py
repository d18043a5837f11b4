"""A clock that moves only when the code under test waits, so that strict limits are tested in no time."""

import heapq
from collections.abc import Callable
from itertools import count

from ftdrivers.clock import Clock, Waitable


class FakeClock(Clock):
    """Starts at 1000 s. For one thread: what other threads would do is scheduled with `at`."""

    def __init__(self) -> None:
        self.ns = 1_000_000_000_000
        self._order = count()
        self._due: list[tuple[int, int, Callable[[], object]]] = []

    def now_ns(self) -> int:
        return self.ns

    def at(self, delay_s: float, action: Callable[[], object]) -> None:
        """Run `action` when the clock has moved on by `delay_s`; it may schedule itself again."""
        heapq.heappush(self._due, (self.ns + round(delay_s * 1e9), next(self._order), action))

    def advance(self, duration_s: float) -> None:
        """Move on, and run what is due on the way."""
        end_ns = self.ns + round(duration_s * 1e9)
        while self._due and self._due[0][0] <= end_ns:
            self._run_next()
        self.ns = max(self.ns, end_ns)

    def stall(self, duration_s: float) -> None:
        """Move on as a computer that gives this program no time: what was due happens afterwards."""
        self.ns += round(duration_s * 1e9)

    def sleep(self, duration_s: float) -> None:
        self.advance(max(0.0, duration_s))

    def wait(self, waitable: Waitable, timeout_s: float) -> bool:
        """Run the next scheduled action, which may have changed what is waited for, or let the time pass."""
        if self._is_set(waitable):
            return True
        end_ns = self.ns + round(max(0.0, timeout_s) * 1e9)
        while self._due and self._due[0][0] <= end_ns:
            self._run_next()
            if not hasattr(waitable, "is_set"):
                return True  # a condition: the waiting thread looks again
            if self._is_set(waitable):
                return True
        self.ns = max(self.ns, end_ns)
        return False

    @staticmethod
    def _is_set(waitable: Waitable) -> bool:
        return hasattr(waitable, "is_set") and bool(waitable.is_set())

    def _run_next(self) -> None:
        due_ns, _, action = heapq.heappop(self._due)
        self.ns = max(self.ns, due_ns)
        action()
