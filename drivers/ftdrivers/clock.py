"""The clock of the drivers: one object, passed to all code that waits or computes the age of a sample.

`REAL` is the clock of the computer. The clock of an emulated cell waits for a reader that gets no CPU time. The
clock of a test moves only when the test advances it. Drivers never call `time.monotonic` or `time.sleep`.
"""

import sys
import threading
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, ExitStack, nullcontext
from typing import Final, Protocol, TypeVar

Heard = TypeVar("Heard")
# If a wait ends later than planned by more than this, the computer was busy and data may have arrived meanwhile.
_OVERSLEPT_S: Final = 0.002


class Waitable(Protocol):
    """A `threading.Condition` whose lock is held, or a `threading.Event`."""

    def wait(self, timeout: float | None = None, /) -> bool:
        """Wait up to `timeout` seconds; return whether the condition was notified or the event was set."""


class Clock(ABC):
    """A monotonic clock and the ways to wait on it. Every method may be called from any thread.

    All differences between a real and an emulated cell are limits and methods of this class, so a driver need not
    know which clock it uses.
    """

    poll_s = 0.05
    """Longest time for which one read may block, s of real time. The time of an emulated cell stops meanwhile."""
    lead_s = 0.0
    """Largest lag of a device's clock behind this clock, s: an emulator in another process may get no CPU time."""
    can_be_held = False
    """Whether the time of this clock stops during a `held` block."""

    def patience_s(self, limit_s: float) -> float:
        """Return a time-out for another process, s of real time. It is long in an emulated cell."""
        return limit_s

    @abstractmethod
    def now_ns(self) -> int:
        """Return the time in nanoseconds; samples are stamped with it as `t_host_ns`."""

    def now_s(self) -> float:
        """Return the time of this clock, that of `now_ns`, in seconds."""
        return self.now_ns() / 1e9

    def awake_s(self) -> float:
        """Return the time of a clock that also runs while the computer is suspended, s. Silence is measured with it."""
        return self.now_s()

    @abstractmethod
    def sleep(self, duration_s: float) -> None:
        """Return after `duration_s` seconds, or at once if `duration_s` is not positive."""

    def looks(self, duration_s: float) -> Iterator[float]:
        """Yield the time left of `duration_s`, s, and finally 0.

        Because of this last iteration, data that arrived in time are read even if this thread is late.
        """
        end_ns = self.now_ns() + round(duration_s * 1e9)
        while (left_ns := end_ns - self.now_ns()) > 0:
            yield left_ns / 1e9
        yield 0.0

    @abstractmethod
    def wait(self, waitable: Waitable, timeout_s: float) -> bool:
        """Wait up to `timeout_s` seconds until `waitable` is notified or set; return whether that happened."""

    def keeping_up(self) -> AbstractContextManager[object]:
        """Mark a block whose thread must see time advance in small steps, such as the loop that reads a stream.

        Between two calls of this clock in this thread, the time of an emulated cell advances by a few milliseconds at
        most. The real clock waits for no thread.
        """
        return nullcontext()

    def held(self) -> AbstractContextManager[object]:
        """Mark a block in which the time of an emulated cell stops and its devices send nothing."""
        return nullcontext()

    def hear(self, look: Callable[[float], Heard | None], silence_s: float) -> Heard | None:
        """Call `look` in a `held` block and return its result; None if nothing arrived for `silence_s`.

        `look` is called again if this thread did not run in time, because data may have arrived meanwhile.
        """
        wait_s, begin_s = 0.0 if self.can_be_held else silence_s, self.now_s()
        found = look(wait_s)
        if found is None and self.now_s() - begin_s >= wait_s + _OVERSLEPT_S:
            found = look(0.0)
        return found

    def away(self) -> AbstractContextManager[object]:
        """Mark a block in which a thread that otherwise keeps up waits for something else, such as a web server.

        During the block, the time of an emulated cell does not wait for the thread.
        """
        return nullcontext()


class _RealClock(Clock):
    def now_ns(self) -> int:
        return time.monotonic_ns()

    def awake_s(self) -> float:
        """Return CLOCK_BOOTTIME in seconds if the system has this clock, else CLOCK_MONOTONIC."""
        if sys.platform == "linux":
            return time.clock_gettime(time.CLOCK_BOOTTIME)
        return time.monotonic()

    def sleep(self, duration_s: float) -> None:
        time.sleep(max(0.0, duration_s))

    def wait(self, waitable: Waitable, timeout_s: float) -> bool:
        return waitable.wait(max(0.0, timeout_s))


REAL = _RealClock()


class Follower(threading.Thread):
    """A daemon thread that calls `work` in a `keeping_up` block of `clock`.

    `start` returns as soon as the time of an emulated cell waits for the thread, so no limit expires earlier. It
    raises the exceptions of `Clock.keeping_up`.
    """

    def __init__(self, clock: Clock, work: Callable[[], None], name: str) -> None:
        super().__init__(name=name, daemon=True)
        self._clock = clock
        self._work = work
        self._decided = threading.Event()
        self._refusal: Exception | None = None

    def start(self) -> None:
        """Start the thread and wait until it has entered its `keeping_up` block."""
        # An emulated cell waits for this thread: a busy computer slows the cell down, but no sample is late.
        super().start()
        self._decided.wait()
        if self._refusal is not None:
            raise self._refusal

    def run(self) -> None:
        """Call `work` in a `keeping_up` block; called in the thread."""
        with ExitStack() as stack:
            try:
                stack.enter_context(self._clock.keeping_up())
            except Exception as error:
                self._refusal = error
                return
            finally:
                self._decided.set()
            self._work()
