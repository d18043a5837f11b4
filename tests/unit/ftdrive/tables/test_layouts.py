"""Files in the shape of 20 programs, two of each, hold the same poses or the same recording as a plain one."""

import gzip
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from ftdrive.tables.table import Table, TableOptions, WrenchAxes

Array = NDArray[np.float64]
G = np.array([0.0, 0.0, -9.81])
MOUNTING = Rotation.from_euler("zyx", [30.0, 2.0, 1.0], degrees=True)
LBF, IN = 4.4482216152605, 0.0254


@dataclass(frozen=True)
class Truth:
    """Times, orientations, positions of the flange and wrenches."""

    t_s: Array
    R: Rotation
    p_m: Array
    wrench: Array


def truth(n: int, step_s: float) -> Truth:
    rng = np.random.default_rng(n)
    t_s = np.linspace(0.0, step_s * (n - 1), n)
    R = Rotation.random(n, random_state=n)
    if n > 100:  # a slow rotation
        R = Rotation.from_rotvec(np.cumsum(rng.normal(size=(n, 3)), axis=0) * 1e-3)
    force = MOUNTING.inv().apply(R.inv().apply(0.9 * G))
    free = np.hstack([force, np.cross([0.01, 0.02, 0.06], force)]) + np.array([1.0, 2.0, 3.0, 0.1, 0.2, 0.3])
    noise = rng.normal(size=(n, 6)) * np.repeat([0.02, 0.001], 3)
    return Truth(t_s, R, rng.uniform(-0.8, 0.8, (n, 3)), np.round(free + noise, 6).astype(np.float64))


POSES, RECORDING = truth(24, 8.0), truth(600, 0.002)
Table_ = Mapping[str, Array]


def columns(names: str, values: Array) -> dict[str, Array]:
    return dict(zip(names.split(), values.T, strict=True))


def axes(pattern: str, letters: str = "xyz") -> str:
    return " ".join(pattern.replace("?", letter) for letter in letters)


def text(
    table: Table_,
    separator: str = ",",
    decimal: str = ".",
    head: str = "",
    units: Sequence[str] = (),
    header: bool = True,
    newline: str = "\n",
) -> str:
    """A table as text; NaN is a blank cell."""
    lines = [separator.join(table)] if header else []
    lines += [separator.join(units)] if units else []
    for row in zip(*table.values(), strict=True):
        cells = ["" if np.isnan(value) else repr(float(value)).replace(".", decimal) for value in row]
        lines.append(separator.join(cells))
    return head + newline.join(lines) + newline


@dataclass(frozen=True)
class Case:
    """Content of a file, and of a second one with the poses; the words that say what was recognised."""

    content: str | bytes
    words: str = ""
    poses: str | None = None
    options: TableOptions = field(default_factory=TableOptions)
    origin_s: float = 0.0


W = "fx fy fz tx ty tz"
CASES: dict[str, Callable[[], Case]] = {}


def case(name: str) -> Callable[[Callable[[], Case]], Callable[[], Case]]:
    def add(make: Callable[[], Case]) -> Callable[[], Case]:
        CASES[name] = make
        return make

    return add


def wrench(one: Truth, names: str = W, factors: Sequence[float] = (1, 1)) -> dict[str, Array]:
    return columns(names, one.wrench / np.repeat(factors, 3))


def quaternion(one: Truth, names: str = "qx qy qz qw") -> dict[str, Array]:
    return columns(names, one.R.as_quat())


def w_first(one: Truth, names: str) -> dict[str, Array]:
    return columns(names, np.roll(one.R.as_quat(), 1, axis=1))


def matrix(one: Truth) -> dict[str, Array]:
    names = " ".join(f"r{i}{j}" for i in (1, 2, 3) for j in (1, 2, 3))
    return columns(names, one.R.as_matrix().reshape(-1, 9))


def position(one: Truth, names: str = "x y z", size: float = 1.0) -> dict[str, Array]:
    return columns(names, one.p_m / size)


def t(one: Truth, name: str = "t", size: float = 1.0, origin_s: float = 0.0) -> dict[str, Array]:
    return {name: np.round((one.t_s + origin_s) / size, 9)}


def blank(one: dict[str, Array], rows: slice) -> dict[str, Array]:
    """Leave all but some rows blank."""
    kept = {name: np.full(len(values), np.nan) for name, values in one.items()}
    for name, values in one.items():
        kept[name][rows] = values[rows]
    return kept


@case("ftdrive, matrix")
def _() -> Case:
    return Case(text(t(POSES) | wrench(POSES) | matrix(POSES)))


@case("ftdrive, rotation vector, tabs")
def _() -> Case:
    return Case(text(t(POSES) | wrench(POSES) | columns("rx ry rz", POSES.R.as_rotvec()), "\t"), "tabs")


@case("own script, roll pitch yaw in degrees")
def _() -> Case:
    angles = columns("Roll Pitch Yaw", POSES.R.as_euler("xyz", degrees=True))
    return Case(text(t(POSES, "time_ms", 1e-3) | wrench(POSES, "Fx Fy Fz Mx My Mz") | angles), "angles in degrees")


@case("own script, Euler angles in rad")
def _() -> Case:
    angles = columns("euler_x euler_y euler_z", POSES.R.as_euler("ZYX")[:, ::-1])
    options = TableOptions(euler="ZYX")
    return Case(
        text(t(POSES) | wrench(POSES, "force_x force_y force_z moment_x moment_y moment_z") | angles), options=options
    )


@case("numpy.savetxt, header behind #")
def _() -> Case:
    return Case(text(t(POSES) | wrench(POSES) | quaternion(POSES), " ", head="# "), "spaces")


@case("numpy.savetxt, no header")
def _() -> Case:
    table = t(POSES) | wrench(POSES) | quaternion(POSES)
    names = {name: str(1 + i) for i, name in enumerate(table)}
    return Case(text(table, "   ", header=False), "spaces, no header", options=TableOptions(columns=names))


@case("pandas, index column")
def _() -> Case:
    index = {"": np.arange(len(POSES.t_s), dtype=float)}
    return Case(text(index | t(POSES, "timestamp") | wrench(POSES) | quaternion(POSES, "q_x q_y q_z q_w")))


@case("pandas, gzip")
def _() -> Case:
    table = t(POSES, "time") | wrench(POSES, "FX FY FZ TX TY TZ") | quaternion(POSES, "quat_x quat_y quat_z quat_w")
    return Case(gzip.compress(text(table).encode()), "gzip")


@case("Excel, German")
def _() -> Case:
    names = "Kraft_x Kraft_y Kraft_z Moment_x Moment_y Moment_z"
    content = text(t(POSES, "Zeit") | wrench(POSES, names) | quaternion(POSES), ";", ",", newline="\r\n")
    return Case(content.encode("utf-8-sig"), "semicolons, decimal comma")


@case("Excel, Unicode text")
def _() -> Case:
    content = text(t(POSES) | wrench(POSES) | quaternion(POSES), "\t", ",", newline="\r\n")
    return Case(content.encode("utf-16"), "tabs, decimal comma, UTF-16")


@case("LabVIEW, units below the names")
def _() -> Case:
    units = ["s", *["N"] * 3, *["N-mm"] * 3, *["deg"] * 3]
    angles = columns("Roll Pitch Yaw", POSES.R.as_euler("xyz", degrees=True))
    table = t(POSES, "X_Value") | wrench(POSES, "Fx Fy Fz Tx Ty Tz", (1, 1e-3)) | angles
    head = "LabVIEW Measurement\nWriter_Version\t2\nOperator\tab\n\n"
    return Case(text(table, "\t", head=head, units=units), "tabs, names in line 5, units below the names")


@case("LabVIEW, decimal comma")
def _() -> Case:
    return Case(
        text(t(POSES, "Time") | wrench(POSES, "Fx Fy Fz Tx Ty Tz") | quaternion(POSES), "\t", ","), "decimal comma"
    )


@case("MATLAB, units behind the names")
def _() -> Case:
    names = "Fx_N Fy_N Fz_N Tx_Nmm Ty_Nmm Tz_Nmm"
    return Case(text(t(POSES, "t_ms", 1e-3) | wrench(POSES, names, (1, 1e-3)) | quaternion(POSES)))


@case("MATLAB, one force in kgf")
def _() -> Case:
    table = {
        f"{name} [{unit}]": values
        for (name, values), unit in zip(
            wrench(POSES, factors=(9.80665, 0.0980665)).items(), ["kgf"] * 3 + ["kgf·cm"] * 3, strict=True
        )
    }
    return Case(text(t(POSES, "time (s)") | table | quaternion(POSES)))


@case("ATI, N and N-m in brackets")
def _() -> Case:
    names = "Fx|(N) Fy|(N) Fz|(N) Tx|(N-m) Ty|(N-m) Tz|(N-m)"
    table = {name.replace("|", " "): values for name, values in wrench(POSES, names).items()}
    return Case(text(table | quaternion(POSES), head="Sensor FT12345\nForce Units: N\n"), "names in line 3")


@case("ATI, lbf and lbf-in")
def _() -> Case:
    names = "Fx|[lbf] Fy|[lbf] Fz|[lbf] Tx|[lbf-in] Ty|[lbf-in] Tz|[lbf-in]"
    table = {name.replace("|", " "): values for name, values in wrench(POSES, names, (LBF, LBF * IN)).items()}
    return Case(text(t(POSES, "Time") | table | quaternion(POSES)))


@case("netft, raw beside")
def _() -> Case:
    raw = columns("raw_fx raw_fy raw_fz raw_tx raw_ty raw_tz", POSES.wrench * 1e6)
    return Case(text(t(POSES, "elapsed_seconds") | raw | wrench(POSES) | quaternion(POSES)), "columns of netft")


@case("netft, with a file of poses")
def _() -> Case:
    poses = text(t(RECORDING) | quaternion(RECORDING) | position(RECORDING))
    return Case(text(t(RECORDING, "elapsed_seconds") | wrench(RECORDING)), "columns of netft", poses)


STAMP_S = 1.7e9


def of_topics(clock: Table_, message: str, pose: tuple[str, str], words: str) -> Case:
    """Two files with the names of messages: `?` is an axis, of force and torque, orientation and position."""
    names = " ".join(axes(message.replace("*", kind)) for kind in ("force", "torque"))
    poses = quaternion(RECORDING, axes(pose[0], "xyzw")) | position(RECORDING, axes(pose[1]))
    return Case(text({**clock, **wrench(RECORDING, names)}), words, text({**clock, **poses}), origin_s=STAMP_S)


@case("rostopic echo -p, two files")
def _() -> Case:
    clock = t(RECORDING, "%time", 1e-9, STAMP_S) | t(RECORDING, "field.header.stamp", 1e-9, STAMP_S)
    pose = "field.pose.orientation.?", "field.pose.position.?"
    return of_topics(clock, "field.wrench.*.?", pose, "time in ns")


@case("rostopic echo -p, TF")
def _() -> Case:
    pose = "field.transform.rotation.?", "field.transform.translation.?"
    return of_topics(t(RECORDING, "%time", 1e-9, STAMP_S), "field.wrench.*.?", pose, "time in ns")


def stamps(names: str) -> dict[str, Array]:
    ns = np.rint(RECORDING.t_s * 1e9)
    return columns(names, np.column_stack([STAMP_S + ns // 1e9, ns % 1e9]))


@case("rosbag_to_csv")
def _() -> Case:
    clock = t(RECORDING, "time", 1.0, 5.0) | stamps(".header.stamp.secs .header.stamp.nsecs")
    return of_topics(clock, ".wrench.*.?", (".pose.orientation.?", ".pose.position.?"), "ROS topics")


@case("bagpy")
def _() -> Case:
    clock = stamps("header.stamp.sec header.stamp.nanosec")
    return of_topics(clock, "wrench.*.?", ("pose.orientation.?", "pose.position.?"), "ROS topics")


PLOTJUGGLER = axes("/ft/wrench/force/?") + " " + axes("/ft/wrench/torque/?")


def plotjuggler_poses(one: Truth) -> dict[str, Array]:
    return quaternion(one, axes("/tcp/pose/orientation/?", "xyzw")) | position(one, axes("/tcp/pose/position/?"))


@case("PlotJuggler, blank cells")
def _() -> Case:
    table = blank(wrench(RECORDING, PLOTJUGGLER), slice(0, None, 2)) | blank(
        plotjuggler_poses(RECORDING), slice(1, None, 2)
    )
    stamps_ = t(RECORDING, "/ft/header/stamp") | t(RECORDING, "/tcp/header/stamp")
    return Case(text(t(RECORDING, "__time") | stamps_ | table), "ROS topics")


@case("PlotJuggler, one clock")
def _() -> Case:
    return Case(
        text(t(RECORDING, "timestamp") | wrench(RECORDING, PLOTJUGGLER) | plotjuggler_poses(RECORDING)), "ROS topics"
    )


@case("Foxglove, receive time")
def _() -> Case:
    pose = "transform.rotation.?", "transform.translation.?"
    return of_topics(t(RECORDING, "receive_time", 1e-9, STAMP_S), "wrench.*.?", pose, "time in ns")


@case("Foxglove, poses at rest")
def _() -> Case:
    names = axes("/wrench.force.?") + " " + axes("/wrench.torque.?")
    table = wrench(POSES, names) | quaternion(POSES, axes("/pose.orientation.?", "xyzw"))
    return Case(text(t(POSES, "timestamp") | table), "ROS topics")


TCP = Rotation.from_euler("xyz", [10.0, 20.0, 30.0], degrees=True), np.array([0.02, -0.01, 0.15])


def tcp_pose(one: Truth, names: str) -> dict[str, Array]:
    R = one.R * TCP[0]
    return columns(names, np.hstack([one.p_m + one.R.apply(TCP[1]), R.as_rotvec()]))


def about_tcp(one: Truth, names: str, in_base: bool) -> dict[str, Array]:
    force, torque = np.hsplit(one.wrench, 2)
    torque = torque - np.cross(TCP[1], force)
    turn = one.R if in_base else TCP[0].inv()
    return columns(names, np.hstack([turn.apply(force), turn.apply(torque)]))


def with_tcp(axes: WrenchAxes | None = None) -> TableOptions:
    return TableOptions(R_flange_tcp=TCP[0].as_matrix(), p_flange_tcp_m=TCP[1], wrench_axes=axes)


RTDE_POSE, RTDE_FORCE = (" ".join(f"actual_TCP_{name}_{i}" for i in range(6)) for name in ("pose", "force"))


@case("RTDE record, spaces, force in base axes about the TCP")
def _() -> Case:
    table = t(POSES, "timestamp") | tcp_pose(POSES, RTDE_POSE) | about_tcp(POSES, RTDE_FORCE, in_base=True)
    return Case(text(table, " "), "columns of RTDE record", options=with_tcp())


@case("RTDE record, raw wrench")
def _() -> Case:
    table = t(RECORDING, "timestamp") | tcp_pose(RECORDING, RTDE_POSE)
    table |= wrench(RECORDING, " ".join(f"ft_raw_wrench_{i}" for i in range(6)))
    return Case(text(table), "columns of RTDE record", options=with_tcp())


@case("KUKA, degrees and mm")
def _() -> Case:
    angles = columns("A B C", POSES.R.as_euler("ZYX", degrees=True))
    return Case(
        text(t(POSES) | position(POSES, "X Y Z", 1e-3) | angles | wrench(POSES, "Fx Fy Fz Mx My Mz"), ";"), "KUKA"
    )


@case("KUKA, RSI, wrench about the TCP")
def _() -> Case:
    R, p = POSES.R * TCP[0], POSES.p_m + POSES.R.apply(TCP[1])
    table = columns("RIst_X RIst_Y RIst_Z", 1e3 * p) | columns("RIst_A RIst_B RIst_C", R.as_euler("ZYX", degrees=True))
    table |= about_tcp(POSES, "Fx Fy Fz Mx My Mz", in_base=False)
    return Case(text(t(POSES) | table), "KUKA", options=with_tcp("tcp"))


@case("xArm")
def _() -> Case:
    angles = columns("roll pitch yaw", POSES.R.as_euler("xyz", degrees=True))
    return Case(text(t(POSES, "timestamp") | position(POSES, "x y z", 1e-3) | angles | wrench(POSES)), "in mm")


@case("xArm, with a prefix and a wrong sign")
def _() -> Case:
    angles = columns("tcp_roll tcp_pitch tcp_yaw", POSES.R.as_euler("xyz", degrees=True))
    table = t(POSES, "timestamp") | angles | columns(W, -POSES.wrench)
    return Case(text(table), "xArm", options=TableOptions(sign=-1))


@case("Fanuc")
def _() -> Case:
    angles = columns("W P R", POSES.R.as_euler("xyz", degrees=True))
    return Case(text(t(POSES) | position(POSES, "X Y Z", 1e-3) | angles | wrench(POSES)), "Fanuc")


@case("Kawasaki")
def _() -> Case:
    angles = columns("O A T", POSES.R.as_euler("ZYZ", degrees=True))
    return Case(text(t(POSES) | position(POSES, "X Y Z", 1e-3) | angles | wrench(POSES)), "Kawasaki")


@case("ABB")
def _() -> Case:
    return Case(
        text(t(POSES) | position(POSES, "x y z", 1e-3) | w_first(POSES, "q1 q2 q3 q4") | wrench(POSES), ";"), "ABB"
    )


@case("ABB, prefix")
def _() -> Case:
    return Case(text(t(POSES) | w_first(POSES, "rob_q1 rob_q2 rob_q3 rob_q4") | wrench(POSES)), "ABB")


def transform(one: Truth, names: str) -> dict[str, Array]:
    T = np.tile(np.eye(4), (len(one.t_s), 1, 1))
    T[:, :3, :3], T[:, :3, 3] = one.R.as_matrix(), one.p_m
    return columns(names, T.swapaxes(1, 2).reshape(-1, 16))


@case("Franka")
def _() -> Case:
    table = transform(POSES, " ".join(f"O_T_EE[{i}]" for i in range(16)))
    return Case(
        text(t(POSES, "time") | table | wrench(POSES, " ".join(f"K_F_ext_hat_K[{i}]" for i in range(6)))), "Franka"
    )


@case("Franka, recording")
def _() -> Case:
    table = transform(RECORDING, " ".join(f"O_T_EE_{i}" for i in range(16)))
    return Case(
        text(t(RECORDING, "time") | table | wrench(RECORDING, " ".join(f"K_F_ext_hat_K_{i}" for i in range(6)))),
        "Franka",
    )


@case("MuJoCo")
def _() -> Case:
    names = "force_0 force_1 force_2 torque_0 torque_1 torque_2"
    return Case(text(t(POSES, "time") | wrench(POSES, names) | w_first(POSES, "quat_0 quat_1 quat_2 quat_3")), "MuJoCo")


@case("evenly spaced samples without times")
def _() -> Case:
    table = wrench(RECORDING, "force_x force_y force_z torque_x torque_y torque_z") | quaternion(RECORDING)
    return Case(text(table | position(RECORDING, "pos_x pos_y pos_z")), options=TableOptions(rate_Hz=500.0))


def read(name: str, tmp_path: Path) -> tuple[Case, Table, Table]:
    one = CASES[name]()
    path = tmp_path / "wrench.csv"
    path.write_bytes(one.content if isinstance(one.content, bytes) else one.content.encode())
    table = Table(path, one.options)
    if one.poses is None:
        return one, table, table
    path = tmp_path / "poses.csv"
    path.write_text(one.poses)
    return one, table, Table(path, one.options)


@pytest.mark.parametrize("name", CASES)
def test_a_file_of_another_program_has_the_same_numbers(name: str, tmp_path: Path) -> None:
    one, table, poses = read(name, tmp_path)
    assert one.words in table.words
    if table is poses and not table.in_motion:
        dataset = table.dataset()
        np.testing.assert_allclose(dataset.R_base_flange, POSES.R.as_matrix(), atol=1e-9)
        np.testing.assert_allclose(dataset.wrench, POSES.wrench, atol=1e-9)
        return
    wrench, pose = (
        [np.concatenate(each) for each in zip(*((one.t_s, one.values) for one in rows), strict=True)]
        for rows in (table.wrenches(), poses.poses())
    )
    halves = (slice(0, None, 2), slice(1, None, 2)) if "blank" in name else (slice(None), slice(None))
    truth_ = np.hstack([RECORDING.R.as_matrix().reshape(-1, 9), RECORDING.p_m])
    for (t_s, values), expected, rows in zip((wrench, pose), (RECORDING.wrench, truth_), halves, strict=True):
        np.testing.assert_allclose(values, expected[rows][:, : values.shape[1]], atol=1e-9)
        np.testing.assert_allclose(t_s - one.origin_s, RECORDING.t_s[rows], atol=1e-6)  # of a float64 since 1970
