"""Recordings as CSV: a text table that everything reads.

    # ftdrive.recording/1: what the columns hold
    # header {...}
    t_s,t_host_ns,...
    ...
    # event {...}          where it happened
    # end

A reader that skips lines with `#`, such as `pandas.read_csv(path, comment="#")`, finds a plain table.
"""

import csv
import io
import json
from collections.abc import Collection, Iterator, Sequence
from pathlib import Path

import numpy as np

from ftdrive.errors import BadRecording
from ftdrive.live.samples import StreamEvent
from ftdrive.recording.growing_file import GrowingFile
from ftdrive.recording.recording import COLUMNS, FORMAT, ROW, Header, Recording, Rows, event_of, event_text

_HEADER, _EVENT, _END = "# header ", "# event ", "# end"
_NAMES = ("t_s", *(COLUMNS.names or ()))


class CsvFile:
    """A new recording."""

    def __init__(self, path: Path, header: Header) -> None:
        self._file = GrowingFile(path)
        self._start_ns: int | None = None
        lines = [f"# {FORMAT}: {header.words}", _HEADER + json.dumps(header.to_dict()), ",".join(_NAMES), ""]
        self._file.add("\n".join(lines).encode())

    def append(self, rows: Rows, events: Sequence[StreamEvent]) -> None:
        """Write samples and events. Raises `OSError`."""
        text = io.StringIO()
        text.writelines(f"{_EVENT}{event_text(event)}\n" for event in events)
        if len(rows):
            self._start_ns = int(rows["t_host_ns"][0]) if self._start_ns is None else self._start_ns
            t_s = (rows["t_host_ns"] - self._start_ns) * 1e-9
            values = [rows.view(COLUMNS)[name] for name in COLUMNS.names or ()]
            columns = [one.astype(np.uint8) if one.dtype == bool else one for one in values]
            table = csv.writer(text, lineterminator="\n")
            table.writerows(zip(t_s.tolist(), *(column.tolist() for column in columns), strict=True))
        self._file.add(text.getvalue().encode())

    def complete(self) -> None:
        """Write the end and give the file its name. Raises `OSError`."""
        with self._file:
            self._file.add(f"{_END}\n".encode())
            self._file.complete()

    def discard(self) -> None:
        """Delete what was written."""
        self._file.discard()


def read_csv(path: Path, _columns: Collection[str] = ()) -> Recording:
    """Read a recording. Raises `BadRecording` or `OSError`."""
    with path.open(encoding="utf-8", errors="replace", newline="") as file:
        lines = _whole_lines(file)
        if not next(lines, "").startswith(f"# {FORMAT.partition('/')[0]}/"):
            raise BadRecording(f"the first line is not '# {FORMAT}'")
        given = next(lines, "")
        if not given.startswith(_HEADER):
            raise BadRecording("the header is missing: the file was cut within its first lines")
        header = Header.from_dict(_parsed(given.removeprefix(_HEADER)))
        names = next(lines, "").rstrip("\n").split(",")
        if missing := [name for name in COLUMNS.names or () if name not in names]:
            raise BadRecording(f"the column {missing[0]} is missing")
        events: list[StreamEvent] = []
        ended: list[str] = []

        def table() -> Iterator[str]:
            for line in lines:
                if line.startswith(_EVENT):
                    events.append(event_of(line.removeprefix(_EVENT)))
                elif line.startswith(_END):
                    ended.append(line)
                else:
                    yield line

        order = [names.index(name) for name in COLUMNS.names or ()]
        try:
            loaded = np.loadtxt(table(), COLUMNS, delimiter=",", usecols=order, ndmin=1, comments=None)
        except ValueError as error:
            raise BadRecording(f"a line cannot be read ({error}): the file is damaged") from error
    cut = "" if ended else "the last line is not '# end'"
    return Recording(header, loaded.view(ROW), events, cut)


def _whole_lines(file: io.TextIOBase) -> Iterator[str]:
    """Give lines that end; the last line of a cut file may not."""
    return (line for line in file if line.endswith("\n"))


def _parsed(text: str) -> dict[str, object]:
    try:
        return dict(json.loads(text))
    except (TypeError, ValueError) as error:
        raise BadRecording(f"the header is not a JSON object ({error}): the file is damaged") from error
