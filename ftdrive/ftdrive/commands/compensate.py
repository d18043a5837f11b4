"""`ftdrive compensate`: compensate a recording without a device."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import click

from ftcalib.rounding import with_sigma
from ftdrive.cell.units import parse_numbers
from ftdrive.commands.options import BAG_TOPICS, FILE, FORCE, FRAME, JSON, PATH, TABLE, NewFile, write_json
from ftdrive.errors import ConfigError
from ftdrive.recording.compensation import compensate_recording, source_to_compensate
from ftdrive.recording.files import format_of
from ftdrive.recording.foreign import is_bag
from ftdrive.runs.calibration import MARKS, read_calibration
from ftdrive.runs.source import SolveOptions
from ftdrive.stream.samples import WrenchFrame
from ftdrive.tables.table import TableOptions
from ftdrive.terminal.console import message_console, messages, working
from ftdrive.terminal.text import echo


@click.command()
@click.argument("path", metavar="[RECORDING]", required=False, type=PATH)
@click.option("--calibration", metavar="PATH", type=PATH, help="Calibration: a calibration.json or its run folder.")
@click.option("--wrench", metavar="FILE", type=FILE, help="Table of the wrench, instead of RECORDING.")
@click.option("--orientation-file", metavar="FILE", type=FILE, help="Table of the flange poses, with --wrench.")
@BAG_TOPICS
@TABLE
@click.option("--delay", metavar="S|auto", help="Delay of the wrench recorded by another program, s.  [default: auto]")
@FORCE
@click.option(
    "--bias",
    type=click.Choice(["keep", "estimate"]),
    default="keep",
    show_default=True,
    help="Keep the calibration's bias, or estimate it from the recording, for sensors zeroed at the start.",
)
@FRAME
@click.option("-o", "--output", type=NewFile(), help="Save the result as a new .mcap, .csv or .parquet.")
@JSON
def compensate(
    path: Path | None,
    calibration: Path | None,
    wrench: Path | None,
    orientation_file: Path | None,
    wrench_topic: str | None,
    pose_topic: str | None,
    table: TableOptions | None,
    delay: str | None,
    force: bool,
    bias: str,
    frame: WrenchFrame,
    output: Path | None,
    as_json: bool,
) -> None:
    """Compensate a whole recording with a calibration; no device is needed.

    RECORDING is a file of `ftdrive record`, compensated with its own calibration by default. Recordings of other
    programs: a table with wrench and orientation, two tables on one clock (--wrench, --orientation-file), possibly with
    different rates, or a ROS 1 or ROS 2 bag. Use --columns and the options below it for what a table does not contain.
    """
    if output is not None:
        format_of(output)
    if path is not None and (wrench is not None or orientation_file is not None):
        raise ConfigError("RECORDING cannot be combined with --wrench and --orientation-file: leave one of the two out")
    if path is None and (wrench is None or orientation_file is None):
        raise ConfigError(_missing_input(wrench, orientation_file, calibration))
    if (wrench_topic or pose_topic) and not (path and is_bag(path)):
        raise ConfigError("--wrench-topic and --pose-topic are only for a ROS bag: leave them out")
    loaded = None if calibration is None else read_calibration(calibration, accept_edited=force)
    pair = None if wrench is None or orientation_file is None else (wrench, orientation_file)
    delay_s = delay if delay is None or delay == "auto" else parse_numbers("--delay", delay, ",", [1])[0]
    options = SolveOptions(pair=pair, topics=(wrench_topic, pose_topic), table=table)
    what = path or wrench or Path()
    with working("Reading") as show:
        source, found = source_to_compensate(
            what, options, loaded, str(calibration), delay_s, everything=output is not None, say=messages.print
        )
        found_numbers, failure = compensate_recording(
            source, frame, output, estimate_bias=bias == "estimate", show=show
        )
    result = {
        **found_numbers,
        "delay_s": found or found_numbers["delay_s"],
        "file": None if output is None else str(output),
    }
    if result["cut"]:
        messages.print(f" {what} is incomplete ({result['cut']}): {result['duration_s']:.1f} s are used.")
    if as_json:
        write_json({"schema_version": 1, **result})
    else:
        echo("\n".join(_result_lines(result, str(frame))))
    if output is not None:
        short = "" if failure is None else f": the first {result['samples']} samples"
        message_console(as_json).print(f" Saved {output}{short}")
    if failure is not None:
        raise failure


def _missing_input(wrench: Path | None, orientation_file: Path | None, calibration: Path | None) -> str:
    if wrench is None and orientation_file is None:
        own = "" if calibration is None else f" --calibration {calibration}"
        missing, line = "the file of the recording", f"RECORDING{own}"
        if calibration is None:
            missing += ", and --calibration PATH if another program recorded it"
    else:
        given = {"--wrench": wrench, "--orientation-file": orientation_file, "--calibration": calibration}
        missing = " and ".join(option for option, path in given.items() if path is None)
        line = " ".join(f"{option} {path or 'FILE'}" for option, path in given.items())
    return f"missing: {missing}. Type\nftdrive compensate {line}"


def _result_lines(result: dict[str, Any], frame: str) -> Iterator[str]:
    yield from (f" {MARKS[mark]}" for mark in result["marks"])
    yield f" {result['samples']} samples, {result['duration_s']:.2f} s, gaps: {result['gaps']}"
    if delay := result["delay_s"]:
        yield f" delay of the wrench: {with_sigma(1e3 * delay['value'], 1e3 * delay['sigma'])} ms (1 sigma)"
    if change := result["bias_change"]:
        pairs = [with_sigma(v, s) for v, s in zip(change["value"], change["sigma"], strict=True)]
        yield f" bias change ± 1 sigma:\n   {', '.join(pairs[:3])} N\n   {', '.join(pairs[3:])} N·m"
    yield f" {'':12}{'force rms':>10}{'max N':>10}{'torque rms':>12}{'max N·m':>10}"
    for name in ("raw", "compensated"):
        f_rms, f_max, t_rms, t_max = result[name].values()
        yield f" {name:12}{f_rms:10.3f}{f_max:10.3f}{t_rms:12.5f}{t_max:10.5f}"
    yield " raw: sensor axes, about the sensor origin"
    yield f" compensated: {frame}"
    for contact in result["contacts"]:
        x, y, z = contact["direction"]
        begin = f"contact at {contact['t_s']:8.2f} s for {contact['duration_s']:6.2f} s"
        yield f" {begin}, peak {contact['peak_N']:7.2f} N along ({x:.2f}, {y:.2f}, {z:.2f})"
