"""Faults of the wire between a sensor and its client, for all emulated sensors.

Not modelled: damaged frames on CAN, which its controllers discard (use `drop`), noise bursts, drift of a clock.
"""

import random
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Generic, TypeVar

from ftmocks.clock import CellClock
from ftmocks.wires.slcan import CanFrame
from ftmocks.wires.uart import WrongParity

Frame = TypeVar("Frame", bytes, CanFrame)


@dataclass
class Faults:
    """Probabilities of faults per frame, and delays. All fields may be changed while the emulator runs.

    A frame is a unit that the device sends: a reply, a sample, a CAN frame, a datagram.

    Parameters
    ----------
    drop, duplicate
        A frame is lost, or sent twice.
    corrupt
        One byte of a frame is changed (serial and UDP). Its parity is wrong if an odd number of bits is changed.
    byte_slip
        One byte of a frame is lost (serial and UDP).
    swap
        A frame is swapped with the next one of the same answer (CAN) or of the stream (UDP).
    foreign
        A frame of another node precedes it (CAN).
    delay_s, jitter_s
        Transmission delay, and the largest additional random delay of a frame. The order does not change, and the
        delays do not accumulate in a stream.
    stall
        Nothing is transmitted, as with a broken wire. The device itself continues.
    """

    drop: float = 0.0
    duplicate: float = 0.0
    corrupt: float = 0.0
    byte_slip: float = 0.0
    swap: float = 0.0
    foreign: float = 0.0
    delay_s: float = 0.0
    jitter_s: float = 0.0
    stall: bool = False

    @property
    def harm_frames(self) -> bool:
        """Whether a fault that acts on single frames is possible. If not, many frames may be sent as one."""
        return any((self.drop, self.duplicate, self.corrupt, self.byte_slip, self.swap, self.foreign, self.jitter_s))


class FaultyWire(Generic[Frame]):
    """Queue of the frames on their way to the client, with faults.

    Parameters
    ----------
    faults
        Faults, which are read at every `put`.
    clock
        Clock of the delays.
    seed
        Seed of the random faults.
    """

    def __init__(self, faults: Faults, clock: CellClock, seed: int = 0) -> None:
        self._faults = faults
        self._clock = clock
        self._random = random.Random(seed)
        self.foreign: Callable[[random.Random], Frame] | None = None
        """Function that returns a frame of another node on the CAN bus, for the fault `foreign`."""
        self._outbox: deque[tuple[float, Frame]] = deque()
        self._held: list[Frame] = []

    def put(self, frames: Sequence[Frame], *, stream: bool = False) -> None:
        """Send frames that belong together.

        Parameters
        ----------
        frames
            Frames in the order of sending.
        stream
            Whether frames of the next call may overtake the last one.
        """
        if self._faults.stall:
            return
        due_s = self._clock.now_s() + self._faults.delay_s
        if self._held or self._faults.harm_frames:
            frames = self._with_faults(frames, stream)
        for frame in frames:
            last_s = self._outbox[-1][0] if self._outbox else due_s  # frames keep their order
            self._outbox.append((max(last_s, due_s + self._faults.jitter_s * self._random.random()), frame))

    def due(self, now_s: float) -> list[Frame]:
        """Remove and return the frames that arrive at the client now."""
        arrived: list[Frame] = []
        while self._outbox and self._outbox[0][0] <= now_s:
            arrived.append(self._outbox.popleft()[1])
        return arrived

    def wait_s(self, now_s: float) -> float | None:
        """Return the time until the next frame arrives, s; None if there is none."""
        return max(0.0, self._outbox[0][0] - now_s) if self._outbox else None

    def clear(self) -> None:
        """Discard all frames in the queue."""
        self._outbox.clear()
        self._held.clear()

    def _with_faults(self, frames: Sequence[Frame], stream: bool) -> list[Frame]:
        faults, chance = self._faults, self._random.random
        sent: list[Frame] = []
        for left, frame in zip(range(len(frames) - 1, -1, -1), frames, strict=True):
            if self.foreign is not None and chance() < faults.foreign:
                sent.append(self.foreign(self._random))
            if chance() < faults.drop:
                continue
            copies = [self._damaged(frame)]
            if chance() < faults.duplicate:
                copies *= 2
            if not self._held and (left or stream) and chance() < faults.swap:
                self._held = copies
            else:
                sent += copies + self._held
                self._held = []
        if not stream:
            sent += self._held
            self._held = []
        return sent

    def _damaged(self, frame: Frame) -> Frame:
        if not isinstance(frame, bytes) or not frame:
            return frame
        data, wrong = frame, None
        if self._random.random() < self._faults.corrupt:
            i = self._random.randrange(len(data))
            flipped = self._random.randrange(1, 256)
            data = data[:i] + bytes([data[i] ^ flipped]) + data[i + 1 :]
            wrong = i if flipped.bit_count() % 2 else None
        if self._random.random() < self._faults.byte_slip:
            i = self._random.randrange(len(data))
            data = data[:i] + data[i + 1 :]
            if wrong is not None:
                wrong = None if wrong == i else wrong - (wrong > i)
        return data if wrong is None else WrongParity(data, wrong)
