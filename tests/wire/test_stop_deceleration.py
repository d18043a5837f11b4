"""The configured deceleration of a stop, on the emulated controller."""

import pytest

from ftdrivers.ur.control import ControlPath
from tests.ur_rtde import require_ur_rtde
from tests.wire.conftest import Station
from tests.wire.stop_trial import stop

SPEED_DEG_S = 45.0


@pytest.mark.slow
@pytest.mark.parametrize("path", ["script", "ur-rtde"])
def test_the_arm_stops_with_the_deceleration_that_is_set(path: ControlPath) -> None:
    if path == "ur-rtde":
        require_ur_rtde()
    with Station("--time-scale", "1") as station:
        soft = stop(station, path, "stop", SPEED_DEG_S, 60.0)
        hard = stop(station, path, "stop", SPEED_DEG_S, 300.0)
    # A soft stop brakes for 0.75 s and 16.9°, a hard one for 0.15 s and 3.4°; both begin a little after the command.
    for seen, stop_deg_s2 in ((soft, 60.0), (hard, 300.0)):
        expected_deg = SPEED_DEG_S * seen.brakes_s + SPEED_DEG_S**2 / (2 * stop_deg_s2)
        assert seen.brakes_s > 0
        assert seen.turned_deg == pytest.approx(expected_deg, abs=3.0)
    assert soft.turned_deg - SPEED_DEG_S * soft.brakes_s > 3 * (hard.turned_deg - SPEED_DEG_S * hard.brakes_s)
