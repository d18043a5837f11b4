"""Text before it reaches a terminal: whole words in lines, help, and tables."""

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

# In help, which click would break at a hyphen.
_HYPHEN: Final = "\ue001"
# More letters than a sentence has.
_WHOLE: Final = 1000
_QUOTED = re.compile(r"`[^`\n]+`")


def glued(text: str, width: int | None = None) -> str:
    """Return text whose commands in backticks are one word each, unless they are wider than a line of `width` columns.

    Fold it, then print it `unglued`.

    Examples
    --------
    >>> unglued(glued("type `ftdrive help`"))
    'type `ftdrive help`'
    """
    return _QUOTED.sub(
        lambda found: found[0].replace(" ", GLUE) if width is None or len(found[0]) <= width else found[0], text
    )


def unglued(text: str) -> str:
    """Return folded text with the spaces of its commands."""
    return text.replace(GLUE, " ")


class WholeWords(click.HelpFormatter):
    """Help whose addresses, options and commands in backticks are never broken, so that they can be copied."""

    def write_text(self, text: str) -> None:
        """Write a paragraph."""
        super().write_text(self._whole(text))

    def write_dl(self, rows: Iterable[tuple[str, str]], col_max: int = 30, col_spacing: int = 2) -> None:
        """Write options or commands, each with its words."""
        super().write_dl([(term, self._whole(words)) for term, words in rows], col_max, col_spacing)

    def getvalue(self) -> str:
        """Return the help."""
        return unglued(super().getvalue()).replace(_HYPHEN, "-")

    @staticmethod
    def _whole(text: str) -> str:
        return glued(text).replace("-", _HYPHEN)


class Group(click.Group):
    """A command with commands, whose help has each of their first sentences whole."""

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Write the list of commands."""
        named = [(name, self.get_command(ctx, name)) for name in self.list_commands(ctx)]
        with formatter.section("Commands"):
            formatter.write_dl([(name, one.get_short_help_str(_WHOLE)) for name, one in named if one is not None])


NARROWEST: Final = 20
"""Columns behind a head: with fewer, lines begin at the left."""


def in_whole_words(text: str, file: IO[str], head: str = "") -> str:
    """Break lines between words where they are longer than the terminal is wide, but not for a file or pipe.

    Control characters become visible. A word that is longer by itself, such as a path, stays whole, and so does a
    command in backticks. Where `head` is what the text begins with, its lines go on behind it, as in `hanging`.
    """
    text = visible(as_typed(text))
    try:
        width = os.get_terminal_size(file.fileno()).columns
    except (OSError, ValueError):  # no terminal; nothing of the system
        return text
    # a terminal that does not know
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
        line if is_command(line.strip()) else unglued(fold.fill(glued(line))) + line[len(line.rstrip()) :]
        # a prompt ends with a space
        for line in text.split("\n")
    )


def echo(text: str = "", *, bold: str = "", err: bool = False, nl: bool = True, fold: bool = True) -> None:
    """Print text on stdout, or stderr with `err`; `bold` is printed before it.

    A terminal gets whole words, and every reader commands that can be typed; with `fold=False` the text is data.
    """

    def shown(text: str) -> str:
        return in_whole_words(text, sys.stderr if err else sys.stdout) if fold else visible(text)

    head = click.style(shown(bold), bold=True) if bold else ""
    click.echo(head + shown(text), err=err, nl=nl)


GAP = "  "


def print_table(titles: Sequence[str], rows: Sequence[Sequence[str]], folding: Collection[str]) -> None:
    """Print a table; a file or pipe has one line a row, and so has a terminal that is wide enough.

    `folding` has the titles of the columns whose texts may be folded.
    """
    rows = [[visible(cell) for cell in row] for row in rows]
    widths = [max(map(len, column)) for column in zip(titles, *rows, strict=True)]
    # columns; the others are on a line of their own
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
    """Fold the texts of a row; those that stand on a line of their own keep their widths."""
    texts = zip(row[:beside], widths, strict=False)
    folded = [wrap(text, width, break_long_words=False, break_on_hyphens=False) for text, width in texts]
    for parts in zip_longest(*folded, fillvalue=""):
        yield _table_line(parts, widths)
    if row[beside:]:
        yield " " * len(GAP) + _table_line(row[beside:], widths[beside:])


def _table_line(row: Sequence[str], widths: Sequence[int]) -> str:
    return unglued(GAP.join(text.ljust(width) for text, width in zip(row, widths, strict=False)).rstrip())
