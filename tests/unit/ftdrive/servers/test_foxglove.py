"""A plain WebSocket client reads what the server sends, and decodes it with other implementations."""

import importlib
import re
import sys
from collections.abc import Iterator
from dataclasses import asdict
from typing import Any, cast

import numpy as np
import pytest
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from scipy.spatial.transform import Rotation

from ftdrive.errors import ConfigError
from ftdrive.servers import foxglove
from ftdrive.servers.foxglove import ARROWS, EVENTS, STATUS, FoxgloveServer
from ftdrive.stream import ros2
from ftdrive.stream.samples import Stages, StreamEvent, WrenchFrame
from tests.unit.ftdrive.servers.fake_stream import INFO, UTC_OFFSET_NS, Client, FakeStream, block, serving


@pytest.fixture
def stream() -> FakeStream:
    return FakeStream()


@pytest.fixture
def server(stream: FakeStream) -> Iterator[FoxgloveServer]:
    with serving(stream) as server:
        yield server


@pytest.fixture
def client(server: FoxgloveServer) -> Iterator[Client]:
    with Client.to(server.port) as client:
        yield client


def read_cdr(client: Client, topic: str, payload: bytes) -> Any:
    channel = client.channels[topic]
    assert (channel["encoding"], channel["schemaEncoding"]) == ("cdr", "ros2msg")
    store = get_typestore(Stores.EMPTY)
    store.register(get_types_from_msg(channel["schema"], channel["schemaName"]))
    return store.deserialize_cdr(payload, channel["schemaName"])


def stamp_ns(stamp: Any) -> int:
    return int(stamp.sec * 1_000_000_000 + stamp.nanosec)


def numbers(*parts: Any) -> list[float]:
    return [getattr(part, axis) for part in parts for axis in "xyz"]


@pytest.mark.parametrize(("topic", "sign", "frame"), [(ros2.RAW, 1, "sensor"), (ros2.COMPENSATED, -1, "base_at_tcp")])
def test_every_wrench_is_sent(server: FoxgloveServer, client: Client, topic: str, sign: int, frame: str) -> None:
    client.subscribe(topic)
    sent = block(start=5, frame=WrenchFrame("base", "tcp"))
    server.add(sent, [])
    for i in range(len(sent)):
        received, log_time_ns, payload = client.message()
        message = read_cdr(client, topic, payload) if i in (0, 69) else None
        assert received == topic
        assert log_time_ns == sent.t_host_ns[i] + UTC_OFFSET_NS
        if message is not None:
            assert stamp_ns(message.header.stamp) == log_time_ns
            assert message.header.frame_id == frame
            assert numbers(message.wrench.force, message.wrench.torque) == (sign * sent.raw[i]).tolist()


def test_poses_and_joints_come_at_the_rate_of_the_arm(server: FoxgloveServer, client: Client) -> None:
    client.subscribe(ros2.POSE, ros2.JOINTS)
    sent = block(700)
    server.add(sent, [])
    topics, times_ns, _ = zip(*(client.message() for _ in range(2 * 50)), strict=True)
    assert {topic: topics.count(topic) for topic in topics} == {ros2.POSE: 50, ros2.JOINTS: 50}
    assert set(times_ns) <= set(sent.t_host_ns + UTC_OFFSET_NS)


def test_frames_lead_from_base_to_the_frame_of_the_wrench(server: FoxgloveServer, client: Client) -> None:
    client.subscribe(ros2.TRANSFORMS)
    sent = block(start=9, frame=WrenchFrame("base", (0.01, 0.02, 0.03)))
    server.add(sent, [])
    _, t_ns, payload = client.message()
    poses = {"base": (np.eye(3), np.zeros(3))}
    for item in read_cdr(client, ros2.TRANSFORMS, payload).transforms:
        R_base_parent, p_base_parent = poses[item.header.frame_id]
        q, p = item.transform.rotation, item.transform.translation
        R = Rotation.from_quat([q.x, q.y, q.z, q.w]).as_matrix()
        poses[item.child_frame_id] = (R_base_parent @ R, p_base_parent + R_base_parent @ [p.x, p.y, p.z])
        assert stamp_ns(item.header.stamp) == t_ns
    R_base_flange, p_base_flange_m = sent.R_base_flange[-1], sent.p_base_flange_m[-1]
    expected = {
        "base": (np.eye(3), np.zeros(3)),
        "flange": (R_base_flange, p_base_flange_m),
        "sensor": (R_base_flange @ INFO.calibration.R_flange_sensor, p_base_flange_m + R_base_flange @ [0, 0, 0.04]),
        "tcp": (R_base_flange @ INFO.R_flange_tcp, p_base_flange_m + R_base_flange @ [0, 0.1, 0.2]),
        "base_at_0.01_0.02_0.03_m": (np.eye(3), p_base_flange_m + R_base_flange @ [0.01, 0.02, 0.03]),
    }
    assert poses.keys() == expected.keys()
    for name, (R, p) in expected.items():
        assert np.allclose(poses[name][0], R), name
        assert np.allclose(poses[name][1], p), name


def test_parameters_are_the_frame_and_the_stages(stream: FakeStream, client: Client) -> None:
    stages = {name: 0.0 if value is None else value for name, value in asdict(Stages()).items()}
    at_first = {"axes": "sensor", "about": "sensor", **stages}
    assert client.parameters() == at_first
    assert client.parameters("axes", "gravity") == {"axes": "sensor", "gravity": True}
    wanted = {"axes": "base", "about": [0, 0.5, 1], "gravity": False, "lowpass_Hz": 40, "deadband_N": 0.5}
    client.set(**wanted)
    assert client.was_set() == at_first | wanted
    assert stream.frame == WrenchFrame("base", (0.0, 0.5, 1.0))
    assert stream.stages == Stages(gravity=False, lowpass_Hz=40.0, deadband_N=0.5)
    client.set(about="flange", lowpass_Hz=0)
    client.was_set()
    assert stream.frame == WrenchFrame("base", "flange")
    assert stream.stages == Stages(gravity=False, deadband_N=0.5)


def test_a_client_that_never_reads_delays_no_other(
    stream: FakeStream, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """Every message reaches a client that reads, until the queue of another one overflows and beyond."""
    monkeypatch.setattr(foxglove, "BACKLOG", 128)
    with serving(stream) as server, Client.to(server.port, reads=False) as slow, Client.to(server.port) as client:
        slow.subscribe(ros2.RAW, EVENTS)
        client.subscribe(ros2.RAW, EVENTS)
        times_full = 0
        while times_full < 10:
            server.add(None, [StreamEvent(0, "mark", "long" * 50_000)])  # fills the buffers of the system
            server.add(block(100), [])
            assert [client.message()[0] for _ in range(101)] == [EVENTS, *[ros2.RAW] * 100]
            times_full += "reads too slowly" in caplog.text
        host, port = slow.socket.local_address[:2]
        assert re.search(f"oldest messages are dropped .*{host}:{port}", caplog.text)


def test_a_port_in_use_is_named(server: FoxgloveServer, stream: FakeStream) -> None:
    with pytest.raises(
        ConfigError, match=rf"cannot listen on 127\.0\.0\.1:{server.port} \(Address already in use\): choose"
    ):
        FoxgloveServer(cast(Any, stream), port=server.port)


def test_without_the_extra_it_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "foxglove", None)
    monkeypatch.delitem(sys.modules, FoxgloveServer.__module__)
    with pytest.raises(ConfigError, match="a server needs foxglove-sdk, of the extra stream"):
        importlib.import_module(FoxgloveServer.__module__)


def test_arrows_and_frames_come_at_most_60_times_a_second(server: FoxgloveServer, client: Client) -> None:
    client.subscribe(ARROWS, ros2.TRANSFORMS, STATUS)
    for start in range(0, 7000, 35):
        server.add(block(35, start), [])
    server.add(None, [StreamEvent(0, "mark", "")])
    topics = [client.message()[0] for _ in range(122)]
    assert (topics.count(ARROWS), topics.count(ros2.TRANSFORMS), topics.count(STATUS)) == (60, 60, 2)
