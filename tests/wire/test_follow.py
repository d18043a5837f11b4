"""Both devices of an emulated cell read without gaps, each at its full rate."""

from collections.abc import Iterator

import numpy as np
import pytest

from ftdrivers.interfaces import ArmStates, FtSamples
from ftdrivers.registry import sensor_from_url
from tests.wire.conftest import Station

pytestmark = pytest.mark.slow  # every test needs a process of its own

SECONDS = 2.0


@pytest.fixture
def station() -> Iterator[Station]:
    """Start a cell whose arm lives as quickly as its sensor."""
    with Station("--sensor", "serial", "--time-scale", "1") as station:
        yield station


def test_no_sample_of_either_device_is_missing(station: Station) -> None:
    sensor = sensor_from_url(station.hello["sensors"]["serial"]["url"], clock=station.clock)
    arm = station.arm()
    wrenches: list[FtSamples] = []
    states: list[ArmStates] = []
    try:
        arm.open()
        with sensor, sensor.follow() as wrenches_of, arm.follow() as states_of:
            end_s = station.clock.now_s() + SECONDS
            while station.clock.now_s() < end_s:
                wrenches.append(wrenches_of.read(0.05))
                states.append(states_of.read(0.05))
            health = sensor.health()
        here = arm.state()
    finally:
        arm.close()
    wrench, state = FtSamples.concatenate(wrenches), ArmStates.concatenate(states)
    assert (np.diff(wrench.seq) == 1).all()
    assert health.lost == 0
    assert len(wrench) == pytest.approx(7000 * SECONDS, rel=0.1)
    np.testing.assert_allclose(np.diff(state.t_device_s), 0.002, atol=1e-9)
    assert len(state) == pytest.approx(500 * SECONDS, rel=0.1)
    assert (np.diff(state.t_host_ns) >= 0).all()
    np.testing.assert_allclose(state.R_base_flange, [here.R_base_flange] * len(state), atol=1e-9)
    np.testing.assert_allclose(state.p_base_flange_m, [here.p_base_flange_m] * len(state), atol=1e-9)
