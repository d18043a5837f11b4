"""An RTDE client in plain bytes."""

import socket
import struct

from tests.wire.waiting import LIMIT_S


class RtdeSocket:
    """The smallest RTDE client: plain bytes."""

    def __init__(self, host: str) -> None:
        self._socket = socket.create_connection((host, 30004), LIMIT_S)
        self._buffer = bytearray()

    def __enter__(self) -> "RtdeSocket":
        return self

    def __exit__(self, *_exc: object) -> None:
        self._socket.close()

    def send(self, hexadecimal: str) -> None:
        self._socket.sendall(bytes.fromhex(hexadecimal))

    def send_package(self, kind: str, payload: bytes = b"") -> None:
        self._socket.sendall(struct.pack(">HB", 3 + len(payload), ord(kind)) + payload)

    def answer(self) -> bytes:
        """The next whole package, header included."""
        while len(self._buffer) < 3 or len(self._buffer) < struct.unpack_from(">H", self._buffer)[0]:
            data = self._socket.recv(4096)
            if not data:
                raise ConnectionError("the server hung up")
            self._buffer += data
        (size,) = struct.unpack_from(">H", self._buffer)
        package = bytes(self._buffer[:size])
        del self._buffer[:size]
        return package

    def ask(self, kind: str, payload: bytes = b"") -> bytes:
        """Payload of the answer of the same kind; samples on the way are skipped."""
        self.send_package(kind, payload)
        while True:
            package = self.answer()
            if package[2:3] == kind.encode():
                return package[3:]
