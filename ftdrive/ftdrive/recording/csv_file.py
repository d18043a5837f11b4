"""Recordings as CSV: a text table that everything reads.

    # ftdrive.recording/1: what the columns hold
    # header {...}
    t_s,t_utc_s,t_host_ns,...
    # crc32 1a2b3c4d       of everything before this line
    ...
    # event {...}          where it happened
    # crc32 5e6f7a8b
    # end

A reader that skips lines with `#`, such as `pandas.read_csv(path, comment="#")`, finds a plain table.

A file whose checksum does not fit is refused. Of a file without its end, samples count up to the last checksum, which
follows at least every second.
"""

import csv
import io
import json
import zlib
from collections.abc import Collection, Generator, Iterator, Sequence
from io import BufferedReader
from itertools import chain, pairwise
from pathlib import Path

import numpy as np

from ftcalib.files import MOST_BYTES, open_file, parsed_json, read_lines
from ftdrive.errors import BadRecording
from ftdrive.live.samples import StreamEvent
from ftdrive.recording.growing_file import GrowingFile
from ftdrive.recording.recording import (
    COLUMNS,
    FORMAT,
    NUMBERS,
    PIECE_ROWS,
    ROW,
    Header,
    Piece,
    Rows,
    event_of,
    event_text,
    places_of,
    table_of,
)

_HEADER, _EVENT, _CRC, _END = "# header ", "# event ", "# crc32 ", "# end"


class CsvFile(GrowingFile):
    """A new recording."""

    def __init__(self, path: Path, header: Header) -> None:
        super().__init__(path)
        self.samples = 0
        self._crc = 0
        self._start_ns: int | None = None
        self._utc_offset_ns = header.info.utc_offset_ns
        names = ",".join(table_of(np.zeros(0, ROW), 0, 0))
        self._add(f"# {FORMAT}: {header.words}\n{_HEADER}{json.dumps(header.to_dict())}\n{names}\n")

    def append(self, rows: Rows, events: Sequence[StreamEvent]) -> None:
        """Write samples, and each event where it happened. Raises `OSError`."""
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
        self._start_ns = int(rows["t_host_ns"][0]) if self._start_ns is None else self._start_ns
        columns = table_of(rows, self._start_ns, self._utc_offset_ns).values()
        whole = [column.astype(np.uint8) if column.dtype == bool else column for column in columns]
        return zip(*(column.tolist() for column in whole), strict=True)

    def _add(self, text: str) -> None:
        content = text.encode()
        crc = zlib.crc32(content, self._crc)
        line = _crc_line(crc)
        self.add(content + line)
        self._crc = zlib.crc32(line, crc)

    def complete(self) -> None:
        """Write the end and give the file its name. Raises `OSError`."""
        with self:
            self.add(f"{_END}\n".encode())
            super().complete()


def read_csv(path: Path, columns: Collection[str]) -> Generator[Piece, None, str]:
    """Read a recording in pieces; return why it ends early. Raises `BadRecording` or `OSError`."""
    size = path.stat().st_size
    with open_file(path) as file:
        if not file.readline(100).startswith(f"# {FORMAT.partition('/')[0]}/".encode()):
            raise BadRecording(f"the first line is not '# {FORMAT}'")
        file.seek(0)
        parts = _checked(file)
        first = next(parts, [])
        if len(first) < 3 or not first[1].startswith(_HEADER):
            raise BadRecording("the header is missing: the file was cut within its first lines")
        header = Header.from_dict(_parsed(first[1].removeprefix(_HEADER)))
        names = first[2].rstrip("\n").split(",")
        if missing := [name for name in COLUMNS.names or () if name not in names]:
            raise BadRecording(f"the column {missing[0]} is missing")
        wanted = [name for name in ROW.names or () if name in columns]
        numbers = np.dtype([(one, COLUMNS[one]) for name in wanted for one in NUMBERS[name]])
        order = [names.index(name) for name in numbers.names or ()]
        kind = np.dtype([(name, ROW[name]) for name in wanted])
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
            except BadRecording as error:  # what was checked before counts
                failure = error
            yield piece()
        except ValueError as error:
            raise BadRecording(f"a line cannot be read ({error}): the file is damaged") from error
        if failure is not None:
            raise failure
        return "" if ended else "the last line is not '# end'"


def _checked(file: BufferedReader) -> Iterator[list[str]]:
    """Give the lines of each checksum that fits them, and the end."""
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


def _parsed(text: str) -> dict[str, object]:
    try:
        return dict(parsed_json(text))
    except (TypeError, ValueError) as error:
        raise BadRecording(f"the header is not a JSON object ({error}): the file is damaged") from error
