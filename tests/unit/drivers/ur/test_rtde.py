import os
import socket
import struct
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress

import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.errors import ConnectError, DeviceTimeout, ProtocolError, StreamBroken
from drivers.ur import live, rtde
from drivers.ur.live import LiveReader, Sample

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
    assert recipe.unpack(data) == [(12.5,), (3,), (1,), (2,), (1,), (-7,), (0,), *((float(k),) for k in range(6))]


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


@given(st.binary(max_size=120))
def test_decoding_is_total(data: bytes) -> None:
    buffer = bytearray(data)
    try:
        while rtde.take_package(buffer) is not None:
            pass
        recipe = rtde.Recipe.decode(data)
        recipe.unpack(data)
    except ProtocolError:
        pass
    try:
        rtde.decode_version(data)
    except ProtocolError:
        assert len(data) != 16


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

    def tell(self, t_s: float, *tcp: float, safety_mode: int = 1) -> None:
        assert self.started.wait(5)
        assert self.client is not None
        values = struct.pack(">di6d", t_s, safety_mode, *(tcp or [0.0] * 6))
        self.client.sendall(rtde.encode(rtde.DATA, b"\x01" + values))

    def close(self) -> None:
        for sock in (self._listener, self.client):
            if sock is not None:
                with suppress(OSError):
                    sock.shutdown(socket.SHUT_RDWR)
                sock.close()
        self._thread.join(5)


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


@contextmanager
def opened(server: Server) -> Iterator[LiveReader]:
    reader = LiveReader(server.host)
    try:
        reader.open(timeout_s=2.0)
        yield reader
    finally:
        reader.close()
        reader.close()


def test_the_newest_offset_is_told_with_its_time() -> None:
    with served() as server, opened(server) as reader:
        assert reader.tells_tcp
        assert not reader.missing & OUTPUTS.keys()
        assert reader.version == (5, 15, 0, 1)
        server.tell(1.0)
        server.tell(2.0, 0.1, 0, 0.2, 0, 0, 1)
        sample = reader.newest(since_s=1.5, limit_s=2.0)
        assert sample.t_device_s == 2.0
        assert sample.outputs == {"timestamp": (2.0,), "tcp_offset": (0.1, 0, 0.2, 0, 0, 1), "safety_mode": (1,)}


def test_a_lost_connection_is_raised_at_the_consumer() -> None:
    with served() as server, opened(server) as reader:
        server.tell(1.0)
        reader.newest(since_s=1.0, limit_s=2.0)
        server.close()
        for _ in range(2):
            with pytest.raises(StreamBroken, match="open the arm again"):
                reader.newest(since_s=5.0, limit_s=2.0)
            with pytest.raises(StreamBroken):
                reader.now_s(limit_s=2.0)


def test_an_old_controller_tells_at_least_its_time() -> None:
    with served({"timestamp": "DOUBLE", "safety_mode": "INT32"}) as server, opened(server) as reader:
        assert not reader.tells_tcp
        assert reader.version[:2] == (5, 15)
        assert server.started.wait(5)
        assert server.client is not None
        server.client.sendall(rtde.encode(rtde.DATA, b"\x01" + struct.pack(">di", 7.0, 3)))
        outputs = reader.newest(since_s=7.0, limit_s=2.0).outputs
        assert outputs == {"timestamp": (7.0,), "safety_mode": (3,)}


class Clock:
    """Stands still, so that no sample seems waited for, until a test moves it on."""

    t_s = 0.0

    def __call__(self) -> float:
        return self.t_s


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    clock = Clock()
    monkeypatch.setattr(live, "awake_s", clock)
    return clock


def pile_up(server: Server, reader: LiveReader, clock: Clock) -> None:
    """Let a pause be far longer than between two samples, then tell what a socket held back."""
    server.tell(1.0)
    reader.newest(since_s=1.0, limit_s=2.0)
    clock.t_s += 0.15
    for k in range(101):
        server.tell(2.0 + 0.008 * k)
    reader.newest(since_s=2.8, limit_s=2.0)


def tell_on(server: Server, reader: LiveReader, clock: Clock, asking: threading.Thread, safety_mode: int) -> None:
    """Tell samples of 3 s and later, each of them waited for, until who asks has an answer."""
    t_s = 3.0
    while asking.is_alive():
        clock.t_s += 0.008
        server.tell(t_s := t_s + 0.008, safety_mode=safety_mode)
        reader.newest(since_s=t_s, limit_s=2.0)


def test_what_has_piled_up_is_not_now(clock: Clock) -> None:
    with served() as server, opened(server) as reader:
        told: list[float] = []
        asking = threading.Thread(target=lambda: told.append(reader.now_s(limit_s=5.0)))
        asking.start()
        pile_up(server, reader, clock)
        tell_on(server, reader, clock, asking, 1)
        assert told[0] > 3.0
        with pytest.raises(DeviceTimeout):
            reader.now_s(limit_s=0.0)  # what was now before this question is not now


def test_what_has_piled_up_is_no_status(clock: Clock) -> None:
    with served() as server, opened(server) as reader:
        pile_up(server, reader, clock)
        with pytest.raises(DeviceTimeout):
            reader.live(max_age_s=0.05, limit_s=0.1)
        told: list[Sample] = []
        asking = threading.Thread(target=lambda: told.append(reader.live(max_age_s=0.05, limit_s=5.0)))
        asking.start()
        tell_on(server, reader, clock, asking, 3)
        assert told[0].outputs["safety_mode"] == (3,)
        clock.t_s += 0.06
        with pytest.raises(DeviceTimeout):
            reader.live(max_age_s=0.05, limit_s=0.0)


def test_a_clock_that_stands_still_is_found_after_a_fifth_of_a_second() -> None:
    with served() as server, opened(server) as reader:
        server.tell(1.0)
        t0 = time.monotonic()
        with pytest.raises(DeviceTimeout, match=r"stood still at 1\.000 s"):
            reader.newest(since_s=1.001, limit_s=0.2)
        assert 0.2 < time.monotonic() - t0 < 1.0


def test_our_own_pause_is_not_the_controllers(monkeypatch: pytest.MonkeyPatch) -> None:
    with served() as server, opened(server) as reader:
        server.tell(1.0)
        reader.newest(since_s=1.0, limit_s=2.0)
        pauses = iter(range(0, 10**9, 30))  # 30 s between any two looks at the clock: the computer sleeps all the time
        monkeypatch.setattr(time, "monotonic", lambda: float(next(pauses)))
        later = threading.Timer(0.04, server.tell, (2.0,))
        later.start()
        assert reader.newest(since_s=2.0, limit_s=0.2).t_device_s == 2.0
        later.join()


@pytest.mark.parametrize(
    ("types", "taken"), [(b"INT32,DOUBLE", []), (b"IN_USE,DOUBLE", ["a"]), (b"NOT_FOUND,IN_USE", ["b"])]
)
def test_inputs_of_others_are_told(types: bytes, taken: list[str]) -> None:
    with served(replace={"I": rtde.encode(rtde.SETUP_INPUTS, b"\x01" + types)}) as server:
        assert rtde.registers_in_use(server.host, ("a", "b"), timeout_s=2.0) == taken
    with served(replace={"I": b""}) as server, pytest.raises(DeviceTimeout, match="did not answer"):
        rtde.registers_in_use(server.host, ("a", "b"), timeout_s=0.1)
    with pytest.raises(StreamBroken, match="was lost"):
        rtde.registers_in_use("127.83.7.2", ("a", "b"), timeout_s=0.1)


@pytest.mark.parametrize(
    ("replace", "says"),
    [
        ({"V": b""}, "did not answer within 0.2 s"),
        ({"V": bytes.fromhex("00045600")}, "protocol version 2 is refused"),
        ({"V": b"HTTP/1.1 400 Bad Request\r\n"}, "did not answer"),
        ({"V": b"\x00\x01\x00"}, "does not speak RTDE"),
        ({"S": bytes.fromhex("00045300")}, "does not start"),
        ({"O": rtde.encode(rtde.SETUP_OUTPUTS, b"\x01" + b",".join([b"DOUBLE"] * 10))}, "DOUBLE, DOUBLE"),
    ],
)
def test_whoever_does_not_speak_rtde_is_refused_in_time(replace: dict[str, bytes], says: str) -> None:
    with served(replace=replace) as server:
        reader = LiveReader(server.host)
        t0 = time.monotonic()
        with pytest.raises(ConnectError, match=says):
            reader.open(timeout_s=0.2)
        reader.close()
        assert time.monotonic() - t0 < 1.0


def test_nobody_there() -> None:
    with pytest.raises(ConnectError, match=r"cannot be reached .*switched on"):
        LiveReader("127.83.7.2").open(timeout_s=0.5)
