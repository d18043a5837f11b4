"""A calibration of an emulated cell, for `demo` and for commands with `--simulate`."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from ftdrive.cell.emulated import MOVED_BY, Station, sensor_name
from ftdrive.runs.outcome import Outcome
from ftdrive.session.events import Event
from ftdrive.session.operator import Key, Operator, Question
from ftdrive.session.options import SessionOptions, with_recorded_mode
from ftdrive.session.session import calibrate
from ftdrive.terminal.console import talk
from ftdrive.terminal.screen import open_operator


class _Unkept:
    """An operator without the events that name a temporary folder."""

    def __init__(self, operator: Operator, folder: Path) -> None:
        self._operator, self._folder = operator, str(folder)

    @property
    def has_keys(self) -> bool:
        return self._operator.has_keys

    def show(self, event: Event) -> None:
        if self._folder not in str(event.to_dict()):
            self._operator.show(event)

    def ask(self, question: Question) -> str:
        return self._operator.ask(question)

    def pressed(self) -> Key | None:
        return self._operator.pressed()


def described(station: Station) -> dict[str, Any]:
    """Return what run.json says about an emulated cell."""
    said = {"sensor": station.sensor, "options": station.options, "control_path": station.control_path}
    return {"station": {**said, "truth": station.truth}}


def start_mover(station: Station, options: SessionOptions) -> None:
    """Let the emulated cell move its arm, in a mode in which the session does not move it."""
    if mover := MOVED_BY.get(with_recorded_mode(options).mode):
        request, words = mover
        station.control(**request)
        talk.print(f"The cell is emulated: {words}.")


def rehearse(station: Station, runs: Path, name: str, *, poses: int = 24, kept: bool = True) -> Outcome:
    """Calibrate an emulated cell without questions; `kept` says whether the folder `runs` outlives the command."""
    options = SessionOptions(runs, name, poses=poses, real=False, questions=False, description=described(station))
    with open_operator() as operator:
        outcome = calibrate(station.cell, operator if kept else _Unkept(operator, runs), options)
    if outcome is None:
        raise RuntimeError("a rehearsal is never a dry run")
    return outcome


@contextmanager
def rehearsed_run(sensor: str | None) -> Iterator[Path]:
    """Make a short run of an emulated cell; yields its folder, which is deleted afterwards.

    Parameters
    ----------
    sensor : str, optional
        As `sensor_name` takes it.
    """
    with TemporaryDirectory(prefix="ftdrive-") as runs:
        with Station(sensor_name(sensor)) as station:
            outcome = rehearse(station, Path(runs), "simulated", poses=6, kept=False)
        yield outcome.run.folder
