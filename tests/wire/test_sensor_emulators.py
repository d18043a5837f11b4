"""The emulated Bota and Net F/T sensors, as pyserial and sockets see them."""

import socket
import struct
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress

import numpy as np
import pytest
import serial
from numpy.typing import NDArray

from ftmocks.sensors.bota import BotaBox, banner, stream_frame
from ftmocks.sensors.netft import RECORD, NetFtBox
from tests.wire.waiting import LIMIT_S, read_to, wait_until

BOTA_WRENCH = np.array([1, -2, 9.81, 0.1, -0.2, 0.3])
RDT_ONE = bytes.fromhex("12 34 00 02 00 00 00 01")
RDT_BIAS = bytes.fromhex("12 34 00 42 00 00 00 00")
RDT_WRENCH = np.array([1.5, -2.25, 10, 0.1, -0.05, 0.025])


def constant(wrench: NDArray[np.float64]) -> Callable[[int], NDArray[np.float64]]:
    return lambda n: np.tile(wrench, (n, 1))


# ---------------------------------------------------------------- Bota


def test_bota_restarts_when_its_port_is_opened_and_is_heard_at_its_own_speed_only() -> None:
    box = BotaBox(constant(BOTA_WRENCH), boot_s=0.1)
    frame = stream_frame(0, BOTA_WRENCH.tolist(), 0, 25.5)[3:27]
    path = box.start()
    try:
        for _ in range(2):
            with serial.Serial(path, 460_800, timeout=LIMIT_S) as port:
                before = read_to(port, banner(12345))
                assert b"c,0,1,0,4" not in before, "printed at 230400 baud"
                assert frame in port.read(37)
                port.write(b"C")
                read_to(port, b"r,0,C,0\r\n")
            wait_until(lambda: not box._was_open)
        with serial.Serial(path, 230_400, timeout=LIMIT_S) as port:
            assert read_to(port, b"c,0,1,0,4\r\n") == b""
            received = port.read(1000)
            assert b"App Init" not in received
            assert frame not in received
            port.write(b"C")
            assert b"r,0,C,0" not in port.read(200), "it does not hear this"
    finally:
        box.stop()


# ---------------------------------------------------------------- Net F/T


class RdtClient:
    """A UDP socket connected to the box."""

    def __init__(self, box: NetFtBox) -> None:
        self.box = box
        self.endpoint = box.start()
        self.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1 << 21)
        self.socket.settimeout(LIMIT_S)
        self.socket.connect((self.endpoint["host"], self.endpoint["rdt_port"]))

    def records(self, count: int) -> NDArray[np.void]:
        return np.frombuffer(b"".join(self.socket.recv(2048) for _ in range(count)), dtype=RECORD)

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
    box = NetFtBox(constant(RDT_WRENCH), rdt_port=0, rate_hz=1000, tool_transform=[0.0] * 6)
    yield box
    box.stop()


def test_rdt_listens_at_its_documented_port() -> None:
    box = NetFtBox(constant(RDT_WRENCH), host="127.83.91.7")
    with rdt_client(box) as client:
        assert client.endpoint["rdt_port"] == 49152
        client.socket.send(RDT_ONE)
        assert len(client.socket.recv(2048)) == 36


def test_rdt_ignores_what_is_no_request(net_box: NetFtBox) -> None:
    start = struct.pack(">HHI", 0x1234, 2, 0)
    with rdt_client(net_box) as client:
        for junk in (b"", b"\x12", start[:-1], start + b"\0", b"\x43\x21" + start[2:], b"\x12\x34\0\x99" + bytes(4)):
            client.socket.send(junk)
        assert client.is_silent()
        client.socket.send(start)
        client.records(10)


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
