"""Text for a terminal: line breaks between words, help texts, and tables."""

import os
import re
import shutil
import sys
import textwrap
from collections.abc import Collection, Iterable, Iterator, Sequence
from itertools import zip_longest
from textwrap import wrap
from typing import IO, Final

import click

from ftdrive.words.text import GLUE, as_typed, is_command, visible

# Replaces hyphens in help texts, because click would break lines at them.
_HYPHEN: Final = "\ue001"
# A line width that no sentence exceeds.
_WHOLE: Final = 1000
_QUOTED = re.compile(r"`[^`\n]+`")


def glue(text: str, width: int | None = None) -> str:
    """Return text in which each command in backticks is one word, unless it is longer than `width` columns.

    Fold the text, then call `unglue` before printing it.

    Examples
    --------
    >>> unglue(glue("type `ftdrive help`"))
    'type `ftdrive help`'
    """
    return _QUOTED.sub(
        lambda found: found[0].replace(" ", GLUE) if width is None or len(found[0]) <= width else found[0], text
    )


def unglue(text: str) -> str:
    """Return folded text with the spaces in its commands restored."""
    return text.replace(GLUE, " ")


class WholeWords(click.HelpFormatter):
    """Help texts in which addresses, options and commands in backticks are never broken, so that they can be copied."""

    def write_text(self, text: str) -> None:
        """Write a paragraph."""
        super().write_text(self._whole(text))

    def write_dl(self, rows: Iterable[tuple[str, str]], col_max: int = 30, col_spacing: int = 2) -> None:
        """Write options or commands with their descriptions."""
        super().write_dl([(term, self._whole(words)) for term, words in rows], col_max, col_spacing)

    def getvalue(self) -> str:
        """Return the help."""
        return unglue(super().getvalue()).replace(_HYPHEN, "-")

    @staticmethod
    def _whole(text: str) -> str:
        return glue(text).replace("-", _HYPHEN)


class Group(click.Group):
    """A command group whose help shows the whole first sentence of each command."""

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Write the list of commands."""
        named = [(name, self.get_command(ctx, name)) for name in self.list_commands(ctx)]
        with formatter.section("Commands"):
            formatter.write_dl([(name, one.get_short_help_str(_WHOLE)) for name, one in named if one is not None])


NARROWEST: Final = 20
"""Smallest number of columns after a head for which lines are indented."""


def in_whole_words(text: str, file: IO[str], head: str = "") -> str:
    """Return text with lines broken between words for a terminal, or with unchanged lines for a file or pipe.

    Control characters become visible. Words longer than a line, such as paths, and commands in backticks stay whole. If
    the text begins with `head`, the lines after the first are indented by its length.
    """
    text = visible(as_typed(text))
    try:
        width = os.get_terminal_size(file.fileno()).columns
    except (OSError, ValueError):  # not a terminal
        return text
    # some terminals report the size 0
    if width == 0:
        return text
    fold = textwrap.TextWrapper(
        width,
        subsequent_indent=" " * len(head) if width - len(head) >= NARROWEST else "",
        break_long_words=False,
        break_on_hyphens=False,
        replace_whitespace=False,
    )
    return "\n".join(
        line if is_command(line.strip()) else unglue(fold.fill(glue(line))) + line[len(line.rstrip()) :]
        # keep the trailing space of a prompt
        for line in text.split("\n")
    )


def echo(text: str = "", *, bold: str = "", err: bool = False, nl: bool = True, fold: bool = True) -> None:
    """Print text on stdout, or stderr with `err`, after the bold text `bold`.

    On a terminal, lines break between words. Commands are printed as they must be typed. `fold=False` is for data.
    """

    def shown(text: str) -> str:
        return in_whole_words(text, sys.stderr if err else sys.stdout) if fold else visible(text)

    head = click.style(shown(bold), bold=True) if bold else ""
    click.echo(head + shown(text), err=err, nl=nl)


GAP = "  "


def print_table(titles: Sequence[str], rows: Sequence[Sequence[str]], folding: Collection[str]) -> None:
    """Print a table; files, pipes and wide terminals get one line per row.

    `folding` contains the titles of the columns that may be folded.
    """
    rows = [[visible(cell) for cell in row] for row in rows]
    widths = [max(map(len, column)) for column in zip(titles, *rows, strict=True)]
    # number of columns in the first line of a row; the remaining columns follow on a second line
    beside = len(titles)
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
    texts = zip(row[:beside], widths, strict=False)
    folded = [wrap(text, width, break_long_words=False, break_on_hyphens=False) for text, width in texts]
    for parts in zip_longest(*folded, fillvalue=""):
        yield _table_line(parts, widths)
    if row[beside:]:
        yield " " * len(GAP) + _table_line(row[beside:], widths[beside:])


def _table_line(row: Sequence[str], widths: Sequence[int]) -> str:
    return unglue(GAP.join(text.ljust(width) for text, width in zip(row, widths, strict=False)).rstrip())
