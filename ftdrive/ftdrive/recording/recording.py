"""Data model of a recording: columns, header and events, stored by every file format.

The orientation is stored as a quaternion, so that all formats contain the same bits.
"""

import json
from collections.abc import Generator, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import MISSING, asdict, dataclass, field, fields, replace
from itertools import accumulate, pairwise
from typing import Any, Final, NamedTuple, Protocol, Self, TypeVar

import numpy as np
from numpy.typing import NDArray

from ftcalib import CalibrationResult, shown
from ftcalib.display import Displayed, Row, Summary
from ftcalib.errors import BadCalibration, DataError
from ftcalib.files import JSON, check_format, parsed_json
from ftcalib.rounding import counted
from ftdrive.errors import BadRecording
from ftdrive.runs.verification import VerificationRecord
from ftdrive.stream.samples import (
    Block,
    Paired,
    Stages,
    StreamEvent,
    StreamInfo,
    WrenchFrame,
    matrices,
    quaternions,
    sensor_origin_m,
)
from ftdrivers.interfaces import DeviceInfo, Fact

T = TypeVar("T")
FORMAT: Final = "ftdrive.recording/1"

Rows = NDArray[np.void]
"""(n,) records of type `ROW`."""
PIECE_ROWS: Final = 1 << 13
"""Number of samples in a piece, small enough for the processor cache."""
ZSTD_LEVEL: Final = -5
"""Compression level of zstd: a fast one, because values with noise in their last digits hardly shrink at any level."""

_AXES = ("fx", "fy", "fz", "tx", "ty", "tz")
_GROUPS: Mapping[str, tuple[str, Sequence[str]]] = {
    "t_host_ns": ("<i8", ()),
    "t_device_s": ("<f8", ()),
    "seq": ("<i8", ()),
    "status": ("<u4", ()),
    "raw": ("<f8", [f"raw_{axis}" for axis in _AXES]),
    "wrench": ("<f8", _AXES),
    "chi2": ("<f8", ()),
    "in_contact": ("?", ()),
    "q_rad": ("<f8", [f"q{joint}" for joint in range(6)]),
    "p_base_flange_m": ("<f8", ["px", "py", "pz"]),
    "quaternion_base_flange": ("<f8", ["qx", "qy", "qz", "qw"]),
}
ROW: Final = np.dtype(
    [(name, kind, (len(names),)) if names else (name, kind) for name, (kind, names) in _GROUPS.items()]
)
"""Type of the record of one sample: fields named as in `Block`, and the orientation as a quaternion x, y, z, w."""
NEEDED: Final = ("t_host_ns", "seq", "raw", "p_base_flange_m", "quaternion_base_flange")
"""Fields of `ROW` that are required to compensate a recording."""
NUMBERS: Final = {name: names or (name,) for name, (_, names) in _GROUPS.items()}
"""Names of the columns that hold each field of `ROW` in the table formats (CSV, Parquet)."""


def flat_layout(kind: np.dtype[Any]) -> np.dtype[Any]:
    """Return the type of a record with one field per number; `kind` is `ROW` or has some of its fields."""
    return np.dtype([(one, kind[name].base) for name in kind.names or () for one in NUMBERS[name]])


COLUMNS: Final = flat_layout(ROW)
"""Type of a sample's record with one field per column of the table formats (CSV, Parquet)."""


def table_of(rows: Rows, start_ns: int, utc_offset_ns: int) -> dict[str, NDArray[Any]]:
    """Return the columns of a CSV or Parquet file: `t_s` and `t_utc_s` for other programs, then the fields of `rows`.

    `start_ns` is `t_host_ns` of the first sample of the recording.
    """
    t_ns, numbers = rows["t_host_ns"], rows.view(flat_layout(rows.dtype))
    times = {"t_s": (t_ns - start_ns) * 1e-9, "t_utc_s": (t_ns + utc_offset_ns) * 1e-9}
    return times | {name: numbers[name] for name in numbers.dtype.names or ()}


def places_of(events: Sequence[StreamEvent], rows: Rows) -> list[int]:
    """Return for each event the number of `rows` before it.

    A sample with the time of an event counts as before it, except for events that change the frame or the stages.
    """
    after_ns = [event.t_host_ns + (event.kind not in ("frame", "stages")) for event in events]
    return list(accumulate(np.searchsorted(rows["t_host_ns"], after_ns).tolist(), max))


def to_records(samples: Block | Paired) -> Rows:
    """Return samples as records of type `ROW`; fields that the samples lack are 0."""
    rows = np.zeros(len(samples), ROW)
    for name in _GROUPS:
        if hasattr(samples, name):
            rows[name] = getattr(samples, name)
    if len(rows):
        rows["quaternion_base_flange"] = quaternions(samples.R_base_flange)
    return rows


def _paired_of(rows: Rows) -> Paired:
    """Return the measured part of records: raw wrenches with their poses; columns that were not read are 0."""

    def column(name: str) -> NDArray[Any]:
        if name in (rows.dtype.names or ()):
            return np.ascontiguousarray(rows[name])
        return np.zeros((len(rows), *ROW[name].shape), ROW[name].base)

    names = [item.name for item in fields(Paired) if item.name != "R_base_flange"]
    return Paired(R_base_flange=matrices(column("quaternion_base_flange")), **{name: column(name) for name in names})


@dataclass(frozen=True, slots=True, eq=False)
class Header:
    """Constant description of a recording, with the frame and the stages at its first sample."""

    info: StreamInfo
    frame: WrenchFrame
    stages: Stages
    configuration: Mapping[str, JSON] = field(default_factory=dict)
    """Configuration of the cell, as printed by `ftdrive config show --json`."""

    @property
    def words(self) -> str:
        """Description of the wrench columns as text."""
        words = (
            "raw_fx..raw_tz as measured, sensor axes, about the sensor origin; "
            f"fx..tz compensated, {self.frame}; N, N·m, m, rad"
        )
        state = self.info.calibration_state or ", ".join(self.info.marks)
        return f"{words}; {state}" if state else words

    def to_dict(self) -> dict[str, JSON]:
        """Return the header as JSON; values that are not finite are null."""
        info = self.info
        values: dict[str, Any] = {item.name: getattr(info, item.name) for item in fields(StreamInfo)}
        for name in _ARRAYS:
            if (value := values[name]) is not None:
                values[name] = np.asarray(np.where(np.isfinite(value), value, None)).tolist()
        values |= {"arm": asdict(info.arm), "sensor": asdict(info.sensor), "versions": dict(info.versions)}
        values["calibration"] = info.calibration.to_dict()
        del values["result"]
        values["verification"] = None if info.verification is None else info.verification.to_dict()
        frame, stages = self.frame.to_dict(), asdict(self.stages)
        return {"format": FORMAT, **values, "frame": frame, "stages": stages, "configuration": dict(self.configuration)}

    @classmethod
    def from_dict(cls, document: Mapping[str, Any]) -> Self:
        """Build the header from JSON, ignoring unknown fields. Raises `BadRecording` if it is damaged or newer."""
        check_format(document, FORMAT, BadRecording)
        try:
            # files from earlier versions lack the fields with defaults
            newer = {item.name: item.default for item in fields(StreamInfo) if item.default is not MISSING}
            known = {**newer, "result": None, **document}
            values = {item.name: known[item.name] for item in fields(StreamInfo)}
            values |= {name: np.array(values[name], np.float64) for name in _ARRAYS if values[name] is not None}
            values |= {"arm": _device_info(values["arm"]), "sensor": _device_info(values["sensor"])}
            values["result"] = CalibrationResult.from_dict(document["calibration"])
            if values["verification"] is not None:
                values["verification"] = VerificationRecord.from_dict(values["verification"])
            frame, stages = _frame_from_dict(document["frame"]), _stages_of(document["stages"])
            return cls(StreamInfo(**values), frame, stages, document["configuration"])
        except KeyError as error:
            raise BadRecording(f"the header lacks the field {error.args[0]}: the file is damaged") from error
        except (BadCalibration, TypeError, ValueError) as error:
            raise BadRecording(f"the header cannot be read ({error}): the file is damaged") from error


_ARRAYS = ("p_flange_sensor_m", "R_flange_tcp", "p_flange_tcp_m", "hour_change")


def _device_info(document: Mapping[str, Any]) -> DeviceInfo:
    facts = {
        name: Fact(tuple(fact["value"]) if isinstance(fact["value"], list) else fact["value"], fact["source"])
        for name, fact in document["facts"].items()
    }
    return DeviceInfo(document["model"], document["serial"], document["firmware"], facts)


def _frame_from_dict(values: Mapping[str, Any]) -> WrenchFrame:
    about: Any = values["about"]
    return WrenchFrame(values["axes"], tuple(about) if isinstance(about, list) else about)


def _stages_of(values: Mapping[str, Any]) -> Stages:
    """Build the stages from JSON; a missing stage was off, because the version that wrote the file did not have it."""
    usual: dict[str, Any] = {item.name: item.default for item in fields(Stages)}
    off = {name: None if value is None else type(value)() for name, value in usual.items()}
    if newer := [name for name, value in dict(values).items() if value and name not in off]:
        raise BadRecording(f"the stage {newer[0]} is unknown to this version: use a newer ftdrive")
    return Stages(**{name: values.get(name, value) for name, value in off.items()})


def event_text(event: StreamEvent) -> str:
    """Return an event as one line of JSON."""
    values = {"t_host_ns": event.t_host_ns, "kind": event.kind, "text": event.text, "values": dict(event.values)}
    return json.dumps(values, ensure_ascii=False)


def event_of(text: str) -> StreamEvent:
    """Build an event from a line made by `event_text`. Raises `ValueError` for any other line."""
    try:
        values = parsed_json(text)
        return StreamEvent(values["t_host_ns"], values["kind"], values["text"], values["values"])
    except (KeyError, TypeError) as error:
        raise ValueError(f"an event without {error}") from error


class Piece(NamedTuple):
    """Consecutive samples of a recording, with all stored columns."""

    header: Header
    rows: Rows
    events: Sequence[StreamEvent]
    """Events of the recording since the previous piece."""
    share: float
    """Share of the recording read up to the end of this piece, 0 to 1."""

    def measured(self) -> "Measured":
        """Return the measured part of the piece: raw wrenches and poses, without the compensated wrench."""
        return Measured(_paired_of(self.rows), self.events, self.share)


class Measured(NamedTuple):
    """Consecutive samples of a recording, with only what was measured: raw wrench and pose with their times."""

    samples: Paired
    events: Sequence[StreamEvent]
    share: float
    """Share of the recording read up to the end of these samples, 0 to 1."""


class AnyRecording(Protocol):
    """Interface of a recording of any length that can be read in blocks, several times."""

    @property
    def header(self) -> Header:
        """Header of the recording."""

    @property
    def cut(self) -> str:
        """Reason why the file ends early, known once it is read to its end; empty if the recording is complete."""

    def blocks(self) -> Iterator[Measured]:
        """Yield all samples in blocks; each call starts again. Damage raises an error after the last valid block."""


def with_calibration(header: Header, calibration: CalibrationResult, name: str) -> Header:
    """Return a copy of a header with another calibration, which `name` names, and without a verification."""
    info = replace(header.info, result=calibration, calibration_name=name, verification=None, calibration_state="")
    if not np.isfinite(info.p_flange_sensor_m).all():
        info = replace(info, p_flange_sensor_m=sensor_origin_m(None, calibration))
    return replace(header, info=info)


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class Recording(Displayed):
    """A recording in memory.

    Events of the kinds "frame" and "stages" mark where these change among the samples; `values` has the new ones.
    """

    header: Header
    rows: Rows
    events: Sequence[StreamEvent]
    cut: str = ""
    """Why the file ends early; empty if it is complete."""

    @property
    def table(self) -> NDArray[np.void]:
        """(n,) samples as records with one field per number, named as in the CSV format, for `pandas.DataFrame`."""
        return self.rows.view(flat_layout(self.rows.dtype))

    def to_frame(self) -> Any:
        """Return the samples as a pandas DataFrame, or as a Polars DataFrame if pandas is missing.

        Returns
        -------
        DataFrame
            Columns of the CSV format: `t_s` since the first sample, `t_utc_s` since 1970, then those of `table`.

        Raises
        ------
        UsageError
            Neither package is installed.
        """
        if "t_host_ns" in (self.rows.dtype.names or ()) and len(self.rows):
            start_ns = int(self.rows["t_host_ns"][0])
            return shown.data_frame(table_of(self.rows, start_ns, self.header.info.utc_offset_ns))
        return shown.data_frame({name: self.table[name] for name in self.table.dtype.names or ()})

    def _summary(self) -> Summary:
        info = self.header.info
        rows = [
            Row("sensor", [f"{info.sensor.model} {info.sensor.serial}, {info.sensor_rate_Hz:.4g} Hz"]),
            Row("arm", [f"{info.arm.model} {info.arm.serial}"]),
            Row("wrench", [f"{self.header.frame}, N and N·m"]),
            Row("calibration", [info.calibration_state or f"{info.calibration.id}, {info.calibration.verdict}"]),
            Row("gaps", [str(self.gaps)] if "seq" in (self.rows.dtype.names or ()) else ["unknown"]),
            Row("events", [str(len(self.events))]),
        ]
        amount = counted(len(self.rows), "sample")
        if "t_host_ns" in (self.rows.dtype.names or ()):
            amount += f" in {self.duration_s:.4g} s"
        return Summary(f"Recording of {amount}", rows, [self.cut] if self.cut else [])

    @property
    def duration_s(self) -> float:
        """Time from the first to the last sample, s."""
        return float(np.ptp(self.rows["t_host_ns"])) * 1e-9 if len(self.rows) else 0.0

    @property
    def gaps(self) -> int:
        """Number of gaps in the samples."""
        return int(np.count_nonzero(np.diff(self.rows["seq"]) != 1))

    def paired(self) -> Paired:
        """Return the raw wrenches with their poses; columns that were not read are 0."""
        return _paired_of(self.rows)

    def pieces(self) -> Iterator[Piece]:
        """Yield the samples in pieces with one frame and stages, each with its header and the events before it."""
        header = self.header
        for rows, events in split_piece(Piece(header, self.rows, self.events, 1.0)):
            for event in events:
                header = next_header(header, event)
            yield Piece(header, rows, events, 1.0)

    def blocks(self) -> Iterator[Measured]:
        """Yield the raw wrenches with their poses in blocks of `PIECE_ROWS` samples."""
        return in_blocks(piece.measured() for piece in self.pieces())


def next_header(header: Header, event: StreamEvent) -> Header:
    """Return the header after an event, which may change frame or stages. Raises `BadRecording` for unknown stages."""
    if event.kind == "frame":
        return replace(header, frame=_frame_from_dict(event.values))
    return replace(header, stages=_stages_of(event.values)) if event.kind == "stages" else header


def split_piece(piece: Piece) -> Iterator[tuple[Rows, Sequence[StreamEvent]]]:
    """Divide samples at changes of frame or stages, and every `PIECE_ROWS`; events come with the samples after them."""
    n = len(piece.rows)
    events = sorted(piece.events, key=lambda event: event.t_host_ns)
    at = places_of(events, piece.rows)
    changes = [row for row, event in zip(at, events, strict=True) if event.kind in ("frame", "stages")]
    ends = sorted({*range(PIECE_ROWS, n, PIECE_ROWS), *changes, n} - {0}) or [0]
    for start, end in pairwise([0, *ends]):
        yield (
            piece.rows[start:end],
            [e for row, e in zip(at, events, strict=True) if start <= row < end or row == end == n],
        )


def read_ahead(items: Iterator[T]) -> Generator[T, None, None]:
    """Yield items while a thread takes the next one; an error of `items` is raised after the items before it."""
    # The new thread only reads; the caller's thread processes and writes, so that errors and Ctrl-C keep their order.
    with ThreadPoolExecutor(1) as reader:
        following = reader.submit(next, items, None)
        while (item := following.result()) is not None:
            following = reader.submit(next, items, None)
            yield item


def in_blocks(parts: Iterable[Measured]) -> Iterator[Measured]:
    """Regroup parts of any size into blocks of `PIECE_ROWS` samples. An error is raised after all earlier rows."""
    waiting, count, events, share, failure = list[Paired](), 0, list[StreamEvent](), 0.0, None
    try:
        for part in parts:
            samples, share = part.samples, part.share
            events += part.events
            while count + len(samples) >= PIECE_ROWS:
                here = PIECE_ROWS - count
                yield Measured(Paired.concatenate([*waiting, samples.rows(slice(here))]), events, share)
                waiting, count, events, samples = [], 0, [], samples.rows(slice(here, None))
            waiting.append(samples)
            count += len(samples)
    except DataError as error:
        failure = error
    if events or count:
        yield Measured(Paired.concatenate(waiting), events, share)
    if failure is not None:
        raise failure
