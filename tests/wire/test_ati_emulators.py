"""The emulated ATI sensors behind their pseudo-terminals, as python-can and pyserial see them."""

import struct
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
from ftmocks.sensors.ati_serial import JAM_PAUSE_S, AtiSerialBox
from ftmocks.wires.modbus import with_crc
from tests.wire.waiting import LIMIT_S, drain, read_to, wait_until

V1 = np.array([-0.85, 1.476, 6.84, 0.044, -0.0762, 0.1608])
V2 = np.array([10, -5, 20, 0.5, -0.25, 0.1])
V1_FRAMES = ["200#0000 0064 012C 01F4", "201#FF38 FE70 FDA8"]
V1_RECORD = bytes.fromhex("00 64 01 2C 01 F4 FF 38 FE 70 FD A8 50")
READ_STATUS = bytes.fromhex("0A 03 00 1D 00 01 15 77")
STATUS_OK = bytes.fromhex("0A 03 02 00 00 1D 85")
START = bytes.fromhex("0A 46 55 A3 9D")
STARTED = bytes.fromhex("0A 46 01 A2 62")
UNLOCK, LOCK = bytes.fromhex("0A 6A AA FF 1D"), bytes.fromhex("0A 6A 18 7F 68")
ACCEPTED = bytes.fromhex("0A 6A 01 BE A2")
WRITE_GAINS = bytes.fromhex("0A 10 00 00 00 06 0C 02 1F 02 2B 02 39 02 43 02 35 02 37 47 2D")
WRITE_OFFSETS = bytes.fromhex("0A 10 00 06 00 06 0C" + "80 00" * 6 + "75 66")
JAM = bytes(range(1, 15))
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


def test_can_settings_may_wait_for_power_up(node: AtiCanNode) -> None:
    node.reset_applies_settings = False
    node.boot_s = 0.0
    with can_client(node.start()) as client:
        client.ask("20D#7F", 1)
        client.bus.send(frame("20C#"))
        assert client.hears_only_the_serial_number()
    node.stop()
    with can_client(node.start()) as client:
        assert client.hears_only_the_serial_number("7F5#")


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
        stuck = drain(port)
        port.write(b"t20F0\r")
        lines = (stuck + read_to(port, b"t20F403080002\r")).split(b"\r")
        assert set(lines) == {b"", b"z", b"t200800000064012C01F4", b"t2016FF38FE70FDA8"}


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

    def is_silent_to(self, request: bytes) -> bool:
        before_s, self.port.timeout = self.box._last_byte_s, 0.03
        self.port.write(request)
        wait_until(lambda: self.box._last_byte_s > before_s and not self.box._burst)  # it came, and a pause after it
        silent = self.port.read(1) == b""
        self.port.timeout = LIMIT_S
        return silent

    def records(self, count: int) -> NDArray[np.uint8]:
        return np.frombuffer(self.port.read(13 * count), dtype=np.uint8).reshape(-1, 13)

    def stop(self) -> None:
        """Jam, wait for the pause after it, and throw away what was on its way."""
        self.port.write(JAM)
        wait_until(lambda: not self.box.streaming and not self.box._burst)
        drain(self.port)
        self.port.write(READ_STATUS)
        status = with_crc(struct.pack(">3BH", 0x0A, 3, 2, self.box.status))
        read_to(self.port, status)


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


def test_serial_frames_of_the_document(box: AtiSerialBox, line: SerialClient) -> None:
    assert line.ask(READ_STATUS, 7) == STATUS_OK
    box.status = 1
    assert line.ask(READ_STATUS, 7) == bytes.fromhex("0A 03 02 00 01 DC 45")
    diagnostics = line.ask(bytes.fromhex("0A 04 00 27 00 06 C1 78"), 17)
    assert diagnostics[:3] == bytes.fromhex("0A 04 0C")
    assert with_crc(diagnostics[:-2]) == diagnostics
    assert line.ask(UNLOCK, 5) == ACCEPTED
    assert line.ask(WRITE_GAINS, 8) == bytes.fromhex("0A 10 00 00 00 06 41 70")
    assert line.ask(WRITE_OFFSETS, 8) == bytes.fromhex("0A 10 00 06 00 06 A1 71")
    assert line.ask(LOCK, 5) == ACCEPTED
    assert line.ask(with_crc(bytes.fromhex("0A 03 00 00 00 0C")), 29)[3:-2] == WRITE_GAINS[7:-2] + WRITE_OFFSETS[7:-2]


@pytest.mark.parametrize(
    "request_",
    [
        READ_STATUS[:-1] + b"\x00",
        with_crc(b"\x09" + READ_STATUS[1:-2]),
        READ_STATUS[:-1],
        b"\x0a",
        bytes(72),
        JAM,
        JAM + READ_STATUS,
        READ_STATUS + READ_STATUS,
        bytes(3000),
    ],
    ids=["crc", "address", "short", "one", "zeros", "jam", "jam without pause", "two without pause", "flood"],
)
def test_serial_damaged_frames_are_met_with_silence(line: SerialClient, request_: bytes) -> None:
    assert line.is_silent_to(request_)
    assert line.ask(READ_STATUS, 7) == STATUS_OK


def test_serial_fewer_bytes_do_not_stop_it_and_a_pause_restarts_the_count(
    box: AtiSerialBox, line: SerialClient
) -> None:
    assert line.ask(START, 5) == STARTED
    for _ in range(2):
        line.port.write(JAM[:13])
        wait_until(lambda: len(box._burst) == 13)
        wait_until(lambda: box.clock.now_s() - box._last_byte_s > 2 * JAM_PAUSE_S)
        assert len(line.records(100)) == 100
    assert box.streaming
    line.port.write(JAM)
    wait_until(lambda: not box.streaming)


def test_serial_requests_in_a_stream_are_not_answered(box: AtiSerialBox, line: SerialClient) -> None:
    assert line.ask(START, 5) == STARTED
    line.port.write(READ_STATUS)
    wait_until(lambda: len(box._burst) == len(READ_STATUS))
    made = box._pacer.made
    assert line.port.read(13 * 200) == V1_RECORD * 200
    wait_until(lambda: box._pacer.made > made + 200)
    assert line.port.read(13 * 200) == V1_RECORD * 200


def test_serial_gains_decide_what_the_gauges_say(box: AtiSerialBox, line: SerialClient) -> None:
    def gauges() -> list[int]:
        assert line.ask(START, 5) == STARTED
        record = line.port.read(13)
        line.stop()
        g0, g2, g4, g1, g3, g5 = struct.unpack(">6h", record[:12])
        return [g0, g1, g2, g3, g4, g5]

    box.needs_gains = True
    assert gauges() == [-8192] * 6, "no gain, and an offset of 0 instead of 32768"
    line.ask(UNLOCK, 5)
    line.ask(WRITE_OFFSETS, 8)
    assert gauges() == [0] * 6, "no gain"
    line.ask(WRITE_GAINS, 8)
    assert gauges() == [100, -200, 300, -400, 500, -600]
    gain_0 = with_crc(struct.pack(">BBHHBH", 0x0A, 0x10, 0, 1, 2, 2 * 543))
    offset_1 = with_crc(struct.pack(">BBHHBH", 0x0A, 0x10, 7, 1, 2, 0x8000 + 400))
    line.ask(gain_0, 8)
    line.ask(offset_1, 8)
    assert gauges() == [200, -100, 300, -400, 500, -600]


def test_serial_host_that_does_not_read_loses_whole_records(box: AtiSerialBox, line: SerialClient) -> None:
    box.measure = noisy(V1)
    assert line.ask(START, 5) == STARTED
    wait_until(lambda: box.dropped_frames > 100)
    assert len(box._unsent) < 13
    records = line.records(4000)
    assert len(records) == 4000
    assert checksums_are_right(records).all()
    assert line.port.in_waiting < 20_000
