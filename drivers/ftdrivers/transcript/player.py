"""The far side of a recorded wire: it plays a transcript to the unmodified driver."""

import math
import os
import select
import threading
import tty
from typing import Final

from ftdrivers.clock import REAL, Clock, Follower
from ftdrivers.transcript.recorder import Passage, Transcript
from ftdrivers.wires.serial_port import leave_marks_to_far_side, marks_asked_for

# A driver may send a request this much earlier than recorded; earlier data of the device is then sent at once.
_EARLY_S: Final = 0.05


class Player:
    """Replays a recorded device on a pseudo-terminal, to one driver that opens it once.

    Replies have the recorded delays, and unsolicited data the recorded timing. A request that is not in the rest of the
    recording is a divergence: silence follows.
    """

    def __init__(self, transcript: Transcript, clock: Clock = REAL) -> None:
        self._clock = clock
        self._passages = transcript.passages
        self._far = _Terminal(transcript)
        self._next = 0
        self._t_ns = transcript.opened_ns  # of the recording, at `_t`
        self._t = 0.0
        self._asked = bytearray()
        self._ended = threading.Event()
        self._thread: Follower | None = None
        self.divergence: str | None = None
        """The request of the driver that is not in the recording."""

    @property
    def left_s(self) -> float:
        """How much of the recording is left, in its own time."""
        left = self._passages[self._next :]
        return (left[-1].t_ns - left[0].t_ns) / 1e9 if left else 0.0

    def __enter__(self) -> str:
        """Open the far side and return the path of its pseudo-terminal."""
        path = self._far.open()
        self._thread = Follower(self._clock, self._serve, f"player on {path}")
        self._thread.start()
        return path

    def __exit__(self, *_: object) -> None:
        self._ended.set()
        if self._thread is not None:
            self._thread.join()
            self._thread = None
            self._far.close()

    def _serve(self) -> None:
        while not self._far.is_awaited():  # nothing is sent before the driver is ready for it
            if self._clock.wait(self._ended, 0.001):
                return
        self._t = self._clock.now_s()
        while not self._ended.is_set():
            self._clock.now_ns()  # an emulated cell waits for this thread
            wait_s = min(self._clock.poll_s, max(0.0, self._play()))
            readable, _, _ = select.select([self._far], [], [], wait_s)
            if readable:
                data = self._far.read()
                if data is None:
                    return
                self._asked += data
                self._listen()

    def _play(self) -> float:
        """Send the data that is due; return the seconds until more may be."""
        if self._far.is_full:
            self._far.send(b"")
        while self._next < len(self._passages) and not self.divergence and not self._passages[self._next].sent:
            passage = self._passages[self._next]
            wait_s = self._due_in_s(passage)
            if wait_s > 0:
                return wait_s
            self._far.send(passage.data)
            self._next += 1
        return 0.001 if self._far.is_full else math.inf

    def _due_in_s(self, passage: Passage) -> float:
        return self._t + (passage.t_ns - self._t_ns) / 1e9 - self._clock.now_s()

    def _listen(self) -> None:
        """Compare what the driver writes with the next request of the recording."""
        while self._asked and not self.divergence:
            first = self._request_from(self._next)
            if first is None:  # the driver is closing, or the recording was broken off
                self._asked.clear()
                return
            expected = self._passages[first].data
            if len(expected) > len(self._asked) and expected.startswith(self._asked):
                return
            found: int | None = first
            while found is not None and not self._asked.startswith(self._passages[found].data):
                found = self._request_from(found + 1)
            if found is None:
                self.divergence = f"the driver sent {self._asked.hex(' ')}, the recording has {expected.hex(' ')}"
                return
            if found == first:
                for passage in self._passages[self._next : found]:
                    if self._due_in_s(passage) < _EARLY_S:
                        self._far.send(passage.data)
            request = self._passages[found]
            del self._asked[: len(request.data)]
            self._next = found + 1
            self._t, self._t_ns = self._clock.now_s(), request.t_ns

    def _request_from(self, start: int) -> int | None:
        return next((i for i in range(start, len(self._passages)) if self._passages[i].sent), None)


# Playing uses a pseudo-terminal, so the driver runs on the real pyserial.
class _Terminal:
    """A pseudo-terminal; for CAN frames an slcan adapter on it, which accepts every command and does nothing."""

    def __init__(self, transcript: Transcript) -> None:
        self._parity_marks = transcript.parity_marks
        self._frames = transcript.frames
        self._line = b""
        self._unsent = b""
        self._master = -1

    def open(self) -> str:
        self._master, slave = os.openpty()
        path = os.ttyname(slave)
        tty.setraw(slave)
        os.close(slave)  # so that the master shows when a driver opens and closes
        os.set_blocking(self._master, False)
        return path

    def close(self) -> None:
        os.close(self._master)

    def is_awaited(self) -> bool:
        """Whether the driver has opened the port, and asked for marks if there are any."""
        poll = select.poll()
        poll.register(self._master, 0)
        if poll.poll(0):  # "hung up" until a driver has opened the other end
            return False
        if self._parity_marks:
            if not marks_asked_for(self._master):
                return False
            leave_marks_to_far_side(self._master)
        return True

    def fileno(self) -> int:
        return self._master

    def read(self) -> bytes | None:
        """Return what the driver has sent; None when it has closed the port."""
        try:
            data = os.read(self._master, 4096)
        except OSError:
            return None  # the driver has closed the port
        return self._frames_of(data) if self._frames else data

    def _frames_of(self, data: bytes) -> bytes:
        """Leave out commands to the adapter, because the recording was made with another one."""
        *lines, self._line = (self._line + data).split(b"\r")
        return b"".join(line + b"\r" for line in lines if line[:1] in {b"t", b"T", b"r", b"R"})

    def send(self, data: bytes) -> None:
        """Send as much as the driver accepts; the next call sends the rest first."""
        data = self._unsent + data
        try:
            written = os.write(self._master, data)
        except BlockingIOError:
            written = 0
        self._unsent = data[written:]

    @property
    def is_full(self) -> bool:
        return bool(self._unsent)
