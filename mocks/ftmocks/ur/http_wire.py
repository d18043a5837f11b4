"""The part of HTTP/1.1 that a server of small JSON documents needs. It uses no sockets.

Source: RFC 9112. Not modelled: chunked bodies, ``Expect``, pipelined answers out of order.
"""

import json
from collections.abc import Mapping
from http import HTTPStatus
from typing import NamedTuple

LONGEST_HEAD = 65536


class HttpError(Exception):
    """The bytes are not a request that this server supports."""


class Request(NamedTuple):
    """A request. `is_last` is true if the client wants the connection to end after the answer."""

    method: str
    path: str
    body: bytes
    is_last: bool


def take_request(buffer: bytearray) -> Request | None:
    """Remove and return the request at the start of `buffer`; return None while it is incomplete.

    Raises
    ------
    HttpError
        The bytes are not a request.
    """
    end = buffer.find(b"\r\n\r\n")
    if end < 0:
        if len(buffer) > LONGEST_HEAD:
            raise HttpError(f"the head of a request is longer than {LONGEST_HEAD} bytes")
        return None
    first, *lines = buffer[:end].decode("latin-1").split("\r\n")
    headers = {name.strip().lower(): value.strip() for name, _, value in (line.partition(":") for line in lines)}
    match first.split(" "):
        case [method, path, "HTTP/1.0" | "HTTP/1.1" as version]:
            pass
        case _:
            raise HttpError(f"{first[:80]!r} is not a request line")
    length = headers.get("content-length", "0")
    if not length.isdecimal() or "transfer-encoding" in headers:
        raise HttpError("a body needs a Content-Length")
    size = end + 4 + int(length)
    if len(buffer) < size:
        return None
    body = bytes(buffer[end + 4 : size])
    del buffer[:size]
    wish = headers.get("connection", "keep-alive" if version == "HTTP/1.1" else "close")
    return Request(method, path, body, wish.lower() == "close")


def response(status: int, document: Mapping[str, object]) -> bytes:
    """Return the bytes of an answer with a JSON document."""
    body = json.dumps(document).encode()
    head = f"HTTP/1.1 {status} {HTTPStatus(status).phrase}\r\nContent-Type: application/json\r\n"
    return f"{head}Content-Length: {len(body)}\r\n\r\n".encode() + body
