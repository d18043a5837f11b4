"""A calibration in motion from files, read piece by piece: a recording, or tables of another program."""

from collections.abc import Iterator, Sequence
from dataclasses import asdict, replace
from math import isfinite
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from ftcalib import CalibrationResult, Known, Setup
from ftcalib.model import STANDARD_GRAVITY_M_S2
from ftcalib.motion.samples import Means
from ftcalib.motion.solve import solve_motion
from ftdrive.cell.config import NOMINAL_ORIENTATION_DEG
from ftdrive.errors import BadRecording
from ftdrive.recording.compensation import NEEDED
from ftdrive.recording.files import RecordingReader
from ftdrive.recording.foreign import table_words
from ftdrive.recording.recording import Header, Recording
from ftdrive.runs.run import made_now
from ftdrive.runs.source import require_same_cell
from ftdrive.tables.table import Rows, Table


def solve_recording(
    source: Path | Recording | tuple[Table, Table],
    *,
    known: Known | None,
    point_mass: bool,
    up_in_base: Sequence[float] | None,
    earlier: CalibrationResult | None = None,
) -> CalibrationResult:
    """Calibrate from a recording in motion.

    Parameters
    ----------
    source : Path, Recording or tuple of Table
        A recording of `ftdrive record`, as a file or in memory, or the wrench and the poses of another program on one
        clock, in two tables or in one.
    known : Known, optional
        A known direction of gravity means a base that is level with respect to `up_in_base`.
    point_mass : bool
        Whether the load is known to have no inertia about its centre of mass.
    up_in_base : sequence of float, optional
        (3,) declared up direction.
    earlier : CalibrationResult, optional
        Of the same cell with another tool, as for `solve_motion`.

    Raises
    ------
    BadDataset, BadRecording, ConfigError, OSError
        A file cannot be used, or the earlier result is rejected or of another sensor or arm.
    NotObservable
        The motion does not determine the parameters, or contradicts the earlier result.
    """
    provenance, height_m, g_m_s2, any_zero = made_now(), None, STANDARD_GRAVITY_M_S2, False
    accuracy_deg = None
    if isinstance(source, Path | Recording):
        wrench, poses, header = _read_in_motion(source)
        devices = {"arm": asdict(header.info.arm), "sensor": asdict(header.info.sensor)}
        provenance |= {"recording": getattr(source, "name", "in memory"), "devices": devices}
        g_m_s2 = header.info.calibration.g_m_s2
        height_m = float(header.info.p_flange_sensor_m[2])
        any_zero = header.info.sensor.has_arbitrary_zero
    else:
        wrench, poses = (_means_of(rows) for rows in (source[0].wrenches(), source[1].poses()))
        accuracy_deg = NOMINAL_ORIENTATION_DEG if source[1].has_nominal_kinematics else None
        names = [table.name for table in source]
        provenance |= {"wrench": names[0], "orientation": names[1]} if len(set(names)) == 2 else {"recording": names[0]}
        provenance |= {"table": words} if (words := table_words(source)) else {}
    if earlier is not None:
        require_same_cell(earlier, provenance)
    setup = Setup(up_in_base=up_in_base, sensor_has_arbitrary_zero=any_zero, orientation_accuracy_deg=accuracy_deg)
    if known is not None and known.gravity_direction_base is not None:
        known = replace(known, gravity_direction_base=-setup.up)
    return solve_motion(
        wrench,
        poses,
        known=known,
        earlier=earlier,
        point_mass=point_mass,
        height_m=height_m if height_m is not None and isfinite(height_m) else None,
        g_m_s2=g_m_s2,
        setup=setup,
        provenance=provenance,
    )


def _read_in_motion(source: Path | Recording) -> tuple[Means, Means, Header]:
    """Read a recording of `ftdrive record`; without positions where it has none. Raises as `RecordingReader.pieces`."""
    reader = source if isinstance(source, Recording) else RecordingReader(source, NEEDED)
    wrench, poses = Means(), Means()
    if isinstance(source, Recording) and (missing := {*NEEDED} - {*(source.rows.dtype.names or ())}):
        raise BadRecording(f"the recording was read without {', '.join(sorted(missing))}: read it with all columns")
    start_ns, with_position = None, False
    for rows in (piece.rows for piece in reader.pieces() if len(piece.rows)):
        if start_ns is None:
            start_ns = int(rows["t_host_ns"][0])
            with_position = bool(np.isfinite(rows["p_base_flange_m"][0]).all())
        t_s = (rows["t_host_ns"] - start_ns) * 1e-9
        R = Rotation.from_quat(rows["quaternion_base_flange"]).as_matrix().reshape(-1, 9)
        wrench.add(t_s, rows["raw"])
        poses.add(t_s, np.hstack([R, rows["p_base_flange_m"]]) if with_position else R)
    return wrench, poses, reader.header


def _means_of(every: Iterator[Rows]) -> Means:
    means = Means()
    for rows in every:
        means.add(rows.t_s, rows.values)
    return means
