"""`ftdrive record`: record the raw and the compensated wrench, with pose and events, to files."""

import re
from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import click

from ftdrive.commands.options import FRAME, JSON, SOURCE, STAGES, TRACK, NewFile, SourceOptions, write_json
from ftdrive.errors import RecordingHasGaps
from ftdrive.recording import Recorder
from ftdrive.recording.files import require_new_recordings
from ftdrive.stream.samples import Tracking, WrenchFrame
from ftdrive.stream.stream import pump
from ftdrive.terminal.console import message_console, messages, working


class Duration(click.ParamType):  # type: ignore[type-arg]  # a generic type in newer versions of click only
    """Type of an option: a duration such as 90, 60s, 10min or 1h, converted to s."""

    name = "duration"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> float:
        """Return a typed duration in s."""
        if isinstance(value, float):
            return value
        found = re.fullmatch(r"(\d+\.?\d*)(s|min|h)?", value)
        if found is None or not float(found[1]):
            self.fail(f"'{value}' is not a duration such as 60s, 10min or 1h.", param, ctx)
        return float(found[1]) * {"min": 60.0, "h": 3600.0}.get(found[2], 1.0)


@click.command()
@click.option(
    "-o",
    "--output",
    "paths",
    metavar="FILE",
    multiple=True,
    required=True,
    type=NewFile(),
    help="Save as a new .mcap, .csv or .parquet. Repeatable.",
)
@click.option(
    "--duration",
    "duration_s",
    type=Duration(),
    help="Duration, such as 60s, 10min or 1h.  [default: until Ctrl-C]",
)
@click.option("--count", type=click.IntRange(1), help="Number of samples to record.")
@SOURCE
@TRACK
@FRAME
@STAGES
@JSON
def record(
    paths: Sequence[Path],
    duration_s: float | None,
    count: int | None,
    source: SourceOptions,
    track: Tracking,
    frame: WrenchFrame,
    stages: dict[str, Any],
    as_json: bool,
) -> None:
    """Record every sample: raw and compensated wrench, pose, joint angles, status, events and the calibration.

    Foxglove, Lichtblick, PlotJuggler and ROS 2 can open .mcap files. The arm is only read, never moved. However the
    recording ends, the files contain all samples up to then. The exit code is 8 if samples are missing.
    """
    require_new_recordings(paths)
    with ExitStack() as stack:
        stream = source.open(stack, frame, track, stages)
        recorder = Recorder(paths, stream.info, stream.cell.to_dict(), duration_s=duration_s, count=count)
        messages.print(f" Recording, {frame}. Press Ctrl-C to stop.")
        try:
            with working("Recording") as recorder.show:
                for _ in pump(stream, [recorder], until=lambda: recorder.is_complete, patience_s=0.0):
                    pass
        finally:
            if recorder.samples:
                _report_recording(recorder, frame, stream.info.calibration_name, as_json=as_json)
    if recorder.gaps:
        raise RecordingHasGaps(
            f"gaps: {recorder.gaps}, samples lost: {recorder.lost}. Check the cable, the power supply and the load on "
            "the computer, then record again. The times are in the events of the file"
        )


def _report_recording(recorder: Recorder, frame: WrenchFrame, name: str, *, as_json: bool) -> None:
    # the rate over all samples, because the rate over the first half second may differ a lot
    rate = f"{recorder.rate_Hz:.0f} Hz"
    for path in recorder.saved:
        samples = f"{recorder.samples} samples, {recorder.duration_s:.2f} s, {rate}, gaps: {recorder.gaps}"
        message_console(as_json).print(f" Saved {path}: {samples}")
    if as_json:
        files = {
            "files": [str(path) for path in recorder.saved],
            "partial": {str(path): samples for path, samples in recorder.partial.items()},
        }
        counts = {key: getattr(recorder, key) for key in ("samples", "duration_s", "rate_Hz", "gaps", "lost")}
        write_json({"schema_version": 1, **files, **counts, **frame.to_dict(), "calibration": name})
