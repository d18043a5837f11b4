"""Addresses of our servers, and a gate that refuses web pages of others by `Host` and `Origin` of a request.

A browser sends both, and a page cannot change them. Without the gate, any page that an operator opens could use a
server on this computer. Programs send no `Origin`.
"""

import asyncio
import ipaddress
import logging
import os
import random
import re
import socket
import sys
from collections.abc import Callable, Collection, Mapping
from contextlib import suppress
from http import HTTPStatus
from http.client import HTTPException, HTTPMessage, parse_headers
from io import BytesIO
from ipaddress import ip_address
from threading import Thread
from typing import Final
from urllib.parse import urlsplit

from ftdrive.errors import ConfigError

Address = tuple[str, int]

# A request may take so long.
_HEAD_S: Final = 10.0
_HEAD_BYTES: Final = 1 << 16
_PIECE: Final = 1 << 16

_HOST: Final = re.compile(r"(\[(?P<v6>[0-9a-fA-F:.]+)\]|(?P<name>[\w.-]+))(:\d{1,5})?", re.ASCII)

_log = logging.getLogger(__name__)


def refusal(headers: Mapping[str, str] | HTTPMessage, bound: str, origins: Collection[str] | None = None) -> str:
    """Return why a request is refused; empty if it is served.

    Parameters
    ----------
    headers : HTTPMessage or mapping
        Of the request.
    bound : str
        The address at which the server listens; `0.0.0.0` and `::` are all addresses of this computer.
    origins : collection of str
        Of foreign pages that `ftdrive stream` serves, such as `https://app.foxglove.dev`; None of a server that serves
        only its own pages.
    """
    host = headers.get("Host", "")
    if not _is_bound(host, bound):
        return f"the server is not {host or 'named in the request'}: use its address"
    origin = headers.get("Origin")
    if origin is None or origin in (origins or ()) or urlsplit(origin).netloc == host:
        return ""
    fix = "open the page of this server" if origins is None else f"`ftdrive stream --allow-origin {origin}` serves them"
    return f"pages of {origin} are not served; {fix}"


def _is_bound(host: str, bound: str) -> bool:
    if (found := _HOST.fullmatch(host)) is None:
        return False
    name = (found["v6"] or found["name"]).lower()
    is_local = bound in ("localhost", "0.0.0.0", "::")
    with suppress(ValueError):
        is_local |= ip_address(bound).is_loopback
    if name == bound or (is_local and name == "localhost"):
        return True
    try:
        address = ip_address(name)
    except ValueError:
        return bound in ("0.0.0.0", "::") and name in (socket.gethostname().lower(), socket.getfqdn().lower())
    return bound in ("0.0.0.0", "::") or (is_local and address.is_loopback)


def hidden_host() -> str:
    """Return an address of this computer for a server behind a gate, which no page can guess."""
    if sys.platform == "darwin":  # has only one; devices are not supported there
        return "127.0.0.1"
    return "127." + ".".join(str(random.SystemRandom().randint(1, 254)) for _ in range(3))


class Gate:
    """Listens for HTTP and WebSocket, and passes the bytes of a permitted request to another server.

    Parameters
    ----------
    bound : tuple of str and int
        Host and port; 0 lets the system choose, see `port`.
    behind : callable
        Returns the address of the server for an `Origin`; None is that of a program.
    origins : collection of str
        See `refusal`.
    token : str
        A browser must have opened `/?token=` with it once, and keeps it as a cookie; empty: none is needed.

    Raises
    ------
    OSError
        The address cannot be used.
    """

    def __init__(
        self,
        bound: Address,
        behind: Callable[[str | None], Address],
        *,
        origins: Collection[str] | None = None,
        token: str = "",
    ) -> None:
        self._host, self._behind, self._origins, self._token = bound[0], behind, origins, token
        self._clients: dict[str, str] = {}
        self._loop = asyncio.new_event_loop()
        try:
            self._server = self._loop.run_until_complete(
                asyncio.start_server(self._serve, *bound, limit=_HEAD_BYTES, reuse_address=True)
            )
        except OSError as error:
            self._loop.close()
            raise OSError(error.errno, os.strerror(error.errno) if error.errno else str(error)) from None
        self.port: int = self._server.sockets[0].getsockname()[1]
        self._thread = Thread(target=self._loop.run_forever, name="gate", daemon=True)
        self._thread.start()

    def with_clients(self, log: str) -> str:
        """Return lines of the server's log with the addresses of the clients, for which it sees those of the gate."""
        for seen, client in list(self._clients.items()):
            log = log.replace(seen, client)
        return log

    def close(self) -> None:
        """Disconnect all."""
        asyncio.run_coroutine_threadsafe(self._end(), self._loop).result()
        self._loop.call_soon_threadsafe(self._loop.stop)
        self._thread.join()
        self._loop.close()

    async def _end(self) -> None:
        self._server.close()
        others = asyncio.all_tasks() - {asyncio.current_task()}
        for task in others:
            task.cancel()
        await asyncio.gather(*others, return_exceptions=True)

    async def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        with suppress(OSError, asyncio.CancelledError):
            try:
                head, headers = await asyncio.wait_for(_head(reader), _HEAD_S)
            except (TimeoutError, asyncio.IncompleteReadError, asyncio.LimitOverrunError, HTTPException):
                await _answer(writer, HTTPStatus.BAD_REQUEST, "this is no HTTP request")
            else:
                if why := refusal(headers, self._host, self._origins):
                    _log.warning("a request was refused: %s", why)
                    await _answer(writer, HTTPStatus.FORBIDDEN, why)
                elif self._token and head.split(b" ", 2)[1] == f"/?token={self._token}".encode():
                    cookie = f"Set-Cookie: {self._cookie}; HttpOnly; SameSite=Strict; Path=/"
                    await _answer(writer, HTTPStatus.SEE_OTHER, "", "Location: /", cookie)
                elif self._token and self._cookie not in headers.get("Cookie", "").split("; "):
                    await _answer(writer, HTTPStatus.FORBIDDEN, "open the whole address that the command has printed")
                else:
                    await self._pass_on(reader, writer, head, self._behind(headers.get("Origin")))
        writer.close()

    @property
    def _cookie(self) -> str:
        # Browsers send the cookies of one port to all ports of a host.
        return f"ftdrive-{self.port}={self._token}"

    async def _pass_on(
        self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter, head: bytes, address: Address
    ) -> None:
        back_reader, back_writer = await asyncio.open_connection(*address)
        seen = _name(back_writer.get_extra_info("sockname"))
        self._clients[seen] = _name(writer.get_extra_info("peername"))
        try:
            back_writer.write(head)
            both = [
                asyncio.ensure_future(_copy(reader, back_writer)),
                asyncio.ensure_future(_copy(back_reader, writer)),
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
    """Read a request up to its body; a plain one asks the server to close, so that each request passes the gate."""
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


async def _answer(writer: asyncio.StreamWriter, status: HTTPStatus, text: str, *more: str) -> None:
    body = f"{text}\n".encode()
    head = [f"HTTP/1.1 {status} {status.phrase}", "Content-Type: text/plain; charset=utf-8", *more]
    head += [f"Content-Length: {len(body)}", "Connection: close"]
    writer.write("\r\n".join([*head, "", ""]).encode() + body)
    await writer.drain()


def _name(address: tuple[str, int]) -> str:
    return f"{address[0]}:{address[1]}"


async def _copy(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
    while piece := await reader.read(_PIECE):
        writer.write(piece)
        await writer.drain()


def host_and_port(option: str, text: str, example: str, *, lowest: int = 1) -> tuple[str, int]:
    """Read HOST:PORT, with brackets round an IPv6 address; raises `ConfigError`."""
    host, _, port = text.rpartition(":")
    if not host or not (port.isascii() and port.isdecimal()) or not lowest <= int(port) < 65536:
        raise ConfigError(f"{option} is '{text}': give HOST:PORT, such as {example}")
    return host.strip("[]"), int(port)


def is_loopback(host: str) -> bool:
    """Whether only this computer reaches an address."""
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


def with_port(host: str, port: int) -> str:
    """Write HOST:PORT, with brackets round an IPv6 address."""
    return f"[{host}]:{port}" if ":" in host else f"{host}:{port}"
