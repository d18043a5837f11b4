"""An arm that is only read: it says what it knows and never moves."""

import numpy as np
import pytest

from ftdrivers.errors import ConnectError, DeviceFault
from ftdrivers.interfaces import ArmState, DeviceInfo, ReadOnlyArm


class Fixed(ReadOnlyArm):
    def identify(self) -> DeviceInfo:
        return DeviceInfo("bench", "1", "none")

    def state(self) -> ArmState:
        return ArmState(7, 0.5, np.zeros(6), np.zeros(6), np.eye(3), np.zeros(3))


def test_it_refuses_control_and_motion_and_may_be_stopped() -> None:
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
