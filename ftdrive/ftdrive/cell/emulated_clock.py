"""The clock of an emulated cell, as a client reads it. `mocks/ftmocks/clock.py` describes page and rule."""

import fcntl
import mmap
import os
import threading
import time
import weakref
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Final

from ftdrivers.clock import Clock, Waitable
from ftdrivers.errors import ConnectError

_VERSION: Final = 1
_NOW, _COUNT, _SLOTS = 1, 2, 4
# A thread that keeps up looks at the clock this often while it waits.
_SLICE_S: Final = 0.005
# When the time has stood still for so long, it is checked whether the station has ended.
_SUSPECT_S: Final = 0.25
_PATIENCE_S: Final = 30.0
_LOCAL_SLOTS: Final = 8
_LOCAL_LEAD_NS: Final = 10_000_000
_NEVER_NS: Final = 2**62
_claiming = threading.Lock()


class EmulatedClock(Clock):
    """Time of one emulated cell; when its process has ended, time goes on with the computer's.

    Parameters
    ----------
    path : str
        The page of shared memory that the station has announced.

    Raises
    ------
    ConnectError
        There is no such page, or it has another version.
    """

    poll_s = _SLICE_S
    lead_s = 0.03
    can_be_held = True

    def __init__(self, path: str) -> None:
        try:
            self._descriptor = os.open(path, os.O_RDWR | os.O_CLOEXEC)
            self._page = memoryview(mmap.mmap(self._descriptor, 0)).cast("q")
        except (OSError, ValueError) as error:
            raise ConnectError(f"the clock of the emulated cell cannot be read ({error})", "start it again") from error
        if self._page[0] != _VERSION:
            raise ConnectError(
                f"the clock of the emulated cell has version {self._page[0]}, not {_VERSION}",
                "install ftdrive and its emulators from one version",
            )
        weakref.finalize(self, os.close, self._descriptor)
        self._own = threading.local()
        self._seen_ns, self._seen_at_s = 0, 0.0
        # What to add to the computer's clock, once the station has ended.
        self._ended_ns: int | None = None

    def patience_s(self, limit_s: float) -> float:
        """Return a long limit on another process, which may starve."""
        return max(limit_s, _PATIENCE_S)

    def now_ns(self) -> int:
        """Return the cell's time, and let it go on where it waits for this thread and is not held."""
        now_ns = self._read_ns()
        if not getattr(self._own, "held", False):
            self._follow(now_ns)
        return now_ns

    def sleep(self, duration_s: float) -> None:
        """Sleep; a thread that keeps up is not waited for meanwhile."""
        deadline_ns = self.now_ns() + round(duration_s * 1e9)
        self._follow(deadline_ns)
        while (left_ns := deadline_ns - self._read_ns()) > 0:
            time.sleep(min(max(left_ns / 1e9, 5e-4), _SUSPECT_S))
        self.now_ns()

    def wait(self, waitable: Waitable, timeout_s: float) -> bool:
        """Wait in short turns where the cell's time waits for this thread."""
        deadline_ns = self.now_ns() + round(timeout_s * 1e9)
        longest_s = _SUSPECT_S if self._slot is None else _SLICE_S
        while True:
            left_s = (deadline_ns - self.now_ns()) / 1e9
            if waitable.wait(max(0.0, min(left_s, longest_s))):
                return True
            if left_s <= 0:
                return False

    @contextmanager
    def keeping_up(self) -> Iterator[None]:
        """Claim a slot of the page for this thread; blocks may be nested."""
        if self._slot is not None:
            yield
            return
        self._own.slot = slot = self._claim()
        try:
            yield
        finally:
            self._own.slot = None
            self._page[slot] = 0

    @contextmanager
    def held(self) -> Iterator[None]:
        """Let the time stand still for this thread."""
        self._own.held = True
        try:
            yield
        finally:
            self._own.held = False

    @contextmanager
    def away(self) -> Iterator[None]:
        """Let the time go on without this thread."""
        self._follow(_NEVER_NS)
        try:
            yield
        finally:
            self.now_ns()

    @property
    def _slot(self) -> int | None:
        slot: int | None = getattr(self._own, "slot", None)
        return slot

    def _follow(self, up_to_ns: int) -> None:
        slot = self._slot
        if slot is not None:
            self._page[slot + 1] = up_to_ns

    def _claim(self) -> int:
        with _claiming:
            fcntl.lockf(self._descriptor, fcntl.LOCK_EX, 8)
            try:
                return self._claim_first_free()
            finally:
                fcntl.lockf(self._descriptor, fcntl.LOCK_UN, 8)

    def _claim_first_free(self) -> int:
        for slot in range(_SLOTS, _SLOTS + 2 * self._page[_COUNT], 2):
            if not self._page[slot]:
                self._page[slot + 1] = self._read_ns()
                self._page[slot] = os.getpid()
                return slot
        raise ConnectError("too many threads follow one emulated cell", "start another cell")

    def _read_ns(self) -> int:
        if self._ended_ns is not None:
            return time.monotonic_ns() + self._ended_ns
        now_ns, now_s = self._page[_NOW], time.monotonic()
        if now_ns != self._seen_ns:
            self._seen_ns, self._seen_at_s = now_ns, now_s
        elif now_s - self._seen_at_s > _SUSPECT_S:
            self._seen_at_s = now_s
            if self._station_has_ended():
                self._ended_ns = now_ns - time.monotonic_ns()
        return now_ns

    def _station_has_ended(self) -> bool:
        """Whether the lock on the page is free, which the station holds as long as it lives."""
        try:
            fcntl.flock(self._descriptor, fcntl.LOCK_SH | fcntl.LOCK_NB)
        except OSError:
            return False
        return True


class LocalClock(EmulatedClock):
    """Time of a device that this process plays: it follows real time and waits for the threads that keep up."""

    lead_s = 0.0  # what was late in a recording is late in its play

    def __init__(self) -> None:
        self._page = memoryview(bytearray(8 * (_SLOTS + 2 * _LOCAL_SLOTS))).cast("q")
        self._page[_NOW], self._page[_COUNT] = time.monotonic_ns(), _LOCAL_SLOTS
        self._own = threading.local()
        self._moving = threading.RLock()
        self._behind_ns = 0

    def _claim(self) -> int:
        with self._moving:
            return self._claim_first_free()

    def _read_ns(self) -> int:
        with self._moving:
            slots, real_ns = self._page[_SLOTS:].tolist(), time.monotonic_ns()
            followed_ns = [up_to_ns for pid, up_to_ns in zip(slots[::2], slots[1::2], strict=True) if pid]
            now_ns = min([real_ns - self._behind_ns, *(up_to_ns + _LOCAL_LEAD_NS for up_to_ns in followed_ns)])
            self._page[_NOW] = now_ns = max(now_ns, self._page[_NOW])
            self._behind_ns = real_ns - now_ns
            return now_ns
