"""The emulated operator who guides the arm, and the program on the pendant: poses, speed, rests and interruptions."""

import numpy as np
import pytest

from ftmocks.arrays import Array
from ftmocks.kinematics import MODELS, Vector6, forward, vector6
from ftmocks.ur.hand import IN_A_PROGRAM, guided_by_hand, orientations, pendant_program
from ftmocks.ur.modes import Runtime
from ftmocks.ur.robot import Robot, RobotSettings
from ftmocks.ur.uploads import start_upload
from ftmocks.world import Truth, World
from tests.unit.mocks.ur.urscript_robot import run

UR5E = MODELS["UR5e"]
HOME = vector6(np.radians([45, -100, 60, -50, 70, 0]))
"""Joint 5 20° off the right angle; there the axes of the flange are along those of joints 4 and 5, and one vertical."""
ALL = 24
SCALE = 20.0
REST_S = 0.2


def new_robot(q: Vector6 = HOME) -> Robot:
    return Robot(World(Truth.drawn(0), UR5E, q, 0), RobotSettings(time_scale=SCALE))


def rests(robot: Robot, count: int) -> list[tuple[Vector6, float]]:
    """Where the arm rests next, and how long (s, real time) until it moves again."""
    found: list[tuple[Vector6, float]] = []
    stood = 0
    for _ in range(100 * robot.frequency_hz):
        robot.tick()
        if robot.arm.at_rest:
            stood += 1
        elif stood:
            found.append((robot.arm.actual_q, stood * robot.period_s))
            stood = 0
        if len(found) == count:
            return found
    raise AssertionError(f"only {len(found)} rests")


def flange(q: Vector6) -> Array:
    """Its orientation in base."""
    return forward(UR5E, q)[:3, :3]


def test_a_hand_turns_the_wrist_to_all_turns_of_a_cube_and_begins_again() -> None:
    robot = new_robot()
    robot.hand = guided_by_hand(robot, REST_S)
    found = rests(robot, ALL + 2)
    np.testing.assert_allclose([q for q, _ in found[ALL:]], [q for q, _ in found[:2]], atol=0.02)
    found = found[:ALL]
    assert all(q[:3] == HOME[:3] for q, _ in found)
    assert all(REST_S <= rest_s < REST_S + 0.05 for _, rest_s in found)
    turns = np.array([flange(found[0][0]).T @ flange(q) for q, _ in found])
    np.testing.assert_allclose(np.abs(turns).max(axis=2), 1.0, atol=0.001)  # axes go to axes
    assert len({tuple(turn.round().astype(int).ravel()) for turn in turns}) == ALL
    down = np.array([-flange(q)[2] for q, _ in found[:6]])
    np.testing.assert_allclose(np.abs(down).max(axis=1), 1.0, atol=0.001)
    assert len({tuple(row) for row in down.round().astype(int).tolist()}) == 6  # soon it has pulled along every axis


def test_a_program_on_the_pendant_goes_there_once_and_back() -> None:
    robot = new_robot()
    assert start_upload(robot, pendant_program(robot, REST_S))
    _, *found = rests(robot, IN_A_PROGRAM + 1)  # before its start too
    assert robot.runtime == Runtime.PLAYING
    expected = orientations(new_robot())[:IN_A_PROGRAM]
    np.testing.assert_allclose([q for q, _ in found], expected, atol=0.02)
    assert all(rest_s == pytest.approx(REST_S, abs=0.02) for _, rest_s in found)
    run(robot, 1.0)
    assert (robot.runtime, robot.arm.q) == (Runtime.STOPPED, expected[0])
