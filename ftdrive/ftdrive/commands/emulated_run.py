"""A calibration of an emulated cell in the terminal, for `demo` and for commands with `--simulate`."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from ftdrive.cell.emulated import Station
    from ftdrive.runs.outcome import Outcome
    from ftdrive.session.options import SessionOptions


def rehearse(station: "Station", runs: Path, name: str, *, kept: bool = True, **options: Any) -> "Outcome":
    """Calibrate an emulated cell as `ftdrive.session.rehearsal.rehearse` does, and show it."""
    from ftdrive.session import rehearsal
    from ftdrive.terminal.screen import open_operator

    with open_operator() as operator:
        return rehearsal.rehearse(station, runs, name, operator, kept=kept, **options)


def start_mover(station: "Station", options: "SessionOptions") -> None:
    """Let the emulated cell move its arm, in a mode in which the session does not move it."""
    from ftdrive.cell.emulated import MOVED_BY
    from ftdrive.session.options import with_recorded_mode
    from ftdrive.terminal.console import messages

    if mover := MOVED_BY.get(with_recorded_mode(options).mode):
        request, words = mover
        station.control(**request)
        messages.print(f"The cell is emulated: {words}.")


@contextmanager
def rehearsed_run(sensor: str | None, **options: Any) -> Iterator[Path]:
    """Make a short run of an emulated cell; yields its folder, which is deleted afterwards.

    Parameters
    ----------
    sensor : str, optional
        As `sensor_name` takes it.
    options
        As of `SessionOptions`.
    """
    from ftdrive.cell.emulated import Station

    with TemporaryDirectory(prefix="ftdrive-") as runs:
        with Station.of(None, sensor) as station:
            outcome = rehearse(station, Path(runs), "simulated", kept=False, **options)
        yield outcome.run.folder
