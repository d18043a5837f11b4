"""The emulated Bota and Net F/T sensors, as pyserial and sockets see them."""

import socket
import struct
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress

import numpy as np
import pytest
from numpy.typing import NDArray

from ftmocks.sensors.netft import RECORD, NetFtBox
from tests.wire.waiting import LIMIT_S

RDT_ONE = bytes.fromhex("12 34 00 02 00 00 00 01")
RDT_BIAS = bytes.fromhex("12 34 00 42 00 00 00 00")
RDT_WRENCH = np.array([1.5, -2.25, 10, 0.1, -0.05, 0.025])


def constant(wrench: NDArray[np.float64]) -> Callable[[int], NDArray[np.float64]]:
    return lambda n: np.tile(wrench, (n, 1))


# ---------------------------------------------------------------- Bota


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
