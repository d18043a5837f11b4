"""A serial port, and the marks with which the kernel reports parity errors.

Ref: POSIX.1-2024, Base Definitions, 11.2.2 Input Modes. With INPCK and PARMRK set and IGNPAR clear, a byte X received
with wrong parity or framing is delivered as FF 00 X, and a valid FF as FF FF. pyserial clears both flags whenever it
configures a port, so damaged bytes are then delivered unmarked.
"""

import contextlib
import errno
import os
import re
import shlex
import sys
import termios
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Final

import serial

from ftdrivers.clock import REAL, Clock
from ftdrivers.errors import ConnectError, PortInUse, StreamBroken


def ask_for_marks(port: serial.Serial | int) -> bool:
    """Let the kernel mark damaged bytes; return whether it can. Bytes received before have no marks and are dropped."""
    # Some adapters (FTDI) report parity errors per USB packet; then all records of the packet are dropped.
    if sys.platform != "linux":  # on other systems, setting flags may reset the non-standard bit rates of pyserial
        return False
    settings = termios.tcgetattr(port)
    # with BRKINT, a break, which is a framing error, would clear the input silently
    settings[0] = settings[0] & ~(termios.IGNPAR | termios.BRKINT) | termios.INPCK | termios.PARMRK
    termios.tcsetattr(port, termios.TCSANOW, settings)
    termios.tcflush(port, termios.TCIFLUSH)
    return True


def marks_asked_for(port: serial.Serial | int) -> bool:
    """Return whether the reader of this terminal expects marks. It works at both ends of a pseudo-terminal."""
    # PARMRK is not checked, because an emulator that writes the marks itself has cleared it
    return sys.platform == "linux" and bool(termios.tcgetattr(port)[0] & termios.INPCK)


def leave_marks_to_far_side(port: serial.Serial | int) -> None:
    """Let the kernel pass bytes unchanged, because the emulator at the other end writes the marks itself."""
    if sys.platform == "linux":
        settings = termios.tcgetattr(port)
        settings[0] &= ~termios.PARMRK
        termios.tcsetattr(port, termios.TCSANOW, settings)


_PLAIN: Final = re.compile(rb"(?:[^\xff]+|\xff\xff)+")
# Mark FF 00 X of a damaged byte X, or an FF whose second FF was lost: treated as a damaged byte.
_MARKED: Final = re.compile(rb"\xff(?:\0.|(?=[^\0]))", re.DOTALL)


class Unmarker:
    """Restores the bytes on the line from marked bytes; a mark may be split between two reads."""

    def __init__(self) -> None:
        # Beginning of a mark, or of a doubled FF, whose remaining bytes have not arrived.
        self._cut = b""

    def undo(self, data: bytes) -> tuple[bytes, list[int]]:
        """Return the bytes on the line, and the indices of those received with wrong parity or framing."""
        data = self._cut + data
        true, damaged, at = bytearray(), list[int](), 0
        while at < len(data):
            if plain := _PLAIN.match(data, at):
                true += plain[0].replace(b"\xff\xff", b"\xff")
                at = plain.end()
            elif marked := _MARKED.match(data, at):
                damaged.append(len(true))
                true.append(marked[0][-1])
                at = marked.end()
            else:
                break
        self._cut = data[at:]
        return bytes(true), damaged

    def forget(self) -> None:
        """Forget the beginning of a mark, because the following bytes were dropped."""
        self._cut = b""


LINK_ERRORS = (OSError, termios.error)
"""Exceptions that a vanished serial port raises; `termios.error` is not an `OSError`."""

_WRITE_S = 0.2
# Bytes that one read of `drain` requests: as many as the fastest sensor sends in 5 ms.
_DRAIN_BYTES = 416


def refusal(owner: str, path: str, error: Exception, found: str, fix: str) -> ConnectError:
    """Return `PortInUse` if the port did not open because another program uses it, else a `ConnectError`."""
    if isinstance(error, OSError) and error.errno in {errno.EAGAIN, errno.EBUSY}:
        holder = f"`fuser -v {shlex.quote(path)}` names it"
        return PortInUse(f"{owner}: the port is in use by another program", f"end it, {holder}")
    return ConnectError(f"{owner}: {found}", fix)


def other_baud(default: int) -> str:
    """Return what to do if bytes arrive but no frames; `default` is the factory setting of the baud rate."""
    return (
        f"set baud=… in its address to the baud rate of the sensor ({default} by default), and check that no other "
        "device is on this port"
    )


class SerialPort:
    """The serial port of one device.

    Parameters
    ----------
    owner : str
        Name of the device, with which every error message begins.
    path : str
        Path of the port, such as ``/dev/serial/by-id/…``.
    baud : int
        Baud rate. There are always 8 data bits and 1 stop bit.
    even_parity : bool
        True for even parity, false for none. The kernel's marks for bytes with wrong parity are removed here.
    read_s : float
        Time-out of one read, s of real time.
    clock : Clock
        Clock with which silences are measured.
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
        # Decoder of the marks for damaged bytes; None while the kernel makes no marks.
        self._marks: Unmarker | None = None

    def open(self) -> None:
        """Open the port and lock it. Raises `ConnectError` if the port is missing, in use or not permitted."""
        # A pseudo-terminal rejects even parity when it is configured again, but can mark bytes. All settings are made
        # here, because pyserial switches the marks off whenever it configures the port.
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
            fix = "plug it in, end other programs that use it, and add this user to the group of the port"
            raise refusal(self._owner, self._path, exc, f"the port cannot be opened ({exc})", fix) from exc
        with contextlib.suppress(ValueError, NotImplementedError, *LINK_ERRORS):
            self._port.set_low_latency_mode(True)  # the latency of some USB adapters becomes 1 ms instead of 16 ms

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
        """Read `size` bytes; fewer after `read_s` or with parity marks. Raises `StreamBroken` if the port is lost."""
        with self._in_use() as port:
            data = port.read(size)
        return self._undo(data)[0]

    def read_all(self, at_least: int) -> bytes:
        """Read `at_least` bytes (as `read`), then all that have arrived. Raises `StreamBroken` if the port is lost."""
        return self.read_marked(at_least)[0]

    def read_marked(self, at_least: int) -> tuple[bytes, list[int]]:
        """Read like `read_all`; also return the indices of bytes received with wrong parity or framing."""
        with self._in_use() as port:
            data = port.read(at_least)
            data += port.read(port.in_waiting)
        return self._undo(data)

    def drain(self, silence_s: float, at_most_s: float) -> None:
        """Drop bytes until none arrives for `silence_s`, at most for `at_most_s`. A lost port raises `StreamBroken`."""
        heard_ns = self._clock.now_ns()
        for _ in self._clock.looks(at_most_s):
            if self.read(_DRAIN_BYTES):
                heard_ns = self._clock.now_ns()
            elif self._clock.now_ns() - heard_ns >= round(silence_s * 1e9):
                return

    def write(self, data: bytes, *, discard: bool = False) -> None:
        """Send bytes; with `discard`, first drop all received bytes. Raises `StreamBroken` if the port is lost."""
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
        """Yield the open port; raise `StreamBroken` if it is closed or has vanished."""
        if self._port is None:
            raise StreamBroken(f"{self._owner}: the port is closed", "open it first")
        try:
            yield self._port
        except (TypeError, *LINK_ERRORS) as exc:  # TypeError: the port was closed during a read
            raise StreamBroken(f"{self._owner}: the port was lost ({exc})", "plug it in and open it again") from exc


@dataclass(frozen=True, slots=True)
class SerialProbe:
    """How a probe recognizes one kind of sensor on a serial port with one setting of the port."""

    url: str
    """Address of the sensor, with ``{port}`` for the port."""
    baud: int
    streams: Callable[[bytes], bool]
    """Returns whether received bytes are a stream of this sensor."""
    request: bytes = b""
    """A read request; empty if the sensor is recognized by listening only."""
    identify: Callable[[bytes], str] | None = None
    """Returns model and serial number from the reply to the request. Raises `ProtocolError` for an invalid reply."""
    even_parity: bool = False
    boot_url: Callable[[bytes], str | None] | None = None
    """Returns the address, with ``{port}``, if the received bytes are the boot text of this sensor, else None."""
