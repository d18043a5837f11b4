"""A run folder: the plan, every pose with its raw samples, and the results.

run.json          ftdrive.run/1: time, command line, versions, configuration, devices
plan.json         ftdrive.plan/2: the plan that the arm followed; missing if the operator moved the arm
events.ndjson     the events of the session, one object per line, see `ftdrive.session.events`
motion.npz        ftdrive.motion/1: all samples in motion, later motion-2.npz; motion/1.npz ... for a recording in parts
poses/01.npz ...  ftdrive.recording/1: one file per pose, on disk before the arm moves on; 01-2.npz replaces 01.npz
dataset.json      ftdrive.dataset/1: means and covariances; dataset-2.json after poses were added or taken again
calibration.json  ftdrive.calibration/2: the result, or the accepted update of a verification; later calibration-2.json
verification.json ftdrive.verification/1: the outcome of a verification; see `ftdrive.runs.verification`
solved-0.1.0.json ftdrive.calibration/2: the result of a later version; see `ftdrive.fleet.resolve`
lock              the process that adds poses, or the last one that did

Damaged files are rejected: JSON files have a checksum, and each line of events.ndjson and each array a CRC-32.
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

# Name of the event `ftdrive.session.events.PoseTaken` in events.ndjson.
POSE = "pose-taken"

_RESTORE = "restore it from a copy"
LOCK: Final = "lock"
# Arrays of samples in the file of a pose, named as in `FtSamples`.
_SAMPLE_COLUMNS = ("t_host_ns", "t_device_s", "seq", "counts", "wrench", "status")

# Mode of a session: how the arm moves, or how its motion is recorded.
Mode = Literal["auto", "step", "manual", "listen", "sweep", "passive"]
# Modes that record while the arm moves; such a run cannot be resumed.
IN_MOTION: Final = ("sweep", "passive")


@dataclass(frozen=True, slots=True, eq=False)
class Reading:
    """State of the arm before or after the samples of a pose, as read from its file."""

    t_host_ns: int
    q_rad: Array
    R_base_flange: Array


class Run(Displayed):
    """A run folder on disk. During a `with` block no other process can add poses.

    Parameters
    ----------
    folder : str or Path
    clock : Clock
        Clock of the cell from which poses are added; each pose records the offset from its `t_host_ns` to UTC.

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
        self._clock_offset_ns = time.time_ns() - clock.now_ns()  # UTC minus host time
        self._events_lock = threading.Lock()
        self._held = ExitStack()

    def __enter__(self) -> Self:
        """Lock the folder until the block or the process ends. Raises `ConfigError` if another process locks it."""
        try:
            import fcntl
        except ImportError:  # on Windows, where no session runs
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
            except OSError as error:  # such as a network drive without locks
                log.warning("%s cannot be locked (%s): do not resume this run in two processes", self.folder, error)
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
        data = "a recording in motion" if self.in_motion else f"{len(self.stops())} poses"
        devices = header.get("devices", {})
        rows = [
            Row("made by", [f"{self.command}, {header.get('created_utc', 'at an unknown time')}"]),
            *(Row(role, [f"{device.get('model')} {device.get('serial')}"]) for role, device in devices.items()),
            Row("data", [data]),
            Row("calibration", [self.calibration_path.name if self.calibration_path.exists() else "none"]),
        ]
        return Summary(title, rows)

    @classmethod
    def create(cls, parent: Path, name: str, description: Mapping[str, Any], clock: Clock = REAL) -> "Run":
        """Make a new folder `<UTC time>-<name>` with its run.json, and return the run."""
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
        """Path of the newest calibration.json, calibration-2.json and so on; it may not exist."""
        return newest_path(self.folder / "calibration.json")

    @property
    def dataset_path(self) -> Path:
        """Path of the newest dataset.json, dataset-2.json and so on; it may not exist."""
        return newest_path(self.folder / "dataset.json")

    @property
    def motion_path(self) -> Path:
        """Path of the newest recording in motion: a file, or a folder with its parts; it may not exist."""
        folder = self.folder / "motion"
        return folder if folder.is_dir() else newest_path(self.folder / "motion.npz")

    @property
    def in_motion(self) -> bool:
        """Whether the run has a recording in motion instead of poses."""
        return self.motion_path.is_file() or any(self.motion_path.glob("*.npz"))

    @property
    def plan_path(self) -> Path:
        """Path of plan.json; it does not exist if the operator moved the arm."""
        return self.folder / "plan.json"

    @property
    def command(self) -> str:
        """Command that made the run: "calibrate" or "verify"."""
        return str(self.header().get("command", "calibrate"))

    @property
    def mode(self) -> "Mode":
        """Mode of the session that made the run. Raises `BadDataset` if run.json is damaged."""
        mode: Mode = self.header().get("mode", "auto")
        return mode

    @property
    def resume_command(self) -> str:
        """Command that resumes the run."""
        return f"ftdrive {self.command} --resume {shlex.quote(str(self.folder))}"

    @property
    def how_to_go_on(self) -> str:
        """What to do if the run has too few data for a result: resume it, or start again if it is in motion."""
        if self.mode in IN_MOTION:
            return f"start again with --{self.mode}, because a recording in motion cannot be resumed"
        return f"continue it with {self.resume_command}"

    @property
    def method(self) -> Method:
        """Calibration method by which the poses of the run are solved, such as "ml"."""
        method: Method = self.header().get("method", "ml")
        return method

    @property
    def solve_command(self) -> str:
        """Command that solves the data of the run again."""
        with_it = "" if self.method == "ml" else f" --method {self.method}"
        return f"ftdrive solve {shlex.quote(str(self.folder))}{with_it}"

    def new_path(self, name: str, ending: str = ".json") -> Path:
        """Return the first unused path of name.json, name-2.json and so on in the run folder."""
        return unused_path(self.folder / f"{name}{ending}")

    def append_event(self, event: Mapping[str, Any], *, sync: bool = False) -> None:
        """Append an event to events.ndjson; with `sync`, return once it is on disk. Any thread may call this method."""
        with self._events_lock, self._events_path.open("ab", buffering=0) as file:
            append_lines(file, file.tell(), [event])
            if sync:
                os.fsync(file.fileno())

    def events(self) -> Iterator[Mapping[str, Any]]:
        """Yield the events in events.ndjson. An incomplete last line is ignored; other damage raises `BadDataset`."""
        path = self._events_path
        text = read_file(path).decode(errors="replace") if path.exists() else ""
        *lines, rest = text.split("\n")
        for number, line in enumerate(lines, 1):
            if (event := parse_line(line)) is None:
                raise BadDataset(f"{path}: line {number} is damaged: {_RESTORE}")
            yield event
        # The last line is an event if only its newline is missing or damaged.
        if (event := parse_line(rest) or parse_line(rest[:-1])) is not None:
            yield event

    @property
    def _events_path(self) -> Path:
        return self.folder / "events.ndjson"

    def _remove_incomplete_event(self) -> None:
        """Remove a last line of events.ndjson that a power failure cut short, so that the next event is readable."""
        if self._events_path.exists():
            os.truncate(self._events_path, read_file(self._events_path).rfind(b"\n") + 1)

    def temperature_C(self) -> float | None:
        """Return the sensor's mean temperature over the poses, °C; None if the sensor reported no temperature."""
        by_stop = {
            event.get("stop"): event.get("temperature_C") for event in self.events() if event.get("event") == POSE
        }
        known = [float(value) for value in by_stop.values() if isinstance(value, int | float)]
        return sum(known) / len(known) if known else None

    def header(self) -> Mapping[str, Any]:
        """Return the contents of run.json; raises `BadDataset` if it is damaged."""
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
        """Return the contents of run.json. Raises `BadDataset` if it is damaged, or if a needed plan is missing."""
        header = self.header()
        for section, key in (("robot", "host"), ("sensor", "url")):
            header["config"][section][key]  # raise `BadDataset` if it is missing
        if self.mode in ("auto", "step") and not self.plan_path.is_file():
            raise BadDataset(
                f"{self.plan_path} is missing, and without its plan the run cannot be resumed: {_RESTORE}, or solve "
                f"the poses taken so far with {self.solve_command}"
            )
        return header

    def commit(self, record: PoseRecord) -> PoseRecord:
        """Write a pose to a new file; once it is on disk, return it with its clock offset, as `records` reads it."""
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
        """Read all poses in the order of the tour; for a pose that was taken again, only the newest."""
        return [_read_pose_record(newest_path(self.folder / "poses" / f"{stop:02d}.npz")) for stop in self.stops()]

    def stops(self) -> list[int]:
        """Return the numbers of the stops with a stored pose, by the names of their files."""
        names = {path.stem.partition("-")[0] for path in (self.folder / "poses").glob("*.npz")}
        return sorted(int(name) for name in names if name.isdecimal())


_Kind = tuple[str, Callable[[Any], bool]]
_TEXT: _Kind = "a string", lambda value: isinstance(value, str)
_TEXT_OR_NULL: _Kind = "a string or null", lambda value: isinstance(value, str | None)
_TEXTS: _Kind = "a list of strings", lambda value: isinstance(value, list) and all(map(_TEXT[1], value))
_OBJECT: _Kind = "an object", lambda value: isinstance(value, dict)
_OBJECTS: _Kind = "an object of objects", lambda value: _OBJECT[1](value) and all(map(_OBJECT[1], value.values()))
# Types of the fields of run.json; `read_recorded` checks the fields of its section config.
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
        section = header
        for key in above:
            section = section.get(key, {})
        if name in section and not fits(section[name]):
            raise BadDataset(f"'{place}' is {section[name]!r}, not {words}; the file is damaged: {_RESTORE}")


class _Whole(dict[str, Any]):
    """A JSON object in run.json. A key that it lacks raises `BadDataset`, whose message names the file and the key."""

    def __init__(self, path: Path, content: Mapping[str, Any]) -> None:
        super().__init__(
            {name: _Whole(path, value) if isinstance(value, dict) else value for name, value in content.items()}
        )
        self._path = path

    def __missing__(self, name: str) -> Any:
        raise BadDataset(f"{self._path} is damaged, because it has no '{name}': {_RESTORE}")


def _read_pose_record(path: Path) -> PoseRecord:
    try:
        data = read_arrays(path)
        version = str(data.get("format"))
        if version != RECORDING_FORMAT:
            raise BadDataset(f"{path} has format {version!r}, but this version reads {RECORDING_FORMAT}")
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
