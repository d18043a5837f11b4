"""What the emulated serial and CAN sensors share: pacing a stream, and sending through a faulty wire.

Does not model: the time a frame takes on the wire, which is short beside the sampling period at every documented rate.
"""

import random
from abc import abstractmethod
from collections.abc import Callable
from typing import Generic

import numpy as np
from numpy.typing import NDArray

from mocks.clock import CellClock
from mocks.wires.faults import Faults, FaultyWire, Frame
from mocks.wires.pty import PtyDevice
from mocks.wires.slcan import CanFrame, SlcanAdapter

Measure = Callable[[int], NDArray[np.float64]]
MIN_WAIT_S = 1e-3


class Pacer:
    """The absolute schedule of a stream: the first sample at its start, then one per period.

    `made` counts the samples of this stream.
    """

    def __init__(self, clock: CellClock) -> None:
        self.made = 0
        self._clock = clock
        self._start_s = 0.0
        self._rate_hz: float | None = None

    @property
    def running(self) -> bool:
        """Whether there is a stream."""
        return self._rate_hz is not None

    def start(self, rate_hz: float) -> None:
        """Begin a stream, or begin it anew."""
        self._rate_hz, self._start_s, self.made = rate_hz, self._clock.now_s(), 0

    def stop(self) -> None:
        """End the stream."""
        self._rate_hz = None

    def due(self, now_s: float) -> int:
        """Return how many samples must be sent now."""
        if self._rate_hz is None or now_s < self._start_s:
            return 0
        count = int((now_s - self._start_s) * self._rate_hz) + 1 - self.made
        self.made += count
        return count

    def wait_s(self, now_s: float) -> float | None:
        """Time until the next sample is due; above 1 kHz, samples come in bursts."""
        if self._rate_hz is None:
            return None
        return max(self._start_s + self.made / self._rate_hz - now_s, MIN_WAIT_S if self._rate_hz > 1000 else 0.0)


class PtySensor(PtyDevice, Generic[Frame]):
    """A sensor behind a pseudo-terminal, which answers and streams through a faulty wire.

    `dropped_frames` counts those the terminal had no room for, because the client does not read.
    """

    def __init__(
        self,
        *,
        seed: int,
        faults: Faults | None,
        clock: CellClock | None,
        foreign: Callable[[random.Random], Frame] | None,
    ) -> None:
        super().__init__(clock)
        self.faults = Faults() if faults is None else faults
        self.dropped_frames = 0
        self._pacer = Pacer(self.clock)
        self._wire: FaultyWire[Frame] = FaultyWire(self.faults, self.clock, seed, foreign=foreign)

    @property
    def streaming(self) -> bool:
        """Whether the sensor sends samples by itself."""
        return self._pacer.running

    @abstractmethod
    def _samples(self, count: int) -> list[Frame]:
        """Frames of that many samples of the stream."""

    @abstractmethod
    def _encode(self, frames: list[Frame]) -> bytes:
        """What the client reads of these frames, and of what else the adapter has to say."""

    def _work(self, _now_s: float) -> float | None:
        """Do what else is due and return the seconds until it is due again."""
        return None

    def _tick(self, now_s: float) -> float | None:
        waits_s = [self._work(now_s)]
        count = self._pacer.due(now_s)
        if count:
            self._wire.put(self._samples(count))
        frames = self._wire.due(self.clock.now_s())
        data = self._encode(frames)
        if data and self._send(data, len(data)):
            self.dropped_frames += len(frames)
        waits_s += [self._pacer.wait_s(now_s), self._wire.wait_s(now_s)]
        return min((wait_s for wait_s in waits_s if wait_s is not None), default=None)


class SerialSensor(PtySensor[bytes]):
    """A sensor on a serial line."""

    def __init__(self, *, seed: int, faults: Faults | None, clock: CellClock | None) -> None:
        super().__init__(seed=seed, faults=faults, clock=clock, foreign=None)

    def _encode(self, frames: list[bytes]) -> bytes:
        return b"".join(frames)


class CanSensor(PtySensor[CanFrame]):
    """A sensor on a CAN bus, and the adapter a client opens.

    Parameters
    ----------
    bitrate
        Of the sensor; a client at another one gets no answer.
    """

    def __init__(self, *, seed: int, faults: Faults | None, clock: CellClock | None, bitrate: int) -> None:
        super().__init__(seed=seed, faults=faults, clock=clock, foreign=self._foreign_frame)
        self.bitrate = bitrate
        self._adapter = SlcanAdapter()
        self._answers = b""

    @abstractmethod
    def _boot(self) -> None:
        """Set the state the sensor has after power-up."""

    @abstractmethod
    def _answer(self, request: CanFrame) -> list[CanFrame]:
        """Answer to a frame on the bus; nothing when it is no request."""

    @abstractmethod
    def _foreign_frame(self, rng: random.Random) -> CanFrame:
        """Another node's frame, which a hasty client could take for the sensor's."""

    def _power_up(self) -> None:
        self._adapter = SlcanAdapter()
        self._answers = b""
        self._wire.clear()
        self._boot()

    def _restart(self) -> None:
        self._wire.clear()
        self._boot()

    def _received(self, data: bytes) -> None:
        answers, frames = self._adapter.feed(data)
        self._answers += answers
        for frame in frames:
            if self._adapter.bitrate == self.bitrate:
                self._wire.put(self._answer(frame))
            else:
                self._adapter.bus_error = True

    def _encode(self, frames: list[CanFrame]) -> bytes:
        data = self._answers
        self._answers = b""
        if self._adapter.bitrate == self.bitrate:
            data += b"".join(self._adapter.line(frame) for frame in frames)
        return data
