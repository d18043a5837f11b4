"""A sweep on the wire: our program on the emulated controller follows the curve, and every cause stops the arm."""

import threading
from collections.abc import Iterator
from contextlib import closing, suppress
from dataclasses import replace

import numpy as np
import pytest

from ftdrivers.errors import DeviceError, DeviceFault
from ftdrivers.sweep import Sweep
from ftdrivers.ur.arm import UrArm
from ftdrivers.ur.timing import UrTiming
from tests.wire.conftest import Station

pytestmark = pytest.mark.slow

BRAKING_S = 0.2
"""From the largest speed of the sweep with 300 °/s²."""


@pytest.fixture(scope="module")
def station() -> Iterator[Station]:
    with Station("--time-scale", "1") as one:
        yield one


@pytest.fixture
def arm(station: Station) -> Iterator[UrArm]:
    clock = station.clock
    with closing(UrArm(station.host, control="script", clock=clock, timing=UrTiming.emulated())) as one:
        one.open(control=True)
        yield one


def curve(arm: UrArm, seconds: float) -> Sweep:
    return Sweep(
        arm.state().q_rad.tolist(), [[0.4, 0.03]] * 3, [[1.0, 4.0]] * 3, [[0, 1], [1, 2], [2, 3]], seconds, 1.5
    )


def test_a_sweep_on_the_wire_follows_the_curve(arm: UrArm) -> None:
    arm.move_to(arm.state().q_rad.tolist(), timeout_s=20, guard=lambda: None)
    sweep = curve(arm, 4.0)
    with arm.follow() as follow:
        arm.sweep(sweep, guard=lambda: None)
        states = follow.read(1.0)
    path = sweep.at(np.arange(0.0, sweep.duration_s, 0.002))
    off = [np.abs(path - q).max(axis=1).min() for q in states.q_rad[::20]]
    assert max(off) < 0.01
    assert np.ptp(states.q_rad, axis=0)[3:].min() > 0.3
    assert np.allclose(states.q_rad[-1], sweep.centre_rad, atol=1e-3)


def test_a_sweep_on_the_wire_begins_where_the_arm_stands(arm: UrArm) -> None:
    sweep = curve(arm, 5.0)
    elsewhere = np.add(sweep.centre_rad, [0, 0, 0, 0.1, 0, 0]).tolist()
    with pytest.raises(DeviceFault, match="rejected the sweep"):
        arm.sweep(replace(sweep, centre_rad=elsewhere), guard=lambda: None)


@pytest.mark.parametrize("cause", ["stop", "network", "protective stop"])
def test_a_sweep_on_the_wire_stops(station: Station, arm: UrArm, cause: str) -> None:
    clock, sweep = station.clock, curve(arm, 8.0)
    since = len(station.ask("state")["events"])

    def follow_it() -> None:
        with suppress(DeviceError):
            arm.sweep(sweep, guard=lambda: None)

    sweeping = threading.Thread(target=follow_it)
    sweeping.start()
    station.wait_for_event("moves", since=since)
    clock.sleep(2.5)
    with clock.keeping_up():
        cause_ns = clock.now_ns()
        with clock.held():
            if cause == "network":
                station.ask("silence-arm", on=True)
            elif cause == "protective stop":
                station.ask("protective-stop")
        if cause == "stop":
            arm.stop()
    stood = station.wait_for_event("stands", since=since)
    station.ask("silence-arm", on=False)
    sweeping.join()
    assert (stood["t_host_ns"] - cause_ns) / 1e9 < 0.3 + BRAKING_S
    if cause == "protective stop":
        station.ask("unlock")
