"""A controller in memory for the tests of the arm."""

import pytest

from ftdrivers.ur.arm import UrArm
from ftdrivers.ur.control import ControlSetting
from ftdrivers.ur.timing import STRICT, UrTiming
from tests.fake_clock import FakeClock
from tests.unit.drivers.ur.controller_in_memory import HOST, Controller, MakeArm, install
from tests.unit.drivers.ur.program_in_memory import Script, install_script


@pytest.fixture
def clock() -> FakeClock:
    return FakeClock()


@pytest.fixture
def controller(clock: FakeClock, monkeypatch: pytest.MonkeyPatch) -> Controller:
    controller = Controller(clock)
    install(controller, monkeypatch)
    return controller


@pytest.fixture
def script(controller: Controller, monkeypatch: pytest.MonkeyPatch) -> Script:
    """The script path of the controller."""
    return install_script(controller, monkeypatch)


@pytest.fixture
def make_arm(script: Script, path: ControlSetting) -> MakeArm:
    """Make arms that find the controller on the control path of the test file, its fixture `path`."""

    def make(timing: UrTiming = STRICT) -> UrArm:
        return UrArm(
            HOST,
            speed_rad_s=1.0,
            acceleration_rad_s2=3.0,
            control=path,
            clock=script.registers.far.clock,
            timing=timing,
        )

    return make


@pytest.fixture
def arm(make_arm: MakeArm) -> UrArm:
    arm = make_arm()
    arm.open(control=True)
    return arm
