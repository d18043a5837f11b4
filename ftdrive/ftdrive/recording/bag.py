"""Recordings of other programs in ROS 2: rosbag2 folders, and MCAP files without our header. Needs the extra `ros2`.

`compensate` reads them as two CSV files, as it does recordings of any other program (docs/decisions/recordings.md,
181). `solve` takes the same numbers without files, so that both agree with the CSV files of the same data.
"""

import struct
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from ftcalib.data.dwell_mean import CHANNELS
from ftcalib.errors import BadDataset, UsageError
from ftcalib.files import open_file
from ftcalib.motion.samples import Means
from ftdrive.errors import ConfigError
from ftdrivers.errors import ProtocolError
from ftdrivers.interfaces import Array
from ftdrivers.ros2.arm import SCHEME, pose_reader_of
from ftdrivers.ros2.poses import UNIT_TOLERANCE, Joints, PoseReader, Poses

if TYPE_CHECKING:
    from rosbags.highlevel import AnyReader

WRENCH: Final = "geometry_msgs/msg/WrenchStamped"
_POSES: Final = "geometry_msgs/msg/PoseStamped"
_MAGIC: Final = b"\x89MCAP0\r\n"
# Times in ns, and numbers.
_Column = tuple[NDArray[np.int64], Array]


def is_bag(path: Path) -> bool:
    """Whether it is a rosbag2 folder, or an MCAP file of another program."""
    if path.is_dir():
        return (path / "metadata.yaml").is_file()
    if path.suffix != ".mcap" or not path.is_file():
        return False
    with open_file(path) as file:
        start = file.read(512)
    try:
        (profile,) = struct.unpack_from("<I", start, 17)
        (library,) = struct.unpack_from("<I", start, 21 + profile)
    except struct.error:
        return False
    return start.startswith(_MAGIC) and not start[25 + profile : 25 + profile + library].startswith(b"ftdrive")


class Bag(NamedTuple):
    """Wrench and pose of a bag, in the order of their stamps, in s from the earliest of both."""

    t_wrench_s: Array
    """(n,)"""
    wrench: Array
    """(n, 6)"""
    t_pose_s: Array
    """(m,)"""
    pose: Array
    """(m, 7) quaternion x, y, z, w of the flange in base, then its position."""


def read_bag(path: Path, wrench_topic: str | None, pose_topic: str | None) -> Bag:
    """Read wrench and pose; times are those of the headers.

    Parameters
    ----------
    path : Path
    wrench_topic : str, optional
        Of WrenchStamped; may be left out if there is only one.
    pose_topic : str, optional
        Of PoseStamped; may be left out if there is only one. Otherwise as the address of an arm:
        ``tf?base=base&flange=tool0`` or ``/joint_states?urdf=arm.urdf&flange=tool0``.

    Raises
    ------
    ConfigError
        The package rosbags is missing, or a topic has to be named.
    BadDataset
        The bag is damaged, or a message cannot be used.
    """
    try:
        from rosbags.highlevel import AnyReader
        from rosbags.typesys import Stores, get_typestore
    except ImportError:
        raise ConfigError(f"{path.name} needs rosbags: pip install 'ftdrive[ros2]'") from None
    try:
        with AnyReader([path], default_typestore=get_typestore(Stores.ROS2_HUMBLE)) as reader:
            wrenches = _chosen(reader, WRENCH, wrench_topic, "--wrench-topic")
            named = _pose_reader(reader, pose_topic)
            messages = _messages(reader, [wrenches, *named.topics])
            wrench = _numbers(wrenches, messages[wrenches], 6)
            poses = _poses(reader, named, messages)
    except (UsageError, BadDataset):
        raise
    except ProtocolError as error:
        raise BadDataset(f"{path.name}: {error}") from error
    except Exception as error:  # rosbags raises those of SQLite, zstd, YAML and its own
        raise BadDataset(f"{path.name} cannot be read ({error}): it is damaged, or of another version") from error
    origin_ns = min(int(wrench[0].min()), int(poses[0].min()))
    return Bag(*_sorted(wrench, origin_ns), *_sorted(poses, origin_ns))


def _sorted(column: _Column, origin_ns: int) -> tuple[Array, Array]:
    t_ns, values = column
    order = np.argsort(t_ns, kind="stable")
    return np.asarray((t_ns - origin_ns)[order] * 1e-9), values[order]


@contextmanager
def as_csv_pair(bag: Bag, name: str) -> Iterator[tuple[Path, Path]]:
    """Give the CSV files of wrench and pose of a bag, as long as the block lasts."""
    with TemporaryDirectory(prefix="ftdrive-bag-") as folder:
        files = Path(folder) / f"{name}-wrench.csv", Path(folder) / f"{name}-poses.csv"
        for file, t_s, values, names in (
            (files[0], bag.t_wrench_s, bag.wrench, CHANNELS),
            (files[1], bag.t_pose_s, bag.pose, ("qx", "qy", "qz", "qw", "x", "y", "z")),
        ):
            header = ",".join(("t", *names))
            # 17 digits keep every bit of a float64.
            np.savetxt(file, np.column_stack([t_s, values]), "%.17g", ",", header=header, comments="")
        yield files


def bag_means(bag: Bag) -> tuple[Means, Means]:
    """Return the means of wrench and pose, as `solve_recording` takes them."""
    wrench, poses = Means(), Means()
    wrench.add(bag.t_wrench_s, bag.wrench)
    R = Rotation.from_quat(bag.pose[:, :4]).as_matrix().reshape(-1, 9)
    poses.add(bag.t_pose_s, np.hstack([R, bag.pose[:, 4:]]))
    return wrench, poses


def _chosen(reader: "AnyReader", kind: str, topic: str | None, option: str) -> str:
    """Return the topic of a type that is named, or the only one. Raises `ConfigError`."""
    of_kind = sorted({one.topic for one in reader.connections if one.msgtype == kind})
    if topic is not None and topic not in of_kind:
        known = ", ".join(of_kind) or "none"
        raise ConfigError(f"{option} {topic}: the bag has no such topic of {kind}; it has {known}")
    if topic is None and len(of_kind) != 1:
        others = ", ".join(sorted({f"{one.topic} ({one.msgtype})" for one in reader.connections}))
        if of_kind:
            raise ConfigError(f"the bag has {len(of_kind)} topics of {kind}, {', '.join(of_kind)}: give {option}")
        raise ConfigError(f"the bag has no topic of {kind}, but {others}: give {option} or another bag")
    return topic or of_kind[0]


def _messages(reader: "AnyReader", topics: Sequence[str]) -> dict[str, list[bytes]]:
    chosen = [one for one in reader.connections if one.topic in topics]
    found: dict[str, list[bytes]] = {topic: [] for topic in topics}
    for connection, _, data in reader.messages(connections=chosen):
        found[connection.topic].append(bytes(data))
    return found


def _numbers(topic: str, messages: Sequence[bytes], count: int) -> _Column:
    """Return stamps (n,) in ns and the numbers (n, count) behind the header of messages in CDR.

    Raises `BadDataset` for no message, a stamp of zero, a number that is not finite, or frames that differ.
    """
    if not messages:
        raise BadDataset(f"{topic} has no message: give another topic")
    first = messages[0]
    if first[:2] != b"\0\1":
        raise BadDataset(f"{topic} is not encoded as little-endian CDR: record it again with the default RMW")
    (length,) = struct.unpack_from("<I", first, 12)
    start = 4 + -(-(12 + length) // 8) * 8
    if {len(one) for one in messages} != {len(first)} or len(first) < start + 8 * count:
        raise BadDataset(f"{topic}: the messages differ in their length, so in frame or type: give another topic")
    rows = np.frombuffer(b"".join(messages), np.uint8).reshape(len(messages), len(first))
    if (rows[:, 12 : 16 + length] != rows[0, 12 : 16 + length]).any():
        raise BadDataset(f"{topic}: the frame changes within the bag: give a topic of one frame")
    seconds, nanoseconds = (rows[:, i : i + 4].copy().view(kind)[:, 0] for i, kind in ((4, "<i4"), (8, "<u4")))
    t_ns = seconds.astype(np.int64) * 1_000_000_000 + nanoseconds
    numbers = rows[:, start : start + 8 * count].copy().view("<f8")
    return _checked(topic, t_ns, numbers)


def _checked(topic: str, t_ns: NDArray[np.int64], numbers: Array) -> _Column:
    if (t_ns <= 0).any():
        raise BadDataset(f"{topic}: a message has the stamp 0: set header.stamp in its driver and record again")
    if not np.isfinite(numbers).all():
        row = int(np.argmax(~np.isfinite(numbers).all(axis=1)))
        raise BadDataset(f"{topic}: message {row + 1} has a number that is not finite: leave this topic out")
    return t_ns, numbers


def _pose_reader(reader: "AnyReader", pose_topic: str | None) -> PoseReader:
    """Return what turns messages into poses. Raises `ConfigError` or `BadUrl`."""
    if pose_topic is None:
        return Poses(_chosen(reader, _POSES, None, "--pose-topic"))
    named = pose_reader_of(SCHEME + pose_topic.removeprefix(SCHEME))
    if isinstance(named, Poses):
        _chosen(reader, _POSES, next(iter(named.topics)), "--pose-topic")
    missing = [topic for topic in named.topics if topic not in reader.topics and topic != "/tf_static"]
    if missing:
        raise ConfigError(f"--pose-topic {pose_topic}: the bag has no topic {missing[0]}")
    return named


def _poses(reader: "AnyReader", named: PoseReader, messages: Mapping[str, list[bytes]]) -> _Column:
    """Return times (m,) in ns, and quaternions x, y, z, w and positions (m, 7)."""
    if isinstance(named, Poses):
        (topic,) = named.topics
        t_ns, numbers = _numbers(topic, messages[topic], 7)
        position, quaternion = numbers[:, :3], numbers[:, 3:]
        lengths = np.linalg.norm(quaternion, axis=1)
        if (np.abs(lengths - 1) > UNIT_TOLERANCE).any():
            wrong = lengths[np.argmax(np.abs(lengths - 1))]
            raise BadDataset(f"{topic}: a quaternion has the length {wrong:.3g}: normalize it in its driver")
        return t_ns, np.hstack([quaternion, position])
    if isinstance(named, Joints):
        return _from_joints(reader, named, messages)
    found = [
        (pose.t_ns, pose.R_base_flange, pose.p_base_flange_m)
        # a bag may have latched ones late
        for topic in sorted(named.topics, key=lambda topic: topic != "/tf_static")
        for data in messages[topic]
        for pose in named.read(topic, reader.deserialize(data, named.topics[topic]))
    ]
    if not found:
        raise BadDataset(f"the bag has no pose: {named.missing()}")
    times, R, p = (np.array(column) for column in zip(*found, strict=True))
    return times, np.hstack([Rotation.from_matrix(R).as_quat(), p])


def _from_joints(reader: "AnyReader", named: Joints, messages: Mapping[str, list[bytes]]) -> _Column:
    """Return what `_poses` does, from all messages at once."""
    (topic,) = named.topics
    t_ns: list[int] = []
    positions: defaultdict[str, list[float]] = defaultdict(list)
    for data in messages[topic]:
        message: Any = reader.deserialize(data, named.topics[topic])
        if (found := named.positions(topic, message)) is not None:
            stamp = message.header.stamp
            t_ns.append(stamp.sec * 1_000_000_000 + stamp.nanosec)
            for name, value in found.items():
                positions[name].append(value)
    if not t_ns:
        raise BadDataset(f"the bag has no pose: {named.missing()}")
    R, p = named.chain.poses({name: np.array(values) for name, values in positions.items()})
    return _checked(topic, np.array(t_ns), np.hstack([Rotation.from_matrix(R).as_quat(), p]))
