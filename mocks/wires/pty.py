"""A device behind a pseudo-terminal: one thread that waits until bytes arrive or the device has something to do.

Ref: pty(7), termios(3). The slave end stays open here, or the master would read EIO as soon as a client leaves.

A pty has no parity. Where the line has, a client asks for marks with INPCK and PARMRK, as it asks a real port. PARMRK
is then taken off again, or the kernel would double what is marked here; as long as INPCK stays, all marking is done
here. Bytes that are in the terminal while the client changes its flags come in either form.

Does not model: line speed (a pty has none), INPCK without PARMRK, IGNPAR, parity of what the client sends, modem lines,
breaks.
"""

import os
import select
import termios
import threading
import tty
from abc import ABC, abstractmethod
from bisect import bisect_left
from collections.abc import Callable

from mocks.clock import CellClock, time_out_s
from mocks.wires.uart import marked

_END, _RESET = b"!", b"r"


class PtyDevice(ABC):
    """Base of the emulated serial devices: opening, unplugging, reading, and writing that never blocks.

    A subclass says what happens at power-up, on received bytes, and when its time comes.

    Parameters
    ----------
    clock
        Of the cell; None makes one for this device alone.
    """

    has_parity = False  # of the line: whether wrong parity can be marked

    def __init__(self, clock: CellClock | None) -> None:
        self.clock = clock or CellClock()
        self._thread: threading.Thread | None = None
        self._master = self._wake_read = self._wake_write = -1
        self._unsent = b""
        self._begun = b""  # the rest of a mark that left in part

    def start(self) -> str:
        """Power the device up behind a new pseudo-terminal.

        Returns
        -------
        Path a client opens, for example ``/dev/pts/3``.

        Raises
        ------
        RuntimeError
            If the device is running already.
        """
        if self._thread is not None:
            raise RuntimeError(f"{type(self).__name__} runs already: stop it before starting it again")
        self._master, slave = os.openpty()
        tty.setraw(self._master)
        tty.setraw(slave)  # else the terminal echoes the device's own bytes back to it
        os.set_blocking(self._master, False)
        self._wake_read, self._wake_write = os.pipe()
        self._unsent = self._begun = b""
        path = os.ttyname(slave)
        self._power_up()
        self._thread = threading.Thread(target=self._serve, args=(slave,), name=f"{type(self).__name__} {path}")
        self._thread.daemon = True
        self._thread.start()
        return path

    def unplug(self) -> None:
        """Close the pseudo-terminal as a pulled cable does: the client's next read or write fails."""
        if self._thread is None:
            return
        os.write(self._wake_write, _END)
        self._thread.join()
        self._thread = None
        os.close(self._wake_write)
        os.close(self._wake_read)

    def stop(self) -> None:
        """End the device; harmless when it has ended already."""
        self.unplug()

    def reset(self) -> None:
        """Interrupt the device's supply for a moment: it starts anew behind the same pseudo-terminal."""
        if self._thread is not None:
            os.write(self._wake_write, _RESET)

    @abstractmethod
    def _power_up(self) -> None:
        """Set the state the device has after power-up."""

    def _restart(self) -> None:
        """Set the state after the supply was interrupted."""
        self._power_up()

    @abstractmethod
    def _received(self, data: bytes) -> None:
        """Take what the client wrote, in whatever pieces it arrives."""

    @abstractmethod
    def _tick(self, now_s: float) -> float | None:
        """Do what is due and return the seconds until the next call is needed, None for not before new bytes."""

    def _send(self, data: bytes, record_bytes: int) -> int:
        """Write without blocking; when the client does not read, drop whole records and keep none.

        Parameters
        ----------
        data
            Whole records; the first may lack bytes at its start.
        record_bytes
            Length of a record: a record whose first bytes left is finished before the next one.

        Returns
        -------
        Number of records dropped.
        """
        self._finish_record()
        rest = data if self._unsent else data[self._write(data) :]
        if not rest:
            return 0
        if not self._unsent:
            self._unsent = rest[: len(rest) % record_bytes]
        return len(rest) // record_bytes

    def _finish_record(self) -> None:
        if self._unsent or self._begun:
            self._unsent = self._unsent[self._write(self._unsent) :]

    def _forget_unsent(self) -> None:
        """Give up a record that left in part."""
        self._unsent = b""

    def _write(self, data: bytes) -> int:
        """Write without blocking; return how many bytes are gone, with one whose mark left in part."""
        # The flags are read before every write: while PARMRK is on, the kernel would double what is marked here.
        form: Callable[[bytes], bytes] = marked if self.has_parity and self._client_wants_marks() else bytes
        wire = self._begun + form(data)
        try:
            wire_sent = os.write(self._master, wire)
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
        """Whether wrong parity must be marked; the kernel marks nothing any more when this returns True."""
        attributes = termios.tcgetattr(self._master)  # the client's: both ends have the same
        flags = attributes[0]
        if flags & (termios.INPCK | termios.IGNPAR) != termios.INPCK:
            return False
        if flags & termios.PARMRK:
            attributes[0] = flags & ~termios.PARMRK
            termios.tcsetattr(self._master, termios.TCSANOW, attributes)
        return True

    def _serve(self, slave: int) -> None:
        try:
            with self.clock.keeping_up():
                while self._turn():
                    pass
        finally:
            os.close(self._master)
            os.close(slave)

    def _turn(self) -> bool:
        """Do what is due, then wait for bytes and take them; False when the device has been unplugged."""
        wait_s = time_out_s(self._tick(self.clock.follow() * 1e-9))
        unfinished = [self._master] if self._unsent or self._begun else []
        readable, writable, _ = select.select([self._master, self._wake_read], unfinished, [], wait_s)
        if self._wake_read in readable:
            if os.read(self._wake_read, 1) == _END:
                return False
            self._restart()
        if self._master in writable:
            self._finish_record()
        if self._master in readable:
            self._received(os.read(self._master, 4096))
        return True
