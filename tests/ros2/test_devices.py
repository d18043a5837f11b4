"""An arm with seven joints and a sensor of another make, by topics: own clock 40 ms ahead, jitter 2 ms, 1 % lost."""

import json
import re
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack, closing, suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ftcalib import CalibrationResult, Setup
from ftcalib.motion.samples import Means
from ftcalib.motion.solve import solve_motion
from ftdrivers.errors import ConnectError, DeviceError
from ftdrivers.interfaces import ArmStates, ForceTorqueSensor, FtSamples
from ftdrivers.registry import sensor_from_url
from ftdrivers.ros2.arm import Ros2Arm
from tests.ros2.seven_joints import TRUTH, URDF


@pytest.fixture
def stack() -> Iterator[ExitStack]:
    with ExitStack() as stack:
        yield stack


def source(stack: ExitStack, **options: Any) -> subprocess.Popen[str]:
    process = stack.enter_context(
        subprocess.Popen(
            [sys.executable, "-m", "tests.ros2.source", json.dumps(options)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )
    )
    stack.callback(process.kill)
    assert process.stdout is not None
    assert process.stdout.readline() == "ready\n"
    return process


def off_in_sigmas(result: CalibrationResult) -> dict[str, float]:
    """Return how far mass, centre of mass and biases are from the truth, in sigmas."""
    estimated: dict[str, Any] = {
        "mass_kg": result.mass_kg,
        "p_sensor_com_m": result.p_sensor_com_m,
        "force_bias_N": result.force_bias_N,
        "torque_bias_Nm": result.torque_bias_Nm,
    }
    sigma: Any = result.sigma
    off = {name: np.abs(np.subtract(value, TRUTH[name])) / sigma[name] for name, value in estimated.items()}
    return {name: float(np.max(value)) for name, value in off.items()}


def test_motion_by_topics_gives_the_load_and_the_offset_of_the_clocks(stack: ExitStack, tmp_path: Path) -> None:
    (tmp_path / "arm.urdf").write_text(URDF)
    source(stack, sway=True)
    arm = Ros2Arm(f"ros2:/joint_states?urdf={tmp_path}/arm.urdf&flange=flange&base=link0")
    sensor = stack.enter_context(sensor_from_url("ros2:/ft/wrench?recover=1"))
    stack.enter_context(closing(arm)).open()
    samples: list[FtSamples] = []
    states: list[ArmStates] = []
    with sensor.follow() as wrenches, arm.follow() as poses:
        end_s = time.monotonic() + 16
        while time.monotonic() < end_s:
            with suppress(DeviceError):  # a busy computer; the stream recovers
                samples.append(wrenches.read(0.05))
                states.append(poses.read(0.0))
    found, moved = FtSamples.concatenate(samples), ArmStates.concatenate(states)
    start_s = moved.t_device_s[0]
    wrench, pose = Means(), Means()
    wrench.add(found.t_device_s - start_s, found.wrench)
    pose.add(moved.t_device_s - start_s, np.hstack([moved.R_base_flange.reshape(-1, 9), moved.p_base_flange_m]))
    result = solve_motion(
        wrench, pose, known=None, point_mass=True, height_m=0.0, g_m_s2=9.80665, setup=Setup(), provenance={}
    )
    assert result.motion is not None
    assert abs(result.motion.delay_s - 0.04) < 1e-3
    assert max(off_in_sigmas(result).values()) < 3.5  # the largest of ten


def test_poses_by_hand_and_topics_give_the_load(stack: ExitStack, tmp_path: Path) -> None:
    process = source(stack)
    command = [sys.executable, "-m", "ftdrive", "calibrate", "--manual", "--yes", "--config", "cell.toml"]
    (tmp_path / "cell.toml").write_text(
        'format = "ftdrive.config/1"\n[robot]\nhost = "ros2:/arm/pose"\n'
        '[sensor]\nurl = "ros2:/ft/wrench?recover=1&range=300,30"\nheight_mm = 0.0\n'
        "[tool]\nmass_kg = 1.3\n[sampling]\naverage_s = 0.3\n"
    )
    session = stack.enter_context(
        subprocess.Popen(command, cwd=tmp_path, stdin=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True)
    )
    stack.callback(session.kill)
    assert process.stdin is not None
    assert session.stderr is not None
    said = []
    for line in session.stderr:
        said.append(line)
        if match := re.match(r"\s+(\d+)/\d+ R\d+: settled", line):
            process.stdin.write(json.dumps({"rest": int(match[1])}) + "\n")
            process.stdin.flush()
    assert session.wait(60) == 0, "".join(said)
    (path,) = tmp_path.glob("runs/*/calibration.json")
    result = CalibrationResult.load(path)
    assert result.verdict == "good"
    assert max(off_in_sigmas(result).values()) < 3.5  # the largest of ten


@pytest.mark.parametrize(
    ("url", "words"),
    [
        ("ros2:/none", r"no node publishes /none .*topics of this type: /ft/wrench"),
        ("ros2:/arm/pose", r"/arm/pose has the type geometry_msgs/msg/PoseStamped, needed is geometry_msgs/msg/Wrench"),
        ("ros2:/ft/wrench?reliable=1", "offered with best effort alone"),
    ],
)
def test_a_topic_that_is_no_sensor_is_one_sentence(stack: ExitStack, url: str, words: str) -> None:
    source(stack)
    with pytest.raises(ConnectError, match=words):
        sensor_from_url(url).open()


@pytest.mark.parametrize(
    ("spoil", "words"),
    [
        ("stamp", "have the stamp 0, so they cannot be paired"),
        ("nan", "wrench that is not finite"),
        ("frame", "the frame changed from"),
        ("mixed", "clock jumped (back|ahead)"),
    ],
)
def test_a_spoilt_sensor_is_one_sentence(stack: ExitStack, spoil: str, words: str) -> None:
    source(stack, spoil=spoil)
    with pytest.raises(DeviceError, match=words), sensor_from_url("ros2:/ft/wrench") as sensor:
        sensor.collect(1.0)


@pytest.mark.parametrize(
    ("spoil", "host", "words"),
    [
        ("stamp", "ros2:/arm/pose", "have the stamp 0"),
        ("quaternion", "ros2:/arm/pose", "quaternion of length 0.7"),
        ("pose-nan", "ros2:/arm/pose", "is not finite"),
        ("mixed", "ros2:/arm/pose", r"went back by 3\.\d s"),
        ("joint", "ros2:/joint_states?urdf={urdf}&flange=flange", "missing joint1, found joint2"),
        (
            "",
            "ros2:/ft/wrench",
            "has the type geometry_msgs/msg/WrenchStamped, needed is geometry_msgs/msg/PoseStamped",
        ),
    ],
)
def test_a_spoilt_arm_is_one_sentence(stack: ExitStack, spoil: str, host: str, words: str, tmp_path: Path) -> None:
    (tmp_path / "arm.urdf").write_text(URDF)
    source(stack, spoil=spoil)
    arm = Ros2Arm(host.format(urdf=tmp_path / "arm.urdf"))
    with closing(arm), pytest.raises(DeviceError, match=words):
        read_for_some_time(arm)


def read_for_some_time(arm: Ros2Arm) -> None:
    arm.open()
    with arm.follow() as follow:
        for _ in range(100):
            follow.read(0.05)


def test_two_publishers_of_one_topic_are_refused(stack: ExitStack) -> None:
    for _ in range(2):
        source(stack)
    sensor = sensor_from_url("ros2:/ft/wrench")
    with closing(sensor), pytest.raises(DeviceError, match=r"2 nodes publish /ft/wrench: /other_make, /other_make"):
        collect_until_it_fails(sensor)


def collect_until_it_fails(sensor: ForceTorqueSensor) -> None:
    """Read on, because the second publisher may be discovered late."""
    sensor.open()
    while True:
        sensor.collect(0.1)
