"""Recordings as Parquet: the fastest to read, for pandas, Polars, DuckDB and MATLAB. Needs the extra `record`.

The columns are those of `table_of`. The footer has `header` and `events` as JSON, and the CRC-32 of these two. Each
page has a CRC-32 too.
"""

import json
import zlib
from collections.abc import Collection, Generator, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np

from ftcalib.files import open_file, parsed_json
from ftdrive.errors import BadRecording
from ftdrive.live.samples import StreamEvent
from ftdrive.recording.growing_file import GrowingFile
from ftdrive.recording.recording import (
    COLUMNS,
    NUMBERS,
    ROW,
    ZSTD_LEVEL,
    Header,
    Piece,
    Rows,
    event_of,
    event_text,
    places_of,
    table_of,
)

_GROUP_ROWS: Final = 1 << 14
_END: Final = b"PAR1"


class ParquetFile(GrowingFile):
    """A new recording. Nothing of it can be read before it is complete."""

    samples = 0
    closed = False
    """For pyarrow, which writes to it as to a file."""

    def __init__(self, path: Path, header: Header) -> None:
        from pyarrow import PythonFile, parquet

        super().__init__(path)
        self._header = header
        self._waiting: list[Rows] = []
        self._events: list[str] = []
        self._start_ns: int | None = None
        self._writer = parquet.ParquetWriter(
            PythonFile(self, "w"),
            _schema(),
            compression="zstd",
            compression_level=ZSTD_LEVEL,
            use_dictionary=False,
            write_statistics=False,
            write_page_checksum=True,
            store_schema=False,
        )

    def write(self, content: bytes) -> None:
        """Append what pyarrow has encoded. Raises `OSError`."""
        if not self._file.closed:  # pyarrow ends each file, also one that was given up
            self.add(content)

    def append(self, rows: Rows, events: Sequence[StreamEvent]) -> None:
        """Keep samples and events; write a row group when there are enough. Raises `OSError`."""
        self._waiting += [rows] if len(rows) else []
        self._events += map(event_text, events)
        if sum(map(len, self._waiting)) >= _GROUP_ROWS:
            self._write_group()

    def complete(self) -> None:
        """Write the footer, and give the file its name. Raises `OSError`."""
        with self:
            if self._waiting:
                self._write_group()
            texts = {"header": json.dumps(self._header.to_dict()), "events": f"[{','.join(self._events)}]"}
            crc = _crc({name.encode(): text.encode() for name, text in texts.items()})
            self._writer.add_key_value_metadata({**texts, "crc32": crc})
            self._writer.close()
            super().complete()

    def _write_group(self) -> None:
        from pyarrow import Array, py_buffer, table

        rows, self._waiting = np.concatenate(self._waiting), []
        self._start_ns = int(rows["t_host_ns"][0]) if self._start_ns is None else self._start_ns
        arrays, columns = [], table_of(rows, self._start_ns, self._header.info.utc_offset_ns)
        for field in _schema():
            column = columns[field.name]
            plain = np.packbits(column, bitorder="little") if column.dtype == bool else np.ascontiguousarray(column)
            # To take an array of numpy, pyarrow would import pandas, for a second.
            arrays.append(Array.from_buffers(field.type, len(rows), [None, py_buffer(plain)]))
        self._writer.write_table(table(arrays, schema=_schema()))


def _schema() -> Any:
    import pyarrow as pa

    columns = table_of(np.zeros(0, ROW), 0, 0)
    fields = [pa.field(name, pa.from_numpy_dtype(column.dtype), nullable=False) for name, column in columns.items()]
    return pa.schema(fields)


def _crc(texts: Mapping[bytes, bytes]) -> str:
    return f"{zlib.crc32(texts[b'header'] + texts[b'events']):08x}"


def read_parquet(path: Path, columns: Collection[str]) -> Generator[Piece, None, str]:
    """Read a recording in pieces; return why it ends early: never. Raises `BadRecording` or `OSError`."""
    from pyarrow import ArrowException, parquet

    with open_file(path) as raw:
        raw.seek(max(0, path.stat().st_size - len(_END)))
        if raw.read() != _END:
            raise BadRecording(
                "its end is missing, without which Parquet cannot be read. If `convert` or `compensate` was "
                "interrupted, repeat it. If `record` of an earlier ftdrive was, convert the file with that version"
            )
    try:
        # With a buffer, a column of a large row group is not read at once.
        with parquet.ParquetFile(path, page_checksum_verification=True, buffer_size=1 << 20) as file:
            texts, total = file.metadata.metadata or {}, file.metadata.num_rows
            if not {b"header", b"events"} <= texts.keys():
                raise BadRecording("it has no header of ftdrive: another program wrote it")
            # Files of earlier versions have no checksum here.
            if texts.get(b"crc32", b"").decode() not in ("", _crc(texts)):
                raise BadRecording("its header differs from its checksum: the file is damaged")
            if not file.schema_arrow.remove_metadata().equals(_schema()):
                raise BadRecording("its columns are not those of a recording: the file is damaged")
            header = Header.from_dict(parsed_json(texts[b"header"]))
            events = [event_of(json.dumps(one)) for one in parsed_json(texts[b"events"])]
            kind = np.dtype([(name, ROW[name]) for name in ROW.names or () if name in columns])
            numbers = np.dtype([(one, COLUMNS[one]) for name in kind.names or () for one in NUMBERS[name]])
            yield Piece(header, np.zeros(0, kind), [], 0.0)
            names, count = {*(numbers.names or ()), "t_host_ns"}, 0
            for number in range(file.num_row_groups):  # one by one, because a reader of all keeps what it has read
                group = file.metadata.row_group(number)
                if len({group.column(i).compression for i in range(group.num_columns)}) > 1:
                    raise BadRecording("its footer contradicts itself: the file is damaged")  # it has no checksum
                for batch in file.iter_batches(2 * _GROUP_ROWS, [number], sorted(names), use_threads=False):
                    rows = np.empty(len(batch), numbers)
                    for name in numbers.names or ():
                        column = batch[name].cast("uint8") if COLUMNS[name].kind == "b" else batch[name]
                        rows[name] = np.from_dlpack(column)  # without pandas, as above
                    times = np.from_dlpack(batch["t_host_ns"]).view([("t_host_ns", "<i8")])
                    here = sum(place < len(times) for place in places_of(events, times))
                    count += len(rows)
                    yield Piece(header, rows.view(kind), events[:here], count / total)
                    events = events[here:]
            if count != total:
                raise BadRecording(f"it has {count} of its {total} samples: the file is damaged")
            yield Piece(header, np.zeros(0, kind), events, 1.0)
    except (ArrowException, MemoryError, OSError, TypeError, ValueError) as error:
        if getattr(error, "errno", None) is not None:  # of the disk; those of pyarrow have none
            raise
        why = next(iter(str(error).splitlines()), type(error).__name__)
        raise BadRecording(f"it cannot be read ({why}): the file is damaged") from error
    return ""
