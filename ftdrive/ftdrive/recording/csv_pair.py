"""Wrench and orientation of another program, as two CSV files on one clock, each at its own rate."""

import csv
import io
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from itertools import chain
from pathlib import Path
from typing import Final, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import minimum_filter1d

from ftcalib import CalibrationResult
from ftcalib.data.dataset import ORIENTATION_FORMS, list_names, orientation_columns, rotations_of
from ftcalib.data.dwell_mean import CHANNELS
from ftcalib.errors import BadDataset
from ftcalib.files import open_file
from ftdrive.live.pairing import DelayEstimator, estimate_delay, pair_blocks
from ftdrive.live.samples import Paired, Stages, StreamInfo, WrenchFrame
from ftdrive.recording.recording import PIECE_ROWS, Header, Measured
from ftdrive.runs.run import versions
from ftdrivers.interfaces import NOT_REPORTED, ArmStates, Array, DeviceInfo, FtSamples

_READ_BYTES, _LONGEST_LINE = 1 << 21, 1 << 14
_SEPARATORS = np.frombuffer(b",\n", np.uint8)
# What may precede a sign.
_BEFORE: Final = {
    sign: np.frombuffer(text, np.uint8) for sign, text in ((b"-", b",\ne"), (b"+", b"e"), (b"e", b"0123456789."))
}


class Wanted(NamedTuple):
    """Columns beside t."""

    choose: Callable[[Sequence[str]], Sequence[str]]
    """Returns their names, from those of all columns."""
    words: str


WRENCH: Final = Wanted(lambda _: CHANNELS, ", ".join(CHANNELS))
ORIENTATION: Final = Wanted(orientation_columns, ORIENTATION_FORMS)


class Part(NamedTuple):
    """Consecutive rows of a table."""

    t_s: Array
    """(n,)"""
    numbers: Array
    """(n, k)"""
    names: Sequence[str]
    """Names of the k columns."""
    place: int
    """Bytes of the file up to the end of these rows."""


def read_table(path: Path, wanted: Wanted) -> Iterator[Part]:
    """Read the column t and the wanted ones; the first row has the names.

    Raises
    ------
    BadDataset
        A column is missing, or a line is not one of numbers; the parts before it are read.
    """
    with open_file(path) as file:
        names, found = _columns(path, file.readline(), wanted)
        use = [names.index(name) for name in ("t", *found)]
        count = 0
        while text := file.read(_READ_BYTES) + file.readline():
            table = _parsed(path, text, len(names), use, count)
            count += table.shape[1]
            yield Part(table[0], np.ascontiguousarray(table[1:].T), found, file.tell())


def mean_rate_Hz(path: Path, wanted: Wanted) -> float:
    """Return the mean rate of the rows of a table, by its first and last row and the number of its lines.

    Raises
    ------
    BadDataset
        A column is missing, or there are fewer than two rows of numbers.
    """
    with open_file(path) as file:
        names, _ = _columns(path, file.readline(), wanted)
        first, lines = file.readline(), 1
        tail = first
        while part := file.read(_READ_BYTES):
            lines += part.count(b"\n")
            tail = (tail + part[-_LONGEST_LINE:])[-_LONGEST_LINE:]
    *_, last = [first, *(line for line in tail.splitlines() if line.strip())]
    count = lines + (not tail.endswith(b"\n")) if first.strip() else 0
    if count < 2:
        raise BadDataset(f"{path.name}: it has {count} rows: at least 2 are needed")
    begin, end = (_parsed(path, line, len(names), [names.index("t")]) for line in (first, last))
    return (count - 1) / max(float((end - begin)[0, 0]), 1e-9)


def _columns(path: Path, head: bytes, wanted: Wanted) -> tuple[list[str], Sequence[str]]:
    try:
        names = [name.strip() for name in next(csv.reader([head.decode("utf-8-sig", "replace")]), [])]
    except csv.Error as error:  # such as a field of more than 131,072 characters
        raise BadDataset(f"{path.name}: the first row is no list of columns ({error}): give a CSV file") from error
    found = wanted.choose(names)
    if not {"t", *found} <= set(names):
        raise BadDataset(f"{path.name}: the first row must name t and {wanted.words}; it names {list_names(names)}")
    return names, found


def _parsed(path: Path, text: bytes, columns: int, use: Sequence[int], before: int = 0) -> Array:
    try:
        return parse_numbers(text, columns, use)
    except ValueError as error:
        # loadtxt counts from there
        place = f"{path.name}, after row {before}" if before else path.name
        raise BadDataset(f"{place}: {error}: correct this line") from error


def parse_numbers(text: bytes, columns: int, use: Sequence[int]) -> Array:
    """Return some columns (k, n) of n whole lines; raises `ValueError` as `numpy.loadtxt`.

    The reader of Matrix Market files in SciPy takes an eighth of the time of `loadtxt` for the same bits. It ignores
    what follows a number in its line, so it gets only text of which nothing could be ignored.
    """
    text = (text if text.endswith(b"\n") else text + b"\n").replace(b"\r\n", b"\n")
    # mmread has the same bits in an eighth of the time, and loadtxt has the errors that users see.
    if _is_plain(text, columns):
        from scipy.io import mmread

        head = b"%%%%MatrixMarket matrix array real general\n%d %d\n" % (columns, text.count(b"\n"))
        try:
            return np.asarray(mmread(io.BytesIO(head + text.replace(b",", b"\n"))))[use]
        except ValueError:  # a sign or a point without a digit
            pass
    lines = text.decode(errors="replace").splitlines()
    return np.loadtxt(lines, delimiter=",", usecols=use, ndmin=2).T


def _is_plain(text: bytes, columns: int) -> bool:
    """Whether each line has so many decimals as `-1.5` or `2e-05`; some may lack their digits."""
    # mmread ignores what follows a number in its line.
    between = text.translate(None, b"0123456789-+")
    one_line = b"," * (columns - 1) + b"\n"
    if between.translate(None, b".e") != one_line * text.count(b"\n"):
        return False
    if any(pair in between for pair in ((b"..", b"ee", b"e.") if b"e" in between else (b"..",))):
        return False
    byte = np.frombuffer(b"\n" + text, np.uint8)
    for sign, before in _BEFORE.items():
        if sign not in text:
            continue
        places = np.flatnonzero(byte == ord(sign))
        if not np.isin(byte[places - 1], before).all() or np.isin(byte[places + 1], _SEPARATORS).any():
            return False
    return True


T = TypeVar("T")
# Seconds: the delay is estimated from all of a recording.
_WHOLE = 10**6
_MEAN_S = 0.008
# Samples before and after a step that show whether it is a gap.
_NEAR = 100
_ROUNDS = 20
# Largest distance of regular times from multiples of their period, in periods.
_REGULAR = 0.2


class CsvPair:
    """Two files as one recording of any length; the devices are unknown.

    Parameters
    ----------
    wrench, orientation : Path
        As `read_wrench` and `read_orientation` take them.
    calibration : CalibrationResult
    name : str
        Of the calibration.
    delay_s : float, optional
        Of the wrench after the orientation; None estimates it in a pass of its own.

    Raises
    ------
    BadDataset
        A file cannot be used, or the two have no time in common.
    """

    cut = ""

    def __init__(
        self, wrench: Path, orientation: Path, calibration: CalibrationResult, name: str, delay_s: float | None
    ) -> None:
        self._wrench, self._states = wrench, _Again(partial(read_orientation, orientation))
        rate_Hz, unknown = mean_rate_Hz(wrench, WRENCH), np.full(3, np.nan)
        info = StreamInfo(
            calibration=calibration,
            calibration_name=name,
            arm=DeviceInfo("unknown", NOT_REPORTED, NOT_REPORTED),
            sensor=DeviceInfo("unknown", NOT_REPORTED, NOT_REPORTED),
            tool="",
            utc_offset_ns=0,
            sensor_rate_Hz=rate_Hz,
            arm_rate_Hz=mean_rate_Hz(orientation, ORIENTATION),
            p_flange_sensor_m=unknown,
            R_flange_tcp=np.eye(3),
            p_flange_tcp_m=unknown,
            versions=versions(),
        )
        self.header = Header(info, WrenchFrame(), Stages())
        self.delay_s, self.delay_sigma_s = self._estimated_delay() if delay_s is None else (delay_s, 0.0)

    def blocks(self) -> Iterator[Measured]:
        """Give the samples in blocks, each with its pose. Raises `BadDataset` behind the last valid one."""
        # Each call reads from the beginning: a binary copy for a second pass would need 1.4 GB an hour.
        size = self._wrench.stat().st_size
        share = [0.0]

        def samples() -> Iterator[FtSamples]:
            for block, place in _read_wrench(self._wrench):
                share[0] = place / size
                yield from (block.rows(slice(i, i + PIECE_ROWS)) for i in range(0, len(block), PIECE_ROWS))

        waiting: list[Paired] = []
        failure: BadDataset | None = None
        try:
            for paired in pair_blocks(samples(), self._states, self.delay_s):
                rows = Paired.concatenate([*waiting, paired])
                # as of other recordings, because the contact test goes in steps
                if len(rows) >= PIECE_ROWS:
                    yield Measured(rows.rows(slice(PIECE_ROWS)), (), share[0])
                waiting = [rows.rows(slice(PIECE_ROWS if len(rows) >= PIECE_ROWS else 0, None))]
        except BadDataset as error:
            failure = error
        if any(map(len, waiting)):
            yield Measured(waiting[0], (), share[0])
        if failure is not None:
            raise failure

    def _estimated_delay(self) -> tuple[float, float]:
        """Return the delay and its sigma, from means over `_MEAN_S`."""
        info = self.header.info
        size = max(1, round(_MEAN_S * info.sensor_rate_Hz))
        means = list(_before_a_fault(_means(self._wrench, size)))
        estimator = DelayEstimator(info.calibration, info.p_flange_sensor_m, window=_WHOLE)
        estimate_delay(means, _Again(lambda: _before_a_fault(iter(self._states))), estimator)
        return estimator.delay_s, estimator.sigma_s


class _Again:
    """What a function yields, as often as it is asked."""

    def __init__(self, states: Callable[[], Iterator[ArmStates]]) -> None:
        self._states = states

    def __iter__(self) -> Iterator[ArmStates]:
        return self._states()


def _before_a_fault(parts: Iterator[T]) -> Iterator[T]:
    """Yield the parts before a fault, if there are any; the pass that follows reports it."""
    count = 0
    try:
        for part in parts:
            yield part
            count += 1
    except BadDataset:
        if not count:
            raise


def _means(path: Path, size: int) -> Iterator[FtSamples]:
    """Yield the mean wrench of each so many samples, numbered, at their mean time."""
    t_s, wrench, count = np.empty(0), np.empty((0, 6)), 0
    for part in _table(path, WRENCH):
        t_s, wrench = np.concatenate([t_s, part.t_s]), np.concatenate([wrench, part.numbers])
        n = len(t_s) // size
        t_ns = _ns(t_s[: n * size].reshape(n, size).mean(axis=1))
        means = wrench[: n * size].reshape(n, size, 6).mean(axis=1)
        yield FtSamples.of(t_ns, np.arange(count, count + n), means)
        t_s, wrench, count = t_s[n * size :], wrench[n * size :], count + n


def _read_wrench(path: Path) -> Iterator[tuple[FtSamples, int]]:
    """Read columns t in s, fx, fy, fz in N, tx, ty, tz in N·m; yield samples and how many bytes they end behind.

    Samples are numbered by their times, see `numbers_of`. Raises `BadDataset`.
    """
    known, number = 0, 0
    t_s, wrench, place = np.empty(0), np.empty((0, 6)), 0
    for part in chain(_table(path, WRENCH), [None]):
        if part is not None:
            t_s, wrench, place = np.concatenate([t_s, part.t_s]), np.concatenate([wrench, part.numbers]), part.place
            if len(t_s) <= known + 2 * _NEAR:
                continue
        numbers = numbers_of(t_s)
        numbers += number - numbers[max(known - 1, 0)]
        # what follows shows whether a step is a gap
        end = len(t_s) if part is None else len(t_s) - _NEAR
        if end > known:
            yield FtSamples.of(_ns(t_s[known:end]), numbers[known:end], wrench[known:end]), place
            number = int(numbers[end - 1])
        start = max(end - 2 * _NEAR, 0)
        t_s, wrench, known = t_s[start:], wrench[start:], end - start


def numbers_of(t_s: Array) -> NDArray[np.int64]:
    """Number samples by their times (n,), so that a sample that is missing is a gap and a late one is not.

    Where each time is near a multiple of the period, a longer step is a gap. Elsewhere, as with times of receipt or of
    batches, a gap is a step after which the samples stay late by a period or more, by their median and by the earliest.
    """
    steps_s = np.diff(t_s)
    if (step_s := float(np.median(steps_s))) > 0:
        steps = np.rint(steps_s / step_s)
        if steps.min() >= 1 and np.abs(steps_s / step_s - steps).max() < _REGULAR:
            return np.concatenate([[0], np.cumsum(steps)]).astype(np.int64)
    number = np.arange(len(t_s))
    # the period is that of all samples, the missing ones included
    for _ in range(_ROUNDS):
        before, number = number, _with_gaps(t_s, float(t_s[-1] - t_s[0]) / int(number[-1]))
        if np.array_equal(number, before):
            break
    return number


def _with_gaps(t_s: Array, period_s: float) -> NDArray[np.int64]:
    number = np.arange(len(t_s))
    if period_s == 0:
        return number
    steps = np.diff(t_s) / period_s
    late = t_s / period_s - number
    # of a sample and those before
    earliest = minimum_filter1d(late, _NEAR, mode="nearest", origin=(_NEAR - 1) // 2)
    following = minimum_filter1d(late, _NEAR, mode="nearest", origin=-_NEAR // 2)  # and those after
    possible = np.flatnonzero((steps > 1.5) & (following[1:] - earliest[:-1] > 0.4))
    # where the samples beside it are less late
    for last in possible[np.argsort(-steps[possible])].tolist():
        near = slice(max(last + 1 - _NEAR, 0), last + 1), slice(last + 1, last + 1 + _NEAR)
        before, after = (t_s[rows] / period_s - number[rows] for rows in near)
        missing = min(np.median(after) - np.median(before), after.min() - before.min())
        number[last + 1 :] += max(round(float(missing)), 0)
    return number


def read_orientation(path: Path) -> Iterator[ArmStates]:
    """Read columns t in s and the orientation of the flange in base; position and joints are NaN. Raises `BadDataset`.

    The orientation is a matrix r11..r33, a quaternion qx, qy, qz, qw, or a rotation vector rx, ry, rz in rad.
    """
    for part in _table(path, ORIENTATION):
        try:
            R = rotations_of(part.names, part.numbers)
        except BadDataset as error:
            raise BadDataset(f"{path.name}: {error}") from error
        unknown = np.full((len(R), 6), np.nan)
        yield ArmStates(_ns(part.t_s), unknown[:, 0], unknown, unknown, R, unknown[:, :3])


def _ns(t_s: Array) -> NDArray[np.int64]:
    return np.rint(t_s * 1e9).astype(np.int64)


def _table(path: Path, wanted: Wanted) -> Iterator[Part]:
    """Read a table in parts, with its times in order. Raises `BadDataset` behind the last valid part."""
    count, last_s = 0, -np.inf
    for part in read_table(path, wanted):
        finite = np.isfinite(part.t_s) & np.isfinite(part.numbers).all(axis=1)
        wrong = ~finite | (np.diff(part.t_s, prepend=last_s) < 0)
        if wrong.any():
            row = int(np.argmax(wrong))
            where = f"row {count + row + 1}: a number is not finite, or t = {part.t_s[row]:g} goes back"
            raise BadDataset(f"{path.name}: {where}")
        if len(part.t_s):
            count, last_s = count + len(part.t_s), float(part.t_s[-1])
            yield part
