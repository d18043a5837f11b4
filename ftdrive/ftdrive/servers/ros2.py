"""Node of `ftdrive ros2`: a compensated stream as topics, transforms, services and diagnostics.

The node follows REP 103, 105 and 107: SI units, `frame_id` for axes and origin of a wrench, stamps with the time of
measurement. During a fault, no wrench is published, and a diagnostic gives the reason.
"""

import math
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future
from contextlib import AbstractContextManager, ExitStack
from dataclasses import dataclass, field, replace
from enum import IntEnum
from functools import partial
from operator import methodcaller
from queue import Empty, SimpleQueue
from threading import Event
from typing import Any, Final

import numpy as np

from ftdrive.errors import ConfigError
from ftdrive.servers.parameters import Fixed, NodeParameters, set_stream
from ftdrive.stream.processing import SENSOR_FRAME
from ftdrive.stream.ros2 import WARNINGS, Transform, pack_transforms, pack_wrenches, transforms_of
from ftdrive.stream.samples import Block, LinkStatus, Picked, Stages, StreamEvent, StreamInfo, WrenchFrame
from ftdrive.stream.stages import stages_in_words
from ftdrive.stream.stream import Sink, Stream, pump
from ftdrivers.errors import DeviceError, NoRos2
from ftdrivers.ros2.middleware import Node, ros2_module

_TF_HZ: Final = 50.0


class TransformPublisher:
    """Publishes the frames `sensor` and `tcp` in the flange once, and the moving frames with each block.

    A frame with base axes about another point moves in the flange and is published too; base to flange only on request.
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
                f"tf2_msgs is not installed, so the transform from {fixed.flange_frame} to {fixed.sensor_frame} is not "
                "published: `ftdrive export calibration --format static-transform` writes a command that publishes it"
            )
            return
        qos = ros2_module("rclpy.qos")
        latched = qos.QoSProfile(depth=1, durability=qos.DurabilityPolicy.TRANSIENT_LOCAL)
        self._static = node.create_publisher(message, "/tf_static", latched)
        self._moving = node.create_publisher(message, "/tf", 100)

    def named(self, frame_id: str) -> str:
        """Return a frame's id with the names that the node's parameters give to sensor, flange and base."""
        return "_at_".join(self._names.get(part, part) for part in frame_id.split("_at_"))

    def use(self, info: StreamInfo) -> None:
        """Publish the transforms of the sensor and the TCP, unless the height of the sensor is unknown."""
        if np.isfinite(info.p_flange_sensor_m).all():
            _, *fixed = transforms_of(WrenchFrame(), info, np.eye(3), np.zeros(3))
            self._send(self._static, fixed, self._node.get_clock().now().nanoseconds)

    def publish(self, block: Block, info: StreamInfo, t_ns: int) -> None:
        """Publish the frames that move, as they are at the newest sample of a block."""
        if not self._picked.rows(np.array([t_ns])).any():
            return
        p_m = block.p_base_flange_m[-1]
        flange, *others = transforms_of(block.frame, info, block.R_base_flange[-1], p_m)
        moving = [one for one in others if one[1] not in ("sensor", "tcp")]
        if self._fixed.publish_base_tf and np.isfinite(p_m).all():
            moving.append(flange)
        self._send(self._moving, moving, t_ns)

    def _send(self, publisher: Any, transforms: list[Transform], t_ns: int) -> None:
        if publisher is not None and transforms:
            named = [(self.named(parent), self.named(child), p_m, R) for parent, child, p_m, R in transforms]
            publisher.publish(pack_transforms(np.array([t_ns]), named).tobytes())


class Averaged:
    """Averages consecutive samples, so many that the means come at no more than `rate_Hz`; one alone is not changed.

    If samples are lost, the mean is over the others. Samples of an interval cut by an interruption are dropped,
    because their mean would be late.
    """

    def __init__(self, sensor_rate_Hz: float, rate_Hz: float) -> None:
        # 1 % less than the quotient, because the sensor's rate is known to about 0.3 % only
        self.count = max(1, int(np.ceil(0.99 * sensor_rate_Hz / rate_Hz)))
        """Number of samples per mean."""
        self._longest_ns = 2e9 * self.count / sensor_rate_Hz
        self._waiting: Block | None = None

    def restart(self) -> None:
        """Drop the samples of the incomplete interval."""
        self._waiting = None

    def add(self, block: Block) -> Block:
        """Return the means that this block completes; columns other than wrenches are those of their first samples."""
        waiting, self._waiting = self._waiting, None
        if waiting is not None and self._continues(waiting, block):
            block = Block.concatenate([waiting, block])
        interval = block.seq // self.count
        is_first = np.diff(interval, prepend=interval[0] - 1) != 0
        # the last interval is incomplete
        if (block.seq[-1] + 1) % self.count:
            last = int(np.flatnonzero(is_first)[-1])
            self._waiting = block.rows(slice(last, None))
            block, is_first = block.rows(slice(last)), is_first[:last]
        if not len(block):
            return block
        begins = np.flatnonzero(is_first)
        n = np.diff(begins, append=len(block))
        t_ns = block.t_host_ns[begins] + np.rint(
            np.add.reduceat(block.t_host_ns - np.repeat(block.t_host_ns[begins], n), begins) / n
        ).astype(np.int64)
        raw, wrench = (np.add.reduceat(values, begins) / n[:, None] for values in (block.raw, block.wrench))
        in_contact = np.logical_or.reduceat(block.in_contact, begins)
        return replace(block.rows(is_first), t_host_ns=t_ns, raw=raw, wrench=wrench, in_contact=in_contact)

    def _continues(self, waiting: Block, block: Block) -> bool:
        is_alike = waiting.frame == block.frame and waiting.stages == block.stages
        return bool(is_alike and block.t_host_ns[0] - waiting.t_host_ns[-1] < self._longest_ns)


class Level(IntEnum):
    """Levels of diagnostic_msgs/DiagnosticStatus."""

    OK, WARN, ERROR, STALE = range(4)


@dataclass(frozen=True, slots=True)
class PartState:
    """State of one part of the node: "stream", "sensor", "arm" or "calibration"."""

    part: str
    level: Level
    text: str
    values: Mapping[str, str] = field(default_factory=dict)
    hardware: str = ""

    def message(self, node: str) -> Any:
        """Return the state as a DiagnosticStatus."""
        messages = ros2_module("diagnostic_msgs.msg")
        return messages.DiagnosticStatus(
            level=bytes([self.level]),
            name=f"{node}: {self.part}",
            message=self.text,
            hardware_id=self.hardware,
            values=[messages.KeyValue(key=key, value=value) for key, value in self.values.items()],
        )


def reports_of(stream: Stream, lost_before: int, sent: int) -> list[PartState]:
    """Return the state of each part of a stream's node; `lost_before` is the count of lost samples a report earlier."""
    status, info = stream.status(), stream.info
    verdict, stages = info.calibration.verdict, stages_in_words(stream.stages)
    values = {
        "axes": stream.frame.axes,
        "about": str(stream.frame.to_dict()["about"]),
        "stages": stages,
        "tool": info.tool,
        "calibration": str(info.calibration.id),
        "verdict": verdict,
        "tare": "none" if status.tare is None else " ".join(f"{value:.6g}" for value in status.tare),
        "delay_s": f"{status.delay_s:.6g}",
        "delay_sigma_s": f"{status.delay_sigma_s:.6g}",
        "drift_N_h": f"{status.drift_N_h:.6g}",
        "messages_sent": str(sent),
    }
    doubts = [*info.marks, *stream.warnings]
    level = Level.ERROR if verdict == "rejected" else Level.WARN if doubts else Level.OK
    text = "; ".join(doubts) or info.calibration_state
    words = status.failure or f"{stream.frame}; {stages}"
    return [
        PartState("stream", Level.ERROR if status.failure else Level.OK, words, values),
        _link_state("sensor", status.sensor, info.sensor, status.sensor.lost - lost_before),
        _link_state("arm", status.arm, info.arm, 0),
        PartState("calibration", level, text, {"file": info.calibration_name, "verdict": verdict}),
    ]


def _link_state(part: str, link: LinkStatus, device: Any, lost: int) -> PartState:
    values = {"rate_Hz": f"{link.rate_Hz:.1f}", "lost": str(link.lost), "age_s": f"{link.age_s:.3f}"}
    if link.error:
        level, text = Level.ERROR, link.error
    elif lost > 0:
        level, text = Level.WARN, f"{lost} samples lost since the last report"
    else:
        level, text = Level.OK, f"{link.rate_Hz:.0f} Hz"
    return PartState(part, level, text, values, f"{device.model} {device.serial}")


NAME: Final = "ftdrive"
REPORT_S: Final = 0.4
"""Time between two reports of the node's state, s; a fault is reported at once."""
# Samples are processed in blocks of this duration, s, which is the maximum delay of a message.
_BLOCK_S: Final = 0.008
_CONTACT_S: Final = 0.1
# Waiting time, s, in which the ROS nodes of this computer and network are discovered.
_DISCOVERY_S: Final = 1.0
# Waiting time before a device that failed to open is tried again, s.
_RETRY_S: Final = 2.0
# The same, s, if the calibration does not fit the devices: the operator must calibrate or select another tool.
_RETRY_CONFIG_S: Final = 10.0
# History of a reliable topic, s, because Fast DDS requests lost messages every 3 s.
_HISTORY_S: Final = 10.0
_TOOL_S: Final = 5.0


class Ros2Node(Sink):
    """Node that publishes a stream until it is closed.

    Parameters
    ----------
    arguments : sequence of str
        ROS arguments, such as ``("--ros-args", "-r", "__ns:=/cell_1", "-p", "axes:=base")``.
    frame : WrenchFrame
        Frame of `~/wrench`, unless the ROS arguments set another one.
    tool : str
        Name of the tool; empty with a given calibration.

    Raises
    ------
    NoRos2
        rclpy cannot be imported, or does not understand the arguments.
    ConfigError
        A parameter cannot be used, or a node with this name is already running.
    """

    label, keeps_all = "node", True

    def __init__(self, arguments: Sequence[str] = (), *, frame: WrenchFrame = SENSOR_FRAME, tool: str = "") -> None:
        wrench = ros2_module("geometry_msgs.msg").WrenchStamped
        trigger = ros2_module("std_srvs.srv").Trigger
        self._bool = ros2_module("std_msgs.msg").Bool
        self._diagnostics = ros2_module("diagnostic_msgs.msg")
        self._stream: Stream | None = None
        # Tools requested by clients, with the future of the decision.
        self._wanted = SimpleQueue[tuple[str, Future[None]]]()
        self._failure, self._reported, self._reported_s, self._lost = "", list[PartState](), 0.0, 0
        self._in_contact, self._contact_s, self.sent = False, 0.0, 0
        self._ros = Node(NAME, arguments)
        self.node = node = self._ros.node
        with ExitStack() as stack:
            stack.callback(self._ros.close)
            self._log = node.get_logger()
            self.parameters = NodeParameters(node, frame, tool)
            self.parameters.apply = self._apply
            self.fixed = self.parameters.fixed
            self._require_alone()
            qos = ros2_module("rclpy.qos")
            quality = qos.qos_profile_sensor_data
            if self.fixed.reliable:
                depth = max(10, round(_HISTORY_S * self.fixed.rate))
                quality = qos.QoSProfile(depth=depth, reliability=qos.ReliabilityPolicy.RELIABLE)
            self._raw = node.create_publisher(wrench, "~/wrench_raw", quality)
            self._compensated = node.create_publisher(wrench, "~/wrench", quality)
            self._contact = node.create_publisher(self._bool, "~/contact", 10)
            self._status = node.create_publisher(self._diagnostics.DiagnosticStatus, "~/status", 10)
            self._overall = node.create_publisher(self._diagnostics.DiagnosticArray, "/diagnostics", 10)
            node.create_service(trigger, "~/tare", partial(self._answer, methodcaller("tare")))
            node.create_service(trigger, "~/undo_tare", partial(self._answer, methodcaller("undo_tare")))
            self._transforms = TransformPublisher(node, self.fixed)
            self._ros.spin()
            stack.pop_all()

    def _require_alone(self) -> None:
        received = Event()
        # A killed node stays in the list of nodes for up to 20 s, so a running node is recognised by its reports.
        subscription = self.node.create_subscription(
            self._diagnostics.DiagnosticStatus, "~/status", lambda _: received.set(), 10
        )
        begin_s, wait_s = time.monotonic(), _DISCOVERY_S
        while not received.is_set() and time.monotonic() - begin_s <= wait_s:
            self._ros.spin_once(0.05)
            is_listed = self.node.count_publishers(subscription.topic_name) > 0
            wait_s = _DISCOVERY_S + 3 * REPORT_S if is_listed else _DISCOVERY_S
        self.node.destroy_subscription(subscription)
        if received.is_set():
            raise ConfigError(
                f"a node {self.name} is already running: stop it, or give this one another name: "
                f"--ros-args -r __node:={NAME}_2"
            )

    @property
    def name(self) -> str:
        """Name of the node with its namespace."""
        return str(self.node.get_fully_qualified_name())

    def close(self) -> None:
        """Leave the ROS graph."""
        self._ros.close()

    # -------------------------------------------------------------------------------------------------------- serving

    def serve(self, open_stream: Callable[[], AbstractContextManager[Stream]]) -> None:
        """Open and publish the stream, again after each failure, until an exception such as Ctrl-C."""
        while True:
            try:
                self._report([PartState("stream", Level.STALE, "opening the devices")])
                with open_stream() as stream:
                    for _ in pump(stream, [self], patience_s=math.inf):
                        self._ros.check()
                        self._change_tool(stream)
            except (ConfigError, DeviceError) as error:
                self._fail(str(error))
                wait_s = _RETRY_S if isinstance(error, DeviceError) else _RETRY_CONFIG_S
                for _ in range(round(wait_s / REPORT_S)):
                    self._report([PartState("stream", Level.ERROR, str(error))])
                    time.sleep(REPORT_S)

    def begin(self, stream: Stream) -> None:
        """Publish this stream from now on."""
        self._lost = stream.status().sensor.lost
        self._averaged = Averaged(stream.info.sensor_rate_Hz, self.fixed.rate)
        self._transforms.use(stream.info)
        stream.frame, stream.stages = self.parameters.frame, self.parameters.stages
        stream.devices.block_s = _BLOCK_S
        self._stream = stream
        if self._failure:
            self._failure = ""
            self._log.info("The devices are open.")

    def end(self) -> None:
        """Stop publishing the stream."""
        self._stream = None

    def add(self, block: Block | None, events: Sequence[StreamEvent]) -> None:
        """Publish samples or a device failure, and log events."""
        if (stream := self._stream) is not None and block:
            self._failure = ""
            self._publish(block, stream.info)
        elif stream is not None and (failure := stream.status().failure):
            self._averaged.restart()
            self._fail(failure)
            self.report()
        for event in events:
            # two calls, because rclpy raises ValueError if one call has two severities
            if event.kind in WARNINGS:
                self._log.warning(event.text)
            else:
                self._log.info(event.text)

    def _publish(self, block: Block, info: StreamInfo) -> None:
        means, now_s = self._averaged.add(block), time.monotonic()
        if means:
            t_ns = means.t_host_ns + info.utc_offset_ns
            frame_id = self._transforms.named(block.frame.id)
            for publisher, wrench, frame in (
                (self._raw, means.raw, self.fixed.sensor_frame),
                (self._compensated, means.wrench, frame_id),
            ):
                if publisher.get_subscription_count():
                    for message in pack_wrenches(t_ns, wrench, frame).tolist():
                        publisher.publish(message)
            self.sent += len(t_ns)
            in_contact = bool(means.in_contact[-1])
            if in_contact != self._in_contact or now_s - self._contact_s >= _CONTACT_S:
                self._in_contact, self._contact_s = in_contact, now_s
                self._contact.publish(self._bool(data=in_contact))
            self._transforms.publish(block, info, int(t_ns[-1]))
        if now_s - self._reported_s >= REPORT_S:
            self.report()

    # ------------------------------------------------------------------------------------------------------- reporting

    def _fail(self, text: str) -> None:
        if text != self._failure:
            self._failure = text
            self._log.error(text)

    def report(self) -> None:
        """Publish the state of the stream in diagnostics and status."""
        if (stream := self._stream) is not None:
            self._report(reports_of(stream, self._lost, self.sent))
            self._lost = stream.status().sensor.lost

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

    # ------------------------------------------------------------------------------------------------------- requests

    def _answer(self, action: Callable[[Stream], StreamEvent], _: Any, response: Any) -> Any:
        stream = self._stream
        if stream is None or self._failure:
            why = self._failure or "the node is still opening the devices"
            response.success, response.message = False, f"refused: {why}"
        else:
            event = action(stream)
            response.success, response.message = event.kind != "tare-refused", event.text
        return response

    def _apply(self, frame: WrenchFrame, stages: Stages, tool: str) -> None:
        """Apply new parameters in the node's thread. If one cannot be used, raise `ConfigError` and change none."""
        if self._stream is not None:
            set_stream(self._stream, frame, stages, partial(self._request_tool, tool))

    def _request_tool(self, tool: str) -> None:
        if tool == self.parameters.tool:
            return
        if not tool:
            raise ConfigError("tool cannot be empty while the node runs: set the name of a tool")
        decided = Future[None]()
        self._wanted.put((tool, decided))
        try:
            decided.result(_TOOL_S)
        except TimeoutError:
            why = f"tool {tool!r} was not applied within {_TOOL_S:g} s, because no samples arrive: check the devices"
            raise ConfigError(why) from None

    def _change_tool(self, stream: Stream) -> None:
        try:
            tool, decided = self._wanted.get_nowait()
        except Empty:
            return
        try:
            stream.use_tool(tool)
            self._transforms.use(stream.info)
            decided.set_result(None)
        except (ConfigError, DeviceError) as error:
            decided.set_exception(ConfigError(str(error)))
