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

# Stands for a hyphen while click folds a help text, because click would break lines at hyphens.
_HYPHEN: Final = "\ue001"
# Limit of a command's help line, longer than any sentence, so that click does not cut it.
_WHOLE: Final = 1000
_QUOTED = re.compile(r"`[^`\n]+`")


def glue(text: str, width: int | None = None) -> str:
    """Replace the spaces in each command in backticks, unless it is longer than `width`, so that it is one word.

    Lines are then not broken within commands. Call `unglue` after folding the text.

    Examples
    --------
    >>> unglue(glue("type `ftdrive help`"))
    'type `ftdrive help`'
    """
    return _QUOTED.sub(
        lambda found: found[0].replace(" ", GLUE) if width is None or len(found[0]) <= width else found[0], text
    )


def unglue(text: str) -> str:
    """Return a text with the spaces restored that `glue` has replaced."""
    return text.replace(GLUE, " ")


class WholeWords(click.HelpFormatter):
    """Help texts in which addresses, options and commands in backticks are never broken, so that they can be copied."""

    def write_text(self, text: str) -> None:
        """Write a paragraph."""
        super().write_text(self._whole(text))

    def write_dl(self, rows: Iterable[tuple[str, str]], col_max: int = 30, col_spacing: int = 2) -> None:
        """Write a list of options or commands with their descriptions."""
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
"""Lines are indented below the first word only if at least this number of columns is left for the text."""


def in_whole_words(text: str, file: IO[str], head: str = "") -> str:
    """Fold a text between words if `file` is a terminal; for a file or pipe, its lines stay unchanged.

    Control characters become visible. Words longer than a line, such as paths, and commands in backticks stay whole. If
    the text begins with `head`, lines after the first are indented by the length of `head`.
    """
    text = visible(as_typed(text))
    try:
        width = os.get_terminal_size(file.fileno()).columns
    except (OSError, ValueError):  # not a terminal
        return text
    # do not fold if the terminal reports the size 0, as some do
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
        # the white space at the end of a line, as of a prompt, is kept
        for line in text.split("\n")
    )


def echo(text: str = "", *, bold: str = "", err: bool = False, nl: bool = True, fold: bool = True) -> None:
    """Print text on stdout, or stderr with `err`, after the bold text `bold`.

    On a terminal, lines break between words, and commands are printed as they must be typed; not with `fold=False`.
    """

    def shown(text: str) -> str:
        return in_whole_words(text, sys.stderr if err else sys.stdout) if fold else visible(text)

    head = click.style(shown(bold), bold=True) if bold else ""
    click.echo(head + shown(text), err=err, nl=nl)


GAP = "  "


def print_table(titles: Sequence[str], rows: Sequence[Sequence[str]], folding: Collection[str]) -> None:
    """Print a table with one line per row; on a narrow terminal, cells are folded and last columns moved below.

    `folding` contains the titles of the columns whose cells may be folded.
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
