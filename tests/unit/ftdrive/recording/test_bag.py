"""Bags of other programs, made by another implementation: solved as the CSV of the same data, or one sentence."""

import re
from collections.abc import Callable
from dataclasses import asdict
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore
from scipy.spatial.transform import Rotation

from ftcalib.errors import BadDataset, FtdriveError
from ftdrive.recording.foreign import is_bag, read_bag
from ftdrive.recording.solve import solve_recording
from ftdrive.tables.table import Table
from tests.ros2.seven_joints import JOINTS, TRUTH, URDF, flange, sway, wrench

STORE = get_typestore(Stores.ROS2_HUMBLE)
T0_NS = 1_700_000_000_123_456_789
Spoil = Callable[[str, int, Any], Any]


def message(kind: str, /, **fields: Any) -> Any:
    return STORE.types[kind](**fields)


def header(t_s: float, frame: str = "base") -> Any:
    stamp_ns = T0_NS + round(t_s * 1e9)
    stamp = message("builtin_interfaces/msg/Time", sec=stamp_ns // 10**9, nanosec=stamp_ns % 10**9)
    return message("std_msgs/msg/Header", stamp=stamp, frame_id=frame)


def vector(values: Any, kind: str = "Vector3") -> Any:
    return message(f"geometry_msgs/msg/{kind}", **dict(zip("xyzw", map(float, values), strict=False)))


def wrench_of(numbers: Any) -> Any:
    return message("geometry_msgs/msg/Wrench", force=vector(numbers[:3]), torque=vector(numbers[3:]))


def pose_of(p: Any, q: Any) -> Any:
    return message("geometry_msgs/msg/Pose", position=vector(p, "Point"), orientation=vector(q, "Quaternion"))


def transform(t_s: float, parent: str, child: str, p: Any, q: Any) -> Any:
    pose = message("geometry_msgs/msg/Transform", translation=vector(p), rotation=vector(q, "Quaternion"))
    return message(
        "geometry_msgs/msg/TransformStamped", header=header(t_s, parent), child_frame_id=child, transform=pose
    )


def tf(*transforms: Any) -> Any:
    return message("tf2_msgs/msg/TFMessage", transforms=list(transforms))


@lru_cache(maxsize=1)
def data(seconds: float = 8.0) -> tuple[Any, ...]:
    """Times of wrench and poses, the wrench, joint angles and poses; the clock of the sensor is 40 ms ahead."""
    t_wrench, t_pose = (np.float64(1e-9) * np.arange(0, round(1e9 * seconds), 10**9 // rate) for rate in (200, 100))
    noise = np.random.default_rng(1).normal(size=(len(t_wrench), 6)) * TRUTH["noise"]
    q = sway(t_pose)
    R, p = flange(q)
    return (
        1e-9 * np.rint(1e9 * (t_wrench + 0.04)),
        t_pose,
        wrench(t_wrench, sway) + noise,
        q,
        Rotation.from_matrix(R).as_quat(),
        p,
    )


TOPICS = {
    "/ft": "geometry_msgs/msg/WrenchStamped",
    "/pose": "geometry_msgs/msg/PoseStamped",
    "/tf": "tf2_msgs/msg/TFMessage",
    "/tf_static": "tf2_msgs/msg/TFMessage",
    "/joints": "sensor_msgs/msg/JointState",
}
TF = ("/ft", "/tf", "/tf_static")


def bag(
    path: Path,
    spoil: Spoil = lambda _topic, _row, made: made,
    *,
    plugin: StoragePlugin = StoragePlugin.SQLITE3,
    topics: tuple[str, ...] = ("/ft", "/pose"),
    rows: int | None = None,
) -> Path:
    """Write the topics; `spoil` replaces messages, or leaves them out with None."""
    t_wrench, t_pose, measured, q, quat, p = data()
    made: dict[str, list[tuple[float, Any]]] = {topic: [] for topic in topics}

    half = [0.0, 0.0, 0.1], [0.0, 0.0, 0.0, 1.0]

    def ft(row: int, t_s: float) -> Any:
        return message(TOPICS["/ft"], header=header(t_s, "ft"), wrench=wrench_of(measured[row]))

    def pose(row: int, t_s: float) -> Any:
        return message(TOPICS["/pose"], header=header(t_s), pose=pose_of(p[row], quat[row]))

    def moving(row: int, t_s: float) -> Any:
        above = p[row] - Rotation.from_quat(quat[row]).apply(half[0])
        other = transform(t_s, "world", "camera", [1, 2, 3], [0, 0, 0, 1])
        return tf(other, transform(t_s, "base", "half", above, quat[row]))

    def fixed(_row: int, _t_s: float) -> Any:
        return tf(transform(0.0, "half", "flange", *half))

    def joints(row: int, t_s: float) -> Any:
        none = np.zeros(0)
        named = [*JOINTS, "finger"]
        state = {"header": header(t_s, ""), "name": named, "position": np.append(q[row], 0.1)}
        return message(TOPICS["/joints"], **state, velocity=none, effort=none)

    makers: dict[str, Callable[[int, float], Any]] = {
        "/ft": ft,
        "/pose": pose,
        "/tf": moving,
        "/tf_static": fixed,
        "/joints": joints,
    }
    late_s = [6.0]  # as a latched message may be
    for topic in topics:
        times_s = {"/ft": t_wrench[:rows].tolist(), "/tf_static": late_s}.get(topic, t_pose[:rows].tolist())
        for row, t_s in enumerate(times_s):
            if (one := spoil(topic, row, makers[topic](row, t_s))) is not None:
                made[topic].append((t_s, one))
    with Writer(path, version=9, storage_plugin=plugin) as writer:
        for topic, messages in made.items():
            connection = writer.add_connection(topic, TOPICS[topic], typestore=STORE)
            for t_s, one in messages:
                cdr = STORE.serialize_cdr(one, TOPICS[topic])
                writer.write(connection, T0_NS + round(1e9 * t_s) + 5_000_000, cdr)  # received 5 ms later
    return path


def solved(path: Path, *topics: str | None) -> Any:
    tables = read_bag(path, *(topics or (None, None)))
    return solve_recording(tables, known=None, point_mass=True, up_in_base=None)


def numbers(result: Any) -> Any:
    return np.concatenate([np.ravel(value) for value in asdict(result.parameters).values()])


@pytest.mark.slow
def test_a_bag_with_transforms_is_solved_from_its_motion(tmp_path: Path) -> None:
    (path,) = bag(tmp_path / "bag", plugin=StoragePlugin.MCAP, topics=TF).glob("*.mcap")  # a file of its own
    assert is_bag(path)
    found = read_bag(path, None, "tf?base=base&flange=flange")
    t_wrench, t_pose, measured, _, quat, p = data()
    (wrenches,), (poses,) = found[0].wrenches(), found[1].poses()
    assert np.allclose(wrenches.t_s, t_wrench, rtol=0, atol=1e-9)
    assert np.allclose(poses.t_s, t_pose, rtol=0, atol=1e-9)
    assert np.array_equal(wrenches.values, measured)
    R = Rotation.from_quat(quat).as_matrix().reshape(-1, 9)
    assert np.allclose(poses.values, np.hstack([R, p]), rtol=0, atol=1e-12)
    result = solve_recording(found, known=None, point_mass=True, up_in_base=None)
    assert result.motion is not None
    assert abs(result.motion.delay_s - 0.04) < 1e-3
    assert abs(result.mass_kg - TRUTH["mass_kg"]) < 3 * result.sigma["mass_kg"]
    error_m = result.p_sensor_com_m - TRUTH["p_sensor_com_m"]
    assert (np.abs(error_m) < 4 * np.array(result.sigma["p_sensor_com_m"])).all()


@pytest.fixture(scope="module")
def expected(tmp_path_factory: pytest.TempPathFactory) -> Any:
    """The same data as CSV, written here."""
    folder = tmp_path_factory.mktemp("csv")
    t_wrench, t_pose, measured, _, quat, p = data()
    pair = folder / "w.csv", folder / "p.csv"
    for file, columns, names in (
        (pair[0], [t_wrench, measured], "t,fx,fy,fz,tx,ty,tz"),
        (pair[1], [t_pose, quat, p], "t,qx,qy,qz,qw,x,y,z"),
    ):
        np.savetxt(file, np.column_stack(columns), "%.17g", ",", header=names, comments="")
    return solve_recording((Table(pair[0]), Table(pair[1])), known=None, point_mass=True, up_in_base=None)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("plugin", "topics", "pose_topic"),
    [
        (StoragePlugin.SQLITE3, ("/ft", "/pose"), None),
        (StoragePlugin.MCAP, ("/ft", "/pose"), "/pose"),
        (StoragePlugin.SQLITE3, ("/ft", "/pose", "/joints"), "/joints?urdf={urdf}&flange=flange&base=link0"),
    ],
)
def test_a_bag_is_solved_as_the_csv_of_the_same_data(
    plugin: StoragePlugin, topics: tuple[str, ...], pose_topic: str | None, tmp_path: Path, expected: Any
) -> None:
    path, urdf = bag(tmp_path / "bag", plugin=plugin, topics=topics), tmp_path / "arm.urdf"
    urdf.write_text(URDF)
    if plugin == StoragePlugin.MCAP:
        path = next(path.glob("*.mcap"))  # a file of its own
    assert is_bag(path)
    result = solved(path, None, pose_topic and pose_topic.format(urdf=urdf))
    assert np.allclose(numbers(result), numbers(expected), rtol=0, atol=1e-9)
    assert abs(result.motion.delay_s - 0.04) < 1e-3
    assert abs(result.mass_kg - TRUTH["mass_kg"]) < 3 * result.sigma["mass_kg"]


def changed(topic: str, change: Callable[[Any], object], every: int = 50) -> Spoil:
    def spoil(of: str, row: int, made: Any) -> Any:
        if of == topic and row % every == every - 1:
            change(made)
        return made

    return spoil


def set_stamp(made: Any) -> None:
    made.header.stamp.sec = made.header.stamp.nanosec = 0


def set_nan(made: Any) -> None:
    made.wrench.force.x = float("nan")


def longer(made: Any) -> None:
    made.header.frame_id = 12 * "a"


def cut(path: Path) -> None:
    (file,) = path.glob("*.db3")
    file.write_bytes(file.read_bytes()[:5000])


def forget(path: Path) -> None:
    (file,) = path.glob("*.db3")
    file.unlink()


def retype(path: Path) -> None:
    file = path / "metadata.yaml"
    file.write_text(file.read_text().replace("WrenchStamped", "Wrench"))


CASES: list[tuple[str, dict[str, Any], str | None, str | None, Any]] = [
    ("stamp 0", {"spoil": changed("/ft", set_stamp)}, None, None, None),
    ("not finite", {"spoil": changed("/ft", set_nan)}, None, None, None),
    ("frame changes", {"spoil": changed("/ft", lambda m: setattr(m.header, "frame_id", "ab"))}, None, None, None),
    ("differ in length", {"spoil": changed("/ft", longer)}, None, None, None),
    ("norm", {"spoil": changed("/pose", lambda m: setattr(m.pose.orientation, "w", 3.0))}, None, None, None),
    ("not finite", {"spoil": changed("/pose", lambda m: setattr(m.pose.position, "x", np.inf))}, None, None, None),
    ("stamp 0", {"spoil": changed("/pose", set_stamp)}, None, None, None),
    ("/ft has no message", {"spoil": lambda t, _, m: None if t == "/ft" else m}, None, None, None),
    ("no such topic .* it has /ft", {}, "/force", None, None),
    ("no such topic .* it has /pose", {}, None, "/poses", None),
    ("no topic of geometry_msgs/msg/PoseStamped", {"topics": ("/ft", "/joints")}, None, None, None),
    ("no topic of geometry_msgs/msg/WrenchStamped", {"topics": ("/pose",)}, None, None, None),
    ("tf has no frame 'tool1'", {"topics": TF}, None, "tf?base=base&flange=tool1", None),
    ("does not connect base with camera", {"topics": TF}, None, "tf?base=base&flange=camera", None),
    ("are static, so none has a time", {"topics": TF}, None, "tf?base=half&flange=flange", None),
    ("tf needs base and flange", {"topics": TF}, None, "tf?base=base", None),
    ("the bag has no topic /tf", {}, None, "tf?base=base&flange=flange", None),
    ("is not a URDF", {"topics": ("/ft", "/joints")}, None, "/joints?urdf=none.urdf&flange=f", None),
    ("apply only to tf and urdf", {}, None, "/pose?base=base", None),
    ("cannot be read", {}, None, None, cut),
    ("cannot be read", {}, None, None, forget),
    ("no topic of geometry_msgs/msg/WrenchStamped", {}, None, None, retype),
]


@pytest.mark.parametrize(("words", "made", "wrench_topic", "pose_topic", "damage"), CASES)
def test_a_bag_that_cannot_be_used_is_one_sentence(
    words: str, made: dict[str, Any], wrench_topic: str | None, pose_topic: str | None, damage: Any, tmp_path: Path
) -> None:
    path = bag(tmp_path / "bag", **made, rows=60)
    if damage is not None:
        damage(path)
    with pytest.raises(FtdriveError) as error:
        read_bag(path, wrench_topic, pose_topic)
    assert re.search(words, str(error.value))
    assert "\n" not in str(error.value)


def test_a_file_that_is_no_bag_of_ros_1_is_not_read_to_the_end_of_its_line(tmp_path: Path) -> None:
    (tmp_path / "a.bag").write_bytes(bytes(1000))
    with pytest.raises(BadDataset, match=r"^a\.bag: the first bytes are not those of a ROS 1 bag"):
        read_bag(tmp_path / "a.bag", None, None)


def test_a_file_of_ros_1_and_a_bag_without_stamps_are_read(tmp_path: Path) -> None:
    from rosbags.rosbag1 import Writer as Writer1

    store: Any = get_typestore(Stores.ROS1_NOETIC)
    t_wrench, t_pose, measured, _, quat, p = data()
    path = tmp_path / "one.bag"
    with Writer1(path) as writer:
        for topic, times, make in (
            ("/ft", t_wrench, lambda row: wrench_of(measured[row])),
            ("/pose", t_pose, lambda row: pose_of(p[row], quat[row])),
        ):
            kind = TOPICS[topic]
            connection = writer.add_connection(topic, kind, typestore=store)
            for row, t_s in enumerate(times):
                stamp_ns = 0 if topic == "/ft" else T0_NS + round(1e9 * t_s)
                stamp = message("builtin_interfaces/msg/Time", sec=stamp_ns // 10**9, nanosec=stamp_ns % 10**9)
                head = store.types["std_msgs/msg/Header"](seq=row, stamp=stamp, frame_id="tool")
                content = store.serialize_ros1(store.types[kind](head, make(row)), kind)  # type: ignore[no-untyped-call]
                writer.write(connection, T0_NS + round(1e9 * t_s), content)
    assert is_bag(path)
    wrenches, poses = read_bag(path, None, None)
    (read,), (turned,) = wrenches.wrenches(), poses.poses()
    assert np.array_equal(read.values, measured)
    assert np.allclose(read.t_s, t_wrench, atol=1e-6)  # of receipt
    assert np.allclose(turned.t_s, t_pose, atol=1e-6)
    assert np.allclose(turned.values[:, 9:], p)


@pytest.mark.slow
def test_the_file_of_a_folder_is_a_bag_by_itself(tmp_path: Path) -> None:
    (path,) = bag(tmp_path / "bag", rows=100).glob("*.db3")
    assert is_bag(path)
    (read,) = read_bag(path, None, None)[0].wrenches()
    assert np.array_equal(read.values, data()[2][:100])
