"""Samples as ROS 2 messages: CDR bytes, `ros2msg` schemas and topics, shared by recordings and servers.

CDR: 4 bytes for "little endian", then the fields, each aligned to its size relative to the first field. Only stamps and
numbers differ between the messages of a block, so a block is packed as one array of records.
"""

import struct
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ftdrive.stream.samples import StreamInfo, WrenchFrame, frames_in_flange, quaternions
from ftdrivers.interfaces import Array

RAW, COMPENSATED, POSE, JOINTS = "/ft_raw", "/ft_compensated", "/flange_pose", "/joint_states"
TRANSFORMS = "/tf"
WARNINGS = "tare-refused", "drift", "gap", "stale"
"""Kinds of stream events that ROS 2 nodes and recordings log as warnings."""

Messages = NDArray[np.void]
"""(n,) serialized messages of equal length; `tolist` returns them as bytes."""

Transform = tuple[str, str, Array, Array]
"""Parent frame, child frame, and the child's origin (3,) or (n, 3), m, and orientation (…, 3, 3) in the parent."""

ENCODING = b"\0\1\0\0"
"""First bytes of each serialized message, which mean CDR encoding, little endian."""

JOINT_NAMES = tuple(
    f"{joint}_joint" for joint in ("shoulder_pan", "shoulder_lift", "elbow", "wrist_1", "wrist_2", "wrist_3")
)

_XYZ = "float64 x\nfloat64 y\nfloat64 z"
_HEADER = "std_msgs/Header\nbuiltin_interfaces/Time stamp\nstring frame_id"
_TIME = "builtin_interfaces/Time\nint32 sec\nuint32 nanosec"
_VECTOR, _POINT = f"geometry_msgs/Vector3\n{_XYZ}", f"geometry_msgs/Point\n{_XYZ}"
_QUATERNION = f"geometry_msgs/Quaternion\n{_XYZ}\nfloat64 w"
_WRENCH = "geometry_msgs/Wrench\nVector3 force\nVector3 torque"
_POSE = "geometry_msgs/Pose\nPoint position\nQuaternion orientation"


class Schema(NamedTuple):
    """A message type and its definition in the `ros2msg` encoding."""

    name: str
    text: str


def _message_schema(name: str, fields: str, *used: str) -> Schema:
    return Schema(name, f"\n{'=' * 80}\nMSG: ".join((fields, *used, _HEADER, _TIME)))


_WRENCH_STAMPED = _message_schema(
    "geometry_msgs/msg/WrenchStamped", "std_msgs/Header header\nWrench wrench", _WRENCH, _VECTOR
)

SCHEMAS = {
    RAW: _WRENCH_STAMPED,
    COMPENSATED: _WRENCH_STAMPED,
    POSE: _message_schema(
        "geometry_msgs/msg/PoseStamped", "std_msgs/Header header\nPose pose", _POSE, _POINT, _QUATERNION
    ),
    JOINTS: _message_schema(
        "sensor_msgs/msg/JointState",
        "std_msgs/Header header\nstring[] name\nfloat64[] position\nfloat64[] velocity\nfloat64[] effort",
    ),
}
"""The schema of each topic."""
TRANSFORMS_SCHEMA = _message_schema(
    "tf2_msgs/msg/TFMessage",
    "geometry_msgs/TransformStamped[] transforms",
    "geometry_msgs/TransformStamped\nstd_msgs/Header header\nstring child_frame_id\nTransform transform",
    "geometry_msgs/Transform\nVector3 translation\nQuaternion rotation",
    _VECTOR,
    _QUATERNION,
)


def pack_wrenches(t_utc_ns: NDArray[np.int64], wrench: Array, frame: str) -> Messages:
    """Pack (n, 6) wrenches, N and N·m, as WrenchStamped."""
    return _pack(ENCODING, _stamps(t_utc_ns), _pack_strings(frame), wrench)


def pack_poses(t_utc_ns: NDArray[np.int64], p_base_flange_m: Array, quaternion: Array) -> Messages:
    """Pack poses of the flange in base, (n, 3) and x, y, z, w (n, 4), as PoseStamped."""
    return _pack(ENCODING, _stamps(t_utc_ns), _pack_strings("base"), p_base_flange_m, quaternion)


def pack_joints(t_utc_ns: NDArray[np.int64], q_rad: Array) -> Messages:
    """Pack (n, 6) joint angles as JointState without velocity and effort."""
    names = _pack_strings("", len(JOINT_NAMES), *JOINT_NAMES, q_rad.shape[1])
    return _pack(ENCODING, _stamps(t_utc_ns), names, q_rad, struct.pack("<II", 0, 0))


def transforms_of(
    frame: WrenchFrame, info: StreamInfo, R_base_flange: Array, p_base_flange_m: Array
) -> list[Transform]:
    """Return the transforms of the flange in base (n, …), and of sensor, tcp and wrench frame in the flange."""
    others = frames_in_flange(frame, info, R_base_flange)
    flange = "base", "flange", np.nan_to_num(p_base_flange_m), R_base_flange
    return [flange, *(("flange", name, p_m, R) for name, (R, p_m) in others.items())]


def pack_transforms(t_utc_ns: NDArray[np.int64], transforms: Sequence[Transform]) -> Messages:
    """Pack transforms at n times as TFMessage."""
    parts: list[bytes | NDArray[Any]] = []
    for parent, child, p_m, R in transforms:
        # the number of transforms precedes the first one
        names = _pack_strings(parent, child, start=0 if parts else 4)
        parts += [_stamps(t_utc_ns), names, np.atleast_2d(p_m), quaternions(R.reshape(-1, 3, 3))]
    return _pack(ENCODING + struct.pack("<I", len(transforms)), *parts)


def _stamps(t_utc_ns: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return ROS stamps (n,) as 8-byte integers: seconds in the lower four bytes, nanoseconds in the upper four."""
    seconds, ns = np.divmod(t_utc_ns, 1_000_000_000)
    return np.asarray(seconds + (ns << 32))


def _pack_strings(*fields: str | int, start: int = 0) -> bytes:
    """Pack strings and counts (uint32), each aligned to 4 bytes; pad to 8 bytes, counted from `start` bytes before."""
    packed = b""
    for item in fields:
        packed += bytes(-len(packed) % 4)
        if isinstance(item, int):
            packed += struct.pack("<I", item)
        else:
            packed += struct.pack("<I", len(item.encode()) + 1) + item.encode() + b"\0"
    return packed + bytes(-(start + len(packed)) % 8)


def _pack(*parts: bytes | NDArray[Any]) -> Messages:
    """Join parts into n messages: each gets all bytes, and one row of each array of stamps (n,) or numbers (n, k)."""
    layout: list[Any] = [
        (f"{i}", f"V{len(part)}")
        if isinstance(part, bytes)
        else (f"{i}", "<i8" if part.ndim == 1 else "<f8", part.shape[1:])
        for i, part in enumerate(parts)
    ]
    # Packing messages one by one takes 12 µs each.
    records = np.empty(len(parts[1]), layout)
    for i, part in enumerate(parts):
        records[f"{i}"] = np.void(part) if isinstance(part, bytes) else part
    return records.view(f"V{records.itemsize}")
