"""The node of `ftdrive ros2`: a compensated stream as topics, transforms, services and diagnostics.

Conventions are those of REP 103, 105 and 107: SI units, a `frame_id` whose axes and origin a wrench has, stamps of the
time of measurement. A fault is a missing message and a diagnostic, never an old or a zero wrench.
"""

import math
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, field
from enum import IntEnum
from functools import partial
from queue import Empty, SimpleQueue
from threading import Event
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ftdrive.errors import ConfigError
from ftdrive.live import ros2
from ftdrive.live.processing import SENSOR_FRAME
from ftdrive.live.samples import (
    Block,
    LinkStatus,
    Picked,
    Stages,
    StreamEvent,
    StreamInfo,
    StreamStatus,
    WrenchFrame,
    frames_in_flange,
)
from ftdrive.live.stages import stages_in_words
from ftdrive.live.stream import BlockReader, CompensatedStream, ProcessedStream
from ftdrive.servers.parameters import Fixed, NodeParameters
from ftdrivers.errors import DeviceError, NoRos2
from ftdrivers.interfaces import Array
from ftdrivers.ros2.middleware import Node, ros2_module

_TF_HZ: Final = 50.0


class Transforms:
    """Publishes sensor and tcp in the flange once, and on request what moves: base to flange.

    A frame of base axes about another point also moves, because the flange turns in the base. It is published too.
    """

    def __init__(self, node: Any, fixed: Fixed) -> None:
        self._node, self._fixed = node, fixed
        self._names = {"sensor": fixed.sensor_frame, "flange": fixed.flange_frame, "base": fixed.base_frame}
        self._picked = Picked(_TF_HZ)
        try:
            message = ros2_module("tf2_msgs.msg").TFMessage
        except NoRos2:
            self._static = self._moving = None
            node.get_logger().info(
                f"tf2_msgs is not installed, so {fixed.flange_frame} to {fixed.sensor_frame} is not published: "
                "`ftdrive export calibration --format static-transform` writes a command that does"
            )
            return
        qos = ros2_module("rclpy.qos")
        latched = qos.QoSProfile(depth=1, durability=qos.DurabilityPolicy.TRANSIENT_LOCAL)
        self._static = node.create_publisher(message, "/tf_static", latched)
        self._moving = node.create_publisher(message, "/tf", 100)

    def frame_id(self, frame: WrenchFrame) -> str:
        """Return the name of the axes and the point of a wrench, in the names of the parameters."""
        axes = self._names.get(frame.axes, frame.axes)
        if frame.axes == frame.about:
            return axes
        if isinstance(frame.about, str):
            return f"{axes}_at_{self._names.get(frame.about, frame.about)}"
        return frame.id.replace(frame.axes, axes, 1)

    def use(self, info: StreamInfo) -> None:
        """Publish where sensor and tcp are, unless the height of the sensor is unknown."""
        if self._static is None or not np.isfinite(info.p_flange_sensor_m).all():
            return
        frames = frames_in_flange(WrenchFrame(), info, np.eye(3))
        fixed = [(self._fixed.flange_frame, self._names.get(name, name), R, p) for name, (R, p) in frames.items()]
        t_ns = self._node.get_clock().now().nanoseconds
        self._static.publish(pack(fixed, t_ns))

    def publish(self, block: Block, info: StreamInfo, t_ns: int) -> None:
        """Publish what moves, at the time of the newest sample of a block."""
        if self._moving is None or not self._picked.rows(np.array([t_ns])).any():
            return
        R_base_flange = block.R_base_flange[-1]
        frames = frames_in_flange(block.frame, info, R_base_flange)
        name = block.frame.id
        moving = []
        if name in frames and name not in ("sensor", "tcp"):
            moving.append((self._fixed.flange_frame, self.frame_id(block.frame), *frames[name]))
        p_m = block.p_base_flange_m[-1]
        if self._fixed.publish_base_tf and np.isfinite(p_m).all():
            moving.append((self._fixed.base_frame, self._fixed.flange_frame, R_base_flange, p_m))
        if moving:
            self._moving.publish(pack(moving, t_ns))


def pack(transforms: Sequence[tuple[str, str, Array, Array]], t_ns: int) -> bytes:
    """Return a TFMessage of (parent, child, orientation (3, 3), origin (3,) in m) as CDR."""
    packed = ros2.pack_transforms(np.array([t_ns]), [(parent, child, p, R) for parent, child, R, p in transforms])
    return bytes(packed.tolist()[0])


class Means(NamedTuple):
    """n means of one frame, in the order of measurement."""

    t_host_ns: NDArray[np.int64]
    """(n,) mean of the times of measurement."""
    raw: Array
    """(n, 6)"""
    wrench: Array
    """(n, 6)"""
    in_contact: NDArray[np.bool_]
    """(n,) whether one of the samples is."""


class Averaged:
    """Means over as many consecutive sample numbers as give at most `rate_Hz`; a single sample stays as it is.

    A lost sample leaves the mean of the others. Samples of an interval that an interruption cut are dropped, because
    their mean would come late.
    """

    def __init__(self, sensor_rate_Hz: float, rate_Hz: float) -> None:
        # a rate is known to about 0.3 %
        self.count = max(1, int(np.ceil(0.99 * sensor_rate_Hz / rate_Hz)))
        """Samples of one mean."""
        self._longest_ns = 2e9 * self.count / sensor_rate_Hz
        self._waiting: Block | None = None

    def restart(self) -> None:
        """Drop the samples of an interval that is not complete."""
        self._waiting = None

    def add(self, block: Block) -> Means:
        """Return the means that are complete with this block."""
        if self.count == 1:
            return Means(block.t_host_ns, block.raw, block.wrench, block.in_contact)
        waiting, self._waiting = self._waiting, None
        if waiting is not None and self._continues(waiting, block):
            block = Block.concatenate([waiting, block])
        interval = block.seq // self.count
        begins = np.flatnonzero(np.diff(interval, prepend=interval[0] - 1))
        # more of the last interval are to come
        if (block.seq[-1] + 1) % self.count:
            last = int(begins[-1])
            self._waiting = block.rows(slice(last, None))
            block, begins = block.rows(slice(last)), begins[:-1]
        if not len(begins):
            return Means(block.t_host_ns, block.raw, block.wrench, block.in_contact)
        n = np.diff(begins, append=len(block))
        t_ns = block.t_host_ns[begins] + np.rint(
            np.add.reduceat(block.t_host_ns - np.repeat(block.t_host_ns[begins], n), begins) / n
        ).astype(np.int64)
        raw, wrench = (np.add.reduceat(values, begins) / n[:, None] for values in (block.raw, block.wrench))
        return Means(t_ns, raw, wrench, np.logical_or.reduceat(block.in_contact, begins))

    def _continues(self, waiting: Block, block: Block) -> bool:
        is_alike = waiting.frame == block.frame and waiting.stages == block.stages
        return bool(is_alike and block.t_host_ns[0] - waiting.t_host_ns[-1] < self._longest_ns)


class Level(IntEnum):
    """Levels of diagnostic_msgs/DiagnosticStatus."""

    OK, WARN, ERROR, STALE = range(4)


@dataclass(frozen=True, slots=True)
class PartState:
    """One part of the node: "stream", "sensor", "arm" or "calibration"."""

    part: str
    level: Level
    text: str
    values: Mapping[str, str] = field(default_factory=dict)
    hardware: str = ""

    def message(self, node: str) -> Any:
        """Return a DiagnosticStatus."""
        messages = ros2_module("diagnostic_msgs.msg")
        return messages.DiagnosticStatus(
            level=bytes([self.level]),
            name=f"{node}: {self.part}",
            message=self.text,
            hardware_id=self.hardware,
            values=[messages.KeyValue(key=key, value=value) for key, value in self.values.items()],
        )


def reports_of(stream: ProcessedStream, warnings: tuple[str, ...], lost_before: int, sent: int) -> list[PartState]:
    """Report an open stream; `lost_before` is the number of lost samples at the report before."""
    status, info = stream.status(), stream.info
    sensor = _link("sensor", status.sensor, info.sensor, status.sensor.lost - lost_before)
    arm = _link("arm", status.arm, info.arm, 0)
    doubts = [*info.marks, *warnings]
    verdict = info.calibration.verdict
    level = Level.ERROR if verdict == "rejected" else Level.WARN if doubts else Level.OK
    text = "; ".join(doubts) or info.calibration_state
    state = PartState("calibration", level, text, {"file": info.calibration_name, "verdict": verdict})
    failed = status.sensor.error or status.arm.error
    words = failed or f"{stream.frame}; {stages_in_words(stream.stages)}"
    whole = PartState("stream", Level.ERROR if failed else Level.OK, words, _values(stream, status, sent))
    return [whole, sensor, arm, state]


def _link(part: str, link: LinkStatus, device: Any, lost: int) -> PartState:
    values = {"rate_Hz": f"{link.rate_Hz:.1f}", "lost": str(link.lost), "age_s": f"{link.age_s:.3f}"}
    if link.error:
        level, text = Level.ERROR, link.error
    elif lost > 0:
        level, text = Level.WARN, f"{lost} samples lost since the report before"
    else:
        level, text = Level.OK, f"{link.rate_Hz:.0f} Hz"
    return PartState(part, level, text, values, f"{device.model} {device.serial}")


def _values(stream: ProcessedStream, status: StreamStatus, sent: int) -> dict[str, str]:
    info = stream.info
    tare = "none" if status.tare is None else " ".join(f"{value:.6g}" for value in status.tare)
    return {
        "axes": stream.frame.axes,
        "about": str(stream.frame.to_dict()["about"]),
        "stages": stages_in_words(stream.stages),
        "tool": info.tool,
        "calibration": str(info.calibration.id),
        "verdict": info.calibration.verdict,
        "tare": tare,
        "delay_s": f"{status.delay_s:.6g}",
        "delay_sigma_s": f"{status.delay_sigma_s:.6g}",
        "drift_N_h": f"{status.drift_N_h:.6g}",
        "messages_sent": str(sent),
    }


NAME: Final = "ftdrive"
REPORT_S: Final = 0.4
"""Between two reports; a fault is reported at once."""
# Samples of so long are processed at once: a message is that late at most, and half as many blocks are processed.
_BLOCK_S: Final = 0.008
_CONTACT_S: Final = 0.1
# Until the nodes of this computer and its network are known.
_DISCOVERY_S: Final = 1.0
# After a device did not open.
_RETRY_S: Final = 2.0
# After the calibration did not fit: a person has to calibrate, or to choose another tool.
_RETRY_CONFIG_S: Final = 10.0
# History of a reliable topic, because Fast DDS asks for what was lost every 3 s.
_HISTORY_S: Final = 10.0
_TOOL_S: Final = 5.0
_WARNINGS: Final = ("tare-refused", "drift", "gap", "stale")


class Ros2Node:
    """Publishes a stream until it is closed.

    Parameters
    ----------
    arguments : sequence of str
        Of ROS, such as ``("--ros-args", "-r", "__ns:=/cell_1", "-p", "axes:=base")``.
    frame : WrenchFrame
        Of `~/wrench`, if the arguments of ROS set no other one.
    tool : str
        Name of the tool; empty if a calibration is given.

    Raises
    ------
    NoRos2
        rclpy cannot be imported, or does not understand the arguments.
    ConfigError
        A parameter cannot be used, or another node of this name runs.
    """

    def __init__(self, arguments: Sequence[str] = (), *, frame: WrenchFrame = SENSOR_FRAME, tool: str = "") -> None:
        self._wrench = ros2_module("geometry_msgs.msg").WrenchStamped
        self._bool = ros2_module("std_msgs.msg").Bool
        self._diagnostics = ros2_module("diagnostic_msgs.msg")
        self._trigger = ros2_module("std_srvs.srv").Trigger
        self._ros = Node(NAME, arguments)
        self.node = self._ros.node
        try:
            self._set_up(frame, tool)
        except BaseException:
            self._ros.close()
            raise

    def _set_up(self, frame: WrenchFrame, tool: str) -> None:
        node = self.node
        self._log = node.get_logger()
        self.parameters = NodeParameters(node, frame, tool)
        self.fixed = self.parameters.fixed
        self._require_alone()
        sensor_data = self._quality()
        self._raw = node.create_publisher(self._wrench, "~/wrench_raw", sensor_data)
        self._compensated = node.create_publisher(self._wrench, "~/wrench", sensor_data)
        self._contact = node.create_publisher(self._bool, "~/contact", 10)
        self._status = node.create_publisher(self._diagnostics.DiagnosticStatus, "~/status", 10)
        self._overall = node.create_publisher(self._diagnostics.DiagnosticArray, "/diagnostics", 10)
        node.create_service(self._trigger, "~/tare", partial(self._answer, lambda stream: stream.tare()))
        node.create_service(self._trigger, "~/undo_tare", partial(self._answer, lambda stream: stream.undo_tare()))
        self._transforms = Transforms(node, self.fixed)
        self._stream: CompensatedStream | None = None
        self._averaged: Averaged | None = None
        # Tools that clients request: name, where the reason of a refusal goes, when it is decided.
        self._wanted: SimpleQueue[tuple[str, list[str], Event]] = SimpleQueue()
        self._failure, self._reported, self._reported_s, self._lost = "", list[PartState](), 0.0, 0
        self._in_contact, self._contact_s, self.sent = False, 0.0, 0
        self._ros.spin()

    def _quality(self) -> Any:
        qos = ros2_module("rclpy.qos")
        if not self.fixed.reliable:
            return qos.qos_profile_sensor_data
        depth = max(10, round(_HISTORY_S * self.fixed.rate))
        return qos.QoSProfile(depth=depth, reliability=qos.ReliabilityPolicy.RELIABLE)

    def _require_alone(self) -> None:
        """Raise `ConfigError` if another node of this name reports; one that was killed may still be listed."""
        received = Event()
        # A killed node stays in the list of nodes for up to 20 s, so a second one is found by its reports.
        subscription = self.node.create_subscription(
            self._diagnostics.DiagnosticStatus, "~/status", lambda _: received.set(), 10
        )
        begin_s = time.monotonic()
        while not received.is_set():
            self._ros.spin_once(0.05)
            waited_s = time.monotonic() - begin_s
            is_listed = self.node.count_publishers(subscription.topic_name) > 0
            if waited_s > (_DISCOVERY_S + 3 * REPORT_S if is_listed else _DISCOVERY_S):
                break
        self.node.destroy_subscription(subscription)
        if received.is_set():
            raise ConfigError(
                f"another node {self.name} runs already: stop it, or give this one a name: "
                f"--ros-args -r __node:={NAME}_2"
            )

    @property
    def name(self) -> str:
        """With its namespace."""
        return str(self.node.get_fully_qualified_name())

    def close(self) -> None:
        """Leave the graph of ROS."""
        self._ros.close()

    # -------------------------------------------------------------------------------------------------------- serving

    def serve(self, open_stream: Callable[[], AbstractContextManager[CompensatedStream]]) -> None:
        """Open the stream and publish it, again after each failure, until an exception such as Ctrl-C ends it."""
        while True:
            try:
                self._report([PartState("stream", Level.STALE, "the devices are being opened")])
                with open_stream() as stream:
                    self.begin(stream)
                    reader = BlockReader(stream, math.inf)
                    while True:
                        self._turn(stream, reader)
            except (ConfigError, DeviceError) as error:
                self.end()
                self._fail(error)
                wait_s = _RETRY_S if isinstance(error, DeviceError) else _RETRY_CONFIG_S
                until_s = time.monotonic() + wait_s
                while time.monotonic() < until_s:
                    self._report([PartState("stream", Level.ERROR, str(error))])
                    time.sleep(REPORT_S)
            finally:
                self.end()

    def begin(self, stream: CompensatedStream) -> None:
        """Publish this stream from now on."""
        self._stream = stream
        self._lost = stream.status().sensor.lost
        self._averaged = Averaged(stream.info.sensor_rate_Hz, self.fixed.rate)
        self._transforms.use(stream.info)
        stream.frame, stream.stages = self.parameters.frame, self.parameters.stages
        stream.block_s = _BLOCK_S
        self.parameters.apply = self._apply
        if self._failure:
            self._failure = ""
            self._log.info("The devices are open.")

    def end(self) -> None:
        """Publish no stream."""
        self._stream = self._averaged = self.parameters.apply = None

    def _turn(self, stream: CompensatedStream, reader: BlockReader) -> None:
        self._ros.check()
        self._change_tool(stream)
        block = reader.read()
        if reader.failure is not None:
            if self._averaged is not None:
                self._averaged.restart()
            self._fail(reader.failure)
            self.report()
        elif block is not None:
            self._failure = ""
            self.write(block)
        for event in stream.take_events():
            self.event(event)

    def write(self, block: Block) -> None:
        """Publish the means that are complete with a block."""
        if self._stream is None or self._averaged is None:
            return
        means = self._averaged.add(block)
        info = self._stream.info
        if len(means.t_host_ns):
            t_ns = means.t_host_ns + info.utc_offset_ns
            frame_id = self._transforms.frame_id(block.frame)
            for publisher, wrench, frame in (
                (self._raw, means.raw, self.fixed.sensor_frame),
                (self._compensated, means.wrench, frame_id),
            ):
                if publisher.get_subscription_count():
                    for message in ros2.pack_wrenches(t_ns, wrench, frame).tolist():
                        publisher.publish(message)
            self.sent += len(t_ns)
            self._publish_contact(bool(means.in_contact[-1]))
            self._transforms.publish(block, info, int(t_ns[-1]))
        if time.monotonic() - self._reported_s >= REPORT_S:
            self.report()

    def event(self, event: StreamEvent) -> None:
        """Log an event."""
        # rclpy raises ValueError if one call has two severities
        if event.kind in _WARNINGS:
            self._log.warning(event.text)
        else:
            self._log.info(event.text)

    def _publish_contact(self, in_contact: bool) -> None:
        now_s = time.monotonic()
        if in_contact != self._in_contact or now_s - self._contact_s >= _CONTACT_S:
            self._in_contact, self._contact_s = in_contact, now_s
            self._contact.publish(self._bool(data=in_contact))

    # ------------------------------------------------------------------------------------------------------- reporting

    def _fail(self, error: Exception) -> None:
        """Log a failure once, however often it is tried again."""
        if (text := str(error)) != self._failure:
            self._failure = text
            self._log.error(text)

    def report(self) -> None:
        """Publish the state of the stream in diagnostics and status."""
        if self._stream is not None:
            reports = reports_of(self._stream, self._stream.warnings, self._lost, self.sent)
            self._lost = self._stream.status().sensor.lost
            self._report(reports)

    def _report(self, reports: list[PartState]) -> None:
        """Publish reports, at once if a level has changed."""
        now_s = time.monotonic()
        levels, before = ([(one.part, one.level) for one in some] for some in (reports, self._reported))
        if levels == before and now_s - self._reported_s < 0.9 * REPORT_S:
            return
        self._reported, self._reported_s = reports, now_s
        messages = [report.message(self.node.get_name()) for report in reports]
        array = self._diagnostics.DiagnosticArray(status=messages)
        array.header.stamp = self.node.get_clock().now().to_msg()
        self._overall.publish(array)
        self._status.publish(messages[0])

    # ---------------------------------------------------------------------------------------- what clients may request

    def _answer(self, action: Callable[[CompensatedStream], StreamEvent], _: Any, response: Any) -> Any:
        stream = self._stream
        if stream is None or self._failure:
            why = self._failure or "the devices are being opened"
            response.success, response.message = False, f"refused: {why}"
        else:
            event = action(stream)
            response.success, response.message = event.kind != "tare-refused", event.text
        return response

    def _apply(self, frame: WrenchFrame, stages: Stages, tool: str) -> None:
        """Apply parameters, in the thread of the node. Raises `ConfigError`; then none has changed."""
        stream = self._stream
        if stream is None:
            return
        before = stream.frame, stream.stages
        try:
            stream.frame, stream.stages = frame, stages
            if tool != self.parameters.tool:
                self._request_tool(tool)
        except ConfigError:
            stream.frame, stream.stages = before
            raise

    def _request_tool(self, tool: str) -> None:
        if not tool:
            raise ConfigError("tool cannot be empty while the node runs: set the name of a tool")
        refusal, decided = list[str](), Event()
        self._wanted.put((tool, refusal, decided))
        if not decided.wait(_TOOL_S):
            raise ConfigError(f"tool {tool!r} was not applied within {_TOOL_S:g} s, because no samples arrive")
        if refusal:
            raise ConfigError(refusal[0])

    def _change_tool(self, stream: CompensatedStream) -> None:
        """Change to the tool that a client requests, between two reads."""
        try:
            tool, refusal, decided = self._wanted.get_nowait()
        except Empty:
            return
        try:
            stream.use_tool(tool)
            self._transforms.use(stream.info)
        except (ConfigError, DeviceError) as error:
            refusal.append(str(error))
        finally:
            decided.set()
