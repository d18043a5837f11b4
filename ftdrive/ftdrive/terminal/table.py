"""A table on stdout: one line a row where it fits; else texts are folded, and the last columns begin a line."""

import shutil
import sys
from collections.abc import Collection, Iterator, Sequence
from itertools import zip_longest
from textwrap import wrap

from ftdrive.terminal.text import echo, visible

GAP = "  "


def print_table(titles: Sequence[str], rows: Sequence[Sequence[str]], folding: Collection[str]) -> None:
    """Print a table; a file or pipe has one line a row, and so has a terminal that is wide enough.

    Parameters
    ----------
    titles : sequence of str
        Of the columns.
    rows : sequence of sequences of str
    folding : collection of str
        Titles of the columns whose texts may be folded.
    """
    rows = [[visible(cell) for cell in row] for row in rows]
    widths = [max(map(len, column)) for column in zip(titles, *rows, strict=True)]
    beside = len(titles)  # columns; the others are on a line of their own
    if sys.stdout.isatty():
        least = [
            max(len(word) for text in column for word in (text.split() if title in folding else [text]) or [""])
            for title, column in zip(titles, zip(titles, *rows, strict=True), strict=True)
        ]
        columns = shutil.get_terminal_size().columns
        while beside > 1 and _width(least[:beside]) > columns:
            beside -= 1
        while _width(widths[:beside]) > columns and widths[:beside] != least[:beside]:
            widest = max(range(beside), key=lambda k: (widths[k] > least[k], widths[k]))
            widths[widest] -= 1
    head, *lines = (line for row in (titles, *rows) for line in _lines(row, widths, beside))
    echo("\n".join(["", *lines]), bold=head)


def _width(widths: Sequence[int]) -> int:
    return sum(widths) + len(GAP) * (len(widths) - 1)


def _lines(row: Sequence[str], widths: Sequence[int], beside: int) -> Iterator[str]:
    """Fold the texts of a row; those that stand on a line of their own keep their widths."""
    texts = zip(row[:beside], widths, strict=False)
    folded = [wrap(text, width, break_long_words=False, break_on_hyphens=False) for text, width in texts]
    for parts in zip_longest(*folded, fillvalue=""):
        yield _line(parts, widths)
    if row[beside:]:
        yield " " * len(GAP) + _line(row[beside:], widths[beside:])


def _line(row: Sequence[str], widths: Sequence[int]) -> str:
    return GAP.join(text.ljust(width) for text, width in zip(row, widths, strict=False)).rstrip()
