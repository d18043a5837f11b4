"""A controller in memory for the tests of the arm."""

import pytest

from tests.fake_clock import FakeClock
from tests.unit.drivers.ur.controller_in_memory import Controller, install
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
