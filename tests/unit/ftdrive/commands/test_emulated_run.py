"""The events of an emulated calibration name no folder that is gone afterwards, and commands that can be typed."""

from contextlib import nullcontext
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from click.testing import CliRunner

from ftdrive.commands import demo
from ftdrive.runs.run import Run
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


@pytest.mark.parametrize(("environment", "command"), [("1", "   uv run ftdrive "), (None, "   ftdrive ")])
def test_the_demo_names_its_next_commands_as_they_can_be_typed(
    environment: str | None, command: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.delenv("UV_RUN_RECURSION_DEPTH", raising=False)
    if environment is not None:
        monkeypatch.setenv("UV_RUN_RECURSION_DEPTH", environment)
    run = Run(Path("runs/a"))
    monkeypatch.setattr(Run, "records", lambda _: [])
    outcome = SimpleNamespace(run=run, result=SimpleNamespace(verdict="good"), drift=None)
    monkeypatch.setattr(demo, "Station", lambda *_, **__: nullcontext(STATION))
    monkeypatch.setattr(demo, "rehearse", lambda *_, **__: outcome)
    monkeypatch.setattr(demo, "print_result", lambda *_, **__: None)
    with capsys.disabled():
        shown = CliRunner().invoke(demo.demo, catch_exceptions=False).stderr
    lines = [line for line in shown.splitlines() if "runs/a" in line and "Saved" not in line]
    assert len(lines) == 2
    assert all(line.startswith(command) for line in lines)
