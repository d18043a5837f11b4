"""Output for people goes to stderr, because stdout is for data."""

import os
import sys
import textwrap
from typing import TextIO

from rich.console import Console
from rich.text import Text


class Talk(Console):
    """A console that knows whether details are wanted (`-v`); `quiet` is the console's own."""

    verbose = False

    def on_broken_pipe(self) -> None:
        """Go on without output: rich would end the thread that prints, and close standard output too."""
        self.quiet = True


talk = Talk(stderr=True, highlight=False, markup=False, emoji=False, soft_wrap=not sys.stderr.isatty())
"""Folds between words in a terminal, never in a file. Prints brackets and colons as they are: paths contain them."""

_NARROWEST = 20
"""Columns behind a head: with fewer, lines begin at the left."""


def hanging(head: str | Text, words: str, console: Console = talk) -> Text:
    """Put words behind a head; on a terminal too narrow for them the next lines begin under the first word."""
    first = Text.assemble(head)
    text = Text(words)
    width = console.width - first.cell_len
    if console.soft_wrap or width < _NARROWEST:
        return first + text
    lines = text.wrap(console, width)
    for line in lines:
        line.rstrip()
    return first + Text("\n" + " " * first.cell_len).join(lines)


def in_whole_words(text: str, file: TextIO, head: str = "") -> str:
    """Break lines between words where they are longer than the terminal is wide; as it is for a file or pipe.

    For what is written without `talk`. A word that is longer by itself, such as a path, stays whole. Where `head` is
    what the text begins with, its lines go on behind it, as in `hanging`.
    """
    try:
        width = os.get_terminal_size(file.fileno()).columns
    except (OSError, ValueError):  # no terminal; nothing of the system
        return text
    if width == 0:  # a terminal that does not know
        return text
    fold = textwrap.TextWrapper(
        width,
        subsequent_indent=" " * len(head) if width - len(head) >= _NARROWEST else "",
        break_long_words=False,
        break_on_hyphens=False,
        replace_whitespace=False,
    )
    return "\n".join(
        fold.fill(line) + line[len(line.rstrip()) :]
        for line in text.split("\n")  # a prompt ends with a space
    )
