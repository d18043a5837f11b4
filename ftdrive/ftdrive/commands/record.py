"""`ftdrive record`: the raw and the compensated wrench, with pose and events, to files."""

import re
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from ftcalib.rounding import with_sigma
from ftdrive.commands.common import FRAME, JSON, SOURCE, TRACK, NewFile, Source, read_frame, write_json
from ftdrive.errors import RecordingHasGaps

if TYPE_CHECKING:
    from ftdrive.live.samples import Axes, Tracking, WrenchFrame
    from ftdrive.live.stream import CompensatedStream
    from ftdrive.recording import Recorder


class Duration(click.ParamType):  # type: ignore[type-arg]  # a generic type in newer versions of click only
    """A time such as 90, 60s, 10min or 1h, in s."""

    name = "duration"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> float:
        """Return seconds."""
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
    help="Duration, such as 60s, 10min or 1h; without a limit, until Ctrl-C.",
)
@click.option("--count", type=click.IntRange(1), help="Number of samples.")
@SOURCE
@TRACK
@FRAME
@JSON
def record(
    paths: Sequence[Path],
    duration_s: float | None,
    count: int | None,
    source: Source,
    track: "Tracking",
    axes: "Axes",
    about: str,
    as_json: bool,
) -> None:
    """Record every sample: raw and compensated wrench, pose, joint angles, status, events and the calibration.

    Foxglove, Lichtblick, PlotJuggler and ROS 2 open .mcap. The arm is only read, never moved. However the recording
    ends, the files hold what was received until then. Exit code 8 if samples are missing.
    """
    from ftdrive.commands.live_source import open_source
    from ftdrive.recording import Recorder
    from ftdrive.recording.files import require_new_recordings
    from ftdrive.terminal.console import messages, working

    require_new_recordings(paths)
    frame = read_frame(axes, about)
    with ExitStack() as stack:
        stream = open_source(source, frame, stack, track)
        recorder = Recorder(paths, stream.info, stream.cell.to_dict())
        messages.print(f" Recording, {frame}. Ctrl-C ends.")
        try:
            with working("Recording") as show:
                _record_stream(stream, recorder, duration_s, count, show)
        finally:
            if recorder.samples:
                _report(recorder, frame, stream.info.calibration_name, as_json=as_json)
    if recorder.gaps:
        raise RecordingHasGaps(
            f"gaps: {recorder.gaps}, samples lost: {recorder.lost}; check cable, supply and load of the computer, then "
            "record again; the events in the file have the times"
        )


def _record_stream(
    stream: "CompensatedStream",
    recorder: "Recorder",
    duration_s: float | None = None,
    count: int | None = None,
    show: Callable[[str], object] = lambda _: None,
) -> None:
    """Record until the end or an exception, and complete the files; `show` gets in words how far it is."""
    import numpy as np

    from ftdrive.live.samples import StreamEvent

    try:
        while True:
            block = stream.read()
            left = len(block) if count is None else count - recorder.samples
            if duration_s is not None and len(block):
                end_ns = (recorder.first_ns or int(block.t_host_ns[0])) + round(duration_s * 1e9)
                left = min(left, int(np.searchsorted(block.t_host_ns, end_ns)))
            for event in stream.take_events():
                if left >= len(block) or event.t_host_ns < block.t_host_ns[left]:
                    recorder.event(event)
            recorder.write(block.rows(slice(left)))
            show(f"{recorder.duration_s:.1f} s, {recorder.samples} samples, gaps: {recorder.gaps}")
            if left < len(block) or recorder.samples == count:
                return
    finally:
        for event in stream.take_events():
            recorder.event(event)
        status = stream.status()
        text = (
            f"the wrench is {with_sigma(1e3 * status.delay_s, 1e3 * status.delay_sigma_s)} ms (1 sigma) after the pose"
        )
        values = {"value": status.delay_s, "sigma": status.delay_sigma_s}
        recorder.event(StreamEvent(recorder.last_ns, "delay", text, values))
        recorder.close(show)


def _report(recorder: "Recorder", frame: "WrenchFrame", name: str, *, as_json: bool) -> None:
    from ftdrive.terminal.console import beside

    # of all samples: that of the first half second may differ much
    rate = f"{recorder.rate_Hz:.0f} Hz"
    for path in recorder.saved:
        samples = f"{recorder.samples} samples, {recorder.duration_s:.2f} s, {rate}, gaps: {recorder.gaps}"
        beside(as_json).print(f" Saved {path}: {samples}")
    if as_json:
        files = {
            "files": [str(path) for path in recorder.saved],
            "partial": {str(path): samples for path, samples in recorder.partial.items()},
        }
        counts = {key: getattr(recorder, key) for key in ("samples", "duration_s", "rate_Hz", "gaps", "lost")}
        write_json({"schema_version": 1, **files, **counts, **frame.to_dict(), "calibration": name})
