"""The state that screen and page draw: means, peaks and the recent past of a stream, in memory of fixed size."""

from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from itertools import groupby
from typing import NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from ftcalib import CalibrationDataset
from ftdrive.checks.check import Check
from ftdrive.checks.sensor import check_noise_change
from ftdrive.live.replay import ReplayedStream
from ftdrive.live.samples import Block, FrameTransform, Stages, StreamInfo, StreamStatus, WrenchFrame
from ftdrive.live.stream import STALE_S
from ftdrive.terminal.lines import WARNING
from ftdrive.terminal.live_feed import MEAN_S, Feed, Note
from ftdrivers.interfaces import Array

T = TypeVar("T")

SPANS_S = (2, 10, 60, 600)
"""Time spans that a plot can show."""
# Bins of one span; twice as many are kept, because whole columns of a plot can be longer than its span.
_BINS = 1024
_MEAN_NS = round(MEAN_S * 1e9)
_REST_NS = 2_000_000_000
_STILL_RAD = 5e-4
_MOST_NOTES = 200


@dataclass(frozen=True, slots=True, eq=False)
class PlotColumns:
    """A span cut into columns of equal duration, oldest first."""

    low: Array
    """(6, n) smallest value; NaN where there is no sample."""
    high: Array
    """(6, n) largest value; NaN where there is no sample."""
    in_contact: NDArray[np.bool_]
    """(n,)"""
    start_ns: int
    column_ns: int

    @property
    def span_s(self) -> float:
        """Duration of all columns."""
        return len(self.in_contact) * self.column_ns * 1e-9

    @property
    def contact_cells(self) -> NDArray[np.bool_]:
        """(n / 2,) in_contact, for characters of two columns."""
        return self.in_contact[::2] | self.in_contact[1::2]

    def column_of(self, t_ns: int) -> int | None:
        """Return the column of a time; None outside."""
        column = (t_ns - self.start_ns) // self.column_ns
        return int(column) if 0 <= column < len(self.in_contact) else None


class History:
    """Smallest and largest wrench of each bin of time, for one span.

    The bins are aligned to the clock, so that a plot moves by whole columns and a column never changes afterwards.

    Parameters
    ----------
    span_s : float
    """

    def __init__(self, span_s: float) -> None:
        self._bin_ns = round(span_s * 1e9 / _BINS)
        self._size = 2 * _BINS
        self._bin = np.empty(self._size, np.int64)
        self._low = np.empty((self._size, 6))
        self._high = np.empty((self._size, 6))
        self._in_contact = np.empty(self._size, np.bool_)
        self.clear()

    def clear(self) -> None:
        """Forget everything."""
        self._bin.fill(-1)

    def add(self, t_ns: NDArray[np.int64], wrench: Array, in_contact: NDArray[np.bool_]) -> None:
        """Add samples in the order of time.

        Parameters
        ----------
        t_ns : array, shape (n,)
        wrench : array, shape (n, 6)
        in_contact : array, shape (n,)
        """
        bins = t_ns // self._bin_ns
        starts = np.flatnonzero(np.diff(bins, prepend=bins[0] - 1))
        bins = bins[starts]
        low, high = np.minimum.reduceat(wrench, starts), np.maximum.reduceat(wrench, starts)
        contact = np.logical_or.reduceat(in_contact, starts)
        # only the first bin can have samples already
        if self._bin[at := bins[0] % self._size] == bins[0]:
            np.minimum(low[0], self._low[at], out=low[0])
            np.maximum(high[0], self._high[at], out=high[0])
            contact[0] |= self._in_contact[at]
        slots = bins % self._size
        self._bin[slots], self._low[slots], self._high[slots], self._in_contact[slots] = bins, low, high, contact

    def columns(self, end_ns: int, n: int) -> PlotColumns:
        """Return n columns of which the last contains `end_ns`."""
        each = max(1, round(_BINS / n))
        first = (end_ns // self._bin_ns // each - n + 1) * each
        bins = np.arange(first, first + n * each)
        slots = bins % self._size
        missing = self._bin[slots] != bins
        low, high = self._low[slots], self._high[slots]
        low[missing], high[missing] = np.inf, -np.inf
        low, high = low.reshape(n, each, 6).min(axis=1).T, high.reshape(n, each, 6).max(axis=1).T
        empty = low > high
        low[empty], high[empty] = np.nan, np.nan
        contact = (self._in_contact[slots] & ~missing).reshape(n, each).any(axis=1)
        return PlotColumns(low, high, contact, int(first * self._bin_ns), each * self._bin_ns)


@dataclass(frozen=True, slots=True, eq=False)
class ShownWrench:
    """The mean of the last 0.1 s of samples."""

    t_host_ns: int
    wrench: Array
    """(6,) N and N·m, in `frame`."""
    raw: Array
    """(6,) N and N·m, sensor axes, about the sensor origin."""
    raw_in_frame: Array
    """(6,) the same in `frame`."""
    sigma: Array
    """(6,) of `wrench`: noise, calibration, sensor under this contact; NaN until the noise is known."""
    rest_sigma: Array
    """(6,) the same of a free tool."""
    sample_sigma: Array
    """(6,) of one sample of a free tool."""
    chi2: float
    """Squared distance of the newest sample from a free tool."""
    in_contact: bool
    R_base_flange: Array
    p_base_flange_m: Array
    """(3,) NaN where unknown."""
    q_rad: Array
    """(6,) NaN where unknown."""
    frame: WrenchFrame
    stages: Stages

    def size(self, first: int) -> tuple[float, float]:
        """Return the size of the force (`first` 0) or the torque (3), and its sigma: that along its direction."""
        part, sigma = self.wrench[first : first + 3], self.sigma[first : first + 3]
        size = float(np.linalg.norm(part))
        return size, float(np.linalg.norm(part * sigma)) / size if size else float(sigma.max())


@dataclass(slots=True, eq=False)
class Peaks:
    """Extremes since the last reset."""

    low: Array = field(default_factory=lambda: np.full(6, np.inf))
    high: Array = field(default_factory=lambda: np.full(6, -np.inf))
    force_N: float = 0.0
    torque_Nm: float = 0.0

    def add(self, wrench: Array) -> None:
        """Take samples (n, 6) into account."""
        np.minimum(self.low, wrench.min(axis=0), out=self.low)
        np.maximum(self.high, wrench.max(axis=0), out=self.high)
        squares = np.square(wrench)
        self.force_N = max(self.force_N, float(np.sqrt(squares[:, :3].sum(axis=1).max())))
        self.torque_Nm = max(self.torque_Nm, float(np.sqrt(squares[:, 3:].sum(axis=1).max())))


@dataclass(frozen=True, slots=True, eq=False)
class View:
    """The state that the screen draws."""

    info: StreamInfo
    status: StreamStatus
    reading: ShownWrench | None
    """None before the first sample."""
    silent: str
    """Which device is silent, and what to do; empty while numbers are fresh."""
    peaks: Peaks
    contact_s: float
    """Duration of the present contact."""
    notes: Sequence[Note]
    """Newest first."""
    checks: Sequence[Check]
    columns: Callable[[int], PlotColumns]
    """The recent past in that many columns."""
    recording_s: float | None
    """Duration of the recording; None without one."""
    is_frozen: bool = False
    can_push: bool = False
    """Whether the tool is emulated, so that a key can push it."""
    replay: ReplayedStream | None = None
    calibrated: Array | None = None
    """(n, 3) directions of gravity in flange axes at the calibrated orientations, as unit vectors; None: unknown."""


class _Sum(NamedTuple):
    end_ns: int
    n: int
    wrench: Array
    raw: Array
    raw_in_frame: Array


class Summary:
    """Sums up what a `Feed` has read.

    Parameters
    ----------
    feed : Feed
    checks : sequence of Check
        Findings to show.
    dataset : CalibrationDataset, optional
        The poses of the calibration, where they are known.
    """

    def __init__(self, feed: Feed, checks: Sequence[Check] = (), dataset: CalibrationDataset | None = None) -> None:
        self.span_s = SPANS_S[1]
        self.is_frozen = False
        self._feed, self._news = feed, feed.subscribe()
        self._checks = list(checks)
        self._dataset = dataset
        # Samples of the free tool, until its noise has been compared.
        self._resting: list[Array] | None = None if dataset is None else []
        self._rested_since_ns, self._rested_at = 0, np.eye(3)
        self._histories = {span_s: History(span_s) for span_s in SPANS_S}
        self._recent: deque[_Sum] = deque()
        self._newest: Block | None = None
        self._peaks = Peaks()
        self._contact_since_ns = 0
        self._notes: deque[Note] = deque(maxlen=_MOST_NOTES)
        for check in checks:
            self._note_check(check)
        self._calibrated: Array | None = None
        if dataset is not None:
            gravity = feed.stream.info.calibration.gravity_force_base_N
            self._calibrated = np.einsum("nji,j->ni", dataset.R_base_flange, gravity / np.linalg.norm(gravity))

    def reset_peaks(self) -> None:
        """Forget the extremes."""
        self._peaks = Peaks()

    def view(self) -> View:
        """Take what is new and return the state to draw."""
        feed, status = self._feed, self._feed.status
        for note in _taken(self._news.notes):
            times = 1
            if self._notes and self._notes[0].text == note.text:
                times += self._notes.popleft().times
            self._notes.appendleft(replace(note, times=times))
        blocks = _taken(self._news.blocks)
        if not self.is_frozen:
            for _, alike in groupby(blocks, lambda block: (block.frame, block.stages)):
                self._add(list(alike))
        now_ns = self._now_ns
        in_contact = self._newest is not None and self._newest.in_contact[-1]
        recording_s = None
        if feed.recording_since_ns is not None and feed.newest_ns is not None:
            recording_s = (feed.newest_ns - feed.recording_since_ns) * 1e-9
        return View(
            info=feed.stream.info,
            status=status,
            reading=self._reading(),
            silent=self._silent(),
            peaks=self._peaks,
            contact_s=(now_ns - self._contact_since_ns) * 1e-9 if in_contact else 0.0,
            notes=self._notes,
            checks=self._checks,
            columns=self._columns,
            recording_s=recording_s,
            is_frozen=self.is_frozen,
            can_push=feed.push is not None,
            calibrated=self._calibrated,
            replay=feed.stream if isinstance(feed.stream, ReplayedStream) else None,
        )

    @property
    def _now_ns(self) -> int:
        return 0 if self._newest is None else int(self._newest.t_host_ns[-1])

    def _columns(self, n: int) -> PlotColumns:
        return self._histories[self.span_s].columns(self._now_ns, n)

    def _silent(self) -> str:
        feed = self._feed
        for device, link in ((feed.stream.info.sensor, feed.status.sensor), (feed.stream.info.arm, feed.status.arm)):
            if link.error or link.age_s > STALE_S:
                return f"{device.model}: {link.error or f'no sample for {link.age_s:.1f} s'}"
        return "" if feed.reader.failure is None else str(feed.reader.failure)

    def _reading(self) -> ShownWrench | None:
        newest, n = self._newest, sum(each.n for each in self._recent)
        if newest is None:
            return None
        return ShownWrench(
            t_host_ns=int(newest.t_host_ns[-1]),
            wrench=np.sum([each.wrench for each in self._recent], axis=0) / n,
            raw=np.sum([each.raw for each in self._recent], axis=0) / n,
            raw_in_frame=np.sum([each.raw_in_frame for each in self._recent], axis=0) / n,
            sigma=self._feed.sigma,
            rest_sigma=self._feed.rest_sigma,
            sample_sigma=self._feed.sample_sigma,
            chi2=float(newest.chi2[-1]),
            in_contact=bool(newest.in_contact[-1]),
            R_base_flange=newest.R_base_flange[-1],
            p_base_flange_m=newest.p_base_flange_m[-1],
            q_rad=newest.q_rad[-1],
            frame=newest.frame,
            stages=newest.stages,
        )

    def _add(self, blocks: list[Block]) -> None:
        """Add blocks of the same frame and stages."""
        newest, before = blocks[-1], self._newest
        t_ns = np.concatenate([block.t_host_ns for block in blocks])
        wrench = np.concatenate([block.wrench for block in blocks])
        in_contact = np.concatenate([block.in_contact for block in blocks])
        has_gone_back = before is not None and t_ns[0] <= before.t_host_ns[-1]
        if before is not None and (newest.frame, newest.stages) != (before.frame, before.stages):
            self._recent.clear()
            self.reset_peaks()
            if newest.frame != before.frame:
                for history in self._histories.values():
                    history.clear()
        if has_gone_back:
            self._recent.clear()
        self._follow_contact(t_ns, in_contact, restarted=has_gone_back)
        self._newest = newest
        to_frame = FrameTransform(newest.frame, self._feed.stream.info)
        for block in blocks:
            end_ns, raw_in_frame = int(block.t_host_ns[-1]), to_frame(block.raw, block.R_base_flange)
            sums = [values.sum(axis=0) for values in (block.wrench, block.raw, raw_in_frame)]
            self._recent.append(_Sum(end_ns, len(block), *sums))
        while not self._now_ns - _MEAN_NS < self._recent[0].end_ns <= self._now_ns:
            self._recent.popleft()
        self._peaks.add(wrench)
        for history in self._histories.values():
            history.add(t_ns, wrench, in_contact)
        self._check_noise(blocks)

    def _follow_contact(self, t_ns: NDArray[np.int64], in_contact: NDArray[np.bool_], *, restarted: bool) -> None:
        if not in_contact[-1]:
            return
        free = np.flatnonzero(~in_contact)
        if len(free) or restarted or self._newest is None or not self._newest.in_contact[-1]:
            self._contact_since_ns = int(t_ns[free[-1] + 1 if len(free) else 0])

    def _check_noise(self, blocks: list[Block]) -> None:
        """Compare the noise of a free tool at rest with that of the calibration, once."""
        if self._resting is None or self._dataset is None:
            return
        first, last = blocks[0], blocks[-1]
        moves = np.abs(last.R_base_flange[-1] - self._rested_at).max() > _STILL_RAD
        if not self._resting or moves or any(block.in_contact.any() for block in blocks):
            self._resting, self._rested_since_ns, self._rested_at = [], self._now_ns, first.R_base_flange[0]
        self._resting += [block.raw for block in blocks]
        if self._now_ns - self._rested_since_ns < _REST_NS:
            return
        check = check_noise_change(np.concatenate(self._resting), self._dataset)
        self._resting = []
        if check.state != "skipped":
            self._resting = None
            self._checks.append(check)
            self._note_check(check)

    def _note_check(self, check: Check) -> None:
        if check.state in {"failed", "warning"}:
            text = f"{check.found}. Fix: {check.fix}" if check.fix else check.found
            self._notes.appendleft(Note(None, text, WARNING))


def _taken(queue: deque[T]) -> list[T]:
    """Empty a queue that another thread fills."""
    return [queue.popleft() for _ in range(len(queue))]
