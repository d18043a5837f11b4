"""From messages to poses of the flange in the base: PoseStamped, JointState with a URDF, tf."""

from collections.abc import Iterator
from typing import Any, Final, NamedTuple, Protocol

import numpy as np
from scipy.spatial.transform import Rotation

from ftdrivers.errors import ProtocolError
from ftdrivers.interfaces import Array
from ftdrivers.ros2.kinematics import Chain
from ftdrivers.ros2.subscription import is_finite, stamp_s

_UNIT_TOLERANCE: Final = 1e-3
_SPREAD_S: Final = 0.1
"""The parts of a chain of tf may differ by so much in time."""


class StampedPose(NamedTuple):
    """The flange in the base at one time."""

    t_s: float
    R_base_flange: Array
    p_base_flange_m: Array


class PoseReader(Protocol):
    """Takes messages of its topics and gives poses."""

    topics: dict[str, str]
    """Types by topic."""

    def read(self, topic: str, message: Any) -> Iterator[StampedPose]:
        """Give the poses that a message completes. Raises `ProtocolError`."""

    def missing(self) -> str:
        """Return why there is no pose yet."""


def pose_of(position: Any, quaternion: Any, what: str) -> tuple[Array, Array]:
    """Return orientation and origin of a message's parts. Raises `ProtocolError`."""
    p = position.x, position.y, position.z
    q = quaternion.x, quaternion.y, quaternion.z, quaternion.w
    if not is_finite(*p, *q):
        raise ProtocolError(f"{what} is not finite", "check its driver")
    if abs(float(np.linalg.norm(q)) - 1) > _UNIT_TOLERANCE:
        raise ProtocolError(f"{what} has a quaternion of length {np.linalg.norm(q):.3g}", "normalize it in its driver")
    return Rotation.from_quat(q).as_matrix(), np.array(p)


class Poses:
    """Poses of the flange in the base from a topic of PoseStamped."""

    def __init__(self, topic: str) -> None:
        self.topics = {topic: "geometry_msgs/msg/PoseStamped"}

    def read(self, topic: str, message: Any) -> Iterator[StampedPose]:
        """Give the pose of a message."""
        pose = pose_of(message.pose.position, message.pose.orientation, f"a pose of {topic}")
        yield StampedPose(stamp_s(message.header, topic), *pose)

    def missing(self) -> str:
        """Return that no message came."""
        return f"no message of {next(iter(self.topics))} arrived"


class Joints:
    """Poses from joint angles. Messages of other joints, such as those of a gripper, are left out."""

    def __init__(self, topic: str, chain: Chain) -> None:
        self.topics = {topic: "sensor_msgs/msg/JointState"}
        self._chain = chain
        self._seen: set[str] = set()

    def read(self, topic: str, message: Any) -> Iterator[StampedPose]:
        """Give the pose of a message that has all joints."""
        if len(message.position) != len(message.name):
            raise ProtocolError(
                f"a message of {topic} has {len(message.name)} names and {len(message.position)} positions",
                "check its driver",
            )
        self._seen |= set(message.name)
        found = dict(zip(message.name, map(float, message.position), strict=True))
        if not all(name in found for name in self._chain.names):
            return
        if not is_finite(*(found[name] for name in self._chain.names)):
            raise ProtocolError(f"a joint of {topic} is not finite", "check its driver")
        yield StampedPose(stamp_s(message.header, topic), *self._chain.pose(found))

    def missing(self) -> str:
        """Return which joints no message had."""
        lacking = [name for name in self._chain.names if name not in self._seen]
        has = ", ".join(sorted(self._seen)) or "none"
        return f"no message of {next(iter(self.topics))} has all joints; missing {', '.join(lacking)}, found {has}"


class Transforms:
    """Poses from tf: all transforms between two frames, at the time of the oldest of them that moves."""

    def __init__(self, base: str, flange: str) -> None:
        self._base, self._flange = base, flange
        self.topics = {"/tf": "tf2_msgs/msg/TFMessage", "/tf_static": "tf2_msgs/msg/TFMessage"}
        self._parts: dict[str, tuple[str, float | None, Array, Array]] = {}
        """By child: parent, time or None if it is static, orientation, origin."""
        self._last_s = 0.0

    def read(self, topic: str, message: Any) -> Iterator[StampedPose]:
        """Give the pose if the oldest part of the chain is newer than before."""
        for part in message.transforms:
            child = part.child_frame_id.lstrip("/")
            parent = part.header.frame_id.lstrip("/")
            pose = pose_of(part.transform.translation, part.transform.rotation, f"the transform {parent} to {child}")
            t_s = None if topic == "/tf_static" else stamp_s(part.header, f"{topic} ({parent} to {child})")
            self._parts[child] = parent, t_s, *pose
        chain = self._chain()
        if chain is None:
            return
        times = [t_s for _, t_s, _, _ in chain if t_s is not None]
        t_s = min(times, default=0.0)
        if not times or t_s <= self._last_s:
            return
        if max(times) - t_s > _SPREAD_S:
            if self._last_s:
                raise ProtocolError(
                    f"the transforms between {self._base} and {self._flange} are {max(times) - t_s:.2f} s apart",
                    "check that one driver publishes all of them, with one clock",
                )
            return
        self._last_s = t_s
        R, p = np.eye(3), np.zeros(3)
        for _, _, R_part, p_part in chain:
            p = p + R @ p_part
            R = R @ R_part
        yield StampedPose(t_s, R, p)

    def _chain(self) -> list[tuple[str, float | None, Array, Array]] | None:
        """Return the parts from base to flange; None while one is missing."""
        chain: list[tuple[str, float | None, Array, Array]] = []
        frame = self._flange
        while frame != self._base:
            if frame not in self._parts or len(chain) > len(self._parts):
                return None
            chain.insert(0, self._parts[frame])
            frame = self._parts[frame][0]
        return chain

    def missing(self) -> str:
        """Return where the tree is cut."""
        frames = {*self._parts, *(parent for parent, *_ in self._parts.values())}
        for frame in (self._base, self._flange):
            if frame not in frames:
                return f"tf has no frame {frame!r}; it has {', '.join(sorted(frames)) or 'none'}"
        frame = self._flange
        while frame in self._parts and frame != self._base:
            frame = self._parts[frame][0]
        if frame != self._base:
            return f"tf does not connect {self._base} with {self._flange}: nothing is above {frame}"
        return f"no transform between {self._base} and {self._flange} moves, so none has a time"
