"""Addresses of the servers, and a gate that refuses foreign web pages by the `Host` and `Origin` of a request.

Browsers send both headers, and a page cannot change them. Without the gate, any page that an operator opens could use a
server on this computer. Programs send no `Origin`.
"""

import asyncio
import logging
import os
import random
import re
import socket
import sys
from collections.abc import Callable, Collection, Mapping
from contextlib import suppress
from dataclasses import dataclass
from http import HTTPStatus
from http.client import HTTPException, HTTPMessage, parse_headers
from io import BytesIO
from ipaddress import ip_address
from threading import Thread
from typing import Final
from urllib.parse import urlsplit

from ftdrive.errors import ConfigError

Address = tuple[str, int]

# Time-out for the head of an HTTP request, s.
_HEAD_S: Final = 10.0
_HEAD_BYTES: Final = 1 << 14
_PIECE: Final = 1 << 16
# Largest number of connections without a complete head; a further connection closes the oldest, to save descriptors.
_WAITING: Final = 500
# Number of refused requests that are logged; more would fill the terminal of a session.
_LOGGED: Final = 5

_HOST: Final = re.compile(r"(\[(?P<v6>[0-9a-fA-F:.]+)\]|(?P<name>[\w.-]+))(:\d{1,5})?", re.ASCII)

_log = logging.getLogger(__name__)


def refusal_reason(headers: Mapping[str, str] | HTTPMessage, bound: str, origins: Collection[str] | None = None) -> str:
    """Return the reason to refuse a request; empty if it is accepted.

    Parameters
    ----------
    headers : HTTPMessage or mapping
        Headers of the request.
    bound : str
        Address of the server; `0.0.0.0` and `::` mean all addresses of this computer.
    origins : collection of str
        Origins of accepted foreign pages, such as `https://app.foxglove.dev`; None for a server that accepts only its
        own pages.
    """
    host = headers.get("Host", "")
    if not _is_bound(host, bound):
        return f"the server has a different address from {host or 'the empty one in the request'}: use its address"
    origin = headers.get("Origin")
    if origin is None or origin in (origins or ()):
        return ""
    with suppress(ValueError):  # not an address
        if urlsplit(origin).netloc == host:
            return ""
    fix = "open the page of this server" if origins is None else f"`ftdrive stream --allow-origin {origin}` serves them"
    return f"pages of {origin} are not served; {fix}"


def _is_bound(host: str, bound: str) -> bool:
    if (found := _HOST.fullmatch(host)) is None:
        return False
    name = (found["v6"] or found["name"]).lower()
    is_local = bound in ("0.0.0.0", "::") or is_loopback(bound)
    if name == bound or (is_local and name == "localhost"):
        return True
    try:
        address = ip_address(name)
    except ValueError:
        return bound in ("0.0.0.0", "::") and name in (socket.gethostname().lower(), socket.getfqdn().lower())
    return bound in ("0.0.0.0", "::") or (is_local and address.is_loopback)


def hidden_host() -> str:
    """Return an address of this computer that a web page cannot guess, for a server behind a gate."""
    if sys.platform == "darwin":  # has only one loopback address
        return "127.0.0.1"
    return "127." + ".".join(str(random.SystemRandom().randint(1, 254)) for _ in range(3))


@dataclass(frozen=True, slots=True)
class Request:
    """A permitted request: its head, and the connection."""

    method: str
    target: str
    headers: HTTPMessage
    head: bytes
    reader: asyncio.StreamReader
    writer: asyncio.StreamWriter

    async def answer(
        self, status: HTTPStatus, body: bytes = b"", content: str = "text/plain; charset=utf-8", *more: str
    ) -> None:
        """Send a complete HTTP answer; `more` are additional header lines."""
        head = [f"HTTP/1.1 {status} {status.phrase}", f"Content-Type: {content}", *more]
        head += [f"Content-Length: {len(body)}", "X-Content-Type-Options: nosniff", "Connection: close"]
        self.writer.write("\r\n".join([*head, "", ""]).encode() + (b"" if self.method == "HEAD" else body))
        await self.writer.drain()

    async def refuse(self, status: HTTPStatus, why: str) -> None:
        """Answer the request with an HTTP error status and one sentence."""
        await self.answer(status, f"{why}\n".encode())


class Gate:
    """Listens for HTTP, refuses foreign requests, and calls `serve` for each permitted one.

    Port 0 lets the system choose, see `port`; `origins` is as in `refusal_reason`. Raises `OSError` for an address that
    cannot be used.
    """

    def __init__(self, bound: Address, origins: Collection[str] | None = None) -> None:
        self._host, self._origins = bound[0], origins
        self._waiting: dict[asyncio.StreamWriter, None] = {}
        self._refused = 0
        self.loop = asyncio.new_event_loop()
        try:
            self._server = self.loop.run_until_complete(
                asyncio.start_server(self._connected, *bound, limit=_HEAD_BYTES, backlog=_WAITING, reuse_address=True)
            )
        except OSError as error:
            self.loop.close()
            raise OSError(error.errno, os.strerror(error.errno) if error.errno else str(error)) from None
        self.port: int = self._server.sockets[0].getsockname()[1]
        self._thread = Thread(target=self.loop.run_forever, name="gate", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Disconnect all clients."""
        asyncio.run_coroutine_threadsafe(self._end(), self.loop).result()
        self.loop.call_soon_threadsafe(self.loop.stop)
        self._thread.join()
        self.loop.close()

    async def _end(self) -> None:
        self._server.close()
        others = asyncio.all_tasks() - {asyncio.current_task()}
        for task in others:
            task.cancel()
        await asyncio.gather(*others, return_exceptions=True)

    async def _connected(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self._waiting[writer] = None
        if len(self._waiting) > _WAITING:
            oldest = next(iter(self._waiting))
            del self._waiting[oldest]
            oldest.transport.abort()
        with suppress(OSError, asyncio.CancelledError):
            try:
                head, headers = await asyncio.wait_for(_head(reader), _HEAD_S)
                method, target, _ = head.partition(b"\r\n")[0].decode("ascii").split(" ")
            except (TimeoutError, ValueError, EOFError, asyncio.LimitOverrunError, HTTPException):
                nothing = Request("", "", HTTPMessage(), b"", reader, writer)
                await nothing.refuse(HTTPStatus.BAD_REQUEST, "this is not an HTTP request")
            else:
                self._waiting.pop(writer, None)
                request = Request(method, target, headers, head, reader, writer)
                if why := refusal_reason(headers, self._host, self._origins):
                    self._refused += 1
                    if self._refused <= _LOGGED:
                        last = "; further ones are not logged" if self._refused == _LOGGED else ""
                        _log.warning("a request was refused: %s%s", why, last)
                    await request.refuse(HTTPStatus.FORBIDDEN, why)
                else:
                    await self.serve(request)
        self._waiting.pop(writer, None)
        writer.close()

    async def serve(self, request: Request) -> None:
        """Answer a permitted request; the connection is closed afterwards."""
        raise NotImplementedError


class PassingGate(Gate):
    """Passes the bytes of permitted requests, including WebSockets, to another server.

    Parameters
    ----------
    bound, origins
        As for `Gate`.
    behind : callable
        Returns the address of the server for an `Origin`, which is None for a program.
    """

    def __init__(
        self, bound: Address, behind: Callable[[str | None], Address], origins: Collection[str] | None = None
    ) -> None:
        self._behind = behind
        self._clients: dict[str, str] = {}
        super().__init__(bound, origins)

    def with_clients(self, log: str) -> str:
        """Return a log of the server with the addresses of the clients in place of those of the gate."""
        for seen, client in list(self._clients.items()):
            log = log.replace(seen, client)
        return log

    async def serve(self, request: Request) -> None:
        """Copy both directions until one of them ends."""
        back_reader, back_writer = await asyncio.open_connection(*self._behind(request.headers.get("Origin")))
        seen = _name(back_writer.get_extra_info("sockname"))
        self._clients[seen] = _name(request.writer.get_extra_info("peername"))
        try:
            back_writer.write(request.head)
            both = [
                asyncio.ensure_future(_copy(request.reader, back_writer)),
                asyncio.ensure_future(_copy(back_reader, request.writer)),
            ]
            try:
                await asyncio.wait(both, return_when=asyncio.FIRST_COMPLETED)
            finally:
                for one in both:
                    one.cancel()
                await asyncio.gather(*both, return_exceptions=True)
        finally:
            del self._clients[seen]
            back_writer.close()


async def _head(reader: asyncio.StreamReader) -> tuple[bytes, HTTPMessage]:
    """Read the head of a request; add "Connection: close" to plain ones, so that each request passes the gate."""
    head = await reader.readuntil(b"\r\n\r\n")
    request, _, rest = head.partition(b"\r\n")
    headers = parse_headers(BytesIO(rest))
    if any(len(headers.get_all(name, [])) > 1 for name in ("Host", "Origin")):
        raise HTTPException
    if headers.get("Upgrade") is None:
        del headers["Connection"]
        headers["Connection"] = "close"
        lines = [f"{name}: {value}" for name, value in headers.items()]
        head = request + b"\r\n" + "\r\n".join([*lines, "", ""]).encode("latin-1")
    return head, headers


def _name(address: tuple[str, int]) -> str:
    return f"{address[0]}:{address[1]}"


async def _copy(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
    while piece := await reader.read(_PIECE):
        writer.write(piece)
        await writer.drain()


def host_and_port(option: str, text: str, example: str, *, lowest: int = 1) -> tuple[str, int]:
    """Parse HOST:PORT, with brackets around an IPv6 address. Raises `ConfigError` for any other text."""
    host, _, port = text.rpartition(":")
    if not host or not (port.isascii() and port.isdecimal()) or not lowest <= int(port) < 65536:
        raise ConfigError(f"{option} is '{text}': give HOST:PORT, such as {example}")
    return host.strip("[]"), int(port)


def is_loopback(host: str) -> bool:
    """Whether an address can only be reached from this computer."""
    try:
        return ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


def with_port(host: str, port: int) -> str:
    """Return HOST:PORT, with brackets around an IPv6 address."""
    return f"[{host}]:{port}" if ":" in host else f"{host}:{port}"
