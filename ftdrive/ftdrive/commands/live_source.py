"""The compensated stream of the cell that the options name, for the commands that have `SOURCE`."""

from collections.abc import Callable
from contextlib import ExitStack
from socket import gethostname

from ftdrive.cell.config import CellConfig
from ftdrive.cell.emulated import Station
from ftdrive.commands.common import Source, read_cell, store_url
from ftdrive.errors import ConfigError
from ftdrive.live.samples import Tracking, WrenchFrame
from ftdrive.live.stream import CompensatedStream
from ftdrive.runs.source import read_calibration
from ftdrive.runs.verification_record import EMULATED
from ftdrive.session.rehearsal import short_calibration, station_of
from ftdrive.store.weighing_log import WeighingLog
from ftdrive.terminal.console import messages
from ftdrive.terminal.screen import open_operator


def open_source(source: Source, frame: WrenchFrame, stack: ExitStack, track: Tracking = "off") -> CompensatedStream:
    """Open the stream of a real or an emulated cell; `stack` closes it.

    The state of the calibration and warnings are printed. Only an emulated cell needs no calibration: it is calibrated
    first.
    """
    path, tool, force, config, robot, sensor, simulate = source
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
    opened = CompensatedStream(cell, chosen, name=name, frame=frame, force=force)
    opened.track = track
    stream = stack.enter_context(opened)
    if tool is not None:
        messages.print(f" {tool}: {stream.info.calibration_name}")
    messages.print(f" {stream.info.calibration_state}")
    for words in stream.warnings:
        messages.print(f" {words}")
    return stream


def open_log(
    source: Source, stream: CompensatedStream, stack: ExitStack, say: Callable[[str], object]
) -> WeighingLog | None:
    """Keep the weighings of a stream until `stack` ends; None with a temporary calibration of an emulated cell.

    `say` takes a sentence for the operator, from any thread.
    """
    if source.simulate and source.path is None:
        return None
    info, cell = stream.info, stream.cell
    origin = {
        "tool": (info.calibration.provenance.get("setup") or {}).get("tool") or info.tool,
        "calibration_id": info.calibration.id,
        "arm_serial": info.arm.serial,
        "sensor_serial": info.sensor.serial,
        "robot_host": cell.robot.host,
        "emulated": EMULATED in info.marks,
        "computer": gethostname(),
    }
    log = WeighingLog(origin, store_url() if source.simulate else cell.store.url, say)
    stack.callback(log.close)
    return log
