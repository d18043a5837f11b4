"""A stream that processes what it reads, and the loop that reads one over interruptions."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator

from ftdrive.live.contact import Contact
from ftdrive.live.processing import Processor
from ftdrive.live.samples import Block, LinkStatus, Paired, StreamStatus
from ftdrivers.clock import Clock
from ftdrivers.errors import DeviceError

RECOVER_S = 10.0
"""So long a stream with an interruption may take to deliver again; then its reader ends."""


class ProcessedStream(Processor, ABC):
    """A processor that reads its own samples: of a cell, or of a recording that replaces it."""

    clock: Clock
    on_contact: Callable[[Contact], object] | None = None
    """Called by the thread that reads, once when a contact has lasted 40 to 60 ms and once when it is over."""

    @abstractmethod
    def read(self) -> Block:
        """Return the next samples; none while a recording pauses."""

    @abstractmethod
    def status(self) -> StreamStatus:
        """Return rates, losses, ages, delay, tare and drift."""

    def _process_read(self, paired: Paired, *, last: bool = False) -> Block:
        block = self.process(paired, last=last)
        self._call_on_contact()
        return block

    def _call_on_contact(self) -> None:
        # Outside of the lock of the processor: the function may call the stream.
        for contact in self.take_contacts():
            if self.on_contact is not None:
                self.on_contact(contact)

    def _status_of(self, sensor: LinkStatus, arm: LinkStatus, delay: tuple[float, float]) -> StreamStatus:
        """Return the state of a stream with these links and this delay and its sigma, s."""
        drift_N_h, drift_sigma_N_h = self._drift.force_rate_N_h
        return StreamStatus(
            sensor=sensor,
            arm=arm,
            delay_s=delay[0],
            delay_sigma_s=delay[1],
            tare=self._tool.tare_wrench,
            tare_t_host_ns=self._tool.tare_t_ns,
            drift_N_h=drift_N_h,
            drift_sigma_N_h=drift_sigma_N_h,
            contact_limit=self._test.limit,
            false_alarm_rate=self._test.false_alarm_rate,
            tracked=self.tracked,
        )


class BlockReader:
    """Reads a stream block after block. While a device has failed it yields None, and raises the failure if it lasts.

    Parameters
    ----------
    stream : ProcessedStream
        Open; its `read` reconnects after a failure.
    patience_s : float
        So long a failure may last; 0 raises it at once. May be set at any time.
    say : callable
        Gets a sentence when an interruption begins, and one when it is over.
    meanwhile : str
        What the interruption means, for the first sentence.

    Attributes
    ----------
    failure : DeviceError or None
        Why the stream gives no samples now.
    """

    def __init__(
        self,
        stream: ProcessedStream,
        patience_s: float = RECOVER_S,
        *,
        say: Callable[[str], object] = lambda _: None,
        meanwhile: str = "",
    ) -> None:
        self.patience_s = patience_s
        self.failure: DeviceError | None = None
        self._stream, self._say, self._meanwhile = stream, say, meanwhile
        self._failing_since_s = 0.0

    def __iter__(self) -> Iterator[Block | None]:
        while True:
            yield self.read()

    def read(self) -> Block | None:
        """Return the next block; None while a device has failed."""
        try:
            block = self._stream.read()
        except DeviceError as error:
            now_s = self._stream.clock.now_s()
            if self.failure is None:
                self._failing_since_s = now_s
                self._say(f"{error}. {self._meanwhile}")
            self.failure = error
            # Each read has waited for the device already, so there is no pause here.
            if now_s - self._failing_since_s >= self.patience_s:
                raise
            return None
        if self.failure is not None:
            self.failure = None
            self._say("Samples arrive again.")
        return block
