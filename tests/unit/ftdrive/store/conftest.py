"""Run folders that the tests of the store share."""

from pathlib import Path

import pytest

from tests.unit.ftdrive.store.run_folders import new_run, result, verified


@pytest.fixture
def runs(tmp_path: Path) -> Path:
    """Three runs, one with an update of the second, and a verification."""
    runs = tmp_path / "runs"
    found = [result(day) for day in (0, 30, 60)]
    for day, one in enumerate(found):
        new_run(runs, f"2026-03-0{day + 1}-calibrate", one)
    update = result(31, parent={"id": found[1].id, "path": "p"}, update="bias", temperature_C=25)
    verified(new_run(runs, "2026-04-01-verify", update), found[1].id, 31, passed=False)
    verified(new_run(runs, "2026-04-02-verify"), found[1].id, 32)
    (runs / "notes").mkdir()
    return runs
