"""The HTTP side of a page: address, access, files, the stream of parts, and requests from controls."""

import asyncio
import hmac
import json
import logging
import os
import re
import secrets
import socket
import sys
import webbrowser
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import cache
from html import escape
from http import HTTPStatus
from importlib.util import find_spec
from pathlib import Path
from tempfile import TemporaryDirectory
from time import monotonic
from typing import Final

from ftdrive.errors import ConfigError
from ftdrive.servers.http_gate import Address, Gate, Request, is_loopback, with_port
from ftdrive.view.page import Page
from ftdrivers.installation import missing_extra

# Default address, at which only this computer can open the page.
_LOCAL: Final[Address] = ("127.0.0.1", 8080)
# Period of updates, slightly shorter than 1/20 s, so that a busy computer still sends 20 per second.
_PERIOD_S: Final = 0.045
# Period of the heartbeats, s. A browser that receives none for a few periods shows the page as stale.
_BEAT_S: Final = 1.0
# A browser that does not read, so that its send buffer stays filled, gets no data and is disconnected after this, s.
_SUSPENDED_S: Final = 30.0
_VIEWERS: Final = 300
# Largest body of a request, bytes, and the time-out for receiving it, s.
_BODY_BYTES: Final = 1 << 15
_BODY_S: Final = 5.0
# Headers with a security policy: nothing from other sites, no inline scripts (but styles, for uPlot), no embedding.
_SAFE: Final = (
    "Content-Security-Policy: default-src 'none'; script-src 'self'; style-src 'self' 'unsafe-inline'; "
    "connect-src 'self'; img-src data:; base-uri 'none'; form-action 'none'; frame-ancestors 'none'",
    "Referrer-Policy: no-referrer",
    "Cache-Control: no-store",
    "Cross-Origin-Resource-Policy: same-origin",
)
_TYPES: Final = {".html": "text/html", ".css": "text/css", ".js": "text/javascript"}
_OPENED: Final = b'<!doctype html><meta http-equiv="refresh" content="0;url=/"><title>ftdrive</title>'

_log = logging.getLogger(__name__)


class Site(Gate):
    """Serves a page to browsers that have opened its address with the token, which they then keep as a cookie.

    With port 0, the system chooses a port, see `port`. Raises `ConfigError` if the extra `viz` is not installed, and
    `OSError` if the address cannot be used.
    """

    def __init__(self, page: Page, bound: Address) -> None:
        _files()  # raise for a missing package before the port is opened
        self.token = secrets.token_urlsafe(18)
        self._page = page
        # for each viewer's connection, the page version that was sent, and when its send buffer was last empty
        self._viewers: dict[asyncio.StreamWriter, tuple[int, float]] = {}
        self._opened = 0
        super().__init__(bound)
        asyncio.run_coroutine_threadsafe(self._send_all(), self.loop)

    async def serve(self, request: Request) -> None:
        """Answer an HTTP request; requests without the token or from other pages are refused."""
        path, _, query = request.target.partition("?")
        number = self._viewer_of(request.headers.get("Cookie", ""))
        if path == "/" and request.method == "GET" and query.startswith("token="):
            await self._open(request, query.removeprefix("token="), number)
        elif number is None:
            await request.refuse(HTTPStatus.FORBIDDEN, "open the complete address that the command printed")
        elif request.headers.get("Sec-Fetch-Site", "none") not in ("none", "same-origin"):
            await request.refuse(HTTPStatus.FORBIDDEN, "requests of other pages are not accepted")
        elif request.method == "POST" and path == "/do":
            await self._act(request, f"viewer {number}")
        elif request.method != "GET":
            await request.refuse(HTTPStatus.METHOD_NOT_ALLOWED, "this address accepts only GET")
        elif path == "/parts":
            await self._follow(request, number)
        elif (file := _files().get(path)) is not None:
            await request.answer(HTTPStatus.OK, file.read_bytes(), f"{_TYPES[file.suffix]}; charset=utf-8", *_SAFE)
        else:
            await request.refuse(HTTPStatus.NOT_FOUND, "this page does not exist")

    def end(self) -> None:
        """Send browsers the last state of the page, which they keep showing, and that the program has ended."""
        with suppress(TimeoutError):
            asyncio.run_coroutine_threadsafe(self._end_viewers(), self.loop).result(1.0)

    async def _open(self, request: Request, token: str, number: int | None) -> None:
        if not hmac.compare_digest(token.encode(), self.token.encode()):
            await request.refuse(HTTPStatus.FORBIDDEN, "open the complete address that the command printed")
            return
        if number is None:
            number, self._opened = self._opened, self._opened + 1
        # Browsers send the cookies of one port to all ports of a host, so the cookie's name contains the port. The page
        # reloads itself, because browsers send no strict cookie after a redirect from another page.
        cookie = f"Set-Cookie: ftdrive-{self.port}={self.token}.{number}; HttpOnly; SameSite=Strict; Path=/"
        await request.answer(HTTPStatus.OK, _OPENED, "text/html; charset=utf-8", cookie, *_SAFE)

    def _viewer_of(self, cookies: str) -> int | None:
        for cookie in cookies.split("; "):
            name, _, value = cookie.partition("=")
            token, _, number = value.rpartition(".")
            if name == f"ftdrive-{self.port}" and hmac.compare_digest(token.encode(), self.token.encode()):
                return int(number) if number.isascii() and number.isdecimal() and int(number) < self._opened else None
        return None

    async def _act(self, request: Request, viewer: str) -> None:
        """Pass a viewer's use of a control to the page; only JSON, which other sites cannot send without permission."""
        headers = request.headers
        length = headers.get("Content-Length", "")
        if headers.get("Origin") is None or headers.get("Content-Type") != "application/json":
            await request.refuse(HTTPStatus.FORBIDDEN, "controls are used from the page itself")
        elif not re.fullmatch("[0-9]{1,6}", length) or int(length) > _BODY_BYTES or headers.get("Transfer-Encoding"):
            await request.refuse(HTTPStatus.REQUEST_ENTITY_TOO_LARGE, f"{_BODY_BYTES} bytes at most")
        else:
            with suppress(TimeoutError, asyncio.IncompleteReadError):
                body = await asyncio.wait_for(request.reader.readexactly(int(length)), _BODY_S)
                try:
                    asked = json.loads(body)
                    self._page.act(viewer, asked["name"], asked["value"])
                except (ValueError, TypeError, KeyError, RecursionError) as error:
                    why = str(error) if type(error) is ValueError else "a request is an object with a name and a value"
                    await request.refuse(HTTPStatus.BAD_REQUEST, why[:300])
                except Exception:
                    _log.exception("a control of the page has failed")
                    await request.refuse(HTTPStatus.INTERNAL_SERVER_ERROR, "this control has failed: see the terminal")
                else:
                    await request.answer(HTTPStatus.NO_CONTENT)

    async def _follow(self, request: Request, number: int) -> None:
        """Register a browser for server-sent events until it disconnects; bytes that it sends are ignored."""
        if len(self._viewers) >= _VIEWERS:
            await request.refuse(HTTPStatus.SERVICE_UNAVAILABLE, f"{_VIEWERS} viewers at most")
            return
        head = ["HTTP/1.1 200 OK", "Content-Type: text/event-stream", *_SAFE, "Connection: close"]
        hello = f"retry: 500\n\ndata: {json.dumps({'viewer': {'kind': 'viewer', 'number': number}})}\n\n"
        request.writer.write("\r\n".join([*head, "", hello]).encode())
        self._viewers[request.writer] = 0, monotonic()
        self._page.viewers = len(self._viewers)
        try:
            while await request.reader.read(1024):
                await asyncio.sleep(_PERIOD_S)
        finally:
            self._viewers.pop(request.writer, None)
            self._page.viewers = len(self._viewers)

    async def _send_all(self) -> None:
        """Send each viewer the changes since its version, forever; one that does not read now gets them all later."""
        beat_s = 0.0
        while True:
            await asyncio.sleep(_PERIOD_S)
            now_s = monotonic()
            if beats := now_s - beat_s > _BEAT_S:
                beat_s = now_s
            self._send(now_s, beats=beats)

    def _send(self, now_s: float, *, beats: bool) -> None:
        made: dict[int, tuple[int, bytes]] = {}
        for writer, (had, taken_s) in list(self._viewers.items()):
            if writer.transport.get_write_buffer_size():
                if now_s - taken_s > _SUSPENDED_S:
                    writer.transport.abort()
                continue
            if had not in made:
                version, parts = self._page.since(had)
                made[had] = version, f"data: {parts}\n\n".encode() if parts else b""
            version, data = made[had]
            self._viewers[writer] = version, now_s
            if beats:
                data += f"event: beat\ndata: {json.dumps(round(self._page.stale_s, 1))}\n\n".encode()
            if data and not writer.is_closing():
                writer.write(data)

    async def _end_viewers(self) -> None:
        self._send(monotonic(), beats=False)
        for writer in self._viewers:
            if not writer.transport.get_write_buffer_size():
                writer.write(b"event: end\ndata: 0\n\n")
        while any(writer.transport.get_write_buffer_size() for writer in self._viewers):
            await asyncio.sleep(0.01)


@contextmanager
def serve_page(title: str, address: Address | None = None) -> Iterator[Page]:
    """Serve a page while the block runs. Raises `ConfigError` if the address is unusable or the extra `viz` is missing.

    Without an address, only this computer can open the page, on port 8080 or, if that is taken, on another one.
    """
    page = Page(title)
    try:
        site = Site(page, address or _LOCAL)
    except OSError as error:
        if address is not None:
            raise ConfigError(f"--view-address {with_port(*address)} cannot be used: {error.strerror}") from error
        site = Site(page, (_LOCAL[0], 0))
    page.url = f"http://{with_port(_reached_at((address or _LOCAL)[0]), site.port)}/?token={site.token}"
    try:
        yield page
    finally:
        site.end()
        site.close()


def _reached_at(host: str) -> str:
    if host not in ("0.0.0.0", "::"):
        return host
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe, suppress(OSError):
        # connecting UDP sends nothing, but selects the network interface; this address is reserved for documentation
        probe.connect(("192.0.2.1", 9))
        return str(probe.getsockname()[0])
    return socket.gethostname()


@contextmanager
def announce_page(page: Page, address: Address | None, print_page: Callable[..., object]) -> Iterator[None]:
    """Print a page's address. If other devices can open it, add a QR code; else open it in a browser, if any."""
    shared = address is not None and not is_loopback(address[0])
    print_page(page.url, shared=shared)
    if shared or (sys.platform == "linux" and not any(map(os.environ.get, ("DISPLAY", "WAYLAND_DISPLAY")))):
        yield
        return
    # open a file in a private folder that redirects to the page, because `ps` would show an address as an argument
    with TemporaryDirectory(prefix="ftdrive-", ignore_cleanup_errors=True) as folder:
        file = Path(folder, "page.html")
        file.write_text(f'<!doctype html><meta http-equiv="refresh" content="0;url={escape(page.url)}">')
        webbrowser.open(file.as_uri())
        yield


@cache
def _files() -> dict[str, Path]:
    """Return the files that a page needs by their address: those in `shell`, and those of the package uPlot."""
    shell = Path(__file__).parent / "shell"
    files: dict[str, Path] = {f"/{file.name}": file for file in shell.iterdir() if file.suffix in _TYPES}
    files["/"] = files.pop("/page.html")
    package = find_spec("uplot")
    if package is None or package.origin is None:
        raise ConfigError(missing_extra("a view", "uplot", "viz"))
    plots = Path(package.origin).parent / "static"
    return files | {f"/{name}": plots / name for name in ("uPlot.iife.js", "uPlot.min.css")}
