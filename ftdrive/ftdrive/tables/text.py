"""Text tables from other programs; separator, decimal mark and header are recognised from the first lines."""

import csv
import gzip
import io
import re
import zlib
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from datetime import UTC, datetime
from pathlib import Path
from typing import IO, Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ftcalib.errors import BadDataset
from ftcalib.files import open_file
from ftcalib.model import Array

# Numbers of characters: in a block; examined first for the format; searched at most for the first row; in a line.
_BLOCK, _FIRST, _HEAD, _LINE = 1 << 22, 1 << 16, 1 << 20, 1 << 18
_SEPARATORS: Final = {";": "semicolons", "\t": "tabs", ",": "commas", " ": "spaces"}
_COMMENT = re.compile(r"\s*(#+|%+|//)\s*")
_NUMBER: Final = {
    ".": re.compile(r"[+-]?(\d+(\.\d*)?|\.\d+)(e[+-]?\d+)?|[+-]?(nan|inf)", re.IGNORECASE),
    ",": re.compile(r"[+-]?(\d+(,\d*)?|,\d+)(e[+-]?\d+)?|[+-]?(nan|inf)", re.IGNORECASE),
}
# Separator and decimal mark are recognised from this number of rows.
_DECIDE = 30
_DATE = re.compile(r"\d{4}-\d\d-\d\d[T ]\d\d:\d\d(:\d\d([.,]\d+)?)?\s*(Z|[+-]\d\d:?\d\d)?")
_UNIT = re.compile(r"[\[(]?\s*[-%°a-zA-Zµμ·*./^²0-9 ]{0,8}\s*[\])]?")
_UNIT_LENGTH = 20


class _TextFormat(NamedTuple):
    """Recognised format of a text table."""

    separator: str
    decimal: str
    names: Sequence[str]
    """Names of the columns as in the file; "1", "2", … if it has no header."""
    units: Sequence[str]
    """Units from a row below the names of the columns; empty strings if there is no such row."""
    dates: Sequence[int]
    """Indices of columns with ISO 8601 dates, such as 2026-11-28 12:00:00.25."""
    first_line: int
    """Number, from 1, of the line with the first row of numbers."""
    words: str
    """Differences from a table with commas, decimal points and one row of names; empty if there are none."""


class TextTable:
    """A text table on disk. Separator and decimal mark are recognised if empty; if that fails, raises `BadDataset`."""

    def __init__(self, path: Path, separator: str = "", decimal: str = "") -> None:
        self.path, self.comments = path, 0
        with self._open() as (text, raw):
            self.format = _format_in(text, separator, decimal)
            encodings = ["gzip"] if text.buffer is not raw else []
            encodings += ["UTF-16"] if text.encoding == "utf-16" else []
        self.names, self.units = self.format.names, self.format.units
        self.words = ", ".join(filter(None, [self.format.words, *encodings]))

    @contextmanager
    def _open(self) -> Iterator[tuple[Any, IO[bytes]]]:
        r"""Yield the unpacked text, whose lines end with `\n`, and the file on disk. Cells keep other line breaks."""
        with open_file(self.path) as raw:
            packed = raw.read(2) == b"\x1f\x8b"
            raw.seek(0)
            file = io.BufferedReader(gzip.GzipFile(fileobj=raw)) if packed else raw
            try:
                is_utf16 = file.peek(2)[:2] in (b"\xff\xfe", b"\xfe\xff")  # as Excel saves "Unicode text"
                text = io.TextIOWrapper(file, "utf-16" if is_utf16 else "utf-8-sig", "replace", newline=None)
                yield text, raw
            except (gzip.BadGzipFile, EOFError, zlib.error) as error:
                raise BadDataset("the compressed file is damaged or incomplete: unpack the readable part") from error

    def blocks(self, use: Sequence[int]) -> Iterator[tuple[Array, float]]:
        """Yield the columns (n, k) of consecutive rows, with the share of the file read so far.

        A blank cell is NaN, and a date is the time since 1970, s. At a bad cell, raises `BadDataset`.
        """
        size = self.path.stat().st_size
        with self._open() as (file, raw):
            line, self.comments = self.format.first_line, 0
            for _ in range(line - 1):
                file.readline()
            while text := file.read(_BLOCK):
                text += file.readline(_LINE)
                if len(text) >= _BLOCK + _LINE and not text.endswith("\n"):
                    cut = line + text.count("\n")
                    raise BadDataset(f"line {cut} is longer than {_LINE} characters: write one row per sample")
                yield self._parsed(text, use, line), raw.tell() / size
                line += text.count("\n")

    def _parsed(self, text: str, use: Sequence[int], first: int) -> Array:
        separator, lines = self.format.separator, text.split("\n")
        rows = lines
        if any(mark in text for mark in "#%/"):
            rows = [line for line in lines if not _COMMENT.match(line)]
        comments = len(lines) - len(rows)
        if separator == " ":
            separator, rows = "\t", ["\t".join(row.split()) for row in rows]
        if self.format.decimal == ",":
            rows = [row.replace(",", ".") for row in rows] if "." not in text else []
        numbers = self._numbers(rows, separator, use)
        if numbers is None:
            plain = "\n".join(["", *rows, ""])
            # Two adjacent separators are replaced twice, because those of consecutive blank cells overlap.
            for edge in (separator * 2, separator * 2, f"\n{separator}", f"{separator}\n"):
                plain = plain.replace(edge, f"{edge[0]}nan{edge[1]}")
            numbers = self._numbers(plain.split("\n"), separator, use)
        if numbers is None:
            return self._slowly_parsed(text, use, first)
        self.comments += comments
        return numbers

    def _numbers(self, lines: Sequence[str], separator: str, use: Sequence[int]) -> Array | None:
        """Read the columns `use` of lines with numpy; return None if it rejects a row or cell, such as a blank one."""
        if not (rows := list(filter(None, lines))):
            return None
        kinds = dict.fromkeys(range(len(self.names)), "U1") | dict.fromkeys(use, "f8")
        kinds |= {i: "U40" for i in self.format.dates if i in use}
        of_columns = [(str(i), kind) for i, kind in kinds.items()]
        try:
            table = np.loadtxt(rows, of_columns, comments=None, delimiter=separator, ndmin=1, quotechar='"')
            columns = [table[str(i)] if kinds[i] == "f8" else self._dates(table[str(i)], self.names[i]) for i in use]
            # a quote that is not closed gives fewer rows, because its cell includes the rows below
            return np.column_stack(columns) if len(table) == len(rows) else None
        except (BadDataset, ValueError):
            return None

    def _dates(self, cells: NDArray[np.str_], name: str) -> Array:
        """Return a column of dates (n,) as times since 1970, s. A cell that is no date raises `BadDataset`."""
        if all((match := _DATE.fullmatch(cell)) and not match[3] for cell in cells.tolist()):
            return seconds_of(cells.astype("datetime64[ns]"))
        return np.array([self._number(cell.strip(), name, 0) for cell in cells.tolist()])

    def _slowly_parsed(self, text: str, use: Sequence[int], first: int) -> Array:
        """Read the columns of a text that numpy rejects, cell by cell. A cell that is no number raises `BadDataset`."""
        count, rows = len(self.names), []
        for line, one in enumerate(text.split("\n"), first):
            row = _split(one, self.format.separator)
            if _COMMENT.match(one):
                self.comments += 1
                continue
            if not any(row):
                continue
            if len(row) == count + 1 and not row[-1].strip():
                row.pop()
            if len(row) != count:
                raise BadDataset(f"line {line} has {len(row)} values, other lines have {count}: correct or delete it")
            rows.append([self._number(row[i].strip(), self.names[i], line) for i in use])
        return np.array(rows, float).reshape(len(rows), len(use))

    def _number(self, cell: str, name: str, line: int) -> float:
        if not cell:
            return np.nan
        if _NUMBER[self.format.decimal].fullmatch(cell):
            return float(cell.replace(",", "."))
        if match := _DATE.fullmatch(cell):
            zone = match[3] or ""
            with suppress(ValueError):  # such as a 13th month
                date = datetime.fromisoformat(cell.removesuffix(zone).rstrip().replace(",", ".") + zone)
                return (date if date.tzinfo else date.replace(tzinfo=UTC)).timestamp()
        other = ",."[self.format.decimal == ","]
        point = {",": "comma", ".": "point"}[other]
        why = f"has a decimal {point}, unlike others" if _NUMBER[other].fullmatch(cell) else "is not a number"
        raise BadDataset(f"line {line}: {name} is '{cell[:40]}', which {why}: correct or delete this line")


def seconds_of(dates: NDArray[Any]) -> Array:
    """Return dates (n,) as times since 1970, s; a missing date is NaN."""
    known = dates.astype("datetime64[ns]")
    return np.where(np.isnat(known), np.nan, known.astype(np.int64) * 1e-9)


def _format_in(text: IO[str], separator: str, decimal: str) -> _TextFormat:
    """Recognise a text table's format from as many first lines as needed. Raises `BadDataset` if there is no table."""
    head = text.read(_FIRST)
    while True:
        more = text.read(len(head))
        try:
            return _format_of(head, bool(more), separator, decimal)
        except _NoNumbers:
            if not more or len(head) >= _HEAD:
                raise
        head += more


class _NoNumbers(BadDataset):
    """Raised if the examined lines have no row of numbers."""


def _format_of(head: str, more: bool, separator: str, decimal: str) -> _TextFormat:
    if "\0" in head:
        raise BadDataset("the file is not a text table: give a CSV file")
    lines = head.split("\n")
    lines = lines[: -1 if more and len(lines) > 1 else None]
    separator, decimal, count, numeric = _decided(lines, separator, decimal)
    if not numeric:
        why = "the file is empty" if not head.strip() else "no row has two numbers or more"
        raise _NoNumbers(f"{why}: give a table with one row per sample")
    rows = [_split(line, separator) for line in lines]
    first = next(i for i, row in enumerate(rows) if _is_data(lines[i], row, decimal, numeric))
    above = [i for i in range(first) if lines[i].strip()]
    _require_no_data(lines, above, numeric, separator, decimal)
    # A separator at the end of each line adds an empty column.
    ended = all(not row[-1] for row in rows[first:] if len(row) == count)
    # the names are the last line above the numbers, because programs may write settings above the names
    header = [(i, cells) for i in above if (cells := _header(lines[i], separator, count, ended))]
    units: Sequence[str] = ()
    if len(header) > 1 and header[-1][0] == above[-1] and all(map(_is_unit, header[-1][1])):
        units = [cell.strip("[]() ") for cell in header.pop()[1]]
    names = header[-1][1] if header else [str(1 + i) for i in range(count)]
    words = [_SEPARATORS[separator]] if separator != "," else []
    words += ["decimal comma"] if decimal == "," else []
    words += ["no header"] if not header else []
    words += [f"names in line {header[-1][0] + 1}"] if header and header[-1][0] else []
    words += ["units below the names"] if units else []
    dates = [i for i, cell in enumerate(rows[first]) if _DATE.fullmatch(cell)]
    return _TextFormat(separator, decimal, names, units or [""] * count, dates, first + 1, ", ".join(words))


def _decided(lines: Sequence[str], separator: str, decimal: str) -> tuple[str, str, int, int]:
    """Return the separator and decimal mark that give the most numbers, and how many columns and numbers a row has."""
    last = [line for line in lines if line.strip() and not _COMMENT.match(line)][-_DECIDE:]
    best = (",", ".", 0, 0)
    most = 0.0
    for between in [separator] if separator else _SEPARATORS:
        rows = [_split(line, between) for line in last]
        counts = [len(row) for row in rows]
        count = max(set(counts), key=counts.count) if counts else 0
        rows = [row for row in rows if len(row) == count]
        for point in decimal or ("." if between == "," else ".,"):
            numbers = [_count_numbers(row, point) for row in rows]
            # Cells that are no numbers reduce the score, because `1,5;2,5` split at commas has two numbers, too.
            score = sum(2 * n - sum(map(bool, row)) for n, row in zip(numbers, rows, strict=True) if n)
            if numbers and min(count, max(numbers)) > 1 and score > most:
                best, most = (between, point, count, max(numbers)), score
    return best


def _split(line: str, separator: str) -> list[str]:
    if separator == " ":
        return line.split()
    try:
        return [cell.strip() for cell in next(csv.reader([line], delimiter=separator), [])]
    except csv.Error:  # the csv module rejects cells above 131,072 characters
        return []


def _count_numbers(row: Sequence[str], decimal: str) -> int:
    return sum(bool(_NUMBER[decimal].fullmatch(cell) or _DATE.fullmatch(cell)) for cell in row)


def _is_data(line: str, row: Sequence[str], decimal: str, numeric: int) -> bool:
    # require few numbers, because in a table of two ROS topics half of the cells are blank
    return not _COMMENT.match(line) and _count_numbers(row, decimal) > max(1, numeric // 4)


def _require_no_data(lines: Sequence[str], above: Sequence[int], numeric: int, separator: str, decimal: str) -> None:
    """Raise `BadDataset` if a line above the first row has numbers with another separator or decimal mark."""
    for i in above:
        for between, point in ((one, other) for one in _SEPARATORS for other in ".,"):
            cells = [cell for cell in _split(lines[i], between) if cell]
            if not _COMMENT.match(lines[i]) and len(cells) == _count_numbers(cells, point) >= max(2, numeric // 2):
                ours, theirs = (
                    f"{_SEPARATORS[a]} and a decimal {'comma' if b == ',' else 'point'}"
                    for a, b in ((between, point), (separator, decimal))
                )
                raise BadDataset(f"line {i + 1} is a row with {ours}, rows below have {theirs}: use one format")


def _is_unit(cell: str) -> bool:
    return len(cell) <= _UNIT_LENGTH and _UNIT.fullmatch(cell) is not None


def _header(line: str, separator: str, count: int, ended: bool) -> list[str]:
    """Return the `count` names in a header line, possibly a comment or with another separator; [] if it has none."""
    line = line[found.end() :] if (found := _COMMENT.match(line)) else line
    for other in (separator, *_SEPARATORS):
        cells = _split(line, other)
        if len(cells) == count - 1 and count > 2:  # R writes no name for the column of row numbers
            cells = [*cells, ""] if ended else ["", *cells]
        if len(cells) == count and not all(_NUMBER["."].fullmatch(cell) for cell in cells):
            return cells
    return []
