"""A calibration of an emulated cell, without questions."""

from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from ftcalib import CalibrationResult
from ftdrive.cell.emulated import REAL_PACE, Station
from ftdrive.errors import Declined, NotAccepted
from ftdrive.runs.source import Outcome
from ftdrive.session.events import Event, Key, Operator, Question
from ftdrive.session.options import SessionOptions
from ftdrive.session.session import calibrate


class NoOperator:
    """Nothing is shown and no key is pressed; a question raises `Declined`."""

    has_keys = False
    pressed_by = "the operator"

    def show(self, event: Event) -> None:
        """Do nothing."""

    def ask(self, question: Question) -> str:
        """Raise `Declined`."""
        raise Declined(f"no operator can answer: {question.text}")

    def absence(self) -> str | None:
        """Return None: a session without an operator misses none."""
        return None

    def pressed(self) -> Key | None:
        """Return None."""
        return None


class _Unkept:
    """An operator without the events that name a temporary folder."""

    def __init__(self, operator: Operator, folder: Path) -> None:
        self._operator, self._folder = operator, str(folder)

    @property
    def has_keys(self) -> bool:
        return self._operator.has_keys

    @property
    def pressed_by(self) -> str:
        return self._operator.pressed_by

    def show(self, event: Event) -> None:
        if self._folder not in str(event.to_dict()):
            self._operator.show(event)

    def ask(self, question: Question) -> str:
        return self._operator.ask(question)

    def absence(self) -> str | None:
        return self._operator.absence()

    def pressed(self) -> Key | None:
        return self._operator.pressed()


def rehearse(
    station: Station,
    runs: Path,
    name: str,
    operator: Operator,
    *,
    kept: bool = True,
    **options: Any,
) -> Outcome:
    """Calibrate an emulated cell.

    `kept` says whether the folder `runs` outlives the calibration; the other keywords are those of `SessionOptions`.
    """
    chosen = SessionOptions(runs, name, real=False, questions=False, description=station.description, **options)
    outcome = calibrate(station.cell, operator if kept else _Unkept(operator, runs), chosen)
    if outcome is None:
        raise RuntimeError("a rehearsal is never a dry run")
    return outcome


def short_calibration(operator: Operator, sensor: str | None = None) -> CalibrationResult:
    """Calibrate an emulated cell with six poses, which takes about 10 s; the run is not kept.

    Parameters
    ----------
    operator : Operator
    sensor : str, optional
        As `sensor_name` takes it.

    Raises
    ------
    NotAccepted
        The result is rejected.
    """
    with Station.of(None, sensor) as station, TemporaryDirectory(prefix="ftdrive-") as runs:
        result = rehearse(station, Path(runs), "simulated", operator, poses=6, kept=False).result
    if result.verdict == "rejected":
        raise NotAccepted(f"the calibration of the emulated cell was rejected: {result.reasons[0]}")
    return result


def station_of(calibration: CalibrationResult, sensor: str | None = None) -> Station:
    """Return the emulated cell of a calibration for a stream, not started; `sensor` replaces its sensor."""
    # A stream pairs by the controller's clock.
    return Station.of(calibration.provenance.get("station"), sensor, REAL_PACE)
