"""Recordings as Parquet: the fastest to read, for pandas, Polars, DuckDB and MATLAB. Needs the extra `record`.

A Parquet file can only be read when it is complete. Until then a recording is a folder `name.parquet.partial` of
complete files of some seconds each, which these programs and `read_recording` read as one table.

The library writes no checksums of pages, so the metadata have a CRC-32 of each column, of the header and of the events.
"""

import json
import os
import re
import shutil
import zlib
from collections.abc import Collection, Mapping, Sequence
from contextlib import closing, suppress
from errno import EIO
from itertools import count
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ftdrive.errors import BadRecording
from ftdrive.live.samples import StreamEvent
from ftdrive.recording.growing_file import partial_of, publish
from ftdrive.recording.recording import COLUMNS, NUMBERS, ROW, Header, Recording, Rows, event_of, event_text, table_of

_PART_NS = 10_000_000_000


class ParquetFile:
    """A new recording."""

    def __init__(self, path: Path, header: Header) -> None:
        import duckdb

        self._path, self._header = path, header
        self._database = duckdb.connect()
        self.partial = partial_of(path)
        self.partial.mkdir()
        self.samples = 0
        self._names = (self.partial / f"{number:06d}.parquet" for number in count(1))
        self._waiting: list[Rows] = []
        self._events: list[StreamEvent] = []
        self._start_ns: int | None = None
        self._crcs: dict[str, int] = {}

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
            parts = {"parts": f"{self.partial}/*.parquet"}
            self._copy("read_parquet($parts)", self.partial / "whole", parts, self._crcs)
            publish(self.partial / "whole", self._path)
            shutil.rmtree(self.partial)
        finally:
            self._database.close()

    def keep(self) -> None:
        """Write the samples that wait, if possible."""
        with suppress(OSError), closing(self._database):
            self._write_part()

    def discard(self) -> None:
        """Delete what was written."""
        self._database.close()
        shutil.rmtree(self.partial, ignore_errors=True)

    def _write_part(self) -> None:
        rows = np.concatenate([np.zeros(0, ROW), *self._waiting])
        if len(rows):
            self._start_ns = int(rows["t_host_ns"][0]) if self._start_ns is None else self._start_ns
            table = table_of(rows, self._start_ns, self._header.info.utc_offset_ns)
            self._database.register("rows", table)
            self._copy("rows", next(self._names), {}, _crcs(table, {}))
            self._database.unregister("rows")
            self._waiting = []
            self.samples += len(rows)
            self._crcs = _crcs(table, self._crcs)

    def _copy(self, source: str, path: Path, values: dict[str, Any], crcs: Mapping[str, int]) -> None:
        import duckdb

        texts = {
            "header": json.dumps(self._header.to_dict()),
            "events": "[" + ",".join(map(event_text, self._events)) + "]",
        }
        texts["crc32"] = json.dumps({**crcs, **{name: zlib.crc32(text.encode()) for name, text in texts.items()}})
        metadata = f"KV_METADATA {{{', '.join(f'{name}: {_quoted(text)}' for name, text in texts.items())}}}"
        try:
            self._database.execute(
                f"COPY (SELECT * FROM {source}) TO {_quoted(str(path))} (FORMAT parquet, {metadata})",
                values,
            )
        except duckdb.Error as error:
            path.unlink(missing_ok=True)
            number = re.search(r'"errno":"(\d+)"', error.args[0])  # DuckDB has it only in the JSON of its text
            code = int(number[1]) if number else EIO
            raise OSError(code, os.strerror(code) if number else str(error)) from error


def read_parquet(path: Path, columns: Collection[str]) -> Recording:
    """Read a recording, or the folder of one that was interrupted. Raises `BadRecording` or `OSError`."""
    parts = sorted(path.glob("*.parquet")) if path.is_dir() else [path]
    if not parts:
        raise BadRecording("the folder contains no complete part")
    groups = [name for name in ROW.names or () if name in columns]
    found = [_read_part(part, groups) for part in parts]
    header, events, _ = found[-1]
    rows = np.concatenate([rows for *_, rows in found])
    return Recording(header, rows, events, "the recording was interrupted" if path.is_dir() else "")


def _read_part(path: Path, groups: Sequence[str]) -> tuple[Header, list[StreamEvent], Rows]:
    """Read some fields of `Recording.rows` from a file; raises `BadRecording`."""
    import duckdb

    names = [one for name in groups for one in NUMBERS[name]]
    with duckdb.connect() as database:
        try:
            pairs = database.execute("SELECT key, value FROM parquet_kv_metadata($1)", [str(path)]).fetchall()
            metadata = {bytes(key).decode(): bytes(value).decode() for key, value in pairs}
            if "header" not in metadata:
                raise BadRecording("the file has no header of ftdrive")
            found = database.execute(f"SELECT {', '.join(names)} FROM read_parquet($1)", [str(path)]).fetchnumpy()
            rows = np.empty(len(found[names[0]]), [(name, COLUMNS[name]) for name in names])
            for name in names:
                rows[name] = np.ma.filled(found[name], np.nan) if np.ma.isMaskedArray(found[name]) else found[name]
            _require(json.loads(metadata["crc32"]), metadata, rows)
            header = Header.from_dict(json.loads(metadata["header"]))
            events = [event_of(json.dumps(one)) for one in json.loads(metadata["events"])]
        except (duckdb.Error, KeyError, TypeError, ValueError) as error:
            what = type(error).__name__  # its text may name a temporary folder
            raise BadRecording(f"the file is damaged or was cut, and cannot be read then ({what})") from error
    return header, events, rows.view([(name, ROW[name]) for name in groups])


def _require(crcs: Mapping[str, int], metadata: Mapping[str, str], rows: Rows) -> None:
    """Raise `BadRecording` if columns, header or events differ from their CRC-32."""
    found = _crcs({name: rows[name] for name in rows.dtype.names or ()}, {})
    found |= {name: zlib.crc32(metadata[name].encode()) for name in ("header", "events")}
    if wrong := [name for name, crc in found.items() if crcs[name] != crc]:
        raise BadRecording(f"{wrong[0]} differs from its checksum: the file is damaged")


def _crcs(table: Mapping[str, NDArray[Any]], before: Mapping[str, int]) -> dict[str, int]:
    """Return the CRC-32 of each column, continued from that of the rows before."""
    return {name: zlib.crc32(column.tobytes(), before.get(name, 0)) for name, column in table.items()}


def _quoted(text: str) -> str:
    return "'" + text.replace("'", "''") + "'"
