"""Flange poses from topics: pose messages, joint states with a URDF, or transforms."""

import xml.etree.ElementTree as ET
from collections.abc import Iterator, Mapping
from difflib import get_close_matches
from pathlib import Path
from typing import Any, Final, NamedTuple, Protocol

import numpy as np
from scipy.spatial.transform import Rotation

from ftdrivers.errors import BadUrl, ProtocolError
from ftdrivers.interfaces import Array
from ftdrivers.ros2.middleware import stamp_ns

# Largest size of a URDF, bytes. Meshes are separate files.
_LARGEST: Final = 16_000_000
_MOVES: Final = ("revolute", "continuous", "prismatic")


class _Joint(NamedTuple):
    name: str
    kind: str
    parent: str
    R: Array
    p: Array
    axis: Array


class Chain:
    """The kinematic chain from a base to a flange.

    Parameters
    ----------
    path : Path
        A URDF file without xacro.
    base, flange : str
        Names of links. An empty base selects the root.

    Raises
    ------
    BadUrl
        The file is not a URDF, a link does not exist, or the flange is not a descendant of the base.
    """

    def __init__(self, path: Path, base: str, flange: str) -> None:
        try:
            with path.open("rb") as file:
                root = ET.fromstring(file.read(_LARGEST).decode())  # safe to parse: the file is on the user's own disk
        except (OSError, UnicodeDecodeError, ET.ParseError) as error:
            raise BadUrl(f"{path} is not a URDF ({error}): give the file with xacro evaluated") from error
        joints = {}
        try:
            for element in root.iter("joint"):
                if (child := element.find("child")) is not None:
                    joints[child.attrib["link"]] = _joint(element)
        except (KeyError, ValueError, TypeError) as error:
            raise BadUrl(f"{path}: a joint cannot be read ({error!r}): correct the URDF") from error
        links = [link.attrib.get("name", "") for link in root.iter("link")]
        for link in (flange, *([base] if base else [])):
            if link not in links:
                near = get_close_matches(link, links, 1)
                hint = f"did you mean {near[0]}?" if near else f"it has {', '.join(links[:20])}"
                raise BadUrl(f"{path} has no link {link!r}: {hint}")
        self._joints: list[_Joint] = []
        link = flange
        while link != base and link in joints and len(self._joints) <= len(joints):
            self._joints.insert(0, joints[link])
            link = joints[link].parent
        if base and link != base:
            raise BadUrl(f"{path}: {flange} is not a descendant of {base}: swap the two, or give another base")
        self.names = [joint.name for joint in self._joints if joint.kind in _MOVES]
        if not self.names:
            raise BadUrl(f"{path}: no joint moves between {base or link} and {flange}: give other links")

    def poses(self, positions: Mapping[str, Array]) -> tuple[Array, Array]:
        """Return orientations (n, 3, 3) and origins (n, 3) of the flange in the base.

        `positions` has the joint positions (n,) by name, rad or m.
        """
        n = len(positions[self.names[0]])
        R, p = np.tile(np.eye(3), (n, 1, 1)), np.zeros((n, 3))
        for joint in self._joints:
            p = p + R @ joint.p
            R = R @ joint.R
            if joint.kind == "prismatic":
                p = p + np.einsum("nij,nj->ni", R, np.outer(positions[joint.name], joint.axis))
            elif joint.kind in _MOVES:
                R = R @ Rotation.from_rotvec(np.outer(positions[joint.name], joint.axis)).as_matrix()
        return R, p


def _joint(element: ET.Element) -> _Joint:
    origin, axis, parent = element.find("origin"), element.find("axis"), element.find("parent")
    place = {} if origin is None else origin.attrib
    kind = element.attrib["type"]
    if kind not in (*_MOVES, "fixed"):
        raise ValueError(f"joint {element.attrib['name']} is {kind}")
    direction = _numbers("1 0 0" if axis is None else axis.attrib["xyz"])
    if parent is None:
        raise ValueError(f"joint {element.attrib['name']} has no parent")
    return _Joint(
        element.attrib["name"],
        kind,
        parent.attrib["link"],
        Rotation.from_euler("xyz", _numbers(place.get("rpy", "0 0 0"))).as_matrix(),
        _numbers(place.get("xyz", "0 0 0")),
        direction / np.linalg.norm(direction),
    )


def _numbers(text: str) -> Array:
    found = np.array([float(word) for word in text.split()])
    if found.shape != (3,) or not np.isfinite(found).all():
        raise ValueError(f"{text!r} is not three numbers")
    return found


UNIT_TOLERANCE: Final = 1e-3
"""Largest difference between the norm of a quaternion and 1."""
# Largest difference between the time stamps of the transforms from base to flange.
_SPREAD_NS: Final = 100_000_000


class StampedPose(NamedTuple):
    """Pose of the flange in the base at one time."""

    t_ns: int
    R_base_flange: Array
    p_base_flange_m: Array


class PoseReader(Protocol):
    """Converts the messages of its topics to poses of the flange in the base."""

    topics: dict[str, str]
    """Message type of each topic to which the reader needs a subscription."""

    def read(self, topic: str, message: Any) -> Iterator[StampedPose]:
        """Yield the poses that a message completes. Raises `ProtocolError` for an invalid pose, joint or time stamp."""

    def missing(self) -> str:
        """Return a sentence that gives the reason why there is no pose yet."""


def _pose_of(position: Any, quaternion: Any, what: str) -> tuple[Array, Array]:
    """Return rotation matrix and position. Raises `ProtocolError` if not finite, or if the quaternion is no unit."""
    p = position.x, position.y, position.z
    q = quaternion.x, quaternion.y, quaternion.z, quaternion.w
    if not np.isfinite((*p, *q)).all():
        raise ProtocolError(f"{what} is not finite", "check the driver that publishes it")
    if abs(float(np.linalg.norm(q)) - 1) > UNIT_TOLERANCE:
        raise ProtocolError(f"{what} has a quaternion of norm {np.linalg.norm(q):.3g}", "normalize it in its driver")
    return Rotation.from_quat(q).as_matrix(), np.array(p)


class Poses:
    """Poses of the flange in the base from a PoseStamped topic."""

    def __init__(self, topic: str) -> None:
        self.topics = {topic: "geometry_msgs/msg/PoseStamped"}

    def read(self, topic: str, message: Any) -> Iterator[StampedPose]:
        """Yield the flange pose that a PoseStamped message contains."""
        pose = _pose_of(message.pose.position, message.pose.orientation, f"a pose of {topic}")
        yield StampedPose(stamp_ns(message.header, topic), *pose)

    def missing(self) -> str:
        """Return a sentence: no message of the topic arrived."""
        return f"no message of {next(iter(self.topics))} arrived"


class Joints:
    """Poses from joint angles. Messages of other joints, such as those of a gripper, are ignored."""

    def __init__(self, topic: str, chain: Chain) -> None:
        self.topics = {topic: "sensor_msgs/msg/JointState"}
        self.chain = chain
        self._seen: set[str] = set()

    def positions(self, topic: str, message: Any) -> dict[str, float] | None:
        """Return the joint positions of the chain, None for other joints; raise `ProtocolError` if they are invalid."""
        if len(message.position) != len(message.name):
            raise ProtocolError(
                f"a message of {topic} has {len(message.name)} names and {len(message.position)} positions",
                "check its driver",
            )
        self._seen |= set(message.name)
        found = dict(zip(message.name, map(float, message.position), strict=True))
        if not all(name in found for name in self.chain.names):
            return None
        if not np.isfinite([found[name] for name in self.chain.names]).all():
            raise ProtocolError(f"a joint of {topic} is not finite", "check its driver")
        return {name: found[name] for name in self.chain.names}

    def read(self, topic: str, message: Any) -> Iterator[StampedPose]:
        """Yield the pose of a message that has all joints."""
        if (found := self.positions(topic, message)) is not None:
            R, p = self.chain.poses({name: np.array([value]) for name, value in found.items()})
            yield StampedPose(stamp_ns(message.header, topic), R[0], p[0])

    def missing(self) -> str:
        """Return a sentence naming the joints of the chain that were missing in all messages."""
        lacking = [name for name in self.chain.names if name not in self._seen]
        has = ", ".join(sorted(self._seen)) or "none"
        return f"no message of {next(iter(self.topics))} has all joints; missing {', '.join(lacking)}, found {has}"


class Transforms:
    """Poses from tf: the product of the transforms between two frames, at the time of the oldest one that moves."""

    def __init__(self, base: str, flange: str) -> None:
        self._base, self._flange = base, flange
        self.topics = {"/tf": "tf2_msgs/msg/TFMessage", "/tf_static": "tf2_msgs/msg/TFMessage"}
        # Newest transforms by child frame: parent, time (None if static), orientation and origin.
        self._parts: dict[str, tuple[str, int | None, Array, Array]] = {}
        self._last_ns = 0

    def read(self, topic: str, message: Any) -> Iterator[StampedPose]:
        """Yield a pose if the oldest transform of the chain is newer than before."""
        for part in message.transforms:
            child = part.child_frame_id.lstrip("/")
            parent = part.header.frame_id.lstrip("/")
            pose = _pose_of(part.transform.translation, part.transform.rotation, f"the transform {parent} to {child}")
            t_ns = None if topic == "/tf_static" else stamp_ns(part.header, f"{topic} ({parent} to {child})")
            self._parts[child] = parent, t_ns, *pose
        chain = self._chain()
        if chain is None:
            return
        times = [t_ns for _, t_ns, _, _ in chain if t_ns is not None]
        oldest_ns = min(times, default=0)
        if not times or oldest_ns <= self._last_ns:
            return
        if max(times) - oldest_ns > _SPREAD_NS:
            if self._last_ns:
                apart_s = 1e-9 * (max(times) - oldest_ns)
                raise ProtocolError(
                    f"the transforms between {self._base} and {self._flange} are {apart_s:.2f} s apart",
                    "check that one driver publishes all of them, with one clock",
                )
            return
        self._last_ns = oldest_ns
        R, p = np.eye(3), np.zeros(3)
        for _, _, R_part, p_part in chain:
            p = p + R @ p_part
            R = R @ R_part
        yield StampedPose(oldest_ns, R, p)

    def _chain(self) -> list[tuple[str, int | None, Array, Array]] | None:
        """Return the transforms from base to flange; None while one of them is missing."""
        chain: list[tuple[str, int | None, Array, Array]] = []
        frame = self._flange
        while frame != self._base:
            if frame not in self._parts or len(chain) > len(self._parts):
                return None
            chain.insert(0, self._parts[frame])
            frame = self._parts[frame][0]
        return chain

    def missing(self) -> str:
        """Return a sentence naming the frame or transform that is missing."""
        frames = {*self._parts, *(parent for parent, *_ in self._parts.values())}
        for frame in (self._base, self._flange):
            if frame not in frames:
                return f"tf has no frame {frame!r}; it has {', '.join(sorted(frames)) or 'none'}"
        frame = self._flange
        for _ in self._parts:  # a wrong tree may contain a cycle
            if frame in self._parts and frame != self._base:
                frame = self._parts[frame][0]
        if frame != self._base:
            return f"tf does not connect {self._base} with {self._flange}: {frame} has no parent"
        return f"all transforms between {self._base} and {self._flange} are static, so none has a time"
