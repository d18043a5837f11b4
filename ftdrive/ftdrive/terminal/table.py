"""A table on stdout: one line a row where it fits, long texts folded where the terminal is narrow."""

import shutil
import sys
from collections.abc import Collection, Sequence

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
    width = sum(widths) + len(GAP) * (len(widths) - 1)
    narrowest = [
        max(len(word) for text in column for word in (text.split() if title in folding else [text]) or [""])
        for title, column in zip(titles, zip(titles, *rows, strict=True), strict=True)
    ]
    columns = shutil.get_terminal_size().columns
    fits = sum(narrowest) + len(GAP) * (len(widths) - 1) <= columns
    if not (sys.stdout.isatty() and fits) or width <= columns:  # a terminal may break lines, never words
        head, *lines = (_line(row, widths) for row in (titles, *rows))
        echo("\n".join(["", *lines]), bold=head)
        return
    from rich.table import Table

    from ftdrive.terminal.console import answer

    table = Table(box=None, pad_edge=False, padding=(0, len(GAP), 0, 0), header_style="bold")
    for title, least in zip(titles, narrowest, strict=True):
        table.add_column(title, no_wrap=title not in folding, overflow="fold", min_width=least)
    for row in rows:
        table.add_row(*row)
    answer.print(table, width=columns, soft_wrap=False)


def _line(row: Sequence[str], widths: Sequence[int]) -> str:
    return GAP.join(text.ljust(width) for text, width in zip(row, widths, strict=True)).rstrip()
