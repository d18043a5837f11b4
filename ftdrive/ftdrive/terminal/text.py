"""Text before it reaches a screen: what a file, a device or the network names cannot command the terminal."""

import os
import re
import sys
import textwrap
from typing import IO, Final

import click

from ftdrive.terminal.command_names import as_typed, is_command

_CONTROL = re.compile(
    "[\x00-\x08\x0b\x0c\x0e-\x1f\x7f-\x9f\u200e\u200f\u2028-\u202e\u2066-\u2069\ud800-\udfff]|\r(?!\n)"
)
"""All but tab and the end of a line; with those that turn the direction of writing, and bytes that are no text."""


def visible(text: str) -> str:
    r"""Return text with control characters as in a Python string, such as `\x1b`; safe on any screen.

    Examples
    --------
    >>> print(visible("gripper\x1b[2J"))
    gripper\x1b[2J
    """
    return _CONTROL.sub(lambda found: found[0].encode("unicode_escape", "surrogatepass").decode(), text)


def in_one_line(text: str) -> str:
    r"""Return text with its newlines as `\n`, but for those before a command, so that a name cannot begin a line.

    Examples
    --------
    >>> print(in_one_line("there is no a\nerror: b; run\nftdrive devices"))
    there is no a\nerror: b; run
    ftdrive devices
    """
    first, *others = text.replace("\r", "\\r").split("\n")
    return first + "".join(("\n" if is_command(line) else "\\n") + line for line in others)


NARROWEST: Final = 20
"""Columns behind a head: with fewer, lines begin at the left."""


def in_whole_words(text: str, file: IO[str], head: str = "") -> str:
    """Break lines between words where they are longer than the terminal is wide, but not for a file or pipe.

    Control characters become visible. A word that is longer by itself, such as
    a path, stays whole. Where `head` is what the text begins with, its lines go on behind it, as in `hanging`.
    """
    text = visible(as_typed(text))
    try:
        width = os.get_terminal_size(file.fileno()).columns
    except (OSError, ValueError):  # no terminal; nothing of the system
        return text
    if width == 0:  # a terminal that does not know
        return text
    fold = textwrap.TextWrapper(
        width,
        subsequent_indent=" " * len(head) if width - len(head) >= NARROWEST else "",
        break_long_words=False,
        break_on_hyphens=False,
        replace_whitespace=False,
    )
    return "\n".join(
        line if is_command(line.strip()) else fold.fill(line) + line[len(line.rstrip()) :]
        for line in text.split("\n")  # a prompt ends with a space
    )


def echo(text: str = "", *, bold: str = "", err: bool = False, nl: bool = True, fold: bool = True) -> None:
    """Print text on stdout, or stderr with `err`; `bold` is printed before it.

    A terminal gets whole words, and every reader commands that can be typed; with `fold=False` the text is data.
    """

    def shown(text: str) -> str:
        return in_whole_words(text, sys.stderr if err else sys.stdout) if fold else visible(text)

    head = click.style(shown(bold), bold=True) if bold else ""
    click.echo(head + shown(text), err=err, nl=nl)
