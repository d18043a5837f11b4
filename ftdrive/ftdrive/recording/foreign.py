"""Recordings of other programs as tables: text, and bags of ROS 1 and ROS 2, which need the extra `ros2`."""

import struct
from collections import defaultdict
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from ftcalib.data.dwell_mean import CHANNELS
from ftcalib.errors import BadDataset, UsageError
from ftcalib.files import open_file
from ftdrive.errors import ConfigError
from ftdrive.recording.files import is_bag, is_recording
from ftdrive.runs.source import SolveOptions
from ftdrive.tables.table import Table
from ftdrivers.errors import ProtocolError
from ftdrivers.installation import missing_extra
from ftdrivers.interfaces import Array
from ftdrivers.ros2.arm import SCHEME, pose_reader_of
from ftdrivers.ros2.poses import UNIT_TOLERANCE, Joints, PoseReader, Poses

if TYPE_CHECKING:
    from rosbags.highlevel import AnyReader

WRENCH: Final = "geometry_msgs/msg/WrenchStamped"
_BAG: Final = b"#ROSBAG V2.0\n"
_POSES: Final = "geometry_msgs/msg/PoseStamped"
# Times in ns, and numbers.
_Column = tuple[NDArray[np.int64], Array]
# Time of receipt in ns, and content.
_Message = tuple[int, bytes]


def tables_of(source: Any, options: SolveOptions) -> tuple[Table, Table] | None:
    """Return wrench and poses of another program, which may be one table; None for a recording of ours.

    `source` is a Path, a DataFrame or a mapping. Raises `BadDataset`, `ConfigError` or `OSError`.
    """
    if options.pair is not None:
        wrench, poses = (Table(path, options.table) for path in options.pair)
        return wrench, poses
    if isinstance(source, Path):
        if is_recording(source):
            return None
        if is_bag(source):
            return read_bag(source, *options.topics)
    table = Table(source, options.table)
    return table, table


def moving_source(source: Any, options: SolveOptions) -> Path | tuple[Table, Table] | None:
    """Return what `solve_recording` takes, a recording or two tables; None for poses at rest. Raises as `tables_of`."""
    if options.pair is None and isinstance(source, Path):
        # A run folder, or a dataset.
        has_poses = source.is_dir() or source.suffix == ".json"
        if has_poses and not is_bag(source):
            return None
    tables = tables_of(source, options)
    if tables is None:
        return Path(source)
    # One table has both streams or poses at rest.
    return tables if tables[0] is not tables[1] or tables[0].in_motion else None


def table_words(tables: tuple[Table, Table]) -> str:
    """Return what was recognised in the tables of a recording, in one line; empty for plain ones."""
    return "; ".join(dict.fromkeys(f"{one.name}: {one.words}" for one in tables if one.words))


def read_bag(path: Path, wrench_topic: str | None, pose_topic: str | None) -> tuple[Table, Table]:
    """Read wrench and pose; times are those of the headers, from the earliest of both.

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
        raise ConfigError(missing_extra(path.name, "rosbags", "ros2")) from None
    if path.suffix == ".bag":
        with open_file(path) as file:
            if file.read(len(_BAG)) != _BAG:  # rosbags would read up to the first end of a line
                raise BadDataset(f"{path.name}: the first bytes are not those of a bag of ROS 1: record it again")
    try:
        with AnyReader([path], default_typestore=get_typestore(Stores.ROS2_HUMBLE)) as reader:
            wrenches = _chosen(reader, WRENCH, wrench_topic, "--wrench-topic")
            named = _pose_reader(reader, pose_topic)
            messages = _messages(reader, [wrenches, *named.topics])
            wrench = _numbers(reader, wrenches, messages[wrenches], 6)
            poses = _poses(reader, named, messages)
    except (UsageError, BadDataset):
        raise
    except ProtocolError as error:
        raise BadDataset(f"{path.name}: {error}") from error
    except Exception as error:  # rosbags raises those of SQLite, zstd, YAML and its own
        raise BadDataset(f"{path.name} cannot be read ({error}): it is damaged, or of another version") from error
    origin_ns = min(int(wrench[0].min()), int(poses[0].min()))
    return (
        _table(path.name, wrench, origin_ns, CHANNELS),
        _table(path.name, poses, origin_ns, ("qx", "qy", "qz", "qw", "x", "y", "z")),
    )


def _table(name: str, column: _Column, origin_ns: int, names: Sequence[str]) -> Table:
    """Return times and numbers as a table, in the order of the times."""
    t_ns, values = column
    order = np.argsort(t_ns, kind="stable")
    t_s = (t_ns - origin_ns)[order] * 1e-9
    return Table({"t": t_s, **dict(zip(names, values[order].T, strict=True))}, name=name)


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


def _messages(reader: "AnyReader", topics: Sequence[str]) -> dict[str, list[_Message]]:
    chosen = [one for one in reader.connections if one.topic in topics]
    found: dict[str, list[_Message]] = {topic: [] for topic in topics}
    for connection, received_ns, data in reader.messages(connections=chosen):
        found[connection.topic].append((received_ns, bytes(data)))
    return found


def _numbers(reader: "AnyReader", topic: str, messages: Sequence[_Message], count: int) -> _Column:
    """Return times (n,) in ns and the numbers (n, count) behind the header of messages.

    The times are those of receipt if no message has a stamp. Raises `BadDataset` for no message, a stamp of zero
    beside others, a number that is not finite, or frames that differ.
    """
    if not messages:
        raise BadDataset(f"{topic} has no message: give another topic")
    received_ns = np.array([received for received, _ in messages])
    data = [one for _, one in messages]
    if reader.is2 and data[0][:2] != b"\0\1":
        raise BadDataset(f"{topic} is not encoded as little-endian CDR: record it again with the default RMW")
    # ROS 1 begins with a counter, ROS 2 with four bytes for the encoding; there numbers begin at multiples of 8.
    (length,) = struct.unpack_from("<I", data[0], 12)
    start = 4 + -(-(12 + length) // 8) * 8 if reader.is2 else 16 + length
    if {len(one) for one in data} != {len(data[0])} or len(data[0]) < start + 8 * count:
        raise BadDataset(f"{topic}: the messages differ in their length, so in frame or type: give another topic")
    rows = np.frombuffer(b"".join(data), np.uint8).reshape(len(data), len(data[0]))
    if (rows[:, 12 : 16 + length] != rows[0, 12 : 16 + length]).any():
        raise BadDataset(f"{topic}: the frame changes within the bag: give a topic of one frame")
    seconds, nanoseconds = (rows[:, i : i + 4].copy().view("<u4")[:, 0] for i in (4, 8))
    t_ns = seconds.astype(np.int64) * 1_000_000_000 + nanoseconds
    numbers = rows[:, start : start + 8 * count].copy().view("<f8")
    return _checked(topic, t_ns if t_ns.any() else received_ns, numbers)


def _checked(topic: str, t_ns: NDArray[np.int64], numbers: Array) -> _Column:
    if (t_ns <= 0).any():
        raise BadDataset(f"{topic}: some messages have the stamp 0: set header.stamp in its driver and record again")
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


def _poses(reader: "AnyReader", named: PoseReader, messages: Mapping[str, list[_Message]]) -> _Column:
    """Return times (m,) in ns, and quaternions x, y, z, w and positions (m, 7)."""
    if isinstance(named, Poses):
        (topic,) = named.topics
        t_ns, numbers = _numbers(reader, topic, messages[topic], 7)
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
        for _, data in messages[topic]
        for pose in named.read(topic, reader.deserialize(data, named.topics[topic]))
    ]
    if not found:
        raise BadDataset(f"the bag has no pose: {named.missing()}")
    times, R, p = (np.array(column) for column in zip(*found, strict=True))
    return times, np.hstack([Rotation.from_matrix(R).as_quat(), p])


def _from_joints(reader: "AnyReader", named: Joints, messages: Mapping[str, list[_Message]]) -> _Column:
    """Return what `_poses` does, from all messages at once."""
    (topic,) = named.topics
    t_ns: list[int] = []
    positions: defaultdict[str, list[float]] = defaultdict(list)
    for _, data in messages[topic]:
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
