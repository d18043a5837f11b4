"""Weighings with a tool: one file per day (UTC), to which every weighing program appends lines.

    {"format": "ftdrive.weighings/1", "day": "2026-11-26", "tool": "gripper", …, "crc32": "…"}
    {"t_utc": "2026-11-26T10:15:00+00:00", "mass_kg": 0.2503, "mass_sigma_kg": 0.0004, …, "crc32": "…"}
    {"t_utc": "2026-11-26T10:15:05+00:00", "refused": "cable", "crc32": "…"}

The file has every weighing. The store has one row per file.
"""

import hashlib
import json
import os
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final, Self

from ftcalib.errors import BadDataset
from ftcalib.files import JSON, check_format, open_file, read_lines
from ftdrive.runs.calibration import number_at, text_at, time_at
from ftdrive.runs.numbers import append_lines, parse_line

FORMAT: Final = "ftdrive.weighings/1"
FOLDER: Final = "weighings"
FILES: Final = "weighings-*.ndjson"
# Codes of the reasons why a weighing gave no mass, see `ftdrive.stream.weighing.WORDS`. Each is a column of the store,
# so a change must increase `ftdrive.store.database.SCHEMA`.
REFUSALS: Final = (
    *("samples", "moving", "unsteady", "contact", "cable", "changed", "lifted", "not-empty", "undecided", "count"),
    "other",  # every code that this version does not know
)
# Number of bytes at the end of a file in which the last line end is searched; no line is as long.
_TAIL: Final = 1 << 16


def append_weighings(folder: Path, origin: Mapping[str, JSON], day: str, lines: Sequence[Mapping[str, JSON]]) -> Path:
    """Append weighings to the file of a day (ISO 8601), and return its path once they are on disk.

    `origin` has the other fields of the file's first line. Other programs may append at the same time. If that fails,
    raises `OSError` and leaves the file without the new lines.
    """
    import fcntl

    key = hashlib.sha256(json.dumps(origin, sort_keys=True).encode()).hexdigest()[:8]
    path = folder / FILES.replace("*", f"{day}-{key}")
    folder.mkdir(parents=True, exist_ok=True)
    with path.open("a+b", buffering=0) as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        end = file.seek(0, os.SEEK_END)
        file.seek(max(0, end - _TAIL))
        tail = file.read()
        # Remove a last line that a power failure cut short.
        begin = end - len(tail) + tail.rfind(b"\n") + 1
        file.truncate(begin)
        append_lines(file, begin, [*([] if begin else [{"format": FORMAT, "day": day, **origin}]), *lines])
        try:
            os.fsync(file.fileno())
        except OSError:
            file.truncate(begin)
            raise
    return path


@dataclass(frozen=True, slots=True, kw_only=True)
class WeighingDay:
    """The weighings on one day (UTC) with one calibration on one arm: one file, or the sum of several files."""

    id: str
    """Name of the weighing file without its extension."""
    path: str
    day: str = ""
    """Day (UTC) in ISO 8601."""
    tool: str | None = None
    arm_serial: str | None = None
    sensor_serial: str | None = None
    robot_host: str | None = None
    calibration_id: str | None = None
    emulated: bool = False
    size: int = 0
    """Number of bytes of the file that are included here; later bytes are new lines."""
    weighings: int = 0
    """Number of weighed parts; weighings of an empty gripper do not count."""
    refusals: Mapping[str, int]
    """Numbers of weighings that gave no mass, by the reason, a code in `REFUSALS`."""
    last_utc: str | None = None
    """Time at which the last part was weighed."""
    mass_kg: float | None = None
    mass_sigma_kg: float | None = None

    @classmethod
    def load(cls, path: Path, before: Self | None = None) -> Self:
        """Read a file, or continue from the state `before`; an incomplete last line is not read.

        Raises
        ------
        BadDataset
            The file is damaged, or has another format.
        OSError
            The file cannot be read.
        """
        total = before or cls(id=path.stem, path=str(path), refusals=dict.fromkeys(REFUSALS, 0))
        size, weighings, refusals, last = total.size, total.weighings, {**total.refusals}, None
        with open_file(path) as file:
            first = 1 + file.read(size).count(b"\n")
            for number, line in enumerate(read_lines(file, BadDataset, first), first):
                if not line.endswith(b"\n"):
                    break
                if (content := parse_line(line.decode(errors="replace"))) is None:
                    raise BadDataset(f"line {number} of the weighings is damaged: restore the file from a copy")
                if number == 1:
                    check_format(content, FORMAT, BadDataset)
                    names = ("tool", "arm_serial", "sensor_serial", "robot_host", "calibration_id")
                    origin: dict[str, Any] = {name: text_at(content, name) for name in names}
                    day, emulated = text_at(content, "day") or "", content.get("emulated") is True
                    total = replace(total, day=day, emulated=emulated, **origin)
                elif (code := content.get("refused")) is not None:
                    refusals[code if code in refusals else "other"] += 1
                elif content.get("is_something"):
                    weighings += not content.get("poses", 1) > 1  # further poses of one part do not count
                    last = content
                size += len(line)
        if not size:
            raise BadDataset("the file has no weighings: delete it")
        if last is not None:
            mass_kg, sigma_kg = number_at(last, "mass_kg"), number_at(last, "mass_sigma_kg")
            total = replace(total, last_utc=time_at(last, "t_utc"), mass_kg=mass_kg, mass_sigma_kg=sigma_kg)
        return replace(total, size=size, weighings=weighings, refusals=refusals)


def sum_up(days: Iterable[WeighingDay]) -> list[WeighingDay]:
    """Return for each tool and arm its last day with weighings: the sum over that day's files, the oldest day first."""
    last = dict[tuple[object, ...], WeighingDay]()
    for part in sorted(days, key=lambda part: (part.day, part.last_utc or "", part.id)):
        key = (part.tool, part.arm_serial, part.robot_host, part.emulated)
        before = last.pop(key, None)
        if before is not None and before.day == part.day:
            refusals = {code: number + before.refusals[code] for code, number in part.refusals.items()}
            last[key] = replace(part, weighings=part.weighings + before.weighings, refusals=refusals)
        else:
            last[key] = part
    return [*last.values()]
