"""A client of port 30001 or 30002 in plain bytes."""

import contextlib
import socket
import time
from collections.abc import Callable
from typing import Any

from tests.unit.mocks.ur.primary_decoder import decoded, packages
from tests.wire.waiting import LIMIT_S

Message = dict[str, Any]


class PrimarySocket:
    """Reads packages, writes programs."""

    def __init__(self, host: str, port: int = 30001) -> None:
        self._socket = socket.create_connection((host, port), LIMIT_S)
        self._rest = b""
        self.received: list[Message] = []
        """Every package so far, decoded."""
        self._at = 0

    def __enter__(self) -> "PrimarySocket":
        return self

    def __exit__(self, *_exc: object) -> None:
        self._socket.close()

    def send(self, text: str) -> None:
        self._socket.sendall(text.encode())

    def wait_for(self, condition: Callable[[Message], bool]) -> Message:
        """The first package behind the one waited for last that meets a condition."""
        deadline_s = time.monotonic() + LIMIT_S
        while True:
            while self._at < len(self.received):
                self._at += 1
                if condition(message := self.received[self._at - 1]):
                    return message
            assert time.monotonic() < deadline_s, self.received[-20:]
            self._receive()

    def next(self, kind: str) -> Message:
        return self.wait_for(lambda message: message["type"] == kind)

    def end(self) -> None:
        """Read up to the end of the connection."""
        with contextlib.suppress(ConnectionError):
            while True:
                self._receive()

    def _receive(self) -> None:
        data = self._socket.recv(65536)
        if not data:
            raise ConnectionError("the server closed the connection")
        found, self._rest = packages(self._rest + data)
        self.received += map(decoded, found)
