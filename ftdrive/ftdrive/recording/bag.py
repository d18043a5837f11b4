"""Recordings of other programs in ROS 2: rosbag2 folders, and MCAP files without our header. Needs the extra `ros2`.

Wrench and pose become the two CSV files that `csv_pair` and `in_motion` read, so that a bag is solved and compensated
as the CSV files of the same data: docs/decisions/0242-a-bag-is-read-as-two-csv-files.md.
"""

import struct
from collections import defaultdict
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from ftcalib.data.dwell_mean import CHANNELS
from ftcalib.errors import BadDataset
from ftdrive.errors import ConfigError
from ftdrivers.errors import ProtocolError
from ftdrivers.interfaces import Array
from ftdrivers.ros2.arm import SCHEME, pose_reader_of
from ftdrivers.ros2.poses import Joints, PoseReader, Poses

if TYPE_CHECKING:
    from rosbags.highlevel import AnyReader

WRENCH: Final = "geometry_msgs/msg/WrenchStamped"
_POSES: Final = "geometry_msgs/msg/PoseStamped"
_MAGIC: Final = b"\x89MCAP0\r\n"
_UNIT_TOLERANCE: Final = 1e-3


def is_bag(path: Path) -> bool:
    """Whether it is a rosbag2 folder, or an MCAP file of another program."""
    if path.is_dir():
        return (path / "metadata.yaml").is_file()
    if path.suffix != ".mcap" or not path.is_file():
        return False
    with path.open("rb") as file:
        start = file.read(512)
    try:
        (profile,) = struct.unpack_from("<I", start, 17)
        (library,) = struct.unpack_from("<I", start, 21 + profile)
    except struct.error:
        return False
    return start.startswith(_MAGIC) and not start[25 + profile : 25 + profile + library].startswith(b"ftdrive")


@contextmanager
def as_csv_pair(path: Path, wrench_topic: str | None, pose_topic: str | None) -> Iterator[tuple[Path, Path]]:
    """Give the CSV files of wrench and pose of a bag, as long as the block lasts.

    Times are those of the headers, from the earliest of both topics.

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
        from rosbags.highlevel import AnyReader, AnyReaderError
        from rosbags.typesys import Stores, get_typestore
    except ImportError:
        raise ConfigError(f"{path.name} needs rosbags: pip install 'ftdrive[ros2]'") from None
    try:
        with AnyReader([path], default_typestore=get_typestore(Stores.ROS2_HUMBLE)) as reader:
            wrench = _wrenches(reader, _chosen(reader, WRENCH, wrench_topic, "--wrench-topic"))
            poses = _poses(reader, pose_topic)
    except (ConfigError, BadDataset):
        raise
    except ProtocolError as error:
        raise BadDataset(f"{path.name}: {error}") from error
    except (AnyReaderError, OSError, ValueError, KeyError, IndexError, RuntimeError, struct.error) as error:
        raise BadDataset(f"{path.name} cannot be read ({error}): the bag is damaged, or of another version") from error
    except Exception as error:  # rosbags raises the errors of SQLite, zstd and others
        raise BadDataset(f"{path.name} cannot be read ({error!r}): the bag is damaged") from error
    origin_ns = min(int(wrench[0][0]), int(poses[0][0]))
    with TemporaryDirectory(prefix="ftdrive-bag-") as folder:
        files = Path(folder) / f"{path.name}-wrench.csv", Path(folder) / f"{path.name}-poses.csv"
        names = ("qx", "qy", "qz", "qw", "x", "y", "z")
        for file, (t_ns, values), columns in zip(files, (wrench, poses), (CHANNELS, names), strict=True):
            order = np.argsort(t_ns, kind="stable")
            table = np.column_stack([(t_ns - origin_ns)[order] * 1e-9, values[order]])
            np.savetxt(file, table, "%.17g", ",", header=",".join(("t", *columns)), comments="")
        yield files


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


def _raw(reader: "AnyReader", topics: Sequence[str]) -> Iterator[tuple[str, str, bytes]]:
    """Give topic, type and bytes of each message in order."""
    chosen = [one for one in reader.connections if one.topic in topics]
    for connection, _, data in reader.messages(connections=chosen):
        yield connection.topic, connection.msgtype, bytes(data)


def _numbers(topic: str, messages: Sequence[bytes], count: int) -> tuple[NDArray[np.int64], Array]:
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


def _checked(topic: str, t_ns: NDArray[np.int64], numbers: Array) -> tuple[NDArray[np.int64], Array]:
    if (t_ns <= 0).any():
        raise BadDataset(f"{topic}: a message has the stamp 0: set header.stamp in its driver and record again")
    if not np.isfinite(numbers).all():
        row = int(np.argmax(~np.isfinite(numbers).all(axis=1)))
        raise BadDataset(f"{topic}: message {row + 1} has a number that is not finite: leave this topic out")
    return t_ns, numbers


def _wrenches(reader: "AnyReader", topic: str) -> tuple[NDArray[np.int64], Array]:
    return _numbers(topic, [data for _, _, data in _raw(reader, [topic])], 6)


def _poses(reader: "AnyReader", pose_topic: str | None) -> tuple[NDArray[np.int64], Array]:
    """Return times (m,) in ns, and quaternions x, y, z, w and positions (m, 7)."""
    if pose_topic is None:
        named: PoseReader = Poses(_chosen(reader, _POSES, None, "--pose-topic"))
    else:
        named = pose_reader_of(SCHEME + pose_topic.removeprefix(SCHEME))
    if isinstance(named, Poses):
        topic = _chosen(reader, _POSES, next(iter(named.topics)), "--pose-topic")
        t_ns, numbers = _numbers(topic, [data for _, _, data in _raw(reader, [topic])], 7)
        position, quaternion = numbers[:, :3], numbers[:, 3:]
        lengths = np.linalg.norm(quaternion, axis=1)
        if (np.abs(lengths - 1) > _UNIT_TOLERANCE).any():
            wrong = lengths[np.argmax(np.abs(lengths - 1))]
            raise BadDataset(f"{topic}: a quaternion has the length {wrong:.3g}: normalize it in its driver")
        return t_ns, np.hstack([quaternion, position])
    missing = [topic for topic in named.topics if topic not in reader.topics and topic != "/tf_static"]
    if missing:
        raise ConfigError(f"--pose-topic {pose_topic}: the bag has no topic {missing[0]}")
    if isinstance(named, Joints):
        return _from_joints(reader, named)
    found = [
        (pose.t_ns, pose.R_base_flange, pose.p_base_flange_m)
        for topic, kind, data in _static_first(reader, named)
        for pose in named.read(topic, reader.deserialize(data, kind))
    ]
    if not found:
        raise BadDataset(f"the bag has no pose: {named.missing()}")
    t_ns, R, p = (np.array(column) for column in zip(*found, strict=True))
    return t_ns, np.hstack([Rotation.from_matrix(R).as_quat(), p])


def _static_first(reader: "AnyReader", named: PoseReader) -> Iterator[tuple[str, str, bytes]]:
    """Give the messages of tf, the latched ones first, which a bag may have late."""
    for topics in (["/tf_static"], [topic for topic in named.topics if topic != "/tf_static"]):
        yield from _raw(reader, topics)


def _from_joints(reader: "AnyReader", named: Joints) -> tuple[NDArray[np.int64], Array]:
    """Return what `_poses` does, from all messages at once."""
    t_ns: list[int] = []
    positions: defaultdict[str, list[float]] = defaultdict(list)
    for topic, kind, data in _raw(reader, list(named.topics)):
        message: Any = reader.deserialize(data, kind)
        if (found := named.positions(topic, message)) is not None:
            stamp = message.header.stamp
            t_ns.append(stamp.sec * 1_000_000_000 + stamp.nanosec)
            for name, value in found.items():
                positions[name].append(value)
    if not t_ns:
        raise BadDataset(f"the bag has no pose: {named.missing()}")
    R, p = named.chain.poses({name: np.array(values) for name, values in positions.items()})
    numbers = np.hstack([Rotation.from_matrix(R).as_quat(), p])
    return _checked(next(iter(named.topics)), np.array(t_ns), numbers)
