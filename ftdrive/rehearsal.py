"""A calibration of an emulated cell: what `demo` shows, and what other commands need first with `--simulate`."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory

from ftdrive.screen import open_operator
from ftdrive.session.guided import Options, calibrate
from ftdrive.session.outcome import Outcome
from ftdrive.simulation import Station, sensor_name


def rehearse(station: Station, runs: Path, name: str, *, poses: int = 24) -> Outcome:
    """Take an emulated cell through a calibration without a question; the run is kept in `runs`."""
    description = {"station": {"sensor": station.sensor, "options": station.options, "truth": station.truth}}
    options = Options(runs, name, poses=poses, real=False, questions=False, description=description)
    with open_operator() as operator:
        outcome = calibrate(station.cell, operator, options)
    if outcome is None:
        raise RuntimeError("a rehearsal is never a dry run")
    return outcome


@contextmanager
def rehearsed_run(sensor: str | None) -> Iterator[Path]:
    """Make a short run of an emulated cell; yields its folder, which is gone afterwards.

    Parameters
    ----------
    sensor : str, optional
        As `sensor_name` takes it.
    """
    with TemporaryDirectory(prefix="ftdrive-") as runs:
        with Station(sensor_name(sensor)) as station:
            outcome = rehearse(station, Path(runs), "simulated", poses=6)
        yield outcome.run.folder
