"""Faults between a sensor and its client, the same for every emulated sensor.

Does not model: damaged frames on CAN (its controllers discard them: use `drop`), noise bursts, slow drift of a clock.
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
    """Probabilities per frame, and delays; every field may be changed while the emulator runs.

    A frame is what the device sends as a unit: a reply, a sample, a CAN frame, a datagram.

    Parameters
    ----------
    drop, duplicate
        A frame is lost, or sent twice.
    corrupt
        One byte of a frame is changed (serial and UDP); its parity is wrong when an odd number of bits is.
    byte_slip
        One byte of a frame is lost (serial and UDP).
    swap
        A frame changes places with the next one of the same answer (CAN) or of the stream (UDP).
    foreign
        Another node's frame precedes it (CAN).
    delay_s, jitter_s
        Transmission delay, and the largest random delay added to it for each frame. Neither changes the order, and a
        stream does not fall behind.
    stall
        Nothing is sent, as with a broken wire; the device itself goes on.
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
        """Whether faults act on single frames: if not, many may be sent as one."""
        return any((self.drop, self.duplicate, self.corrupt, self.byte_slip, self.swap, self.foreign, self.jitter_s))


class FaultyWire(Generic[Frame]):
    """The frames on their way to the client, in order, with their faults.

    Parameters
    ----------
    faults
        Read at every `put`.
    clock
        Of the cell, for delays.
    seed
        Of all random faults.
    """

    def __init__(self, faults: Faults, clock: CellClock, seed: int = 0) -> None:
        self._faults = faults
        self._clock = clock
        self._random = random.Random(seed)
        self.foreign: Callable[[random.Random], Frame] | None = None
        """Makes another node's frame."""
        self._outbox: deque[tuple[float, Frame]] = deque()
        self._held: list[Frame] = []

    def put(self, frames: Sequence[Frame], *, stream: bool = False) -> None:
        """Send frames that belong together.

        Parameters
        ----------
        frames
            In the order of sending.
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
        """Remove and return the frames that arrive now."""
        arrived: list[Frame] = []
        while self._outbox and self._outbox[0][0] <= now_s:
            arrived.append(self._outbox.popleft()[1])
        return arrived

    def wait_s(self, now_s: float) -> float | None:
        """Return the time until the next frame arrives, None when there is none."""
        return max(0.0, self._outbox[0][0] - now_s) if self._outbox else None

    def clear(self) -> None:
        """Discard the frames on their way."""
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
