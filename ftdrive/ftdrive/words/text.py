"""Texts that are safe on any terminal, and commands as they must be typed."""

import os
import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

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
    "report": "Write a report of a calibration: verdict, findings, figures.",
    "live": "Show the raw and the compensated wrench.",
    "weigh": "Weigh what the gripper holds, in half a second.",
    "loads": "Check the sensor with a known weight, or correct its matrix with several.",
    "push": "Set payload or gravity in the controller as calibrated.",
    "record": "Record raw and compensated wrench with pose and events.",
    "history": "List results and verifications, with their trends.",
    "fleet": "Watch many cells: what is due, what drifts, solve all again.",
    "diff": "Compare two calibrations, in sigmas.",
    "convert": "Convert a recording between MCAP, CSV and Parquet.",
    "compensate": "Compensate a recording. Needs no device.",
    "stream": "Serve the wrench to Foxglove, Lichtblick and PlotJuggler.",
    "serve-load": "Give weight and contact wrench to a UR program.",
    "ros2": "Publish the wrench as ROS 2 topics, with a tare service and diagnostics.",
    "replay": "Repeat a recorded run with the same routine and solver.",
    "bundle": "Write a run into one file for a bug report, without addresses.",
    "export": "Write a plan or a calibration for another program.",
    "transcript": "Record or play the bytes on a sensor's wire.",
    "completion": "Print the completion of a shell: bash, zsh or fish.",
}
"""Help line of each command, by the name of its module in `ftdrive.commands`."""
_COMMAND = re.compile(rf"(?<![\w./-])(?<!uv run )ftdrive (?=(?:{'|'.join(COMMANDS)}|help)\b|--)")
GLUE: Final = "\ue000"
"""A space at which lines are not broken in help or tables; a private-use character, so no message contains it."""


def as_typed(text: str) -> str:
    """Return a message whose commands begin with `uv run` if `uv run` has started this program."""
    return (
        _COMMAND.sub("uv run ftdrive ", text) if "UV_RUN_RECURSION_DEPTH" in os.environ else text
    )  # uv run sets this variable


def is_command(line: str) -> bool:
    """Whether a line is only a command; such a line is never broken, so that it can be copied."""
    return line.startswith(("ftdrive ", "uv run ftdrive "))


# Characters to escape: controls except tab and newline, changes of the writing direction, undecodable bytes.
_CONTROL = re.compile(
    "[\x00-\x08\x0b\x0c\x0e-\x1f\x7f-\x9f\u200e\u200f\u2028-\u202e\u2066-\u2069\ud800-\udfff]|\r(?!\n)"
)


def visible(text: str) -> str:
    r"""Return text with control characters escaped as in a Python string, such as `\x1b`.

    Examples
    --------
    >>> print(visible("gripper\x1b[2J"))
    gripper\x1b[2J
    """
    return _CONTROL.sub(lambda found: found[0].encode("unicode_escape", "surrogatepass").decode(), text)


def in_one_line(text: str) -> str:
    r"""Return text with newlines as `\n`, except before a command, so that a file's name cannot begin a line.

    Examples
    --------
    >>> print(in_one_line("there is no a\nerror: b; run\nftdrive devices"))
    there is no a\nerror: b; run
    ftdrive devices
    """
    first, *others = text.replace("\r", "\\r").split("\n")
    return first + "".join(("\n" if is_command(line) else "\\n") + line for line in others)


@dataclass(frozen=True, slots=True)
class TextLine:
    """A line of text with its style."""

    head: str
    """A mark or an indent before the text; wrapped lines continue below the first word after it."""
    words: str
    style: str = ""
    """Style in the notation of the package rich, such as "bold red", for a terminal with colour."""
