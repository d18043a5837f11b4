"""The frames that the messages name, on /tf_static and /tf, where the messages of tf2 are installed."""

from collections.abc import Sequence
from typing import Any, Final

import numpy as np

from ftdrive.live import ros2
from ftdrive.live.frames import frames_in_flange
from ftdrive.live.samples import Block, StreamInfo, WrenchFrame
from ftdrive.servers.picked import Picked
from ftdrive.servers.ros2.parameters import Fixed
from ftdrivers.errors import NoRos2
from ftdrivers.interfaces import Array
from ftdrivers.ros2.middleware import ros2_module

_TF_HZ: Final = 50.0


class Transforms:
    """Publishes sensor and tcp in the flange once, and on request what moves: base to flange.

    A frame of base axes about another point also moves, because the flange turns in the base. It is published too.
    """

    def __init__(self, node: Any, fixed: Fixed) -> None:
        self._node, self._fixed = node, fixed
        self._names = {"sensor": fixed.sensor_frame, "flange": fixed.flange_frame, "base": fixed.base_frame}
        self._picked = Picked(_TF_HZ)
        try:
            message = ros2_module("tf2_msgs.msg").TFMessage
        except NoRos2:
            self._static = self._moving = None
            node.get_logger().info(
                f"tf2_msgs is not installed, so {fixed.flange_frame} to {fixed.sensor_frame} is not published: "
                "`ftdrive export calibration --format static-transform` writes a command that does"
            )
            return
        qos = ros2_module("rclpy.qos")
        latched = qos.QoSProfile(depth=1, durability=qos.DurabilityPolicy.TRANSIENT_LOCAL)
        self._static = node.create_publisher(message, "/tf_static", latched)
        self._moving = node.create_publisher(message, "/tf", 100)

    def frame_id(self, frame: WrenchFrame) -> str:
        """Return the name of the axes and the point of a wrench, in the names of the parameters."""
        axes = self._names.get(frame.axes, frame.axes)
        if frame.axes == frame.about:
            return axes
        if isinstance(frame.about, str):
            return f"{axes}_at_{self._names.get(frame.about, frame.about)}"
        return ros2.frame_id(frame).replace(frame.axes, axes, 1)

    def use(self, info: StreamInfo) -> None:
        """Publish where sensor and tcp are, unless the height of the sensor is unknown."""
        if self._static is None or not np.isfinite(info.p_flange_sensor_m).all():
            return
        frames = frames_in_flange(WrenchFrame(), info, np.eye(3))
        fixed = [(self._fixed.flange_frame, self._names.get(name, name), R, p) for name, (R, p) in frames.items()]
        t_ns = self._node.get_clock().now().nanoseconds
        self._static.publish(pack(fixed, t_ns))

    def publish(self, block: Block, info: StreamInfo, t_ns: int) -> None:
        """Publish what moves, at the time of the newest sample of a block."""
        if self._moving is None or not self._picked.rows(np.array([t_ns])).any():
            return
        R_base_flange = block.R_base_flange[-1]
        frames = frames_in_flange(block.frame, info, R_base_flange)
        name = ros2.frame_id(block.frame)
        moving = []
        if name in frames and name not in ("sensor", "tcp"):
            moving.append((self._fixed.flange_frame, self.frame_id(block.frame), *frames[name]))
        p_m = block.p_base_flange_m[-1]
        if self._fixed.publish_base_tf and np.isfinite(p_m).all():
            moving.append((self._fixed.base_frame, self._fixed.flange_frame, R_base_flange, p_m))
        if moving:
            self._moving.publish(pack(moving, t_ns))


def pack(transforms: Sequence[tuple[str, str, Array, Array]], t_ns: int) -> bytes:
    """Return a TFMessage of (parent, child, orientation (3, 3), origin (3,) in m) as CDR."""
    packed = ros2.pack_transforms(np.array([t_ns]), [(parent, child, p, R) for parent, child, R, p in transforms])
    return bytes(packed.tolist()[0])
