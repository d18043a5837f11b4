"""The line that sums up a fleet."""

from dataclasses import replace
from datetime import timedelta

import pytest

from ftdrive.fleet.state import Fleet, FleetFinding, summary
from tests.unit.ftdrive.fleet.fleets import DRIFTING, NOW, cell, never_calibrated

SOUND = cell("A")
LATE = cell("B", due=NOW - timedelta(days=2))
PAYLOAD = FleetFinding("payload", ("A", "C"), "the payload is wrong")
BASE = FleetFinding("base", ("C",), "the base has turned")


@pytest.mark.parametrize(
    ("fleet", "words"),
    [
        (Fleet((SOUND,), ()), "1 cell: none needs attention"),
        (Fleet((SOUND, replace(SOUND, tool="drill")), ()), "1 cell: none needs attention"),
        (Fleet((SOUND, LATE), (FleetFinding("overdue", ("B",), "late"),)), "2 cells: 1 due"),
        (Fleet((SOUND, cell("C")), (PAYLOAD, BASE)), "2 cells: 2 with a finding"),
        (
            Fleet((cell("A", drift=DRIFTING), replace(LATE, passed=False), never_calibrated("C")), (BASE,)),
            "3 cells: 1 never calibrated, 1 failed, 1 drifting, 1 due, 1 with a finding",
        ),
    ],
)
def test_cells_with_and_without_findings_are_counted(fleet: Fleet, words: str) -> None:
    assert summary(fleet, NOW) == words
