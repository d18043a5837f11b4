"""Samples as ROS 2 messages: CDR bytes, `ros2msg` schemas and topics, shared by recordings and servers.

CDR: 4 bytes that say "little endian", then the fields, each aligned to its size counted from there. All but the stamp
and the numbers is the same in every message of a block, so that a block is packed as one array of records.
"""

import struct
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ftdrive.live.samples import quaternions
from ftdrivers.interfaces import Array

RAW, COMPENSATED, POSE, JOINTS = "/ft_raw", "/ft_compensated", "/flange_pose", "/joint_states"
TRANSFORMS = "/tf"

Messages = NDArray[np.void]
"""(n,) messages, all of one length; `tolist` makes bytes of them."""

ENCODING = b"\0\1\0\0"
"""The first bytes of a message: CDR, little endian."""

JOINT_NAMES = (
    "shoulder_pan_joint",
    "shoulder_lift_joint",
    "elbow_joint",
    "wrist_1_joint",
    "wrist_2_joint",
    "wrist_3_joint",
)

_HEADER = """std_msgs/Header
builtin_interfaces/Time stamp
string frame_id"""
_TIME = """builtin_interfaces/Time
int32 sec
uint32 nanosec"""
_VECTOR = """geometry_msgs/Vector3
float64 x
float64 y
float64 z"""
_WRENCH = """geometry_msgs/Wrench
Vector3 force
Vector3 torque"""
_POSE = """geometry_msgs/Pose
Point position
Quaternion orientation"""
_POINT = """geometry_msgs/Point
float64 x
float64 y
float64 z"""
_QUATERNION = """geometry_msgs/Quaternion
float64 x
float64 y
float64 z
float64 w"""


@dataclass(frozen=True, slots=True)
class Schema:
    """A message type and its definition in the encoding `ros2msg`."""

    name: str
    text: str


def _schema(name: str, fields: str, *used: str) -> Schema:
    return Schema(name, f"\n{'=' * 80}\nMSG: ".join((fields, *used, _HEADER, _TIME)))


_WRENCH_STAMPED = _schema("geometry_msgs/msg/WrenchStamped", "std_msgs/Header header\nWrench wrench", _WRENCH, _VECTOR)

SCHEMAS = {
    RAW: _WRENCH_STAMPED,
    COMPENSATED: _WRENCH_STAMPED,
    POSE: _schema("geometry_msgs/msg/PoseStamped", "std_msgs/Header header\nPose pose", _POSE, _POINT, _QUATERNION),
    JOINTS: _schema(
        "sensor_msgs/msg/JointState",
        "std_msgs/Header header\nstring[] name\nfloat64[] position\nfloat64[] velocity\nfloat64[] effort",
    ),
}
"""The schema of each topic."""
TRANSFORMS_SCHEMA = _schema(
    "tf2_msgs/msg/TFMessage",
    "geometry_msgs/TransformStamped[] transforms",
    """geometry_msgs/TransformStamped
std_msgs/Header header
string child_frame_id
Transform transform""",
    """geometry_msgs/Transform
Vector3 translation
Quaternion rotation""",
    _VECTOR,
    _QUATERNION,
)


def pack_wrenches(t_utc_ns: NDArray[np.int64], wrench: Array, frame: str) -> Messages:
    """Pack (n, 6) wrenches, N and N·m, as WrenchStamped."""
    return _pack(t_utc_ns, _strings(frame), wrench)


def pack_poses(t_utc_ns: NDArray[np.int64], R_base_flange: Array, p_base_flange_m: Array) -> Messages:
    """Pack poses (n, 3, 3) and (n, 3) of the flange in base as PoseStamped."""
    return pack_pose_numbers(t_utc_ns, np.concatenate([p_base_flange_m, quaternions(R_base_flange)], axis=1))


def pack_pose_numbers(t_utc_ns: NDArray[np.int64], pose: Array) -> Messages:
    """Pack (n, 7) poses, position in m and quaternion x, y, z, w, as PoseStamped."""
    return _pack(t_utc_ns, _strings("base"), pose)


def pack_joints(t_utc_ns: NDArray[np.int64], q_rad: Array) -> Messages:
    """Pack (n, 6) joint angles as JointState without velocity and effort."""
    names = _strings("", len(JOINT_NAMES), *JOINT_NAMES, q_rad.shape[1])
    return _pack(t_utc_ns, names, q_rad, struct.pack("<II", 0, 0))


def pack_transforms(t_utc_ns: NDArray[np.int64], transforms: Sequence[tuple[str, str, Array, Array]]) -> Messages:
    """Pack transforms as TFMessage.

    Parameters
    ----------
    t_utc_ns : array, shape (n,)
    transforms : sequence of tuple
        Parent, child, origin (3,) or (n, 3) in m and orientation (3, 3) or (n, 3, 3) of the child in the parent.
    """
    n = len(t_utc_ns)
    values: list[NDArray[np.void]] = [_column(n, np.void(ENCODING + struct.pack("<I", len(transforms))))]
    for number, (parent, child, p_m, R) in enumerate(transforms):
        stamp = np.zeros(n, [("sec", "<i4"), ("nanosec", "<u4")])
        stamp["sec"], stamp["nanosec"] = np.divmod(t_utc_ns, 1_000_000_000)
        # the count stands before the first
        names = _strings(parent, child, start=4 if number == 0 else 0)
        pose = np.empty((n, 7))
        pose[:, :3], pose[:, 3:] = p_m, quaternions(R.reshape(-1, 3, 3))
        values += [stamp, _column(n, np.void(names)), pose.view("V56")[:, 0]]
    parts = [np.ascontiguousarray(value).view(np.uint8).reshape(n, value.itemsize) for value in values]
    return np.asarray(np.hstack(parts).view(f"V{sum(part.shape[1] for part in parts)}")[:, 0])


def _column(n: int, value: np.void) -> NDArray[np.void]:
    return np.full(n, value, f"V{value.itemsize}")


def _strings(*fields: str | int, start: int = 0) -> bytes:
    """Pack strings and counts (uint32), each aligned to 4 bytes; what follows is aligned to 8 from `start` before."""
    packed = b""
    for item in fields:
        packed += bytes(-len(packed) % 4)
        if isinstance(item, int):
            packed += struct.pack("<I", item)
        else:
            packed += struct.pack("<I", len(item.encode()) + 1) + item.encode() + b"\0"
    return packed + bytes(-(start + len(packed)) % 8)


def _pack(t_utc_ns: NDArray[np.int64], same: bytes, numbers: Array, end: bytes = b"") -> Messages:
    n, width = numbers.shape
    layout = [
        ("encoding", "V4"),
        ("sec", "<i4"),
        ("nanosec", "<u4"),
        ("same", f"V{len(same)}"),
        ("numbers", "<f8", (width,)),
        ("end", f"V{len(end)}"),
    ]
    # Packed one by one, messages cost 12 µs each.
    records = np.empty(n, layout)
    records["encoding"] = np.void(ENCODING)
    records["sec"], records["nanosec"] = np.divmod(t_utc_ns, 1_000_000_000)
    records["same"] = np.void(same)
    records["numbers"] = numbers
    if end:
        records["end"] = np.void(end)
    return records.view(f"V{records.itemsize}")
