"""Server of the stream for Foxglove, Lichtblick and PlotJuggler: WebSocket, parameters and scene.

Wrenches, poses, joint angles and frames are ROS 2 messages, because the viewers have no other wrench type and
PlotJuggler no other encoding. Arrows and events have Foxglove types. Programs can tare, and can set the frame and the
stages. Browser pages are accepted from a few origins, and may do the same if control is allowed, see `http_gate`.
"""

import json
import logging
import os
import socket
import stat
from collections.abc import Callable, Collection, Sequence
from contextlib import suppress
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any, Final
from urllib.parse import urlencode

import numpy as np
from numpy.typing import NDArray

from ftdrive.errors import ConfigError
from ftdrive.servers.http_gate import PassingGate, hidden_host
from ftdrive.servers.parameters import parameters_of, set_stream, with_changes
from ftdrive.stream import ros2
from ftdrive.stream.samples import Block, Picked, StreamEvent, quaternions
from ftdrive.stream.stream import Sink, Stream
from ftdrivers.installation import missing_extra
from ftdrivers.interfaces import Array

try:
    import foxglove as sdk
except ImportError:
    raise ConfigError(missing_extra("a server", "foxglove-sdk", "stream")) from None

from foxglove import (
    Channel,
    Context,
    MessageSchema,
    Parameter,
    Schema,
    Service,
    ServiceRequest,
    ServiceSchema,
    messages,
)
from foxglove.channels import LogChannel, SceneUpdateChannel
from foxglove.websocket import Capability, Client, ServerListener, StatusLevel

FORCE_M_N, TORQUE_M_NM = 0.01, 0.1
"""Lengths of the drawn arrows, m per N and m per N·m: 10 N and 1 N·m are 100 mm."""
_ORANGE, _BLUE = messages.Color(r=1.0, g=0.5, b=0.0, a=1.0), messages.Color(r=0.1, g=0.4, b=1.0, a=1.0)
_HEAD_M = 0.02


def _timestamp(t_utc_ns: int) -> messages.Timestamp:
    return messages.Timestamp(*divmod(t_utc_ns, 1_000_000_000))


def _arrows(block: Block, t_utc_ns: int) -> messages.SceneUpdate:
    """Return arrows of force (orange) and torque (blue) of the newest sample, in the wrench frame."""
    force_N, torque_Nm = block.wrench[-1, :3], block.wrench[-1, 3:]
    entity = messages.SceneEntity(
        timestamp=_timestamp(t_utc_ns),
        frame_id=block.frame.id,
        id="wrench",
        frame_locked=True,
        arrows=[_arrow_primitive(FORCE_M_N * force_N, _ORANGE), _arrow_primitive(TORQUE_M_NM * torque_Nm, _BLUE)],
    )
    return messages.SceneUpdate(entities=[entity])


def _arrow_primitive(vector_m: Array, color: messages.Color) -> messages.ArrowPrimitive:
    length_m = float(np.linalg.norm(vector_m))
    # An arrow points along x. A half turn about the bisector of x and the vector swaps the two directions.
    bisector = np.array([1.0, 0.0, 0.0]) + (vector_m / length_m if length_m > 0 else 0.0)
    half_turn = bisector / norm if (norm := np.linalg.norm(bisector)) > 1e-9 else np.array([0.0, 0.0, 1.0])
    orientation = messages.Quaternion(**dict(zip("xyz", half_turn.tolist(), strict=True)), w=0.0)
    head_m = min(_HEAD_M, length_m / 2)
    return messages.ArrowPrimitive(
        pose=messages.Pose(position=messages.Vector3(), orientation=orientation),
        shaft_length=length_m - head_m,
        shaft_diameter=0.4 * _HEAD_M,
        head_length=head_m,
        head_diameter=0.8 * _HEAD_M,
        color=color,
    )


ARROWS, EVENTS, STATUS = "/wrench_arrows", "/events", "/stream_status"

VIEWERS: Final = (
    "https://app.foxglove.dev",
    "https://studio.foxglove.dev",
    # sent by the desktop programs; browsers send it or null for local pages
    "file://",
    # the container of Lichtblick
    "http://localhost:8080",
)
"""HTTP origins of the web pages and desktop programs of Foxglove and Lichtblick."""

SCENE_HZ = 60.0
"""Rate, Hz, at which coordinate frames and arrows are sent: no screen shows more."""
STATUS_HZ = 2.0
BACKLOG = 1 << 15
"""Most messages that wait for a slow client, more than two seconds of 7 kHz; then the oldest are dropped."""

_log = logging.getLogger(__name__)


class FoxgloveServer(Sink, ServerListener):
    """Sends a stream to any number of clients.

    No client delays the stream. Messages wait in one queue per client; the SDK drops the oldest from a full queue
    without counting them. Therefore `STATUS` contains the number of messages sent per topic, from which a client can
    count its losses. A slow client is logged at most every 30 s.

    Requests of clients are handled in a thread of the SDK.

    Parameters
    ----------
    port : int
        Port of the server; 0 lets the system choose, see `port`.
    origins : collection of str
        Origins of pages accepted in addition to `VIEWERS`.
    allow_control : bool
        Whether pages may tare and set parameters, as programs can.

    Raises
    ------
    ConfigError
        The address cannot be used.
    """

    label = "Foxglove"

    def __init__(
        self,
        stream: Stream,
        host: str = "127.0.0.1",
        port: int = 8765,
        *,
        origins: Collection[str] = (),
        allow_control: bool = False,
    ) -> None:
        self._stream = stream
        self._info = stream.info
        # keep the context alive, because server and channels have only weak references to it
        self._context = context = Context()
        self._channels: dict[str, Any] = {
            topic: Channel(
                topic,
                message_encoding="cdr",
                schema=Schema(name=schema.name, encoding="ros2msg", data=schema.text.encode()),
                context=context,
            ).base  # its methods skip type checks: 15 000 calls per second
            for topic, schema in (ros2.SCHEMAS | {ros2.TRANSFORMS: ros2.TRANSFORMS_SCHEMA}).items()
        } | {
            ARROWS: SceneUpdateChannel(ARROWS, context=context),
            EVENTS: LogChannel(EVENTS, context=context),
            STATUS: Channel(STATUS, message_encoding="json", context=context).base,
        }
        self._sent = dict.fromkeys(self._channels, 0)
        self._arm, self._scene, self._status = Picked(self._info.arm_rate_Hz), Picked(SCENE_HZ), Picked(STATUS_HZ)
        behind = hidden_host()
        options: dict[str, Any] = {
            "name": f"ftdrive: {self._info.tool}, {self._info.calibration_name}",
            "host": behind,
            "port": 0,
            "context": context,
            "message_backlog_size": BACKLOG,
        }
        self._control = sdk.start_server(
            **options,
            capabilities=[Capability.Parameters, Capability.Services],
            supported_encodings=["json"],
            services=[self._service("tare", stream.tare), self._service("undo_tare", stream.undo_tare)],
            server_listener=self,
        )
        # a second server without control, because the SDK sees no Origin and all its clients have the same rights
        self._read_only = sdk.start_server(**options)
        self._servers = self._control, self._read_only
        for server in self._servers:
            _send_at_once(server.port)

        def route(origin: str | None) -> tuple[str, int]:
            return behind, (self._control if origin is None or allow_control else self._read_only).port

        try:
            self._gate = PassingGate((host, port), route, origins=(*VIEWERS, *origins))
        except OSError as error:
            self._stop()
            raise ConfigError(
                f"the server cannot listen on {host}:{port} ({error.strerror}): choose another --port or --host"
            ) from error
        self._slow_clients = _SlowClients(self._gate.with_clients)

    @property
    def port(self) -> int:
        """Port of the server."""
        return self._gate.port

    @property
    def app_url(self) -> str:
        """Address of Foxglove in a browser, with this server as its source."""
        source = {"ds": "foxglove-websocket", "ds.url": f"ws://127.0.0.1:{self.port}"}
        return f"https://app.foxglove.dev?{urlencode(source)}"

    def add(self, block: Block | None, events: Sequence[StreamEvent]) -> None:
        """Send samples and events without waiting."""
        offset_ns = self._info.utc_offset_ns
        if block:
            self._send_block(block, block.t_host_ns + offset_ns)
        for event in events:
            t_ns = np.array([event.t_host_ns + offset_ns])
            level = messages.LogLevel.Warning if event.kind in ros2.WARNINGS else messages.LogLevel.Info
            log = messages.Log(timestamp=_timestamp(int(t_ns[0])), level=level, message=event.text, name=event.kind)
            self._send(EVENTS, t_ns, partial(list, [log]))

    def _send_block(self, block: Block, t_ns: NDArray[np.int64]) -> None:
        frame = block.frame.id
        self._send(ros2.RAW, t_ns, lambda: ros2.pack_wrenches(t_ns, block.raw, "sensor").tolist())
        self._send(ros2.COMPENSATED, t_ns, lambda: ros2.pack_wrenches(t_ns, block.wrench, frame).tolist())
        # poses at the arm's rate, because those between are interpolated
        if (rows := self._arm.rows(t_ns)).any():
            poses, t_arm_ns = block.rows(rows), t_ns[rows]
            p_m, R = poses.p_base_flange_m, poses.R_base_flange
            self._send(ros2.POSE, t_arm_ns, lambda: ros2.pack_poses(t_arm_ns, p_m, quaternions(R)).tolist())
            self._send(ros2.JOINTS, t_arm_ns, lambda: ros2.pack_joints(t_arm_ns, poses.q_rad).tolist())
        newest = t_ns[-1:]
        if self._scene.rows(newest).any():
            self._send(ros2.TRANSFORMS, newest, lambda: self._frames(block, newest))
            self._send(ARROWS, newest, lambda: [_arrows(block, int(newest[0]))])
        if self._status.rows(newest).any():
            self._send(STATUS, newest, lambda: [self._state()])

    def end(self) -> None:
        """Disconnect the clients."""
        self._gate.close()
        self._stop()
        self._slow_clients.close()

    def _stop(self) -> None:
        for server in self._servers:
            server.stop()

    def _send(self, topic: str, t_ns: NDArray[np.int64], pack: Callable[[], Sequence[object]]) -> None:
        channel = self._channels[topic]
        if channel.has_sinks():
            for message, t in zip(pack(), t_ns.tolist(), strict=True):
                channel.log(message, log_time=t)
            self._sent[topic] += len(t_ns)

    def _frames(self, block: Block, t_ns: NDArray[np.int64]) -> Sequence[object]:
        placed = ros2.transforms_of(block.frame, self._info, block.R_base_flange[-1], block.p_base_flange_m[-1])
        return list(ros2.pack_transforms(t_ns, placed).tolist())

    def _state(self) -> bytes:
        state = {
            "frame": str(self._stream.frame),
            "stages": asdict(self._stream.stages),
            "calibration": self._info.calibration_name,
            "verdict": self._info.calibration.verdict,
            "marks": self._info.marks,
            "status": asdict(self._stream.status()),
            "sent": self._sent,
        }
        # replace arrays and NaN, which JSON does not have
        text = json.dumps(state, default=np.ndarray.tolist)
        return json.dumps(json.loads(text, parse_constant=lambda _: None)).encode()

    def on_get_parameters(
        self, _client: Client, param_names: list[str], _request: str | None = None
    ) -> list[Parameter]:
        """Return the parameters with these names, or all if no names are given. Called in an SDK thread."""
        values = parameters_of(self._stream.frame, self._stream.stages)
        return [Parameter(name, value=value) for name, value in values.items() if name in (param_names or values)]

    def on_set_parameters(
        self, client: Client, parameters: list[Parameter], _request: str | None = None
    ) -> list[Parameter]:
        """Set all parameters, or none with a warning; return the resulting values. Called in an SDK thread."""
        stream, changes = self._stream, [(one.name, one.get_value()) for one in parameters]
        try:
            set_stream(stream, *with_changes(stream.frame, stream.stages, changes))
        except ConfigError as error:
            self._control.publish_status(str(error), StatusLevel.Warning)
        return self.on_get_parameters(client, [])

    def _service(self, name: str, action: Callable[[], StreamEvent]) -> Service:
        def handle(_: ServiceRequest) -> bytes:
            event = action()
            return json.dumps({"success": event.kind != "tare-refused", "message": event.text}).encode()

        # The ROS 2 type of this name, as JSON.
        empty = b'{"type": "object", "properties": {}}'
        result = b'{"type": "object", "properties": {"success": {"type": "boolean"}, "message": {"type": "string"}}}'
        request, response = (
            MessageSchema(encoding="json", schema=Schema(name=words, encoding="jsonschema", data=schema))
            for words, schema in (("Trigger_Request", empty), ("Trigger_Response", result))
        )
        schema = ServiceSchema(name="std_srvs/srv/Trigger", request=request, response=response)
        return Service(name, schema=schema, handler=handle)


def _send_at_once(port: int) -> None:
    """Set TCP_NODELAY on the socket of this process that listens on a port; its connections inherit the option.

    Without the option, a message waits up to 40 ms for the acknowledgement of the previous one.
    """
    folder = Path("/dev/fd")  # Windows has none
    for name in [path.name for path in folder.iterdir()] if folder.is_dir() else []:
        with suppress(OSError):  # the file was closed meanwhile
            if not stat.S_ISSOCK(os.fstat(int(name)).st_mode):
                continue
            with socket.socket(fileno=os.dup(int(name))) as found:
                if found.family in (socket.AF_INET, socket.AF_INET6) and found.getsockname()[1] == port:
                    found.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)


class _SlowClients(logging.Handler):
    """Logs the slow clients that the SDK reports, with their addresses."""

    def __init__(self, with_clients: Callable[[str], str]) -> None:
        super().__init__(logging.INFO)
        self._with_clients = with_clients
        sdk.set_log_level("INFO")
        logging.getLogger("foxglove").setLevel(logging.WARNING)
        self._source = logging.getLogger("foxglove.websocket.connected_client.send_lossy")
        self._source.setLevel(logging.INFO)
        self._source.propagate = False
        self._source.addHandler(self)

    def emit(self, record: logging.LogRecord) -> None:
        """Log a message from the SDK."""
        report = self._with_clients(record.getMessage())
        _log.warning("a client reads too slowly, so its oldest messages are dropped (%s)", report)

    def close(self) -> None:
        """Stop logging."""
        self._source.removeHandler(self)
        super().close()
