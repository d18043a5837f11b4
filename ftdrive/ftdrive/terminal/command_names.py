"""The commands, and how a user types them."""

import os
import re
from collections.abc import Mapping
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
    "report": "Report a calibration in one file: verdict, findings, figures.",
    "live": "Show the raw and the compensated wrench.",
    "weigh": "Weigh what the gripper holds, in half a second.",
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
}
"""A command, whose module is `ftdrive.commands.NAME`, and its line in the help."""
_COMMAND = re.compile(rf"(?<![\w./-])(?<!uv run )ftdrive (?=(?:{'|'.join(COMMANDS)})\b)")


def as_typed(text: str) -> str:
    """Return a message whose commands begin with `uv run` if this program was started so: nothing else would work."""
    return _COMMAND.sub("uv run ftdrive ", text) if "UV_RUN_RECURSION_DEPTH" in os.environ else text  # uv run sets it


def is_command(line: str) -> bool:
    """Whether a line is a command and nothing else; it is never broken, so that it can be copied."""
    return line.startswith(("ftdrive ", "uv run ftdrive "))
