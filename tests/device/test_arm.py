"""A real arm, with `--arm` and `--move`: its last joint turns slowly, there and back, while the sensor is watched."""

from collections.abc import Iterator
from math import radians

import numpy as np
import pytest

from ftdrivers.errors import DeviceFault
from ftdrivers.interfaces import ForceTorqueSensor, RobotArm
from ftdrivers.registry import arm_class

SPEED_RAD_S, ACCELERATION_RAD_S2 = radians(5), radians(20)
TURN_RAD = radians(3)
MOST_N = 20.0
"""More than a tool's weight changes in these axes by so small a turn; a touch is more."""


@pytest.fixture
def arm(request: pytest.FixtureRequest) -> Iterator[RobotArm]:
    """The arm under control, after the operator has typed its serial number."""
    host = request.config.getoption("--arm")
    if not (host and request.config.getoption("--move")):
        pytest.skip("needs --arm HOST and --move")
    kind = arm_class("ur")
    arm = kind(host, speed_rad_s=SPEED_RAD_S, acceleration_rad_s2=ACCELERATION_RAD_S2)  # type: ignore[call-arg]
    try:
        arm.open()
        info = arm.identify()
        capture = request.config.pluginmanager.getplugin("capturemanager")
        with capture.global_and_fixture_disabled():
            turn = f"turn its last joint by {np.degrees(TURN_RAD):.0f}° and back"
            question = "Clear the area. Keep a hand on the emergency stop. Type the serial number to move: "
            typed = input(f"\n{info.model} {info.serial} at {host} will {turn}.\n{question}")
        if typed.strip() != info.serial:
            pytest.skip("not confirmed")
        arm.open(control=True)
        yield arm
    finally:
        arm.close()


def test_a_guarded_move_of_a_few_degrees(arm: RobotArm, sensor: ForceTorqueSensor) -> None:
    still_N = sensor.collect(0.5).wrench[:, :3].mean(axis=0)
    begin = arm.state().q_rad

    def guard() -> None:
        sensor.check()
        force_N = float(np.linalg.norm(sensor.latest(timeout_s=0.1).wrench[0, :3] - still_N))
        if force_N > MOST_N:
            raise DeviceFault(f"the force has changed by {force_N:.1f} N", "see what the tool touches")

    for turn_rad in (TURN_RAD, 0.0):
        goal = begin + np.array([0, 0, 0, 0, 0, turn_rad])
        arm.move_to(goal.tolist(), timeout_s=10.0, guard=guard)
        arm.wait_until_still(timeout_s=5.0, guard=guard)
        np.testing.assert_allclose(arm.state().q_rad, goal, atol=radians(0.1))
