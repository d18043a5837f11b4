"""Port 30001 and PolyScope X of the emulated controller, on the wires."""

import http.client
import itertools
import json
import struct
from collections.abc import Iterator
from typing import Any

import pytest

from tests.wire.primary_socket import PrimarySocket
from tests.wire.rtde_socket import RtdeSocket
from tests.wire.station_process import StationProcess

pytestmark = pytest.mark.slow  # every test needs a process of its own

SLEEPING = "def f():\n  sleep(1000)\nend\n"


@pytest.fixture(scope="module")
def station() -> Iterator[StationProcess]:
    with StationProcess() as cell:
        yield cell


@pytest.fixture(scope="module")
def polyscope_x() -> Iterator[StationProcess]:
    with StationProcess("--polyscope", "10.12.0") as cell:
        yield cell


@pytest.fixture(autouse=True)
def _as_it_was(request: pytest.FixtureRequest) -> Iterator[None]:
    yield
    for name in {"station", "polyscope_x"} & set(request.fixturenames):
        cell: StationProcess = request.getfixturevalue(name)
        cell.ask("remote-control")
        cell.ask("silence-arm", on=False)
        cell.ask("dashboard-stop")


def ask_api(station: StationProcess, method: str, path: str, body: object = None) -> tuple[int, dict[str, Any]]:
    connection = http.client.HTTPConnection(station.host, station.hello["arm"]["api_port"], timeout=30)
    try:
        connection.request(method, f"/universal-robots/robot-api{path}", None if body is None else json.dumps(body))
        answer = connection.getresponse()
        return answer.status, json.loads(answer.read())
    finally:
        connection.close()


def test_a_connection_begins_with_a_greeting_and_streams_ten_a_second(station: StationProcess) -> None:
    with PrimarySocket(station.host) as client:
        client.wait_for(lambda m: m["type"] == "state" and m["mode"]["timestamp"] > first_us(client) + 900_000)
        assert [message["type"] for message in client.received[:4]] == ["version", "unexplained", "tolerances", "state"]
        assert set(client.received[3]) >= {"mode", "joints", "cartesian", "kinematics", "configuration"}
        steps = [message["mode"]["timestamp"] for message in client.received[4:] if message["type"] == "state"]
        assert {b - a for a, b in itertools.pairwise(steps)} == {100_000}


def first_us(client: PrimarySocket) -> int:
    return int(client.received[3]["mode"]["timestamp"])


def test_a_program_from_port_30001_runs_and_is_heard_by_every_client(station: StationProcess) -> None:
    with PrimarySocket(station.host) as sender, PrimarySocket(station.host) as listener:
        listener.next("version")
        sender.send('def f():\n  textmsg("hello")\n  sync()\nend\n')
        for client in (sender, listener):
            assert client.next("key")["title"] == "PROGRAM_XXX_STARTED"
            assert client.next("text")["text"] == "hello"
            assert client.next("key")["title"] == "PROGRAM_XXX_STOPPED"
    assert station.wait_for_event("program f")["by"] == "primary port"


def test_local_control_ends_connections_and_lets_new_ones_only_read(station: StationProcess) -> None:
    known = len(station.ask("state")["events"])
    with PrimarySocket(station.host) as before:
        before.next("state")
        station.ask("remote-control", on=False)
        before.end()
    with PrimarySocket(station.host) as client:
        for remote in (False, True):
            station.ask("remote-control", on=remote)
            client.send(SLEEPING)
            assert client.next("error")["code"] == 210
            client.next("state")
    refused = station.wait_for_event("program f", accepted=False, since=known)
    assert (refused["by"], refused["why"]) == ("primary port", "read-only connection")
    with PrimarySocket(station.host) as client:
        client.send(SLEEPING)
        assert client.next("key")["title"] == "PROGRAM_XXX_STARTED"


def test_polyscope_x_has_the_robot_api_in_place_of_the_dashboard(polyscope_x: StationProcess) -> None:
    with pytest.raises(ConnectionRefusedError):
        polyscope_x.connect(29999)
    assert ask_api(polyscope_x, "GET", "/robotstate/v1/robotmode") == (200, {"mode": "RUNNING", "message": "OK"})
    with PrimarySocket(polyscope_x.host) as client:
        assert client.next("version")["version"] == [10, 12, 0]
        client.send(SLEEPING)
        client.wait_for(lambda m: m["type"] == "state" and m["mode"]["running"] == 1)
        assert ask_api(polyscope_x, "GET", "/program/v1/state")[1]["state"] == "PLAYING"
        assert ask_api(polyscope_x, "PUT", "/program/v1/state", {"action": "stop"})[0] == 200
        assert client.wait_for(lambda m: m["type"] == "key" and "STOPPED" in m["title"])["text"] == "f"
    polyscope_x.ask("remote-control", on=False)
    assert ask_api(polyscope_x, "PUT", "/program/v1/state", {"action": "play"})[0] == 403
    with RtdeSocket(polyscope_x.host) as rtde:
        assert struct.unpack(">4I", rtde.ask("v"))[:3] == (10, 12, 0)
        assert rtde.ask("O", struct.pack(">d", 125.0) + b"safety_mode,payload") == b"\x01INT32,DOUBLE"
