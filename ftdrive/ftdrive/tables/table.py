"""Tables of wrenches and poses, from text or memory, converted to the units and frames of ftdrive."""

import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Final, Literal, NamedTuple, Protocol, get_args

import numpy as np
from scipy.spatial.transform import Rotation

from ftcalib import CalibrationDataset
from ftcalib.data.dataset import LARGEST, Orientation, proper_rotations
from ftcalib.data.dwell_mean import LEAST_SAMPLES, QUIET, mean_and_covariance
from ftcalib.errors import BadDataset
from ftcalib.files import JSON
from ftcalib.model import Array, angle_between, nearest_rotation
from ftcalib.rounding import counted
from ftdrive.errors import ConfigError
from ftdrive.tables.columns import COUNTS, UNITS, Signal, SignalColumns, factor
from ftdrive.tables.text import TextTable, seconds_of

WrenchAxes = Literal["sensor", "flange", "tcp", "base"]
# Axis sequences of Euler angles as in SciPy: upper case for rotations about tool axes, lower case about base axes.
_MAKERS: Final = {"rpy": "xyz", "abc": "ZYX", "wpr": "xyz", "oat": "ZYZ"}
# For each form of orientation, the axes to which its angle columns belong, in the order of the columns.
_AXES: Final = {"rpy": "xyz", "abc": "zyx", "wpr": "xyz", "oat": "zyz", "vector": "xyz", "angles": "xyz"}
_ORIENTATIONS: Final = (
    *("matrix", "quaternion", "quaternion_w_first", "transform", "tcp_pose", "vector", "rpy", "abc", "wpr", "oat"),
    *("angles", "joints", "gravity", "acceleration"),
)
# Forms of the orientation that the message about a missing one compares with the table, the most likely first.
_NEAREST: Final = ("quaternion", "matrix", "vector", "rpy", "abc", "tcp_pose")
_KIND: Final = {
    "time": "time",
    "position": "length",
    "acceleration": "acceleration",
    **dict.fromkeys((*_AXES, "joints"), "angle"),
}
_LONGEST_VECTOR_RAD = 2 * np.pi + 0.01
# Largest accepted deviation of a quaternion's norm from 1, as for values that are rounded to two decimals.
_ROUNDED_LENGTH = 0.01
# If values without a unit exceed these, angles (two turns) are in degrees, and positions (any arm's reach) in mm.
_MOST_RAD, _MOST_M = 4 * np.pi, 10.0
_UNITS_OF_TIME: Final = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}
# Times since 1970 in this range, s (1990 to 2100), are taken as Unix times.
_EPOCH_S: Final = (6.3e8, 4.1e9)
# A recording has time steps, s, in this range (50 kHz to 5 Hz), and at least this number of rows.
_STEPS_S: Final = (2e-5, 0.2)
_RECORDING_ROWS = 200
# Range of the time from pose to pose, s. Times without a unit that give other steps are not in s.
_POSE_STEPS_S: Final = (0.5, 1e3)
# Rows of a table whose orientations differ by less than this, as from encoder noise and rounding, are at rest.
_AT_REST_RAD: Final = float(np.radians(0.2))
# If at least this share of a table's rows is at rest, the arm stopped at poses, and the other rows are moves.
_MOSTLY: Final = 0.9
# A gravity vector this close to straight up is turned down about x, because any horizontal axis would do.
_UPSIDE_DOWN = 1e-9


@dataclass(frozen=True, slots=True, eq=False)
class TableOptions:
    """Facts that are needed to read a table of another program, and that the table itself does not contain.

    Raises
    ------
    ConfigError
        The order of the angles, the text format or the rate is invalid.

    Examples
    --------
    >>> import ftdrive
    >>> table = ftdrive.TableOptions(columns={"t": "t [ms]"}, sign=1)
    >>> bool(ftdrive.read_dataset("poses.csv", table=table).t_s.max() < 1)
    True
    """

    columns: Mapping[str, str] = field(default_factory=dict)
    """Columns of the table by their names in ftdrive, with a unit if needed: ``{"fx": "Force X [kgf]"}``."""
    separator: Literal["", ",", ";", "\t", " "] = ""
    """Separator of the columns in a text table; if empty, it is recognised."""
    decimal: Literal["", ".", ","] = ""
    """Decimal mark in a text table; if empty, it is recognised."""
    rate_Hz: float | None = None
    """Sample rate of a table without times; None if the table has times, or poses at rest."""
    euler: str = ""
    """Order of the three angles: rpy, ABC, WPR, OAT, or three axes, such as ZYX (tool axes) or xyz (base axes)."""
    wrench_axes: WrenchAxes | None = None
    """Axes and reference point of the wrench; None means those of the program that wrote the table, usually sensor."""
    R_flange_tcp: Array = field(default_factory=lambda: np.eye(3))
    """(3, 3) orientation of the TCP relative to the flange, if the poses in the table are those of the TCP."""
    p_flange_tcp_m: Array = field(default_factory=lambda: np.zeros(3))
    """(3,) position of the TCP in flange axes, if the poses in the table are those of the TCP."""
    sign: Literal[1, -1] = 1
    """Factor of the wrench: -1 for a sensor that reports the reaction, with the opposite sign."""
    forward: Callable[[Array], tuple[Array, Array]] | None = None
    """Forward kinematics: returns R_base_flange (n, 3, 3) and p_base_flange_m (n, 3) for joint angles (n, 6), rad."""

    def __post_init__(self) -> None:
        if self.euler and self.euler.lower() not in _MAKERS and not re.fullmatch("[xyz]{3}|[XYZ]{3}", self.euler):
            makers = ", ".join(name if name == "rpy" else name.upper() for name in _MAKERS)
            raise ConfigError(
                f"--euler {self.euler}: give {makers}, or three axes such as ZYX (tool axes) or xyz (base axes)"
            )
        if self.separator not in ("", ",", ";", "\t", " ") or self.decimal not in ("", ".", ","):
            given = f"separator {self.separator!r}, decimal {self.decimal!r}"
            raise ConfigError(f"[text]: {given}: give a comma, semicolon, tab or space, and a point or comma")
        if self.rate_Hz is not None and not self.rate_Hz > 0:
            raise ConfigError(f"--rate {self.rate_Hz:g}: give the number of samples per second")


_JOINTS_ONLY = "the table has joint angles but no orientation: add --model, such as UR5e, or --urdf FILE"
_ANGLES_ONLY = "the order of the three angles is unknown: add --euler, such as ZYX (tool axes) or xyz (base axes)"


class _ColumnSource(Protocol):
    """A table on disk or in memory, of which chosen columns are read in blocks of rows."""

    names: Sequence[str]
    units: Sequence[str]
    words: str
    comments: int
    """Number of commented lines that `blocks` has skipped between the rows."""

    def blocks(self, use: Sequence[int]) -> Iterator[tuple[Array, float]]:
        """Yield blocks of consecutive rows with the k columns `use` (n, k), and the share of the table read so far."""


class _FrameSource:
    """Columns of a pandas or Polars DataFrame, a pyarrow table, or a mapping of names to arrays."""

    words, comments = "", 0

    def __init__(self, frame: Any) -> None:
        self._frame = frame
        columns = frame.keys() if isinstance(frame, Mapping) else getattr(frame, "column_names", None) or frame.columns
        self.names: Sequence[str] = list(map(str, columns))
        self.units: Sequence[str] = [""] * len(self.names)

    def blocks(self, use: Sequence[int]) -> Iterator[tuple[Array, float]]:
        """Yield all rows at once. Raises `BadDataset` if a cell is not a number."""
        try:
            columns = [np.asarray(self._frame[self.names[i]]) for i in use] or [np.empty((0, 0))]
            numbers = [
                seconds_of(column) if column.dtype.kind == "M" else column.astype(np.float64) for column in columns
            ]
            yield np.column_stack(numbers), 1.0
        except (TypeError, ValueError) as error:
            raise BadDataset(f"{error}: put a number into each cell") from error


class SignalRows(NamedTuple):
    """Consecutive rows of one signal in a table."""

    t_s: Array
    """(n,) times."""
    values: Array
    """(n, k) values in SI units."""
    place: float
    """Share of the table read so far, 0 to 1."""


class Table:
    """A table of another program in which time, wrench and orientation are recognised.

    Parameters
    ----------
    source : Path, DataFrame or mapping
    options : TableOptions, optional
    name : str
        Name in messages; by default the name of the file, or of the type of the source.

    Raises
    ------
    BadDataset
        The source is not a table, or a column contradicts its name. A missing signal is an error only if needed.
    OSError
        The source cannot be read.
    """

    def __init__(self, source: Path | Any, options: TableOptions | None = None, name: str = "") -> None:
        self.name = name or (source.name if isinstance(source, Path) else type(source).__name__)
        self.options = options or TableOptions()
        self._guesses: list[str] = []
        self._count = 0
        self._found: dict[str, Signal | None] = {}
        with self._named():
            text = self.options.separator, self.options.decimal
            self.source: _ColumnSource = TextTable(source, *text) if isinstance(source, Path) else _FrameSource(source)
            in_memory = isinstance(self.source, _FrameSource)
            self._columns = SignalColumns(
                self.source.names, self.source.units, self.options.columns, in_memory=in_memory
            )
            self._find()

    def _find(self) -> None:
        """Recognise the table's signals, and the factors of their units, from the columns' names and first rows."""
        find, options = self._columns.find, self.options
        orientation = find(*(_AXES if options.euler else _ORIENTATIONS))
        self._found = {
            "time": None if options.rate_Hz else find("time"),
            "wrench": find("wrench", "flange_wrench", "base_wrench"),
            "orientation": orientation,
            "position": None
            if orientation is None or orientation.form in ("transform", "tcp_pose")
            else find("position"),
            "sigma": find("sigma"),
        }
        signals = [signal for signal in self._found.values() if signal is not None]
        use = sorted({column for signal in signals for column in signal.columns})
        rows, _ = next(self.source.blocks(use), (np.empty((0, len(use))), 1.0))
        first = {signal.form: rows[:, [use.index(column) for column in signal.columns]] for signal in signals}
        self._factors = {signal.form: self._factors_of(signal, first[signal.form]) for signal in signals}
        self._first = {key: first[item.form] * self._factors[item.form] for key, item in self._found.items() if item}

    @property
    def words(self) -> str:
        """One line about the recognised format of the table; empty if names and units are those of ftdrive."""
        programs = {signal.program for signal in self._found.values() if signal} - {"ftdrive", "own program"}
        named = [f"columns of {program}" for program in sorted(programs)]
        if self.options.rate_Hz:  # shown because no check can detect a wrong rate
            named.append(f"{self.options.rate_Hz:g} Hz as given (the inertia depends on its square)")
        return "; ".join(filter(None, [self.source.words, *named, *self._guesses]))

    @property
    def has_nominal_kinematics(self) -> bool:
        """Whether the orientations are computed from the table's joint angles, by uncalibrated kinematics."""
        orientation = self._found["orientation"]
        return orientation is not None and orientation.form == "joints"

    @property
    def gravity_is_measured(self) -> bool:
        """Whether the table has directions of gravity instead of orientations, so rotations about it are unknown."""
        orientation = self._found["orientation"]
        return orientation is not None and orientation.form in ("gravity", "acceleration")

    def has(self, signal: Literal["wrench", "orientation"]) -> bool:
        """Return whether the table has this signal."""
        return self._found[signal] is not None

    @cached_property
    def in_motion(self) -> bool:
        """Whether the table is a recording in motion: many rows at a high rate, or separate rows of two streams."""
        if self.gravity_is_measured or not (self.has("wrench") and self.has("orientation")):
            return False
        wrench, orientation = (np.isfinite(self._first[one]).all(axis=1) for one in ("wrench", "orientation"))
        both = wrench & orientation
        if not both.any():
            return bool(wrench.any() and orientation.any())
        if both.sum() < _RECORDING_ROWS or not (self._found["time"] or self.options.rate_Hz):
            return False
        if self.options.rate_Hz:
            return True
        return bool(np.median(np.diff(self._first["time"].sum(axis=1)[both])) <= _STEPS_S[1])

    def rate_Hz(self, signal: Literal["wrench", "orientation"]) -> float:
        """Return the mean rate of a signal in the first rows, Hz. Raises `BadDataset` for fewer than two rows."""
        if self.options.rate_Hz:
            return self.options.rate_Hz
        self._require_time()
        self._require(signal)
        t_s = self._first["time"].sum(axis=1)[np.isfinite(self._first[signal]).all(axis=1)]
        if len(t_s) < 2:
            raise BadDataset(f"{self.name}: the table has {len(t_s)} rows of the {signal}: at least 2 are needed")
        return (len(t_s) - 1) / max(float(t_s[-1] - t_s[0]), 1e-9)

    def wrenches(self) -> Iterator[SignalRows]:
        """Yield wrenches (n, 6), N and N·m, in sensor or flange axes. Invalid rows raise `BadDataset` in turn."""
        signals = [self._require("wrench")]
        if self._axes == "base":
            signals.append(self._require("orientation"))
        self._require_time()
        for t_s, (read, *pose), place in self._in_order(signals):
            with self._named():
                wrench = self._in_flange(read, pose)
            yield SignalRows(t_s, wrench, place)

    def poses(self) -> Iterator[SignalRows]:
        """Yield R_base_flange by rows, then p_base_flange_m if known: (n, 9 or 12). Errors as for `wrenches`."""
        signals = [self._require("orientation"), *([one] if (one := self._found["position"]) else [])]
        if self.gravity_is_measured:
            raise BadDataset(f"{self.name}: gravity does not determine the rotation about it: give the orientation too")
        self._require_time()
        for t_s, values, place in self._in_order(signals):
            with self._named():
                R, p = self._flange(values)
            yield SignalRows(t_s, np.hstack([R.reshape(-1, 9), *([] if p is None else [p])]), place)

    def dataset(self, orientation: Orientation = "R_base_flange") -> CalibrationDataset:
        """Return the poses at rest: one per row, or one per dwell in a long table. Invalid rows raise `BadDataset`."""
        if orientation not in get_args(Orientation):
            raise ValueError(f"orientation is '{orientation}', expected one of {', '.join(get_args(Orientation))}")
        if self._found["sigma"] is None and self._columns.begins("sigma"):
            raise BadDataset(f"{self.name}: {self._columns.missing('standard errors', 'sigma')}")
        signals = [
            self._require("orientation"),
            self._require("wrench"),
            *([one] if (one := self._found["sigma"]) else []),
        ]
        if len(signals) > 2 and self._axes in ("tcp", "base"):
            raise BadDataset(f"{self.name}: standard errors must be in sensor axes: leave them out, or rotate them")
        times, parts, _ = zip(*self._rows(signals), strict=True)
        t_s = np.concatenate(times)
        pose, wrench, *sigma = (np.concatenate(each) for each in zip(*parts, strict=True))
        if not len(wrench):
            raise BadDataset(
                f"{self.name}: no row has both an orientation and a wrench: give one row per pose, or a recording"
            )
        if missing := self._count - len(wrench):
            self._guesses.append(f"{missing} of {self._count} rows without wrench or orientation left out")
        if comments := self.source.comments:
            self._guesses.append(f"{comments} commented lines between the rows left out")
        if sigma and (sigma[0] <= 0).any():
            row = int(np.argmax((sigma[0] <= 0).any(axis=1)))
            raise BadDataset(
                f"{self.name}: " + _wrong_row(row, f"the standard error {sigma[0][row].min():g} is not above 0")
            )
        with self._named():
            R, _ = self._flange([pose])
            rows = CalibrationDataset(
                R_base_flange=np.swapaxes(R, 1, 2) if orientation == "R_flange_base" else R,
                wrench=self._in_flange(wrench, [pose]),
                wrench_cov=sigma[0][:, :, None] ** 2 * np.eye(6) if sigma else None,
                n_samples=np.zeros(len(wrench), np.int64),
                t_s=t_s - t_s[0],
                meta={"source": self.name, "orientation": orientation, **self._form(signals[0].form)},
            )
        return rows if sigma or len(rows) < _RECORDING_ROWS else self._of_dwells(rows)

    def _of_dwells(self, rows: CalibrationDataset) -> CalibrationDataset:
        """Average the rows of each dwell to one pose; return the rows unchanged if less than 90 % are at rest."""
        dwells = _dwells(rows.R_base_flange, rows.wrench)
        n_samples = np.array([len(range(*dwell.indices(len(rows)))) for dwell in dwells], np.int64)
        if n_samples.sum() < _MOSTLY * len(rows):
            return rows
        self._guesses.append(f"{n_samples.sum():,} rows at rest are {counted(len(dwells), 'pose')}")
        if between := len(rows) - n_samples.sum():
            self._guesses.append(f"{counted(between, 'row')} between them left out")
        means = [mean_and_covariance(rows.wrench[dwell]) for dwell in dwells]
        return replace(
            rows,
            R_base_flange=nearest_rotation(np.array([rows.R_base_flange[dwell].mean(axis=0) for dwell in dwells])),
            wrench=np.array([estimate.mean for estimate in means]),
            wrench_cov=np.array([estimate.covariance for estimate in means]),
            n_samples=n_samples,
            t_s=np.array([rows.t_s[dwell].mean() for dwell in dwells]),
        )

    def _form(self, form: str) -> dict[str, JSON]:
        """Return the notation of the orientations, such as Euler angles, for later checks for its typical mistakes."""
        if form in _AXES and (self.options.euler or form in _MAKERS):
            euler = self.options.euler or form
            return {"form": "euler", "euler": _MAKERS.get(euler.lower(), euler)}
        return {
            "form": {"quaternion_w_first": "quaternion", "transform": "matrix", "tcp_pose": "vector"}.get(form, form)
        }

    def _require_time(self) -> None:
        if self._found["time"] is None and not self.options.rate_Hz:
            words = self._columns.missing("time", "time")
            rate = "rate_Hz=…" if isinstance(self.source, _FrameSource) else "--rate HZ"
            raise BadDataset(f"{self.name}: {words}, or add {rate} if the samples are evenly spaced")

    def _require(self, signal: str) -> Signal:
        """Return a signal. If it is missing, raises `BadDataset` with the line to type in its message."""
        if (columns := self._found[signal]) is not None:
            return columns
        with self._named():
            words = self._columns.missing(signal, *(("wrench",) if signal == "wrench" else _NEAREST))
            # also suggest two files, because a recording in motion often has one file per device
            alone = signal == "orientation" and self.has("wrench") and self._found["time"] is not None
            raise BadDataset(f"{words}, or give poses of their own: --wrench, --orientation-file" if alone else words)

    @contextmanager
    def _named(self) -> Iterator[None]:
        try:
            yield
        except BadDataset as error:
            raise BadDataset(f"{self.name}: {error}") from error

    def _factors_of(self, signal: Signal, first: Array) -> Array:
        """Return a signal's factors to SI units; a missing unit is inferred if the first values leave no doubt."""
        names = [self.source.names[column] for column in signal.columns]
        kinds = {"tcp_pose": ["length"] * 3 + ["angle"] * 3}.get(signal.form, [_KIND.get(signal.form, "")] * len(names))
        if "wrench" in signal.form or signal.form == "sigma":
            kinds = ["force"] * 3 + ["torque"] * 3
        if signal.form == "time" and len(names) == 2:
            return np.array([1.0, 1e-9])
        factors = [
            factor(unit, kind, name) if kind else None
            for unit, kind, name in zip(signal.units, kinds, names, strict=True)
        ]
        if signal.form == "wrench" and any(unit.lower() in COUNTS for unit in signal.units):
            self._guesses.append("wrench in counts")
        largest = float(np.nanmax(np.abs(first), initial=0.0))
        guess = 1.0
        if signal.form == "time" and None in factors:
            unit = _unit_of_time(first[:, 0], names[0])
            guess = _UNITS_OF_TIME[unit]
            self._guesses += [f"time in {unit}"] if unit != "s" else []
        elif kinds[0] == "angle" and None in factors and largest > _MOST_RAD and signal.form != "vector":
            guess = UNITS["angle"]["deg"]
            self._guesses.append("angles in degrees")
        elif kinds[0] == "length" and signal.form == "position" and None in factors and largest > _MOST_M:
            guess = 1e-3
            self._guesses.append("positions in mm")
        return np.array([guess if one is None else one for one in factors])

    def _in_order(self, signals: Sequence[Signal]) -> Iterator[tuple[Array, list[Array], float]]:
        """Yield the non-empty blocks of `_rows`. Raises `BadDataset` if the times decrease from row to row."""
        last_s = -np.inf
        for t_s, values, place in self._rows(signals):
            if (back := np.diff(t_s, prepend=last_s) < 0).any():
                at_s = t_s[int(np.argmax(back))]
                raise BadDataset(f"{self.name}: the time goes back to {at_s:.9g} s: sort the samples by time")
            if len(t_s):
                last_s = float(t_s[-1])
                yield t_s, values, place

    def _rows(self, signals: Sequence[Signal]) -> Iterator[tuple[Array, list[Array], float]]:
        """Yield times, values in SI units, and the share of the table read, for the rows that have all these signals.

        Without a time column or a rate, times are NaN. Raises `BadDataset` for a row with an incomplete signal.
        """
        with self._named():
            yield from self._complete_rows(signals)

    def _complete_rows(self, signals: Sequence[Signal]) -> Iterator[tuple[Array, list[Array], float]]:
        time = self._found["time"]
        timed = [*signals, *([] if time is None else [time])]
        use = list(dict.fromkeys(column for one in timed for column in one.columns))
        count = 0
        for block, place in self.source.blocks(use):
            columns = [[use.index(column) for column in one.columns] for one in timed]
            values = [block[:, own] * self._factors[one.form] for one, own in zip(timed, columns, strict=True)]
            complete = np.ones(len(block), bool)
            for one, numbers in zip(signals, values, strict=False):
                known = np.isfinite(numbers)
                if (partly := known.any(axis=1) & ~known.all(axis=1)).any():
                    row = int(np.argmax(partly))
                    name = self.source.names[one.columns[int(np.argmin(known[row]))]]
                    raise BadDataset(_wrong_row(count + row, f"{name} is missing or not a finite number"))
                if (huge := np.argwhere(known & (np.abs(numbers) > LARGEST))).size:
                    row, column = huge[0]
                    name, value = self.source.names[one.columns[column]], numbers[row, column]
                    raise BadDataset(_wrong_row(count + row, f"{name} is {value:.3g}, more than any device reports"))
                complete &= known.all(axis=1)
            if time is not None:
                t_s = values[-1].sum(axis=1)
                if (untimed := complete & ~np.isfinite(t_s)).any():
                    raise BadDataset(_wrong_row(count + int(np.argmax(untimed)), "the time is missing"))
            else:
                t_s = np.arange(count, count + len(block)) / (self.options.rate_Hz or np.nan)
            self._count = count = count + len(block)
            yield t_s[complete], [numbers[complete] for numbers in values[: len(signals)]], place

    @property
    def _axes(self) -> WrenchAxes:
        form = "" if (wrench := self._found["wrench"]) is None else wrench.form
        if self.options.wrench_axes is not None:
            return self.options.wrench_axes
        return "base" if form == "base_wrench" else "sensor"

    def _in_flange(self, wrench: Array, pose: Sequence[Array]) -> Array:
        """Convert wrenches (n, 6) to flange axes about the flange origin; those in sensor axes only get their sign."""
        force, torque = np.hsplit(self.options.sign * wrench, 2)
        if self._axes in ("sensor", "flange"):
            return np.hstack([force, torque])
        if self._axes == "tcp":
            R_flange = self.options.R_flange_tcp
            force, torque = force @ R_flange.T, torque @ R_flange.T
        else:
            R, _ = self._flange(pose[:1])
            force, torque = (np.einsum("nji,nj->ni", R, vector) for vector in (force, torque))
        return np.hstack([force, torque + np.cross(self.options.p_flange_tcp_m, force)])

    def _flange(self, values: Sequence[Array]) -> tuple[Array, Array | None]:
        """Return R_base_flange (n, 3, 3), and p_base_flange_m (n, 3) or None, from the columns of the pose."""
        orientation = self._found["orientation"]
        numbers, p = values[0], values[1] if len(values) > 1 else None
        form = "" if orientation is None else orientation.form
        if form == "tcp_pose":
            p, numbers, form = numbers[:, :3], numbers[:, 3:], "vector"
        if form == "transform":  # Franka writes the matrix column by column
            matrices = numbers.reshape(-1, 4, 4).swapaxes(1, 2)
            p, numbers, form = matrices[:, :3, 3], matrices[:, :3, :3].reshape(-1, 9), "matrix"
        if form == "quaternion_w_first":
            numbers, form = np.roll(numbers, -1, axis=1), "quaternion"
        if form == "joints":
            if self.options.forward is None:
                raise BadDataset(_JOINTS_ONLY)
            return self.options.forward(numbers)
        if form in ("gravity", "acceleration"):
            R = _upright(numbers if form == "gravity" else -numbers)
        elif form in _AXES and (self.options.euler or form in _MAKERS):
            R = _of_angles(numbers, self.options.euler or form, _AXES[form])
        elif form == "angles":
            raise BadDataset(_ANGLES_ONLY)
        else:
            R = _rotations(form, numbers)
        R = R @ self.options.R_flange_tcp.T
        return R, None if p is None else p - R @ self.options.p_flange_tcp_m


def _dwells(R: Array, wrench: Array) -> list[slice]:
    """Return the rows of each dwell: at least 20 in one orientation R (n, 3, 3), with no step in the wrench (n, 6)."""
    dwells: list[slice] = []
    first = 0
    for end in (*(np.flatnonzero(angle_between(R[1:], R[:-1]) > _AT_REST_RAD) + 1), len(R)):
        while end - first >= LEAST_SAMPLES:
            ahead = LEAST_SAMPLES
            while not (moved := angle_between(R[first : first + ahead], R[first]) > _AT_REST_RAD).any():
                if first + ahead >= end:
                    break
                ahead *= 2
            last = min(end, first + (int(np.argmax(moved)) if moved.any() else ahead))
            if last - first >= LEAST_SAMPLES:
                dwells += _without_steps(wrench, first, last)
            first = last
        first = end
    return dwells


def _without_steps(wrench: Array, first: int, last: int) -> list[slice]:
    """Split the rows of a dwell at steps in the wrench (n, 6), such as a tare; return parts of 20 rows or more."""
    parts, waiting = list[slice](), [(first, last)]
    while waiting:
        first, last = waiting.pop()
        step = None if last - first < 2 * LEAST_SAMPLES else _largest_step(wrench[first:last])
        if step is None:
            parts.append(slice(first, last))
        else:
            waiting += [(first + step, last), (first, first + step)]
    return parts


def _largest_step(wrench: Array) -> int | None:
    """Return the row from which the mean of the wrench (n, 6) differs most; None if that difference may be noise."""
    n = len(wrench)
    before = np.arange(LEAST_SAMPLES, n - LEAST_SAMPLES + 1)
    path = np.cumsum(wrench - wrench.mean(axis=0), axis=0)[before - 1] / np.maximum(wrench.std(axis=0), 1e-300)
    step = int(before[np.argmax(np.abs(path).max(axis=1) / np.sqrt(before * (n - before)))])
    parts = [mean_and_covariance(part) for part in (wrench[:step], wrench[step:])]
    sigma = np.sqrt(np.diag(parts[0].covariance + parts[1].covariance))
    return step if (np.abs(parts[0].mean - parts[1].mean) > QUIET * sigma).any() else None


def _wrong_row(row: int, words: str) -> str:
    return f"row {row + 1}: {words}: correct or delete it"


def _of_angles(angles: Array, euler: str, axes: str) -> Array:
    """Return the rotations (n, 3, 3) for Euler angles (n, 3) in columns `axes`, applied in the order `euler`."""
    sequence = _MAKERS.get(euler.lower(), euler)
    if sequence.lower() != axes and sorted(sequence.lower()) == sorted(axes):
        angles = angles[:, [axes.index(axis) for axis in sequence.lower()]]
    return Rotation.from_euler(sequence, angles).as_matrix()


def _rotations(form: str, numbers: Array) -> Array:
    """Return the rotations (n, 3, 3) that matrices, quaternions or vectors (n, k) give. Others raise `BadDataset`."""
    if form == "matrix":
        return proper_rotations(numbers.reshape(-1, 3, 3))
    length = np.linalg.norm(numbers, axis=1)
    if form == "quaternion":
        for i in np.flatnonzero(np.abs(length - 1) > _ROUNDED_LENGTH):
            raise BadDataset(f"row {i + 1}: the quaternion has length {length[i]:.3g}, not 1: check qx, qy, qz, qw.")
        return Rotation.from_quat(numbers).as_matrix()
    if (largest := float(length.max(initial=0.0))) > _MOST_RAD:
        raise BadDataset(
            f"a rotation vector of length {largest:.0f} is in degrees, or three Euler angles: give its unit, --columns "
            f'"rx=… [deg],ry=… [deg],rz=… [deg]", or add --euler xyz (base axes) or XYZ (tool axes)'
        )
    if largest > _LONGEST_VECTOR_RAD:
        raise BadDataset(
            f"row {length.argmax() + 1}: the rotation vector is {largest:.0f} rad long, more than 2π: rx, ry, rz "
            "look like degrees, convert them to rad."
        )
    return Rotation.from_rotvec(numbers).as_matrix()


def _upright(gravity: Array) -> Array:
    """Return the smallest rotations (n, 3, 3) that turn the directions of gravity (n, 3) to -z, straight down."""
    up = -gravity / np.linalg.norm(gravity, axis=1, keepdims=True)
    halfway = np.column_stack([np.cross(up, [0.0, 0.0, 1.0]), 1 + up[:, 2]])
    halfway[halfway[:, 3] < _UPSIDE_DOWN] = [1.0, 0.0, 0.0, 0.0]
    return Rotation.from_quat(halfway).as_matrix()


def _unit_of_time(t: Array, name: str) -> str:
    """Return the likely unit of times (n,): "s" if that is possible. Raises `BadDataset` if two other units fit."""
    t = t[np.isfinite(t)]
    steps = np.diff(t)
    steps = steps[steps > 0]
    if not len(steps):
        return "s"
    since_1970 = [unit for unit, size in _UNITS_OF_TIME.items() if _EPOCH_S[0] < t[0] * size < _EPOCH_S[1]]
    if since_1970:
        return since_1970[0]
    step = float(np.median(steps))
    is_recording = len(t) >= _RECORDING_ROWS
    least, most = _STEPS_S if is_recording else _POSE_STEPS_S
    fitting = [unit for unit, size in _UNITS_OF_TIME.items() if least <= step * size <= most]
    if "s" in fitting or not fitting or step < 1:  # steps below 1 are not ms, us or ns
        return "s"
    if len(fitting) > 1 and is_recording:
        raise BadDataset(
            f"steps of {step:g} in the times may be {' or '.join(fitting)}: name the unit, "
            f'--columns "t={name} [{fitting[0]}]"'
        )
    return fitting[0]
