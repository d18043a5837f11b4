"""Tables of wrenches and poses, from text or from memory, as numbers in the units and frames of the project."""

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
# Sequences of scipy: capitals turn about axes of the tool, small letters about those of the base.
_MAKERS: Final = {"rpy": "xyz", "abc": "ZYX", "wpr": "xyz", "oat": "ZYZ"}
# Axis about which each column turns.
_AXES: Final = {"rpy": "xyz", "abc": "zyx", "wpr": "xyz", "oat": "zyz", "vector": "xyz", "angles": "xyz"}
_ORIENTATIONS: Final = (
    *("matrix", "quaternion", "quaternion_w_first", "transform", "tcp_pose", "vector", "rpy", "abc", "wpr", "oat"),
    *("angles", "joints", "gravity", "acceleration"),
)
# Layouts of the orientation that a message may suggest, the likeliest first.
_NEAREST: Final = ("quaternion", "matrix", "vector", "rpy", "abc", "tcp_pose")
_KIND: Final = {
    "time": "time",
    "position": "length",
    "acceleration": "acceleration",
    **dict.fromkeys((*_AXES, "joints"), "angle"),
}
_LONGEST_VECTOR_RAD = 2 * np.pi + 0.01
# A quaternion rounded to two decimals differs from length 1 by no more.
_ROUNDED_LENGTH = 0.01
# More than two turns in rad, or than any arm reaches in m: the numbers are degrees and mm.
_MOST_RAD, _MOST_M = 4 * np.pi, 10.0
_UNITS_OF_TIME: Final = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}
# 1990 to 2100, since 1970.
_EPOCH_S: Final = (6.3e8, 4.1e9)
# Recordings have steps between these, 50 kHz to 5 Hz, and so many rows.
_STEPS_S: Final = (2e-5, 0.2)
_RECORDING_ROWS = 200
# From pose to pose; longer ones are in another unit.
_POSE_STEPS_S: Final = (0.5, 1e3)
# Rows at rest in one orientation differ by no more, with encoder noise and rounded angles.
_AT_REST_RAD: Final = float(np.radians(0.2))
# Rows at rest become poses if they are at least this share of the table: the others are rows between two poses.
_MOSTLY: Final = 0.9
# Nearer to it, any horizontal axis turns a vector upright.
_UPSIDE_DOWN = 1e-9


@dataclass(frozen=True, slots=True, eq=False)
class TableOptions:
    """What a table does not say of itself.

    Raises
    ------
    ConfigError
        An order of angles or a rate that cannot be.

    Examples
    --------
    >>> import ftdrive
    >>> table = ftdrive.TableOptions(columns={"t": "t [ms]"}, sign=1)
    >>> bool(ftdrive.read_dataset("poses.csv", table=table).t_s.max() < 1)
    True
    """

    columns: Mapping[str, str] = field(default_factory=dict)
    """Columns of the table by our names, with a unit where theirs have none: ``{"fx": "Force X [kgf]"}``."""
    separator: Literal["", ",", ";", "\t", " "] = ""
    """Of the text; it is recognised if it is empty."""
    decimal: Literal["", ".", ","] = ""
    """Sign of the text; it is recognised if it is empty."""
    rate_Hz: float | None = None
    """Of a table without times."""
    euler: str = ""
    """rpy, ABC, WPR, OAT, or three axes: ZYX turns about those of the tool, xyz about those of the base."""
    wrench_axes: WrenchAxes | None = None
    """Axes and reference point of the wrench; None is what the program of the table means, mostly the sensor."""
    R_flange_tcp: Array = field(default_factory=lambda: np.eye(3))
    """(3, 3) of the TCP, if the poses are its poses."""
    p_flange_tcp_m: Array = field(default_factory=lambda: np.zeros(3))
    """(3,) of the TCP, if the poses are its poses."""
    sign: Literal[1, -1] = 1
    """-1 for a sensor that reports the reaction."""
    forward: Callable[[Array], tuple[Array, Array]] | None = None
    """Returns R_base_flange (n, 3, 3) and p_base_flange_m (n, 3) of joint angles (n, 6) in rad."""

    def __post_init__(self) -> None:
        if self.euler and self.euler.lower() not in _MAKERS and not re.fullmatch("[xyz]{3}|[XYZ]{3}", self.euler):
            makers = ", ".join(name if name == "rpy" else name.upper() for name in _MAKERS)
            raise ConfigError(
                f"--euler {self.euler}: give {makers}, or three axes, such as ZYX (of the tool) or xyz (of the base)"
            )
        if self.separator not in ("", ",", ";", "\t", " ") or self.decimal not in ("", ".", ","):
            given = f"separator {self.separator!r}, decimal {self.decimal!r}"
            raise ConfigError(f"[text]: {given}: give a comma, semicolon, tab or space, and a point or comma")
        if self.rate_Hz is not None and not self.rate_Hz > 0:
            raise ConfigError(f"--rate {self.rate_Hz:g}: give the samples a second")


_JOINTS_ONLY = "it has joint angles and no orientation: add --model, such as UR5e, or --urdf FILE"
_ANGLES_ONLY = "it has three angles: add --euler, such as ZYX (axes of the tool) or xyz (axes of the base)"


class ColumnSource(Protocol):
    """Columns that are read in blocks."""

    names: Sequence[str]
    units: Sequence[str]
    words: str
    comments: int
    """Lines between the rows that `blocks` has left out as comments."""

    def blocks(self, use: Sequence[int]) -> Iterator[tuple[Array, float]]:
        """Give some columns (n, k) of consecutive rows, and the share of the source before the next ones."""


class FrameSource:
    """A DataFrame of pandas or Polars, a table of pyarrow, or a mapping of names to arrays."""

    words, comments = "", 0

    def __init__(self, frame: Any) -> None:
        self._frame = frame
        columns = frame.keys() if isinstance(frame, Mapping) else getattr(frame, "column_names", None) or frame.columns
        self.names: Sequence[str] = list(map(str, columns))
        self.units: Sequence[str] = [""] * len(self.names)

    def blocks(self, use: Sequence[int]) -> Iterator[tuple[Array, float]]:
        """Give all rows. Raises `BadDataset`."""
        try:
            columns = [np.asarray(self._frame[self.names[i]]) for i in use] or [np.empty((0, 0))]
            numbers = [seconds_of(one) if one.dtype.kind == "M" else one.astype(np.float64) for one in columns]
            yield np.column_stack(numbers), 1.0
        except (TypeError, ValueError) as error:
            raise BadDataset(f"{error}: give a number in each cell") from error


class SignalRows(NamedTuple):
    """Consecutive rows of a signal."""

    t_s: Array
    """(n,)"""
    values: Array
    """(n, k)"""
    place: float
    """Share of the source before the next rows."""


class Table:
    """A table whose signals were found.

    Parameters
    ----------
    source : Path, DataFrame or mapping
    options : TableOptions, optional
    name : str
        For messages; the name of the file or of the type of the source otherwise.

    Raises
    ------
    BadDataset
        It is no table, or a column contradicts its name. A signal that is missing raises where it is needed.
    OSError
        It cannot be read.
    """

    def __init__(self, source: Path | Any, options: TableOptions | None = None, name: str = "") -> None:
        self.name = name or (source.name if isinstance(source, Path) else type(source).__name__)
        self.options = options or TableOptions()
        self._guesses: list[str] = []
        self._count = 0
        self._found: dict[str, Signal | None] = {}
        with self._named():
            text = self.options.separator, self.options.decimal
            self.source: ColumnSource = TextTable(source, *text) if isinstance(source, Path) else FrameSource(source)
            in_memory = isinstance(self.source, FrameSource)
            self._columns = SignalColumns(
                self.source.names, self.source.units, self.options.columns, in_memory=in_memory
            )
            self._find()

    def _find(self) -> None:
        """Find the signals, and the factors of their units; the first rows show what no name says."""
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
        signals = [one for one in self._found.values() if one is not None]
        use = sorted({column for one in signals for column in one.columns})
        rows, _ = next(self.source.blocks(use), (np.empty((0, len(use))), 1.0))
        first = {one.form: rows[:, [use.index(column) for column in one.columns]] for one in signals}
        self._factors = {one.form: self._factors_of(one, first[one.form]) for one in signals}
        self._first = {name: first[one.form] * self._factors[one.form] for name, one in self._found.items() if one}

    @property
    def words(self) -> str:
        """What was recognised, in one line; empty for a table with the names and units of the project."""
        programs = {one.program for one in self._found.values() if one} - {"ftdrive", "own program"}
        named = [f"columns of {one}" for one in sorted(programs)]
        if self.options.rate_Hz:  # nothing else shows a wrong one
            named.append(f"{self.options.rate_Hz:g} Hz as given, on whose square the inertia depends")
        return "; ".join(filter(None, [self.source.words, *named, *self._guesses]))

    @property
    def has_nominal_kinematics(self) -> bool:
        """Whether orientations follow from joint angles with the nominal kinematics of a model."""
        orientation = self._found["orientation"]
        return orientation is not None and orientation.form == "joints"

    @property
    def gravity_is_measured(self) -> bool:
        """Whether the orientation is a direction of gravity, so that nothing turns about the vertical."""
        orientation = self._found["orientation"]
        return orientation is not None and orientation.form in ("gravity", "acceleration")

    def has(self, signal: Literal["wrench", "orientation"]) -> bool:
        """Whether the table has a signal."""
        return self._found[signal] is not None

    @cached_property
    def in_motion(self) -> bool:
        """Whether its rows follow one another too quickly for poses at rest, or come from two streams."""
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
        """Return the mean rate of a signal in the first rows. Raises `BadDataset` for fewer than two."""
        if self.options.rate_Hz:
            return self.options.rate_Hz
        self._require_time()
        self._require(signal)
        t_s = self._first["time"].sum(axis=1)[np.isfinite(self._first[signal]).all(axis=1)]
        if len(t_s) < 2:
            raise BadDataset(f"{self.name}: it has {len(t_s)} rows of the {signal}: at least 2 are needed")
        return (len(t_s) - 1) / max(float(t_s[-1] - t_s[0]), 1e-9)

    def wrenches(self) -> Iterator[SignalRows]:
        """Give wrenches (n, 6) in N and N·m, in axes of the sensor or the flange.

        Raises `BadDataset` behind the last valid rows.
        """
        signals = [self._require("wrench")]
        if self._axes == "base":
            signals.append(self._require("orientation"))
        self._require_time()
        for t_s, (read, *pose), place in self._in_order(signals):
            with self._named():
                wrench = self._in_flange(read, pose)
            yield SignalRows(t_s, wrench, place)

    def poses(self) -> Iterator[SignalRows]:
        """Give R_base_flange row by row, and p_base_flange_m if it is known: (n, 9 or 12). Raises as `wrenches`."""
        signals = [self._require("orientation"), *([one] if (one := self._found["position"]) else [])]
        if self.gravity_is_measured:
            raise BadDataset(f"{self.name}: gravity does not show how the arm turns about it: give the orientation too")
        self._require_time()
        for t_s, values, place in self._in_order(signals):
            with self._named():
                R, p = self._flange(values)
            yield SignalRows(t_s, np.hstack([R.reshape(-1, 9), *([] if p is None else [p])]), place)

    def dataset(self, orientation: Orientation = "R_base_flange") -> CalibrationDataset:
        """Return the rows as poses at rest: each row is one, or the rows of each dwell in a long table.

        Raises `BadDataset`.
        """
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
            raise BadDataset(
                f"{self.name}: standard errors are those of the sensor's axes: leave them out, or rotate them"
            )
        times, parts, _ = zip(*self._rows(signals), strict=True)
        t_s = np.concatenate(times)
        pose, wrench, *sigma = (np.concatenate(each) for each in zip(*parts, strict=True))
        if not len(wrench):
            raise BadDataset(
                f"{self.name}: no row has an orientation and a wrench: give one row a pose, or a recording"
            )
        if missing := self._count - len(wrench):
            self._guesses.append(f"{missing} of {self._count} rows left out, which lack the wrench or the orientation")
        if comments := self.source.comments:
            self._guesses.append(f"{comments} commented lines between the rows left out")
        if sigma and (sigma[0] <= 0).any():
            row = int(np.argmax((sigma[0] <= 0).any(axis=1)))
            raise BadDataset(
                f"{self.name}: " + _wrong_row(row, f"{sigma[0][row].min():g} is no standard error, which is above 0")
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
        """Return one pose per dwell; the rows themselves if they are not mostly dwells."""
        dwells = _dwells(rows.R_base_flange, rows.wrench)
        n_samples = np.array([len(range(*one.indices(len(rows)))) for one in dwells], np.int64)
        if n_samples.sum() < _MOSTLY * len(rows):
            return rows
        self._guesses.append(f"{n_samples.sum():,} rows at rest are {counted(len(dwells), 'pose')}")
        if between := len(rows) - n_samples.sum():
            self._guesses.append(f"{counted(between, 'row')} between them left out")
        means = [mean_and_covariance(rows.wrench[one]) for one in dwells]
        return replace(
            rows,
            R_base_flange=nearest_rotation(np.array([rows.R_base_flange[one].mean(axis=0) for one in dwells])),
            wrench=np.array([one.mean for one in means]),
            wrench_cov=np.array([one.covariance for one in means]),
            n_samples=n_samples,
            t_s=np.array([rows.t_s[one].mean() for one in dwells]),
        )

    def _form(self, form: str) -> dict[str, JSON]:
        """Return what the orientations were read from, which limits what a mistake in them can be."""
        if form in _AXES and (self.options.euler or form in _MAKERS):
            euler = self.options.euler or form
            return {"form": "euler", "euler": _MAKERS.get(euler.lower(), euler)}
        return {
            "form": {"quaternion_w_first": "quaternion", "transform": "matrix", "tcp_pose": "vector"}.get(form, form)
        }

    def _require_time(self) -> None:
        if self._found["time"] is None and not self.options.rate_Hz:
            words = self._columns.missing("time", "time")
            rate = "rate_Hz=…" if isinstance(self.source, FrameSource) else "--rate HZ"
            raise BadDataset(f"{self.name}: {words}, or add {rate} if the samples are evenly spaced")

    def _require(self, signal: str) -> Signal:
        """Return a signal. Raises `BadDataset` with the line to type."""
        if (found := self._found[signal]) is not None:
            return found
        with self._named():
            words = self._columns.missing(signal, *(("wrench",) if signal == "wrench" else _NEAREST))
            # A recording in motion is often a file for each device.
            alone = signal == "orientation" and self.has("wrench") and self._found["time"] is not None
            raise BadDataset(f"{words}, or give poses of their own: --wrench, --orientation-file" if alone else words)

    @contextmanager
    def _named(self) -> Iterator[None]:
        try:
            yield
        except BadDataset as error:
            raise BadDataset(f"{self.name}: {error}") from error

    def _factors_of(self, signal: Signal, first: Array) -> Array:
        """Return the factor to SI of each column, guessed where no unit is named and the numbers leave no doubt."""
        names = [self.source.names[column] for column in signal.columns]
        kinds = {"tcp_pose": ["length"] * 3 + ["angle"] * 3}.get(signal.form, [_KIND.get(signal.form, "")] * len(names))
        if "wrench" in signal.form or signal.form == "sigma":
            kinds = ["force"] * 3 + ["torque"] * 3
        if signal.form == "time" and len(names) == 2:
            return np.array([1.0, 1e-9])
        found = [
            factor(unit, kind, name) if kind else None
            for unit, kind, name in zip(signal.units, kinds, names, strict=True)
        ]
        if signal.form == "wrench" and any(unit.lower() in COUNTS for unit in signal.units):
            self._guesses.append("wrench in counts")
        largest = float(np.nanmax(np.abs(first), initial=0.0))
        guess = 1.0
        if signal.form == "time" and None in found:
            unit = _unit_of_time(first[:, 0], names[0])
            guess = _UNITS_OF_TIME[unit]
            self._guesses += [f"time in {unit}"] if unit != "s" else []
        elif kinds[0] == "angle" and None in found and largest > _MOST_RAD and signal.form != "vector":
            guess = UNITS["angle"]["deg"]
            self._guesses.append("angles in degrees")
        elif kinds[0] == "length" and signal.form == "position" and None in found and largest > _MOST_M:
            guess = 1e-3
            self._guesses.append("positions in mm")
        return np.array([guess if one is None else one for one in found])

    def _in_order(self, signals: Sequence[Signal]) -> Iterator[tuple[Array, list[Array], float]]:
        """Give `_rows` that exist. Raises `BadDataset` if their time goes back."""
        last_s = -np.inf
        for t_s, values, place in self._rows(signals):
            if (back := np.diff(t_s, prepend=last_s) < 0).any():
                at_s = t_s[int(np.argmax(back))]
                raise BadDataset(f"{self.name}: the time goes back to {at_s:.9g} s: give the samples in their order")
            if len(t_s):
                last_s = float(t_s[-1])
                yield t_s, values, place

    def _rows(self, signals: Sequence[Signal]) -> Iterator[tuple[Array, list[Array], float]]:
        """Give times, numbers in SI and place of the rows that have all of some signals.

        Times are NaN without a column and a rate. Raises `BadDataset` for a row that has a part of a signal.
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
                    raise BadDataset(_wrong_row(count + row, f"{name} is missing or no finite number"))
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
        """Return wrenches (n, 6) in axes of the flange and about its origin, if they are not those of the sensor."""
        force, torque = np.hsplit(self.options.sign * wrench, 2)
        if self._axes in ("sensor", "flange"):
            return np.hstack([force, torque])
        if self._axes == "tcp":
            R_flange = self.options.R_flange_tcp
            force, torque = force @ R_flange.T, torque @ R_flange.T
        else:
            R, _ = self._flange(pose[:1])
            force, torque = (np.einsum("nji,nj->ni", R, one) for one in (force, torque))
        return np.hstack([force, torque + np.cross(self.options.p_flange_tcp_m, force)])

    def _flange(self, values: Sequence[Array]) -> tuple[Array, Array | None]:
        """Return R_base_flange (n, 3, 3) and p_base_flange_m (n, 3) of orientations and perhaps positions."""
        orientation = self._found["orientation"]
        numbers, p = values[0], values[1] if len(values) > 1 else None
        form = "" if orientation is None else orientation.form
        if form == "tcp_pose":
            p, numbers, form = numbers[:, :3], numbers[:, 3:], "vector"
        if form == "transform":  # column by column
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
    """Return the rows of each dwell: 20 or more in one orientation (n, 3, 3), without a step of the wrench (n, 6)."""
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
    """Split the rows of a dwell at steps of the wrench (n, 6), such as a tare; each part has 20 rows or more."""
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
    """Return the row (n, 6) from which on the mean differs most, None if it is within the noise."""
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
    """Return the rotations (n, 3, 3) of three angles (n, 3) about these axes, turned in the order of `euler`."""
    sequence = _MAKERS.get(euler.lower(), euler)
    if sequence.lower() != axes and sorted(sequence.lower()) == sorted(axes):
        angles = angles[:, [axes.index(axis) for axis in sequence.lower()]]
    return Rotation.from_euler(sequence, angles).as_matrix()


def _rotations(form: str, numbers: Array) -> Array:
    """Return the rotations (n, 3, 3) in these numbers (n, k). Raises `BadDataset`."""
    if form == "matrix":
        return proper_rotations(numbers.reshape(-1, 3, 3))
    length = np.linalg.norm(numbers, axis=1)
    if form == "quaternion":
        for i in np.flatnonzero(np.abs(length - 1) > _ROUNDED_LENGTH):
            raise BadDataset(f"row {i + 1}: the quaternion has length {length[i]:.3g}, not 1: check qx, qy, qz, qw.")
        return Rotation.from_quat(numbers).as_matrix()
    if (largest := float(length.max(initial=0.0))) > _MOST_RAD:
        raise BadDataset(
            f"a rotation vector of {largest:.0f} rad has degrees, or is three angles: name its unit, --columns "
            f'"rx=… [deg],ry=… [deg],rz=… [deg]", or add --euler xyz (axes of the base) or XYZ (axes of the tool)'
        )
    if largest > _LONGEST_VECTOR_RAD:
        raise BadDataset(
            f"row {length.argmax() + 1}: the rotation vector is {largest:.0f} rad long, more than 2π: rx, ry, rz "
            "look like degrees, convert them to rad."
        )
    return Rotation.from_rotvec(numbers).as_matrix()


def _upright(gravity: Array) -> Array:
    """Return the least rotations (n, 3, 3) that turn a direction of gravity (n, 3) straight down."""
    up = -gravity / np.linalg.norm(gravity, axis=1, keepdims=True)
    halfway = np.column_stack([np.cross(up, [0.0, 0.0, 1.0]), 1 + up[:, 2]])
    halfway[halfway[:, 3] < _UPSIDE_DOWN] = [1.0, 0.0, 0.0, 0.0]
    return Rotation.from_quat(halfway).as_matrix()


def _unit_of_time(t: Array, name: str) -> str:
    """Return the unit of times (n,), s unless the numbers leave no doubt. Raises `BadDataset` if two others fit."""
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
    if "s" in fitting or not fitting or step < 1:  # slow samples in s, or fast ones in ms
        return "s"
    if len(fitting) > 1 and is_recording:
        raise BadDataset(
            f"steps of {step:g} in the times may be {' or '.join(fitting)}: name the unit, "
            f'--columns "t={name} [{fitting[0]}]"'
        )
    return fitting[0]
