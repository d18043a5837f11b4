"""The file formats by their endings."""

from collections.abc import Callable, Collection, Sequence
from importlib import import_module
from pathlib import Path
from typing import NamedTuple, Protocol

from ftdrive.errors import BadRecording, ConfigError
from ftdrive.live.samples import StreamEvent
from ftdrive.recording.csv_file import CsvFile, read_csv
from ftdrive.recording.growing_file import partial_of
from ftdrive.recording.mcap_file import McapFile, read_mcap
from ftdrive.recording.parquet_file import ParquetFile, read_parquet
from ftdrive.recording.recording import ROW, Header, Recording, Rows

_PIECE_ROWS = 7000


class RecordingFile(Protocol):
    """A new file of one format."""

    samples: int
    """So many are in the file and remain there, whatever happens."""

    @property
    def partial(self) -> Path:
        """Name until it is complete."""

    def append(self, rows: Rows, events: Sequence[StreamEvent]) -> None:
        """Write samples of one frame, and the events since the samples before."""

    def complete(self) -> None:
        """Write the end, fsync the file and give it its name."""

    def keep(self) -> None:
        """End the file without completing it; what was written remains in `partial`."""

    def discard(self) -> None:
        """Delete what was written."""


class Format(NamedTuple):
    """A file format."""

    new: Callable[[Path, Header], RecordingFile]
    read: Callable[[Path, Collection[str]], Recording]
    package: str
    """Needed for it."""


_FORMATS = {
    ".mcap": Format(McapFile, read_mcap, "mcap"),
    ".csv": Format(CsvFile, read_csv, "csv"),
    ".parquet": Format(ParquetFile, read_parquet, "duckdb"),
}
ENDINGS = tuple(_FORMATS)


def format_of(path: Path) -> Format:
    """Return the format of a recording, complete or not; raises `ConfigError` if it is unknown or lacks its package."""
    ending = Path(path.name.removesuffix(".partial")).suffix
    if ending not in _FORMATS:
        raise ConfigError(f"{path} has no ending of a recording: name it .mcap, .csv or .parquet")
    try:
        import_module(_FORMATS[ending].package)
    except ImportError:
        raise ConfigError(f"{ending} needs {_FORMATS[ending].package}: pip install 'ftdrive[record]'") from None
    return _FORMATS[ending]


def require_new_recordings(paths: Sequence[Path]) -> None:
    """Raise `ConfigError` or `OSError` unless a recording can be written to all of these files."""
    for path in paths:
        format_of(path)
        partial_of(path)
    if len({path.absolute() for path in paths}) < len(paths):
        raise ConfigError("two outputs name the same file: leave one out")


def read_recording(path: str | Path, columns: Collection[str] = ROW.names or ()) -> Recording:
    """Read a recording, also the `.partial` of one that was interrupted.

    Parameters
    ----------
    path : str or Path
        Its ending names the format: .mcap, .csv or .parquet.
    columns : collection of str
        Fields of `Recording.rows` that are needed. Others may be missing, which makes reading Parquet faster.

    Raises
    ------
    ConfigError
        Another ending, or the package for the format is missing.
    BadRecording
        Damaged, without a sample, or of another program. A file that was cut is read up to there; `cut` says so.
    OSError
        The file does not exist or cannot be read.

    Examples
    --------
    >>> import ftdrive
    >>> recording = ftdrive.read_recording("peg.csv")
    >>> table = recording.table  # a DataFrame: pandas.DataFrame(table)
    >>> table["fz"].shape, table["raw_fz"].shape
    ((3000,), (3000,))
    """
    path = Path(path)
    file_format = format_of(path)
    try:
        recording = file_format.read(path, columns)
    except BadRecording as error:
        raise BadRecording(error.problem, path) from error
    if not len(recording.rows):
        raise BadRecording("it contains no sample: the file was cut, or the stream ended at once", path)
    return recording


def write_recording(path: str | Path, recording: Recording) -> None:
    """Write a new file with all of a recording, or none.

    Parameters
    ----------
    path : str or Path
        Its ending names the format: .mcap, .csv or .parquet.
    recording : Recording

    Raises
    ------
    ConfigError
        Another ending, or the package for the format is missing.
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
        for rows, events, _ in recording.pieces(_PIECE_ROWS):
            file.append(rows, events)
        file.complete()
    except BaseException:
        file.discard()
        raise
