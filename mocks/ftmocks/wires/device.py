"""What every emulated sensor has: settings, a paced stream, a faulty wire, and the thread that serves it.

Does not model: the time a frame takes on the wire, which is short beside the sampling period at every documented rate.
"""

import os
import select
import threading
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import KW_ONLY, dataclass, field
from typing import Any, Generic

import numpy as np
from numpy.typing import NDArray

from ftmocks.arrays import Array
from ftmocks.clock import CellClock, time_out_s
from ftmocks.wires.faults import Faults, FaultyWire, Frame

Measure = Callable[[int], Array]
MIN_WAIT_S = 2e-3
"""Samples above 1 kHz come in bursts, as a USB adapter delivers them."""
_END, _RESET = b"!", b"r"


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
        """Start a stream, or restart it."""
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

    def times_s(self, count: int) -> Array:
        """Return when the last samples that were due had to be measured, (count,) on the cell's clock."""
        if self._rate_hz is None:
            return np.full(count, self._clock.now_s())
        return self._start_s + np.arange(self.made - count, self.made) / self._rate_hz

    def wait_s(self, now_s: float) -> float | None:
        """Return the time until the next sample is due."""
        if self._rate_hz is None:
            return None
        return max(self._start_s + self.made / self._rate_hz - now_s, MIN_WAIT_S if self._rate_hz > 1000 else 0.0)


@dataclass(eq=False)
class Device(ABC, Generic[Frame]):
    """An emulated sensor. Its fields may be changed while it runs, except addresses.

    Parameters
    ----------
    measure
        Returns (n, 6) successive noisy readings in N and N·m, sensor axes; thread-safe. The device calls it once for
        every sample that it makes.
    seed, faults
        Of the wire.
    clock
        Of the cell; without one the device makes its own.
    saturated_axis
        Number 0 to 5 of an axis that always reads the end of its range; of a gauge where the sensor sends gauges.
    """

    measure: Measure
    _: KW_ONLY
    seed: int = 0
    faults: Faults = field(default_factory=Faults)
    clock: CellClock = field(default_factory=CellClock)
    saturated_axis: int | None = None

    def __post_init__(self) -> None:
        self._pacer = Pacer(self.clock)
        self._wire: FaultyWire[Frame] = FaultyWire(self.faults, self.clock, self.seed)
        self._threads: list[threading.Thread] = []
        self._file = self._wake_read = self._wake_write = -1

    @property
    def streaming(self) -> bool:
        """Whether the sensor sends samples by itself."""
        return self._pacer.running

    def sample_times_s(self, count: int) -> Array:
        """Return when the readings that the device asks for now are measured, (count,) on the cell's clock."""
        return self._pacer.times_s(count)

    @abstractmethod
    def start(self) -> Any:
        """Power the device up and return what a client opens: a path, or addresses by name.

        Raises
        ------
        RuntimeError
            If the device is running already.
        OSError
            If an address cannot be had.
        """

    def unplug(self) -> None:
        """Close the wire as a pulled cable does: the client's next read or write fails."""
        if not self._threads:
            return
        os.write(self._wake_write, _END)
        for thread in self._threads:
            thread.join()
        self._threads.clear()
        os.close(self._wake_write)
        os.close(self._wake_read)

    def stop(self) -> None:
        """End the device; harmless when it has ended already."""
        self.unplug()

    def reset(self) -> None:
        """Interrupt the device's supply for a moment: it restarts on the same wire."""
        if self._threads:
            os.write(self._wake_write, _RESET)

    @abstractmethod
    def _power_up(self) -> None:
        """Set the state the device has after power-up."""

    def _restart(self) -> None:
        """Set the state after the supply was interrupted."""
        self._power_up()

    @abstractmethod
    def _receive(self) -> None:
        """Read what the client has sent and act on it."""

    def _work(self, _now_s: float) -> float | None:
        """Do what else is due and return the seconds until it is due again."""
        return None

    @abstractmethod
    def _sample(self, count: int) -> None:
        """Make the next samples of the stream and put them on the wire."""

    @abstractmethod
    def _deliver(self, frames: list[Frame]) -> None:
        """Pass on the frames that arrive at the client now."""

    @property
    def _readable(self) -> list[int]:
        """Files on which something may come from the client."""
        return [self._file]

    @property
    def _unfinished(self) -> bool:
        """Whether something waits until the client reads."""
        return False

    def _finish_record(self) -> None:
        """Send what was left over."""

    @abstractmethod
    def _close(self) -> None:
        """Close the wire."""

    def _readings(self, count: int, limit: Array) -> tuple[Array, NDArray[np.bool_]]:
        """Return (count, 6) readings clipped at `limit` (6,), and (count,) whether one is at its limit."""
        readings = self.measure(count)
        if self.saturated_axis is not None:
            readings = readings.copy()
            readings[:, self.saturated_axis] = limit[self.saturated_axis]
        return readings.clip(-limit, limit), np.any(np.abs(readings) >= limit, axis=1)

    def _require_stopped(self) -> None:
        if self._threads:
            raise RuntimeError(f"{type(self).__name__} runs already: stop it before starting it again")

    def _launch(self, *more: Callable[[], None]) -> None:
        """Power the device up and start its thread, and threads for what else it serves."""
        self._wake_read, self._wake_write = os.pipe()
        self._power_up()
        for target in (self._serve, *more):
            self._threads.append(threading.Thread(target=target, name=type(self).__name__, daemon=True))
            self._threads[-1].start()

    def _serve(self) -> None:
        try:
            with self.clock.keeping_up():
                while self._turn():
                    pass
        finally:
            self._close()

    def _turn(self) -> bool:
        """Do what is due, then wait for the client and take what it sent; False when the device was unplugged."""
        wait_s = time_out_s(self._tick(self.clock.follow() * 1e-9))
        writers = [self._file] if self._unfinished else []
        readable, writable, _ = select.select([*self._readable, self._wake_read], writers, [], wait_s)
        if self._wake_read in readable:
            if os.read(self._wake_read, 1) == _END:
                return False
            self._restart()
        if writable:
            self._finish_record()
        if self._file in readable:
            self._receive()
        return True

    def _tick(self, now_s: float) -> float | None:
        """Do what is due and return the seconds until the next call is needed, None for not before the client sends."""
        waits_s = [self._work(now_s)]
        if count := self._pacer.due(now_s):
            self._sample(count)
        self._deliver(self._wire.due(self.clock.now_s()))
        waits_s += [self._pacer.wait_s(now_s), self._wire.wait_s(now_s)]
        return min((wait_s for wait_s in waits_s if wait_s is not None), default=None)
