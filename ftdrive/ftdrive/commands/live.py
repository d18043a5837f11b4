"""`ftdrive live`: raw and compensated wrench, ten times a second."""

import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, nullcontext
from dataclasses import replace
from functools import partial
from pathlib import Path
from shlex import quote
from typing import Any

import click
import numpy as np
from rich.console import Group
from rich.live import Live

from ftcalib.errors import FtdriveError
from ftdrive.cell.config import CellConfig, read_recorded, recorded_cell
from ftdrive.checks.arm import check_weighed_payload
from ftdrive.checks.check import Check
from ftdrive.commands.common import (
    FRAME,
    JSON,
    SOURCE,
    TRACK,
    Number,
    Source,
    ViewOptions,
    check_simulate,
    read_frame,
    view_options,
    write_json,
)
from ftdrive.commands.live_source import check_view, open_raw, open_source
from ftdrive.errors import ConfigError
from ftdrive.live.replay import ReplayedStream, replay_run
from ftdrive.live.samples import Axes, Paired, Sink, StreamInfo, Tracking, WrenchFrame
from ftdrive.live.stream import RECOVER_S, CompensatedStream
from ftdrive.planning.geometry.certify import Certifier
from ftdrive.planning.planner import certifier_for
from ftdrive.recording import Recorder, RecordingReader, read_recording
from ftdrive.recording.foreign import tables_of
from ftdrive.recording.raw_table import RawTable
from ftdrive.recording.recording import with_calibration
from ftdrive.recording.table_pair import TablePair
from ftdrive.runs.run import Run
from ftdrive.runs.source import SolveOptions, read_calibration
from ftdrive.terminal.console import answer, has_screen, messages
from ftdrive.terminal.keyboard import Keyboard
from ftdrive.terminal.lines import BAD
from ftdrive.terminal.live_feed import MEAN_S, Feed
from ftdrive.terminal.live_panels import plain as plain_lines
from ftdrive.terminal.live_view import Summary, View
from ftdrive.terminal.text import echo
from ftdrivers.interfaces import Array

# N and N·m, sensor axes, on the tool of an emulated cell.
_PUSH = [0.0, 0.0, -8.0, 0.0, 0.0, 0.0]


@click.command()
@SOURCE
@TRACK
@click.option(
    "--raw",
    is_flag=True,
    help="Show the readings of the sensor alone: no robot and no calibration; t subtracts, r saves a .csv.",
)
@click.option(
    "--replay",
    metavar="RUN|RECORDING",
    type=click.Path(exists=True, path_type=Path),
    help="Show the samples of a run, of a recording, which has a calibration, or of a table of any program.",
)
@click.option("--speed", type=Number(0, min_open=True), help="Speed of --replay; 1 is the speed of the recording.")
@FRAME
@click.option("--once", is_flag=True, help="Print one reading, then end.")
@click.option("--plain", is_flag=True, help="Show a table instead of the full screen; lines in a file.")
@click.option("--allow-control", is_flag=True, help="With --view: the page may tare and choose the frame.")
@view_options
@JSON
def live(
    source: Source,
    track: Tracking,
    raw: bool,
    replay: Path | None,
    speed: float | None,
    axes: Axes,
    about: str,
    once: bool,
    plain: bool,
    allow_control: bool,
    view: ViewOptions,
    as_json: bool,
) -> None:
    """Show the raw and the compensated wrench, refreshed ten times a second.

    The compensated wrench is the contact wrench: measured minus bias and gravity, along the chosen axes and about the
    chosen point. The arm is only read, never moved. With --json, one object per line. With --simulate, the key f pushes
    the tool. With --raw, a sensor needs neither robot nor calibration.
    """
    check_simulate(source.simulate, real={"--replay": replay})
    if raw:
        _require_sensor_alone(source, track, replay, axes, about, view)
    if speed is not None and replay is None:
        raise ConfigError("--speed goes only with --replay: add it, or leave --speed out")
    if replay is not None and source.tool:
        raise ConfigError("--tool does not go with --replay: leave one of the two out")
    check_view(view, once=once, allow_control=allow_control)
    view.require()
    frame = read_frame(axes, about)
    prints = once or as_json or not sys.stdout.isatty() or answer.is_dumb_terminal
    full_screen = not (prints or plain) and has_screen()
    with ExitStack() as stack:
        stream: CompensatedStream | ReplayedStream
        checks = list[Check]()
        recorder: Callable[[Path], Sink] | None = None
        push: Callable[[], object] | None = None
        if replay is not None:
            stream = replayed(replay, source.path, frame, speed=1.0 if speed is None else speed, force=source.force)
            stream.track = track
        else:
            if raw:
                stream = open_raw(source, stack)
                recorder = partial(RawTable, info=stream.info)
            else:
                stream = open_source(source, frame, stack, track)
                checks = [check_weighed_payload(stream.payload_kg, stream.info.calibration, stream.cell.sensor.mass_kg)]
                recorder = partial(_recorder, stream.info, stream.cell.to_dict())
            if source.simulate:
                push = partial(stream.station.control, do="push", wrench=_PUSH, seconds=1.0)
        feed = Feed(stream, recorder, push)
        title = "ftdrive live" if replay is None else f"ftdrive live, replay of {replay.name}"
        if (page := stack.enter_context(view.page(title))) is not None:
            from ftdrive.view.live_page import LivePage
            from ftdrive.view.page import drawing

            cell = stream.cell if isinstance(stream, CompensatedStream) else _recorded_cell(replay or Path())
            certifier = None if cell is None else _certifier(cell, stream.info.arm.model)
            shown = LivePage(page, feed, checks, certifier, controls=allow_control)
            # the full screen hides what is printed
            say = partial(feed.note, style=BAD) if full_screen else messages.print
            stack.enter_context(drawing(page, shown.draw, say))
        if prints:
            _print(feed, once=once, as_json=as_json)
        elif not full_screen:
            _show_table(feed, checks)
        else:
            from ftdrive.terminal.live_screen import run_live

            run_live(feed, checks, "" if page is None else page.url)


def replayed(path: Path, calibration: Path | None, frame: WrenchFrame, *, speed: float, force: bool) -> ReplayedStream:
    """Replay a run folder, a recording with its own calibration unless another one is given, or another program's."""
    loaded = None if calibration is None else read_calibration(calibration, accept_edited=force)
    if _is_run(path):
        if loaded is None:
            own = quote(str(path)) if Run(path).calibration_path.is_file() else "PATH"
            raise ConfigError(f"no calibration: give --calibration {own}")
        return replay_run(Run(path), loaded, str(calibration), frame=frame, speed=speed)
    if (tables := tables_of(path, SolveOptions())) is not None:
        if loaded is None:
            raise ConfigError("no calibration: give --calibration PATH")
        pair = TablePair(*tables, loaded, str(calibration), None)
        rows = Paired.concatenate([block.samples for block in pair.blocks()])
        return ReplayedStream(pair.header.info, rows, frame=frame, speed=speed)
    recording = read_recording(path)
    if loaded is not None:
        recording = replace(recording, header=with_calibration(recording.header, loaded, str(calibration)))
    return ReplayedStream(recording.header.info, recording.paired(), frame=frame, speed=speed)


def _is_run(path: Path) -> bool:
    return path.is_dir() and path.suffix != ".partial"


def _recorded_cell(path: Path) -> CellConfig | None:
    try:
        if _is_run(path):
            return recorded_cell(Run(path).header()["config"])
        return recorded_cell(read_recorded(RecordingReader(path).header.configuration))
    except (FtdriveError, KeyError, TypeError):  # such as a table of another program
        return None


def _certifier(cell: CellConfig, model: str) -> Certifier | None:
    """Describe arm and tool of a cell; None where it does not describe them."""
    try:
        return certifier_for(cell, model)
    except ConfigError as error:
        messages.print(f" The page shows no arm: {error}")
        return None


def _recorder(info: StreamInfo, configuration: dict[str, Any], path: Path) -> Recorder:
    return Recorder([path], info, configuration)


def _require_sensor_alone(
    source: Source, track: Tracking, replay: Path | None, axes: Axes, about: str, view: ViewOptions
) -> None:
    """Raise `ConfigError` for options that need an arm or a calibration."""
    options = {
        "--calibration": source.path,
        "--tool": source.tool,
        "--robot": source.described.robot,
        "--replay": replay,
        "--track": track != "off",
        "--axes": axes != "sensor",
        "--about": about != "sensor",
        "--view": view.wanted,
    }
    if given := [option for option, value in options.items() if value]:
        raise ConfigError(f"{given[0]} does not go with --raw, which shows a sensor alone: leave one of the two out")


def _print(feed: Feed, *, once: bool = False, as_json: bool = False) -> None:
    for view in _views(feed, raises=once):
        reading = _reading(view)
        if as_json:
            write_json(reading)
        elif once:
            echo(_line(reading, feed.stream.frame))
        else:
            contact = "   contact" if reading["contact"] else ""
            echo(f"{reading['t_s']:.1f} s   {_line(reading, feed.stream.frame)}{contact}")
        if once:
            break


def _show_table(feed: Feed, checks: Sequence[Check]) -> None:
    shown = Group()
    with (
        # Enter would break the screen
        Keyboard(0) if Keyboard.usable(0) else nullcontext(),
        Live(console=answer, refresh_per_second=10) as screen,
    ):
        for view in _views(feed, checks):
            shown = Group(*(line.as_text() for line in plain_lines(view, answer.width)))
            screen.update(Group(shown, "Ctrl-C ends"))
        screen.update(Group(shown, "The recording has ended."))


def _views(feed: Feed, checks: Sequence[Check] = (), *, raises: bool = False) -> Iterator[View]:
    """Yield the state each `MEAN_S` from when the noise is known; raise a failure at once or when it lasts."""
    stream = feed.stream
    summary = Summary(feed, checks)
    begin_ns: int | None = None
    is_known, ended = False, False
    while not ended:
        feed.reader.patience_s = RECOVER_S if is_known and not raises else 0.0
        feed.step()
        if feed.reader.failure is not None:
            yield summary.view()
            continue
        ended = isinstance(stream, ReplayedStream) and stream.has_ended
        if feed.newest_ns is None:
            continue
        begin_ns = feed.newest_ns if begin_ns is None else begin_ns
        if (feed.newest_ns - begin_ns) * 1e-9 >= MEAN_S - 0.5 / stream.info.sensor_rate_Hz or (ended and not is_known):
            begin_ns = feed.newest_ns
            is_known = bool(np.isfinite(feed.sigma).all()) or isinstance(stream, ReplayedStream)
            view = summary.view()
            if is_known:
                yield view


def _reading(view: View) -> dict[str, Any]:
    status, calibration, verification = view.status, view.info.calibration, view.info.verification
    reading, is_raw = view.reading, view.info.is_raw
    assert reading is not None  # noqa: S101 - a view is shown from the first reading on

    def wrench(values: Array) -> dict[str, Any] | None:
        if view.silent:
            return None
        numbers = [float(value) if np.isfinite(value) else None for value in values]
        return {"force_N": numbers[:3], "torque_Nm": numbers[3:]}

    return {
        "schema_version": 1,
        "t_s": reading.t_host_ns * 1e-9,
        "axes": reading.frame.axes,
        "about": "sensor origin" if reading.frame.about == "sensor" else reading.frame.about,
        "raw": wrench(reading.raw_in_frame),
        "compensated": None if is_raw else wrench(reading.wrench),
        "sigma": wrench(reading.sigma),
        "sigma_at_rest": wrench(reading.rest_sigma),
        "contact": None if view.silent or is_raw else reading.in_contact,
        "stale": view.silent or None,
        "delay_s": None if is_raw else {"value": status.delay_s, "sigma": status.delay_sigma_s},
        "rate_Hz": status.sensor.rate_Hz,
        "lost": status.sensor.lost,
        "calibration": calibration.provenance.get("created_utc"),
        "calibration_id": None if is_raw else calibration.id,
        "verdict": None if is_raw else calibration.verdict,
        "marks": list(view.info.marks),
        "tracked": None if status.tracked is None else status.tracked.to_dict(),
        "verification": None if verification is None else verification.to_dict(),
    }


def _line(reading: dict[str, Any], frame: WrenchFrame) -> str:
    contact = reading["compensated"] or reading["raw"]
    if contact is None:
        return f"stale: {reading['stale']}"
    force, torque = (
        " ".join(f"{value:9.{n}f}" for value in contact[key]) for key, n in (("force_N", 3), ("torque_Nm", 5))
    )
    return f"F {force} N   T {torque} N·m   ({frame})"
