"""Ports of this computer where a driver is recorded, or played to: what relays and player have in common."""

import threading
from socketserver import BaseRequestHandler, ThreadingTCPServer
from typing import Final, Self

LOOPBACK: Final = "127.0.0.1"
LOOK_S: Final = 0.05
"""How often is looked whether it has ended."""
HTTP_S: Final = 2.0
AT_ONCE: Final = 64
"""Datagrams for pynetft in a row, where they are late: its socket has room for about 250."""


class PageServer(ThreadingTCPServer):
    """Answers over HTTP at a free port while it is entered, one question a connection."""

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
        self.server_close()  # waits for exchanges under way
