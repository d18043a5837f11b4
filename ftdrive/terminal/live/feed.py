"""The thread that reads the stream, and what it keeps for the screen."""

import threading
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import replace
from operator import methodcaller
from queue import SimpleQueue
from typing import NamedTuple, Protocol

import numpy as np

from drivers.errors import DriverError
from drivers.interfaces import Array
from ftdrive.checks.check import Check
from ftdrive.errors import ConfigError
from ftdrive.live.samples import Block, Stages, StreamEvent, StreamInfo, StreamStatus, WrenchFrame
from ftdrive.terminal.live.history import SPANS_S, Columns, History
from ftdrive.terminal.live.view import Note, Peaks, Reading, View

STALE_S = 0.3
"""An older number is not shown."""
_MEAN_NS = 100_000_000
_RETRY_S = 0.05
"""A silent stream raises at once; this long the thread waits before it reads again."""
_MOST_NOTES = 200
_MARKS = ("tare", "tare-undone", "stages", "gap", "mark")
"""Events whose time the plots show; contact has a colour, and a change of frame clears them."""
_STYLES = {
    "contact": "magenta",
    "tare": "green",
    "tare-refused": "red bold",
    "drift": "bold black on yellow",
    "gap": "red bold",
    "stale": "red bold",
    "recovered": "green",
    "mark": "bold",
}


class Stream(Protocol):
    """What the screen needs of a `CompensatedStream` or a `ReplayedStream`."""

    info: StreamInfo
    frame: WrenchFrame
    stages: Stages

    def read(self, timeout_s: float = 0.1) -> Block:
        """Return at least one row."""

    def take_events(self) -> list[StreamEvent]:
        """Return the events since the last call."""

    def status(self) -> StreamStatus:
        """Return rates, ages, delay, tare and drift."""

    def tare(self) -> StreamEvent:
        """Set the bias so that a free tool reads zero."""

    def undo_tare(self) -> StreamEvent:
        """Return to the bias before the last tare."""

    def mark(self, text: str) -> StreamEvent:
        """Put a mark into the stream."""


class Sink(Protocol):
    """A consumer of blocks, such as a recorder."""

    def write(self, block: Block) -> None:
        """Take samples."""

    def event(self, event: StreamEvent) -> None:
        """Take an event."""

    def close(self) -> None:
        """Complete the output."""


class _Sum(NamedTuple):
    end_ns: int
    n: int
    wrench: Array
    raw: Array


class Feed:
    """Reads a stream in a thread of its own and sums it up, in memory of fixed size.

    The screen asks for a `View` whenever it draws, and never waits for the stream. What a key changes is done between
    two reads, in the thread that reads, so that the stream is used by one thread.

    Parameters
    ----------
    stream : Stream
    recorder : callable, optional
        Opens a recording.
    checks : sequence of Check
        Findings beside those about the calibration.
    """

    def __init__(
        self, stream: Stream, recorder: Callable[[], Sink] | None = None, checks: Sequence[Check] = ()
    ) -> None:
        self.stream = stream
        self.span_s = SPANS_S[1]
        self.is_frozen = False
        self.failure: DriverError | None = None
        """Why the stream gives no samples now."""
        self.crash: BaseException | None = None
        self._recorder = recorder
        self._sink: Sink | None = None
        self._checks = checks
        self._lock = threading.Lock()
        self._histories = {span_s: History(span_s) for span_s in SPANS_S}
        self._recent: deque[_Sum] = deque()
        self._newest: Block | None = None
        self._peaks = Peaks()
        self._contact_since_ns: int | None = None
        self._recording_since_ns: int | None = None
        self._notes: deque[Note] = deque(maxlen=_MOST_NOTES)
        self._requests: SimpleQueue[Callable[[], object]] = SimpleQueue()
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._run, name="live screen", daemon=True)

    def start(self) -> None:
        """Start to read."""
        self._thread.start()

    def stop(self) -> None:
        """Stop to read and complete a recording."""
        self._ended.set()
        self._thread.join()
        self._stop_recording()

    def request(self, action: Callable[[], object]) -> None:
        """Let the reading thread do something with the stream."""
        self._requests.put(action)

    def reset_peaks(self) -> None:
        """Forget the extremes."""
        with self._lock:
            self._peaks = Peaks()

    def note(self, text: str, style: str = "") -> None:
        """Show a line among the events."""
        with self._lock:
            self._notes.appendleft(Note(self._newest_ns, text, style))

    def view(self) -> View:
        """Return the state to draw."""
        status = self.stream.status()
        with self._lock:
            newest_ns = self._newest_ns or 0
            since_ns = (self._contact_since_ns, self._recording_since_ns)
            contact_s, recording_s = (None if start is None else (newest_ns - start) * 1e-9 for start in since_ns)
            return View(
                info=self.stream.info,
                status=status,
                reading=self._reading(),
                silent=self._silent(status),
                peaks=replace(self._peaks, low=self._peaks.low.copy(), high=self._peaks.high.copy()),
                contact_s=contact_s or 0.0,
                notes=list(self._notes),
                checks=self._checks,
                columns=self._columns,
                recording_s=recording_s,
                is_frozen=self.is_frozen,
            )

    @property
    def _newest_ns(self) -> int | None:
        return None if self._newest is None else int(self._newest.t_host_ns[-1])

    def _columns(self, n: int) -> Columns:
        with self._lock:
            return self._histories[self.span_s].columns(self._newest_ns or 0, n)

    def _silent(self, status: StreamStatus) -> str:
        if self.failure is not None:
            return str(self.failure)
        for device, link in ((self.stream.info.sensor, status.sensor), (self.stream.info.arm, status.arm)):
            if link.error or link.age_s > STALE_S:
                return f"{device.model}: {link.error or f'no sample for {link.age_s:.1f} s'}"
        return ""

    def _reading(self) -> Reading | None:
        newest, n = self._newest, sum(each.n for each in self._recent)
        if newest is None:
            return None
        return Reading(
            t_host_ns=int(newest.t_host_ns[-1]),
            wrench=np.sum([each.wrench for each in self._recent], axis=0) / n,
            raw=np.sum([each.raw for each in self._recent], axis=0) / n,
            sigma=newest.sigma,
            chi2=float(newest.chi2[-1]),
            in_contact=bool(newest.in_contact[-1]),
            R_base_flange=newest.R_base_flange[-1],
            p_base_flange_m=newest.p_base_flange_m[-1],
            frame=newest.frame,
            stages=newest.stages,
        )

    def step(self) -> None:
        """Do what keys requested, read once, and take the events."""
        self._answer()
        self._read()
        self._take_events()

    def _run(self) -> None:
        try:
            while not self._ended.is_set():
                self.step()
        except BaseException as error:  # the main thread raises it
            self.crash = error

    def _answer(self) -> None:
        while not self._requests.empty():
            try:
                self._requests.get_nowait()()
            except (ConfigError, DriverError, OSError) as error:
                self.note(str(error), _STYLES["tare-refused"])

    def _read(self) -> None:
        try:
            block = self.stream.read()
        except DriverError as error:
            self.failure = error
            self._ended.wait(_RETRY_S)
            return
        self.failure = None
        self._record(lambda sink: sink.write(block))
        if not self.is_frozen:
            with self._lock:
                self._show(block)

    def _show(self, block: Block) -> None:
        t_ns, newest = block.t_host_ns, self._newest
        if newest is not None and (block.frame, block.stages) != (newest.frame, newest.stages):
            self._recent.clear()
            self._peaks = Peaks()
            if block.frame != newest.frame:
                for history in self._histories.values():
                    history.clear()
        if newest is not None and t_ns[0] <= newest.t_host_ns[-1]:  # a recording has gone back
            self._recent.clear()
            self._contact_since_ns = None
        self._newest = block
        self._recent.append(_Sum(int(t_ns[-1]), len(block), block.wrench.sum(axis=0), block.raw.sum(axis=0)))
        while self._recent[0].end_ns <= t_ns[-1] - _MEAN_NS:
            self._recent.popleft()
        self._peaks.add(block.wrench)
        for history in self._histories.values():
            history.add(t_ns, block.wrench, block.in_contact)
        free = np.flatnonzero(~block.in_contact)
        if not block.in_contact[-1]:
            self._contact_since_ns = None
        elif self._contact_since_ns is None or len(free):
            self._contact_since_ns = int(t_ns[free[-1] + 1 if len(free) else 0])

    def _take_events(self) -> None:
        for event in self.stream.take_events():
            self._record(methodcaller("event", event))
            note = Note(event.t_host_ns, event.text, _STYLES.get(event.kind, ""), event.kind in _MARKS)
            with self._lock:
                self._notes.appendleft(note)

    def switch_recording(self) -> None:
        """Start a recording, or complete the one that runs; for `request`."""
        if self._sink is not None:
            self._stop_recording()
        elif self._recorder is None:
            self.note("recording is not available here: use `ftdrive record -o FILE`")
        else:
            self._sink, self._recording_since_ns = self._recorder(), self._newest_ns
            self.note("recording started")

    def _stop_recording(self) -> None:
        sink, self._sink, self._recording_since_ns = self._sink, None, None
        if sink is not None:
            sink.close()
            self.note("recording complete")

    def _record(self, act: Callable[[Sink], None]) -> None:
        """Let the recorder do something; its failure ends the recording, never the screen."""
        if self._sink is None:
            return
        try:
            act(self._sink)
        except (ConfigError, OSError) as error:
            self._sink = self._recording_since_ns = None
            self.note(f"recording ended: {error}", _STYLES["gap"])
