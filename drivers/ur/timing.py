"""Every limit of time that a Universal Robots arm is held to, and the one way to wait for something within one."""

from dataclasses import dataclass
from typing import Final, Self

from drivers.clock import Clock, Waitable

_TURN_NS: Final = 50_000_000


@dataclass(frozen=True)
class UrTiming:
    """Limits in seconds. The defaults are for a real cell: `drivers/ur/README.md` says what depends on them."""

    # What the controller's samples prove: the same for every cell.
    stale_s: float = 0.2
    """The longest silence of the controller."""
    status_s: float = 0.05
    """The greatest age of a status."""
    glance_s: float = 0.1
    """What a stop waits for a sample before it takes the way that needs none."""
    reason_s: float = 0.05
    """A program may end some cycles before the controller reports why."""
    still_s: float = 0.3
    """Rest without a break, after which the structure no longer rings."""
    ours_every_s: float = 0.1
    """During a move, the control program is asked a question after so long."""

    # What another process, thread or server may take: generous in an emulated cell.
    connect_s: float = 2.0
    """Greeting of RTDE, one question to the dashboard server, connection to the script port."""
    release_s: float = 1.0
    """Until another client has let registers and program go; one whose parent was killed needs half of that."""
    starting_s: float = 4.5
    """Start of the control process, until its program plays."""
    call_s: float = 2.0
    """An answer of the control process; it takes 10 ms, and motion is watched meanwhile."""
    progress_s: float = 0.4
    """The same for the progress of a move, which takes 0.03 ms; the guard is not called meanwhile."""
    ours_s: float = 0.4
    """A question to the control program, which answers within two control cycles."""
    ours_again_s: float = 1.0
    """The same when the arm is opened again, where nothing hurries."""
    ours_closing_s: float = 0.3
    """The same when the arm is closed."""
    quit_s: float = 0.7
    """End of the control program and of its process when the arm is closed."""
    braking_s: float = 0.5
    """A soft stop, beyond the time the joints need to decelerate."""
    stop_s: float = 0.4
    """A stop through the dashboard server, which takes 0.02 s; it goes on in the background afterwards."""
    stop_silent_s: float = 0.15
    """The same when the controller has been silent for `stale_s`."""
    reach_s: float = 1.5
    """How long the attempt in the background tries to connect: one retransmission of TCP."""
    unwatched_s: float = 0.5
    """The control process stops a move about which it was not asked for so long."""
    child_starting_s: float = 9.0
    """The control process ends itself when ur_rtde, which gives up after 5 s, has not started it by then."""
    child_leaving_s: float = 3.0
    """The same when its parent has gone."""

    @classmethod
    def emulated(cls) -> Self:
        """Limits of an emulated cell, whose processes may have to wait for the computer."""
        return cls(
            connect_s=30.0,
            release_s=5.0,  # silence is the answer here: whoever holds on is waited for as long
            starting_s=30.0,
            call_s=30.0,
            progress_s=30.0,
            ours_s=5.0,  # the same: a program of another client never answers
            ours_again_s=5.0,
            ours_closing_s=5.0,
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
    """Waits in turns, `limit_s` in all. A turn in which this process was itself suspended counts as two at most.

    A suspended process has not listened, so what it has not heard proves nothing.
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
        """Wait until `changed` is notified, a turn at most; what was done since the last turn counts too."""
        self._clock.wait(changed, min(self._left_ns, _TURN_NS) / 1e9)
        now_ns = self._clock.now_ns()
        self._left_ns -= min(now_ns - self._counted_ns, 2 * _TURN_NS)
        self._counted_ns = now_ns
