"""Recordings as tables with the columns of `table_of`; header and events are JSON.

CSV, for any program:

    # ftdrive.recording/1: description of the columns
    # header {...}
    t_s,t_utc_s,t_host_ns,...
    # crc32 1a2b3c4d       of everything before this line
    ...
    # event {...}          at its time
    # crc32 5e6f7a8b
    # end

A reader that skips lines with `#`, such as `pandas.read_csv(path, comment="#")`, reads a plain table. A file whose
checksum does not match is rejected. In a file without its end, samples are valid up to the last checksum; there is one
at least every second.

Parquet, for pandas, Polars, DuckDB and MATLAB, is fastest to read. It needs the extra `record`. The footer has
`header` and `events`, and their CRC-32. Each page has a CRC-32 too.
"""

import csv
import io
import json
import zlib
from collections.abc import Collection, Generator, Iterator, Mapping, Sequence
from io import BufferedReader
from itertools import chain, pairwise
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from ftcalib.files import MOST_BYTES, open_file, parsed_json, read_lines
from ftdrive.errors import BadRecording
from ftdrive.recording.growing_file import GrowingFile
from ftdrive.recording.recording import (
    COLUMNS,
    FORMAT,
    PIECE_ROWS,
    ROW,
    ZSTD_LEVEL,
    Header,
    Piece,
    Rows,
    event_of,
    event_text,
    flat_layout,
    places_of,
    table_of,
)
from ftdrive.stream.samples import StreamEvent

FIRST_BYTES = f"# {FORMAT.partition('/')[0]}/".encode()
"""First bytes of a CSV recording of any version."""
_HEADER, _EVENT, _CRC, _END = "# header ", "# event ", "# crc32 ", "# end"
_GROUP_ROWS: Final = 1 << 14
_PARQUET_END: Final = b"PAR1"


class _TableFile(GrowingFile):
    def __init__(self, path: Path, header: Header) -> None:
        super().__init__(path)
        self.samples = 0
        self._header = header
        self._start_ns: int | None = None

    def _columns(self, rows: Rows) -> dict[str, NDArray[Any]]:
        self._start_ns = int(rows["t_host_ns"][0]) if self._start_ns is None else self._start_ns
        return table_of(rows, self._start_ns, self._header.info.utc_offset_ns)


class CsvFile(_TableFile):
    """A new recording in the CSV format."""

    def __init__(self, path: Path, header: Header) -> None:
        super().__init__(path, header)
        self._crc = 0
        names = ",".join(table_of(np.zeros(0, ROW), 0, 0))
        self._add(f"# {FORMAT}: {header.words}\n{_HEADER}{json.dumps(header.to_dict())}\n{names}\n")

    def append(self, rows: Rows, events: Sequence[StreamEvent]) -> None:
        """Write samples, and each event between the samples around it. Raises `OSError` if that fails."""
        text = io.StringIO()
        table = csv.writer(text, lineterminator="\n")
        lines = list(self._lines(rows)) if len(rows) else []
        places = [0, *places_of(events, rows)]
        for (start, stop), event in zip(pairwise(places), events, strict=True):
            table.writerows(lines[start:stop])
            text.write(f"{_EVENT}{event_text(event)}\n")
        table.writerows(lines[places[-1] :])
        self._add(text.getvalue())
        self.samples += len(rows)

    def _lines(self, rows: Rows) -> Iterator[tuple[float, ...]]:
        columns = self._columns(rows).values()
        whole = [column.astype(np.uint8) if column.dtype == bool else column for column in columns]
        return zip(*(column.tolist() for column in whole), strict=True)

    def _add(self, text: str) -> None:
        content = text.encode()
        crc = zlib.crc32(content, self._crc)
        line = _crc_line(crc)
        self.add(content + line)
        self._crc = zlib.crc32(line, crc)

    def _write_end(self) -> None:
        self.add(f"{_END}\n".encode())


def read_csv(path: Path, columns: Collection[str]) -> Generator[Piece, None, str]:
    """Read a CSV recording in pieces; return why it ends early, or "". Damage raises `BadRecording`."""
    size = path.stat().st_size
    with open_file(path) as file:
        if not file.readline(100).startswith(FIRST_BYTES):
            raise BadRecording(f"the first line is not '# {FORMAT}'")
        file.seek(0)
        parts = _checked_lines(file)
        first = next(parts, [])
        if len(first) < 3 or not first[1].startswith(_HEADER):
            raise BadRecording("the header is missing: the file was cut within its first lines")
        header = Header.from_dict(_parse_document(first[1].removeprefix(_HEADER)))
        names = first[2].rstrip("\n").split(",")
        if missing := [name for name in COLUMNS.names or () if name not in names]:
            raise BadRecording(f"the column {missing[0]} is missing")
        kind = np.dtype([(name, ROW[name]) for name in ROW.names or () if name in columns])
        numbers = flat_layout(kind)
        order = [names.index(name) for name in numbers.names or ()]
        lines, events, ended, failure = list[str](), list[StreamEvent](), False, None

        def piece() -> Piece:
            rows = np.zeros(0, numbers)
            if lines:
                rows = np.loadtxt(lines, numbers, delimiter=",", usecols=order, ndmin=1, comments=None)
            return Piece(header, rows.view(kind), events, file.tell() / size)

        yield Piece(header, np.zeros(0, kind), [], 0.0)
        try:
            try:
                for part in chain([first[3:]], parts):
                    events += [event_of(line.removeprefix(_EVENT)) for line in part if line.startswith(_EVENT)]
                    lines += [line for line in part if not line.startswith((_EVENT, _END))]
                    ended = part[-1:] == [f"{_END}\n"]
                    if len(lines) >= PIECE_ROWS:
                        yield piece()
                        lines, events = [], []
            except BadRecording as error:  # yield the lines before the damage first
                failure = error
            yield piece()
        except ValueError as error:
            raise BadRecording(f"a line cannot be read ({error}): the file is damaged") from error
        if failure is not None:
            raise failure
        return "" if ended else "the last line is not '# end'"


def _checked_lines(file: BufferedReader) -> Iterator[list[str]]:
    """Yield the lines before each checksum, and the last line `# end`. A wrong checksum raises `BadRecording`."""
    crc, waiting, begin = 0, list[str](), 0
    for number, line in enumerate(read_lines(file, BadRecording), 1):
        if file.tell() - begin > MOST_BYTES:
            raise BadRecording(f"no checksum follows line {number - len(waiting)}: the file is damaged")
        if not line.endswith(b"\n"):
            break
        if line.startswith(_CRC.encode()):
            if line != _crc_line(crc):
                raise BadRecording(f"line {number} is not the checksum of the lines before it: the file is damaged")
            yield waiting
            waiting, begin = [], file.tell()
        else:
            waiting.append(line.decode(errors="replace"))
        crc = zlib.crc32(line, crc)
    if waiting[:1] == [f"{_END}\n"]:
        yield waiting[:1]
    elif f"{_END}\n" in waiting:
        raise BadRecording("its last samples have no checksum: the file is damaged")


def _crc_line(crc: int) -> bytes:
    return f"{_CRC}{crc:08x}\n".encode()


def _parse_document(text: str) -> dict[str, object]:
    try:
        return dict(parsed_json(text))
    except (TypeError, ValueError) as error:
        raise BadRecording(f"the header is not a JSON object ({error}): the file is damaged") from error


class ParquetFile(_TableFile):
    """A new recording in the Parquet format. The file is unreadable until complete, so `samples` stays 0."""

    grows = False
    closed = False
    """Attribute that pyarrow expects a file to have."""

    def __init__(self, path: Path, header: Header) -> None:
        from pyarrow import PythonFile, parquet

        super().__init__(path, header)
        self._waiting: list[Rows] = []
        self._events: list[str] = []
        self._writer = parquet.ParquetWriter(
            PythonFile(self, "w"),
            _arrow_schema(),
            compression="zstd",
            compression_level=ZSTD_LEVEL,
            use_dictionary=False,
            write_statistics=False,
            write_page_checksum=True,
            store_schema=False,
        )

    def write(self, content: bytes) -> None:
        """Append bytes for pyarrow, which uses this object as its file. Raises `OSError` if that fails."""
        if not self._file.closed:  # pyarrow writes the end of the file even after `discard`
            self.add(content)

    def append(self, rows: Rows, events: Sequence[StreamEvent]) -> None:
        """Buffer samples and events; write enough samples as a row group. Raises `OSError` if writing fails."""
        self._waiting += [rows] if len(rows) else []
        self._events += map(event_text, events)
        if sum(map(len, self._waiting)) >= _GROUP_ROWS:
            self._write_group()

    def _write_end(self) -> None:
        if self._waiting:
            self._write_group()
        texts = {"header": json.dumps(self._header.to_dict()), "events": f"[{','.join(self._events)}]"}
        crc = _text_crc({name.encode(): text.encode() for name, text in texts.items()})
        self._writer.add_key_value_metadata({**texts, "crc32": crc})
        self._writer.close()

    def _write_group(self) -> None:
        from pyarrow import Array, py_buffer, table

        rows, self._waiting = np.concatenate(self._waiting), []
        arrays, columns = [], self._columns(rows)
        for field in _arrow_schema():
            column = columns[field.name]
            plain = np.packbits(column, bitorder="little") if column.dtype == bool else np.ascontiguousarray(column)
            # Converting a numpy array directly would make pyarrow import pandas, which takes a second.
            arrays.append(Array.from_buffers(field.type, len(rows), [None, py_buffer(plain)]))
        self._writer.write_table(table(arrays, schema=_arrow_schema()))


def _arrow_schema() -> Any:
    import pyarrow as pa

    columns = table_of(np.zeros(0, ROW), 0, 0)
    fields = [pa.field(name, pa.from_numpy_dtype(column.dtype), nullable=False) for name, column in columns.items()]
    return pa.schema(fields)


def _text_crc(texts: Mapping[bytes, bytes]) -> str:
    return f"{zlib.crc32(texts[b'header'] + texts[b'events']):08x}"


def read_parquet(path: Path, columns: Collection[str]) -> Generator[Piece, None, str]:
    """Read a Parquet recording in pieces; return "", because a truncated file raises `BadRecording`, as damage does."""
    from pyarrow import ArrowException, parquet

    with open_file(path) as raw:
        raw.seek(max(0, path.stat().st_size - len(_PARQUET_END)))
        if raw.read() != _PARQUET_END:
            raise BadRecording(
                "its end is missing, without which Parquet cannot be read. If `convert` or `compensate` was "
                "interrupted, repeat it. If `record` of an older ftdrive was interrupted, convert it with that version"
            )
    try:
        # With a buffer size, pyarrow does not read the columns of a large row group all at once.
        with parquet.ParquetFile(path, page_checksum_verification=True, buffer_size=1 << 20) as file:
            texts, total = file.metadata.metadata or {}, file.metadata.num_rows
            if not {b"header", b"events"} <= texts.keys():
                raise BadRecording("it has no header of ftdrive: another program wrote it")
            # Parquet files from earlier versions of ftdrive have no checksum of the header.
            if texts.get(b"crc32", b"").decode() not in ("", _text_crc(texts)):
                raise BadRecording("its header differs from its checksum: the file is damaged")
            if not file.schema_arrow.remove_metadata().equals(_arrow_schema()):
                raise BadRecording("its columns are not those of a recording: the file is damaged")
            header = Header.from_dict(parsed_json(texts[b"header"]))
            events = [event_of(json.dumps(one)) for one in parsed_json(texts[b"events"])]
            kind = np.dtype([(name, ROW[name]) for name in ROW.names or () if name in columns])
            numbers = flat_layout(kind)
            yield Piece(header, np.zeros(0, kind), [], 0.0)
            names, count = {*(numbers.names or ()), "t_host_ns"}, 0
            for number in range(file.num_row_groups):  # one reader for all row groups would keep their data in memory
                group = file.metadata.row_group(number)
                if len({group.column(i).compression for i in range(group.num_columns)}) > 1:
                    raise BadRecording("its footer is inconsistent: the file is damaged")  # it has no checksum
                for batch in file.iter_batches(2 * _GROUP_ROWS, [number], sorted(names), use_threads=False):
                    rows = np.empty(len(batch), numbers)
                    for name in numbers.names or ():
                        column = batch[name].cast("uint8") if COLUMNS[name].kind == "b" else batch[name]
                        rows[name] = np.from_dlpack(column)  # so that pyarrow does not import pandas
                    times = np.from_dlpack(batch["t_host_ns"]).view([("t_host_ns", "<i8")])
                    here = sum(place < len(times) for place in places_of(events, times))
                    count += len(rows)
                    yield Piece(header, rows.view(kind), events[:here], count / total)
                    events = events[here:]
            if count != total:
                raise BadRecording(f"it has {count} of its {total} samples: the file is damaged")
            yield Piece(header, np.zeros(0, kind), events, 1.0)
    except (ArrowException, MemoryError, OSError, TypeError, ValueError) as error:
        if getattr(error, "errno", None) is not None:  # a disk error, because pyarrow's own errors have no errno
            raise
        why = next(iter(str(error).splitlines()), type(error).__name__)
        raise BadRecording(f"it cannot be read ({why}): the file is damaged") from error
    return ""
