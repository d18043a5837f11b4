"""An operator who turns the sensor to all sides: by hand, or with a program on the pendant.

Only the wrist turns. The operator holds the arm above the sensor, which does not measure the hand.
"""

import math
from collections.abc import Iterator
from itertools import cycle

from ftmocks.kinematics import Vector6
from ftmocks.ur.robot import Robot
from ftmocks.ur.uploads import Upload

SPEED_RAD_S = 0.6
ACCELERATION_RAD_S2 = 1.5
REST_S = 3.5
"""Rest at each orientation on the cell's clock, independent of the speed of the arm."""

TIPS = ((0, 0), (0, 1), (1, 0), (2, 0), (0, -1), (-1, 0))
"""Quarter turns of joints 4 and 5: the tool points in six directions."""
SPINS = (0, -1, 1, 2)
"""Quarter turns of joint 6."""
IN_A_PROGRAM = 12
"""Number of orientations in the program: all tips, with two of the spins."""


def orientations(q: Vector6) -> list[Vector6]:
    """Return 24 postures (rad) near `q`: all turns of a cube. The first is `q` with joint 5 at a right angle."""
    q1, q2, q3, q4, q5, q6 = q
    right = math.copysign(math.pi / 2, q5)
    return [
        (q1, q2, q3, _turned(q4, tip4), _turned(right, tip5), _turned(q6, spin))
        for spin in SPINS
        for tip4, tip5 in TIPS
    ]


def guided_by_hand(robot: Robot, rest_s: float) -> Iterator[None]:
    """Move the arm through the `orientations` over and over and rest at each; one control cycle per `next`.

    The operator waits while the arm cannot be moved.
    """
    for q in cycle(orientations(robot.arm.q)):
        while robot.hand_obstacle or robot.arm.busy:
            yield
        robot.hand_move(q, SPEED_RAD_S)
        while robot.arm.busy:
            yield
        for _ in range(round(rest_s * robot.frequency_hz)):
            yield


def pendant_program(robot: Robot, rest_s: float) -> Upload:
    """Return a program that visits the first `orientations`, returns to the first and rests at each."""
    first, *others = orientations(robot.arm.q)[:IN_A_PROGRAM]
    rest = f"  sleep({rest_s * robot.settings.time_scale})\n"
    moves = [f"  movej({list(q)}, a={ACCELERATION_RAD_S2}, v={SPEED_RAD_S})\n" for q in (first, *others, first)]
    return Upload("turns", "def turns():\n" + "".join(move + rest for move in moves) + "end\n", secondary=False)


def _turned(angle: float, quarters: int) -> float:
    """Turn an angle by quarter turns and keep it within one turn."""
    turned = angle + quarters * math.pi / 2
    return turned if abs(turned) <= 2 * math.pi else math.remainder(turned, 2 * math.pi)
