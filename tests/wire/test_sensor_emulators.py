"""The emulated Robotous, Robotiq, Bota and Net F/T sensors, as python-can, pyserial and sockets see them."""

import socket
import struct
import termios
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from typing import Any

import can
import numpy as np
import pytest
import serial
from numpy.typing import NDArray

from ftmocks.sensors.bota import BotaBox, crc16_x25
from ftmocks.sensors.netft import RECORD, NetFtBox
from ftmocks.sensors.robotiq import RobotiqBox
from ftmocks.sensors.robotous import RobotousCanNode, RobotousSerialBox, packet
from ftmocks.wires.modbus import with_crc
from tests.wire.waiting import LIMIT_S, drain, read_to, wait_until

UNPLUGGED = (serial.SerialException, can.CanError, OSError, termios.error)
RFT_WRENCH = np.array([10, -5, 20, 1, -0.5, 0.05])
RFT_START = bytes.fromhex("55 0B 00 00 00 00 00 00 00 0B AA")
RFT_STOP = bytes.fromhex("55 0C 00 00 00 00 00 00 00 0C AA")
RFT_RATE_1_KHZ = bytes.fromhex("55 0F 08 00 00 00 00 00 00 17 AA")
RFT_SAMPLE = bytes.fromhex("55 0B 01F4 FF06 03E8 07D0 FC18 0064 00 0000 3F AA")
FT300_WRENCH = np.array([12.34, -5.67, 100, 0.15, -0.025, 1])
FT300_START = bytes.fromhex("09 10 01 9A 00 01 02 02 00 CD CA")
FT300_STARTED = bytes.fromhex("09 10 01 9A 00 01 21 52")
FT300_FRAME = bytes.fromhex("20 4E D2 04 C9 FD 10 27 96 00 E7 FF E8 03 86 DC")
FT300_READ = bytes.fromhex("09 03 00 B4 00 06 84 A6")
BOTA_WRENCH = np.array([1, -2, 9.81, 0.1, -0.2, 0.3])
RDT_ONE = bytes.fromhex("12 34 00 02 00 00 00 01")
RDT_BIAS = bytes.fromhex("12 34 00 42 00 00 00 00")
RDT_WRENCH = np.array([1.5, -2.25, 10, 0.1, -0.05, 0.025])


def constant(wrench: NDArray[np.float64]) -> Callable[[int], NDArray[np.float64]]:
    return lambda n: np.tile(wrench, (n, 1))


class Counter:
    """Readings that carry their number on the x axis, in steps that every sensor resolves."""

    step_N = 0.02

    def __init__(self) -> None:
        self.made = 0

    def __call__(self, count: int) -> NDArray[np.float64]:
        readings = np.zeros((count, 6))
        readings[:, 0] = np.arange(self.made, self.made + count) * self.step_N
        self.made += count
        return readings


@contextmanager
def serial_client(device: RobotousSerialBox | RobotiqBox | BotaBox) -> Iterator[serial.Serial]:
    try:
        with serial.Serial(device.start(), timeout=LIMIT_S) as port:
            yield port
    finally:
        device.stop()


# ---------------------------------------------------------------- Robotous, CAN


@pytest.fixture
def node() -> Iterator[RobotousCanNode]:
    node = RobotousCanNode(constant(RFT_WRENCH))
    yield node
    node.stop()


@contextmanager
def can_client(node: RobotousCanNode, bitrate: int = 1_000_000) -> Iterator[can.BusABC]:
    try:
        bus = can.Bus(interface="slcan", channel=node.start(), bitrate=bitrate, sleep_after_open=0)
        try:
            yield bus
        finally:
            with suppress(*UNPLUGGED):
                bus.shutdown()
    finally:
        node.stop()


def send_command(bus: can.BusABC, command: str, identifier: int = 0x64) -> None:
    data = bytes.fromhex(command).ljust(8, b"\0")
    bus.send(can.Message(arbitration_id=identifier, data=data, is_extended_id=False))


def hear(bus: can.BusABC, count: int) -> list[tuple[int, str]]:
    messages = [bus.recv(LIMIT_S) for _ in range(count)]
    return [(m.arbitration_id, m.data.hex().upper()) for m in messages if m is not None]


def drain_bus(bus: can.BusABC) -> None:
    """Take what was on its way from a sensor that sends nothing more: a full adapter would lose its next answer."""
    while bus.recv(0.05):
        pass


CAN_SAMPLE = [(1, "0B01F4FF0603E807"), (2, "D0FC180064000000")]


def test_robotous_can_commands_and_stream(node: RobotousCanNode) -> None:
    with can_client(node) as bus:
        send_command(bus, "01")
        assert hear(bus, 2) == [(1, "015246543630" + "2D48"), (2, "4130310000000000")]
        send_command(bus, "0A")
        assert hear(bus, 2) == [(1, "0A01F4FF0603E807"), CAN_SAMPLE[1]]
        send_command(bus, "0F 08")
        assert hear(bus, 2)[0] == (1, "0F01000000000000")
        send_command(bus, "0B")
        assert hear(bus, 400) == CAN_SAMPLE * 200
        send_command(bus, "01")
        send_command(bus, "0C")
        wait_until(lambda: not node.streaming)
        send_command(bus, "10")
        while (reply := hear(bus, 2)) == CAN_SAMPLE:
            pass
        assert reply[0] == (1, "1008000000000000")


# ---------------------------------------------------------------- Robotous, UART


RFT_GET_RATE = packet(b"\x10".ljust(8, b"\0"))


def rft_rate(code: int) -> bytes:
    return packet(bytes([0x10, code]).ljust(16, b"\0"))


def test_robotous_uart_streams_and_stops() -> None:
    box = RobotousSerialBox(constant(RFT_WRENCH), baud_code=1)
    with serial_client(box) as port:
        port.write(RFT_RATE_1_KHZ)
        assert port.read(19) == packet(bytes.fromhex("0F 01").ljust(16, b"\0"))
        port.write(RFT_START)
        assert port.read(19 * 200) == RFT_SAMPLE * 200
        port.write(packet(b"\x02".ljust(8, b"\0")) + RFT_STOP)
        wait_until(lambda: not box.streaming)
        rest = drain(port)
        port.write(b"\x55\x55" + packet(b"\x0a".ljust(8, b"\0"))[:-1] + b"\0" + RFT_GET_RATE)
        rest += read_to(port, rft_rate(8))
        assert rest == RFT_SAMPLE * (len(rest) // 19), "nothing else is answered, and no frame is cut"


# ---------------------------------------------------------------- Robotiq


def test_robotiq_start_stream_stop() -> None:
    box = RobotiqBox(constant(FT300_WRENCH))
    with serial_client(box) as port:
        for _ in range(2):
            port.write(FT300_READ)
            rest = read_to(port, with_crc(bytes.fromhex("09 03 0C 04D2 FDC9 2710 0096 FFE7 03E8")))
            assert rest == FT300_FRAME * (len(rest) // 16), "no frame of the last stream is cut"
            port.write(FT300_START)
            assert port.read(8) == FT300_STARTED
            assert port.read(16 * 20) == FT300_FRAME * 20
            port.write(FT300_READ)
            assert port.read(32) == FT300_FRAME * 2, "no reply in the stream"
            port.write(b"\xff" * 50)
            wait_until(lambda: not box.streaming)


def test_robotiq_needs_the_whole_stop_sequence() -> None:
    box = RobotiqBox(constant(FT300_WRENCH), streaming_at_start=True)
    with serial_client(box) as port:
        port.write(b"\xff" * 49 + b"\0" + b"\xff" * 49)
        assert port.read(160) == FT300_FRAME * 10
        port.write(b"\xff" * 300)
        wait_until(lambda: not box.streaming)
        later_s = box.clock.now_s() + 0.05  # its thread has done whole turns by then
        wait_until(lambda: box.clock.now_s() > later_s and not box._burst)  # what is more than 50 is forgotten
        port.write(FT300_START)
        rest = read_to(port, FT300_STARTED)
        assert rest == FT300_FRAME * (len(rest) // 16)


# ---------------------------------------------------------------- Bota


def bota_fields(frame: bytes) -> tuple[Any, ...]:
    assert frame[0] == 0xAA
    assert crc16_x25(frame[1:-2]) == frame[-2:]
    return struct.unpack("<H6fIf", frame[1:-2])


def test_bota_streams_when_opened_and_can_be_configured_at_once() -> None:
    box = BotaBox(constant(BOTA_WRENCH))
    with serial_client(box) as port:
        frames = [bota_fields(port.read(37)) for _ in range(10)]
        assert [round(x, 5) for x in frames[0][1:7]] == BOTA_WRENCH.tolist()
        assert np.diff([f[7] for f in frames]).tolist() == [10_000] * 9
        port.write(b"C")
        assert len(read_to(port, b"r,0,C,0\r\n")) % 37 == 0
        for command, answer in (
            (b"c,0,1,0,4", b"r,0,c,0\r\n"),
            (b"f,64,0,0,0", b"r,0,f,0\r\n"),
            (b"R", b"r,0,R,0\r\n"),
        ):
            for byte in command:
                port.write(bytes([byte]))
            assert port.read(len(answer)) == answer
        frames = [bota_fields(port.read(37)) for _ in range(100)]
        assert np.diff([f[7] for f in frames]).tolist() == [1250] * 99, "800 Hz"


@pytest.mark.parametrize(
    ("written", "answers"),
    [
        (b"f,0,0,0,0", b"r,1,f,0\r\n"),
        (b"c,0,1,0,9", b"r,1,c,0\r\n"),
        (b"x", b"r,1,x,0\r\n"),
        (b"C", b"r,0,C,0\r\n"),
        (b"\r\n c,1,1,0,4 f,512,0,0,0\r\n", b"r,0,c,0\r\nr,0,f,0\r\n"),
        (b"cccccccccccccccccc", b"r,1,c,0\r\n"),
    ],
)
def test_bota_configuration_answers(written: bytes, answers: bytes) -> None:
    box = BotaBox(constant(BOTA_WRENCH))
    with serial_client(box) as port:
        port.write(b"garbage C")
        read_to(port, b"r,0,C,0\r\n")
        port.write(written)
        assert port.read(len(answers)) == answers
        port.write(b"C")
        assert read_to(port, b"r,0,C,0\r\n") == b"", "and nothing else"


def test_bota_waits_for_the_rest_of_a_command() -> None:
    box = BotaBox(constant(BOTA_WRENCH))
    with serial_client(box) as port:
        port.write(b"C")
        read_to(port, b"r,0,C,0\r\n")
        port.write(b"c,0,1,")
        wait_until(lambda: box._line == b"c,0,1,")
        port.write(b"0,4")
        assert port.read_until(b"\n") == b"r,0,c,0\r\n"


# ---------------------------------------------------------------- Net F/T


class RdtClient:
    """A UDP socket that talks to the box."""

    def __init__(self, box: NetFtBox) -> None:
        self.box = box
        self.endpoint = box.start()
        self.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1 << 21)
        self.socket.settimeout(LIMIT_S)
        self.socket.connect((self.endpoint["host"], self.endpoint["rdt_port"]))

    def datagrams(self, count: int) -> list[bytes]:
        return [self.socket.recv(2048) for _ in range(count)]

    def records(self, count: int) -> NDArray[np.void]:
        return np.frombuffer(b"".join(self.datagrams(count)), dtype=RECORD)

    def is_silent(self, silence_s: float = 0.05) -> bool:
        self.socket.settimeout(silence_s)
        with suppress(TimeoutError):
            self.socket.recv(2048)
            return False
        self.socket.settimeout(LIMIT_S)
        return True


@contextmanager
def rdt_client(box: NetFtBox) -> Iterator[RdtClient]:
    try:
        client = RdtClient(box)
        with client.socket:
            yield client
    finally:
        box.stop()


@pytest.fixture
def net_box() -> Iterator[NetFtBox]:
    box = NetFtBox(constant(RDT_WRENCH), rdt_port=0, rate_hz=1000)
    yield box
    box.stop()


def test_rdt_documented_sample(net_box: NetFtBox) -> None:
    with rdt_client(net_box) as client:
        client.socket.send(RDT_ONE)
        data = client.socket.recv(2048)
        assert data[:4] == bytes.fromhex("00000001")
        assert data[8:].hex(" ", 4).upper() == "00000000 0016E360 FFDDAAF0 00989680 000186A0 FFFF3CB0 000061A8"
        assert client.is_silent()


def test_rdt_listens_at_its_documented_port() -> None:
    box = NetFtBox(constant(RDT_WRENCH), host="127.83.91.7")
    with rdt_client(box) as client:
        assert client.endpoint["rdt_port"] == 49152
        client.socket.send(RDT_ONE)
        assert len(client.socket.recv(2048)) == 36


@pytest.mark.parametrize(("command", "count", "sent"), [(1, 0, 1), (1, 3, 3), (2, 25, 25), (3, 12, 12)])
def test_rdt_count_is_honoured(net_box: NetFtBox, command: int, count: int, sent: int) -> None:
    with rdt_client(net_box) as client:
        client.socket.send(struct.pack(">HHI", 0x1234, command, count))
        records = client.records(3 if command == 3 else sent)
        assert records["rdt"].tolist() == list(range(1, sent + 1))
        assert (np.diff(records["ft"].astype(int)) == 7).all(), "it samples at 7000 Hz inside"
        assert client.is_silent()
        assert not net_box.streaming


def test_rdt_ignores_what_is_no_request(net_box: NetFtBox) -> None:
    start = struct.pack(">HHI", 0x1234, 2, 0)
    with rdt_client(net_box) as client:
        for junk in (b"", b"\x12", start[:-1], start + b"\0", b"\x43\x21" + start[2:], b"\x12\x34\0\x99" + bytes(4)):
            client.socket.send(junk)
        assert client.is_silent()
        client.socket.send(start)
        client.records(10)


def test_rdt_buffered_datagrams(net_box: NetFtBox) -> None:
    net_box.buffer_size = 40
    with rdt_client(net_box) as client:
        client.socket.send(struct.pack(">HHI", 0x1234, 3, 0))
        data = client.datagrams(3)
        assert [len(datagram) for datagram in data] == [1440] * 3
        records = np.frombuffer(b"".join(data), dtype=RECORD)
        assert records["rdt"].tolist() == list(range(1, 121))


def test_rdt_bias_status_latch_and_reset(net_box: NetFtBox) -> None:
    net_box.status = 0x80010000
    with rdt_client(net_box) as client:
        client.socket.send(RDT_BIAS)
        client.socket.send(RDT_ONE)
        record = client.records(1)[0]
        assert record["counts"].tolist() == [0] * 6
        assert record["status"] == 0x80010000
        client.socket.send(bytes.fromhex("12 34 00 41 00 00 00 00"))
        client.socket.send(RDT_ONE)
        assert client.records(1)["status"][0] == 0
        net_box.reset()
        net_box.status, net_box.saturated_axis = 0, 2
        client.socket.send(RDT_ONE)
        record = client.records(1)[0]
        assert record["status"] == 0x80020000
        assert record["counts"].tolist() == [1_500_000, -2_250_000, 400_000_000, 100_000, -50_000, 25_000]
        assert record["ft"] < 7000, "counts since the reset"


def test_pynetft_reads_the_box(net_box: NetFtBox) -> None:
    """What the published client asks for: the configuration page, a real-time stream, bias, and the stream again."""
    pynetft = pytest.importorskip("pynetft")
    net_box.rate_hz = 200
    endpoint = net_box.start()
    config = pynetft.Config(
        sensor_host=endpoint["host"], rdt_port=endpoint["rdt_port"], http_port=endpoint["http_port"]
    )
    with pynetft.Client(config, queue_size=1000) as client:
        samples = client.samples(timeout=LIMIT_S)
        first = next(samples)
        np.testing.assert_allclose(first.wrench, RDT_WRENCH)
        assert first.force_unit is pynetft.ForceUnit.NEWTON
        assert first.torque_unit is pynetft.TorqueUnit.NEWTON_METER
        following = [next(samples).rdt_sequence for _ in range(50)]
        assert following == list(range(first.rdt_sequence + 1, first.rdt_sequence + 51))
        health = client.health()
        assert (health.lost_count, health.malformed_count, health.device_error_count) == (0, 0, 0)
        client.bias()
        wait_until(lambda: not any(next(samples).wrench))
    wait_until(lambda: not net_box.streaming)


# ---------------------------------------------------------------- all of them
