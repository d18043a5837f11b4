"""Faults of link, program, safety and power on the wires of the emulated controller."""

import contextlib
import socket
import struct
from collections.abc import Callable, Iterator

import pytest

from ftmocks.ur import rtde
from tests.wire.station_process import StationProcess
from tests.wire.waiting import LIMIT_S


@pytest.fixture
def start() -> Iterator[Callable[..., StationProcess]]:
    """Start stations that end with the test."""
    with contextlib.ExitStack() as stack:
        yield lambda *options: stack.enter_context(StationProcess(*options))


@pytest.fixture(scope="module")
def station() -> Iterator[StationProcess]:
    """One for all tests that leave it as they found it."""
    with StationProcess() as shared:
        yield shared


@pytest.mark.parametrize(("what", "ports"), [("rtde", [30004]), ("dashboard", [29999]), ("script", [30002, 30003])])
def test_ports_close_and_open_one_by_one(station: StationProcess, what: str, ports: list[int]) -> None:
    known = len(station.ask("state")["events"])
    with station.connect(ports[0]) as before:
        station.wait_for(
            lambda state: any((e["by"], e["what"]) == (what, "connected") for e in state["events"][known:])
        )
        station.ask("listen", what=what, on=False)
        station.ask("listen", what=what, on=False)
        for port in (29999, 30002, 30003, 30004):
            if port in ports:
                with pytest.raises(ConnectionRefusedError):
                    station.connect(port)
            else:
                station.connect(port).close()
        before.settimeout(0.05)
        if what != "dashboard":
            with pytest.raises(TimeoutError):
                before.recv(1)  # still connected, nothing to say
        station.ask("listen", what=what, on=True)
        for port in ports:
            station.connect(port).close()


def test_a_silent_dashboard_accepts_and_answers_later(station: StationProcess) -> None:
    with station.connect(29999) as old:
        assert old.makefile("rb").readline().startswith(b"Connected")
        station.ask("silent", what="dashboard", on=True)
        old.sendall(b"robotmode\n")
        with station.connect(29999) as new:
            for client in (old, new):
                client.settimeout(0.05)
                with pytest.raises(TimeoutError):
                    client.recv(1)
            station.ask("silent", what="dashboard", on=False)
            for client, line in (
                (old, b"Robotmode: RUNNING\n"),
                (new, b"Connected: Universal Robots Dashboard Server\n"),
            ):
                client.settimeout(LIMIT_S)
                assert client.recv(100) == line


def kinds(client: socket.socket) -> Iterator[str]:
    """Yield the kinds of RTDE packages as they arrive."""
    buffer = bytearray()
    while True:
        yield from (chr(kind) for kind, _payload in rtde.take_packages(buffer))
        buffer += client.recv(4096)


@pytest.mark.parametrize("answers", [True, False])
def test_silent_rtde_stops_streaming_and_answers_only_if_asked_to(station: StationProcess, answers: bool) -> None:
    with station.connect(30004) as client:
        client.sendall(struct.pack(">HB", 20, ord("O")) + struct.pack(">d", 500.0) + b"timestamp"[:9])
        assert client.recv(100)[2:4] == b"O\x01"
        client.sendall(b"\x00\x03S")
        assert client.recv(4) == b"\x00\x04S\x01"
        assert client.recv(100)[2:3] == b"U"
        station.ask("silent", what="rtde", on=True, answers=answers)
        client.settimeout(0.1)
        with contextlib.suppress(TimeoutError):
            while client.recv(1000):
                pass  # what was on its way
        client.sendall(b"\x00\x03v")
        if answers:
            client.settimeout(LIMIT_S)
            assert client.recv(100)[2:3] == b"v"
            client.settimeout(0.1)
        with pytest.raises(TimeoutError):
            client.recv(100)
        station.ask("silent", what="rtde", on=False)
        client.settimeout(LIMIT_S)
        assert ("U" if answers else "v") in kinds(client), "what was asked in the silence is answered"


def test_connections_come_and_go_in_the_event_log(start: Callable[..., StationProcess]) -> None:
    station = start()
    with station.connect(30004) as client:
        station.wait_for(lambda state: [e["what"] for e in state["events"]] == ["connected"])
        before_ns = station.ask("state")["t_host_ns"]
        assert station.ask("drop", what="rtde", reset=True)["connections"] == 1
        with pytest.raises(ConnectionResetError):
            client.recv(1)
    drop, gone = (state := station.ask("state", since=1))["events"]
    assert (drop["by"], drop["what"], drop["reset"]) == ("network", "drop rtde", True)
    assert (gone["by"], gone["what"]) == ("rtde", "disconnected")
    assert before_ns <= drop["t_host_ns"] <= gone["t_host_ns"] <= state["t_host_ns"]


def test_any_mode_can_be_asked_for(start: Callable[..., StationProcess]) -> None:
    station = start()
    for number, name in ((2, "REDUCED"), (4, "RECOVERY"), (5, "SAFEGUARD_STOP"), (1, "NORMAL"), (3, "PROTECTIVE_STOP")):
        assert station.ask("mode", safety=number)["safety_mode"] == name
        assert station.ask("state")["robot_mode"] == "RUNNING"
    assert station.ask("mode", safety=9) == {"done": "mode", "robot_mode": "POWER_OFF", "safety_mode": "FAULT"}
    for number, name in ((-1, "NO_CONTROLLER"), (5, "IDLE"), (7, "RUNNING")):
        assert station.ask("mode", robot=number)["robot_mode"] == name
