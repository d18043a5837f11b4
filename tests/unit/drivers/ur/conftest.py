"""A controller in memory for the tests of the arm."""

import pytest

from tests.fake_clock import FakeClock
from tests.unit.drivers.ur.controller_in_memory import Controller, install


@pytest.fixture
def clock() -> FakeClock:
    return FakeClock()


@pytest.fixture
def controller(clock: FakeClock, monkeypatch: pytest.MonkeyPatch) -> Controller:
    controller = Controller(clock)
    install(controller, monkeypatch)
    return controller
