"""A serial port, and the parity marks of the kernel.

Ref: POSIX.1-2024, Base Definitions, 11.2.2 Input Modes. With INPCK and PARMRK set and IGNPAR clear, a byte X received
with wrong parity or framing arrives as FF 00 X, and a valid FF as FF FF. pyserial clears both flags whenever it
configures a port, so the system then delivers damaged bytes unmarked.
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
    """Let the system mark damaged bytes; return whether it can. Drops earlier bytes, which have no marks."""
    # Some adapters (FTDI) report parity for a whole USB packet, and all its records are dropped.
    if sys.platform != "linux":  # setting flags may undo pyserial's unusual bit rates there
        return False
    settings = termios.tcgetattr(port)
    # with BRKINT a break, which is a framing error, would empty the input silently
    settings[0] = settings[0] & ~(termios.IGNPAR | termios.BRKINT) | termios.INPCK | termios.PARMRK
    termios.tcsetattr(port, termios.TCSANOW, settings)
    termios.tcflush(port, termios.TCIFLUSH)
    return True


def marks_asked_for(port: serial.Serial | int) -> bool:
    """Return whether the reader of this terminal undoes marks; works on both sides of a pseudo-terminal."""
    # INPCK alone: a far side that makes the marks itself has cleared PARMRK
    return sys.platform == "linux" and bool(termios.tcgetattr(port)[0] & termios.INPCK)


def leave_marks_to_far_side(port: serial.Serial | int) -> None:
    """Let the system pass bytes unchanged, because the far side makes the marks itself."""
    # A pseudo-terminal rejects parity, but an emulator or a transcript can make the marks itself.
    if sys.platform == "linux":
        settings = termios.tcgetattr(port)
        settings[0] &= ~termios.PARMRK
        termios.tcsetattr(port, termios.TCSANOW, settings)


_PLAIN: Final = re.compile(rb"(?:[^\xff]+|\xff\xff)+")
# FF 00 X, or an FF whose second FF is lost, which counts as damaged.
_MARKED: Final = re.compile(rb"\xff(?:\0.|(?=[^\0]))", re.DOTALL)


class Unmarker:
    """Restores the bytes on the line from marked bytes, however reads divide them."""

    def __init__(self) -> None:
        # The beginning of a mark or of a doubled FF whose rest has not arrived.
        self._cut = b""

    def undo(self, data: bytes) -> tuple[bytes, list[int]]:
        """Return the true bytes, and the places of those received with wrong parity or framing."""
        # pyserial delivers bytes of wrong parity unmarked, so Linux marks them as POSIX defines, and the marks are
        # removed here.
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
        """Restart, because the rest of a cut mark was dropped."""
        self._cut = b""


LINK_ERRORS = (OSError, termios.error)
"""Raised by a vanished serial port; `termios.error` is not an `OSError`."""

_WRITE_S = 0.2
# 5 ms of the fastest sensor.
_DRAIN_BYTES = 416


def refusal(owner: str, path: str, error: Exception, found: str, fix: str) -> ConnectError:
    """Convert the error of opening a port: `PortInUse` where another program has it, else `found` and `fix`."""
    if isinstance(error, OSError) and error.errno in {errno.EAGAIN, errno.EBUSY}:
        holder = f"`fuser -v {shlex.quote(path)}` names it"
        return PortInUse(f"{owner}: the port is in use by another program", f"end it, {holder}")
    return ConnectError(f"{owner}: {found}", fix)


def other_baud(default: int) -> str:
    """Return the fix for bytes without frames; `default` is the baud rate of a new sensor."""
    return (
        f"set baud=… in its address to the baud rate of the sensor ({default} by default), and check that no other "
        "device is on this port"
    )


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
        # While the system marks damaged bytes.
        self._marks: Unmarker | None = None

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


@dataclass(frozen=True, slots=True)
class SerialProbe:
    """How to recognize one kind of sensor on a serial port with one setting."""

    url: str
    """Address of the sensor, with ``{port}`` for the port."""
    baud: int
    streams: Callable[[bytes], bool]
    """Returns whether received bytes are the stream of this sensor."""
    request: bytes = b""
    """A read request; empty if the sensor is recognized by listening only."""
    identify: Callable[[bytes], str] | None = None
    """Returns what the reply reports about the sensor. Raises `ProtocolError`."""
    even_parity: bool = False
    boot_url: Callable[[bytes], str | None] | None = None
    """Returns the address, with ``{port}``, if received bytes are printed by this sensor while it boots."""
