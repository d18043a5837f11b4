"""Which requests pass the gate before a server, over real sockets."""

import socket
from collections.abc import Iterator
from contextlib import closing
from http.client import HTTPConnection, HTTPResponse
from http.server import BaseHTTPRequestHandler, HTTPServer
from threading import Thread
from typing import Any

import pytest
from websockets import InvalidStatus, Origin, Subprotocol
from websockets.sync.client import connect

from ftdrive.servers.http_gate import PassingGate, refusal_reason
from tests.unit.ftdrive.servers.fake_stream import Client, FakeStream, serving

PAGE = "https://evil.example"
VIEWER = "https://app.foxglove.dev"


class Echo(BaseHTTPRequestHandler):
    def do_GET(self) -> None:
        self.send_response(200)
        self.end_headers()
        self.wfile.write(self.path.encode())

    def log_message(self, *_: object) -> None:
        """Log nothing."""


@pytest.fixture
def port() -> Iterator[int]:
    server = HTTPServer(("127.0.0.1", 0), Echo)
    thread = Thread(target=server.serve_forever, args=(0.01,))
    thread.start()
    with closing(PassingGate(("127.0.0.1", 0), lambda _: ("127.0.0.1", server.server_port))) as gate:
        yield gate.port
    server.shutdown()
    server.server_close()
    thread.join()


def ask(port: int, path: str, **headers: str) -> HTTPResponse:
    connection = HTTPConnection("127.0.0.1", port, timeout=30)
    with closing(connection):
        connection.request("GET", path, headers=headers)
        answer = connection.getresponse()
        assert (answer.read() == path.encode()) == (answer.status == 200)
    return answer


def status(port: int, **headers: str) -> int:
    return ask(port, "/page", **headers).status


def test_foreign_origin_and_host_are_refused_and_programs_are_served(port: int) -> None:
    assert status(port) == 200
    assert status(port, Origin=f"http://127.0.0.1:{port}") == 200
    assert status(port, Origin=PAGE) == 403
    assert status(port, Origin="null") == 403
    assert status(port, Host=f"evil.example:{port}") == 403
    assert status(port, Host=f"evil.example:{port}", Origin=f"http://evil.example:{port}") == 403


def test_a_second_request_on_one_connection_does_not_pass_unchecked(port: int) -> None:
    request = f"GET /page HTTP/1.1\r\nHost: 127.0.0.1:{port}\r\nConnection: keep-alive\r\n\r\n"
    with socket.create_connection(("127.0.0.1", port), timeout=30) as raw:
        raw.sendall(request.encode() + request.replace("\r\n\r\n", f"\r\nOrigin: {PAGE}\r\n\r\n").encode())
        received = b""
        while piece := raw.recv(4096):
            received += piece
    assert received.count(b"/page") == 1


@pytest.mark.parametrize("request_head", [b"\x00\x01\r\n\r\n", b"GET / HTTP/1.1\r\nHost: a\r\nHost: b\r\n\r\n"])
def test_what_is_no_request_is_refused(port: int, request_head: bytes) -> None:
    with socket.create_connection(("127.0.0.1", port), timeout=30) as raw:
        raw.sendall(request_head)
        assert raw.recv(4096).split()[1] in (b"400", b"403")


@pytest.mark.parametrize(
    ("host", "bound", "served"),
    [
        ("localhost:8765", "127.0.0.1", True),  # a tunnel may have another port
        ("[::1]:8765", "127.0.0.1", True),
        ("192.168.1.5:8765", "127.0.0.1", False),
        ("192.168.1.5:8765", "192.168.1.5", True),
        ("192.168.1.5:8765", "0.0.0.0", True),
        (f"{socket.gethostname()}:8765", "0.0.0.0", True),
        ("evil.example:8765", "0.0.0.0", False),
        ("localhost.evil.example", "localhost", False),
        ("", "127.0.0.1", False),
        ("[", "127.0.0.1", False),
    ],
)
def test_the_host_is_the_bound_address(host: str, bound: str, served: bool) -> None:
    assert (not refusal_reason({"Host": host}, bound)) is served


@pytest.mark.parametrize("host", ["127.0.0.1:10019.evil", "evil@127.0.0.1", "[::1]evil"])
def test_what_only_begins_as_the_address_is_refused(host: str) -> None:
    assert "the server has a different address from" in refusal_reason({"Host": host}, "127.0.0.1")


def handshake(port: int, origin: str | None, host: str = "127.0.0.1", **options: Any) -> Any:
    return connect(
        f"ws://{host}:{port}",
        origin=None if origin is None else Origin(origin),
        subprotocols=[Subprotocol("foxglove.sdk.v1")],
        compression=None,
        **options,
    )


@pytest.mark.parametrize("allow_control", [False, True])
def test_a_viewer_in_a_browser_reads_and_controls_only_if_that_is_allowed(allow_control: bool) -> None:
    stream = FakeStream()
    with serving(stream, origins=[PAGE], allow_control=allow_control) as server:
        for origin in (VIEWER, PAGE):
            with handshake(server.port, origin) as viewer:
                info = viewer.recv(timeout=10)
                assert ('"services"' in info) is allow_control
        with Client.to(server.port) as program:
            program.call("tare")
            assert program.answer()["success"]
    assert stream.tares == 1


@pytest.mark.parametrize(("origin", "host"), [(PAGE, "127.0.0.1"), (None, "evil.example")])
def test_any_other_page_is_refused_by_the_stream(origin: str | None, host: str) -> None:
    with (
        serving(FakeStream()) as server,
        socket.create_connection(("127.0.0.1", server.port)) as raw,
        pytest.raises(InvalidStatus, match="403"),
        handshake(server.port, origin, host=host, sock=raw),
    ):
        pass
