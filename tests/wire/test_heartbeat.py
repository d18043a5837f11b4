"""The heartbeat of the script path: however the computer fails in mid-move, the controller stops the arm by itself.

tests/benchmarks/heartbeat.py makes 100 trials of each kind.
"""

from collections.abc import Callable

import pytest

from tests.wire.conftest import Station
from tests.wire.heartbeat_trial import KINDS, WITHIN_S, trial


@pytest.mark.parametrize(
    "kind",
    [pytest.param(kind, marks=pytest.mark.realtime if kind == "suspended" else pytest.mark.slow) for kind in KINDS],
)
def test_the_arm_stops_when_the_computer_fails(start_station: Callable[..., Station], kind: str) -> None:
    """A suspended client would hold the clock of the cell, so it keeps the computer's time."""
    with start_station("--time-scale", "1") as station:
        decelerates_s = trial(station, kind, 0.5, real_clock=kind == "suspended")
    assert decelerates_s is not None
    assert decelerates_s < WITHIN_S
