"""What the base classes of the devices do for every driver."""

import numpy as np
import pytest

from ftdrivers.errors import ConnectError, DeviceFault
from ftdrivers.interfaces import ArmState, ControllerSettings, DeviceInfo, ReadOnlyArm, RobotArm
from ftdrivers.sweep import Sweep
from tests.fake_clock import FakeClock
from tests.unit.ftdrive.fake_cell import FakeArm


def test_an_arm_whose_driver_sets_nothing_says_what_it_was_to_set() -> None:
    arm = FakeArm(FakeClock())
    assert arm.controller_settings() == ControllerSettings(1.5, (0.0, 0.0, 0.05))  # of its status
    with pytest.raises(DeviceFault, match=r"payload of 1.2 kg at \[0.0, 0.0, 0.08\] m"):
        arm.set_payload(1.2, (0.0, 0.0, 0.08))
    sweep = Sweep(arm.q.tolist(), [[0.1, 0.1]] * 3, [[1.0, 2.0]] * 3, [[0.0, 0.0]] * 3, 10.0, 2.0)
    with pytest.raises(DeviceFault, match="calibrate without --sweep"):
        RobotArm.sweep(arm, sweep, guard=lambda: None)
    with pytest.raises(DeviceFault, match=r"gravity of \[0.0, 0.0, 9.82\]"):
        arm.set_gravity((0.0, 0.0, 9.82))


class Fixed(ReadOnlyArm):
    def identify(self) -> DeviceInfo:
        return DeviceInfo("bench", "1", "none")

    def state(self) -> ArmState:
        return ArmState(7, 0.5, np.zeros(6), np.zeros(6), np.eye(3), np.zeros(3))


def test_an_arm_that_is_only_read_refuses_control_and_motion_and_may_be_stopped() -> None:
    arm = Fixed()
    with pytest.raises(ConnectError, match="only reads"):
        arm.open(control=True)
    with pytest.raises(DeviceFault, match="only reads"):
        arm.move_to([0.0] * 6, timeout_s=1.0, guard=lambda: None)
    with pytest.raises(DeviceFault, match="only reads"):
        arm.wait_until_still(timeout_s=1.0, guard=lambda: None)
    with pytest.raises(DeviceFault, match="only reads"):
        arm.within_safety_limits([0.0] * 6)
    arm.stop()
