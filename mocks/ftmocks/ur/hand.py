"""An operator who turns the sensor to many orientations, by hand or with a program on the pendant.

Only the wrist turns. The operator holds the arm above the sensor, so the sensor does not measure the hand. A tool
with a hanging load is only tilted, and the operator waits longer until the load is at rest.
"""

import math
from collections.abc import Iterator
from itertools import cycle

from ftmocks.kinematics import Vector6, forward
from ftmocks.ur.robot import Robot
from ftmocks.ur.uploads import Upload

SPEED_RAD_S = 0.6
ACCELERATION_RAD_S2 = 1.5
REST_S = 3.5
"""Rest at each orientation, s of the cell's clock, which does not depend on the speed of the arm."""
REST_WITH_LOAD_S = 15.0
TILT_RAD = math.radians(60)

TIPS: tuple[tuple[int, int], ...] = ((0, 0), (0, 1), (1, 0), (2, 0), (0, -1), (-1, 0))
"""Quarter turns of joints 4 and 5, with which the tool points in six directions."""
SPINS = (0, -1, 1, 2)
"""Rotations of joint 6, as numbers of quarter turns."""
IN_A_PROGRAM = 12
"""Number of orientations in the program: all directions of the tool, each with two of the spins."""


def orientations(robot: Robot) -> list[Vector6]:
    """Return joint angles, rad, for the 24 rotations of a cube; with a hanging load, for the tool down and tilted.

    In the first posture joint 5 is at a right angle.
    """
    q1, q2, q3, q4, q5, q6 = robot.arm.q
    right, step, tips = math.copysign(math.pi / 2, q5), math.pi / 2, TIPS
    if robot.world.hung is not None:
        axis = forward(robot.world.dh, (q1, q2, q3, q4, right, q6))[:3, 2]
        right = math.copysign(right, right * float(axis @ robot.world.truth.gravity_m_s2))
        step, tips = TILT_RAD, tuple(tip for tip in TIPS if abs(sum(tip)) < 2)
    return [
        (q1, q2, q3, _turned(q4, step * tip4), _turned(right, step * tip5), _turned(q6, spin * math.pi / 2))
        for spin in SPINS
        for tip4, tip5 in tips
    ]


def usual_rest_s(robot: Robot) -> float:
    """Return the time for which the operator rests at each orientation, s."""
    return REST_S if robot.world.hung is None else REST_WITH_LOAD_S


def guided_by_hand(robot: Robot, rest_s: float) -> Iterator[None]:
    """Move the arm through the `orientations` repeatedly and rest at each. Each `next` is one control cycle.

    The operator waits while the arm cannot be moved.
    """
    for q in cycle(orientations(robot)):
        while robot.hand_obstacle or robot.arm.busy:
            yield
        robot.hand_move(q, SPEED_RAD_S)
        while robot.arm.busy:
            yield
        for _ in range(round(rest_s * robot.frequency_hz)):
            yield


def pendant_program(robot: Robot, rest_s: float) -> Upload:
    """Return a program that visits the first `orientations`, returns to the first and rests at each."""
    first, *others = orientations(robot)[:IN_A_PROGRAM]
    rest = f"  sleep({rest_s * robot.settings.time_scale})\n"
    moves = [f"  movej({list(q)}, a={ACCELERATION_RAD_S2}, v={SPEED_RAD_S})\n" for q in (first, *others, first)]
    return Upload("turns", "def turns():\n" + "".join(move + rest for move in moves) + "end\n", secondary=False)


def _turned(angle: float, by: float) -> float:
    """Return an angle after a rotation, kept within one revolution."""
    turned = angle + by
    return turned if abs(turned) <= 2 * math.pi else math.remainder(turned, 2 * math.pi)
