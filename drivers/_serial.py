"""A serial port that fails in our words: opened once, 8N1, every wait bounded."""

import contextlib

import serial

from drivers._stream import LINK_ERRORS
from drivers.errors import ConnectError, StreamBroken

_READ_S = 0.05
_WRITE_S = 0.2


class SerialPort:
    """The serial port of one device.

    Parameters
    ----------
    owner : str
        The device as the user knows it; begins every error message.
    path : str
        Such as ``/dev/serial/by-id/…``.
    baud : int
        Bit/s; always 8 data bits, no parity, one stop bit.
    """

    def __init__(self, owner: str, path: str, baud: int) -> None:
        self._owner = owner
        self._path = path
        self._baud = baud
        self._port: serial.Serial | None = None

    def open(self) -> None:
        """Take the port for this process alone. Raises `ConnectError`."""
        try:
            self._port = serial.Serial(self._path, self._baud, timeout=_READ_S, write_timeout=_WRITE_S, exclusive=True)
        except (ValueError, *LINK_ERRORS) as exc:
            raise ConnectError(
                f"{self._owner}: the port does not open ({exc}); is it plugged in, free, and are you in its group?"
            ) from exc
        with contextlib.suppress(ValueError, NotImplementedError, *LINK_ERRORS):
            self._port.set_low_latency_mode(True)  # a courtesy of some adapters: 1 ms instead of 16 ms

    def close(self) -> None:
        """Free the port. Idempotent."""
        port, self._port = self._port, None
        if port is not None:
            with contextlib.suppress(*LINK_ERRORS):
                port.close()

    @property
    def is_open(self) -> bool:
        """Whether the port is ours at this moment."""
        return self._port is not None

    def read(self, size: int) -> bytes:
        """Read `size` bytes, or fewer after 0.05 s. Raises `StreamBroken`."""
        port = self._open_or_broken()
        try:
            return port.read(size)
        except (TypeError, *LINK_ERRORS) as exc:  # TypeError: closed under a blocked read
            raise self._broken(exc) from exc

    def read_all(self, at_least: int) -> bytes:
        """Read `at_least` bytes, or fewer after 0.05 s, and whatever else has arrived. Raises `StreamBroken`."""
        port = self._open_or_broken()
        try:
            data = port.read(at_least)
            return data + port.read(port.in_waiting)
        except (TypeError, *LINK_ERRORS) as exc:
            raise self._broken(exc) from exc

    def write(self, data: bytes) -> None:
        """Send bytes. Raises `StreamBroken`."""
        port = self._open_or_broken()
        try:
            port.write(data)
        except (TypeError, *LINK_ERRORS) as exc:
            raise self._broken(exc) from exc

    def _open_or_broken(self) -> serial.Serial:
        if self._port is None:
            raise StreamBroken(f"{self._owner}: closed")
        return self._port

    def _broken(self, exc: Exception) -> StreamBroken:
        return StreamBroken(f"{self._owner}: the port is gone ({exc}); plug it in and open it again")
