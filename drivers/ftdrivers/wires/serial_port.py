"""A serial port that raises our errors; every wait is bounded."""

import contextlib
import errno
import os
import shlex
import termios
from collections.abc import Iterator

import serial

from ftdrivers.clock import REAL, Clock
from ftdrivers.errors import ConnectError, PortInUse, StreamBroken
from ftdrivers.wires.parity import Unmarker, ask_for_marks

LINK_ERRORS = (OSError, termios.error)
"""Raised by a vanished serial port; `termios.error` is not an `OSError`."""

_WRITE_S = 0.2
_DRAIN_BYTES = 416
"""5 ms of the fastest sensor."""


def refusal(owner: str, path: str, error: Exception, found: str, fix: str) -> ConnectError:
    """Convert the error of opening a port: `PortInUse` where another program has it, else `found` and `fix`."""
    if isinstance(error, OSError) and error.errno in {errno.EAGAIN, errno.EBUSY}:
        holder = f"`fuser -v {shlex.quote(path)}` names it"
        return PortInUse(f"{owner}: the port is in use by another program", f"end it, {holder}")
    return ConnectError(f"{owner}: {found}", fix)


class SerialPort:
    """The serial port of one device.

    Parameters
    ----------
    owner : str
        Name of the device; begins every error message.
    path : str
        Such as ``/dev/serial/by-id/…``.
    baud : int
        Bit/s; always 8 data bits and 1 stop bit.
    even_parity : bool
        Else no parity. The system marks bytes of wrong parity, where it can; this class undoes the marks.
    read_s : float
        The longest that one read waits, in real time.
    clock : Clock
        Measures silences.
    """

    def __init__(
        self,
        owner: str,
        path: str,
        baud: int,
        *,
        even_parity: bool = False,
        read_s: float = 0.05,
        clock: Clock = REAL,
    ) -> None:
        self._owner = owner
        self._path = path
        self._baud = baud
        self._even_parity = even_parity
        self._read_s = min(read_s, clock.poll_s)
        self._clock = clock
        self._port: serial.Serial | None = None
        self._marks: Unmarker | None = None
        """While the system marks damaged bytes."""

    def open(self) -> None:
        """Open the port and lock it. Raises `ConnectError`."""
        # A pseudo-terminal rejects even parity on the second configuration, but can mark bytes. Everything is set here,
        # because pyserial clears the marks whenever it configures the port.
        emulated = os.path.realpath(self._path).startswith("/dev/pts/")
        try:
            self._port = serial.Serial(
                self._path,
                self._baud,
                parity=serial.PARITY_EVEN if self._even_parity and not emulated else serial.PARITY_NONE,
                timeout=self._read_s,
                write_timeout=self._clock.patience_s(_WRITE_S),
                exclusive=True,
            )
            self._marks = Unmarker() if self._even_parity and ask_for_marks(self._port) else None
        except (ValueError, *LINK_ERRORS) as exc:
            self.close()
            fix = "plug it in, end other programs that use it, and join its group"
            raise refusal(self._owner, self._path, exc, f"the port does not open ({exc})", fix) from exc
        with contextlib.suppress(ValueError, NotImplementedError, *LINK_ERRORS):
            self._port.set_low_latency_mode(True)  # some adapters can: 1 ms instead of 16 ms

    def close(self) -> None:
        """Close the port. Idempotent."""
        port, self._port = self._port, None
        if port is not None:
            with contextlib.suppress(*LINK_ERRORS):
                port.close()

    @property
    def is_open(self) -> bool:
        """Whether the port is open."""
        return self._port is not None

    def read(self, size: int) -> bytes:
        """Read `size` bytes, fewer after `read_s` or with marks among them. Raises `StreamBroken`."""
        with self._in_use() as port:
            data = port.read(size)
        return self._undo(data)[0]

    def read_all(self, at_least: int) -> bytes:
        """Read `at_least` bytes, or fewer as in `read`, and all others that have arrived. Raises `StreamBroken`."""
        return self.read_marked(at_least)[0]

    def read_marked(self, at_least: int) -> tuple[bytes, list[int]]:
        """Read like `read_all`; also return the places of bytes received with wrong parity or framing."""
        with self._in_use() as port:
            data = port.read(at_least)
            data += port.read(port.in_waiting)
        return self._undo(data)

    def drain(self, silence_s: float, at_most_s: float) -> None:
        """Drop what arrives until a silence of `silence_s`, for `at_most_s`. Raises `StreamBroken`."""
        heard_ns = self._clock.now_ns()
        for _ in self._clock.looks(at_most_s):
            if self.read(_DRAIN_BYTES):
                heard_ns = self._clock.now_ns()
            elif self._clock.now_ns() - heard_ns >= round(silence_s * 1e9):
                return

    def write(self, data: bytes, *, discard: bool = False) -> None:
        """Send bytes; `discard` drops what has arrived before. Raises `StreamBroken`."""
        with self._in_use() as port:
            if discard:
                port.reset_input_buffer()
                if self._marks is not None:
                    self._marks.forget()
            port.write(data)

    def _undo(self, data: bytes) -> tuple[bytes, list[int]]:
        return (data, []) if self._marks is None else self._marks.undo(data)

    @contextlib.contextmanager
    def _in_use(self) -> Iterator[serial.Serial]:
        """Give the open port, and raise `StreamBroken` when it is gone."""
        if self._port is None:
            raise StreamBroken(f"{self._owner}: the port is closed", "open it first")
        try:
            yield self._port
        except (TypeError, *LINK_ERRORS) as exc:  # TypeError: closed under a blocked read
            raise StreamBroken(f"{self._owner}: the port is gone ({exc})", "plug it in and open it again") from exc
