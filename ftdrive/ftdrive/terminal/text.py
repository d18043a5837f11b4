"""Text before it reaches a screen: names that cannot command the terminal, commands as they are typed, and tables."""

import os
import re
import shutil
import sys
import textwrap
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from itertools import zip_longest
from textwrap import wrap
from typing import IO, Final

import click

COMMANDS: Final[Mapping[str, str]] = {
    "demo": "Calibrate an emulated cell: no hardware, 25 s.",
    "init": "Ask about the cell, probe it, write ftdrive.toml. Moves nothing.",
    "config": "Show the configuration and the source of each value.",
    "plan": "Plan a tour proven clear of collisions. Needs no robot.",
    "calibrate": "Drive the tour, average the sensor at each pose, solve.",
    "verify": "Compare fresh poses with a calibration's prediction.",
    "doctor": "Check robot, sensor and computer. Moves nothing.",
    "devices": "List serial ports and CAN interfaces.",
    "solve": "Solve a recorded run, a dataset or a CSV file.",
    "report": "Report a calibration in one file: verdict, findings, figures.",
    "live": "Show the raw and the compensated wrench.",
    "weigh": "Weigh what the gripper holds, in half a second.",
    "loads": "Check the sensor by a known weight, or correct its matrix by several.",
    "push": "Set payload or gravity in the controller as calibrated.",
    "record": "Record raw and compensated wrench with pose and events.",
    "history": "List results and verifications, with their trends.",
    "fleet": "Watch many cells: what is due, what drifts, solve all again.",
    "diff": "Compare two calibrations, in sigmas.",
    "convert": "Convert a recording between MCAP, CSV and Parquet.",
    "compensate": "Compensate a recording. Needs no device.",
    "stream": "Serve the wrench to Foxglove, Lichtblick and PlotJuggler.",
    "serve-load": "Give weight and contact wrench to a UR program.",
    "ros2": "Publish the wrench as topics of ROS 2, with tare service and diagnostics.",
    "replay": "Repeat a recorded run through the same routine and solver.",
    "bundle": "Write a run into one file for a bug report, without addresses.",
    "export": "Write a plan or a calibration for another program.",
    "transcript": "Record or play the bytes on a sensor's wire.",
    "completion": "Print the completion of a shell: bash, zsh or fish.",
}
"""A command, whose module is `ftdrive.commands.NAME`, and its line in the help."""
_COMMAND = re.compile(rf"(?<![\w./-])(?<!uv run )ftdrive (?=(?:{'|'.join(COMMANDS)}|help)\b|--)")


def as_typed(text: str) -> str:
    """Return a message whose commands begin with `uv run` if this program was started so: nothing else would work."""
    return _COMMAND.sub("uv run ftdrive ", text) if "UV_RUN_RECURSION_DEPTH" in os.environ else text  # uv run sets it


def is_command(line: str) -> bool:
    """Whether a line is a command and nothing else; it is never broken, so that it can be copied."""
    return line.startswith(("ftdrive ", "uv run ftdrive "))


# All but tab and the end of a line; with those that turn the direction of writing, and bytes that are no text.
_CONTROL = re.compile(
    "[\x00-\x08\x0b\x0c\x0e-\x1f\x7f-\x9f\u200e\u200f\u2028-\u202e\u2066-\u2069\ud800-\udfff]|\r(?!\n)"
)


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


GLUE: Final = "\ue000"
"""A space where no line of help or of a table ends: of private use, so no message has one."""
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
        yield _line(parts, widths)
    if row[beside:]:
        yield " " * len(GAP) + _line(row[beside:], widths[beside:])


def _line(row: Sequence[str], widths: Sequence[int]) -> str:
    return unglued(GAP.join(text.ljust(width) for text, width in zip(row, widths, strict=False)).rstrip())
