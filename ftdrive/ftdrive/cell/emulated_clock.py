"""Client of the clock of an emulated cell. `mocks/ftmocks/clock.py` describes the shared page and its rules."""

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
# Period at which a thread that waits inside `keeping_up` reads the clock, s.
_SLICE_S: Final = 0.005
# If the clock stands still for this time, s, check whether the process of the emulated cell has ended.
_SUSPECT_S: Final = 0.25
_PATIENCE_S: Final = 30.0
_LOCAL_SLOTS: Final = 8
_LOCAL_LEAD_NS: Final = 10_000_000
_NEVER_NS: Final = 2**62
_claiming = threading.Lock()


class EmulatedClock(Clock):
    """Clock of an emulated cell; after the end of its process it continues with the computer's clock.

    Parameters
    ----------
    path : str
        Page of shared memory that the station has announced.

    Raises
    ------
    ConnectError
        The page does not exist, or has another version.
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
                "install the same version of ftdrive and its emulators",
            )
        weakref.finalize(self, os.close, self._descriptor)
        self._own = threading.local()
        self._seen_ns, self._seen_at_s = 0, 0.0
        # Offset from the computer's clock, ns, once the process of the emulated cell has ended; None before.
        self._ended_ns: int | None = None

    def patience_s(self, limit_s: float) -> float:
        """Return a time limit for this clock: at least 30 s, as the emulating process may get little CPU time."""
        return max(limit_s, _PATIENCE_S)

    def now_ns(self) -> int:
        """Return the time of the emulated cell, and let it advance unless this thread is inside `held`."""
        now_ns = self._read_ns()
        if not getattr(self._own, "held", False):
            self._follow(now_ns)
        return now_ns

    def sleep(self, duration_s: float) -> None:
        """Sleep; meanwhile the clock does not wait for this thread."""
        deadline_ns = self.now_ns() + round(duration_s * 1e9)
        self._follow(deadline_ns)
        while (left_ns := deadline_ns - self._read_ns()) > 0:
            time.sleep(min(max(left_ns / 1e9, 5e-4), _SUSPECT_S))
        self.now_ns()

    def wait(self, waitable: Waitable, timeout_s: float) -> bool:
        """Wait for an event, in short slices if the clock waits for this thread; return whether it was set."""
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
        """Let the clock wait for this thread during the block; blocks may be nested."""
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
        """Stop the clock during the block, provided that this thread is inside `keeping_up`."""
        self._own.held = True
        try:
            yield
        finally:
            self._own.held = False

    @contextmanager
    def away(self) -> Iterator[None]:
        """Let the clock advance without this thread during the block."""
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
        raise ConnectError("too many threads use one emulated cell", "start another cell")

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
        """Return whether the station has released its lock on the page, which it holds while it runs."""
        try:
            fcntl.flock(self._descriptor, fcntl.LOCK_SH | fcntl.LOCK_NB)
        except OSError:
            return False
        return True


class LocalClock(EmulatedClock):
    """Clock of a device that this process plays back: real time, but it waits for the threads in `keeping_up`."""

    lead_s = 0.0  # no lead: records that were late when recorded are late in playback too

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
