"""A run folder: the plan, every pose with its raw samples, and the results.

run.json          ftdrive.run/1: when, with what, command line, versions, configuration, devices
plan.json         ftdrive.plan/2: the plan the arm followed; not where a person moved it
events.ndjson     what happened, one object a line, as `ftdrive.session.events` has it
motion.npz        ftdrive.motion/1: every sample of sensor and arm while the tool moved; motion-2.npz likewise
motion/1.npz ...  the same in parts, each on disk within seconds, of a recording that may end at any time
poses/01.npz ...  ftdrive.recording/1: one file per pose, on disk before the arm moves on; 01-2.npz took its place
dataset.json      ftdrive.dataset/1: means and covariances; dataset-2.json after poses were added or taken again
calibration.json  ftdrive.calibration/2: the result; calibration-2.json likewise. Of a verification: the accepted update
verification.json ftdrive.verification/1: the outcome of a verification; see `ftdrive.runs.verification`
solved-0.1.0.json ftdrive.calibration/2: the result of a later version; see `ftdrive.fleet.resolve`
lock              which process adds poses, or did so last

Damage is refused: JSON files have a checksum, each line of events.ndjson a CRC-32, and each array of a pose too.
"""

import logging
import os
import platform
import shlex
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from itertools import count
from pathlib import Path
from typing import Any, Final, Literal, Self, get_args

import numpy as np

from ftcalib.display import Displayed, Row, Summary
from ftcalib.errors import BadDataset
from ftcalib.files import check_format, newest_path, read_file, read_object, unused_path, write_object
from ftcalib.model import Array
from ftcalib.result import Method
from ftcalib.routine import PoseRecord, TourPose
from ftdrive.cell.config import read_recorded
from ftdrive.errors import ConfigError
from ftdrive.runs.calibration import made_now
from ftdrive.runs.numbers import DAMAGE, append_lines, parse_line, read_arrays, write_arrays
from ftdrivers.clock import REAL, Clock
from ftdrivers.interfaces import FtSamples

RUN_FORMAT = "ftdrive.run/1"
RECORDING_FORMAT = "ftdrive.recording/1"
log = logging.getLogger(__name__)

# The event of a pose that is on disk, `ftdrive.session.events.PoseTaken`.
POSE = "pose-taken"

_RESTORE = "take it from a copy"
LOCK: Final = "lock"
# Columns of a recording, named as in `FtSamples`.
_SAMPLE_COLUMNS = ("t_host_ns", "t_device_s", "seq", "counts", "wrench", "status")

# How a session moves from pose to pose.
Mode = Literal["auto", "step", "manual", "listen", "sweep", "passive"]
# Modes that record in motion; such a recording is not continued.
IN_MOTION: Final = ("sweep", "passive")


@dataclass(frozen=True, slots=True, eq=False)
class Reading:
    """One look at the arm, read back from a recording."""

    t_host_ns: int
    q_rad: Array
    R_base_flange: Array


class Run(Displayed):
    """A run folder on disk. In a `with` block no other process can add poses.

    Parameters
    ----------
    folder : str or Path
    clock : Clock
        Of the cell whose poses are added: each is kept with what to add to its `t_host_ns` for UTC.

    Examples
    --------
    >>> import ftdrive
    >>> run = ftdrive.Run("runs/gripper")
    >>> run.stops()  # the poses taken; run.records() reads their samples
    [1, 2, 3, 4, 5, 6]
    >>> ftdrive.read_dataset(run.folder).wrench.shape
    (6, 6)
    >>> ftdrive.read_calibration(run.folder).n_poses
    6
    """

    def __init__(self, folder: str | Path, clock: Clock = REAL) -> None:
        self.folder = Path(folder)
        self._clock_offset_ns = time.time_ns() - clock.now_ns()  # the anchor of all times in the files
        self._events_lock = threading.Lock()
        self._held = ExitStack()

    def __enter__(self) -> Self:
        """Lock the folder until the block or the process ends; raises `ConfigError` if another process holds it."""
        try:
            import fcntl
        except ImportError:  # not on Windows, where no session runs
            return self
        with ExitStack() as stack:
            file = stack.enter_context((self.folder / LOCK).open("a+"))
            try:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError as error:
                file.seek(0)
                raise ConfigError(
                    f"{self.folder} is in use by {file.read() or 'another process'}: wait until it ends, or end it"
                ) from error
            except OSError as error:  # of a network drive without locks
                log.warning("%s cannot be locked (%s): do not resume this run twice at once", self.folder, error)
            file.truncate(0)
            file.write(f"process {os.getpid()} on {platform.node()} since {datetime.now(UTC):%Y-%m-%d %H:%M:%S} UTC")
            file.flush()
            self._remove_incomplete_event()
            self._held = stack.pop_all()
        return self

    def __exit__(self, *_: object) -> None:
        self._held.close()

    def _summary(self) -> Summary:
        title = f"Run {self.folder}"
        try:
            header = self.header()
        except (BadDataset, OSError) as error:
            return Summary(title, notes=[str(error)])
        taken = "a recording in motion" if self.in_motion else f"poses {len(self.stops())}"
        devices = header.get("devices", {})
        rows = [
            Row("made by", [f"{self.command}, {header.get('created_utc', 'at an unknown time')}"]),
            *(Row(name, [f"{one.get('model')} {one.get('serial')}"]) for name, one in devices.items()),
            Row("data", [taken]),
            Row("calibration", [self.calibration_path.name if self.calibration_path.exists() else "none"]),
        ]
        return Summary(title, rows)

    @classmethod
    def create(cls, parent: Path, name: str, description: Mapping[str, Any], clock: Clock = REAL) -> "Run":
        """Make a new folder `<UTC time>-<name>` and write its run.json."""
        made = made_now()
        now = datetime.fromisoformat(made["created_utc"])
        folder = parent / f"{now:%Y-%m-%dT%H%M%SZ}-{name}"
        for number in count(2):
            try:
                folder.mkdir(parents=True)
                break
            except FileExistsError:
                folder = parent / f"{now:%Y-%m-%dT%H%M%SZ}-{name}-{number}"
        (folder / "poses").mkdir()
        header = {"format": RUN_FORMAT, **made, "created_host_ns": clock.now_ns(), **description}
        write_object(folder / "run.json", header, allow_nan=True)
        return cls(folder, clock)

    @property
    def calibration_path(self) -> Path:
        """Where the newest result is kept."""
        return newest_path(self.folder / "calibration.json")

    @property
    def dataset_path(self) -> Path:
        """Where the newest dataset is kept."""
        return newest_path(self.folder / "dataset.json")

    @property
    def motion_path(self) -> Path:
        """Where the newest recording in motion is kept: a file, or a folder of parts."""
        folder = self.folder / "motion"
        return folder if folder.is_dir() else newest_path(self.folder / "motion.npz")

    @property
    def in_motion(self) -> bool:
        """Whether it holds a recording in motion instead of poses."""
        return self.motion_path.is_file() or any(self.motion_path.glob("*.npz"))

    @property
    def plan_path(self) -> Path:
        """Where the plan is kept."""
        return self.folder / "plan.json"

    @property
    def command(self) -> str:
        """Command that made the run: "calibrate" or "verify"."""
        return str(self.header().get("command", "calibrate"))

    @property
    def mode(self) -> "Mode":
        """How its session went from pose to pose. Raises `BadDataset`."""
        mode: Mode = self.header().get("mode", "auto")
        return mode

    @property
    def resume_command(self) -> str:
        """Command that continues the run."""
        return f"ftdrive {self.command} --resume {shlex.quote(str(self.folder))}"

    @property
    def how_to_go_on(self) -> str:
        """What to do about a run without data for a result. Raises `BadDataset`."""
        if self.mode in IN_MOTION:
            return f"start again with --{self.mode}, because a recording in motion is not continued"
        return f"continue it with {self.resume_command}"

    @property
    def method(self) -> Method:
        """Method by which the poses are solved."""
        method: Method = self.header().get("method", "ml")
        return method

    @property
    def solve_command(self) -> str:
        """Command that solves the poses taken."""
        with_it = "" if self.method == "ml" else f" --method {self.method}"
        return f"ftdrive solve {shlex.quote(str(self.folder))}{with_it}"

    def new_path(self, name: str, ending: str = ".json") -> Path:
        """Give the next free path for a file that may be written again: name.json, name-2.json and so on."""
        return unused_path(self.folder / f"{name}{ending}")

    def append_event(self, event: Mapping[str, Any], *, sync: bool = False) -> None:
        """Add a line to events.ndjson, or nothing; with `sync` return when it is on disk. Any thread."""
        with self._events_lock, self._events_path.open("ab", buffering=0) as file:
            append_lines(file, file.tell(), [event])
            if sync:
                os.fsync(file.fileno())

    def events(self) -> Iterator[Mapping[str, Any]]:
        """Read events.ndjson; a last line cut off by a power failure is ignored. Raises `BadDataset` for any other."""
        path = self._events_path
        text = read_file(path).decode(errors="replace") if path.exists() else ""
        *lines, rest = text.split("\n")
        for number, line in enumerate(lines, 1):
            if (event := parse_line(line)) is None:
                raise BadDataset(f"{path}: line {number} is damaged: {_RESTORE}")
            yield event
        # What follows the last line is an event if only the end of its line is damaged.
        if (event := parse_line(rest) or parse_line(rest[:-1])) is not None:
            yield event

    @property
    def _events_path(self) -> Path:
        return self.folder / "events.ndjson"

    def _remove_incomplete_event(self) -> None:
        """Remove what a power failure left of the last line, so that the next event begins a new one."""
        if self._events_path.exists():
            os.truncate(self._events_path, read_file(self._events_path).rfind(b"\n") + 1)

    def temperature_C(self) -> float | None:
        """Return the mean temperature of the sensor over the poses; None where it reported none."""
        found = {event.get("stop"): event.get("temperature_C") for event in self.events() if event.get("event") == POSE}
        known = [float(value) for value in found.values() if isinstance(value, int | float)]
        return sum(known) / len(known) if known else None

    def header(self) -> Mapping[str, Any]:
        """Read run.json; raises `BadDataset` if it is damaged."""
        path = self.folder / "run.json"
        if not path.exists():
            raise BadDataset(f"{self.folder} is not a run folder: it has no run.json")
        try:
            header = read_object(path, BadDataset)
            check_format(header, RUN_FORMAT, BadDataset)
            _require_kinds(header)
            if "config" in header:
                header["config"] = read_recorded(header["config"])
        except (BadDataset, ConfigError) as error:
            raise BadDataset(f"{path}: {error}") from error
        return _Whole(path, header)

    def header_to_resume(self) -> Mapping[str, Any]:
        """Read run.json; raises `BadDataset` also if the plan of the run is lost."""
        header = self.header()
        for section, key in (("robot", "host"), ("sensor", "url")):
            header["config"][section][key]  # raises if it is missing
        if self.mode in ("auto", "step") and not self.plan_path.is_file():
            raise BadDataset(
                f"{self.plan_path} is lost, and without its plan a run cannot go on: {_RESTORE}, or solve the poses "
                f"that are there with {self.solve_command}"
            )
        return header

    def commit(self, record: PoseRecord) -> PoseRecord:
        """Write one pose; returns it, as `records` reads it, when it is on disk."""
        record = replace(record, clock_offset_ns=record.clock_offset_ns or self._clock_offset_ns)
        readings: dict[str, Any] = {
            f"{when}_{name}": np.asarray(getattr(reading, name))
            for when, reading in (("before", record.before), ("after", record.after))
            for name in ("t_host_ns", "q_rad", "R_base_flange")
        }
        arrays = {
            "format": np.array(RECORDING_FORMAT),
            "stop": np.array(record.stop),
            "number": np.array(record.pose.number),
            "q_target_rad": record.pose.q_rad,
            "steady": np.array(record.steady),
            "clock_offset_ns": np.array(record.clock_offset_ns),
            **({"swings": np.array(True)} if record.swings else {}),
            **readings,
            **{name: getattr(record.samples, name) for name in _SAMPLE_COLUMNS},
        }
        write_arrays(unused_path(self.folder / "poses" / f"{record.stop:02d}.npz"), arrays, compressed=True)
        return record

    def records(self) -> list[PoseRecord]:
        """Read every pose, in the order of the tour; of a pose taken again, the newest."""
        return [_read_pose_record(newest_path(self.folder / "poses" / f"{stop:02d}.npz")) for stop in self.stops()]

    def stops(self) -> list[int]:
        """Return the stops taken, without reading them."""
        names = {path.stem.partition("-")[0] for path in (self.folder / "poses").glob("*.npz")}
        return sorted(int(name) for name in names if name.isdecimal())


_Kind = tuple[str, Callable[[Any], bool]]
_TEXT: _Kind = "a text", lambda value: isinstance(value, str)
_TEXT_OR_NULL: _Kind = "a text or null", lambda value: isinstance(value, str | None)
_TEXTS: _Kind = "a list of texts", lambda value: isinstance(value, list) and all(map(_TEXT[1], value))
_OBJECT: _Kind = "an object", lambda value: isinstance(value, dict)
_OBJECTS: _Kind = "an object of objects", lambda value: _OBJECT[1](value) and all(map(_OBJECT[1], value.values()))
# Types of the fields of run.json; `recorded` checks those of config.
_KINDS: Mapping[str, _Kind] = {
    "config": _OBJECTS,
    "command": _TEXT,
    "devices": _OBJECTS,
    "devices.arm.serial": _TEXT,
    "devices.sensor.serial": _TEXT,
    "devices.sensor.facts": _OBJECTS,
    "mode": (f"one of {', '.join(get_args(Mode))}", lambda value: value in get_args(Mode)),
    "said": _OBJECT,
    "said.config": _TEXT_OR_NULL,
    "said.robot": _TEXT_OR_NULL,
    "said.sensor": _TEXT_OR_NULL,
    "said.tool": _TEXTS,
    "station": _OBJECT,
    "station.sensor": _TEXT,
    "station.options": _TEXTS,
    "verification": _OBJECT,
    "load": _OBJECT,
}


def _require_kinds(header: Mapping[str, Any]) -> None:
    for place, (words, fits) in _KINDS.items():
        *above, name = place.split(".")
        found = header
        for one in above:
            found = found.get(one, {})
        if name in found and not fits(found[name]):
            raise BadDataset(f"'{place}' is {found[name]!r} and not {words}, the file is damaged: {_RESTORE}")


class _Whole(dict[str, Any]):
    """An object of run.json; a missing key raises an error that names the file."""

    def __init__(self, path: Path, content: Mapping[str, Any]) -> None:
        super().__init__(
            {name: _Whole(path, value) if isinstance(value, dict) else value for name, value in content.items()}
        )
        self._path = path

    def __missing__(self, name: str) -> Any:
        raise BadDataset(f"{self._path} is damaged, it has no '{name}': {_RESTORE}")


def _read_pose_record(path: Path) -> PoseRecord:
    try:
        data = read_arrays(path)
        found = str(data.get("format"))
        if found != RECORDING_FORMAT:
            raise BadDataset(f"{path} has format {found!r}: this version reads {RECORDING_FORMAT}")
        before, after = (
            Reading(int(data[f"{when}_t_host_ns"]), data[f"{when}_q_rad"], data[f"{when}_R_base_flange"])
            for when in ("before", "after")
        )
        return PoseRecord(
            stop=int(data["stop"]),
            pose=TourPose(int(data["number"]), data["q_target_rad"]),
            before=before,
            after=after,
            samples=FtSamples(*(data[name] for name in _SAMPLE_COLUMNS)),
            steady=bool(data["steady"]),
            clock_offset_ns=int(data.get("clock_offset_ns", 0)),
            swings=bool(data.get("swings", False)),
        )
    except DAMAGE as error:
        raise BadDataset(
            f"{path} is not a recording of a pose ({error}): {_RESTORE}, or move it away and --resume the run"
        ) from error
