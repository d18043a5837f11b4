"""Messages and a graph of ROS 2 in memory, on a fake clock: plain objects instead of rclpy."""

from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import pytest

from tests.fake_clock import FakeClock

RELIABLE, BEST_EFFORT = "reliable", "best effort"


def header(t_s: float, frame: str = "base") -> Any:
    sec, nanosec = divmod(round(t_s * 1e9), 10**9)
    return SimpleNamespace(stamp=SimpleNamespace(sec=sec, nanosec=nanosec), frame_id=frame)


def vector(*values: float) -> Any:
    return SimpleNamespace(**dict(zip("xyzw", values, strict=False)))


def pose(t_s: float = 5.0, p: Any = (0, 0, 1), q: Any = (0, 0, 0, 1)) -> Any:
    return SimpleNamespace(header=header(t_s), pose=SimpleNamespace(position=vector(*p), orientation=vector(*q)))


def joints(t_s: float, names: list[str], position: Any) -> Any:
    return SimpleNamespace(header=header(t_s), name=names, position=position)


def tf(*parts: tuple[float, str, str], q: Any = (0, 0, 0, 1)) -> Any:
    moved = SimpleNamespace(translation=vector(0, 0, 1), rotation=vector(*q))
    made = [
        SimpleNamespace(header=header(t, parent), child_frame_id=child, transform=moved) for t, parent, child in parts
    ]
    return SimpleNamespace(transforms=made)


def wrench(t_s: float = 5.0, frame: str = "ft", fx: float = 1.0) -> Any:
    parts = SimpleNamespace(force=vector(fx, 2, 3), torque=vector(4, 5, 6))
    return SimpleNamespace(header=header(t_s, frame), wrench=parts)


class Graph:
    """A node, which is its own rclpy node, and the publishers around it."""

    def __init__(self, clock: FakeClock) -> None:
        self.node, self.clock = self, clock
        self.publishers: dict[str, list[Any]] = {}
        self.profiles: dict[str, Any] = {}
        """Of the subscriptions."""
        self.kinds: dict[str, str] = {}
        self.is_closed = False
        self.nodes = 0
        """Made so far."""
        self.wall_ahead_s = 0.0
        """The clock of this computer is so much ahead of the driver's."""
        self._callbacks: dict[str, Callable[..., None]] = {}

    def add(
        self, topic: str, kind: str, name: str = "driver", *, space: str = "/", reliability: str = BEST_EFFORT
    ) -> None:
        """Add a publisher."""
        one = SimpleNamespace(
            node_name=name,
            node_namespace=space,
            topic_type=kind,
            qos_profile=SimpleNamespace(reliability=reliability),
        )
        self.publishers[topic] = [*self.publishers.get(topic, []), one]

    def publish(self, topic: str, message: Any, info: Any = None) -> None:
        """Send a message with what the middleware says about it, which tf does not look at."""
        if topic in self._callbacks and not self.is_closed:
            self._callbacks[topic](*([message] if topic.startswith("/tf") else [message, info]))

    def later(self, delay_s: float, topic: str, message: Any) -> None:
        self.clock.at(delay_s, lambda: self.publish(topic, message))

    def create_node(self, _name: str) -> "Graph":
        self.is_closed = False
        self.nodes += 1
        return self

    def spin(self) -> None: ...

    def check(self) -> None: ...

    def close(self) -> None:
        self.is_closed = True

    def get_publishers_info_by_topic(self, topic: str) -> list[Any]:
        return self.publishers.get(topic, [])

    def get_topic_names_and_types(self) -> list[tuple[str, list[str]]]:
        return [(topic, [one.topic_type for one in found]) for topic, found in self.publishers.items()]

    def create_subscription(self, kind: str, topic: str, callback: Callable[..., None], profile: Any) -> None:
        self._callbacks[topic], self.kinds[topic], self.profiles[topic] = callback, kind, profile

    def get_clock(self) -> Any:
        t_ns = self.clock.now_ns() + round(self.wall_ahead_s * 1e9)
        return SimpleNamespace(now=lambda: SimpleNamespace(nanoseconds=t_ns))


class _Messages:
    """A package of messages, whose classes are their own names."""

    def __getattr__(self, name: str) -> str:
        return name


def install(graph: Graph, monkeypatch: pytest.MonkeyPatch) -> None:
    """Put a graph in place of rclpy."""
    qos = SimpleNamespace(
        ReliabilityPolicy=SimpleNamespace(RELIABLE=RELIABLE, BEST_EFFORT=BEST_EFFORT),
        DurabilityPolicy=SimpleNamespace(TRANSIENT_LOCAL="kept", VOLATILE="not kept"),
        QoSProfile=SimpleNamespace,
    )
    modules = {"rclpy.qos": qos}
    monkeypatch.setattr("ftdrivers.ros2.middleware.ros2_module", lambda name: modules.get(name, _Messages()))
    for module in ("arm", "sensor"):
        monkeypatch.setattr(f"ftdrivers.ros2.{module}.Node", graph.create_node)
