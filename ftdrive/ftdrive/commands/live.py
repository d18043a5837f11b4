"""`ftdrive live`: show raw and compensated wrench, ten times per second."""

import sys
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import click

from ftdrive.cell.emulated import Station
from ftdrive.checks.arm import check_weighed_payload
from ftdrive.checks.check import Check
from ftdrive.commands.options import (
    FRAME,
    JSON,
    PATH,
    POSITIVE,
    SOURCE,
    STAGES,
    TRACK,
    Headed,
    SourceOptions,
    ViewOptions,
    check_simulate,
    view_options,
)
from ftdrive.errors import ConfigError
from ftdrive.library import certifier_of
from ftdrive.recording.recorder import RawTable, Recorder
from ftdrive.recording.replay import open_replay
from ftdrive.stream.feed import Feed
from ftdrive.stream.samples import Tracking, WrenchFrame
from ftdrive.stream.sources import CellSource
from ftdrive.stream.stream import Sink, Stream
from ftdrive.terminal.console import answer, has_screen, messages
from ftdrive.terminal.live_panels import show_table
from ftdrive.terminal.live_screen import run_live
from ftdrive.terminal.text import echo
from ftdrive.view.live_page import LivePage
from ftdrive.view.page import drawing
from ftdrive.words.stream import StreamSummary

HEADINGS = {
    "The cell": "--config --robot --sensor --simulate --raw",
    "The calibration": "--calibration --tool --force",
    "The wrench": "--axes --about --stages --track",
    "A recording": "--replay --speed",
    "Output": "--once --plain --view --view-address --allow-control --json --help",
}


@click.command(cls=Headed, headings=HEADINGS)
@SOURCE
@TRACK
@click.option(
    "--raw",
    is_flag=True,
    help="Show the raw readings without robot and calibration; key t subtracts the mean, r saves a .csv.",
)
@click.option(
    "--replay",
    metavar="RUN|RECORDING",
    type=PATH,
    help="Show a run, a recording (with its own calibration), or a table of another program.",
)
@click.option("--speed", type=POSITIVE, help="Speed of --replay; 1 is real time.")
@FRAME
@STAGES
@click.option("--once", is_flag=True, help="Print one reading and exit.")
@click.option("--plain", is_flag=True, help="Show a table instead of the full screen; to a file, print lines.")
@click.option("--allow-control", is_flag=True, help="Let the page of --view tare and choose the frame.")
@view_options
@JSON
def live(
    source: SourceOptions,
    track: Tracking,
    raw: bool,
    replay: Path | None,
    speed: float | None,
    frame: WrenchFrame,
    stages: dict[str, Any],
    once: bool,
    plain: bool,
    allow_control: bool,
    view: ViewOptions,
    as_json: bool,
) -> None:
    """Show the raw and the compensated wrench, ten times per second.

    The compensated wrench is the contact wrench: measured minus bias and gravity, in the chosen axes and about the
    chosen point. The arm is only read, never moved. With --json, each line is one object. With --simulate, key f pushes
    the tool. --raw needs neither robot nor calibration.
    """
    check_simulate(source.simulate, real={"--replay": replay})
    if raw:
        chosen = {"--track": track != "off", "--axes": frame.axes != "sensor", "--about": frame.about != "sensor"}
        source.require_alone({"--replay": replay, **chosen, "--stages": stages, "--view": view.wanted})
    if speed is not None and replay is None:
        raise ConfigError("--speed is only for --replay: add --replay, or leave --speed out")
    if replay is not None and source.tool:
        raise ConfigError("--tool cannot be combined with --replay: leave one of the two out")
    view.require(once=once, allow_control=allow_control)
    prints = once or as_json or not sys.stdout.isatty() or answer.is_dumb_terminal
    full_screen = not (prints or plain) and has_screen()
    with ExitStack() as stack:
        checks = list[Check]()
        recorder: Callable[[Path], Sink] | None = None
        if replay is not None:
            stream = open_replay(replay, source.path, frame, speed=1.0 if speed is None else speed, force=source.force)
            stream.track = track
            stream.stages = replace(stream.stages, **stages)
        elif raw:
            cell = Station.of(None, source.described.sensor) if source.simulate else source.described.sensor_alone()
            stream = stack.enter_context(Stream(CellSource(cell, None)))
            messages.print(f" {stream.info.calibration_state}")
            recorder = partial(RawTable, info=stream.info)
        else:
            stream = source.open(stack, frame, track, stages)
            payload_kg, mass_kg = stream.devices.payload_kg, stream.cell.sensor.mass_kg
            checks = [check_weighed_payload(payload_kg, stream.info.calibration, mass_kg)]
            recorder = lambda path: Recorder([path], stream.info, stream.cell.to_dict())  # noqa: E731
        feed = Feed(stream, recorder)
        if source.simulate:  # wrench: N and N·m, sensor axes
            feed.push = partial(stream.station.control, do="push", wrench=[0.0, 0.0, -8.0, 0.0, 0.0, 0.0], seconds=1.0)
        title = "ftdrive live" if replay is None else f"ftdrive live, replay of {replay.name}"
        if (page := stack.enter_context(view.page(title))) is not None:
            certifier = certifier_of(stream, replay, messages.print)
            shown = LivePage(page, feed, checks, certifier, controls=allow_control)
            # on the full screen, errors of the page become notes, because it would hide printed messages
            say = partial(feed.note, kind="failed") if full_screen else messages.print
            stack.enter_context(drawing(page, shown.draw, say))
        if full_screen:
            run_live(feed, checks, "" if page is None else page.url)
        elif not prints:
            show_table(StreamSummary(feed, checks).views())
        else:
            for line in StreamSummary(feed).lines(once=once, as_json=as_json):
                (click.echo if as_json else echo)(line)
