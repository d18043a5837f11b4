"""The compensated stream of the cell that the options name, for `live`, `record` and `stream`."""

from contextlib import ExitStack
from pathlib import Path
from tempfile import TemporaryDirectory

from ftcalib import CalibrationResult
from ftdrive.cell.config import CellConfig
from ftdrive.cell.emulated import Station, sensor_name
from ftdrive.commands.common import check_simulate, read_cell, stop_unless_accepted
from ftdrive.commands.emulated_run import rehearse
from ftdrive.errors import ConfigError
from ftdrive.live.samples import WrenchFrame
from ftdrive.live.stream import CompensatedStream, load_calibration
from ftdrive.terminal.console import talk

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
) -> tuple[CompensatedStream, CellConfig]:
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
        Apply a calibration of another arm, sensor or mount.
    """
    check_simulate(simulate, real={"--tool": tool})
    if path is not None and tool is not None:
        raise ConfigError("--calibration and --tool exclude one another: leave one of them out")
    calibration = None if path is None else load_calibration(path)
    if simulate:
        calibration, cell = _emulated(calibration, sensor, stack)
    elif calibration is None and tool is None:
        raise ConfigError("no calibration: give --calibration PATH or --tool NAME, or --simulate")
    else:
        cell = read_cell(config, robot, sensor)
    chosen = calibration if calibration is not None else str(tool)
    name = "temporary calibration" if path is None else str(path)
    stream = stack.enter_context(CompensatedStream(cell, chosen, name=name, frame=frame, force=force))
    if tool is not None:
        talk.print(f" {tool}: {stream.info.calibration_name}")
    talk.print(f" {stream.info.calibration_state}")
    for words in stream.warnings:
        talk.print(f" {words}")
    return stream, cell


def _emulated(
    calibration: CalibrationResult | None, sensor: str | None, stack: ExitStack
) -> tuple[CalibrationResult, CellConfig]:
    """Start the cell of a calibration, or calibrate a new one with six poses."""
    if calibration is None:
        with Station(sensor_name(sensor)) as quick, TemporaryDirectory(prefix="ftdrive-") as runs:
            calibration = rehearse(quick, Path(runs), "simulated", poses=6, kept=False).result
        stop_unless_accepted(calibration)
    made_by = calibration.provenance.get("station")
    pace = ("--time-scale", "1")  # a stream pairs by the controller's clock
    return calibration, stack.enter_context(Station.of(made_by, sensor, pace)).cell
