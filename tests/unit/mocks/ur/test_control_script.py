"""The twin of the ur_rtde control script by its registers: what each command answers and does."""

import math

import numpy as np
import pytest

from ftmocks.kinematics import MODELS, forward, matrix_of, pose_of
from ftmocks.ur.robot import Robot, RobotSettings
from ftmocks.ur.script import DONE, REALTIME
from ftmocks.world import Truth, World
from tests.unit.mocks.ur.urscript_robot import HOME, end_of, run, start

DH = MODELS["UR5e"]
TCP = (0.0, 0.0, 0.1, 0.0, 0.0, 0.0)
ABOVE_M = 0.2
ANYWHERE = [3.0, 0.0, 0.0, 0.0, 0.0, 0.0]


@pytest.fixture
def robot() -> Robot:
    """Its tool must stay above a plane, and has a TCP."""
    robot = Robot(World(Truth.drawn(0), DH, HOME), RobotSettings(plane=(0, 0, 1, ABOVE_M)))
    start("def rtde_control():\nend\n", robot)
    command(robot, 29, *TCP)
    run(robot, 1.0)
    return robot


def command(robot: Robot, number: int, *doubles: float) -> list[float]:
    """Have a command carried out, as ur_rtde writes it, and return the six output registers."""
    values = {f"input_double_register_{i}": float(value) for i, value in enumerate(doubles)}
    robot.write_inputs({"input_int_register_0": number, "input_int_register_1": 0, **values})
    run(robot, 0.01)
    while robot.output_ints[0] != DONE and number not in REALTIME:
        robot.tick()
    robot.write_inputs({"input_int_register_0": 0})
    run(robot, 0.01)
    return list(robot.output_doubles[:6])


def test_poses_and_joints(robot: Robot) -> None:
    flange = pose_of(forward(DH, HOME))
    pose = pose_of(forward(DH, HOME) @ matrix_of(TCP))
    turned, quarter = [1.0, 2.0, 3.0, 0.0, 0.0, math.pi / 2], [1.0, 3.0, 3.0, 0.0, 0.0, math.pi / 2]
    for number, doubles, answer in (
        (28, (), pose),
        (43, (), pose),
        (44, (*HOME, *TCP), pose),
        (58, (), flange),
        (40, (), TCP),
        (46, pose, HOME),
        (30, (*pose, *HOME), HOME),
        (39, (*turned, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0), quarter),
    ):
        assert command(robot, number, *doubles) == pytest.approx(list(answer), abs=1e-9), number


def test_what_is_possible_and_what_is_not(robot: Robot) -> None:
    pose = pose_of(forward(DH, HOME) @ matrix_of(TCP))
    below = [*pose[:2], ABOVE_M - 0.15, *pose[3:]]
    for number, doubles, answer in (
        (60, pose, True),
        (60, ANYWHERE, False),
        (61, (*ANYWHERE, *HOME), False),
        (37, HOME, True),
        (37, (7.0, *HOME[1:]), False),
        (36, pose, True),
        (36, below, False),
        (36, ANYWHERE, False),
        (47, (), True),
    ):
        command(robot, number, *doubles)
        assert robot.output_ints[1] == answer, (number, doubles)
    robot.write_inputs({"input_int_register_0": 46, "input_double_register_0": 3.0})
    run(robot, 0.05)
    assert "no solution" in end_of(robot).why


@pytest.mark.slow
def test_blocking_moves_arrive(robot: Robot) -> None:
    q = [*HOME[:5], HOME[5] + 1.0]
    begun_s = robot.timestamp_s
    command(robot, 1, *q, 1.0, 2.0)
    assert robot.timestamp_s - begun_s == pytest.approx(1.5, abs=0.05)
    assert list(robot.arm.q) == q
    lower = pose_of(forward(DH, robot.arm.q) @ matrix_of(TCP))
    lower = (*lower[:2], lower[2] - 0.05, *lower[3:])
    command(robot, 3, *lower, 0.25, 1.2)
    np.testing.assert_allclose(forward(DH, robot.arm.q) @ matrix_of(TCP), matrix_of(lower), atol=1e-9)
    command(robot, 4, *q, 0.25, 1.2)
    np.testing.assert_allclose(robot.arm.q, q, atol=1e-6)
    command(robot, 2, *lower, 1.0, 2.0)
    np.testing.assert_allclose(forward(DH, robot.arm.q) @ matrix_of(TCP), matrix_of(lower), atol=1e-9)
