"""Recordings as Parquet: the fastest to read, for pandas, Polars, DuckDB and MATLAB. Needs the extra `record`.

    PAR1
    record {"header": …}
    record {"rows": n, "pages": […], "events": […]}, then one page for each column; again for each row group
    record {"rows": all}
    footer of Parquet, PAR1

Other programs read the footer. `read_parquet` reads the records in their order, so that a file without its end is
readable up to its last row group. A record has a CRC-32, and names the place and the CRC-32 of each page.

The libraries write a file that cannot be read before its end. The format: https://parquet.apache.org/docs/file-format
"""

import json
import os
import struct
import zlib
from collections.abc import Collection, Generator, Mapping, Sequence
from contextlib import suppress
from itertools import chain
from pathlib import Path
from typing import IO, Any, Final

import numpy as np
from numpy.typing import NDArray

from ftcalib.files import MOST_BYTES, open_file, parsed_json
from ftdrive import __version__
from ftdrive.errors import BadRecording
from ftdrive.live.samples import StreamEvent
from ftdrive.recording.growing_file import GrowingFile
from ftdrive.recording.recording import (
    COLUMNS,
    NUMBERS,
    ROW,
    Header,
    Piece,
    Rows,
    event_of,
    event_text,
    table_of,
)

LEVEL: Final = -5
"""Level of zstd: numbers with noise in their last digits hardly shrink, at any level."""
# A row group is written after so long or so many samples.
_GROUP_NS, _GROUP_ROWS = 10_000_000_000, 1 << 14
_MAGIC, _RECORD = b"PAR1", b"FTDR"
# Types of the compact protocol of Thrift.
_I32, _I64, _TEXT, _LIST, _STRUCT = 5, 6, 8, 9, 12
_BOOLEAN, _INT32, _INT64, _DOUBLE = 0, 1, 2, 5
_KINDS: Final = {"b": _BOOLEAN, "u": _INT32, "i": _INT64, "f": _DOUBLE}
_UNSIGNED, _ZSTD, _PLAIN, _RLE = 13, 6, 0, 3

_Fields = Mapping[int, tuple[int, Any]]


class ParquetFile(GrowingFile):
    """A new recording."""

    def __init__(self, path: Path, header: Header) -> None:
        from zstandard import ZstdCompressor

        super().__init__(path)
        self._compress = ZstdCompressor(LEVEL).compress
        self._header = header
        self.samples = 0
        self._waiting: list[Rows] = []
        self._new: list[StreamEvent] = []
        self._events: list[StreamEvent] = []
        self._start_ns: int | None = None
        self._groups: list[bytes] = []
        self._kinds = {name: _KINDS[column.dtype.kind] for name, column in self._table(np.zeros(0, ROW)).items()}
        self.add(_MAGIC + _record({"header": header.to_dict()}))

    def append(self, rows: Rows, events: Sequence[StreamEvent]) -> None:
        """Keep samples and events; write a row group when there are enough. Raises `OSError`."""
        self._waiting += [rows] if len(rows) else []
        self._new += events
        if not self._waiting:
            return
        span_ns = self._waiting[-1]["t_host_ns"][-1] - self._waiting[0]["t_host_ns"][0]
        if span_ns >= _GROUP_NS or sum(map(len, self._waiting)) >= _GROUP_ROWS:
            self._write_group()

    def complete(self) -> None:
        """Write the footer, and give the file its name. Raises `OSError`."""
        with self:
            self._write_group()
            texts = {
                "header": json.dumps(self._header.to_dict()),
                "events": "[" + ",".join(map(event_text, self._events)) + "]",
            }
            schema = [{4: (_TEXT, b"schema"), 5: (_I32, len(self._kinds))}]
            for name, kind in self._kinds.items():
                unsigned = {6: (_I32, _UNSIGNED)} if kind == _INT32 else {}
                schema.append({1: (_I32, kind), 3: (_I32, 0), 4: (_TEXT, name.encode()), **unsigned})
            pairs = [{1: (_TEXT, key.encode()), 2: (_TEXT, text.encode())} for key, text in texts.items()]
            footer = _struct(
                {
                    1: (_I32, 2),
                    2: (_LIST, (_STRUCT, schema)),
                    3: (_I64, self.samples),
                    4: (_LIST, (_STRUCT, self._groups)),
                    5: (_LIST, (_STRUCT, pairs)),
                    6: (_TEXT, f"ftdrive version {__version__}".encode()),
                }
            )
            end = _record({"rows": self.samples})
            self.add(end + footer + struct.pack("<I", len(footer)) + _MAGIC)
            super().complete()

    def keep(self) -> None:
        """Write the samples that wait, if possible, and close the file."""
        with suppress(OSError, ValueError):
            self._write_group()
        super().keep()

    def _table(self, rows: Rows) -> dict[str, NDArray[Any]]:
        if len(rows) and self._start_ns is None:
            self._start_ns = int(rows["t_host_ns"][0])
        return table_of(rows, self._start_ns or 0, self._header.info.utc_offset_ns)

    def _write_group(self) -> None:
        n = sum(map(len, self._waiting))
        if not n and not self._new:
            return
        heads, bodies, pages, sizes = list[bytes](), list[bytes](), list[list[int]](), list[int]()
        tables = [self._table(rows) for rows in self._waiting or [np.zeros(0, ROW)]]
        for name in self._kinds:
            column = np.concatenate([table[name] for table in tables])
            plain = np.packbits(column, bitorder="little") if column.dtype == bool else column
            # Each row group is readable as soon as it is written, so that a power failure costs only the last one.
            body = self._compress(plain.data)
            crc = zlib.crc32(body)
            numbers = _struct({1: (_I32, n), 2: (_I32, _PLAIN), 3: (_I32, _RLE), 4: (_I32, _RLE)})
            page = [0, plain.nbytes, len(body), crc - (crc >> 31 << 32)]
            head = _struct({**{place: (_I32, number) for place, number in enumerate(page, 1)}, 5: (_STRUCT, numbers)})
            heads.append(head)
            bodies.append(body)
            pages.append([len(head), len(body), crc])
            sizes.append(plain.nbytes)
        events = list(map(event_text, self._new))
        record = _record({"rows": n, "pages": dict(zip(self._kinds, pages, strict=True)), "events": events})
        place = self.add(record, *chain.from_iterable(zip(heads, bodies, strict=True))) + len(record)
        if n:
            self._groups.append(self._group(place, pages, sizes, n))
        self.samples += n
        self._events += self._new
        self._waiting, self._new = [], []

    def _group(self, place: int, pages: Sequence[Sequence[int]], sizes: Sequence[int], rows: int) -> bytes:
        """Describe a row group whose pages begin at a place of the file."""
        columns, total = list[_Fields](), 0
        for (name, kind), (head, body, _), size in zip(self._kinds.items(), pages, sizes, strict=True):
            values = {
                1: (_I32, kind),
                2: (_LIST, (_I32, [_PLAIN])),
                3: (_LIST, (_TEXT, [name.encode()])),
                4: (_I32, _ZSTD),
                5: (_I64, rows),
                6: (_I64, head + size),
                7: (_I64, head + body),
                9: (_I64, place),
            }
            columns.append({2: (_I64, place), 3: (_STRUCT, values)})
            place, total = place + head + body, total + head + size
        return _struct({1: (_LIST, (_STRUCT, columns)), 2: (_I64, total), 3: (_I64, rows)})


def _struct(fields: _Fields) -> bytes:
    """Encode the fields of a structure, by ascending number, in the compact protocol of Thrift."""
    packed, last = b"", 0
    for number, (kind, value) in fields.items():
        packed += bytes([(number - last) << 4 | kind]) + _value(kind, value)
        last = number
    return packed + b"\0"


def _value(kind: int, value: Any) -> bytes:
    if kind in (_I32, _I64):
        return _count(value << 1 ^ value >> 63)
    if kind == _TEXT:
        return _count(len(value)) + bytes(value)
    if kind == _STRUCT:
        return value if isinstance(value, bytes) else _struct(value)
    inner, items = value
    head = bytes([len(items) << 4 | inner]) if len(items) < 15 else bytes([15 << 4 | inner]) + _count(len(items))
    return head + b"".join(_value(inner, item) for item in items)


def _count(number: int) -> bytes:
    packed = bytearray()
    while number > 127:
        packed.append(number & 127 | 128)
        number >>= 7
    return bytes(packed) + bytes([number])


def _record(content: Mapping[str, Any]) -> bytes:
    text = json.dumps(content).encode()
    return _RECORD + struct.pack("<II", len(text), zlib.crc32(text)) + text


def read_parquet(path: Path, columns: Collection[str]) -> Generator[Piece, None, str]:
    """Read a recording in pieces; return why it ends early. Raises `BadRecording` or `OSError`."""
    from zstandard import ZstdError

    kind = np.dtype([(name, ROW[name]) for name in ROW.names or () if name in columns])
    size, count = path.stat().st_size, 0
    with open_file(path) as file:
        if file.read(len(_MAGIC)) != _MAGIC:
            raise BadRecording("the first bytes are not those of Parquet")
        try:
            first = _read_record(file)
            if first is None or "header" not in first:
                raise BadRecording("it has no header of ftdrive: it was cut within it, or another program wrote it")
            header = Header.from_dict(first["header"])
            yield Piece(header, np.zeros(0, kind), [], 0.0)
            while (record := _read_record(file)) is not None:
                if "pages" not in record:
                    if record["rows"] != count:
                        raise BadRecording(f"it has {count} of its {record['rows']} samples: the file is damaged")
                    return ""
                if file.tell() + sum(head + body for head, body, _ in record["pages"].values()) > size:
                    break
                rows = np.empty(record["rows"], kind)
                _read_pages(file, record["pages"], rows)
                count += len(rows)
                yield Piece(header, rows, [event_of(one) for one in record["events"]], file.tell() / size)
        except (KeyError, MemoryError, TypeError, ValueError, ZstdError) as error:
            raise BadRecording(f"a record cannot be read ({type(error).__name__}): the file is damaged") from error
        file.seek(max(size - len(_MAGIC), 0))
        if size > 2 * len(_MAGIC) and file.read() == _MAGIC:
            raise BadRecording("its last record is missing: the file is damaged")
    return "the recording was interrupted"


def _read_pages(file: IO[bytes], pages: Mapping[str, Sequence[int]], rows: Rows) -> None:
    from zstandard import ZstdDecompressor

    decompress = ZstdDecompressor().decompress
    numbers = rows.view([(one, COLUMNS[one]) for name in rows.dtype.names or () for one in NUMBERS[name]])
    for name, (head, length, crc) in pages.items():
        if name not in (numbers.dtype.names or ()):
            file.seek(head + length, os.SEEK_CUR)
            continue
        file.seek(head, os.SEEK_CUR)
        body = file.read(length)
        if zlib.crc32(body) != crc:
            raise BadRecording(f"{name} differs from its checksum: the file is damaged")
        plain, column = decompress(body), COLUMNS[name]
        if column.kind == "b":
            numbers[name] = np.unpackbits(np.frombuffer(plain, np.uint8), count=len(rows), bitorder="little")
        else:
            numbers[name] = np.frombuffer(plain, column, len(rows))


def _read_record(file: IO[bytes]) -> dict[str, Any] | None:
    """Read a record; None if the file ends within it."""
    start = file.read(12)
    if len(start) < 12:
        return None
    length, crc = struct.unpack_from("<II", start, 4)
    is_record = start[:4] == _RECORD and length <= MOST_BYTES
    text = file.read(length) if is_record else b""
    if is_record and len(text) < length:
        return None
    if not is_record or zlib.crc32(text) != crc:
        raise BadRecording("a record differs from its checksum: the file is damaged")
    return dict(parsed_json(text))
