"""A calibration in motion from files, read piece by piece: a recording, or two CSV files of another program."""

from collections.abc import Sequence
from dataclasses import asdict, replace
from math import isfinite
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from ftcalib import CalibrationResult, Known, Setup
from ftcalib.data.dataset import rotations_of
from ftcalib.errors import BadDataset
from ftcalib.model import STANDARD_GRAVITY_M_S2, Array
from ftcalib.motion.samples import Means
from ftcalib.motion.solve import solve_motion
from ftdrive.recording.compensation import NEEDED
from ftdrive.recording.csv_pair import ORIENTATION, WRENCH, Wanted, read_table
from ftdrive.recording.files import RecordingReader
from ftdrive.recording.recording import Header
from ftdrive.runs.run import made_now
from ftdrive.runs.source import require_same_cell

_POSITION = ("x", "y", "z")


def solve_recording(
    path: Path,
    pair: tuple[Path, Path] | None = None,
    means: tuple[Means, Means] | None = None,
    *,
    known: Known | None,
    point_mass: bool,
    up_in_base: Sequence[float] | None,
    earlier: CalibrationResult | None = None,
) -> CalibrationResult:
    """Calibrate from a recording in motion.

    Parameters
    ----------
    path : Path
        A recording of `ftdrive record`.
    pair : tuple of Path, optional
        Instead of it: CSV files of the wrench and of the poses, on one clock.
    means : tuple of Means, optional
        Instead of both: wrench and poses of a bag, whose name is that of `path`.
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
    provenance, height_m, g_m_s2 = made_now(), None, STANDARD_GRAVITY_M_S2
    if means is not None:
        wrench, poses = means
        provenance |= {"recording": path.name}
    elif pair is None:
        wrench, poses, header = _read_in_motion(path)
        devices = {"arm": asdict(header.info.arm), "sensor": asdict(header.info.sensor)}
        provenance |= {"recording": path.name, "devices": devices}
        g_m_s2 = header.info.calibration.g_m_s2
        height_m = float(header.info.p_flange_sensor_m[2])
    else:
        wrench, poses = _read_wrench_file(pair[0]), _read_pose_file(pair[1])
        provenance |= {"wrench": pair[0].name, "orientation": pair[1].name}
    if earlier is not None:
        require_same_cell(earlier, provenance)
    setup = Setup(up_in_base=up_in_base)
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


def _read_in_motion(path: Path) -> tuple[Means, Means, Header]:
    """Read a recording of `ftdrive record`; without positions where it has none. Raises as `RecordingReader.pieces`."""
    reader, wrench, poses = RecordingReader(path, NEEDED), Means(), Means()
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


def _read_wrench_file(path: Path) -> Means:
    """Read columns t in s, fx, fy, fz in N, tx, ty, tz in N·m. Raises `BadDataset` or `OSError`."""
    means = Means()
    for part in read_table(path, WRENCH):
        _add(means, path, part.t_s, part.numbers)
    return means


def _read_pose_file(path: Path) -> Means:
    """Read columns t in s, the orientation of the flange in base and, if they are there, x, y, z in m.

    The orientation is r11..r33, qx, qy, qz, qw, or rx, ry, rz in rad. Raises `BadDataset` or `OSError`.
    """

    def pose(names: Sequence[str]) -> Sequence[str]:
        return [*ORIENTATION.choose(names), *(_POSITION if set(_POSITION) <= set(names) else ())]

    means = Means()
    for part in read_table(path, Wanted(pose, ORIENTATION.words)):
        of_orientation = tuple(name for name in part.names if name not in _POSITION)
        try:
            R = rotations_of(of_orientation, part.numbers[:, : len(of_orientation)]).reshape(-1, 9)
        except BadDataset as error:
            raise BadDataset(f"{path.name}: {error}") from error
        _add(means, path, part.t_s, np.hstack([R, part.numbers[:, len(of_orientation) :]]))
    return means


def _add(means: Means, path: Path, t_s: Array, values: Array) -> None:
    try:
        means.add(t_s, values)
    except BadDataset as error:
        raise BadDataset(f"{path.name}: {error}") from error
