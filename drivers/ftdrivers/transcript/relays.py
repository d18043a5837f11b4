"""Relays between driver and device, which record a sensor on Ethernet.

pynetft opens its sockets outside Python. So pynetft and the driver's HTTP requests are redirected to two ports of this
computer. The relays forward every datagram unchanged, and every request with the host name of the device.
"""

import contextlib
import http.client
import select
import socket
import threading
from collections.abc import Iterator
from dataclasses import replace
from functools import cache
from socketserver import BaseRequestHandler
from typing import Any, Final, Self

import pynetft

from ftdrivers.transcript.ports import AT_ONCE, HTTP_S, LOOK_S, LOOPBACK, PageServer
from ftdrivers.transcript.recorder import Writer
from ftdrivers.transcript.taps import replaced

_ROOM: Final = 4 << 20
"""Receive buffer of a relay in bytes; the system may grant less."""


@contextlib.contextmanager
def relayed(writer: Writer) -> Iterator[None]:
    """Redirect pynetft and HTTP clients in the `with` block to relays."""
    with contextlib.ExitStack() as relays:

        @cache
        def pages_of(host: str, port: int) -> int:
            return relays.enter_context(_PageRelay(writer, host, port)).port

        @cache
        def stream_of(host: str, port: int) -> int:
            relay = relays.enter_context(_DatagramRelay(writer, host, port))
            writer.event("open", port=f"{host}:{port}", datagrams=True)
            return relay.port

        class RelayedClient(pynetft.Client):
            def __init__(self, config: pynetft.Config, **options: Any) -> None:
                try:
                    rdt_port = stream_of(config.sensor_host, config.rdt_port)
                except OSError as error:
                    raise pynetft.NetFTError(str(error)) from error
                http_port = pages_of(config.sensor_host, config.http_port)
                here = replace(config, sensor_host=LOOPBACK, rdt_port=rdt_port, http_port=http_port)
                super().__init__(here, **options)

        class RelayedConnection(http.client.HTTPConnection):
            def __init__(self, *arguments: Any, **options: Any) -> None:
                super().__init__(*arguments, **options)
                self.host, self.port = LOOPBACK, pages_of(self.host, self.port)

        with replaced(pynetft, "Client", RelayedClient), replaced(http.client, "HTTPConnection", RelayedConnection):
            yield


class _DatagramRelay:
    """Forwards datagrams in both directions between the driver, at `port` of this computer, and a sensor.

    Each socket of the driver gets a new one towards the device, so that it receives no replies to earlier requests.
    """

    def __init__(self, writer: Writer, host: str, port: int) -> None:
        self._writer = writer
        self._device = socket.getaddrinfo(host, port, type=socket.SOCK_DGRAM)[0]
        self._far = self._connect()
        self._near = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._near.bind((LOOPBACK, 0))
        self.port: int = self._near.getsockname()[1]
        self._driver: Any = None
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._run, name=f"datagrams of {host}")

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._ended.set()
        self._thread.join()
        self._near.close()
        self._far.close()

    def _connect(self) -> socket.socket:
        family, kind, _, _, address = self._device
        far = socket.socket(family, kind)
        far.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _ROOM)
        try:
            far.connect(address)  # reject datagrams of other hosts
        except OSError:
            far.close()
            raise
        return far

    def _run(self) -> None:
        at_once = 0
        while True:
            is_ended = self._ended.is_set()
            readable, _, _ = select.select([self._near, self._far], [], [], 0)
            if is_ended and self._near not in readable:  # the driver's last request was forwarded
                return
            at_once += 1
            if not readable:
                at_once = 0
                readable, _, _ = select.select([self._near, self._far], [], [], LOOK_S)
            elif at_once == AT_ONCE:  # after a pause of this computer
                at_once = 0
                self._writer.clock.sleep(0.001)
            try:
                if self._near in readable:
                    data, driver = self._near.recvfrom(65536)
                    self._writer.sent(data)
                    if driver != self._driver:
                        far = self._connect()
                        self._far.close()
                        self._far, self._driver = far, driver
                    self._far.send(data)
                if self._far in readable:
                    data = self._far.recv(65536)
                    self._writer.received_datagram(data)
                    self._near.sendto(data, self._driver)
            except OSError as error:  # nothing listens at the device, or here any more: the driver sees silence
                self._writer.event("unreachable", error=str(error))


class _PageRelay(PageServer):
    """Forwards HTTP requests to a sensor, and its replies back."""

    def __init__(self, writer: Writer, host: str, port: int) -> None:
        super().__init__(f"pages of {host}", _PageExchange)
        self.writer = writer
        self.device = host, port

    def for_the_device(self, request: bytes) -> bytes:
        """Replace the host name of this computer by that of the device."""
        host, port = self.device
        here = f"\r\nHost: {LOOPBACK}:{self.port}\r\n"
        there = f"\r\nHost: {host}\r\n" if port == http.client.HTTP_PORT else f"\r\nHost: {host}:{port}\r\n"
        return request.replace(here.encode(), there.encode())


class _PageExchange(BaseRequestHandler):
    server: _PageRelay

    def handle(self) -> None:
        driver: socket.socket = self.request
        request = reply = b""
        error = None
        clock = self.server.writer.clock
        began_s = clock.now_s()
        try:
            driver.settimeout(HTTP_S)
            request = self.server.for_the_device(driver.recv(65536))
            with socket.create_connection(self.server.device, timeout=HTTP_S) as device:
                device.sendall(request)
                while not self.server.ended.is_set():
                    readable, _, _ = select.select([driver, device], [], [], LOOK_S)
                    if device in readable:
                        if not (data := device.recv(65536)):
                            break
                        reply += data
                        driver.sendall(data)
                    if driver in readable:
                        if not (data := driver.recv(65536)):
                            break
                        request += data
                        device.sendall(data)
        except OSError as exc:
            error = str(exc)
        took_s = round(clock.now_s() - began_s, 6)
        self.server.writer.event("page", request=request.hex(), reply=reply.hex(), took_s=took_s, error=error)
