"""Messages and addresses that cannot be used: one sentence each. No ROS is needed: the messages are plain objects."""

import re
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from ftcalib import CalibrationDataset, solve
from ftcalib.errors import AcceptanceError, DataError
from ftdrive.checks.sensor import check_compensated
from ftdrivers.errors import BadUrl, DeviceError, ProtocolError
from ftdrivers.interfaces import FtSamples
from ftdrivers.ros2.arm import Ros2Arm
from ftdrivers.ros2.middleware import Received
from ftdrivers.ros2.poses import Chain, Joints, Poses, Transforms
from ftdrivers.ros2.sensor import Ros2Sensor
from tests.ros2.seven_joints import JOINTS, URDF, flange, posture
from tests.unit.drivers.ros2.graph_in_memory import joints, pose, tf, wrench

NAN = float("nan")


@pytest.fixture
def urdf(tmp_path: Path) -> Path:
    path = tmp_path / "arm.urdf"
    path.write_text(URDF)
    return path


class Topic(Ros2Sensor):
    """A sensor that reads when the test says so."""

    def read(self, messages: dict[int, Any]) -> FtSamples:
        """Return the samples of messages by their numbers."""
        for number, message in messages.items():
            self._queue.put(Received(message, 7, number))
        samples = self._read_block()
        self._newest = samples.rows(slice(-1, None))
        return samples


def read_sensor(*messages: Any) -> FtSamples:
    return Topic("/ft").read(dict(enumerate(messages)))


def test_a_chain_agrees_with_kinematics_written_apart(urdf: Path) -> None:
    urdf.write_text(URDF.replace('axis xyz="0 0 1"', 'axis xyz="0 0 2"', 1))  # its length counts for nothing
    chain = Chain(urdf, "link0", "flange")
    q = np.array([posture(number) for number in range(5)])
    R, p = chain.poses(dict(zip(JOINTS, q.T, strict=True)))
    expected_R, expected_p = flange(q)
    assert np.allclose(R, expected_R, atol=1e-12)
    assert np.allclose(p, expected_p, atol=1e-12)


def test_other_joints_on_the_topic_are_left_out(urdf: Path) -> None:
    reader = Joints("/joints", Chain(urdf, "", "flange"))
    assert list(reader.read("/joints", joints(5.0, ["finger"], [0.1]))) == []
    assert "missing joint1, joint2" in reader.missing()
    (found,) = reader.read("/joints", joints(5.25, [*JOINTS, "finger"], [*posture(1), 0.1]))
    assert found.t_ns == 5_250_000_000


def test_a_pose_of_tf_has_the_time_of_its_oldest_part() -> None:
    reader = Transforms("base", "flange")
    turned = Rotation.from_euler("z", 90, degrees=True).as_quat()
    assert list(reader.read("/tf_static", tf((0.0, "wrist", "flange"), q=turned))) == []
    assert list(reader.read("/tf", tf((5.0, "base", "arm")))) == []
    (found,) = reader.read("/tf", tf((5.01, "arm", "wrist")))
    assert found.t_ns == 5_000_000_000
    assert np.allclose(found.p_base_flange_m, [0, 0, 3])
    assert np.allclose(found.R_base_flange, Rotation.from_quat(turned).as_matrix())
    assert list(reader.read("/tf", tf((5.02, "arm", "wrist")))) == []  # the oldest part is that of before


def test_a_sensor_numbers_and_stamps_its_samples() -> None:
    samples = read_sensor(wrench(5.0), wrench(5.002))
    assert samples.t_device_s == pytest.approx([5.0, 5.002], abs=1e-9)
    assert samples.seq.tolist() == [0, 1]
    assert samples.wrench[0].tolist() == [1, 2, 3, 4, 5, 6]


def test_numbers_that_are_missing_are_lost_messages() -> None:
    sensor = Topic("/ft")
    sensor.read({number: wrench(5 + 0.01 * number) for number in (3, 4, 8, 9, 12)})
    assert sensor.health().lost == 3 + 2
    sensor.read({15: wrench(5.2)})
    assert sensor.health().lost == 5 + 2
    sensor.read({3: wrench(5.3)})  # another publisher counts from the beginning
    assert sensor.health().lost == 7


def _read_tf(*messages: tuple[str, Any]) -> None:
    reader = Transforms("base", "flange")
    for topic, message in messages:
        list(reader.read(topic, message))
    raise ProtocolError(reader.missing())


BAD_MESSAGES: list[tuple[str, Callable[[], object]]] = [
    ("stamp 0", lambda: read_sensor(wrench(0.0))),
    ("stamp 0", lambda: list(Poses("/p").read("/p", pose(0.0)))),
    ("frame changed from 'ft' to 'other'", lambda: read_sensor(wrench(), wrench(frame="other"))),
    ("pose of /p is not finite", lambda: list(Poses("/p").read("/p", pose(p=(NAN, 0, 0))))),
    ("pose of /p is not finite", lambda: list(Poses("/p").read("/p", pose(q=(0, 0, 0, float("inf")))))),
    ("quaternion of norm 0.5", lambda: list(Poses("/p").read("/p", pose(q=(0, 0, 0, 0.5))))),
    ("tf has no frame 'flange'", lambda: _read_tf(("/tf", tf((5.0, "base", "arm"))))),
    ("arm has no parent", lambda: _read_tf(("/tf", tf((5.0, "arm", "flange"), (5.0, "base", "other"))))),
    ("are static, so none has a time", lambda: _read_tf(("/tf_static", tf((0.0, "base", "flange"))))),
    ("stamp 0", lambda: _read_tf(("/tf", tf((0.0, "base", "flange"))))),
    (
        "are 0.50 s apart",
        lambda: _read_tf(
            ("/tf", tf((5.0, "base", "arm"), (5.0, "arm", "flange"))),
            ("/tf", tf((5.5, "arm", "flange"), (5.001, "base", "arm"))),
        ),
    ),
    (
        "does not connect base with flange",
        lambda: _read_tf(("/tf", tf((5.0, "a", "flange"), (5.0, "flange", "a"), (5.0, "base", "b")))),
    ),
]


@pytest.mark.parametrize(("words", "read"), BAD_MESSAGES)
def test_a_message_that_cannot_be_used_is_one_sentence(words: str, read: Callable[[], object]) -> None:
    with pytest.raises(DeviceError) as error:
        read()
    assert re.search(words, str(error.value))
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("words", "names", "position"),
    [
        ("7 names and 3 positions", JOINTS, [0.0, 0.0, 0.0]),
        ("a joint of /j is not finite", JOINTS, [0.0] * 6 + [NAN]),
    ],
)
def test_joints_that_cannot_be_used_are_one_sentence(
    words: str, names: list[str], position: list[float], urdf: Path
) -> None:
    with pytest.raises(ProtocolError, match=words):
        list(Joints("/j", Chain(urdf, "", "flange")).read("/j", joints(5.0, names, position)))


@pytest.mark.parametrize(
    ("words", "host"),
    [
        ("names no topic", "ros2:"),
        ("tf needs base and flange", "ros2:tf"),
        ("unknown option parent", "ros2:tf?base=base&flange=f&parent=x"),
        ("option is given twice", "ros2:tf?base=base&base=other&flange=f"),
        ("base and flange apply only to tf and urdf", "ros2:/pose?flange=f"),
        ("option 'flange' is missing", "ros2:/joints?urdf={urdf}"),
        ("has no link 'flang': did you mean flange", "ros2:/joints?urdf={urdf}&flange=flang"),
        ("link0 is not a descendant of link7", "ros2:/joints?urdf={urdf}&flange=link0&base=link7"),
        ("no joint moves between link7 and flange", "ros2:/joints?urdf={urdf}&flange=flange&base=link7"),
        ("is not a URDF", "ros2:/joints?urdf={broken}&flange=flange"),
        ("a joint cannot be read", "ros2:/joints?urdf={planar}&flange=flange"),
    ],
)
def test_an_address_that_cannot_be_used_is_one_sentence(words: str, host: str, urdf: Path) -> None:
    broken, planar = urdf.with_name("broken.urdf"), urdf.with_name("planar.urdf")
    broken.write_text(URDF[:-20])
    planar.write_text(URDF.replace('type="fixed"', 'type="planar"'))
    with pytest.raises(BadUrl, match=words):
        Ros2Arm(host.format(urdf=urdf, broken=broken, planar=planar))


@pytest.mark.slow
@pytest.mark.parametrize("bias_N", [0.0, 7.0])
def test_a_compensated_wrench_at_rest_is_named_and_never_good(bias_N: float) -> None:
    cell: Any = SimpleNamespace(tool=SimpleNamespace(mass_kg=1.3), site=SimpleNamespace(g_m_s2=9.80665))
    rng = np.random.default_rng(1)
    R = Rotation.random(12, rng=rng).as_matrix()
    wrench = np.repeat([bias_N, 0.0], 3) + rng.normal(size=(12, 6)) * np.repeat([0.05, 0.002], 3)
    check = check_compensated(wrench, cell)
    assert (check.state == "warning") == (bias_N == 0.0)  # a bias hides it at rest, but not from poses
    covariance = np.tile(np.diag(np.repeat([0.05, 0.002], 3) ** 2), (12, 1, 1))
    data = CalibrationDataset(R, wrench, covariance, np.zeros(12, np.int64), np.full(12, np.nan))
    with suppress(AcceptanceError, DataError):
        result = solve(data)
        assert result.verdict == "rejected"
        assert any("compensated" in reason for reason in result.reasons)
