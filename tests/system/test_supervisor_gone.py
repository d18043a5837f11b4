"""A supervisor that is gone: the arm stops, the event and the message come, and the run is resumed."""

from collections.abc import Iterator
from pathlib import Path

import pytest

from ftdrive.cell.emulated import Station
from ftdrivers.ur.control import ControlPath
from tests.system.command_line import CommandLine
from tests.system.supervisor_trial import ANSWERS, GONE, Kind, push_trial, trial, verify_trial
from tests.ur_rtde import require_ur_rtde

LONG_BEFORE_ITS_GOAL_S = 1.0
"""The move takes 3 s. An idle computer needs 0.3 s at most, but here it may be busy."""


@pytest.fixture(scope="module")
def station(request: pytest.FixtureRequest) -> Iterator[Station]:
    path: ControlPath = request.param
    if path == "ur-rtde":
        require_ur_rtde()
    with Station("robotous-serial", ["--seed", "3"], control_path=path) as station:
        yield station


# Each kind was tried at rest and in mid-move, on both paths, before these were chosen.
ALONE = [("reader killed", True, "ur-rtde"), ("stdin closed", False, "script")]


@pytest.mark.slow
@pytest.mark.parametrize(("kind", "moving", "station"), ALONE, indirect=["station"])
def test_a_supervisor_that_leaves_ends_the_session(
    kind: Kind, moving: bool, station: Station, ftdrive: CommandLine
) -> None:
    seen = trial(kind, station, ftdrive, moving=moving)
    assert seen.exit_code == GONE, seen
    assert seen.moved == moving
    assert seen.rest_s is None or seen.rest_s < LONG_BEFORE_ITS_GOAL_S
    assert len(seen.events) == 1
    assert "error: " in seen.said
    assert "Traceback" not in seen.said
    assert seen.resumed == 0


@pytest.mark.slow
@pytest.mark.parametrize("station", ["script"], indirect=True)
def test_verify_stops_likewise_and_push_sends_nothing(station: Station, ftdrive: CommandLine) -> None:
    config = ftdrive.connect(station)
    run = Path(ftdrive.json("calibrate", "--config", config, "--minimal", typed=ANSWERS)["run"])
    seen = verify_trial(station, ftdrive, ftdrive.folder / run)
    assert (seen.exit_code, seen.moved, len(seen.events), seen.resumed) == (GONE, True, 1, 0), seen
    assert seen.rest_s is not None
    assert seen.rest_s < LONG_BEFORE_ITS_GOAL_S
    code, said, sent = push_trial(station, ftdrive, ftdrive.folder / run)
    assert (code, sent) == (GONE, False), said
    assert "standard input" in said
