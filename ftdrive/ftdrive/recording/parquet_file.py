"""Recordings as Parquet: the fastest to read, for pandas, Polars, DuckDB and MATLAB. Needs the extra `record`.

A Parquet file can only be read when it is complete. Until then a recording is a folder `name.parquet.partial` of
complete files of some seconds each, which these programs and `read_recording` read as one table.
"""

import json
import shutil
from collections.abc import Collection, Sequence
from itertools import count
from pathlib import Path
from typing import Any

import numpy as np

from ftdrive.errors import BadRecording
from ftdrive.live.samples import StreamEvent
from ftdrive.recording.growing_file import partial_of, publish
from ftdrive.recording.recording import COLUMNS, NUMBERS, ROW, Header, Recording, Rows, event_of, event_text

_PART_NS = 10_000_000_000


class ParquetFile:
    """A new recording."""

    def __init__(self, path: Path, header: Header) -> None:
        import duckdb

        self._path, self._header = path, header
        self._database = duckdb.connect()
        self._folder = partial_of(path)
        self._folder.mkdir()
        self._names = (self._folder / f"{number:06d}.parquet" for number in count(1))
        self._waiting: list[Rows] = []
        self._events: list[StreamEvent] = []
        self._start_ns: int | None = None

    def append(self, rows: Rows, events: Sequence[StreamEvent]) -> None:
        """Keep samples and events; write a part when there are enough. Raises `OSError`."""
        self._waiting += [rows] if len(rows) else []
        self._events += events
        if len(rows) and rows["t_host_ns"][-1] - self._waiting[0]["t_host_ns"][0] >= _PART_NS:
            self._write_part()

    def complete(self) -> None:
        """Join the parts. Raises `OSError`; the parts remain then, and can be read."""
        try:
            self._write_part()
            self._copy("read_parquet($parts)", self._folder / "whole", {"parts": f"{self._folder}/*.parquet"})
            publish(self._folder / "whole", self._path)
            shutil.rmtree(self._folder)
        finally:
            self._database.close()

    def discard(self) -> None:
        """Delete what was written."""
        self._database.close()
        shutil.rmtree(self._folder, ignore_errors=True)

    def _write_part(self) -> None:
        rows, self._waiting = np.concatenate([np.zeros(0, ROW), *self._waiting]), []
        if len(rows):
            self._start_ns = int(rows["t_host_ns"][0]) if self._start_ns is None else self._start_ns
            table = {"t_s": (rows["t_host_ns"] - self._start_ns) * 1e-9}
            table |= {name: rows.view(COLUMNS)[name] for name in COLUMNS.names or ()}
            self._database.register("rows", table)
            self._copy("rows", next(self._names), {})
            self._database.unregister("rows")

    def _copy(self, source: str, path: Path, values: dict[str, Any]) -> None:
        import duckdb

        header = json.dumps(self._header.to_dict())
        events = "[" + ",".join(map(event_text, self._events)) + "]"
        metadata = f"KV_METADATA {{header: {_quoted(header)}, events: {_quoted(events)}}}"
        try:
            self._database.execute(
                f"COPY (SELECT * FROM {source}) TO {_quoted(str(path))} (FORMAT parquet, {metadata})",
                values,
            )
        except duckdb.Error as error:
            path.unlink(missing_ok=True)
            raise OSError(f"{path} cannot be written ({error}): make room there; the parts are kept") from error


def read_parquet(path: Path, columns: Collection[str]) -> Recording:
    """Read a recording, or the folder of one that was interrupted. Raises `BadRecording` or `OSError`."""
    import duckdb

    parts = sorted(map(str, path.glob("*.parquet"))) if path.is_dir() else [str(path)]
    if not parts:
        raise BadRecording("the folder contains no complete part")
    groups = [name for name in ROW.names or () if name in columns]
    names = [one for name in groups for one in NUMBERS[name]]
    with duckdb.connect() as database:
        try:
            pairs = database.execute("SELECT key, value FROM parquet_kv_metadata($1)", [parts[-1]]).fetchall()
            metadata = {bytes(key).decode(): bytes(value).decode() for key, value in pairs}
            if "header" not in metadata:
                raise BadRecording("the file has no header of ftdrive")
            header = Header.from_dict(json.loads(metadata["header"]))
            events = [event_of(json.dumps(one)) for one in json.loads(metadata["events"])]
            found = database.execute(f"SELECT {', '.join(names)} FROM read_parquet($1)", [parts]).fetchnumpy()
        except (duckdb.Error, KeyError, ValueError) as error:
            what = type(error).__name__  # its text may name a temporary folder
            raise BadRecording(f"the file is damaged or was cut, and cannot be read then ({what})") from error
    rows = np.empty(len(found[names[0]]), [(name, COLUMNS[name]) for name in names])
    for name in names:
        rows[name] = np.ma.filled(found[name], np.nan) if np.ma.isMaskedArray(found[name]) else found[name]
    grouped = rows.view([(name, ROW[name]) for name in groups])
    return Recording(header, grouped, events, "the recording was interrupted" if path.is_dir() else "")


def _quoted(text: str) -> str:
    return "'" + text.replace("'", "''") + "'"
