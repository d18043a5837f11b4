"""Ports of this computer that replace a device; shared by relays and player."""

import threading
from socketserver import BaseRequestHandler, ThreadingTCPServer
from typing import Final, Self

LOOPBACK: Final = "127.0.0.1"
LOOK_S: Final = 0.05
"""Period of the check for the end."""
HTTP_S: Final = 2.0
AT_ONCE: Final = 64
"""The most late datagrams sent to pynetft at once: its socket holds about 250."""


class PageServer(ThreadingTCPServer):
    """Serves HTTP at a free port while it is entered, one request a connection."""

    def __init__(self, name: str, handler: type[BaseRequestHandler]) -> None:
        super().__init__((LOOPBACK, 0), handler)
        self.port: int = self.server_address[1]
        self.ended = threading.Event()
        self._thread = threading.Thread(target=self.serve_forever, args=(LOOK_S,), name=name)

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.ended.set()
        self.shutdown()
        self._thread.join()
        self.server_close()  # waits for exchanges in progress
