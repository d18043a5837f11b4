"""What the base classes of the devices do for every driver."""

import numpy as np
import pytest

from ftdrivers.errors import DeviceFault, DeviceTimeout
from ftdrivers.interfaces import ArmStates, ControllerSettings, RobotArm
from ftdrivers.sweep import Sweep
from tests.fake_clock import FakeClock
from tests.unit.ftdrive.fake_cell import FakeArm


def test_an_arm_that_can_only_be_asked_is_followed_state_by_state() -> None:
    clock = FakeClock()
    arm = FakeArm(clock)
    with arm.follow() as follow:
        states = ArmStates.concatenate([follow.read(0.1) for _ in range(5)])
        assert np.diff(states.t_host_ns).tolist() == [8_000_000] * 4
        assert states.q_rad == pytest.approx(np.tile(arm.q, (5, 1)))
        assert states.R_base_flange.shape == (5, 3, 3)
        assert states.p_base_flange_m[3] == pytest.approx(arm.state().p_base_flange_m)
        assert states.rows(slice(1, 3)).t_host_ns.tolist() == states.t_host_ns[1:3].tolist()
        arm.gone = DeviceTimeout("its clock stands still")
        with pytest.raises(DeviceTimeout, match="stands still"):
            follow.read(0.1)


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
