"""A ROS 2 node and its subscriptions.

Reason: docs/decisions/sensors.md, 179.
"""

import importlib
import math
import os
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from threading import Thread
from typing import Any, Final, NamedTuple

from ftdrivers.clock import Clock
from ftdrivers.errors import ConnectError, NoRos2, ProtocolError
from ftdrivers.installation import install_command
from ftdrivers.interfaces import Diagnosis

# Variables that name the user's profiles of Fast DDS. It also reads DEFAULT_FASTDDS_PROFILES.xml in the current folder.
_PROFILES: Final = {"FASTDDS_DEFAULT_PROFILES_FILE", "FASTRTPS_DEFAULT_PROFILES_FILE"}


def ros2_module(name: str) -> Any:
    """Import a ROS 2 module, such as "rclpy" or "geometry_msgs.msg". Raises `NoRos2` if it is missing."""
    # The ROS wheels restart Python to set LD_LIBRARY_PATH (30 ms). They lack tf2_msgs, so tf needs a sourced ROS.
    try:
        return importlib.import_module(name)
    except ImportError as error:
        package = name.partition(".")[0]
        raise NoRos2(
            f"Python cannot import {package} ({error}): source ROS 2 (`source /opt/ros/jazzy/setup.bash`, with ftdrive "
            f"in a venv of its Python with --system-site-packages), or on Linux x86-64 `{install_command('ros2')}`"
        ) from error


def _stay_on_loopback() -> None:
    """Make Fast DDS bind its ports to loopback if ROS is configured for this computer only."""
    # The discovery range alone leaves the ports open on all interfaces. A profile of the user takes precedence.
    if os.environ.get("ROS_AUTOMATIC_DISCOVERY_RANGE") != "LOCALHOST" or _PROFILES & os.environ.keys():
        return
    if not Path("DEFAULT_FASTDDS_PROFILES.xml").exists():
        os.environ["FASTDDS_DEFAULT_PROFILES_FILE"] = str(Path(__file__).with_name("loopback.xml"))


class Node:
    """A ROS 2 node with a context of its own; callbacks run in the thread of the node between `spin` and `close`.

    Parameters
    ----------
    name : str
        Name of the node, which `arguments` may replace.
    arguments : sequence of str
        ROS arguments, beginning with ``--ros-args``: remapping, parameters, namespace.

    Raises
    ------
    NoRos2
        rclpy is missing, or does not understand the arguments.
    """

    def __init__(self, name: str, arguments: Sequence[str] = ()) -> None:
        rclpy = ros2_module("rclpy")
        self._executors = ros2_module("rclpy.executors")
        _stay_on_loopback()
        self.context = rclpy.Context()
        try:
            rclpy.init(args=["ftdrive", *arguments], context=self.context)  # own context: installs no signal handlers
            self.node = rclpy.create_node(name, context=self.context)
        except Exception as error:  # rclpy raises its own exceptions, some of them private
            with suppress(Exception):
                self.context.try_shutdown()
            first = next(iter(str(error).splitlines()), "")
            words = " ".join(arguments) or "none"
            raise NoRos2(f"ROS 2 does not start with the arguments {words}: {first}: correct them") from error
        self._executor = self._executors.SingleThreadedExecutor(context=self.context)
        self._executor.add_node(self.node)
        self._thread: Thread | None = None
        self._failure: Exception | None = None

    def spin(self) -> None:
        """Start the thread that calls the callbacks of the subscriptions."""
        self._thread = Thread(target=self._spin, name=f"ROS 2 of {self.node.get_name()}", daemon=True)
        self._thread.start()

    def spin_once(self, timeout_s: float) -> None:
        """Call one callback if one is due within `timeout_s`. Use this method only before `spin`."""
        self._executor.spin_once(timeout_sec=timeout_s)

    def _spin(self) -> None:
        try:
            self._executor.spin()
        except (self._executors.ExternalShutdownException, self._executors.ShutdownException):
            pass  # another thread has closed the node meanwhile
        except Exception as error:
            self._failure = error

    def check(self) -> None:
        """Raise the exception of a callback, after which no further callback is called."""
        if self._failure is not None:
            raise self._failure

    def close(self) -> None:
        """Stop the thread and leave the ROS graph. Idempotent."""
        if self.context.ok():
            self._executor.shutdown()
            if self._thread is not None:
                self._thread.join(1.0)
            self.node.destroy_node()
            self.context.try_shutdown()


DISCOVERY_S: Final = 3.0
"""Time-out until the publishers of a topic are known, s."""
_SAME_CLOCK_MS: Final = 2.0
# A time stamp older than this by the clock of this computer must be from another clock.
_LONGEST_WAY_MS: Final = 30.0
# Time after the first publisher of a topic within which a second one is discovered too.
_OTHERS_S: Final = 0.5
# Interval between two checks whether another node publishes the same topic, s.
_LOOK_S: Final = 1.0
_UNNAMED: Final = "NAME_UNKNOWN"
_UNNUMBERED: Final = (1 << 64) - 1


class Received(NamedTuple):
    """A received message with its sequence number and time of receipt."""

    message: Any
    t_host_ns: int
    number: int
    """Sequence number of the publisher, where lost messages are gaps; counted here if the middleware gives none."""


def subscribe(
    ros: Node, topic: str, kind: str, on_message: Callable[[Received], None], clock: Clock, *, reliable: bool = False
) -> str:
    """Wait for the one publisher of a topic, and receive its messages from now on, in the thread of the node.

    Parameters
    ----------
    ros : Node
    topic : str
    kind : str
        Message type, such as "geometry_msgs/msg/WrenchStamped".
    reliable : bool
        Request reliable delivery, which the publisher must offer.

    Returns
    -------
    str
        Name of the publishing node.

    Raises
    ------
    ConnectError
        No node publishes the topic, its type is different, or the publisher offers only best effort.
    ProtocolError
        Two nodes publish the topic.
    """
    package, _, name = kind.partition("/msg/")
    message_type = getattr(ros2_module(f"{package}.msg"), name)
    publisher = _publisher(ros, topic, kind, clock, reliable=reliable)
    qos = ros2_module("rclpy.qos")
    reliability = qos.ReliabilityPolicy.RELIABLE if reliable else qos.ReliabilityPolicy.BEST_EFFORT
    profile = qos.QoSProfile(depth=1000, reliability=reliability)
    count = 0

    def received(message: Any, info: Any) -> None:
        nonlocal count
        t_host_ns = clock.now_ns()
        count += 1
        number = _number(info)
        on_message(Received(message, t_host_ns, count if number is None else number))

    ros.node.create_subscription(message_type, topic, received, profile)
    return publisher


def subscribe_to_tf(ros: Node, topic: str, on_message: Callable[[Received], None], clock: Clock) -> None:
    """Receive /tf or /tf_static, which many nodes publish. Raises `NoRos2` if tf2_msgs is missing."""
    qos = ros2_module("rclpy.qos")
    is_static = topic == "/tf_static"
    profile = qos.QoSProfile(
        depth=1000,
        reliability=qos.ReliabilityPolicy.RELIABLE if is_static else qos.ReliabilityPolicy.BEST_EFFORT,
        durability=qos.DurabilityPolicy.TRANSIENT_LOCAL if is_static else qos.DurabilityPolicy.VOLATILE,
    )
    message_type = ros2_module("tf2_msgs.msg").TFMessage
    ros.node.create_subscription(
        message_type, topic, lambda message: on_message(Received(message, clock.now_ns(), 0)), profile
    )


def clock_diagnosis(ros: Node, newest_s: float) -> Diagnosis:
    """Compare the newest stamp with the clock of this computer."""
    behind_ms = 1e3 * (ros.node.get_clock().now().nanoseconds * 1e-9 - newest_s)
    if -_SAME_CLOCK_MS < behind_ms < _LONGEST_WAY_MS:
        return Diagnosis("clock", True, f"the newest stamp is {behind_ms:.1f} ms old by the clock of this computer")
    where = f"{behind_ms:.0f} ms behind" if behind_ms > 0 else f"{-behind_ms:.0f} ms ahead of"
    found = f"the stamps come from another clock, {where} that of this computer; the delay is estimated from motion"
    return Diagnosis("clock", True, found)


def _number(info: Any) -> int | None:
    """Return the publisher's sequence number of a message; rclpy passes a mapping, or before Jazzy an object."""
    found = info.get("publication_sequence_number") if isinstance(info, Mapping) else None
    return None if found is None or found >= _UNNUMBERED else int(found)


def _publisher(ros: Node, topic: str, kind: str, clock: Clock, *, reliable: bool) -> str:
    found: list[Any] = []
    for _ in clock.looks(DISCOVERY_S):
        found = ros.node.get_publishers_info_by_topic(topic)
        if found and not any(_UNNAMED in one.node_name for one in found):  # names of nodes arrive after their topics
            clock.sleep(_OTHERS_S)
            found = ros.node.get_publishers_info_by_topic(topic)
            break
        clock.sleep(0.05)
    kinds, names = sorted({one.topic_type for one in found}), _names(found)
    if not found:
        same = [name for name, types in ros.node.get_topic_names_and_types() if kind in types and name != topic]
        others = f"topics of this type: {', '.join(same)}" if same else "no topic has this type"
        domain = "check the name, ROS_DOMAIN_ID and that its driver is running"
        raise ConnectError(f"no node publishes {topic} ({kind}); {others}", domain)
    if kinds != [kind]:
        raise ConnectError(f"{topic} has the type {', '.join(kinds)}, but {kind} is needed", "give another topic")
    OnePublisher(ros, topic, clock).check()
    best_effort = ros2_module("rclpy.qos").ReliabilityPolicy.BEST_EFFORT
    if reliable and found[0].qos_profile.reliability == best_effort:
        raise ConnectError(f"{topic} is published with best effort only", "leave the option reliable out")
    return names[0]


class OnePublisher:
    """Checks repeatedly whether another node publishes a topic too; some nodes are discovered after seconds."""

    def __init__(self, ros: Node, topic: str, clock: Clock) -> None:
        self._ros, self._topic, self._clock = ros, topic, clock
        self._looked_s = -math.inf

    def check(self, *, in_order: bool = True) -> None:
        """Raise `ProtocolError` if there is another publisher; stamps out of order are a reason to check at once."""
        if in_order and self._clock.now_s() - self._looked_s < _LOOK_S:
            return
        self._looked_s = self._clock.now_s()
        names = _names(self._ros.node.get_publishers_info_by_topic(self._topic))
        if len(names) > 1:
            raise ProtocolError(
                f"{len(names)} nodes publish {self._topic}: {', '.join(names)}", "stop all but one of them"
            )


def _names(publishers: Sequence[Any]) -> list[str]:
    return sorted(
        "a program without a node" if _UNNAMED in one.node_name else f"{one.node_namespace.rstrip('/')}/{one.node_name}"
        for one in publishers
    )


def stamp_ns(header: Any, topic: str) -> int:
    """Return the time of a header in nanoseconds. Raises `ProtocolError` if it was not set."""
    t_ns = int(header.stamp.sec) * 1_000_000_000 + int(header.stamp.nanosec)
    if t_ns <= 0:
        raise ProtocolError(
            f"the messages of {topic} have the stamp {t_ns * 1e-9:g}, so they cannot be paired",
            "set header.stamp to the time of measurement in its driver",
        )
    return t_ns
