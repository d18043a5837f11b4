"""Tables of numbers as CSV, from other programs, read in parts."""

import csv
import io
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np

from ftcalib.data.dataset import ORIENTATION_FORMS, listed, orientation_columns
from ftcalib.data.dwell_mean import CHANNELS
from ftcalib.errors import BadDataset
from ftcalib.files import open_file
from ftdrivers.interfaces import Array

_READ_BYTES, _LONGEST_LINE = 1 << 21, 1 << 14
_SEPARATORS = np.frombuffer(b",\n", np.uint8)
_BEFORE: Final = {
    sign: np.frombuffer(text, np.uint8) for sign, text in ((b"-", b",\ne"), (b"+", b"e"), (b"e", b"0123456789."))
}
"""What may precede a sign."""


class Wanted(NamedTuple):
    """Columns beside t."""

    choose: Callable[[Sequence[str]], Sequence[str]]
    """Returns their names, from those of all columns."""
    words: str


WRENCH: Final = Wanted(lambda _: CHANNELS, ", ".join(CHANNELS))
ORIENTATION: Final = Wanted(orientation_columns, ORIENTATION_FORMS)


class Part(NamedTuple):
    """Consecutive rows of a table."""

    t_s: Array
    """(n,)"""
    numbers: Array
    """(n, k)"""
    names: Sequence[str]
    """Of the k columns."""
    place: int
    """Bytes of the file up to the end of these rows."""


def read_table(path: Path, wanted: Wanted) -> Iterator[Part]:
    """Read the column t and the wanted ones; the first row has the names.

    Raises
    ------
    BadDataset
        A column is missing, or a line is not one of numbers; the parts before it are read.
    """
    with open_file(path) as file:
        names, found = _columns(path, file.readline(), wanted)
        use = [names.index(name) for name in ("t", *found)]
        count = 0
        while text := file.read(_READ_BYTES) + file.readline():
            table = _parsed(path, text, len(names), use, count)
            count += table.shape[1]
            yield Part(table[0], np.ascontiguousarray(table[1:].T), found, file.tell())


def mean_rate_Hz(path: Path, wanted: Wanted) -> float:
    """Return the mean rate of the rows of a table, by its first and last row and the number of its lines.

    Raises
    ------
    BadDataset
        A column is missing, or there are fewer than two rows of numbers.
    """
    with open_file(path) as file:
        names, _ = _columns(path, file.readline(), wanted)
        first, lines = file.readline(), 1
        tail = first
        while part := file.read(_READ_BYTES):
            lines += part.count(b"\n")
            tail = (tail + part[-_LONGEST_LINE:])[-_LONGEST_LINE:]
    *_, last = [first, *(line for line in tail.splitlines() if line.strip())]
    count = lines + (not tail.endswith(b"\n")) if first.strip() else 0
    if count < 2:
        raise BadDataset(f"{path.name}: it has {count} rows: at least 2 are needed")
    begin, end = (_parsed(path, line, len(names), [names.index("t")]) for line in (first, last))
    return (count - 1) / max(float((end - begin)[0, 0]), 1e-9)


def _columns(path: Path, head: bytes, wanted: Wanted) -> tuple[list[str], Sequence[str]]:
    """Return the names of all columns, and of the wanted ones."""
    try:
        names = [name.strip() for name in next(csv.reader([head.decode("utf-8-sig", "replace")]), [])]
    except csv.Error as error:  # such as a field of more than 131,072 characters
        raise BadDataset(f"{path.name}: the first row is no list of columns ({error}): give a CSV file") from error
    found = wanted.choose(names)
    if not {"t", *found} <= set(names):
        raise BadDataset(f"{path.name}: the first row must name t and {wanted.words}; it names {listed(names)}")
    return names, found


def _parsed(path: Path, text: bytes, columns: int, use: Sequence[int], before: int = 0) -> Array:
    """Parse lines behind so many rows of a file."""
    try:
        return parsed(text, columns, use)
    except ValueError as error:
        place = f"{path.name}, after row {before}" if before else path.name  # loadtxt counts from there
        raise BadDataset(f"{place}: {error}: correct this line") from error


def parsed(text: bytes, columns: int, use: Sequence[int]) -> Array:
    """Return some columns (k, n) of n whole lines; raises `ValueError` as `numpy.loadtxt`.

    The reader of Matrix Market files in SciPy takes an eighth of the time of `loadtxt` for the same bits. It ignores
    what follows a number in its line, so it gets only text of which nothing could be ignored.
    """
    text = (text if text.endswith(b"\n") else text + b"\n").replace(b"\r\n", b"\n")
    if _is_plain(text, columns):
        from scipy.io import mmread

        head = b"%%%%MatrixMarket matrix array real general\n%d %d\n" % (columns, text.count(b"\n"))
        try:
            return np.asarray(mmread(io.BytesIO(head + text.replace(b",", b"\n"))))[use]
        except ValueError:  # a sign or a point without a digit
            pass
    lines = text.decode(errors="replace").splitlines()
    return np.loadtxt(lines, delimiter=",", usecols=use, ndmin=2).T


def _is_plain(text: bytes, columns: int) -> bool:
    """Whether each line has so many decimals as `-1.5` or `2e-05`; some may lack their digits."""
    between = text.translate(None, b"0123456789-+")
    one_line = b"," * (columns - 1) + b"\n"
    if between.translate(None, b".e") != one_line * text.count(b"\n"):
        return False
    if any(pair in between for pair in ((b"..", b"ee", b"e.") if b"e" in between else (b"..",))):
        return False
    byte = np.frombuffer(b"\n" + text, np.uint8)
    for sign, before in _BEFORE.items():
        if sign not in text:
            continue
        places = np.flatnonzero(byte == ord(sign))
        if not np.isin(byte[places - 1], before).all() or np.isin(byte[places + 1], _SEPARATORS).any():
            return False
    return True
