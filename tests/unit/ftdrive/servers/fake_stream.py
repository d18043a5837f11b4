"""A stream that gives what a test says, and a client of the server in the plainest form: JSON and bytes."""

import json
import socket
import struct
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from types import SimpleNamespace
from typing import Any, Self, cast

import numpy as np
from scipy.spatial.transform import Rotation
from websockets import Subprotocol
from websockets.sync.client import connect
from websockets.sync.connection import Connection

from ftdrive.errors import ConfigError
from ftdrive.stream.samples import Block, LinkStatus, Stages, StreamEvent, StreamInfo, StreamStatus, WrenchFrame
from ftdrivers.clock import REAL

UTC_OFFSET_NS = 1_700_000_000_000_000_000
RATE_HZ = 7000.0

INFO = StreamInfo(
    result=cast(
        Any,
        SimpleNamespace(
            R_flange_sensor=Rotation.from_euler("z", 30, True).as_matrix(),
            verdict="good",
            provenance={"station": {"sensor": "can"}},
            is_edited=False,
        ),
    ),
    calibration_name="calibration.json",
    arm=cast(Any, None),
    sensor=cast(Any, None),
    tool="gripper",
    utc_offset_ns=UTC_OFFSET_NS,
    sensor_rate_Hz=RATE_HZ,
    arm_rate_Hz=500.0,
    p_flange_sensor_m=np.array([0.0, 0.0, 0.04]),
    R_flange_tcp=Rotation.from_euler("x", 90, True).as_matrix(),
    p_flange_tcp_m=np.array([0.0, 0.1, 0.2]),
    versions={},
)


def block(n: int = 70, start: int = 0, frame: WrenchFrame = WrenchFrame(), stages: Stages = Stages()) -> Block:  # noqa: B008
    """Make n samples from number `start`, with a different value in every field."""
    seq = np.arange(start, start + n)
    t_ns = 1_000_000_000 + (seq * 1_000_000_000) // round(RATE_HZ)
    raw = seq[:, np.newaxis] + np.arange(6) / 8
    return Block(
        t_host_ns=t_ns,
        t_device_s=np.full(n, np.nan),
        seq=seq,
        status=np.zeros(n, np.uint32),
        raw=raw,
        wrench=-raw,
        chi2=seq / 2,
        in_contact=seq % 2 == 1,
        q_rad=raw / 1000,
        R_base_flange=Rotation.from_rotvec(np.outer(seq / 1000, [1.0, 2.0, 3.0])).as_matrix().reshape(-1, 3, 3),
        p_base_flange_m=raw[:, :3] / 100,
        sigma=np.ones(6),
        frame=frame,
        stages=stages,
    )


class FakeStream:
    def __init__(self) -> None:
        self.info = INFO
        self.clock: Any = REAL
        self.frame = WrenchFrame()
        self.stages = Stages()
        self.contact = False
        self.tares = 0

    def __setattr__(self, name: str, value: Any) -> None:
        if (name == "frame" and value.about == "tcp") or (name == "stages" and value.inertia):
            raise ConfigError("the height of the sensor is not configured: set it")
        super().__setattr__(name, value)

    def tare(self) -> StreamEvent:
        if self.contact:
            return StreamEvent(5, "tare-refused", "3.4 N from the free tool")
        self.tares += 1
        return StreamEvent(5, "tare", "bias +0.4 N")

    def undo_tare(self) -> StreamEvent:
        self.tares -= 1
        return StreamEvent(6, "tare-undone", "bias as calibrated")

    def status(self) -> StreamStatus:
        link = LinkStatus(RATE_HZ, RATE_HZ, 0, 0.001)
        tare = np.arange(6.0) if self.tares else None
        return StreamStatus(link, replace(link, lost=3), 0.003, 0.0002, tare, None, float("nan"), 0.1, 22.5, 0.001)


@contextmanager
def serving(stream: FakeStream, **options: Any) -> Iterator[Any]:
    from ftdrive.servers.foxglove import FoxgloveServer

    server = FoxgloveServer(cast(Any, stream), port=0, **options)
    yield server
    server.end()


class Client:
    """A client that shares no code with the server."""

    def __init__(self, socket: Connection) -> None:
        self.socket = socket
        self.info = self.read("serverInfo")
        self.channels = {channel["topic"]: channel for channel in self.read("advertise")["channels"]}
        self._topics = {channel["id"]: topic for topic, channel in self.channels.items()}
        self.services = {service["name"]: service for service in self.read("advertiseServices")["services"]}

    @classmethod
    @contextmanager
    def to(cls, port: int, *, reads: bool = True) -> Iterator[Self]:
        """Connect. A client that does not read has small buffers, and takes messages only when it is asked for one."""
        raw = socket.socket()
        if not reads:
            raw.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        raw.connect(("127.0.0.1", port))
        with connect(
            f"ws://127.0.0.1:{port}",
            sock=raw,
            subprotocols=[Subprotocol("foxglove.sdk.v1")],
            compression=None,
            max_queue=None if reads else 1,
            close_timeout=10 if reads else 0.01,
        ) as connection:
            yield cls(connection)

    def read(self, op: str) -> dict[str, Any]:
        """Read on to a text message."""
        while True:
            received = self.socket.recv(timeout=10)
            if isinstance(received, str) and (message := json.loads(received))["op"] == op:
                return cast(dict[str, Any], message)

    def send(self, op: str, **fields: object) -> None:
        self.socket.send(json.dumps({"op": op, **fields}))

    def subscribe(self, *topics: str) -> None:
        """Subscribe, and wait until the server has done so: it answers in order."""
        wanted = [{"id": self.channels[topic]["id"], "channelId": self.channels[topic]["id"]} for topic in topics]
        self.send("subscribe", subscriptions=wanted)
        self.parameters()

    def message(self) -> tuple[str, int, bytes]:
        """Read on to a data message; return topic, log time and payload."""
        while True:
            received = self.socket.recv(timeout=10)
            if isinstance(received, bytes) and received[0] == 1:
                _, channel, t_ns = struct.unpack_from("<BIQ", received)
                return self._topics[channel], t_ns, received[13:]

    def parameters(self, *names: str) -> dict[str, Any]:
        self.send("getParameters", parameterNames=names, id="get")
        return self._values("get")

    def set(self, **values: object) -> None:
        parameters = [{"name": name, "value": value} for name, value in values.items()]
        self.send("setParameters", parameters=parameters, id="set")

    def was_set(self) -> dict[str, Any]:
        return self._values("set")

    def _values(self, id_: str) -> dict[str, Any]:
        while (answer := self.read("parameterValues")).get("id") != id_:
            pass
        return {item["name"]: item["value"] for item in answer["parameters"]}

    def call(self, service: str) -> None:
        self.socket.send(struct.pack("<BIII", 2, self.services[service]["id"], 7, 4) + b"json{}")

    def answer(self) -> dict[str, Any]:
        while True:
            received = self.socket.recv(timeout=10)
            if isinstance(received, bytes) and received[0] == 3:
                assert received[13:17] == b"json"
                return cast(dict[str, Any], json.loads(received[17:]))
            if isinstance(received, str) and (message := json.loads(received))["op"] == "serviceCallFailure":
                return cast(dict[str, Any], message)
