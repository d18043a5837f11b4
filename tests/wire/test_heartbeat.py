"""The heartbeat of the script path: however the computer fails in mid-move, the controller stops the arm by itself."""

from collections.abc import Callable

import pytest

from tests.wire.conftest import Station
from tests.wire.heartbeat_trial import KINDS, WITHIN_S, trial


@pytest.mark.slow
@pytest.mark.parametrize("kind", [kind for kind in KINDS if kind != "suspended"])  # it would hold the clock of the cell
def test_the_arm_stops_when_the_computer_fails(start_station: Callable[..., Station], kind: str) -> None:
    with start_station("--time-scale", "1") as station:
        decelerates_s = trial(station, kind, 0.5, real_clock=False)
    assert decelerates_s is not None
    assert decelerates_s < WITHIN_S
