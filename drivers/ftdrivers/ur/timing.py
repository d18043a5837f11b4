"""Every time limit of a Universal Robots arm; waits for an event and for a lock."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from threading import RLock
from typing import Final, Self

from ftdrivers.clock import Clock, Waitable

_TURN_NS: Final = 50_000_000


@dataclass(frozen=True)
class UrTiming:
    """Limits in seconds. The defaults are for a real cell; docs/explanation/ur-controller.md has their effects."""

    # Limits on samples of the controller, the same in every cell.
    stale_s: float = 0.2
    """The longest time without a sample."""
    status_s: float = 0.05
    """The greatest age of a status, from its receipt."""
    late_s: float = 0.05
    """A sample that is later than this by the controller's clock is too old for a state or a status."""
    glance_s: float = 0.1
    """The wait of a stop for a sample, before it uses the dashboard server."""
    reason_s: float = 0.05
    """A program may end some cycles before the controller reports the reason."""
    still_s: float = 0.3
    """Rest without a break, after which the structure no longer rings."""
    ours_every_s: float = 0.1
    """Period of the question to the control program during a move."""

    # Limits on other processes, threads and servers: generous in an emulated cell.
    connect_s: float = 2.0
    """Start-up of RTDE, one request to the dashboard server, connection to the script port."""
    release_s: float = 1.0
    """Until another client releases registers and program; one whose parent was killed takes 0.5 s."""
    starting_s: float = 4.5
    """Start of the control process, until its program plays."""
    call_s: float = 2.0
    """A reply of the control process, which takes 10 ms. Motion is watched meanwhile."""
    progress_s: float = 0.4
    """Such a reply about the progress of a move, which takes 0.03 ms. The guard is not called meanwhile."""
    ours_s: float = 0.4
    """A question to the control program, which answers within two control cycles."""
    ours_again_s: float = 1.0
    """This question when the arm is reopened."""
    ours_closing_s: float = 0.3
    """This question when the arm is closed."""
    quit_s: float = 0.7
    """End of the control program and of its process when the arm is closed."""
    braking_s: float = 0.5
    """A `stopJ`, beyond the time in which the joints decelerate."""
    stop_s: float = 0.4
    """A stop through the dashboard server, which takes 0.02 s; it continues in the background afterwards."""
    stop_silent_s: float = 0.15
    """Such a stop when no sample has arrived for `stale_s`."""
    reach_s: float = 1.5
    """How long the attempt in the background tries to connect: one retransmission of TCP."""
    unwatched_s: float = 0.5
    """The control process stops a move after this time without a request."""
    child_starting_s: float = 9.0
    """The control process ends itself when ur_rtde, which gives up after 5 s, has not connected by then."""
    child_leaving_s: float = 3.0
    """The control process ends itself if its exit takes longer after the parent has gone."""

    @classmethod
    def emulated(cls) -> Self:
        """Return the limits of an emulated cell, whose processes may be starved."""
        # Limits on samples are the same in every cell; those on other processes are generous.
        return cls(
            connect_s=30.0,
            release_s=5.0,  # another client gives no answer, so this wait always ends at its limit
            starting_s=30.0,
            call_s=30.0,
            progress_s=30.0,
            ours_s=30.0,
            ours_again_s=30.0,
            ours_closing_s=30.0,
            quit_s=30.0,
            braking_s=30.0,
            stop_s=30.0,
            stop_silent_s=2.0,
            unwatched_s=30.0,
            child_starting_s=35.0,
            child_leaving_s=30.0,
        )


STRICT: Final = UrTiming()
"""Limits of a real cell."""


class Patience:
    """Waits in turns, `limit_s` in total. A turn in which this process was suspended counts as two at most.

    A suspended process cannot receive, so its silence proves nothing.
    """

    def __init__(self, clock: Clock, limit_s: float) -> None:
        self._clock = clock
        self._left_ns = round(limit_s * 1e9)
        self._counted_ns = clock.now_ns()

    @property
    def is_over(self) -> bool:
        """Whether `limit_s` has passed."""
        return self._left_ns <= 0

    def wait(self, changed: Waitable) -> None:
        """Wait until `changed` is notified, for one turn at most; the time since the last turn counts too."""
        self._clock.wait(changed, min(self._left_ns, _TURN_NS) / 1e9)
        now_ns = self._clock.now_ns()
        self._left_ns -= min(now_ns - self._counted_ns, 2 * _TURN_NS)
        self._counted_ns = now_ns


@contextmanager
def held(lock: RLock, clock: Clock) -> Iterator[None]:
    """Hold a lock; a thread that waits for it keeps following the clock of an emulated cell."""
    while not lock.acquire(timeout=0.02):
        clock.now_ns()
    try:
        yield
    finally:
        lock.release()
