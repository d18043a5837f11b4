"""`ftdrive live`: raw and compensated wrench, ten times a second."""

import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, nullcontext
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import click
import numpy as np
from rich.console import Group
from rich.live import Live
from rich.table import Table
from rich.text import Text

from ftdrive.checks.check import Check
from ftdrive.checks.devices import AXES, check_weighed_payload
from ftdrive.commands.common import (
    CALIBRATION_OR_TOOL,
    CELL,
    FRAME,
    JSON,
    Number,
    check_simulate,
    read_frame,
    simulate,
    write_json,
)
from ftdrive.commands.live_source import RECOVER_S, open_source
from ftdrive.errors import ConfigError
from ftdrive.live.frames import FrameTransform
from ftdrive.live.processing import ProcessedStream
from ftdrive.live.replay import ReplayedStream, replay_run
from ftdrive.live.samples import Axes, Block, StreamInfo, WrenchFrame
from ftdrive.live.stream import CompensatedStream
from ftdrive.recording import Recorder, read_recording
from ftdrive.runs.run import Run
from ftdrive.runs.source import read_calibration
from ftdrive.terminal.console import talk
from ftdrive.terminal.keyboard import Keyboard
from ftdrivers.errors import DeviceError
from ftdrivers.interfaces import Array

_PERIOD_S = 0.1


@click.command()
@CALIBRATION_OR_TOOL
@CELL
@simulate("Use the emulated cell of the calibration, or one with --sensor emulated://NAME.")
@click.option(
    "--replay",
    metavar="RUN|RECORDING",
    type=click.Path(exists=True, path_type=Path),
    help="Show the samples of a run, or of a recording, which has a calibration.",
)
@click.option("--speed", type=Number(0, min_open=True), help="Of --replay; 1 is that of the recording.")
@FRAME
@click.option("--once", is_flag=True, help="Print one reading, then end.")
@click.option("--plain", is_flag=True, help="Show a table instead of the full screen.")
@JSON
def live(
    path: Path | None,
    tool: str | None,
    force: bool,
    config: Path | None,
    robot: str | None,
    sensor: str | None,
    simulate: bool,
    replay: Path | None,
    speed: float | None,
    axes: Axes,
    about: str,
    once: bool,
    plain: bool,
    as_json: bool,
) -> None:
    """Show the raw and the compensated wrench, refreshed ten times a second.

    The compensated wrench is the contact wrench: measured minus bias and gravity, along the chosen axes and about the
    chosen point. The arm is only read, never moved. With --json, one object per line.
    """
    check_simulate(simulate, real={"--config": config, "--robot": robot, "--replay": replay})
    if speed is not None and replay is None:
        raise ConfigError("--speed goes only with --replay: add it, or leave --speed out")
    if replay is not None and tool:
        raise ConfigError("--tool does not go with --replay: leave one of the two out")
    frame = read_frame(axes, about)
    with ExitStack() as stack:
        stream: CompensatedStream | ReplayedStream
        checks = list[Check]()
        recorder: Callable[[Path], Recorder] | None = None
        if replay is not None:
            stream = _replayed(replay, path, frame, speed=1.0 if speed is None else speed, force=force)
        else:
            stream = open_source(
                path, tool, config, robot, sensor, force=force, simulate=simulate, frame=frame, stack=stack
            )
            checks = [check_weighed_payload(stream.payload_kg, stream.info.calibration, stream.cell.sensor.mass_kg)]
            recorder = partial(_recorder, stream.info, stream.cell.to_dict())
        if once or as_json:
            _print(stream, once=once, as_json=as_json)
        elif talk.is_terminal and sys.stdout.isatty() and sys.stdin.isatty() and not plain:
            from ftdrive.terminal.live_screen import run_live

            run_live(stream, recorder=recorder, checks=checks)
        else:
            _show_table(stream)


def _replayed(path: Path, calibration: Path | None, frame: WrenchFrame, *, speed: float, force: bool) -> ReplayedStream:
    """Replay a run folder, or a recording with its own calibration unless another one is given."""
    loaded = None if calibration is None else read_calibration(calibration, accept_edited=force)
    if path.is_dir() and path.suffix != ".partial":
        if loaded is None:
            raise ConfigError("no calibration: give --calibration PATH")
        return replay_run(Run(path), loaded, str(calibration), frame=frame, speed=speed)
    recording = read_recording(path)
    if loaded is not None:
        recording = recording.with_calibration(loaded, str(calibration))
    return ReplayedStream(recording.header.info, recording.paired(), frame=frame, speed=speed)


def _recorder(info: StreamInfo, configuration: dict[str, Any], path: Path) -> Recorder:
    return Recorder([path], info, configuration)


def _print(stream: CompensatedStream | ReplayedStream, *, once: bool, as_json: bool) -> None:
    for look in _looks(stream, raises=once):
        reading = _reading(look, stream)
        if as_json:
            write_json(reading)
        else:
            click.echo(_line(reading, stream.frame))
        if once:
            break


def _show_table(stream: CompensatedStream | ReplayedStream) -> None:
    shown = Group()
    with (
        Keyboard(0) if Keyboard.usable(0) else nullcontext(),  # Enter would break the screen
        Live(console=talk, refresh_per_second=10) as screen,
    ):
        for look in _looks(stream):
            made = f"{stream.info.calibration_name}: {stream.info.calibration_state or stream.info.calibration.verdict}"
            shown = _screen(_reading(look, stream), stream.frame, made)
            screen.update(Group(shown, "Ctrl-C ends"))
        screen.update(Group(shown, "The recording has ended."))


@dataclass(frozen=True, slots=True, eq=False)
class Look:
    """The mean over about `_PERIOD_S`."""

    t_s: float
    R_base_flange: Array
    raw: Array
    wrench: Array
    sigma: Array
    chi2: float
    in_contact: bool
    stale: str = ""
    """Why there is no newer one."""


def _looks(stream: CompensatedStream | ReplayedStream, *, raises: bool = False) -> Iterator[Look]:
    """Yield a mean for each period from when the noise is known; raise a failure at once or when it lasts."""
    blocks: list[Block] = []
    look: Look | None = None
    failing_since_s: float | None = None
    ended = False
    while not ended:
        try:
            block = stream.read()
        except DeviceError as error:
            now_s = stream.clock.now_s()
            failing_since_s = now_s if failing_since_s is None else failing_since_s
            if raises or look is None or now_s - failing_since_s > RECOVER_S:
                raise
            blocks.clear()
            yield replace(look, stale=str(error))
            continue
        failing_since_s = None
        ended = isinstance(stream, ReplayedStream) and stream.has_ended
        if len(block):
            blocks.append(block)
        if not blocks:
            continue
        span_s = (blocks[-1].t_host_ns[-1] - blocks[0].t_host_ns[0]) * 1e-9
        if span_s >= _PERIOD_S - 0.5 / stream.info.sensor_rate_Hz or (ended and look is None):
            if np.isfinite(block.sigma).all() or isinstance(stream, ReplayedStream):
                look = _look(blocks, stream, span_s)
                yield look
            blocks.clear()


def _look(blocks: Sequence[Block], stream: ProcessedStream, span_s: float) -> Look:
    newest, frame = blocks[-1], blocks[-1].frame
    alike = [block for block in blocks if block.frame == frame and block.stages == newest.stages]
    to_frame = FrameTransform(frame, stream.info)
    raw = np.concatenate([to_frame(block.raw, block.R_base_flange) for block in alike])
    return Look(
        t_s=newest.t_host_ns[-1] * 1e-9,
        R_base_flange=newest.R_base_flange[-1],
        raw=raw.mean(axis=0),
        wrench=np.concatenate([block.wrench for block in alike]).mean(axis=0),
        sigma=stream.sigma_of_mean(newest.R_base_flange[-1], span_s),
        chi2=float(newest.chi2[-1]),
        in_contact=bool(newest.in_contact[-1]),
    )


def _reading(look: Look, stream: ProcessedStream) -> dict[str, Any]:
    status, frame, calibration = stream.status(), stream.frame, stream.info.calibration
    verification = stream.info.verification

    def wrench(values: Array) -> dict[str, Any] | None:
        if look.stale:
            return None
        numbers = [float(value) if np.isfinite(value) else None for value in values]
        return {"force_N": numbers[:3], "torque_Nm": numbers[3:]}

    return {
        "schema_version": 1,
        "t_s": look.t_s,
        "axes": frame.axes,
        "about": "sensor origin" if frame.about == "sensor" else frame.about,
        "raw": wrench(look.raw),
        "compensated": wrench(look.wrench),
        "sigma": wrench(look.sigma),
        "contact": None if look.stale else look.in_contact,
        "stale": look.stale or None,
        "delay_s": {"value": status.delay_s, "sigma": status.delay_sigma_s},
        "rate_Hz": status.sensor.rate_Hz,
        "lost": status.sensor.lost,
        "calibration": calibration.provenance.get("created_utc"),
        "calibration_id": calibration.id,
        "verdict": calibration.verdict,
        "marks": list(stream.info.marks),
        "verification": None if verification is None else verification.to_dict(),
    }


def _line(reading: dict[str, Any], frame: WrenchFrame) -> str:
    contact = reading["compensated"]
    if contact is None:
        return f"stale: {reading['stale']}"
    force, torque = (
        " ".join(f"{value:9.{n}f}" for value in contact[key]) for key, n in (("force_N", 3), ("torque_Nm", 5))
    )
    return f"F {force} N   T {torque} N·m   ({frame})"


def _screen(reading: dict[str, Any], frame: WrenchFrame, made: str) -> Group:
    table = Table(box=None)
    for title, width in (("", 2), ("raw", 9), ("contact", 13), ("± 1 sigma", 9), ("", 20)):
        table.add_column(title, justify="right", min_width=width, no_wrap=True)  # else they move with every sign
    columns = [_six(reading[key]) for key in ("raw", "compensated", "sigma")]
    for i, name in enumerate(AXES):
        raw, contact, sigma = (column[i] for column in columns)
        unit, full, digits = ("N", 20.0, 3) if i < 3 else ("N·m", 2.0, 5)
        filled = 0 if contact is None else min(20, round(20 * abs(contact) / full))
        bar = Text.assemble(("█" * filled, "red" if contact and contact < 0 else "green"), "·" * (20 - filled))
        shown = [_digits(value, digits) for value in (raw, contact, sigma)]
        table.add_row(name, shown[0], f"{shown[1]} {unit}", shown[2], bar)
    delay, state = reading["delay_s"], "CONTACT" if reading["contact"] else "free"
    return Group(
        Text.assemble((str(frame), "bold"), "   contact: raw minus bias and gravity"),
        made,
        f"mean of {_PERIOD_S} s   {reading['rate_Hz']:.0f} Hz, lost {reading['lost']}",
        Text(f"{reading['stale']}", "red")
        if reading["stale"]
        else f"{state}   delay {1e3 * delay['value']:.1f} ± {1e3 * delay['sigma']:.1f} ms (1 sigma)",
        table,
    )


def _six(wrench: dict[str, Any] | None) -> list[float | None]:
    return [None] * 6 if wrench is None else [*wrench["force_N"], *wrench["torque_Nm"]]


def _digits(value: float | None, digits: int) -> str:
    return "--.--" if value is None else f"{value:.{digits}f}"
