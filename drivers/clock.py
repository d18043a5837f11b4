"""Time as the drivers measure it: one object that is given to everything that waits or judges an age.

`REAL` is the computer's own clock. An emulated cell has a clock of its own that waits for a starved reader, and tests
have one that moves only when they say so. No module of `drivers` calls `time.monotonic` or `time.sleep` itself.
"""

import sys
import threading
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, ExitStack, nullcontext
from typing import Protocol


class Waitable(Protocol):
    """A `threading.Condition` whose lock is held, or a `threading.Event`."""

    def wait(self, timeout: float | None = None, /) -> bool:
        """Return whether it was notified or set within `timeout` seconds."""


class Clock(ABC):
    """A monotonic clock and the ways to wait on it. Every method may be called from any thread."""

    emulated = False
    """Whether the cell is emulated: then only the far side's own time may run out, never that of the computer."""

    @property
    def poll_s(self) -> float:
        """How long one read may block in real time; an emulated cell stands still meanwhile."""
        return 0.005 if self.emulated else 0.05

    @abstractmethod
    def now_ns(self) -> int:
        """Return the time in nanoseconds; samples are stamped with it as `t_host_ns`."""

    def now_s(self) -> float:
        """Return the same time in seconds."""
        return self.now_ns() / 1e9

    def awake_s(self) -> float:
        """Return seconds of a clock that also counts while the computer sleeps; silence is judged by it."""
        return self.now_s()

    @abstractmethod
    def sleep(self, duration_s: float) -> None:
        """Return after `duration_s` seconds, at once where that is not positive."""

    def looks(self, duration_s: float) -> Iterator[float]:
        """Yield how many seconds are left of `duration_s`, and 0 for a last look when they are over.

        So what has come in time is found, however late this thread is.
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

        While the block runs, an emulated cell's time goes on by at most some milliseconds between two calls of this
        clock in this thread. A real clock waits for no thread.
        """
        return nullcontext()

    def away(self) -> AbstractContextManager[object]:
        """Mark a block whose thread waits for something that does not call this clock, such as a web server's answer.

        An emulated cell's time does not wait for the thread meanwhile, although it keeps up before and after.
        """
        return nullcontext()


class RealClock(Clock):
    """The computer's monotonic clock."""

    def now_ns(self) -> int:
        """Return `time.monotonic_ns()`."""
        return time.monotonic_ns()

    def awake_s(self) -> float:
        """Return CLOCK_BOOTTIME in seconds, where the system has it."""
        if sys.platform == "linux":
            return time.clock_gettime(time.CLOCK_BOOTTIME)
        return time.monotonic()

    def sleep(self, duration_s: float) -> None:
        """Sleep."""
        time.sleep(max(0.0, duration_s))

    def wait(self, waitable: Waitable, timeout_s: float) -> bool:
        """Wait."""
        return waitable.wait(max(0.0, timeout_s))


REAL = RealClock()


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
