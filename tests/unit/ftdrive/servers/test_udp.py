"""JSON datagrams as PlotJuggler parses them."""

import json
import socket
from collections.abc import Iterator

import pytest

from ftdrive.errors import ConfigError
from ftdrive.servers.udp import UdpSender
from ftdrive.stream.samples import WrenchFrame
from tests.unit.ftdrive.servers.fake_stream import INFO, UTC_OFFSET_NS, block


@pytest.fixture
def viewer() -> Iterator[socket.socket]:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as viewer:
        viewer.bind(("127.0.0.1", 0))
        viewer.settimeout(30)
        yield viewer


@pytest.fixture
def sender(viewer: socket.socket) -> Iterator[UdpSender]:
    sender = UdpSender(INFO, "127.0.0.1", viewer.getsockname()[1])
    yield sender
    sender.end()


def test_a_datagram_has_the_time_and_both_wrenches_by_frame(sender: UdpSender, viewer: socket.socket) -> None:
    sent = block(start=3, frame=WrenchFrame("base", "tcp"))
    sender.add(sent, [])
    values = json.loads(viewer.recv(65536))
    assert abs(values["timestamp"] - (sent.t_host_ns[0] + UTC_OFFSET_NS) * 1e-9) < 1e-6
    assert values["raw_sensor"]["torque_Nm"] == dict(zip("xyz", sent.raw[0, 3:].tolist(), strict=True))
    assert values["compensated_base_at_tcp"]["force_N"] == dict(zip("xyz", sent.wrench[0, :3].tolist(), strict=True))
    assert (values["chi2"], values["in_contact"]) == (1.5, 1)


def test_a_viewer_that_is_not_there_is_no_error(sender: UdpSender, viewer: socket.socket) -> None:
    viewer.close()
    for start in range(0, 210, 70):
        sender.add(block(start=start), [])


def test_an_unknown_host_is_named() -> None:
    with pytest.raises(ConfigError, match=r"--udp nowhere\.invalid:9870: .*give the address"):
        UdpSender(INFO, "nowhere.invalid", 9870)
