"""Subscribers in a process of their own: rclpy, and Cyclone DDS as a second implementation that knows no ROS.

`python -m tests.ros2.clients rclpy|cyclonedds TOPIC COUNT [reliable]` prints "ready" and, after COUNT messages,
one JSON line a WrenchStamped with its time of receipt.
"""

import json
import os
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

CYCLONE = """<CycloneDDS><Domain><General><Interfaces><NetworkInterface address="127.0.0.1"/></Interfaces>
<AllowMulticast>false</AllowMulticast></General><Discovery><ParticipantIndex>auto</ParticipantIndex>
<MaxAutoParticipantIndex>60</MaxAutoParticipantIndex>
<Peers><Peer address="localhost"/></Peers></Discovery>
<Internal><PrimaryReorderMaxSamples>100000</PrimaryReorderMaxSamples>
<SecondaryReorderMaxSamples>100000</SecondaryReorderMaxSamples></Internal></Domain></CycloneDDS>"""


def say(arrived_ns: int, message: Any) -> None:
    stamp, wrench = message.header.stamp, message.wrench
    numbers = [getattr(part, axis) for part in (wrench.force, wrench.torque) for axis in "xyz"]
    t_ns = stamp.sec * 10**9 + stamp.nanosec
    sys.stdout.write(json.dumps([t_ns, message.header.frame_id, numbers, arrived_ns]) + "\n")


def by_rclpy(topic: str, wanted: int, *, reliable: bool) -> None:
    import rclpy
    from geometry_msgs.msg import WrenchStamped
    from rclpy.executors import SingleThreadedExecutor
    from rclpy.qos import QoSProfile, qos_profile_sensor_data

    rclpy.init()
    node = rclpy.create_node("second_process")
    received: list[tuple[int, Any]] = []
    quality = QoSProfile(depth=100_000) if reliable else qos_profile_sensor_data
    node.create_subscription(WrenchStamped, topic, lambda one: received.append((time.time_ns(), one)), quality)
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    _print_all(received, wanted, lambda: executor.spin_once(timeout_sec=0.1))


def by_cyclonedds(topic: str, wanted: int, *, reliable: bool) -> None:
    os.environ["CYCLONEDDS_URI"] = CYCLONE
    from cyclonedds.core import Policy, Qos
    from cyclonedds.domain import DomainParticipant
    from cyclonedds.idl import IdlStruct
    from cyclonedds.idl.annotations import final
    from cyclonedds.idl.types import float64, int32, uint32
    from cyclonedds.sub import DataReader
    from cyclonedds.topic import Topic

    @dataclass
    @final
    class Time(IdlStruct, typename="builtin_interfaces::msg::dds_::Time_"):
        sec: int32
        nanosec: uint32

    @dataclass
    @final
    class Header(IdlStruct, typename="std_msgs::msg::dds_::Header_"):
        stamp: Time
        frame_id: str

    @dataclass
    @final
    class Vector3(IdlStruct, typename="geometry_msgs::msg::dds_::Vector3_"):
        x: float64
        y: float64
        z: float64

    @dataclass
    @final
    class Wrench(IdlStruct, typename="geometry_msgs::msg::dds_::Wrench_"):
        force: Vector3
        torque: Vector3

    @dataclass
    @final
    class WrenchStamped(IdlStruct, typename="geometry_msgs::msg::dds_::WrenchStamped_"):
        header: Header
        wrench: Wrench

    participant = DomainParticipant(int(os.environ["ROS_DOMAIN_ID"]))
    reliability = Policy.Reliability.Reliable(10**9) if reliable else Policy.Reliability.BestEffort
    qos = Qos(reliability, Policy.History.KeepLast(100_000))
    reader = DataReader(participant, Topic(participant, f"rt{topic}", WrenchStamped), qos=qos)
    received: list[tuple[int, Any]] = []

    def look() -> None:
        received.extend((time.time_ns(), one) for one in reader.take(1000) if hasattr(one, "wrench"))
        time.sleep(0.001)

    _print_all(received, wanted, look)


def _print_all(received: list[tuple[int, Any]], wanted: int, look: Callable[[], None]) -> None:
    sys.stdout.write("ready\n")
    sys.stdout.flush()
    while len(received) < wanted:
        look()
    for arrived_ns, message in received[:wanted]:  # at the end: a pipe must not delay what is received
        say(arrived_ns, message)


if __name__ == "__main__":
    client = {"rclpy": by_rclpy, "cyclonedds": by_cyclonedds}[sys.argv[1]]
    client(sys.argv[2], int(sys.argv[3]), reliable="reliable" in sys.argv)
