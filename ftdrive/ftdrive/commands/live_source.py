"""The compensated stream of the cell that the options name, for `live`, `record` and `stream`."""

from contextlib import ExitStack
from pathlib import Path

from ftdrive.cell.config import CellConfig
from ftdrive.cell.emulated import Station
from ftdrive.commands.common import check_simulate, read_cell
from ftdrive.errors import ConfigError
from ftdrive.live.samples import WrenchFrame
from ftdrive.live.stream import CompensatedStream
from ftdrive.runs.source import read_calibration
from ftdrive.session.rehearsal import short_calibration, station_of
from ftdrive.terminal.console import messages
from ftdrive.terminal.screen import open_operator

RECOVER_S = 10.0
"""So long a stream with an interruption may take to deliver again; then the command ends."""


def open_source(
    path: Path | None,
    tool: str | None,
    config: Path | None,
    robot: str | None,
    sensor: str | None,
    *,
    force: bool,
    simulate: bool,
    frame: WrenchFrame,
    stack: ExitStack,
) -> CompensatedStream:
    """Open the stream of a real or an emulated cell; `stack` closes it.

    The state of the calibration and warnings are printed.

    Parameters
    ----------
    path : Path, optional
        A calibration.json or its run folder. Only an emulated cell needs none: it is calibrated first.
    tool : str, optional
        Instead of `path`, on a real cell: the newest accepted calibration of this tool.
    config, robot, sensor
        As `read_cell` takes them.
    force : bool
        Apply a calibration of another arm, sensor or mount, or one that was edited by hand.
    """
    check_simulate(simulate, real={"--tool": tool})
    if path is not None and tool is not None:
        raise ConfigError("--calibration and --tool exclude one another: leave one of them out")
    calibration = None if path is None else read_calibration(path, accept_edited=force)
    cell: CellConfig | Station
    if simulate:
        if calibration is None:
            with open_operator() as operator:
                calibration = short_calibration(operator, sensor)
        cell = station_of(calibration, sensor)
    elif calibration is None and tool is None:
        raise ConfigError("no calibration: give --calibration PATH or --tool NAME, or --simulate")
    else:
        cell = read_cell(config, robot, sensor)
    chosen = calibration if calibration is not None else str(tool)
    name = "temporary calibration" if path is None else str(path)
    stream = stack.enter_context(CompensatedStream(cell, chosen, name=name, frame=frame, force=force))
    if tool is not None:
        messages.print(f" {tool}: {stream.info.calibration_name}")
    messages.print(f" {stream.info.calibration_state}")
    for words in stream.warnings:
        messages.print(f" {words}")
    return stream
