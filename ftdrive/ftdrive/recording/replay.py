"""Replay of a run, a recording or a table of another program as a stream."""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from shlex import quote
from typing import Any

import numpy as np

from ftcalib import CalibrationResult
from ftcalib.errors import BadDataset
from ftdrive.errors import ConfigError
from ftdrive.recording.files import load_recording
from ftdrive.recording.foreign import TablePair, tables_of
from ftdrive.recording.recording import with_calibration
from ftdrive.runs.calibration import read_calibration
from ftdrive.runs.run import Run
from ftdrive.stream.samples import Paired, StreamInfo, WrenchFrame, sensor_origin_m
from ftdrive.stream.sources import RecordingSource
from ftdrive.stream.stream import Stream
from ftdrivers.interfaces import NOT_REPORTED, DeviceInfo


def open_replay(path: Path, calibration: Path | None, frame: WrenchFrame, *, speed: float, force: bool) -> Stream:
    """Open the stream of a run folder, a recording (by default with its own calibration) or another program's table.

    Raises `ConfigError` if there is no calibration, and `DataError` or `OSError` for a file that cannot be used.
    """
    loaded = None if calibration is None else read_calibration(calibration, accept_edited=force)
    is_run = is_run_folder(path)
    tables = None if is_run else tables_of(path)
    if tables is None and not is_run:
        recording = load_recording(path)
        header = recording.header
        if loaded is not None:
            header = with_calibration(header, loaded, str(calibration))
        source = RecordingSource(header.info, recording.paired())
    elif loaded is None:
        own = quote(str(path)) if is_run and Run(path).calibration_path.is_file() else "PATH"
        raise ConfigError(f"no calibration: give --calibration {own}")
    elif tables is None:
        source = source_of_run(Run(path), loaded, str(calibration))
    else:
        pair = TablePair(*tables, loaded, str(calibration), None)
        source = RecordingSource(pair.header.info, Paired.concatenate([block.samples for block in pair.blocks()]))
    source.speed = speed
    return Stream(source, frame=frame).open()


def is_run_folder(path: Path) -> bool:
    """Whether a path is a folder, which is taken as a run; the `.partial` of an interrupted recording is not one."""
    return path.is_dir() and path.suffix != ".partial"


def source_of_run(run: Run, calibration: CalibrationResult, name: str = "") -> RecordingSource:
    """Return a source with the samples of a run's poses one after the other, without the moves, which have no samples.

    `name` names the calibration. Raises `BadDataset` for a damaged run or a run without poses.
    """
    header, records = run.header(), run.records()
    if not records:
        raise BadDataset(f"{run.folder} has no pose: replay another run")
    pieces: list[Paired] = []
    count, span_s = 0, 0.0
    for record in records:
        samples, at = record.samples, record.before
        n, sent = len(samples.seq), int(samples.seq[-1] - samples.seq[0]) + 1
        span_s += (samples.t_host_ns[-1] - samples.t_host_ns[0]) * 1e-9
        pieces.append(
            Paired(
                t_host_ns=np.empty(n, np.int64),
                t_device_s=samples.t_device_s,
                # numbers keep the gaps of lost samples, and go on from pose to pose
                seq=samples.seq - samples.seq[0] + count,
                status=samples.status,
                raw=samples.wrench,
                q_rad=np.tile(at.q_rad, (n, 1)),
                R_base_flange=np.tile(at.R_base_flange, (n, 1, 1)),
                p_base_flange_m=np.full((n, 3), np.nan),
            )
        )
        count += sent
    rate_Hz = (count - len(records)) / max(span_s, 1e-9)
    rows = Paired.concatenate(pieces)
    begin_ns = int(records[0].samples.t_host_ns[0])
    rows = replace(rows, t_host_ns=begin_ns + np.rint(rows.seq * 1e9 / rate_Hz).astype(np.int64))
    config: Mapping[str, Any] = header["config"]
    info = StreamInfo(
        result=calibration,
        calibration_name=name,
        arm=_replayed_device(header, "arm"),
        sensor=_replayed_device(header, "sensor"),
        tool=config["tool"].get("name", ""),
        utc_offset_ns=records[0].clock_offset_ns,
        sensor_rate_Hz=rate_Hz,
        arm_rate_Hz=rate_Hz,
        p_flange_sensor_m=sensor_origin_m(config["sensor"].get("height_mm")),
        R_flange_tcp=np.eye(3),
        p_flange_tcp_m=np.full(3, np.nan),
        versions=header.get("versions", {}),
        emulated=header.get("station") is not None,
    )
    return RecordingSource(info, rows)


def _replayed_device(header: Mapping[str, Any], role: str) -> DeviceInfo:
    found = header.get("devices", {}).get(role, {})
    return DeviceInfo(*(found.get(name, NOT_REPORTED) for name in ("model", "serial", "firmware")))
