"""The events of an emulated calibration name no folder that is gone afterwards, and commands that can be typed."""

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from ftdrive.session import rehearsal
from ftdrive.session.events import Event, Noted, RunOpened

STATION: Any = SimpleNamespace(description={}, truth={"mass_kg": 0.5}, cell=None)


class Listener:
    def __init__(self) -> None:
        self.events: list[Event] = []

    def show(self, event: Event) -> None:
        self.events.append(event)


@pytest.mark.parametrize(("kept", "expected"), [(True, [RunOpened, Noted, Noted]), (False, [Noted])])
def test_the_place_of_a_run_that_is_not_kept_is_not_printed(
    kept: bool, expected: list[type[Event]], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder, person = str(tmp_path / "2026-simulated"), Listener()

    def calibrate(_: object, operator: Any, options: Any) -> SimpleNamespace:
        assert options.runs == tmp_path
        operator.show(RunOpened(folder=folder, resume=f"ftdrive calibrate --resume {folder}"))
        operator.show(Noted(words="this computer cannot be kept awake"))
        operator.show(Noted(words=f"3 poses are kept in {folder}"))
        return SimpleNamespace()

    monkeypatch.setattr(rehearsal, "run_calibration", calibrate)
    rehearsal.rehearse(STATION, tmp_path, "simulated", person, kept=kept)  # type: ignore[arg-type]
    assert [type(event) for event in person.events] == expected
