"""Writers of recordings: several files at once, recorders for a stream and for raw readings, and conversion."""

import signal
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any, Final

import numpy as np

from ftcalib.files import JSON
from ftcalib.rounding import with_sigma
from ftdrive.errors import BadRecording
from ftdrive.recording.files import (
    RecordingFile,
    RecordingReader,
    format_of,
    grown_as,
    require_new_recordings,
    write_recording,
)
from ftdrive.recording.growing_file import GrowingFile
from ftdrive.recording.recording import ROW, Header, Rows, read_ahead, split_piece, to_records
from ftdrive.stream.samples import Block, StreamEvent, StreamInfo
from ftdrive.stream.stream import Sink, Stream

# Samples are written in batches of this duration, ns, because each write delays the stream by a few ms.
_FLUSH_NS = 200_000_000


class RecordingFiles:
    """New files, each of which gets all samples. Raises `OSError` if a file exists or cannot be created."""

    def __init__(self, paths: Sequence[Path], header: Header) -> None:
        self.saved: list[Path] = []
        """Completed files."""
        self.partial: dict[Path, int] = {}
        """Files that could not be completed, with the number of samples in each."""
        self._paths, self._files = paths, list[RecordingFile]()
        with ExitStack() as stack:
            stack.callback(self.discard)
            for path in paths:
                self._files.append(format_of(path).new(path, header))
            stack.pop_all()

    def append(self, rows: Rows, events: Sequence[StreamEvent]) -> None:
        """Append samples, all in one frame, and the events since the previous samples to all files.

        Raises `OSError` if a file cannot be written; no file is then completed, and the message states what each has.
        """
        with _delay_signals():
            try:
                for file in self._files:
                    file.append(rows, events)
            except BaseException as error:
                files, self._files = self._files, []
                for file in files:
                    self._keep(file)
                if isinstance(error, OSError):
                    raise self._named(error) from error
                raise

    def complete(self) -> None:
        """Complete all files, even if one of them fails.

        Raises `OSError` if a file cannot be completed; its message states what each `.partial` contains.
        """
        files, self._files, failure = self._files, [], None
        with _delay_signals():
            # after an error in `append`, the list of files is empty
            for path, file in zip(self._paths, files, strict=False):
                try:
                    file.complete()
                    self.saved.append(path)
                except OSError as error:
                    self._keep(file)
                    failure = failure or error
        if failure is not None:
            raise self._named(failure)

    def discard(self) -> None:
        """Delete the incomplete files."""
        for file in self._files:
            file.discard()
        self._files = []

    def _keep(self, file: RecordingFile) -> None:
        """Close a file without completing it; delete it if it contains no readable samples."""
        file.keep()
        if file.samples:
            self.partial[file.partial] = file.samples
        else:
            file.discard()

    def _named(self, error: OSError) -> OSError:
        kept = " and ".join(f"{path} contains {samples} samples" for path, samples in self.partial.items())
        kept = f"{kept}, which `ftdrive convert` saves as a complete file" if kept else "no sample was kept"
        return type(error)(f"{error.strerror or error}: {kept}")


class Recorder(Sink):
    """Writes a stream to new files (.mcap, .csv or .parquet, by suffix), which are created at the first sample.

    Changes of the frame or the stages become events with the time of the first sample after them. An incomplete Parquet
    file cannot be read, so `x.parquet` is recorded as `x.parquet.mcap` and converted at the end. If the stream is
    `repeatable`, such as a recording, Parquet is written directly. The `configuration` of the cell is stored in the
    header. `duration_s` and `count` limit the recording; at the limit, `is_complete` is true.

    Raises `ConfigError` for an unknown suffix or a missing package, `OSError` if a file exists or its folder does not.
    """

    label, keeps_all = "recording", True
    is_complete = False
    _stream: Stream | None = None

    def __init__(
        self,
        paths: Sequence[Path],
        info: StreamInfo,
        configuration: Mapping[str, JSON],
        *,
        repeatable: bool = False,
        duration_s: float | None = None,
        count: int | None = None,
    ) -> None:
        self._is_repeatable, self._duration_s, self._count = repeatable, duration_s, count
        self.samples, self.gaps, self.lost = 0, 0, 0
        self.first_ns = self.last_ns = 0
        self.show: Callable[[str], object] = lambda _: None
        """Called with progress messages, because the final conversion may take a minute per hour of samples."""
        require_new_recordings(paths)
        self._info, self._configuration = info, configuration
        self._grown = {path if repeatable else grown_as(path): path for path in paths}
        self._files: RecordingFiles | None = None
        self._header: Header | None = None
        self._blocks: list[Block] = []
        self._events: list[StreamEvent] = []

    @property
    def saved(self) -> Sequence[Path]:
        """Completed files."""
        return [path for path in self._grown.values() if self._files and path in self._files.saved]

    @property
    def partial(self) -> Mapping[Path, int]:
        """Files that could not be completed, with the number of samples in each."""
        return self._files.partial if self._files else {}

    @property
    def duration_s(self) -> float:
        """Time from the first to the last sample, s."""
        return (self.last_ns - self.first_ns) * 1e-9

    @property
    def rate_Hz(self) -> float:
        """Mean rate of all samples; 0 for a single sample."""
        return (self.samples - 1) / self.duration_s if self.duration_s else 0.0

    def begin(self, stream: Stream) -> None:
        """Keep the stream to record its delay at the end, except if it is repeatable and has its own delay events."""
        self._stream = None if self._is_repeatable else stream

    def add(self, block: Block | None, events: Sequence[StreamEvent]) -> None:
        """Record the samples up to the limits of duration and count. Raises the errors of `RecordingFiles.append`."""
        if block:
            left = len(block) if self._count is None else self._count - self.samples
            if self._duration_s is not None:
                end_ns = (self.first_ns or int(block.t_host_ns[0])) + round(self._duration_s * 1e9)
                left = min(left, int(np.searchsorted(block.t_host_ns, end_ns)))
            if left < len(block):
                events = [event for event in events if event.t_host_ns < block.t_host_ns[left]]
                block = block.rows(slice(left))
                self.is_complete = True
        for event in events:
            if event.kind == "gap":
                self.gaps += 1
                self.lost += int(event.values.get("lost", 0))
        # `_follow` records changes of the frame and the stages, with the first sample after them
        self._events += [event for event in events if event.kind not in ("frame", "stages")]
        if block:
            self._follow(block)
            self._blocks.append(block)
            self.samples += len(block)
            self.last_ns = int(block.t_host_ns[-1])
            if self.last_ns - self._blocks[0].t_host_ns[0] >= _FLUSH_NS:
                self._flush()
            self.show(f"{self.duration_s:.1f} s, {self.samples} samples, gaps: {self.gaps}")
            self.is_complete |= self.samples == self._count

    def end(self) -> None:
        """Complete the files; without samples, none are created. Raises the errors of `RecordingFiles.complete`."""
        if self._stream is not None:
            status = self._stream.status()
            values = {"value": status.delay_s, "sigma": status.delay_sigma_s}
            delay_ms = with_sigma(1e3 * status.delay_s, 1e3 * status.delay_sigma_s)
            text = f"delay of the wrench relative to the pose: {delay_ms} ms (± is 1 sigma)"
            self._events.append(StreamEvent(self.last_ns, "delay", text, values))
        self._flush()
        if self._files:
            try:
                self._files.complete()
            finally:
                for grown, path in self._grown.items():
                    if grown != path and grown in self._files.saved:
                        self.show(f"Converting to {path}")
                        self._convert(self._files, grown, path)

    def _convert(self, files: RecordingFiles, grown: Path, path: Path) -> None:
        """Convert the file `grown` to `path`, then delete it. If that fails, raises `OSError`, and `grown` stays."""
        files.saved.remove(grown)
        try:
            write_recording(path, RecordingReader(grown))
        except (BadRecording, KeyboardInterrupt, OSError) as error:
            files.partial[grown] = self.samples
            kind = type(error) if isinstance(error, OSError) else OSError
            raise kind(
                f"{path} was not written ({error or 'interrupted'}): {grown} contains {self.samples} samples. Use "
                f"`ftdrive convert {grown} {path}`"
            ) from error
        grown.unlink()
        files.saved.append(path)

    def discard(self) -> None:
        """Delete the incomplete files."""
        if self._files:
            self._files.discard()

    def _follow(self, block: Block) -> None:
        """Create the files at the first block; at later ones, record a change of frame or stages as an event."""
        t_ns = int(block.t_host_ns[0])
        if self._header is None:
            self._header, self.first_ns = Header(self._info, block.frame, block.stages, self._configuration), t_ns
            self._files = RecordingFiles(list(self._grown), self._header)
        changes = []
        if block.frame != self._header.frame:
            text = f"The compensated wrench is in {block.frame}"
            changes.append(StreamEvent(t_ns, "frame", text, block.frame.to_dict()))
        if block.stages != self._header.stages:
            changes.append(StreamEvent(t_ns, "stages", f"The stages are {block.stages}", asdict(block.stages)))
        if changes:
            # write the previous samples, because all samples of one write must be in one frame
            self._flush()
            self._events += changes
            self._header = replace(self._header, frame=block.frame, stages=block.stages)

    def _flush(self) -> None:
        blocks, self._blocks = self._blocks, []
        events, self._events = self._events, []
        if self._files and (blocks or events):
            self._files.append(to_records(Block.concatenate(blocks)) if blocks else np.zeros(0, ROW), events)


_RAW_ROW: Final = "{:.6f}," + ",".join(["{:.7g}"] * 6) + "\n"


class RawTable(Sink):
    """A new .csv file: time in UTC seconds, then the raw wrench in N and N·m, sensor axes, about the sensor origin.

    Tares are not subtracted, and events are not stored. Raises the errors of `GrowingFile`.
    """

    label, keeps_all = "recording", True

    def __init__(self, path: Path, info: StreamInfo) -> None:
        self._utc_offset_ns = info.utc_offset_ns
        self._file = GrowingFile(path)
        self._file.add(b"t,fx,fy,fz,tx,ty,tz\n")

    def add(self, block: Block | None, _events: Sequence[StreamEvent]) -> None:
        """Write samples."""
        if block:
            rows = np.column_stack([(block.t_host_ns + self._utc_offset_ns) * 1e-9, block.raw])
            self._file.add("".join(_RAW_ROW.format(*row) for row in rows).encode())

    def end(self) -> None:
        """Complete the file."""
        self._file.complete()


def convert_recording(
    reader: RecordingReader, target: Path, show: Callable[[str], object] = lambda _: None
) -> tuple[dict[str, Any], BaseException | None]:
    """Convert a recording of any length to a new file; return samples, duration_s and gaps, and what ended it early.

    Damage and Ctrl-C end the new file after the last valid piece. Raises `BadRecording` if no piece is valid, and
    the `OSError` of `RecordingFiles`. `show` receives progress messages.
    """
    files = RecordingFiles([target], reader.header)
    failure: BaseException | None = None
    samples = gaps = first_ns = last_ns = seq = 0
    with ExitStack() as stack:
        stack.callback(files.discard)
        try:
            for piece in read_ahead(reader.pieces()):
                for rows, events in split_piece(piece):
                    if len(rows):
                        if not samples:
                            first_ns, seq = int(rows["t_host_ns"][0]), int(rows["seq"][0]) - 1
                        gaps += int(np.count_nonzero(np.diff(rows["seq"], prepend=seq) != 1))
                        samples, last_ns, seq = samples + len(rows), int(rows["t_host_ns"][-1]), int(rows["seq"][-1])
                    files.append(rows, events)
                show(f"Converting: {piece.share:.0%}")
        except (BadRecording, KeyboardInterrupt) as error:
            if not samples:
                raise
            failure = error
        files.complete()
    return {"samples": samples, "duration_s": (last_ns - first_ns) * 1e-9, "gaps": gaps}, failure


@contextmanager
def _delay_signals() -> Iterator[None]:
    """Delay the effect of Ctrl-C, `kill` and a closed terminal to the end of the block, so that no write is cut."""
    waiting: list[tuple[Any, Any, Any]] = []
    handlers = {}
    if threading.current_thread() is threading.main_thread():
        names = (getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name))
        handlers = {number: handler for number in names if callable(handler := signal.getsignal(number))}
    for number, handler in handlers.items():
        signal.signal(number, lambda *given, act=handler: waiting.append((act, *given)))
    try:
        yield
    finally:
        for number, handler in handlers.items():
            signal.signal(number, handler)
    for act, number, frame in waiting[:1]:
        act(number, frame)
