"""The emulated ATI sensors behind their pseudo-terminals, as python-can and pyserial see them."""

import termios
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress

import can
import numpy as np
import pytest
import serial
from can.interfaces.slcan import slcanBus
from numpy.typing import NDArray

from ftmocks.sensors.ati_can import AtiCanNode
from ftmocks.sensors.ati_serial import AtiSerialBox
from tests.wire.waiting import LIMIT_S, drain, wait_until

V1 = np.array([-0.85, 1.476, 6.84, 0.044, -0.0762, 0.1608])
START = bytes.fromhex("0A 46 55 A3 9D")
STARTED = bytes.fromhex("0A 46 01 A2 62")
UNPLUGGED = (serial.SerialException, can.CanError, OSError, termios.error)


def constant(wrench: NDArray[np.float64]) -> Callable[[int], NDArray[np.float64]]:
    return lambda n: np.tile(wrench, (n, 1))


class Counted:
    """Readings of V1, and how often one was asked for."""

    def __init__(self) -> None:
        self.calls = 0

    def __call__(self, count: int) -> NDArray[np.float64]:
        self.calls += 1
        return constant(V1)(count)


# ---------------------------------------------------------------- CAN


def text(message: can.Message) -> str:
    return f"{message.arbitration_id:03X}#{message.data.hex(' ', 2).upper()}"


def frame(line: str) -> can.Message:
    identifier, data = line.split("#")
    return can.Message(arbitration_id=int(identifier, 16), data=bytes.fromhex(data), is_extended_id=False)


class CanClient:
    """A python-can bus with the two things every test does."""

    def __init__(self, path: str, bitrate: int = 250_000) -> None:
        self.bus = can.Bus(interface="slcan", channel=path, bitrate=bitrate, sleep_after_open=0)

    def ask(self, line: str, count: int) -> list[str]:
        self.bus.send(frame(line))
        return [text(message) for message in self.collect(count)]

    def collect(self, count: int) -> list[can.Message]:
        messages = [self.bus.recv(LIMIT_S) for _ in range(count)]
        return [message for message in messages if message is not None]

    def hears_only_the_serial_number(self, request: str = "205#") -> bool:
        """Whether everything sent before was ignored: requests are answered in order."""
        return self.ask(request, 1) == [f"{request[:3]}#4654 3132 3334 3500"]


@contextmanager
def can_client(path: str, bitrate: int = 250_000) -> Iterator[CanClient]:
    client = CanClient(path, bitrate)
    try:
        yield client
    finally:
        with suppress(*UNPLUGGED):
            client.bus.shutdown()


@pytest.fixture
def node() -> Iterator[AtiCanNode]:
    node = AtiCanNode(constant(V1), boot_s=0.05)
    yield node
    node.stop()


@pytest.fixture
def client(node: AtiCanNode) -> Iterator[CanClient]:
    with can_client(node.start()) as client:
        yield client


def test_can_reset_is_silent_then_slot_0_with_new_base_and_bit_rate(node: AtiCanNode) -> None:
    path = node.start()
    with can_client(path) as client:
        client.ask("206#05", 1)
        client.ask("20D#21", 1)
        client.ask("20E#03", 1)
        assert client.hears_only_the_serial_number(), "settings wait for the reset"
        client.bus.send(frame("20C#"))
        client.bus.send(frame("205#"))
        wait_until(lambda: node.bitrate == 500_000)
        assert client.bus.recv(0.02) is None, "the node boots, then listens at another bit rate"
    with can_client(path, bitrate=500_000) as client:
        wait_until(lambda: node.clock.now_s() > node._booted_s)
        client.bus.send(frame("205#"))
        assert client.hears_only_the_serial_number("215#")
        assert client.ask("210#", 2)[0] == "210#0000 0064 012C 01F4"


def test_can_adapter_answers_its_own_questions(client: CanClient) -> None:
    assert isinstance(client.bus, slcanBus)
    assert client.bus.get_version(1.0) == (10, 13)
    assert client.bus.get_serial_number(1.0) == "EMUL"


def test_can_host_that_never_reads_costs_frames_not_memory(node: AtiCanNode) -> None:
    with serial.Serial(node.start(), timeout=LIMIT_S) as port:
        port.write(b"S5\rO\r")
        readings, asked = Counted(), 0
        node.measure = readings
        while not node.dropped_frames:
            port.write(b"t2000\r" * 50)
            port.flush()
            asked += 50
        wait_until(lambda: readings.calls == asked)
        assert len(node._answers) + len(node._unsent) < 40_000, "the answers to one read of 4096 bytes"
        received, firmware = drain(port), b"t20F403080002\r"
        while firmware not in received:  # a request whose answer has no room is lost too
            port.write(b"t20F0\r")
            received += drain(port)
        lines = set(received.split(b"\r"))
        assert lines == {b"", b"z", b"t200800000064012C01F4", b"t2016FF38FE70FDA8", firmware[:-1]}


@pytest.mark.parametrize("make", [AtiCanNode, AtiSerialBox])
def test_unplugging_fails_the_client_and_stop_is_idempotent(make: type[AtiCanNode | AtiSerialBox]) -> None:
    device = make(constant(V1))
    device.stop()
    with ExitStack() as stack:
        stack.callback(device.stop)
        port = stack.enter_context(serial.Serial(device.start(), timeout=LIMIT_S))
        with pytest.raises(RuntimeError, match="runs already"):
            device.start()
        device.unplug()
        with pytest.raises(UNPLUGGED):
            port.read(1)
        with pytest.raises(UNPLUGGED):
            port.write(b"\r")
    device.stop()
    device.stop()


# ---------------------------------------------------------------- serial


class SerialClient:
    """A pyserial port with the two things every test does."""

    def __init__(self, box: AtiSerialBox, port: serial.Serial) -> None:
        self.box = box
        self.port = port

    def ask(self, request: bytes, reply_bytes: int) -> bytes:
        self.port.write(request)
        return self.port.read(reply_bytes)

    def records(self, count: int) -> NDArray[np.uint8]:
        return np.frombuffer(self.port.read(13 * count), dtype=np.uint8).reshape(-1, 13)


def checksums_are_right(records: NDArray[np.uint8]) -> NDArray[np.bool_]:
    right: NDArray[np.bool_] = (records[:, :12].sum(axis=1) & 0x7F) == (records[:, 12] & 0x7F)
    return right


def noisy(wrench: NDArray[np.float64]) -> Callable[[int], NDArray[np.float64]]:
    rng = np.random.default_rng(3)
    return lambda n: wrench + rng.normal(scale=[0.05] * 3 + [0.002] * 3, size=(n, 6))


@pytest.fixture
def box() -> Iterator[AtiSerialBox]:
    box = AtiSerialBox(constant(V1), needs_gains=False)
    yield box
    box.stop()


@pytest.fixture
def line(box: AtiSerialBox) -> Iterator[SerialClient]:
    with serial.Serial(box.start(), 1_250_000, timeout=LIMIT_S) as port:
        yield SerialClient(box, port)


def test_serial_host_that_does_not_read_loses_whole_records(box: AtiSerialBox, line: SerialClient) -> None:
    box.measure = noisy(V1)
    assert line.ask(START, 5) == STARTED
    wait_until(lambda: box.dropped_frames > 100)
    assert len(box._unsent) < 13
    records = line.records(4000)
    assert len(records) == 4000
    assert checksums_are_right(records).all()
    assert line.port.in_waiting < 20_000
