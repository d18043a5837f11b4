import os
import socket
import struct
import threading
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager, suppress
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from ftdrivers.errors import ConnectError, DeviceTimeout, StreamBroken, Unreachable
from ftdrivers.ur import rtde
from tests.fake_clock import FakeClock

# Real bytes of an e-Series controller answering, and of a client asking.
ASK_PROTOCOL, ANSWER_PROTOCOL = bytes.fromhex("0005560002"), bytes.fromhex("00045601")
ASK_VERSION = bytes.fromhex("000376")
ANSWER_VERSION = bytes.fromhex("001376 00000005 0000000f 00000000 00000001")
ASK_START, ANSWER_START = bytes.fromhex("000353"), bytes.fromhex("00045301")
ANSWER_OUTPUTS = bytes.fromhex("005b4f01") + (
    b"DOUBLE,UINT32,UINT32,UINT32,INT32,INT32,INT32,DOUBLE,DOUBLE,DOUBLE,DOUBLE,DOUBLE,DOUBLE"
)


def test_requests_are_the_documented_bytes() -> None:
    assert rtde.encode(rtde.REQUEST_PROTOCOL_VERSION, b"\x00\x02") == ASK_PROTOCOL
    assert rtde.encode(rtde.GET_CONTROLLER_VERSION) == ASK_VERSION
    assert rtde.encode(rtde.START) == ASK_START
    setup = rtde.encode_setup_outputs(500.0, ("timestamp", "robot_status_bits"))
    assert setup == bytes.fromhex("0026 4f 407f400000000000") + b"timestamp,robot_status_bits"


def test_answers_are_read_from_the_documented_bytes() -> None:
    buffer = bytearray(ANSWER_PROTOCOL + ANSWER_VERSION + ANSWER_OUTPUTS + ANSWER_START)
    assert rtde.take_package(buffer) == (rtde.REQUEST_PROTOCOL_VERSION, b"\x01")
    kind, version = rtde.take_package(buffer) or (0, b"")
    assert kind == rtde.GET_CONTROLLER_VERSION
    assert rtde.decode_version(version) == (5, 15, 0, 1)
    kind, outputs = rtde.take_package(buffer) or (0, b"")
    recipe = rtde.Recipe.decode(outputs)
    assert (kind, recipe.id, len(recipe.types)) == (rtde.SETUP_OUTPUTS, 1, 13)
    assert rtde.take_package(buffer) == (rtde.START, b"\x01")
    assert rtde.take_package(buffer) is None

    sample = rtde.encode(rtde.DATA, b"\x01" + struct.pack(">dIIIiii6d", 12.5, 3, 1, 2, 1, -7, 0, *range(6)))
    assert len(sample) == 84  # as documented for this recipe
    kind, data = rtde.take_package(bytearray(sample)) or (0, b"")
    assert kind == rtde.DATA
    recipe.check(data)
    columns = recipe.columns([data, data])
    assert [column.tolist() for column in columns] == [2 * [x] for x in (12.5, 3, 1, 2, 1, -7, 0, *range(6))]


class Server:
    """A controller that answers what `answer` says."""

    host = f"127.83.{os.getpid() % 251}.1"  # its own loopback address: the port is fixed

    def __init__(self, answer: Callable[[bytes], bytes]) -> None:
        self._answer = answer
        self._listener = socket.create_server((self.host, rtde.PORT))
        self.client: socket.socket | None = None
        self.started = threading.Event()
        self._thread = threading.Thread(target=self._serve)
        self._thread.start()

    def _serve(self) -> None:
        try:
            self.client, _ = self._listener.accept()
            while request := self.client.recv(4096):
                self.client.sendall(self._answer(request))
                if request == ASK_START:
                    self.started.set()
        except OSError:
            pass

    def send(self, data: bytes) -> None:
        assert self.started.wait(30)
        assert self.client is not None
        self.client.sendall(data)

    def close(self) -> None:
        for sock in (self._listener, self.client):
            if sock is not None:
                with suppress(OSError):
                    sock.shutdown(socket.SHUT_RDWR)
                sock.close()
        self._thread.join(30)


ANSWERS = {"V": ANSWER_PROTOCOL, "v": ANSWER_VERSION, "S": ANSWER_START}
OUTPUTS = {"timestamp": "DOUBLE", "safety_mode": "INT32", "tcp_offset": "VECTOR6D"}


@contextmanager
def served(outputs: dict[str, str] = OUTPUTS, replace: dict[str, bytes] = ANSWERS) -> Iterator[Server]:
    """Start a controller that knows these outputs."""

    def answer(request: bytes) -> bytes:
        kind = chr(request[2])
        if kind in (answers := ANSWERS | replace):
            return answers[kind]
        types = ",".join(outputs.get(name, "NOT_FOUND") for name in request[11:].decode().split(","))
        return rtde.encode(rtde.SETUP_OUTPUTS, b"\x01" + types.encode())

    server = Server(answer)
    try:
        yield server
    finally:
        server.close()


def sample(t_s: float, *tcp: float, safety_mode: int = 1) -> bytes:
    return rtde.encode(rtde.DATA, b"\x01" + struct.pack(">di6d", t_s, safety_mode, *(tcp or [0.0] * 6)))


def subscribe(server: Server) -> rtde.Subscription:
    return rtde.Subscription(server.host, OUTPUTS, 125.0, timeout_s=30.0)


def values(stream: rtde.Subscription) -> list[dict[str, Any]]:
    """Every sample that has arrived."""
    columns = stream.decode(stream.read(30.0))
    lists = zip(*(column.tolist() for column in columns.values()), strict=True)
    return [dict(zip(columns, row, strict=True)) for row in lists]


def test_samples_come_whole_and_in_order() -> None:
    with served() as server, closing(subscribe(server)) as stream:
        assert stream.version == (5, 15, 0, 1)
        assert stream.missing == []
        text = rtde.encode(ord("M"), b"words of the controller")
        both = sample(1.0) + text + sample(2.0, 0.1, 0, 0.2, 0, 0, 1, safety_mode=3)
        server.send(both[:90])  # in the middle of the second
        assert values(stream) == [{"timestamp": 1.0, "safety_mode": 1, "tcp_offset": [0.0] * 6}]
        with pytest.raises(TimeoutError):
            stream.read(0.01)
        server.send(both[90:] + sample(3.0))
        second, third = values(stream)
        assert second == {"timestamp": 2.0, "safety_mode": 3, "tcp_offset": [0.1, 0, 0.2, 0, 0, 1]}
        assert third["timestamp"] == 3.0


def test_a_lost_connection_is_raised() -> None:
    with served() as server, closing(subscribe(server)) as stream:
        server.send(sample(1.0))
        stream.read(30.0)
        server.close()
        for _ in range(2):
            with pytest.raises((StreamBroken, OSError)):
                stream.read(30.0)


@pytest.mark.parametrize(
    ("types", "taken"), [(b"INT32,DOUBLE", []), (b"IN_USE,DOUBLE", ["a"]), (b"NOT_FOUND,IN_USE", ["b"])]
)
def test_inputs_of_other_clients_are_reported(types: bytes, taken: list[str]) -> None:
    with served(replace={"I": rtde.encode(rtde.SETUP_INPUTS, b"\x01" + types)}) as server:
        assert rtde.registers_in_use(server.host, ("a", "b"), timeout_s=30.0) == taken
    with served(replace={"I": b""}) as server, pytest.raises(DeviceTimeout, match="did not answer"):
        rtde.registers_in_use(server.host, ("a", "b"), timeout_s=0.1)
    with pytest.raises(StreamBroken, match="was lost"):
        rtde.registers_in_use("127.83.7.2", ("a", "b"), timeout_s=0.1)


@pytest.mark.parametrize(
    ("replace", "says"),
    [
        ({"V": b""}, "did not answer within 0.2 s"),
        ({"V": bytes.fromhex("00045600")}, "refuses protocol version 2"),
        ({"V": b"\x00\x01\x00"}, "does not speak RTDE"),
        ({"S": bytes.fromhex("00045300")}, "does not start"),
        ({"O": rtde.encode(rtde.SETUP_OUTPUTS, b"\x01" + b",".join([b"DOUBLE"] * 10))}, "DOUBLE, DOUBLE"),
    ],
)
def test_a_server_that_does_not_speak_rtde_is_refused(replace: dict[str, bytes], says: str) -> None:
    with served(replace=replace) as server, pytest.raises(ConnectError, match=says):
        rtde.Subscription(server.host, OUTPUTS, 125.0, timeout_s=0.2 if "did not answer" in says else 30.0)


def test_the_greeting_has_one_time_out_in_all() -> None:
    """A server that sends anything but the answer, again and again, is given up by the clock."""
    clock = FakeClock()

    def chatter(_: bytes) -> bytes:
        clock.advance(3.0)
        return rtde.encode(ord("M"), b"wait")

    server = Server(chatter)
    try:
        with pytest.raises(ConnectError, match="did not answer"):
            rtde.Subscription(server.host, OUTPUTS, 125.0, timeout_s=2.0, clock=clock)
    finally:
        server.close()


@pytest.mark.parametrize(
    ("error", "fix"),
    [
        (TimeoutError("timed out"), "ping ur5"),
        (OSError(113, "No route to host"), "ping ur5"),
        (ConnectionRefusedError(111, "Connection refused"), "enable RTDE"),
        (socket.gaierror(-2, "Name or service not known"), "IPv4 address"),
    ],
)
def test_each_reason_for_no_connection_has_its_own_fix(
    error: OSError, fix: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(*_: object, **__: object) -> None:
        raise error

    monkeypatch.setattr(socket, "create_connection", refuse)
    with pytest.raises(Unreachable) as raised:
        rtde.Subscription("ur5", OUTPUTS, 125.0, timeout_s=0.5)
    assert fix in raised.value.fix


@given(st.lists(st.tuples(st.integers(0, 255), st.binary(max_size=80)), max_size=6), st.integers(1, 40))
def test_packages_survive_any_cut_of_the_stream(packages: list[tuple[int, bytes]], step: int) -> None:
    stream = b"".join(rtde.encode(kind, payload) for kind, payload in packages)
    buffer, found = bytearray(), []
    for at in range(0, len(stream), step):
        buffer += stream[at : at + step]
        while (package := rtde.take_package(buffer)) is not None:
            found.append(package)
    assert found == packages
    assert not buffer
