"""Datasets, calibrations and recorded runs from any place that commands accept: run folders and single files."""

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any, Final

import numpy as np

from ftcalib import CalibrationDataset, CalibrationResult, Known, Setup, read_csv
from ftcalib.data.dataset import Orientation
from ftcalib.errors import BadDataset
from ftcalib.model import STANDARD_GRAVITY_M_S2, Array, Parameters
from ftcalib.routine import ArmReading, PoseRecord, WrenchSamples
from ftdrive.runs.outcome import dataset_of, earlier_of
from ftdrive.runs.run import Run, versions


class RecordedRun:
    """Arm and sensor in one, as `ftcalib.routine` wants them; neither moves nor waits."""

    def __init__(self, records: Sequence[PoseRecord]) -> None:
        self._records = list(records)
        self._stop = -1
        self._collected = False

    def go_on_to(self, q_rad: Array) -> None:
        """Go on to the next recorded stop, which must be at these joint angles (6,)."""
        self._stop += 1
        if not np.array_equal(q_rad, self._records[self._stop].pose.q_rad):
            raise ValueError(f"stop {self._stop + 1} of the recording went elsewhere than the routine now asks")

    def wait_until_still(self, **_: object) -> None:
        """Begin a look at the pose."""
        self._collected = False

    def state(self) -> ArmReading:
        """Return the state before or after the samples."""
        record = self._records[self._stop]
        return record.after if self._collected else record.before

    def collect(self, _duration_s: float, /) -> WrenchSamples:
        """Give the samples of this stop."""
        self._collected = True
        return self._records[self._stop].samples

    def check(self) -> None:
        """Do nothing: a recording cannot fail."""


_UNDESCRIBED: Final = Setup()


@dataclass(frozen=True, slots=True, eq=False)
class Source:
    """What a place holds."""

    dataset: CalibrationDataset
    provenance: dict[str, Any]
    g_m_s2: float = STANDARD_GRAVITY_M_S2
    setup: Setup = _UNDESCRIBED
    """The described cell."""
    known: Known | None = None
    records: Sequence[PoseRecord] = ()
    """Only of a run."""
    earlier: CalibrationResult | None = None
    """Of a run of a new tool: the result that gives mounting, base and gain."""

    @property
    def circumstances(self) -> dict[str, Any]:
        """What `ftcalib.solve` takes beside dataset and provenance."""
        return {"g_m_s2": self.g_m_s2, "setup": self.setup, "known": self.known}

    @property
    def truth(self) -> Parameters | None:
        """What a perfect calibration finds, of an emulated cell that is described in the run."""
        truth = (self.provenance.get("station") or {}).get("truth")
        return None if truth is None else Parameters(*(np.array(truth[one.name]) for one in fields(Parameters)))


def read_source(
    source: Path, orientation: Orientation, known: Known | None = None, up_in_base: Sequence[float] | None = None
) -> Source:
    """Read the data of a place.

    Parameters
    ----------
    source : Path
        A run folder, a dataset.json or a CSV file.
    orientation : Orientation
        Of the rotations in a CSV file.
    known : Known, optional
        A known direction of gravity means a base that is level with respect to the mounting.
    up_in_base : sequence of float, optional
        (3,) declared up direction, instead of that of a run's mounting.

    Raises
    ------
    BadDataset, OSError
    """
    if source.is_dir():
        run = Run(source)
        if run.in_motion:
            raise BadDataset(f"{source} is a recording in motion and has no poses: solve it with {run.solve_command}")
        records = run.records()
        dataset, of_run = dataset_of(run, records)
        found = Source(dataset, of_run.provenance(), of_run.g_m_s2, of_run.setup, None, records, earlier_of(run))
    else:
        dataset = CalibrationDataset.load(source) if source.suffix == ".json" else read_csv(source, orientation)
        found = Source(dataset, {"source": source.name, "versions": versions()})
    if up_in_base is not None:
        provenance = {**found.provenance, "up_in_base": list(up_in_base)}
        found = replace(found, setup=replace(found.setup, up_in_base=up_in_base), provenance=provenance)
    if known is not None and known.gravity_direction_base is not None:
        known = replace(known, gravity_direction_base=-found.setup.up)
    return replace(found, known=known)


def read_dataset(path: str | Path, orientation: Orientation = "R_base_flange") -> CalibrationDataset:
    """Read the poses of a calibration; `CalibrationDataset.save` writes them.

    Parameters
    ----------
    path : str or Path
        A run folder, a dataset.json or a CSV file, whose columns are those of `ftcalib.read_csv`.
    orientation : {"R_base_flange", "R_flange_base"}
        Of the rotations in a CSV file: flange to base coordinates, like a robot pose, or the inverse.

    Raises
    ------
    DataError
        The message names the file, and the row or the field.
    OSError
        It cannot be read.

    Examples
    --------
    >>> import ftdrive
    >>> dataset = ftdrive.read_dataset("poses.csv")
    >>> dataset.wrench.shape
    (24, 6)
    """
    return read_source(Path(path), orientation).dataset


def read_calibration(path: str | Path, *, accept_edited: bool = False) -> CalibrationResult:
    """Read a calibration; `CalibrationResult.save` writes it.

    Parameters
    ----------
    path : str or Path
        A calibration.json, or a run folder: its newest calibration.
    accept_edited : bool
        Accept a file that was edited by hand; the result is then `is_edited`.

    Raises
    ------
    DataError
        The file is not a calibration that this version can read, is damaged or was edited.
    OSError
        It cannot be read.

    Examples
    --------
    >>> import ftdrive
    >>> ftdrive.solve(ftdrive.read_dataset("poses.csv")).save("calibration.json")
    >>> ftdrive.read_calibration("calibration.json").verdict
    'good'
    """
    path = Path(path)
    return CalibrationResult.load(Run(path).calibration_path if path.is_dir() else path, accept_edited=accept_edited)
