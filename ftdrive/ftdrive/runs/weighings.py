"""Weighings of a tool: a file for each day (UTC), to which every program that weighs adds lines.

    {"format": "ftdrive.weighings/1", "day": "2026-11-26", "tool": "gripper", …, "crc32": "…"}
    {"t_utc": "2026-11-26T10:15:00+00:00", "mass_kg": 0.2503, "mass_sigma_kg": 0.0004, …, "crc32": "…"}
    {"t_utc": "2026-11-26T10:15:05+00:00", "refused": "cable", "crc32": "…"}

The file has every weighing. The store has one row for it, however many there are.
"""

import hashlib
import json
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final, Self

from ftcalib.errors import BadDataset
from ftcalib.files import JSON, check_format, open_file, read_lines

FORMAT: Final = "ftdrive.weighings/1"
FOLDER: Final = "weighings"
FILES: Final = "weighings-*.ndjson"
# Why nothing was weighed: the codes of `ftdrive.stream.weighing.WORDS`. Each is a column of the store: a change raises
# `ftdrive.store.database.SCHEMA`.
REFUSALS: Final = (
    *("samples", "moving", "unsteady", "contact", "cable", "changed", "lifted", "not-empty", "undecided", "count"),
    "other",  # of a newer version
)
# Bytes that contain the end of the line before, if a power failure cut the last one off.
_TAIL: Final = 1 << 16


def is_weighings(path: Path) -> bool:
    """Whether a file has weighings, by its name."""
    return path.match(FILES)


class WeighingsFile:
    """The weighings of one origin on one day, in a file; other programs may add lines at the same time."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.header: Mapping[str, JSON] = {}
        self.size = 0
        """Bytes that were read."""
        self.weighings = 0
        """Number of weighings of a part: an empty gripper does not count."""
        self.refusals = dict.fromkeys(REFUSALS, 0)
        self.last: Mapping[str, JSON] = {}
        """The last line of a part."""
        self._lines = 0

    @classmethod
    def of(cls, folder: Path, origin: Mapping[str, JSON], day: str) -> Self:
        """Return the file of an origin, which is the rest of its header, on a day as ISO 8601."""
        key = hashlib.sha256(json.dumps(origin, sort_keys=True).encode()).hexdigest()[:8]
        found = cls(folder / FILES.replace("*", f"{day}-{key}"))
        found.header = {"format": FORMAT, "day": day, **origin}
        return found

    def append(self, lines: Sequence[Mapping[str, JSON]]) -> None:
        """Add lines, and the header to a new file; returns when they are on disk. Raises `OSError`."""
        import fcntl

        from ftdrive.runs.numbers import append_lines

        self.path.parent.mkdir(parents=True, exist_ok=True)
        with self.path.open("a+b", buffering=0) as file:
            fcntl.flock(file, fcntl.LOCK_EX)
            end = file.seek(0, os.SEEK_END)
            file.seek(max(0, end - _TAIL))
            tail = file.read()
            # A power failure may have cut off the last line.
            begin = end - len(tail) + tail.rfind(b"\n") + 1
            file.truncate(begin)
            append_lines(file, begin, [*([] if begin else [self.header]), *lines])
            try:
                os.fsync(file.fileno())
            except OSError:
                file.truncate(begin)
                raise

    def read(self) -> None:
        """Read the lines since the last call; a last line without its end does not count.

        Raises
        ------
        BadDataset
            The file is damaged or of another format.
        OSError
        """
        # Imported here, because a list of weighings from the store needs no zipfile.
        from ftdrive.runs.numbers import read_line

        with open_file(self.path) as file:
            file.seek(self.size)
            for line in read_lines(file, BadDataset, self._lines + 1):
                if not line.endswith(b"\n"):
                    break
                if (found := read_line(line.decode(errors="replace"))) is None:
                    raise BadDataset(f"line {self._lines + 1} of the weighings is damaged: take the file from a copy")
                self._take(found)
                self._lines += 1
                self.size += len(line)
        if not self._lines:
            raise BadDataset("the file has no weighings: delete it")

    def _take(self, line: dict[str, Any]) -> None:
        if not self._lines:
            check_format(line, FORMAT, BadDataset)
            self.header = line
        elif (code := line.get("refused")) is not None:
            self.refusals[code if code in self.refusals else "other"] += 1
        elif line.get("is_something"):
            self.weighings += not line.get("poses", 1) > 1  # more poses of the same part
            self.last = line
