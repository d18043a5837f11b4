"""The dashboard server and the Robot API: requests and answers as documented, on a loopback socket."""

import json
import socketserver
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, HTTPServer
from typing import Any

import pytest

from ftdrivers.clock import REAL
from ftdrivers.errors import NoDashboard
from ftdrivers.ur import services
from ftdrivers.ur.services import Services, ServicesOf

HOST = "127.0.0.1"
V5, VX = (5, 15, 0, 1), (10, 14, 0, 1)


@contextmanager
def serving(server: socketserver.BaseServer) -> Iterator[None]:
    thread = threading.Thread(target=server.serve_forever, args=(0.01,), daemon=True)
    thread.start()
    try:
        yield
    finally:
        server.shutdown()
        server.server_close()
        thread.join(5)


@contextmanager
def a_dashboard(replies: dict[str, str], monkeypatch: pytest.MonkeyPatch) -> Iterator[list[str]]:
    asked: list[str] = []

    class Handler(socketserver.StreamRequestHandler):
        def handle(self) -> None:
            self.wfile.write(b"Connected: Universal Robots Dashboard Server\n")
            for line in self.rfile:
                asked.append(line.decode().strip())
                reply = replies.get(asked[-1], f"could not understand: '{asked[-1]}'")
                self.wfile.write(reply.encode() + b"\n")

    with socketserver.TCPServer((HOST, 0), Handler) as server, serving(server):
        monkeypatch.setattr(services, "DASHBOARD_PORT", server.server_address[1])
        yield asked


@contextmanager
def an_api(answers: dict[tuple[str, str], tuple[int, Any]]) -> Iterator[tuple[int, list[Any]]]:
    asked: list[Any] = []

    class Handler(BaseHTTPRequestHandler):
        protocol_version = "HTTP/1.1"

        def do_GET(self) -> None:
            self._answer(None)

        def do_PUT(self) -> None:
            self._answer(json.loads(self.rfile.read(int(self.headers["Content-Length"]))))

        def _answer(self, content: Any) -> None:
            path = self.path.removeprefix("/universal-robots/robot-api")
            asked.append((self.command, path, content))
            status, answer = answers.get((self.command, path), (404, {"message": "Not Found"}))
            body = answer if isinstance(answer, bytes) else json.dumps(answer).encode()
            self.send_response(status)
            self.send_header("Content-Length", str(len(body)))
            self.end_headers()
            self.wfile.write(body)

        def log_message(self, *_: object) -> None: ...

    with HTTPServer((HOST, 0), Handler) as server, serving(server):
        yield server.server_address[1], asked


def everything(services: Services) -> tuple[object, ...]:
    return (
        services.model(),
        services.serial(),
        services.polyscope(),
        services.program(),
        services.in_remote_control(),
    )


def ask(version: tuple[int, int, int, int], question: Callable[[Services], Any], port: int = 1) -> Any:
    return ServicesOf(HOST, version, REAL, port).ask(question, timeout_s=10.0)


def test_a_dashboard_server_answers(monkeypatch: pytest.MonkeyPatch) -> None:
    replies = {
        "get robot model": "UR5",
        "get serial number": "20225500001",
        "PolyscopeVersion": "URSoftware 5.15.0.1261331 (Oct 27 2022)",
        "programState": "PLAYING pick.urp",
        "is in remote control": "true",
        "stop": "Stopped",
    }
    with a_dashboard(replies, monkeypatch) as asked:
        assert ask(V5, everything) == ("UR5", "20225500001", "5.15.0.1261331", "PLAYING pick.urp", True)
        ask(V5, lambda services: services.stop())
    assert asked[-1] == "stop"


def test_an_old_dashboard_server_does_not_know_everything(monkeypatch: pytest.MonkeyPatch) -> None:
    with a_dashboard({"PolyscopeVersion": "3.4.5.100"}, monkeypatch):
        model, serial, polyscope, _, remote = ask(V5, everything)
        assert (model, serial, polyscope, remote) == (None, None, "3.4.5.100", None)
        with pytest.raises(NoDashboard, match=r"dashboard server of 127\.0\.0\.1 reports: could not understand"):
            ask(V5, lambda services: services.stop())


def test_a_robot_api_answers() -> None:
    answers: dict[tuple[str, str], tuple[int, Any]] = {
        ("GET", "/system/v1/information"): (200, {"serialNumber": "20261500001", "robotType": "UR15"}),
        ("GET", "/versions/v1"): (200, {"marketingVersion": "10.14.0", "baselineVersion": "1"}),
        ("GET", "/program/v1/state"): (200, {"state": "PLAYING", "message": "", "details": ""}),
        ("GET", "/system/v1/controlmode"): (200, {"mode": "LOCAL"}),
        ("PUT", "/program/v1/state"): (200, {"message": "ok"}),
    }
    with an_api(answers) as (port, asked):
        assert ask(VX, everything, port) == ("UR15", "20261500001", "10.14.0", "PLAYING", False)
        ask(VX, lambda services: services.stop(), port)
    assert asked[-1] == ("PUT", "/program/v1/state", {"action": "stop"})


@pytest.mark.parametrize(
    ("status", "answer", "says"),
    [(403, {"message": "Forbidden"}, "status 403.*Forbidden"), (200, b"<html>", "not JSON"), (500, {}, "status 500")],
)
def test_a_robot_api_that_refuses(status: int, answer: Any, says: str) -> None:
    with (
        an_api({("PUT", "/program/v1/state"): (status, answer)}) as (port, _),
        pytest.raises(NoDashboard, match=f"Robot API of .*{says}"),
    ):
        ask(VX, lambda services: services.stop(), port)


@pytest.mark.parametrize(
    ("version", "name", "fix"), [(V5, "dashboard server", "Services"), (VX, "Robot API", r"10\.11")]
)
def test_a_device_that_does_not_answer(
    version: tuple[int, int, int, int], name: str, fix: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(services, "DASHBOARD_PORT", 1)
    with pytest.raises(NoDashboard, match=f"the {name} of .* reports: .*refused.*{fix}"):
        ask(version, everything)


def test_an_early_robot_api_does_not_know_everything() -> None:
    with an_api({("GET", "/program/v1/state"): (200, {"state": "STOPPED"})}) as (port, _):
        assert ask(VX, everything, port) == (None, None, None, "STOPPED", None)
