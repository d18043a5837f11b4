"""A sensor behind a pseudo-terminal, which answers and streams through a faulty wire.

Ref: pty(7), termios(3). The slave end stays open here, or the master would read EIO when a client closes its end. With
`sees_openings` only the client opens the slave end: while no client has it open, the master is hung up.

A pty has no parity. If the line has it, a client requests marks with INPCK and PARMRK, as on a real port. The emulator
then clears PARMRK, or the kernel would double the marks. While INPCK is set, the emulator does all marking. Bytes in
the terminal while the client changes its flags arrive in either form.

Does not model: line speed (a pty has none), INPCK without PARMRK, IGNPAR, parity of what the client sends, modem lines,
breaks.
"""

import contextlib
import os
import select
import termios
import tty
from abc import abstractmethod
from bisect import bisect_left
from collections.abc import Callable
from dataclasses import dataclass

from ftmocks.wires.device import Device
from ftmocks.wires.faults import Frame
from ftmocks.wires.uart import marked


@dataclass(eq=False)
class PtyDevice(Device[Frame]):
    """Base class of the emulated serial and CAN sensors: opening, unplugging, reading, and writing that never blocks.

    `dropped_frames` counts the frames for which the terminal had no room, because the client does not read.
    """

    has_parity = False  # whether the line has parity, so that wrong parity can occur
    sees_openings = False  # whether the device can use `_is_open`, which is then correct within 5 ms

    def __post_init__(self) -> None:
        super().__post_init__()
        self.dropped_frames = 0
        self._slave = -1
        self._unsent = b""
        self._begun = b""  # rest of a parity mark of which the terminal took only a part

    def start(self) -> str:
        """Power the device up behind a new pseudo-terminal.

        Returns
        -------
        Path that a client opens, for example ``/dev/pts/3``.
        """
        self._require_stopped()
        self._file, self._slave = os.openpty()
        tty.setraw(self._file)
        tty.setraw(self._slave)  # else the terminal echoes what the device sends
        os.set_blocking(self._file, False)
        self._unsent = self._begun = b""
        path = os.ttyname(self._slave)
        if self.sees_openings:
            os.close(self._slave)
            self._slave = -1
        self._launch()
        return path

    @property
    def _is_open(self) -> bool:
        """Whether a client has the port open; True for a device that cannot detect this."""
        if not self.sees_openings or self._file < 0:
            return True
        poll = select.poll()
        poll.register(self._file, 0)
        return not poll.poll(0)

    @property
    def _readable(self) -> list[int]:
        return [self._file] if self._is_open else []  # a terminal that is hung up is always readable

    @abstractmethod
    def _received(self, data: bytes) -> None:
        """Process the bytes that the client wrote, in pieces of any size."""

    @abstractmethod
    def _samples(self, count: int) -> list[Frame]:
        """Return the frames of the next `count` samples of the stream."""

    @abstractmethod
    def _encode(self, frames: list[Frame]) -> bytes:
        """Return the bytes of these frames as the client reads them, and other bytes that the adapter sends."""

    def _receive(self) -> None:
        data = b""
        with contextlib.suppress(OSError):  # the client has closed the port
            data = os.read(self._file, 4096)
        self._received(data)

    def _sample(self, count: int) -> None:
        self._wire.put(self._samples(count))

    def _deliver(self, frames: list[Frame]) -> None:
        data = self._encode(frames)
        if data and self._send(data, len(data)):
            self.dropped_frames += len(frames)

    def _close(self) -> None:
        os.close(self._file)
        if self._slave >= 0:
            os.close(self._slave)

    def _send(self, data: bytes, record_bytes: int) -> int:
        """Write without blocking; if the client does not read, drop whole records and keep none.

        Parameters
        ----------
        data
            Whole records; the first may lack bytes at its start.
        record_bytes
            Length of a record. A record whose first bytes were sent is completed before the next one.

        Returns
        -------
        Number of dropped records.
        """
        self._finish_record()
        rest = data if self._unsent else data[self._write(data) :]
        if not rest:
            return 0
        if not self._unsent:
            self._unsent = rest[: len(rest) % record_bytes]
        return len(rest) // record_bytes

    @property
    def _unfinished(self) -> bool:
        return bool(self._unsent or self._begun)

    def _finish_record(self) -> None:
        if self._unfinished:
            self._unsent = self._unsent[self._write(self._unsent) :]

    def _fall_silent(self) -> None:
        """End the stream and discard all bytes in transit, including a record that was sent in part."""
        self._pacer.stop()
        self._wire.clear()
        self._unsent = b""

    def _write(self, data: bytes) -> int:
        """Write without blocking; return the number of bytes sent, including one whose mark was sent in part."""
        # The flags are read before every write: while PARMRK is on, the kernel would double the marks made here.
        form: Callable[[bytes], bytes] = marked if self.has_parity and self._client_wants_marks() else bytes
        wire = self._begun + form(data)
        try:
            wire_sent = os.write(self._file, wire)
        except BlockingIOError:
            return 0
        if wire_sent == len(wire):
            self._begun = b""
            return len(data)
        wire_sent -= len(self._begun)
        if wire_sent < 0:
            self._begun = self._begun[wire_sent:]
            return 0
        sent = bisect_left(range(len(data)), wire_sent, key=lambda count: len(form(data[:count])))
        self._begun = form(data[:sent])[wire_sent:]
        return sent

    def _client_wants_marks(self) -> bool:
        """Whether wrong parity must be marked. After True is returned, the kernel no longer marks anything."""
        attributes = termios.tcgetattr(self._file)  # the flags of the client: both ends share them
        flags = attributes[0]
        if flags & (termios.INPCK | termios.IGNPAR) != termios.INPCK:
            return False
        if flags & termios.PARMRK:
            attributes[0] = flags & ~termios.PARMRK
            termios.tcsetattr(self._file, termios.TCSANOW, attributes)
        return True
