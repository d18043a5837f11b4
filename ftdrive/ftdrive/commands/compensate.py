"""`ftdrive compensate`: a recording compensated at once, without a device."""

from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from ftdrive.commands.common import BAG_TOPICS, FILE, FORCE, FRAME, JSON, NewFile, numbers, read_frame, write_json
from ftdrive.terminal.text import echo

if TYPE_CHECKING:
    from ftcalib import CalibrationResult
    from ftdrive.live.samples import Axes
    from ftdrive.recording.recording import Source

_EXISTING = click.Path(exists=True, path_type=Path)
CALIBRATION = click.option(
    "--calibration", metavar="PATH", type=_EXISTING, help="A calibration.json or its run folder."
)
BIAS = click.option(
    "--bias",
    type=click.Choice(["keep", "estimate"]),
    default="keep",
    show_default=True,
    help="Keep the calibration's bias, or estimate it from the recording: for sensors that are zeroed at start.",
)


@click.command()
@click.argument("path", metavar="[RECORDING]", required=False, type=_EXISTING)
@CALIBRATION
@click.option("--wrench", metavar="FILE", type=FILE, help="Instead of RECORDING: CSV with t,fx,fy,fz,tx,ty,tz.")
@click.option("--orientation-file", metavar="FILE", type=FILE, help="With --wrench: CSV with t and the orientation.")
@BAG_TOPICS
@click.option("--delay", metavar="S|auto", help="With --wrench: delay of the wrench, s.  [default: auto]")
@FORCE
@BIAS
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
    delay: str | None,
    force: bool,
    bias: str,
    axes: "Axes",
    about: str,
    output: Path | None,
    as_json: bool,
) -> None:
    """Compensate a whole recording with a calibration; no device is needed.

    RECORDING is a file of `ftdrive record`; without --calibration its own is used. Recordings of other programs come as
    two CSV files on one clock, each at its own rate: the wrench in N and N·m, and the orientation of the flange in base
    as r11..r33, qx,qy,qz,qw or rx,ry,rz in rad; or as a rosbag2 folder or an MCAP file of ROS 2.
    """
    from ftdrive.errors import ConfigError
    from ftdrive.recording.bag import as_csv_pair, is_bag, read_bag
    from ftdrive.recording.compensation import compensate_recording
    from ftdrive.recording.files import format_of
    from ftdrive.runs.source import read_calibration
    from ftdrive.terminal.console import beside, messages, working

    if output is not None:
        format_of(output)
    frame = read_frame(axes, about)
    loaded = None if calibration is None else read_calibration(calibration, accept_edited=force)
    with working("Reading") as show, ExitStack() as stack:
        if path is not None and is_bag(path):
            bag = read_bag(path, wrench_topic, pose_topic)
            wrench, orientation_file = stack.enter_context(as_csv_pair(bag, path.name))
            path = None
        elif wrench_topic or pose_topic:
            raise ConfigError("--wrench-topic and --pose-topic go with a bag of ROS 2: leave them out")
        source, found = _open(path, calibration, loaded, wrench, orientation_file, delay, everything=output is not None)
        numbers, failure = compensate_recording(source, frame, output, estimate_bias=bias == "estimate", show=show)
    result = {**numbers, "delay_s": found or numbers["delay_s"], "file": None if output is None else str(output)}
    if result["cut"]:
        what = path or wrench
        messages.print(f" {what} is incomplete ({result['cut']}): {result['duration_s']:.1f} s of it are used.")
    if as_json:
        write_json({"schema_version": 1, **result})
    else:
        echo("\n".join(_words(result, str(frame))))
    if output is not None:
        short = "" if failure is None else f": the first {result['samples']} samples"
        beside(as_json).print(f" Saved {output}{short}")
    if failure is not None:
        raise failure


def _open(
    path: Path | None,
    calibration: Path | None,
    loaded: "CalibrationResult | None",
    wrench: Path | None,
    orientation: Path | None,
    delay: str | None,
    *,
    everything: bool,
) -> tuple["Source", dict[str, float] | None]:
    """Return the recording with the calibration, and the delay of a pair of files with one sigma."""
    from ftdrive.errors import ConfigError
    from ftdrive.recording.compensation import NEEDED, read_with_calibration
    from ftdrive.recording.csv_pair import CsvPair
    from ftdrive.recording.recording import ROW

    if path is None:
        if wrench is None or orientation is None or loaded is None:
            raise ConfigError("no recording: give its file, or --wrench, --orientation-file and --calibration")
        delay_s = None if delay in (None, "auto") else numbers("--delay", str(delay), ",", [1])[0]
        pair = CsvPair(wrench, orientation, loaded, str(calibration), delay_s)
        return pair, {"value": pair.delay_s, "sigma": pair.delay_sigma_s}
    if wrench or orientation or delay:
        raise ConfigError("--wrench, --orientation-file and --delay do not go with RECORDING: leave it or them out")
    return read_with_calibration(path, loaded, str(calibration), ROW.names or () if everything else NEEDED), None


def _words(result: dict[str, Any], frame: str) -> Iterator[str]:
    from ftcalib.rounding import with_sigma
    from ftdrive.runs.verification import MARKS

    yield from (f" {MARKS[mark]}" for mark in result["marks"])
    yield f" {result['samples']} samples, {result['duration_s']:.2f} s, gaps: {result['gaps']}"
    if delay := result["delay_s"]:
        yield f" wrench after pose: {with_sigma(1e3 * delay['value'], 1e3 * delay['sigma'])} ms (1 sigma)"
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
