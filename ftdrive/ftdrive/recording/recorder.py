"""Writers of recordings: files that grow together, a stream recorded in them, and a recording converted."""

import signal
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np

from ftcalib.files import JSON
from ftdrive.errors import BadRecording
from ftdrive.live.samples import Block, StreamEvent, StreamInfo
from ftdrive.recording.files import (
    RecordingFile,
    RecordingReader,
    format_of,
    grown_as,
    require_new_recordings,
    write_recording,
)
from ftdrive.recording.recording import ROW, Header, Rows, divided, read_ahead, rows_of

# Writing takes a few ms, in which the stream waits.
_FLUSH_NS = 200_000_000


class RecordingFiles:
    """New files that grow together, each with all samples.

    Parameters
    ----------
    paths : sequence of Path
        The ending chooses the format: .mcap, .csv or .parquet.
    header : Header

    Raises
    ------
    ConfigError
        An ending is unknown, or the package for a format is missing.
    OSError
        A file exists, or its folder does not.
    """

    def __init__(self, paths: Sequence[Path], header: Header) -> None:
        self.saved: list[Path] = []
        """Files that are complete."""
        self.partial: dict[Path, int] = {}
        """Files that could not be completed, and how many samples each of them keeps."""
        self._paths, self._files = paths, list[RecordingFile]()
        with ExitStack() as stack:
            stack.callback(self.discard)
            for path in paths:
                self._files.append(format_of(path).new(path, header))
            stack.pop_all()

    def append(self, rows: Rows, events: Sequence[StreamEvent]) -> None:
        """Write samples of one frame, and the events since the samples before.

        Raises
        ------
        OSError
            A file cannot be written. None will be completed, and the error names what remains in which `.partial`.
        """
        with _uninterrupted():
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
        """Complete all files that hold every sample.

        Raises
        ------
        OSError
            A file could not be completed; the others were. It names what remains in which `.partial`.
        """
        files, self._files, failure = self._files, [], None
        with _uninterrupted():
            # after an error there is no file
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
        """Delete what was written and is not complete."""
        for file in self._files:
            file.discard()
        self._files = []

    def _keep(self, file: RecordingFile) -> None:
        """End a file without completing it; one without samples that can be read is deleted."""
        file.keep()
        if file.samples:
            self.partial[file.partial] = file.samples
        else:
            file.discard()

    def _named(self, error: OSError) -> OSError:
        """Return an error of the same kind that names what is safe."""
        kept = " and ".join(f"{path} keeps {samples} samples" for path, samples in self.partial.items())
        kept = f"{kept}, which `ftdrive convert` saves as a complete file" if kept else "no sample is kept"
        return type(error)(f"{error.strerror or error}: {kept}")


class Recorder:
    """Writes a stream to files, with everything since the first sample; a consumer of blocks and events.

    Changes of frame and stages become events with the time of the first sample after them. Parquet cannot be read
    before its end: `x.parquet` is recorded as `x.parquet.mcap`, and converted when the recorder is closed.

    Parameters
    ----------
    paths : sequence of Path
        New files; the ending chooses the format: .mcap, .csv or .parquet.
    info : StreamInfo
    configuration : mapping
        Of the cell, for the header.
    repeatable : bool
        Whether the stream can be read again, as one from a file: then Parquet is written at once.

    Raises
    ------
    ConfigError
        An ending is unknown, or the package for a format is missing.
    OSError
        A file exists, or its folder does not.
    """

    def __init__(
        self, paths: Sequence[Path], info: StreamInfo, configuration: Mapping[str, JSON], *, repeatable: bool = False
    ) -> None:
        self.samples, self.gaps, self.lost = 0, 0, 0
        self.first_ns = self.last_ns = 0
        require_new_recordings(paths)
        self._info, self._configuration = info, configuration
        self._grown = {path if repeatable else grown_as(path): path for path in paths}
        self._files: RecordingFiles | None = None
        self._header: Header | None = None
        self._blocks: list[Block] = []
        self._events: list[StreamEvent] = []

    @property
    def saved(self) -> Sequence[Path]:
        """Files that are complete."""
        return [path for path in self._grown.values() if self._files and path in self._files.saved]

    @property
    def partial(self) -> Mapping[Path, int]:
        """Files that could not be completed, and how many samples each of them keeps."""
        return self._files.partial if self._files else {}

    @property
    def duration_s(self) -> float:
        """From the first sample to the last."""
        return (self.last_ns - self.first_ns) * 1e-9

    @property
    def rate_Hz(self) -> float:
        """Mean rate of all samples; 0 if there is only one."""
        return (self.samples - 1) / self.duration_s if self.duration_s else 0.0

    def write(self, block: Block) -> None:
        """Record samples.

        Raises
        ------
        OSError
            A file cannot be written. None will be completed, and the error names what remains in which `.partial`.
        """
        if not len(block):
            return
        self._follow(block)
        self._blocks.append(block)
        self.samples += len(block)
        self.last_ns = int(block.t_host_ns[-1])
        if self.last_ns - self._blocks[0].t_host_ns[0] >= _FLUSH_NS:
            self._flush()

    def event(self, event: StreamEvent) -> None:
        """Record an event of the stream."""
        if event.kind == "gap":
            self.gaps += 1
            self.lost += int(event.values.get("lost", 0))
        # `_follow` finds the first sample of each
        if event.kind not in ("frame", "stages"):
            self._events.append(event)

    def close(self, show: Callable[[str], object] = lambda _: None) -> None:
        """Complete all files that hold every sample; without a sample there is none.

        Parameters
        ----------
        show : callable
            Gets in words what is done, because a conversion may take a minute for each hour of samples.

        Raises
        ------
        OSError
            A file could not be completed; the others were. It names what remains in which file.
        """
        self._flush()
        if self._files:
            try:
                self._files.complete()
            finally:
                for grown, path in self._grown.items():
                    if grown != path and grown in self._files.saved:
                        show(f"Converting to {path}")
                        self._convert(self._files, grown, path)

    def _convert(self, files: RecordingFiles, grown: Path, path: Path) -> None:
        """Write a complete recording in another format, and delete it. After an error it remains. Raises `OSError`."""
        files.saved.remove(grown)
        try:
            write_recording(path, RecordingReader(grown))
        except (BadRecording, KeyboardInterrupt, OSError) as error:
            files.partial[grown] = self.samples
            kind = type(error) if isinstance(error, OSError) else OSError
            raise kind(
                f"{path} was not written ({error or 'interrupted'}): {grown} keeps {self.samples} samples, which "
                f"`ftdrive convert {grown} {path}` saves"
            ) from error
        grown.unlink()
        files.saved.append(path)

    def discard(self) -> None:
        """Delete what was written."""
        if self._files:
            self._files.discard()

    def _follow(self, block: Block) -> None:
        """Begin with the first block; record a change of frame or stages."""
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
            # the samples of one flush are in one frame
            self._flush()
            self._events += changes
            self._header = replace(self._header, frame=block.frame, stages=block.stages)

    def _flush(self) -> None:
        blocks, self._blocks = self._blocks, []
        events, self._events = self._events, []
        if self._files and (blocks or events):
            self._files.append(rows_of(Block.concatenate(blocks)) if blocks else np.zeros(0, ROW), events)


def converted(
    reader: RecordingReader, target: Path, show: Callable[[str], object] = lambda _: None
) -> tuple[dict[str, Any], BaseException | None]:
    """Write a recording of any length as a new file, in blocks.

    Parameters
    ----------
    reader : RecordingReader
    target : Path
        Its ending names the format.
    show : callable
        Gets in words how much is done.

    Returns
    -------
    numbers : dict
        samples, duration_s, gaps.
    failure : exception or None
        A file that is damaged and Ctrl-C end the recording behind the last valid piece.

    Raises
    ------
    BadRecording
        The first piece is damaged.
    OSError
        The file cannot be written; the error names what was kept.
    """
    files = RecordingFiles([target], reader.header)
    failure: BaseException | None = None
    samples = gaps = first_ns = last_ns = seq = 0
    with ExitStack() as stack:
        stack.callback(files.discard)
        try:
            for piece in read_ahead(reader.pieces()):
                for rows, events in divided(piece):
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
def _uninterrupted() -> Iterator[None]:
    """Let Ctrl-C, `kill` and a closing terminal wait, so that each file gets all of a piece."""
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
