"""Two other implementations of CDR read what we pack."""

from typing import Any

import numpy as np
import pytest
from mcap_ros2._dynamic import generate_dynamic
from rosbags.typesys import Stores, get_typestore
from rosbags.typesys.store import Typestore
from scipy.spatial.transform import Rotation

from ftdrive.stream import ros2
from ftdrive.stream.samples import quaternions

N = 5
T_NS = 1_700_000_000_999_999_999 + 142_857 * np.arange(N)
NUMBERS = np.random.default_rng(1).normal(size=(N, 6))
ORIENTATIONS = Rotation.random(N, random_state=1)

PACKED = {
    ros2.RAW: ros2.pack_wrenches(T_NS, NUMBERS, "sensor").tolist(),
    ros2.COMPENSATED: ros2.pack_wrenches(T_NS, NUMBERS, "base_at_tcp").tolist(),
    ros2.POSE: ros2.pack_poses(T_NS, NUMBERS[:, :3], quaternions(ORIENTATIONS.as_matrix())).tolist(),
    ros2.JOINTS: ros2.pack_joints(T_NS, NUMBERS).tolist(),
}


@pytest.fixture(scope="module")
def store() -> Typestore:
    return get_typestore(Stores.ROS2_HUMBLE)


@pytest.mark.parametrize("topic", PACKED)
def test_rosbags_writes_the_same_bytes(store: Typestore, topic: str) -> None:
    name = ros2.SCHEMAS[topic].name
    for packed, t_ns in zip(PACKED[topic], T_NS.tolist(), strict=True):
        message: Any = store.deserialize_cdr(packed, name)
        assert message.header.stamp.sec * 1_000_000_000 + message.header.stamp.nanosec == t_ns
        assert bytes(store.serialize_cdr(message, name)) == packed


@pytest.mark.parametrize("length", range(1, 5))
def test_numbers_stay_aligned_after_a_frame_name_of_any_length(store: Typestore, length: int) -> None:
    packed = ros2.pack_wrenches(T_NS, NUMBERS, "x" * length).tolist()[-1]
    message: Any = store.deserialize_cdr(packed, "geometry_msgs/msg/WrenchStamped")
    force, torque = message.wrench.force, message.wrench.torque
    assert message.header.frame_id == "x" * length
    assert [force.x, force.y, force.z, torque.x, torque.y, torque.z] == NUMBERS[-1].tolist()


@pytest.mark.parametrize("topic", PACKED)
def test_the_schema_alone_is_enough_to_read_a_message(topic: str) -> None:
    schema = ros2.SCHEMAS[topic]
    message = generate_dynamic(schema.name, schema.text)[schema.name](PACKED[topic][2])
    if topic == ros2.JOINTS:
        assert message.name == list(ros2.JOINT_NAMES)
        assert message.position == NUMBERS[2].tolist()
        assert (len(message.velocity), len(message.effort)) == (0, 0)
    elif topic == ros2.POSE:
        q = message.pose.orientation
        assert message.header.frame_id == "base"
        assert message.pose.position.y == NUMBERS[2, 1]
        assert Rotation.from_quat([q.x, q.y, q.z, q.w]).approx_equal(ORIENTATIONS[2], atol=1e-12)
    else:
        assert message.wrench.torque.x == NUMBERS[2, 3]
