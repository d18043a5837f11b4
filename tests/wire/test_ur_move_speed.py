"""The speed of a move, told with it; and a guard that says no before anything moves."""

import time
from collections.abc import Iterator
from math import radians

import pytest

from drivers.ur.arm import UrArm
from ftdrive.simulation import Station


@pytest.fixture
def station() -> Iterator[Station]:
    with Station("none", ["--time-scale", "1"]) as station:
        yield station


@pytest.fixture
def arm(station: Station) -> Iterator[UrArm]:
    arm = UrArm(station.endpoints["arm"]["host"], speed_rad_s=radians(60), acceleration_rad_s2=radians(80))
    arm.open(control=True)
    yield arm
    arm.close()


def turn(arm: UrArm, by_deg: float) -> list[float]:
    q: list[float] = arm.state().q_rad.tolist()
    q[5] += radians(by_deg)
    return q


def test_each_move_has_its_own_speed(arm: UrArm) -> None:
    took_s = []
    for back, speed in ((1, None), (-1, radians(15))):
        q, began_s = turn(arm, 20.0 * back), time.monotonic()
        arm.move_to(
            q, timeout_s=10, guard=lambda: None, speed_rad_s=speed, acceleration_rad_s2=None if speed is None else 1.0
        )
        took_s.append(time.monotonic() - began_s)
    assert 0.95 < took_s[0] < 1.6  # 2 sqrt(20 / 80) s
    assert 1.55 < took_s[1] < 2.4  # 20 / 15 + 15 / 57.3 s


@pytest.mark.parametrize("speed", [0.0, 9.0])
def test_absurd_speeds_are_refused_before_anything_moves(speed: float, arm: UrArm, station: Station) -> None:
    with pytest.raises(ValueError, match="speed_rad_s"):
        arm.move_to(turn(arm, 10), timeout_s=5, guard=lambda: None, speed_rad_s=speed)
    with pytest.raises(ValueError, match="acceleration_rad_s2"):
        arm.move_to(turn(arm, 10), timeout_s=5, guard=lambda: None, acceleration_rad_s2=speed)
    assert not station.control(do="state")["moving"]


def test_a_guard_that_has_tripped_lets_no_move_begin(arm: UrArm, station: Station) -> None:
    def tripped() -> None:
        raise InterruptedError

    with pytest.raises(InterruptedError):
        arm.move_to(turn(arm, 10), timeout_s=5, guard=tripped)
    events = station.control(do="state", since=0)["events"]
    assert not [event for event in events if event["what"] == "moves"]
