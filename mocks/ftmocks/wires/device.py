"""Base class of emulated sensors: settings, a stream with a schedule, a wire with faults, and the serving thread.

Not modelled: the transmission time of a frame, which is short compared with the sample period at every documented rate.
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
"""Shortest wait of the serving thread, s. Faster samples are sent in bursts, as a USB adapter delivers them."""
_END, _RESET = b"!", b"r"


class Pacer:
    """Schedule of a stream: the first sample at the start, then one sample per period. `made` counts the samples."""

    def __init__(self, clock: CellClock) -> None:
        self.made = 0
        self._clock = clock
        self._start_s = 0.0
        self._rate_hz: float | None = None

    @property
    def running(self) -> bool:
        """Whether the stream runs."""
        return self._rate_hz is not None

    def start(self, rate_hz: float) -> None:
        """Start or restart the stream."""
        self._rate_hz, self._start_s, self.made = rate_hz, self._clock.now_s(), 0

    def stop(self) -> None:
        """End the stream: no further sample becomes due."""
        self._rate_hz = None

    def due(self, now_s: float) -> int:
        """Return the number of samples that are due."""
        if self._rate_hz is None or now_s < self._start_s:
            return 0
        count = int((now_s - self._start_s) * self._rate_hz) + 1 - self.made
        self.made += count
        return count

    def times_s(self, count: int) -> Array:
        """Return the times (count,) on the cell's clock at which the last due samples were to be measured."""
        if self._rate_hz is None:
            return np.full(count, self._clock.now_s())
        return self._start_s + np.arange(self.made - count, self.made) / self._rate_hz

    def wait_s(self, now_s: float) -> float | None:
        """Return the time until the next sample is due, s."""
        if self._rate_hz is None:
            return None
        return max(self._start_s + self.made / self._rate_hz - now_s, MIN_WAIT_S if self._rate_hz > 1000 else 0.0)


@dataclass(eq=False)
class Device(ABC, Generic[Frame]):
    """An emulated sensor. All fields except addresses may be changed while it runs.

    Parameters
    ----------
    measure
        Thread-safe function that returns n noisy readings (n, 6), N and N·m, in sensor axes. It is called once per
        sample.
    seed, faults
        Random seed, and faults of the wire.
    clock
        Clock of the cell; None creates one.
    saturated_axis
        Index 0 to 5 of an axis, or of a gauge if the sensor sends gauges, that always reads the end of its range.
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
        """Whether the sensor sends samples without requests."""
        return self._pacer.running

    def sample_times_s(self, count: int) -> Array:
        """Return the times (count,), on the cell's clock, at which the next `count` readings are to be measured."""
        return self._pacer.times_s(count)

    @abstractmethod
    def start(self) -> Any:
        """Power the device up and return what a client opens: a path, or addresses by name.

        Raises
        ------
        RuntimeError
            The device is running already.
        OSError
            An address is not available.
        """

    def unplug(self) -> None:
        """Close the wire, as if the cable had been pulled: the next read or write of the client fails."""
        if not self._threads:
            return
        os.write(self._wake_write, _END)
        for thread in self._threads:
            thread.join()
        self._threads.clear()
        os.close(self._wake_write)
        os.close(self._wake_read)

    def stop(self) -> None:
        """Switch the device off and end its threads. Idempotent."""
        self.unplug()

    def reset(self) -> None:
        """Interrupt the supply of the device for a moment, which restarts it on the same wire."""
        if self._threads:
            os.write(self._wake_write, _RESET)

    @abstractmethod
    def power_up(self) -> None:
        """Set the state that the device has after power-up."""

    def _restart(self) -> None:
        """Set the state after an interruption of the supply."""
        self.power_up()

    @abstractmethod
    def _receive(self) -> None:
        """Read and process the bytes that the client has sent."""

    def _work(self, _now_s: float) -> float | None:
        """Do the tasks of a subclass that are due, other than the stream; return the time until the next one, s."""
        return None

    @abstractmethod
    def _sample(self, count: int) -> None:
        """Put the next `count` samples of the stream on the wire."""

    @abstractmethod
    def _deliver(self, frames: list[Frame]) -> None:
        """Write these frames, which arrive at the client now, to the wire."""

    @property
    def _readable(self) -> list[int]:
        """Files or sockets from which bytes of the client can be read."""
        return [self._file]

    @property
    def _unfinished(self) -> bool:
        """Whether a record was sent in part, because the client does not read."""
        return False

    def _finish_record(self) -> None:
        """Send the rest of a record that was sent in part."""

    @abstractmethod
    def _close(self) -> None:
        """Close the wire."""

    def _readings(self, count: int, limit: Array) -> tuple[Array, NDArray[np.bool_]]:
        """Return readings (count, 6), clipped at `limit` (6,), and whether each is at the limit (count,)."""
        readings = self.measure(count)
        if self.saturated_axis is not None:
            readings = readings.copy()
            readings[:, self.saturated_axis] = limit[self.saturated_axis]
        return readings.clip(-limit, limit), np.any(np.abs(readings) >= limit, axis=1)

    def _require_stopped(self) -> None:
        if self._threads:
            raise RuntimeError(f"{type(self).__name__} runs already: stop it before starting it again")

    def _launch(self, *more: Callable[[], None]) -> None:
        """Power the device up and start its threads."""
        self._wake_read, self._wake_write = os.pipe()
        self.power_up()
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
        """Do due tasks, then wait for the client and process its bytes; return False if the device was unplugged."""
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
        """Do the tasks that are due; return the time until the next one, s; None if only the client can cause one."""
        waits_s = [self._work(now_s)]
        if count := self._pacer.due(now_s):
            self._sample(count)
        self._deliver(self._wire.due(self.clock.now_s()))
        waits_s += [self._pacer.wait_s(now_s), self._wire.wait_s(now_s)]
        return min((wait_s for wait_s in waits_s if wait_s is not None), default=None)
