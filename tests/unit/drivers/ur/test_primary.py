"""The primary interface: packages as its document lays them out, and a connection to a server of bytes."""

import math
import socket
import struct
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress

import pytest
from hypothesis import given
from hypothesis import strategies as st

from ftdrivers.clock import REAL
from ftdrivers.errors import ConnectError, ProtocolError
from ftdrivers.ur import primary
from ftdrivers.ur.kinematics import MODELS
from ftdrivers.ur.primary import Code, FactoryKinematics, Failed, Message, Note, RobotType, Started, Stopped


def package(kind: int, payload: bytes) -> bytes:
    return struct.pack(">iB", 5 + len(payload), kind) + payload


def message(kind: int, content: bytes) -> bytes:
    return package(20, struct.pack(">QbB", 123456789, -2, kind) + content)


def key(title: bytes, text: bytes) -> bytes:
    return message(7, struct.pack(">iiB", 0, 0, len(title)) + title + text)


def configuration(robot_type: int) -> bytes:
    limits = struct.pack(">24d", *range(24))
    rest = struct.pack(">5d24d", *range(29)) + struct.pack(">4i", 100, 2, robot_type, 1)
    return package(16, package(0, bytes(40)) + package(6, limits + rest))


DOCUMENTED: list[tuple[bytes, list[Message]]] = [
    (key(b"PROGRAM_XXX_STARTED", b"ftdrive_control"), [Started("ftdrive_control")]),
    (key(b"PROGRAM_XXX_STOPPED", b"ftdrive_control"), [Stopped("ftdrive_control")]),
    (key(b"SOMETHING_ELSE", b"x"), []),
    (
        message(10, struct.pack(">ii", 4, 7) + b"syntax_error_on_line:4:end:"),
        [Failed(4, 7, "syntax_error_on_line:4:end:")],
    ),
    (message(6, struct.pack(">iiiBI", 210, 0, 2, 0, 0) + b"text"), [Code(210, 0, "text")]),
    (message(6, struct.pack(">iiiII", 210, 0, 2, 0, 0) + b"text"), [Code(210, 0, "text")]),
    (message(0, b"ftdrive control program, version 1\0"), [Note("ftdrive control program, version 1")]),
    (message(3, b"\x09URControl\x05\x0f"), []),
    (configuration(9), [RobotType("UR15")]),
    (configuration(99), [RobotType(None)]),
]


@pytest.mark.parametrize(("data", "expected"), DOCUMENTED)
@pytest.mark.parametrize("step", [1, 7, 1000])
def test_messages_are_read_as_documented(data: bytes, expected: list[Message], step: int) -> None:
    buffer = bytearray()
    found: list[Message] = []
    for k in range(0, len(data), step):
        buffer += data[k : k + step]
        while (taken := primary.take_primary_package(buffer)) is not None:
            found += primary.decode(*taken)
    assert found == expected


@given(st.binary(max_size=200))
def test_decoding_is_total(data: bytes) -> None:
    buffer = bytearray(data)
    with suppress(ProtocolError):
        while (taken := primary.take_primary_package(buffer)) is not None:
            list(primary.decode(*taken))
    for kind in (16, 20):
        list(primary.decode(kind, data))


# ---------------------------------------------------------------------- a connection


@contextmanager
def served(serve: Callable[[socket.socket], None], monkeypatch: pytest.MonkeyPatch) -> Iterator[str]:
    with socket.create_server(("127.0.0.1", 0)) as server:
        monkeypatch.setattr(primary, "PORT", server.getsockname()[1])

        def run() -> None:
            with suppress(OSError), server.accept()[0] as client:
                serve(client)

        thread = threading.Thread(target=run, daemon=True)
        thread.start()
        yield "127.0.0.1"
    thread.join(5)


def test_a_program_is_sent_and_its_fate_read(monkeypatch: pytest.MonkeyPatch) -> None:
    received = bytearray()

    def serve(client: socket.socket) -> None:
        client.sendall(configuration(7))
        while not received.endswith(b"end\n\n"):
            received.extend(client.recv(4096))
        client.sendall(DOCUMENTED[0][0] + DOCUMENTED[3][0])

    with served(serve, monkeypatch) as host:
        connection = primary.Primary(host, timeout_s=5)
        connection.send("def a():\nend\n")
        found: list[Message] = []
        while not connection.closed:
            found += connection.read(5)
        connection.close()
    assert found == [RobotType("UR20"), Started("ftdrive_control"), *DOCUMENTED[3][1]]
    assert bytes(received) == b"def a():\nend\n\n"


def test_the_model_is_read_once_it_is_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    def serve(client: socket.socket) -> None:
        client.sendall(DOCUMENTED[5][0])
        client.sendall(configuration(8)[:100])
        client.sendall(configuration(8)[100:])
        client.recv(1)

    with served(serve, monkeypatch) as host:
        assert primary.read_arm(host, timeout_s=5, clock=REAL) == ("UR30", None)
    with served(lambda _: None, monkeypatch) as host:
        assert primary.read_arm(host, timeout_s=5, clock=REAL) == (None, None)
    assert primary.read_arm("127.0.0.1", timeout_s=1, clock=REAL) == (None, None)  # its port is closed now


KINEMATICS_OF_A_UR5E = bytes.fromhex(
    "000000e105ffffffffffffffffffffffffffffffffffffffffffffffff"
    + "00" * 48
    + "0000000000000000bfdb333333333333bfd919ce075f6fd2"
    + "00" * 24
    + "3fc4cccccccccccd000000000000000000000000000000003fc10ff9724745393fb985f06f6944673fb97f62b6ae7d56"
    + "3ff921fb54524550000000000000000000000000000000003ff921fb54524550bff921fb545245500000000000000000"
    + "00000000"
)
"""Of a simulator, PolyScope 5.8, from the tests of Universal Robots' client library (test_primary_parser.cpp)."""


def test_the_kinematics_are_read_with_the_model(monkeypatch: pytest.MonkeyPatch) -> None:
    state = package(16, KINEMATICS_OF_A_UR5E + configuration(1)[5:])

    def serve(client: socket.socket) -> None:
        client.sendall(state)
        client.recv(1)

    with served(serve, monkeypatch) as host:
        model, kinematics = primary.read_arm(host, timeout_s=5, clock=REAL)
    assert model == "UR5"
    assert kinematics is not None
    assert kinematics.numbers == pytest.approx(MODELS["UR5e"].numbers, abs=1e-9)


@pytest.mark.parametrize("numbers", [[math.nan] * 24, [0.0] * 11 + [0.1] + [0.0] * 12, [0.0] * 23 + [0.1]])
def test_kinematics_that_no_arm_has_are_left_out(numbers: list[float]) -> None:
    content = package(5, struct.pack(">6I24dI", *[0] * 6, *numbers, 0))
    assert list(primary.decode(16, content)) == [FactoryKinematics(None)]


def test_each_closed_port_has_its_fix() -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        free = server.getsockname()[1]
    with pytest.raises(ConnectError, match="real-time client interface"):
        primary.find_program_port("127.0.0.1", free, timeout_s=1)
    with pytest.raises(ConnectError, match=f"127.0.0.1:{free}"):
        primary.find_program_port("127.0.0.1", free, timeout_s=1)
