"""The compensated stream of the cell that the options name, for the commands that have `SOURCE`."""

from collections.abc import Callable
from contextlib import ExitStack
from socket import gethostname

from ftcalib import CalibrationResult
from ftdrive.cell.config import CellConfig, cell_of
from ftdrive.cell.emulated import Station
from ftdrive.commands.common import Source, ViewOptions, store_url
from ftdrive.errors import ConfigError
from ftdrive.live.processing import SENSOR_FRAME
from ftdrive.live.raw import RawStream
from ftdrive.live.samples import Tracking, WrenchFrame
from ftdrive.live.stream import CompensatedStream
from ftdrive.runs.source import read_calibration
from ftdrive.runs.verification import EMULATED
from ftdrive.session.rehearsal import short_calibration, station_of
from ftdrive.store.weighing_log import WeighingLog
from ftdrive.terminal.console import messages
from ftdrive.terminal.screen import open_operator


def open_source(source: Source, frame: WrenchFrame, stack: ExitStack, track: Tracking = "off") -> CompensatedStream:
    """Open the stream of a real or an emulated cell; `stack` closes it.

    The state of the calibration and warnings are printed. Only an emulated cell needs no calibration: it is calibrated
    first.
    """
    calibration = None if source.path is None else read_calibration(source.path, accept_edited=source.force)
    cell = None
    if source.simulate:
        if calibration is None:
            with open_operator() as operator:
                calibration = short_calibration(operator, source.described.sensor)
    elif calibration is None and source.tool is None:
        raise no_calibration()
    else:
        cell = source.described.cell()
    opened = build_stream(source, cell, calibration, None if calibration is not None else source.tool, frame)
    opened.track = track
    stream = stack.enter_context(opened)
    if source.tool is not None:
        messages.print(f" {source.tool}: {stream.info.calibration_name}")
    messages.print(f" {stream.info.calibration_state}")
    for words in stream.warnings:
        messages.print(f" {words}")
    return stream


def open_raw(source: Source, stack: ExitStack) -> RawStream:
    """Open the sensor alone of a real or an emulated cell; `stack` closes it."""
    cell: CellConfig | Station
    if source.simulate:
        cell = Station.of(None, source.described.sensor)
    else:
        cell = cell_of(source.described.settings(), devices=False)
        if not cell.sensor.url:
            raise ConfigError("no sensor: give --sensor URL, or --simulate; `ftdrive devices --probe PLACE` finds one")
    stream = stack.enter_context(RawStream(cell))
    messages.print(f" {stream.info.calibration_state}")
    return stream


def build_stream(
    source: Source,
    cell: CellConfig | None,
    calibration: CalibrationResult | None,
    tool: str | None,
    frame: WrenchFrame = SENSOR_FRAME,
) -> CompensatedStream:
    """Return the stream of a cell, not open yet, or without a cell that of an emulated one; a tool goes first.

    Raises `ConfigError` without a calibration and without the name of a tool.
    """
    chosen = tool or calibration
    # an emulated cell ends with its stream, so each stream has one of its own
    place = station_of(calibration, source.described.sensor) if cell is None and calibration is not None else cell
    if chosen is None or place is None:
        raise no_calibration()
    name = "temporary calibration" if source.path is None else str(source.path)
    return CompensatedStream(place, chosen, name=name, frame=frame, force=source.force)


def check_view(view: ViewOptions, *, once: bool, allow_control: bool) -> None:
    """Raise `ConfigError` for options of a page that would be ignored."""
    if once and view.wanted:
        raise ConfigError("--view does not go with --once: leave one of the two out")
    if allow_control and not view.wanted:
        raise ConfigError("--allow-control goes only with --view: add it, or leave --allow-control out")


def no_calibration() -> ConfigError:
    """Return the error of a command that has neither a calibration nor the name of a tool."""
    return ConfigError(
        "no calibration: give --calibration PATH or --tool NAME, or --simulate; `ftdrive history` lists calibrations, "
        "`ftdrive live --raw` needs none"
    )


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
