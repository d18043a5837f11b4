"""Text before it reaches a screen: names that cannot command the terminal, commands as they are typed, and tables."""

import os
import re
import shutil
import sys
import textwrap
from collections.abc import Collection, Iterator, Mapping, Sequence
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
        line if is_command(line.strip()) else fold.fill(line) + line[len(line.rstrip()) :]
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
    return GAP.join(text.ljust(width) for text, width in zip(row, widths, strict=False)).rstrip()
