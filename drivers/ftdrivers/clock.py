"""The clock of the drivers: one object, passed to everything that waits or judges an age.

`REAL` is the computer's own clock. The clock of an emulated cell waits for a starved reader. The clock of a test moves
only when the test moves it. No module of `drivers` calls `time.monotonic` or `time.sleep` itself.
"""

import sys
import threading
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, ExitStack, nullcontext
from typing import Final, Protocol, TypeVar

Heard = TypeVar("Heard")
# After a wait that ends this late the computer was busy, and something may have arrived meanwhile.
_OVERSLEPT_S: Final = 0.002


class Waitable(Protocol):
    """A `threading.Condition` whose lock is held, or a `threading.Event`."""

    def wait(self, timeout: float | None = None, /) -> bool:
        """Return whether it was notified or set within `timeout` seconds."""


class Clock(ABC):
    """A monotonic clock and the ways to wait on it. Every method may be called from any thread.

    What differs in an emulated cell is here, as limits and methods; no driver knows which clock it has.
    """

    poll_s = 0.05
    """The longest that one read may block, in real time; the time of an emulated cell stands still meanwhile."""
    lead_s = 0.0
    """The most that a device may be behind this clock, as one in another process is that starves."""
    can_be_held = False
    """Whether time stands still in a `held` block."""

    def patience_s(self, limit_s: float) -> float:
        """Return a limit on another process in real time: a long one in an emulated cell, where it may starve."""
        return limit_s

    @abstractmethod
    def now_ns(self) -> int:
        """Return the time in nanoseconds; samples are stamped with it as `t_host_ns`."""

    def now_s(self) -> float:
        """Return the same time in seconds."""
        return self.now_ns() / 1e9

    def awake_s(self) -> float:
        """Return seconds of a clock that also counts while the computer sleeps. It measures silence."""
        return self.now_s()

    @abstractmethod
    def sleep(self, duration_s: float) -> None:
        """Return after `duration_s` seconds, or at once where that is not positive."""

    def looks(self, duration_s: float) -> Iterator[float]:
        """Yield how many seconds of `duration_s` are left, and finally 0.

        The last turn finds what arrived in time, however late this thread is.
        """
        end_ns = self.now_ns() + round(duration_s * 1e9)
        while (left_ns := end_ns - self.now_ns()) > 0:
            yield left_ns / 1e9
        yield 0.0

    @abstractmethod
    def wait(self, waitable: Waitable, timeout_s: float) -> bool:
        """Wait until `waitable` is notified or set, at most `timeout_s` seconds; return whether it was."""

    def keeping_up(self) -> AbstractContextManager[object]:
        """Mark a block whose thread must see time pass in small steps, such as the loop that reads a stream.

        Between two calls of this clock in this thread, the time of an emulated cell advances by some milliseconds at
        most. A real clock waits for no thread.
        """
        return nullcontext()

    def held(self) -> AbstractContextManager[object]:
        """Mark a block in which the time of an emulated cell does not go on, so that its devices send no more."""
        return nullcontext()

    def hear(self, look: Callable[[float], Heard | None], silence_s: float) -> Heard | None:
        """Return what `look` finds within `silence_s`, called in a `held` block; None for a silence.

        A silence counts if this thread was awake to hear it. Where time stands still, nothing more arrives.
        """
        wait_s, begin_s = 0.0 if self.can_be_held else silence_s, self.now_s()
        found = look(wait_s)
        if found is None and self.now_s() - begin_s >= wait_s + _OVERSLEPT_S:
            found = look(0.0)
        return found

    def away(self) -> AbstractContextManager[object]:
        """Mark a block in which a thread that keeps up waits for something else, such as the answer of a web server.

        The time of an emulated cell does not wait for the thread meanwhile.
        """
        return nullcontext()


class _RealClock(Clock):
    def now_ns(self) -> int:
        return time.monotonic_ns()

    def awake_s(self) -> float:
        """Return CLOCK_BOOTTIME in seconds, where the system has it."""
        if sys.platform == "linux":
            return time.clock_gettime(time.CLOCK_BOOTTIME)
        return time.monotonic()

    def sleep(self, duration_s: float) -> None:
        time.sleep(max(0.0, duration_s))

    def wait(self, waitable: Waitable, timeout_s: float) -> bool:
        return waitable.wait(max(0.0, timeout_s))


REAL = _RealClock()


class Follower(threading.Thread):
    """A daemon thread whose `work` keeps up with `clock`.

    `start` returns once an emulated cell's time waits for the thread, so that nothing is timed before. It raises what
    `Clock.keeping_up` raises.
    """

    def __init__(self, clock: Clock, work: Callable[[], None], name: str) -> None:
        super().__init__(name=name, daemon=True)
        self._clock = clock
        self._work = work
        self._decided = threading.Event()
        self._refusal: Exception | None = None

    def start(self) -> None:
        """Start the thread and wait until it keeps up."""
        # An emulated cell waits for this thread, so a busy computer makes the cell slow, never late.
        super().start()
        self._decided.wait()
        if self._refusal is not None:
            raise self._refusal

    def run(self) -> None:
        """Keep up and work; called in the thread."""
        with ExitStack() as stack:
            try:
                stack.enter_context(self._clock.keeping_up())
            except Exception as error:
                self._refusal = error
                return
            finally:
                self._decided.set()
            self._work()
