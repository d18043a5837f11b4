"""Recordings on disk: choice of the file format by suffix, and reading and writing of recordings."""

from collections.abc import Callable, Collection, Generator, Iterator, Sequence
from contextlib import closing
from functools import reduce
from importlib import import_module
from pathlib import Path
from typing import NamedTuple

import numpy as np

from ftdrive.errors import BadRecording, ConfigError
from ftdrive.recording.growing_file import partial_of
from ftdrive.recording.mcap_file import McapFile, read_mcap
from ftdrive.recording.recording import ROW, Measured, Piece, Recording, in_blocks, next_header, read_ahead, split_piece
from ftdrive.recording.table_files import CsvFile, ParquetFile, read_csv, read_parquet
from ftdrivers.installation import missing_extra

RecordingFile = McapFile | CsvFile | ParquetFile
"""A new recording file in one format. After any error, the first `samples` samples remain readable in the file."""


class _RecordingFormat(NamedTuple):
    """A file format of recordings."""

    new: type[RecordingFile]
    read: Callable[[Path, Collection[str]], Generator[Piece, None, str]]
    """Reads a file in pieces; the first piece has the header and no samples. Returns why the file ends early."""
    package: str
    """Python package that the format needs."""


_FORMATS = {
    ".mcap": _RecordingFormat(McapFile, read_mcap, "mcap"),
    ".csv": _RecordingFormat(CsvFile, read_csv, "csv"),
    ".parquet": _RecordingFormat(ParquetFile, read_parquet, "pyarrow"),
}
ENDINGS = tuple(_FORMATS)


def format_of(path: Path) -> _RecordingFormat:
    """Return the format for a recording's suffix. Raises `ConfigError` if it is unknown or its package is missing."""
    ending = Path(path.name.removesuffix(".partial")).suffix
    if ending not in _FORMATS:
        raise ConfigError(f"{path} does not have the suffix of a recording: name it .mcap, .csv or .parquet")
    try:
        import_module(_FORMATS[ending].package)
    except ImportError:
        raise ConfigError(missing_extra(ending, _FORMATS[ending].package, "record")) from None
    return _FORMATS[ending]


def grown_as(path: Path) -> Path:
    """Return the file to write a stream to: `path`, or an MCAP file if its format is unreadable until complete."""
    return path if format_of(path).new.grows else path.with_name(f"{path.name}.mcap")


def require_new_recordings(paths: Sequence[Path]) -> None:
    """Raise `ConfigError` or `OSError` unless a stream can be recorded to all of these files."""
    grown = [grown_as(path) for path in paths]
    for path in (*paths, *grown):
        partial_of(path, grows=format_of(path).new.grows)
    if len({path.absolute() for path in grown}) < len(paths):
        raise ConfigError("two outputs name the same file: leave one out")


class RecordingReader:
    """A recording on disk, read in blocks; also the `.partial` file of an interrupted recording.

    Parameters
    ----------
    path : Path
        The suffix selects the format: .mcap, .csv or .parquet.
    columns : collection of str
        Required fields of `Recording.rows`. Others may be left out, which makes reading faster.

    Raises
    ------
    ConfigError
        The suffix is unknown, or the package for the format is missing.
    BadRecording
        The header is damaged, or another program wrote the file.
    OSError
        The file does not exist or cannot be read.

    Examples
    --------
    >>> from pathlib import Path
    >>> from ftdrive.recording import RecordingReader
    >>> for samples, events, _ in RecordingReader(Path("peg.csv")).blocks():
    ...     t_ns, wrench, R_base_flange = samples.t_host_ns, samples.raw, samples.R_base_flange
    >>> wrench.shape[1:], R_base_flange.shape[1:]
    ((6,), (3, 3))
    """

    def __init__(self, path: Path, columns: Collection[str] = ROW.names or ()) -> None:
        self.path, self.cut = path, ""
        """Reason why the file ends early, known once it is read to its end; empty if the recording is complete."""
        self._columns, self._read = columns, format_of(path).read
        with closing(self._pieces()) as pieces:
            self.header = next(pieces).header

    def pieces(self) -> Iterator[Piece]:
        """Yield the stored samples. Raises `BadRecording` for an empty file, and for damage after the intact pieces."""
        count = 0
        for piece in self._pieces():
            count += len(piece.rows)
            yield piece
        if not count:
            raise BadRecording("it contains no sample: the file was cut, or the stream ended at once", self.path)

    def blocks(self) -> Iterator[Measured]:
        """Yield the raw wrenches and poses with their times in blocks. Raises the errors of `pieces`."""
        return in_blocks(piece.measured() for piece in self.pieces())

    def _pieces(self) -> Generator[Piece, None, None]:
        try:
            self.cut = yield from self._read(self.path, self._columns)
        except BadRecording as error:
            raise BadRecording(error.problem, self.path) from error


def load_recording(path: str | Path, columns: Collection[str] = ROW.names or ()) -> Recording:
    """Read a whole recording into memory, with `RecordingReader`.

    Raises `BadRecording` for a damaged or empty file. A truncated file is read to its end; `cut` then gives the reason.
    """
    # Damage raises an error instead of a printed message, which a caller in Python would not see.
    reader = RecordingReader(Path(path), columns)
    pieces = list(reader.pieces())
    events = [event for piece in pieces for event in piece.events]
    reduce(next_header, events, reader.header)  # raise an error for a stage from a newer version
    return Recording(reader.header, np.concatenate([piece.rows for piece in pieces]), events, reader.cut)


def write_recording(path: str | Path, recording: Recording | RecordingReader) -> None:
    """Write a whole recording to a new file; after an error, no file remains.

    Parameters
    ----------
    path : str or Path
        The suffix selects the format: .mcap, .csv or .parquet.
    recording : Recording or RecordingReader

    Raises
    ------
    ConfigError
        The suffix is unknown, or the package for the format is missing.
    OSError
        The file exists or cannot be written.

    Examples
    --------
    >>> import ftdrive
    >>> ftdrive.write_recording("peg.parquet", ftdrive.read_recording("peg.csv"))
    >>> len(ftdrive.read_recording("peg.parquet").rows)
    3000
    """
    path = Path(path)
    file = format_of(path).new(path, recording.header)
    try:
        with closing(read_ahead(recording.pieces())) as pieces:
            for piece in pieces:
                for rows, events in split_piece(piece):
                    file.append(rows, events)
        file.complete()
    except BaseException:
        file.discard()
        raise
