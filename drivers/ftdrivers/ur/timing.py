"""Time-outs of a Universal Robots arm, and waits for an event or a lock."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from threading import RLock
from typing import Final, Self

from ftdrivers.clock import Clock, Waitable

_TURN_NS: Final = 50_000_000


@dataclass(frozen=True)
class UrTiming:
    """Time-outs in seconds. The defaults are for a real cell; docs/explanation/ur-controller.md has their effects."""

    # Limits on samples from the controller are equal in real and emulated cells.
    stale_s: float = 0.2
    """Longest time without a sample before the controller counts as silent."""
    status_s: float = 0.05
    """Largest age of a status since its receipt."""
    late_s: float = 0.05
    """Largest delay of a sample by the controller's clock; later samples are too old for a state or a status."""
    glance_s: float = 0.1
    """Time for which a stop waits for a sample before it uses the dashboard server."""
    reason_s: float = 0.05
    """Time from the end of a program until the controller reports the reason."""
    still_s: float = 0.3
    """Time of uninterrupted rest after which vibrations of the structure have decayed."""
    ours_every_s: float = 0.1
    """Interval at which the control program is asked, during a move, whether it still runs."""

    # Time-outs of other processes, threads and servers are long in an emulated cell.
    connect_s: float = 2.0
    """Time-out for starting RTDE, for one request to the dashboard server, and for connecting to the program port."""
    release_s: float = 1.0
    """Time-out until another client releases registers and program. A client whose parent was killed takes 0.5 s."""
    starting_s: float = 4.5
    """Time-out from the start of the control process until its program plays."""
    call_s: float = 2.0
    """Time-out for a reply from the control process; 10 ms are usual. Guards watch the motion meanwhile."""
    progress_s: float = 0.4
    """Time-out for the question whether a move has ended, which takes 0.03 ms. The guard is not called meanwhile."""
    ours_s: float = 0.4
    """Time-out for the control program's answer that it still runs, which takes two control cycles at most."""
    ours_again_s: float = 1.0
    """Value of `ours_s` while an open arm is opened again."""
    ours_closing_s: float = 0.3
    """Value of `ours_s` when the arm is closed."""
    quit_s: float = 0.7
    """Time-out for ending the control program and its process when the arm is closed."""
    braking_s: float = 0.5
    """Time-out of `stopJ`, in addition to the time in which the joints decelerate."""
    stop_s: float = 0.4
    """Time-out of a stop through the dashboard server, which takes 0.02 s. Then it continues in the background."""
    stop_silent_s: float = 0.15
    """Value of `stop_s` if no sample has arrived for `stale_s`."""
    reach_s: float = 1.5
    """Time for which the attempt in the background tries to connect, enough for one retransmission of TCP."""
    unwatched_s: float = 0.5
    """Time without a request after which the control process stops a move."""
    child_starting_s: float = 9.0
    """Time-out after which the control process ends if ur_rtde, which gives up after 5 s, has not connected."""
    child_leaving_s: float = 3.0
    """Time-out for the exit of the control process after the parent has ended."""

    @classmethod
    def emulated(cls) -> Self:
        """Return the time-outs of an emulated cell, whose processes may get little CPU time."""
        return cls(
            connect_s=30.0,
            release_s=5.0,  # shorter than other time-outs, because this wait always takes its full time
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
"""Time-outs of a real cell."""


class Patience:
    """Waits in turns until `limit_s` has passed. A turn in which this process was suspended adds two turns at most.

    A suspended process receives nothing, so the silence does not show that the other side is dead.
    """

    def __init__(self, clock: Clock, limit_s: float) -> None:
        self._clock = clock
        self._left_ns = round(limit_s * 1e9)
        self._counted_ns = clock.now_ns()

    @property
    def is_over(self) -> bool:
        """Whether the wait has lasted `limit_s` or longer."""
        return self._left_ns <= 0

    def wait(self, changed: Waitable) -> None:
        """Wait for one turn at most until `changed` is notified. The time since the last turn is included."""
        self._clock.wait(changed, min(self._left_ns, _TURN_NS) / 1e9)
        now_ns = self._clock.now_ns()
        self._left_ns -= min(now_ns - self._counted_ns, 2 * _TURN_NS)
        self._counted_ns = now_ns


@contextmanager
def held(lock: RLock, clock: Clock) -> Iterator[None]:
    """Hold a lock. While a thread waits for it, the thread continues to follow the clock of an emulated cell."""
    while not lock.acquire(timeout=0.02):
        clock.now_ns()
    try:
        yield
    finally:
        lock.release()
