"""Recordings of other programs: recognise them, read them as tables, and pair wrenches and poses.

Tables are text files or ROS 1 and ROS 2 bags, which need the extra `ros2`.
"""

import struct
from collections.abc import Iterator, Mapping, Sequence
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, TypeVar

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import minimum_filter1d
from scipy.spatial.transform import Rotation

from ftcalib import CalibrationResult
from ftcalib.data.dwell_mean import CHANNELS
from ftcalib.errors import BadDataset, UsageError
from ftcalib.files import open_file
from ftdrive.errors import ConfigError
from ftdrive.recording.files import ENDINGS
from ftdrive.recording.mcap_file import MAGIC
from ftdrive.recording.recording import PIECE_ROWS, Header, Measured, in_blocks
from ftdrive.recording.table_files import FIRST_BYTES
from ftdrive.runs.calibration import versions
from ftdrive.runs.source import SolveOptions
from ftdrive.stream.pairing import DelayEstimator, pair_blocks
from ftdrive.stream.samples import Stages, StreamInfo, WrenchFrame
from ftdrive.tables.table import Table, TableOptions
from ftdrivers.errors import ProtocolError
from ftdrivers.installation import missing_extra
from ftdrivers.interfaces import NOT_REPORTED, ArmStates, Array, DeviceInfo, FtSamples
from ftdrivers.ros2.arm import SCHEME, pose_reader_of
from ftdrivers.ros2.poses import UNIT_TOLERANCE, Joints, PoseReader, Poses

if TYPE_CHECKING:
    from rosbags.highlevel import AnyReader

WRENCH: Final = "geometry_msgs/msg/WrenchStamped"
_BAG: Final = b"#ROSBAG V2.0\n"
_POSES: Final = "geometry_msgs/msg/PoseStamped"
# The values of a topic: times in ns, and one row of values per time.
_Column = tuple[NDArray[np.int64], Array]
# A message of a ROS bag: time of receipt in ns, and encoded content.
_Message = tuple[int, bytes]

T = TypeVar("T")
# Window of the delay estimate, s, longer than any recording, so that all samples are used.
_WHOLE = 10**6
_MEAN_S = 0.008
# Number of samples before and after a step that decide whether it is a gap.
_NEAR = 100
_ROUNDS = 20
# Times are regular if their steps deviate from multiples of the period by less than this, in periods.
_REGULAR = 0.2


def is_recording(path: Path) -> bool:
    """Whether a file is from `ftdrive record`: by its suffix, and by its first line (CSV) or named writer (MCAP)."""
    ending = Path(path.name.removesuffix(".partial")).suffix
    if ending != ".csv":
        return ending in ENDINGS and not is_bag(path)
    if not path.is_file():
        return False
    with open_file(path) as file:
        return file.readline(100).startswith(FIRST_BYTES)


def is_bag(path: Path) -> bool:
    """Whether a path is a ROS 1 or ROS 2 bag: a rosbag2 folder, a .db3 or .bag, or an MCAP file of another program."""
    if path.is_dir():
        return (path / "metadata.yaml").is_file()
    if path.suffix in (".bag", ".db3"):
        return path.is_file()
    if path.suffix != ".mcap" or not path.is_file():
        return False
    with open_file(path) as file:
        start = file.read(512)
    try:
        (profile,) = struct.unpack_from("<I", start, 17)
        (library,) = struct.unpack_from("<I", start, 21 + profile)
    except struct.error:
        return False
    return start.startswith(MAGIC) and not start[25 + profile : 25 + profile + library].startswith(b"ftdrive")


def tables_of(
    source: Any,
    options: TableOptions | None = None,
    pair: tuple[Path, Path] | None = None,
    topics: tuple[str | None, str | None] = (None, None),
) -> tuple[Table, Table] | None:
    """Return the table of wrenches and the table of poses, possibly the same one; None for a recording of ftdrive.

    `source` is a Path, a DataFrame or a mapping. Raises the errors of `Table` and, for a ROS bag, of `read_bag`.
    """
    if pair is not None:
        return Table(pair[0], options), Table(pair[1], options)
    if isinstance(source, Path):
        if is_recording(source):
            return None
        if is_bag(source):
            return read_bag(source, *topics)
    table = Table(source, options)
    return table, table


def moving_source(source: Any, options: SolveOptions) -> Path | tuple[Table, Table] | None:
    """Return a recording in motion for `solve_recording`; None for poses at rest. Raises the errors of `tables_of`."""
    if options.pair is None and isinstance(source, Path):
        # A run folder or a dataset has only poses at rest.
        has_poses = source.is_dir() or source.suffix == ".json"
        if has_poses and not is_bag(source):
            return None
    tables = tables_of(source, options.table, options.pair, options.topics)
    if tables is None:
        return Path(source)
    # A single table has either both streams or poses at rest.
    return tables if tables[0] is not tables[1] or tables[0].in_motion else None


def table_words(tables: tuple[Table, Table]) -> str:
    """Return a line about the recognised formats of the tables; empty if all names and units are those of ftdrive."""
    return "; ".join(dict.fromkeys(f"{one.name}: {one.words}" for one in tables if one.words))


def read_bag(path: Path, wrench_topic: str | None, pose_topic: str | None) -> tuple[Table, Table]:
    """Read wrenches and poses; the times come from the headers and count from the earliest message.

    The topics of WrenchStamped and PoseStamped may be omitted if there is only one of each. `pose_topic` may also have
    the form of an arm address: ``tf?base=base&flange=tool0`` or ``/joint_states?urdf=arm.urdf&flange=tool0``. Raises
    `ConfigError` if the package rosbags is missing or a topic must be given, and `BadDataset` for an unusable bag.
    """
    try:
        from rosbags.highlevel import AnyReader
        from rosbags.typesys import Stores, get_typestore
    except ImportError:
        raise ConfigError(missing_extra(path.name, "rosbags", "ros2")) from None
    if path.suffix == ".bag":
        with open_file(path) as file:
            if file.read(len(_BAG)) != _BAG:  # rosbags would read the whole first line, however long
                raise BadDataset(f"{path.name}: the first bytes are not those of a ROS 1 bag: record it again")
    try:
        with AnyReader([path], default_typestore=get_typestore(Stores.ROS2_HUMBLE)) as reader:
            wrenches = _choose_topic(reader, WRENCH, wrench_topic, "--wrench-topic")
            named = _pose_reader(reader, pose_topic)
            messages = _read_topics(reader, [wrenches, *named.topics])
            wrench = _number_column(reader, wrenches, messages[wrenches], 6)
            poses = _pose_column(reader, named, messages)
    except (UsageError, BadDataset):
        raise
    except ProtocolError as error:
        raise BadDataset(f"{path.name}: {error}") from error
    except Exception as error:  # any error of rosbags, SQLite, zstd or YAML
        raise BadDataset(f"{path.name} cannot be read ({error}): it is damaged or has another version") from error
    origin_ns = min(int(wrench[0].min()), int(poses[0].min()))
    return (
        _time_ordered_table(path.name, wrench, origin_ns, CHANNELS),
        _time_ordered_table(path.name, poses, origin_ns, ("qx", "qy", "qz", "qw", "x", "y", "z")),
    )


def _time_ordered_table(name: str, column: _Column, origin_ns: int, names: Sequence[str]) -> Table:
    t_ns, values = column
    order = np.argsort(t_ns, kind="stable")
    t_s = (t_ns - origin_ns)[order] * 1e-9
    return Table({"t": t_s, **dict(zip(names, values[order].T, strict=True))}, name=name)


def _choose_topic(reader: "AnyReader", kind: str, topic: str | None, option: str) -> str:
    of_kind = sorted({one.topic for one in reader.connections if one.msgtype == kind})
    if topic is not None and topic not in of_kind:
        known = ", ".join(of_kind) or "none"
        raise ConfigError(f"{option} {topic}: the bag has no such topic of {kind}; it has {known}")
    if topic is None and len(of_kind) != 1:
        others = ", ".join(sorted({f"{one.topic} ({one.msgtype})" for one in reader.connections}))
        if of_kind:
            raise ConfigError(f"the bag has {len(of_kind)} topics of {kind}, {', '.join(of_kind)}: give {option}")
        raise ConfigError(f"the bag has no topic of {kind}, only {others}: give {option} or another bag")
    return topic or of_kind[0]


def _read_topics(reader: "AnyReader", topics: Sequence[str]) -> dict[str, list[_Message]]:
    chosen = [one for one in reader.connections if one.topic in topics]
    found: dict[str, list[_Message]] = {topic: [] for topic in topics}
    for connection, received_ns, data in reader.messages(connections=chosen):
        found[connection.topic].append((received_ns, bytes(data)))
    return found


def _number_column(reader: "AnyReader", topic: str, messages: Sequence[_Message], count: int) -> _Column:
    """Return times (n,), ns, those of receipt if there are no stamps, and the `count` numbers after each header."""
    if not messages:
        raise BadDataset(f"{topic} has no message: give another topic")
    received_ns = np.array([received for received, _ in messages])
    data = [one for _, one in messages]
    if reader.is2 and data[0][:2] != b"\0\1":
        raise BadDataset(f"{topic} is not encoded as little-endian CDR: record it again with the default RMW")
    # A ROS 1 message begins with a counter, a ROS 2 message with 4 encoding bytes, and its numbers align to 8 bytes.
    (length,) = struct.unpack_from("<I", data[0], 12)
    start = 4 + -(-(12 + length) // 8) * 8 if reader.is2 else 16 + length
    if {len(one) for one in data} != {len(data[0])} or len(data[0]) < start + 8 * count:
        raise BadDataset(f"{topic}: the messages differ in length, and therefore in frame or type: give another topic")
    rows = np.frombuffer(b"".join(data), np.uint8).reshape(len(data), len(data[0]))
    if (rows[:, 12 : 16 + length] != rows[0, 12 : 16 + length]).any():
        raise BadDataset(f"{topic}: the frame changes within the bag: give a topic with one frame")
    seconds, nanoseconds = (rows[:, i : i + 4].copy().view("<u4")[:, 0] for i in (4, 8))
    t_ns = seconds.astype(np.int64) * 1_000_000_000 + nanoseconds
    numbers = rows[:, start : start + 8 * count].copy().view("<f8")
    return _checked_column(topic, t_ns if t_ns.any() else received_ns, numbers)


def _checked_column(topic: str, t_ns: NDArray[np.int64], numbers: Array) -> _Column:
    if (t_ns <= 0).any():
        raise BadDataset(f"{topic}: some messages have the stamp 0: set header.stamp in its driver and record again")
    if not np.isfinite(numbers).all():
        row = int(np.argmax(~np.isfinite(numbers).all(axis=1)))
        raise BadDataset(f"{topic}: message {row + 1} has a value that is not finite: give another topic")
    return t_ns, numbers


def _pose_reader(reader: "AnyReader", pose_topic: str | None) -> PoseReader:
    if pose_topic is None:
        return Poses(_choose_topic(reader, _POSES, None, "--pose-topic"))
    named = pose_reader_of(SCHEME + pose_topic.removeprefix(SCHEME))
    if isinstance(named, Poses):
        _choose_topic(reader, _POSES, next(iter(named.topics)), "--pose-topic")
    missing = [topic for topic in named.topics if topic not in reader.topics and topic != "/tf_static"]
    if missing:
        raise ConfigError(f"--pose-topic {pose_topic}: the bag has no topic {missing[0]}")
    return named


def _pose_column(reader: "AnyReader", named: PoseReader, messages: Mapping[str, list[_Message]]) -> _Column:
    """Return times (m,), ns, and flange poses (m, 7): quaternions x, y, z, w, then positions, m."""
    if isinstance(named, Poses):
        (topic,) = named.topics
        t_ns, numbers = _number_column(reader, topic, messages[topic], 7)
        position, quaternion = numbers[:, :3], numbers[:, 3:]
        lengths = np.linalg.norm(quaternion, axis=1)
        if (np.abs(lengths - 1) > UNIT_TOLERANCE).any():
            wrong = lengths[np.argmax(np.abs(lengths - 1))]
            raise BadDataset(f"{topic}: a quaternion has the norm {wrong:.3g}: normalize it in its driver")
        return t_ns, np.hstack([quaternion, position])
    decoded: Iterator[tuple[str, Any]] = (
        (topic, reader.deserialize(data, named.topics[topic]))
        # Latched messages on /tf_static may be stored late in a bag, so they are put first here.
        for topic in sorted(named.topics, key=lambda topic: topic != "/tf_static")
        for _, data in messages[topic]
    )
    found: list[tuple[Any, ...]]
    if isinstance(named, Joints):
        found = [
            (message.header.stamp, *joints.values())
            for topic, message in decoded
            if (joints := named.positions(topic, message)) is not None
        ]
    else:
        found = [pose for topic, message in decoded for pose in named.read(topic, message)]
    if not found:
        raise BadDataset(f"the bag has no pose: {named.missing()}")
    times, *columns = zip(*found, strict=True)
    if isinstance(named, Joints):
        # Convert all poses at once, because converting them one by one takes longer than reading the messages.
        t_ns = np.array([stamp.sec * 1_000_000_000 + stamp.nanosec for stamp in times])
        R, p = named.chain.poses(dict(zip(named.chain.names, map(np.array, columns), strict=True)))
        (topic,) = named.topics
        return _checked_column(topic, t_ns, np.hstack([Rotation.from_matrix(R).as_quat(), p]))
    R, p = map(np.array, columns)
    return np.array(times), np.hstack([Rotation.from_matrix(R).as_quat(), p])


class TablePair:
    """Two tables, or one table with both streams, as one recording of any length; the devices are unknown.

    `name` names the calibration, and `delay_s` is the delay of the wrench relative to the orientation; None estimates
    it in a separate pass. Raises `BadDataset` if a table cannot be used, or if the tables do not overlap in time.
    """

    cut = ""

    def __init__(
        self, wrench: Table, orientation: Table, calibration: CalibrationResult, name: str, delay_s: float | None
    ) -> None:
        self._wrench, self._orientation = wrench, orientation
        rate_Hz, unknown = wrench.rate_Hz("wrench"), np.full(3, np.nan)
        info = StreamInfo(
            result=calibration,
            calibration_name=name,
            arm=DeviceInfo("unknown", NOT_REPORTED, NOT_REPORTED),
            sensor=DeviceInfo("unknown", NOT_REPORTED, NOT_REPORTED),
            tool="",
            utc_offset_ns=0,
            sensor_rate_Hz=rate_Hz,
            arm_rate_Hz=orientation.rate_Hz("orientation"),
            p_flange_sensor_m=unknown,
            R_flange_tcp=np.eye(3),
            p_flange_tcp_m=unknown,
            versions=versions(),
        )
        self.header = Header(info, WrenchFrame(), Stages())
        self.delay_s, self.delay_sigma_s = self._estimated_delay() if delay_s is None else (delay_s, 0.0)

    def blocks(self) -> Iterator[Measured]:
        """Yield the samples with their poses in blocks. A fault raises `BadDataset` after the last valid block."""
        # Each call reads the files again, because a binary copy would need 1.4 GB per hour of samples.
        share = [0.0]

        def samples() -> Iterator[FtSamples]:
            for block, share[0] in _numbered_samples(self._wrench):
                yield from (block.rows(slice(i, i + PIECE_ROWS)) for i in range(0, len(block), PIECE_ROWS))

        paired = pair_blocks(samples(), _states_of(self._orientation), self.delay_s)
        # Regroup to the block size of other recordings, because the result of the contact test depends on the size.
        return in_blocks(Measured(block, (), share[0]) for block in paired)

    def _estimated_delay(self) -> tuple[float, float]:
        info = self.header.info
        size = max(1, round(_MEAN_S * info.sensor_rate_Hz))
        means = list(_before_a_fault(_mean_samples(self._wrench, size)))
        estimator = DelayEstimator(info.calibration, info.p_flange_sensor_m, window=_WHOLE)
        estimator.learn(means, lambda: _before_a_fault(_states_of(self._orientation)))
        return estimator.delay_s, estimator.sigma_s


def _before_a_fault(parts: Iterator[T]) -> Iterator[T]:
    """Yield the parts before a `BadDataset`, which is raised only if there are none; a later pass raises it again."""
    count = 0
    try:
        for part in parts:
            yield part
            count += 1
    except BadDataset:
        if not count:
            raise


def _mean_samples(table: Table, size: int) -> Iterator[FtSamples]:
    t_s, wrench, count = np.empty(0), np.empty((0, 6)), 0
    for rows in table.wrenches():
        t_s, wrench = np.concatenate([t_s, rows.t_s]), np.concatenate([wrench, rows.values])
        n = len(t_s) // size
        t_ns = _ns(t_s[: n * size].reshape(n, size).mean(axis=1))
        means = wrench[: n * size].reshape(n, size, 6).mean(axis=1)
        yield FtSamples.of(t_ns, np.arange(count, count + n), means)
        t_s, wrench, count = t_s[n * size :], wrench[n * size :], count + n


def _numbered_samples(table: Table) -> Iterator[tuple[FtSamples, float]]:
    """Yield blocks of samples, numbered by their times, with the share of the table read so far."""
    known, number = 0, 0
    t_s, wrench, place = np.empty(0), np.empty((0, 6)), 0.0
    for rows in chain(table.wrenches(), [None]):
        if rows is not None:
            t_s, wrench, place = np.concatenate([t_s, rows.t_s]), np.concatenate([wrench, rows.values]), rows.place
            if len(t_s) <= known + 2 * _NEAR:
                continue
        numbers = sample_numbers(t_s)
        numbers += number - numbers[max(known - 1, 0)]
        # keep the last samples for the next round, because only the samples after a step show whether it is a gap
        end = len(t_s) if rows is None else len(t_s) - _NEAR
        if end > known:
            yield FtSamples.of(_ns(t_s[known:end]), numbers[known:end], wrench[known:end]), place
            number = int(numbers[end - 1])
        start = max(end - 2 * _NEAR, 0)
        t_s, wrench, known = t_s[start:], wrench[start:], end - start


def sample_numbers(t_s: Array) -> NDArray[np.int64]:
    """Number samples by their times (n,), so that a missing sample leaves a gap and a late sample does not.

    If all times are near multiples of the period, a longer step is a gap. Otherwise, as for times of receipt or of
    batches, a gap is a step after which the samples stay late by at least a period, in the median and at the earliest.
    """
    steps_s = np.diff(t_s)
    if (step_s := float(np.median(steps_s))) > 0:
        steps = np.rint(steps_s / step_s)
        if steps.min() >= 1 and np.abs(steps_s / step_s - steps).max() < _REGULAR:
            return np.concatenate([[0], np.cumsum(steps)]).astype(np.int64)
    number = np.arange(len(t_s))
    # repeat, because the period follows from the number of all samples, including the missing ones
    for _ in range(_ROUNDS):
        before, number = number, _with_gaps(t_s, float(t_s[-1] - t_s[0]) / int(number[-1]))
        if np.array_equal(number, before):
            break
    return number


def _with_gaps(t_s: Array, period_s: float) -> NDArray[np.int64]:
    number = np.arange(len(t_s))
    if period_s == 0:
        return number
    steps = np.diff(t_s) / period_s
    late = t_s / period_s - number
    # smallest delay of each sample and those before it
    earliest = minimum_filter1d(late, _NEAR, mode="nearest", origin=(_NEAR - 1) // 2)
    following = minimum_filter1d(late, _NEAR, mode="nearest", origin=-_NEAR // 2)  # this sample and later ones
    possible = np.flatnonzero((steps > 1.5) & (following[1:] - earliest[:-1] > 0.4))
    # check the largest steps first
    for last in possible[np.argsort(-steps[possible])].tolist():
        near = slice(max(last + 1 - _NEAR, 0), last + 1), slice(last + 1, last + 1 + _NEAR)
        before, after = (t_s[rows] / period_s - number[rows] for rows in near)
        missing = min(np.median(after) - np.median(before), after.min() - before.min())
        number[last + 1 :] += max(round(float(missing)), 0)
    return number


def _states_of(table: Table) -> Iterator[ArmStates]:
    """Yield arm states with the orientations of a table; positions, joint angles and speeds are NaN."""
    for rows in table.poses():
        unknown = np.full((len(rows.t_s), 6), np.nan)
        R = rows.values[:, :9].reshape(-1, 3, 3)
        yield ArmStates(_ns(rows.t_s), unknown[:, 0], unknown, unknown, R, unknown[:, :3])


def _ns(t_s: Array) -> NDArray[np.int64]:
    return np.rint(t_s * 1e9).astype(np.int64)
