"""An arm by topics on a fake clock: its first pose, speed, silence, stamps that go back, and the end."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from ftdrivers.errors import ConnectError, DeviceTimeout, ProtocolError, StreamBroken
from ftdrivers.ros2.arm import Ros2Arm
from tests.unit.drivers.ros2.graph_in_memory import Graph, pose, tf

TOPIC, KIND = "/arm/pose", "geometry_msgs/msg/PoseStamped"


def opened(graph: Graph, t_s: float = 5.0) -> Ros2Arm:
    """Open an arm whose first pose has this stamp."""
    graph.add(TOPIC, KIND, space="/cell")
    graph.later(0.6, TOPIC, pose(t_s))
    arm = Ros2Arm(f"ros2:{TOPIC}", clock=graph.clock)
    arm.open()
    return arm


def test_it_opens_with_the_first_pose(graph: Graph) -> None:
    begin_s = graph.clock.now_s()
    arm = opened(graph)
    assert graph.clock.now_s() - begin_s == pytest.approx(0.6)
    arm.open()  # the pose is new enough: nothing to do
    assert graph.nodes == 1
    assert arm.identify().facts["publisher"].value == "/cell/driver"
    assert arm.identify().model == f"ros2:{TOPIC}"
    graph.later(0.1, TOPIC, pose(5.1))
    state = arm.state()
    assert state.t_device_s == pytest.approx(5.1)
    assert state.t_host_ns == graph.clock.now_ns()
    assert state.p_base_flange_m.tolist() == [0, 0, 1]
    assert np.isnan(state.q_rad).all()
    assert state.q_rad.shape == (6,)
    graph.clock.advance(0.3)
    with pytest.raises(ConnectError, match=r"no message of /arm/pose arrived"):
        arm.open()  # the pose is too old: a new connection, to a driver that has ended
    assert graph.is_closed
    with pytest.raises(ConnectError, match="not open"):
        arm.identify()


@pytest.mark.parametrize(("late_s", "is_in_time"), [(1.9, True), (2.1, False)])
def test_a_first_pose_has_two_seconds(graph: Graph, late_s: float, is_in_time: bool) -> None:
    graph.add(TOPIC, KIND)
    graph.later(0.5 + late_s, TOPIC, pose())
    arm = Ros2Arm(f"ros2:{TOPIC}", clock=graph.clock)
    if is_in_time:
        arm.open()
    else:
        with pytest.raises(ConnectError):
            arm.open()
    assert graph.is_closed != is_in_time


def test_a_first_message_that_cannot_be_used_is_the_reason(graph: Graph) -> None:
    with pytest.raises(ConnectError, match="stamp 0"):
        opened(graph, 0.0)
    assert graph.clock.now_s() == pytest.approx(1000.6)
    assert graph.is_closed


def test_tf_is_received_from_all_its_publishers(graph: Graph) -> None:
    graph.later(0.1, "/tf_static", tf((0.0, "wrist", "flange")))
    graph.later(0.2, "/tf", tf((5.0, "base", "wrist")))
    arm = Ros2Arm("ros2:tf?base=base&flange=flange", model="other make", clock=graph.clock)
    arm.open()
    assert arm.identify().model == "other make"
    assert arm.identify().facts["publisher"].value == "tf"
    assert {topic: (one.reliability, one.durability) for topic, one in graph.profiles.items()} == {
        "/tf": ("best effort", "not kept"),
        "/tf_static": ("reliable", "kept"),
    }


@pytest.mark.parametrize(
    ("turn_rad_s", "velocity_m_s", "speed"), [(0.3, 0.0, 0.3), (0.0, 0.2, 0.2), (0.3, 0.5, 0.5), (25.0, 0.0, 25.0)]
)
def test_the_speed_is_that_of_the_faster_of_turn_and_translation_over_a_tenth_of_a_second(
    graph: Graph, turn_rad_s: float, velocity_m_s: float, speed: float
) -> None:
    arm = opened(graph)
    axis = np.array([0.48, -0.6, 0.64])
    speeds = []
    for number in range(1, 41):
        moved_s = max(0, number - 20) * 0.01  # at rest for 0.2 s
        q = Rotation.from_rotvec(turn_rad_s * moved_s * axis).as_quat()
        graph.later(0.01, TOPIC, pose(5 + 0.01 * number, p=velocity_m_s * moved_s * axis + [0, 0, 1], q=q))
        speeds.append(arm.state().qd_rad_s)
    assert np.allclose(speeds[19], 0.0, atol=1e-12)
    assert np.allclose(speeds[24], speed / 2, atol=1e-6)  # of the last 0.1 s it has moved 0.05 s
    assert np.allclose(speeds[29:], speed, atol=1e-6)
    assert speeds[0].shape == (6,)


def test_silence_is_an_error_after_its_limit(graph: Graph) -> None:
    arm = opened(graph)
    graph.clock.advance(0.1)
    begin_s = graph.clock.now_s()
    with pytest.raises(DeviceTimeout, match=r"no new pose for 0\.40 s \(allowed: 0\.3 s\)"):
        arm.state()
    assert graph.clock.now_s() - begin_s == pytest.approx(0.3)
    graph.later(0.1, TOPIC, pose(6.0))
    arm.state()
    graph.clock.advance(0.1)
    with arm.follow() as follow:
        begin_s = graph.clock.now_s()
        with pytest.raises(DeviceTimeout):
            follow.read(5.0)
        assert graph.clock.now_s() - begin_s == pytest.approx(0.3)


def test_a_follower_reads_every_pose_in_order(graph: Graph) -> None:
    arm = opened(graph)
    with arm.follow() as follow:
        begin_s = graph.clock.now_s()
        nothing = follow.read(0.05)
        assert [value.shape for value in (nothing.q_rad, nothing.R_base_flange)] == [(0, 6), (0, 3, 3)]
        assert graph.clock.now_s() - begin_s == pytest.approx(0.05)
        for number in range(1, 4):
            graph.later(0.01 * number, TOPIC, pose(5 + 0.1 * number))
        graph.clock.advance(0.05)
        states = follow.read(0.1)
        assert states.t_device_s.tolist() == pytest.approx([5.1, 5.2, 5.3])
        assert np.diff(states.t_host_ns).tolist() == [10_000_000] * 2
        assert graph.clock.now_s() - begin_s == pytest.approx(0.1)  # it has not waited for more
        graph.later(0.02, TOPIC, pose(5.4))
        assert follow.read(0.02).t_device_s.tolist() == pytest.approx([5.4])  # it comes with the end of the wait
        arm.close()
        with pytest.raises(ConnectError, match="not open"):
            follow.read(0.1)
    graph.later(0.55, TOPIC, pose(6.0))
    arm.open()
    with pytest.raises(StreamBroken, match="the arm was closed; follow it again"):
        follow.read(0.1)


@pytest.mark.parametrize(("back_s", "is_other"), [(0.0, False), (0.45, False), (0.52, True)])
def test_a_stamp_that_goes_back_is_dropped_and_by_half_a_second_another_clock(
    graph: Graph, back_s: float, is_other: bool
) -> None:
    arm = opened(graph)
    with arm.follow() as follow:
        graph.publish(TOPIC, pose(5.0 - back_s))
        if is_other:
            with pytest.raises(ProtocolError, match=r"the stamps of /arm/pose went back by 0\.5 s"):
                follow.read(0.01)
            with pytest.raises(ProtocolError, match="went back"):
                arm.state()
            graph.later(0.6, TOPIC, pose(6.0))
            arm.open()  # a new connection, because of the failure
            assert graph.nodes == 2
        else:
            assert len(follow.read(0.01).t_host_ns) == 0
            graph.publish(TOPIC, pose(5.1))
            assert follow.read(0.01).t_device_s.tolist() == pytest.approx([5.1])


def test_a_second_publisher_ends_it(graph: Graph) -> None:
    arm = opened(graph)
    graph.add(TOPIC, KIND, "other")
    graph.later(0.1, TOPIC, pose(5.1))
    with pytest.raises(ProtocolError, match="2 nodes publish /arm/pose: /cell/driver, /other"):
        arm.state()


def test_it_reports_publisher_and_clock(graph: Graph) -> None:
    arm = opened(graph)
    graph.later(0.01, TOPIC, pose(1000.60))
    topic, clock = arm.diagnose()
    assert topic.found == "ros2:/arm/pose is published by /cell/driver"
    assert clock.found.startswith("the newest stamp is 10.0 ms old")
