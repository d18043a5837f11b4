"""Calibration from files: poses at rest, or a recording in motion, which is read piece by piece."""

from collections.abc import Sequence
from dataclasses import asdict, replace
from math import isfinite
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from ftcalib import CalibrationResult, Known, Setup
from ftcalib.model import STANDARD_GRAVITY_M_S2
from ftcalib.motion.samples import Means
from ftcalib.motion.solve import solve_motion
from ftdrive.cell.config import NOMINAL_ORIENTATION_DEG
from ftdrive.errors import BadRecording, ConfigError
from ftdrive.recording.files import RecordingReader
from ftdrive.recording.foreign import is_bag, moving_source, table_words
from ftdrive.recording.recording import NEEDED, Header, Recording
from ftdrive.runs.calibration import made_now
from ftdrive.runs.run import Run
from ftdrive.runs.source import RecordedData, SolveOptions, read_source, require_same_cell, solve_in_motion
from ftdrive.tables.table import Table

Moving = Run | Path | tuple[Table, Table]


def read_place(place: Path, options: SolveOptions) -> Moving | RecordedData:
    """Return poses at rest, or a recording in motion, which is read when solved. Raises the errors of `read_source`."""
    if any(options.topics) and (options.pair is not None or not is_bag(place)):
        raise ConfigError("--wrench-topic and --pose-topic are only for a ROS bag: leave them out")
    moving: Moving | None
    if is_bag(place) and options.method != "ml":
        moving = place  # do not read the bag, because the error below follows
    elif place.is_dir() and Run(place).in_motion:
        moving = Run(place)
    else:
        moving = moving_source(place, options)
    if moving is not None and options.method != "ml":
        raise ConfigError(f"--method {options.method} is for poses at rest: leave it out for a recording")
    return read_source(place, options) if moving is None else moving


def solve_place(data: Moving | RecordedData, options: SolveOptions) -> CalibrationResult:
    """Solve the data from `read_place`; if the options have an earlier result, solve only for the tool.

    Raises `ConfigError` for options that the solution method cannot use, in addition to the errors of the solvers.
    """
    if isinstance(data, RecordedData):
        method: Any = options.method
        try:
            return data.solve(method, drift=options.drift, as_published=options.as_published, earlier=options.earlier)
        except ValueError as error:
            raise ConfigError(str(error)) from error
    known, earlier, point_mass = options.known, options.earlier, options.point_mass
    if isinstance(data, Run):
        return solve_in_motion(data, known, earlier=earlier, point_mass=point_mass)
    return solve_recording(data, known=known, point_mass=point_mass, up_in_base=options.up_in_base, earlier=earlier)


def solve_recording(
    source: Path | Recording | tuple[Table, Table],
    *,
    known: Known | None,
    point_mass: bool,
    up_in_base: Sequence[float] | None,
    earlier: CalibrationResult | None = None,
) -> CalibrationResult:
    """Calibrate from a recording in motion, from ftdrive or from another program with one clock, by `solve_motion`.

    With a known direction of gravity, the base is level with respect to the declared up direction `up_in_base` (3,).
    `earlier` is a result of the same cell with another tool.

    Raises `BadDataset`, `BadRecording`, `ConfigError` or `OSError` if a file cannot be used, or if the earlier result
    is rejected or belongs to another sensor or arm. Raises `NotObservable` if the motion does not determine the
    parameters, or if it contradicts the earlier result.
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
        wrench, poses = Means(), Means()
        for means, every in ((wrench, source[0].wrenches()), (poses, source[1].poses())):
            for rows in every:
                means.add(rows.t_s, rows.values)
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
    """Return means of wrenches and poses (R, and p if known), and the header. Errors as in `RecordingReader.pieces`."""
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
