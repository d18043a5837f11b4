"""Data of a calibration from any place that `solve` and `report` accept: a run folder, a dataset or a CSV file."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

from ftcalib import CalibrationDataset, Known, read_csv
from ftcalib.model import STANDARD_GRAVITY_M_S2, UP_IN_BASE
from ftcalib.routine import PoseRecord
from ftdrive.runs.outcome import dataset_of
from ftdrive.runs.run import Run, versions

Orientation = Literal["R_base_flange", "R_flange_base"]


@dataclass(frozen=True, slots=True, eq=False)
class Source:
    """What a place holds."""

    dataset: CalibrationDataset
    circumstances: dict[str, Any]
    """What else `ftcalib.solve` takes; `payload_kg` only for a run."""
    provenance: dict[str, Any]
    records: Sequence[PoseRecord] = ()
    """Only of a run."""


def read_source(source: Path, orientation: Orientation, known: Known | None = None) -> Source:
    """Read the data of a place.

    Parameters
    ----------
    source : Path
        A run folder, a dataset.json or a CSV file.
    orientation : Orientation
        Of the rotations in a CSV file.
    known : Known, optional
        A known direction of gravity means a base that is level with respect to the mounting.

    Raises
    ------
    BadDataset, OSError
    """
    if source.is_dir():
        run = Run(source)
        records = run.records()
        dataset, circumstances, provenance = dataset_of(run, records)
    else:
        records = []
        dataset = CalibrationDataset.load(source) if source.suffix == ".json" else read_csv(source, orientation)
        circumstances = {"g_m_s2": STANDARD_GRAVITY_M_S2, "up_in_base": UP_IN_BASE}
        provenance = {"source": source.name, "versions": versions()}
    if known is not None and known.gravity_direction_base is not None:
        known = replace(known, gravity_direction_base=-circumstances["up_in_base"])
    return Source(dataset, {**circumstances, "known": known}, provenance, records)
