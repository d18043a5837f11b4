"""What the live screen keeps of a stream, in memory of fixed size."""

from collections import deque
from collections.abc import Sequence
from dataclasses import replace
from itertools import groupby
from typing import NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from ftcalib import CalibrationDataset
from ftdrive.checks.check import Check
from ftdrive.checks.devices import check_noise_change
from ftdrive.live.frames import FrameTransform
from ftdrive.live.loop import ProcessedStream
from ftdrive.live.replay import ReplayedStream
from ftdrive.live.samples import Block
from ftdrive.live.stream import STALE_S
from ftdrive.terminal.live.feed import MEAN_S, Feed
from ftdrive.terminal.live.history import SPANS_S, Columns, History
from ftdrive.terminal.live.view import WARNING, Note, Peaks, Reading, Replay, View
from ftdrivers.interfaces import Array

T = TypeVar("T")

_MEAN_NS = round(MEAN_S * 1e9)
_REST_NS = 2_000_000_000
_STILL_RAD = 5e-4
_MOST_NOTES = 200


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
        self._feed = feed
        self._checks = list(checks)
        self._dataset = dataset
        self._resting: list[Array] | None = None if dataset is None else []
        """Samples of the free tool, until its noise has been compared."""
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
        for note in _taken(feed.notes):
            times = 1
            if self._notes and self._notes[0].text == note.text:
                times += self._notes.popleft().times
            self._notes.appendleft(replace(note, times=times))
        blocks = _taken(feed.blocks)
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
            replay=_replay(feed.stream),
        )

    @property
    def _now_ns(self) -> int:
        return 0 if self._newest is None else int(self._newest.t_host_ns[-1])

    def _columns(self, n: int) -> Columns:
        return self._histories[self.span_s].columns(self._now_ns, n)

    def _silent(self) -> str:
        feed = self._feed
        for device, link in ((feed.stream.info.sensor, feed.status.sensor), (feed.stream.info.arm, feed.status.arm)):
            if link.error or link.age_s > STALE_S:
                return f"{device.model}: {link.error or f'no sample for {link.age_s:.1f} s'}"
        return "" if feed.reader.failure is None else str(feed.reader.failure)

    def _reading(self) -> Reading | None:
        newest, n = self._newest, sum(each.n for each in self._recent)
        if newest is None:
            return None
        return Reading(
            t_host_ns=int(newest.t_host_ns[-1]),
            wrench=np.sum([each.wrench for each in self._recent], axis=0) / n,
            raw=np.sum([each.raw for each in self._recent], axis=0) / n,
            raw_in_frame=np.sum([each.raw_in_frame for each in self._recent], axis=0) / n,
            sigma=self._feed.sigma,
            sample_sigma=newest.sigma,
            chi2=float(newest.chi2[-1]),
            in_contact=bool(newest.in_contact[-1]),
            R_base_flange=newest.R_base_flange[-1],
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


def _replay(stream: ProcessedStream) -> Replay | None:
    if not isinstance(stream, ReplayedStream):
        return None
    return Replay(stream.at_s, stream.duration_s, stream.speed, stream.is_paused, stream.has_ended)


def _taken(queue: deque[T]) -> list[T]:
    """Empty a queue that another thread fills."""
    return [queue.popleft() for _ in range(len(queue))]
