"""Text tables as other programs write them: how one is written is found from its first lines."""

import csv
import gzip
import io
import re
import zlib
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, BinaryIO, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ftcalib.errors import BadDataset
from ftcalib.files import open_file
from ftcalib.model import Array

_READ_BYTES, _HEAD_BYTES = 1 << 22, 1 << 16
_SEPARATORS: Final = {";": "semicolons", "\t": "tabs", ",": "commas", " ": "spaces"}
_COMMENT = re.compile(r"\s*(#+|%+|//)\s*")
_NUMBER: Final = {
    ".": re.compile(r"[+-]?(\d+(\.\d*)?|\.\d+)(e[+-]?\d+)?|[+-]?(nan|inf)", re.IGNORECASE),
    ",": re.compile(r"[+-]?(\d+(,\d*)?|,\d+)(e[+-]?\d+)?|[+-]?(nan|inf)", re.IGNORECASE),
}
# Rows at the end of the first lines decide on separator and decimal sign.
_DECIDE = 30
_DATE = re.compile(r"\d{4}-\d\d-\d\d[T ]\d\d:\d\d(:\d\d([.,]\d+)?)?\s*(Z|[+-]\d\d:?\d\d)?")
_UNIT = re.compile(r"[\[(]?\s*[-%°a-zA-Zµμ·*./^²0-9 ]{0,8}\s*[\])]?")


class TextFormat(NamedTuple):
    """How a table is written."""

    separator: str
    decimal: str
    names: Sequence[str]
    """One a column, as in the file; "1", "2", … without a header."""
    units: Sequence[str]
    """Of a second row of the header; empty cells without one."""
    dates: Sequence[int]
    """Columns with dates as in ISO 8601, such as 2026-11-28 12:00:00.25."""
    first_line: int
    """Number of the first row of numbers, from 1."""
    words: str
    """What differs from commas and a decimal point below one row of names; empty if nothing does."""


class TextTable:
    """A text table on disk; what is not given of how it is written is recognised. Raises `BadDataset` or `OSError`."""

    def __init__(self, path: Path, separator: str = "", decimal: str = "") -> None:
        self.path = path
        with self._open() as (file, raw):
            head = file.read(_HEAD_BYTES)
            more = bool(file.read(1))
            packed = type(file).__name__ if file is not raw else ""
        self.format = _format_of(head.decode("utf-8-sig", "replace"), more, separator, decimal)
        self.names, self.units, self.words = self.format.names, self.format.units, self.format.words
        if packed:
            self.words = ", ".join(filter(None, [self.words, "gzip" if packed == "GzipFile" else "UTF-16"]))

    @contextmanager
    def _open(self) -> Iterator[tuple[BinaryIO, BinaryIO]]:
        """Give the text in UTF-8, and the file as it is on disk."""
        with open_file(self.path) as raw:
            magic = raw.read(2)
            raw.seek(0)
            file: Any = raw
            if magic == b"\x1f\x8b":
                file = gzip.GzipFile(fileobj=raw)
            elif magic in (b"\xff\xfe", b"\xfe\xff"):  # Excel calls it Unicode text
                file = io.BytesIO(raw.read().decode("utf-16", "replace").encode())
            try:
                yield file, raw
            except (gzip.BadGzipFile, EOFError, zlib.error) as error:
                raise BadDataset("the compressed file is damaged or cut: unpack what is left") from error

    def blocks(self, use: Sequence[int]) -> Iterator[tuple[Array, float]]:
        """Give some columns (n, k) of consecutive rows, and the share of the file before the next ones.

        A blank cell is NaN, a date the seconds since 1970. Raises `BadDataset` behind the last valid block.
        """
        size = self.path.stat().st_size
        with self._open() as (file, raw):
            line = self.format.first_line
            for _ in range(line - 1):
                file.readline()
            while text := file.read(_READ_BYTES) + file.readline():
                yield self._parsed(text, use, line), raw.tell() / size
                line += text.count(b"\n")

    def _parsed(self, text: bytes, use: Sequence[int], line: int) -> Array:
        import pyarrow as pa  # .1 s that other commands need not wait
        from pyarrow import csv as arrow

        separator = self.format.separator
        if separator == " ":
            text = re.sub(rb"(?m)^[ \t]+|[ \t\r]+$", b"", text)
            text = re.sub(rb"[ \t]+", b"\t", text)
            separator = "\t"
        names = [str(i) for i in range(len(self.names))]
        wanted = [names[i] for i in use]
        try:
            table = arrow.read_csv(
                pa.BufferReader(text),
                arrow.ReadOptions(column_names=names, block_size=len(text) + 1, use_threads=False),
                arrow.ParseOptions(delimiter=separator),
                arrow.ConvertOptions(
                    column_types={
                        names[i]: pa.timestamp("ns") if i in self.format.dates else pa.float64() for i in use
                    },
                    include_columns=wanted,
                    null_values=[""],
                    decimal_point=self.format.decimal,
                ),
            )
        except pa.ArrowInvalid:
            return self._slowly_parsed(text, separator, use, line)
        columns = [column.to_numpy() for column in table.columns]
        return np.column_stack([seconds_of(column) if column.dtype.kind == "M" else column for column in columns])

    def _slowly_parsed(self, text: bytes, separator: str, use: Sequence[int], first: int) -> Array:
        """Parse what pyarrow refuses, such as a comment or `+1`. Raises `BadDataset` with the line."""
        count, rows = len(self.names), []
        for line, row in enumerate(
            csv.reader(text.decode("utf-8", "replace").splitlines(), delimiter=separator), first
        ):
            if not any(map(str.strip, row)) or _COMMENT.match(row[0]):
                continue
            if len(row) == count + 1 and not row[-1].strip():
                row.pop()
            if len(row) != count:
                raise BadDataset(f"line {line} has {len(row)} values, other lines have {count}: correct or delete it")
            rows.append([self._number(row[i].strip(), self.names[i], line) for i in use])
        return np.array(rows, float).reshape(-1, len(use))

    def _number(self, cell: str, name: str, line: int) -> float:
        if not cell:
            return np.nan
        if _NUMBER[self.format.decimal].fullmatch(cell):
            return float(cell.replace(",", "."))
        if _DATE.fullmatch(cell):
            date = datetime.fromisoformat(cell.replace(",", "."))
            return (date if date.tzinfo else date.replace(tzinfo=UTC)).timestamp()
        other = ",."[self.format.decimal == ","]
        point = {",": "comma", ".": "point"}[other]
        why = f"has a decimal {point}, unlike others" if _NUMBER[other].fullmatch(cell) else "is no number"
        raise BadDataset(f"line {line}: {name} is '{cell[:40]}', which {why}: correct or delete this line")


def seconds_of(dates: NDArray[Any]) -> Array:
    """Return the seconds since 1970 of dates (n,)."""
    known = dates.astype("datetime64[ns]")
    return np.where(np.isnat(known), np.nan, known.astype(np.int64) * 1e-9)


def _format_of(head: str, more: bool, separator: str, decimal: str) -> TextFormat:
    if "\0" in head:
        raise BadDataset("it is no text table: give a CSV file")
    lines = head.splitlines()
    lines = lines[: -1 if more and len(lines) > 1 else None]
    separator, decimal, count, numeric = _decided(lines, separator, decimal)
    if not numeric:
        found = "the file is empty" if not head.strip() else "no row has two numbers or more"
        raise BadDataset(f"{found}: give a table with one row a sample")
    rows = [_split(line, separator) for line in lines]
    first = next(i for i, row in enumerate(rows) if _is_data(lines[i], row, decimal, numeric))
    above = [i for i in range(first) if lines[i].strip()]
    # A separator at the end of each line makes one more column.
    ended = all(not row[-1] for row in rows[first:] if len(row) == count)
    # Programs write their settings above the names, one a line.
    header = [(i, cells) for i in above if (cells := _header(lines[i], separator, count, ended))]
    units: Sequence[str] = ()
    if len(header) > 1 and header[-1][0] == above[-1] and all(_UNIT.fullmatch(cell) for cell in header[-1][1]):
        units = [cell.strip("[]() ") for cell in header.pop()[1]]
    names = header[-1][1] if header else [str(1 + i) for i in range(count)]
    words = [_SEPARATORS[separator]] if separator != "," else []
    words += ["decimal comma"] if decimal == "," else []
    words += ["no header"] if not header else []
    words += [f"names in line {header[-1][0] + 1}"] if header and header[-1][0] else []
    words += ["units below the names"] if units else []
    dates = [i for i, cell in enumerate(rows[first]) if _DATE.fullmatch(cell)]
    return TextFormat(separator, decimal, names, units or [""] * count, dates, first + 1, ", ".join(words))


def _decided(lines: Sequence[str], separator: str, decimal: str) -> tuple[str, str, int, int]:
    """Return separator, decimal sign, columns and numbers a row: those by which most cells are numbers."""
    last = [line for line in lines if line.strip() and not _COMMENT.match(line)][-_DECIDE:]
    best = (",", ".", 0, 0)
    most = 0.0
    for between in [separator] if separator else _SEPARATORS:
        rows = [_split(line, between) for line in last]
        counts = [len(row) for row in rows]
        count = max(set(counts), key=counts.count) if counts else 0
        rows = [row for row in rows if len(row) == count]
        for point in decimal or ("." if between == "," else ".,"):
            numbers = [_numbers(row, point) for row in rows]
            # A cell that is not a number counts against it: `1,5;2,5` has numbers between commas too.
            score = sum(2 * n - sum(map(bool, row)) for n, row in zip(numbers, rows, strict=True) if n)
            if numbers and min(count, max(numbers)) > 1 and score > most:
                best, most = (between, point, count, max(numbers)), score
    return best


def _split(line: str, separator: str) -> list[str]:
    if separator == " ":
        return line.split()
    cells = next(csv.reader([line], delimiter=separator), [])
    return [cell.strip() for cell in cells]


def _numbers(row: Sequence[str], decimal: str) -> int:
    return sum(bool(_NUMBER[decimal].fullmatch(cell) or _DATE.fullmatch(cell)) for cell in row)


def _is_data(line: str, row: Sequence[str], decimal: str, numeric: int) -> bool:
    # Two topics on one clock leave half of the cells blank.
    return not _COMMENT.match(line) and _numbers(row, decimal) > max(1, numeric // 4)


def _header(line: str, separator: str, count: int, ended: bool) -> list[str]:
    """Return the names in a line above the numbers; behind `#` or `%`, and perhaps with separators of its own."""
    line = _COMMENT.sub("", line, count=1)
    for other in (separator, *_SEPARATORS):
        cells = _split(line, other)
        if len(cells) == count - 1 and count > 2:  # R leaves out the name of the row numbers
            cells = [*cells, ""] if ended else ["", *cells]
        if len(cells) == count and not all(_NUMBER["."].fullmatch(cell) for cell in cells):
            return cells
    return []
