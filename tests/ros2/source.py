"""Plays an arm with seven joints and a sensor of another make as topics: an own clock, jitter, lost messages.

`python -m tests.ros2.source '{"seconds": 30, …}'` publishes /ft/wrench, /arm/pose and /joint_states,
prints "ready", and obeys lines of JSON on stdin: {"rest": number of an orientation} or {"sway": true}. It shares no
code with the drivers.
"""

import json
import sys
import threading
import time
from typing import Any

import numpy as np
import rclpy
from geometry_msgs.msg import PoseStamped, WrenchStamped
from rclpy.qos import QoSProfile, qos_profile_sensor_data
from scipy.spatial.transform import Rotation
from sensor_msgs.msg import JointState

from tests.ros2.seven_joints import JOINTS, TRUTH, Array, flange, posture, sway, wrench

_SENSOR_HZ, _ARM_HZ = 500, 250
_AHEAD_S = 0.04


class Source:
    """Publishes in real time what is due."""

    def __init__(self, options: dict[str, Any]) -> None:
        rclpy.init()
        self.node = rclpy.create_node("other_make")
        self.offset_ns = round(1e6 * options.get("offset_ms", 40.0))
        """Of the sensor's clock."""
        self.jitter_s = 1e-3 * options.get("jitter_ms", 2.0)
        self.lost = options.get("lost", 0.01)
        self.spoil = options.get("spoil", "")
        self._wrench = self.node.create_publisher(WrenchStamped, "/ft/wrench", qos_profile_sensor_data)
        self._pose = self.node.create_publisher(PoseStamped, "/arm/pose", QoSProfile(depth=10))
        self._joints = self.node.create_publisher(JointState, "/joint_states", QoSProfile(depth=10))
        self._rng = np.random.default_rng(1)
        self._at = posture(0)
        self._from, self._begin_s = self._at, -10.0
        self._sways = bool(options.get("sway", False))
        self.start_ns = time.time_ns()

    def joints(self, t_s: Array) -> Array:
        if self._sways:
            return sway(t_s)
        share = np.clip((t_s - self._begin_s) / 0.5, 0, 1)[:, None]
        return np.asarray(self._from + (self._at - self._from) * (3 * share**2 - 2 * share**3))

    def obey(self) -> None:
        for line in sys.stdin:
            request = json.loads(line)
            if "rest" in request:
                ahead_s = (time.time_ns() - self.start_ns) * 1e-9 + 2 * _AHEAD_S
                self._from, self._begin_s = self.joints(np.array([ahead_s]))[0], ahead_s
                self._at, self._sways = posture(request["rest"]), False
            self._sways = request.get("sway", self._sways)

    def run(self, seconds: float) -> None:
        """Compute a little ahead, and send each message some time after its time of measurement."""
        ready_s = 0.0
        last_s = {"wrench": 0.0, "pose": 0.0}
        while ready_s < seconds:
            to_s = ready_s + _AHEAD_S
            due: list[tuple[float, float, str, Any]] = []
            for topic, rate_Hz in (("wrench", _SENSOR_HZ), ("pose", _ARM_HZ)):
                t_s = np.arange(round(ready_s * rate_Hz), round(to_s * rate_Hz)) / rate_Hz
                values = wrench(t_s, self.joints) if topic == "wrench" else [*zip(*self.poses(t_s), strict=True)]
                for measured_s, value in zip(t_s.tolist(), values, strict=True):
                    last_s[topic] = max(last_s[topic], measured_s + _AHEAD_S + self._rng.uniform(0, self.jitter_s))
                    due.append((last_s[topic], measured_s + _AHEAD_S, topic, value))
            for at_s, measured_s, topic, value in sorted(due, key=lambda one: one[:2]):
                time.sleep(max(0.0, at_s - (time.time_ns() - self.start_ns) * 1e-9))
                (self.send_wrench if topic == "wrench" else self.send_pose)(measured_s, value)
            ready_s = to_s

    def poses(self, t_s: Array) -> tuple[Array, Array, Array]:
        q_rad = self.joints(t_s)
        R, p = flange(q_rad)
        return q_rad, p, Rotation.from_matrix(R).as_quat()

    def stamp(self, header: Any, t_s: float, offset_ns: int, frame: str) -> None:
        t_ns = self.start_ns + round(t_s * 1e9) + offset_ns
        header.stamp.sec, header.stamp.nanosec = divmod(t_ns, 10**9)
        header.frame_id = frame
        if self.spoil == "stamp":
            header.stamp.sec = header.stamp.nanosec = 0
        if self.spoil == "mixed" and self._rng.random() < 0.1:
            header.stamp.sec -= 3

    def send_wrench(self, t_s: float, exact: Array) -> None:
        noise = self._rng.normal(size=6) * TRUTH["noise"]
        if self._rng.random() < self.lost:
            return
        values = exact + noise
        if self.spoil == "compensated":
            values = noise
        if self.spoil == "nan" and self._rng.random() < 0.1:
            values[3] = np.nan
        message = WrenchStamped()
        frame = "other" if self.spoil == "frame" and self._rng.random() < 0.1 else "ft_frame"
        self.stamp(message.header, t_s, self.offset_ns, frame)
        for part, numbers in ((message.wrench.force, values[:3]), (message.wrench.torque, values[3:])):
            part.x, part.y, part.z = map(float, numbers)
        self._wrench.publish(message)

    def send_pose(self, t_s: float, pose: tuple[Array, Array, Array]) -> None:
        q_rad, p, quaternion = pose
        if self._rng.random() < self.lost:
            return
        message = PoseStamped()
        self.stamp(message.header, t_s, 0, "link0")
        position, orientation = message.pose.position, message.pose.orientation
        position.x, position.y, position.z = map(float, p)
        if self.spoil == "quaternion":
            quaternion = 0.7 * quaternion
        if self.spoil == "pose-nan":
            quaternion = np.full(4, np.nan)
        orientation.x, orientation.y, orientation.z, orientation.w = map(float, quaternion)
        self._pose.publish(message)
        joints = JointState(name=[*JOINTS, "finger"], position=[*map(float, q_rad), 0.02])
        if self.spoil == "joint":
            joints = JointState(name=JOINTS[1:], position=[*map(float, q_rad[1:])])
        if self.spoil == "joint-nan":
            joints.position[2] = float("nan")
        self.stamp(joints.header, t_s, 0, "")
        self._joints.publish(joints)


if __name__ == "__main__":
    given = json.loads(sys.argv[1]) if len(sys.argv) > 1 else {}
    source = Source(given)
    threading.Thread(target=source.obey, daemon=True).start()
    sys.stdout.write("ready\n")
    sys.stdout.flush()
    source.run(given.get("seconds", 600.0))
