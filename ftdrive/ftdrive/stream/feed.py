"""Data of a stream for the live screen and the page in the browser, and the requests that both can make."""

import math
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from queue import SimpleQueue
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ftcalib import CalibrationDataset
from ftdrive.checks.check import Check
from ftdrive.checks.sensor import check_noise_change
from ftdrive.errors import ConfigError
from ftdrive.stream.samples import Block, StreamEvent
from ftdrive.stream.stream import Sink, Stream, pump
from ftdrivers.errors import DeviceError
from ftdrivers.interfaces import Array

MEAN_S = 0.1
"""The screen and the page show means over this time, s."""
SPANS_S = (2, 10, 60, 600)
"""Time spans that a plot can show, s."""
# Time bins per span of a plot. Twice as many are stored, as the whole columns of a plot can be longer than the span.
_BINS = 1024
_STATUS_NS = 50_000_000
# Cut-off frequency, Hz, of the low-pass filter that a key switches on in the live view.
_LOWPASS_HZ = 40.0
# Most blocks and notes that wait for a slow screen or page; older ones are dropped. Recordings use no such queue.
_MOST_BLOCKS, _MOST_NOTES = 2000, 200
_REST_NS = 2_000_000_000
_STILL_RAD = 5e-4


@dataclass(frozen=True, slots=True)
class FeedNote:
    """An event in the stream, or the answer to an operator's request, as shown on the screen and the page."""

    t_host_ns: int | None
    text: str
    kind: str = ""
    """Kind of the event; for the answer to a request "failed", "warning" or empty."""
    times: int = 1
    """How often this note occurred in a row."""

    @property
    def words(self) -> str:
        """The text of the note, followed by the number of its occurrences if there are several."""
        return self.text if self.times == 1 else f"{self.text} ({self.times} times)"


class Feed(Sink):
    """Passes the blocks and events of a stream to the screen and the page, and never waits for them.

    Requests from the screen and the page are carried out between two reads, so only one thread uses the stream.
    `recorder` opens a recording in a new file, and `push` pushes the tool of an emulated cell.
    """

    label = "screen"

    def __init__(
        self,
        stream: Stream,
        recorder: Callable[[Path], Sink] | None = None,
        push: Callable[[], object] | None = None,
    ) -> None:
        self.stream = stream
        self.push = push
        self.status = stream.status()
        self.sigma = self.rest_sigma = self.sample_sigma = np.full(6, np.nan)
        """(6,) standard deviations: of a mean over `MEAN_S` under the current contact, of such a mean of a free tool,
        and of one sample of a free tool. Updated every 50 ms, like the status."""
        self.newest_ns: int | None = None
        """Time of the newest sample on the cell's clock; None before the first."""
        self.turned_ns = stream.clock.now_ns()
        """Time of the last read of the stream, even if it returned no samples."""
        self.recorded: list[Path] = []
        self.sinks: list[Sink] = [self]
        """Receivers of the stream; may be added and removed between two reads."""
        self._readers: list[tuple[deque[Block], deque[FeedNote]]] = []
        self._recorder = recorder
        self._recording: Sink | None = None
        self._recording_since_ns = 0
        self._status_ns = 0
        self._requests: SimpleQueue[Callable[[], object]] = SimpleQueue()

    def subscribe(self) -> tuple[deque[Block], deque[FeedNote]]:
        """Return two queues for a new screen or page, which get the blocks and the notes from now on."""
        self._readers.append((deque(maxlen=_MOST_BLOCKS), deque(maxlen=_MOST_NOTES)))
        return self._readers[-1]

    def do(self, action: Callable[[], object]) -> None:
        """Let the thread that reads the stream call `action` between two reads; an error of it becomes a note."""
        self._requests.put(action)

    def note(self, text: str, kind: str = "") -> None:
        """Add a note."""
        self._add_note(FeedNote(self.newest_ns, text, kind))

    def turns(self, patience_s: float = math.inf, until: Callable[[], object] | None = None) -> Iterator[Block | None]:
        """Read as `pump` does, and carry out the requests between two reads."""
        say = partial(self.note, kind="failed")
        for block in pump(self.stream, self.sinks, until=until, patience_s=patience_s, say=say):
            yield block
            while not self._requests.empty():
                try:
                    self._requests.get_nowait()()
                except (ConfigError, DeviceError, OSError) as error:
                    say(str(error))

    def add(self, block: Block | None, events: Sequence[StreamEvent]) -> None:
        """Queue the samples and events for all readers, and update the status."""
        self.turned_ns = self.stream.clock.now_ns()
        if block:
            self.newest_ns = int(block.t_host_ns[-1])
            for blocks, _ in self._readers:
                blocks.append(block)
            if abs(self.newest_ns - self._status_ns) > _STATUS_NS:
                self._status_ns = self.newest_ns
                self.status = self.stream.status()
                sigma_of_mean = partial(self.stream.processor.sigma_of_mean, block.R_base_flange[-1])
                self.sigma, self.rest_sigma = sigma_of_mean(MEAN_S), sigma_of_mean(MEAN_S, loaded=False)
                self.sample_sigma = sigma_of_mean(loaded=False)
        elif block is None:
            self.status = self.stream.status()
        for event in events:
            # the screen and the page show the tracked values separately
            if event.kind != "tracked":
                text = f'mark "{event.text}"' if event.kind == "mark" else event.text
                self._add_note(FeedNote(event.t_host_ns, text, event.kind))

    def _add_note(self, note: FeedNote) -> None:
        for _, notes in self._readers:
            notes.append(note)

    # --------------------------------------------------------------------------------------------------------- requests

    @property
    def recording_s(self) -> float | None:
        """Duration of the running recording, s; None if none is running."""
        if self._recording not in self.sinks or self.newest_ns is None:
            return None
        return (self.newest_ns - self._recording_since_ns) * 1e-9

    def switch_recording(self) -> None:
        """Start a recording in a new file, or complete the running one."""
        if self._recording is not None and self._recording in self.sinks:
            self.sinks.remove(self._recording)
            try:
                self._recording.end()
            except (ConfigError, OSError) as error:
                self.note(f"recording stopped with an error: {error}", "failed")
            else:
                self.note("recording complete")
        elif self._recorder is None:
            self.note("recording is not available here: use `ftdrive record -o FILE`")
        else:
            now_ns = self.newest_ns or 0
            utc = datetime.fromtimestamp((now_ns + self.stream.info.utc_offset_ns) * 1e-9, UTC)
            # MCAP recordings need poses and a calibration; the readings of a sensor alone go to a table
            kind, ending = ("raw", "csv") if self.stream.info.is_raw else ("live", "mcap")
            path = Path(f"{kind}-{utc:%Y-%m-%dT%H%M%SZ}.{ending}").absolute()
            self._recording, self._recording_since_ns = self._recorder(path), now_ns
            self.sinks.append(self._recording)
            self.recorded.append(path)
            self.note(f"recording to {path}")

    def push_tool(self) -> None:
        """Push the tool of an emulated cell; on a real cell do nothing."""
        if self.push is not None:
            self.push()
            self.note("the emulated tool is pushed")

    def switch_stage(self, name: str) -> None:
        """Switch a stage on or off; the low-pass gets a cut-off below the Nyquist frequency of the sensor."""
        stages = self.stream.stages
        value: Any = not getattr(stages, name)
        if name == "lowpass_Hz":
            value = min(_LOWPASS_HZ, self.stream.info.sensor_rate_Hz / 4) if value else None
        self.stream.stages = replace(stages, **{name: value})

    def next_frame(self, name: str, values: Sequence[Any]) -> None:
        """Choose the next axes or point that the cell supports; for each one skipped, note what to configure."""
        frame = self.stream.frame
        now = getattr(frame, name)
        start = values.index(now) + 1 if now in values else 0
        for value in [*values[start:], *values[:start]]:
            try:
                self.stream.frame = replace(frame, **{name: value})
            except ConfigError as error:
                self.note(str(error), "failed")
            else:
                return


class NoiseWatch(Sink):
    """Compares the noise of a free tool at rest once with that in the poses of a calibration; `found` gets the check.

    The comparison uses two seconds in which the arm rests without contact.
    """

    label = "noise"

    def __init__(self, dataset: CalibrationDataset, found: Callable[[Check], object]) -> None:
        self._dataset, self._found = dataset, found
        self._resting: list[Block] | None = []

    def add(self, block: Block | None, events: Sequence[StreamEvent]) -> None:  # noqa: ARG002 - no event matters
        """Collect the samples of a rest, and compare the noise after two seconds."""
        if not block or self._resting is None:
            return
        first = self._resting[0] if self._resting else block
        moved = np.abs(block.R_base_flange[-1] - first.R_base_flange[0]).max() > _STILL_RAD
        self._resting = [] if moved or block.in_contact.any() else [*self._resting, block]
        if not self._resting or block.t_host_ns[-1] - first.t_host_ns[-1] < _REST_NS:
            return
        check = check_noise_change(np.concatenate([one.raw for one in self._resting]), self._dataset)
        self._resting = []
        if check.state != "skipped":
            self._resting = None
            self._found(check)


@dataclass(frozen=True, slots=True, eq=False)
class PlotColumns:
    """A time span divided into columns of equal duration, oldest first."""

    low: Array
    """(6, n) smallest value in each column; NaN in a column without samples."""
    high: Array
    """(6, n) largest value in each column; NaN in a column without samples."""
    in_contact: NDArray[np.bool_]
    """(n,) whether each column contains a contact."""
    start_ns: int
    column_ns: int
    marks: set[int]
    """Indices of the columns that contain a mark, a tare, a gap or a change of stages."""

    @property
    def span_s(self) -> float:
        """Duration of all columns."""
        return len(self.in_contact) * self.column_ns * 1e-9

    @property
    def span(self) -> str:
        """The duration as text."""
        return f"{self.span_s:.{0 if self.span_s > 5 else 1}f} s"

    @property
    def contact_cells(self) -> NDArray[np.bool_]:
        """(n / 2,) contact in each pair of columns, because one character shows two."""
        return self.in_contact[::2] | self.in_contact[1::2]


class History:
    """Smallest and largest wrench per time bin, for one time span.

    Bins are aligned to the clock: a plot moves by whole columns, and a completed column does not change.
    """

    def __init__(self, span_s: float) -> None:
        self._bin_ns = round(span_s * 1e9 / _BINS)
        self._size = 2 * _BINS
        self._bin = np.empty(self._size, np.int64)
        # Minima of the wrench and of the negated wrench.
        self._least = np.empty((self._size, 12))
        self._in_contact = np.empty(self._size, np.bool_)
        self.clear()

    def clear(self) -> None:
        """Discard all samples."""
        self._bin.fill(-1)

    def add(self, t_ns: NDArray[np.int64], wrench: Array, in_contact: NDArray[np.bool_]) -> None:
        """Add samples in time order: times (n,), wrenches (n, 6), and whether each is in contact (n,)."""
        bins = t_ns // self._bin_ns
        starts = np.flatnonzero(np.diff(bins, prepend=bins[0] - 1))
        bins = bins[starts]
        least = np.minimum.reduceat(np.hstack([wrench, -wrench]), starts)
        contact = np.logical_or.reduceat(in_contact, starts)
        # only the first bin can contain earlier samples
        if self._bin[at := bins[0] % self._size] == bins[0]:
            np.minimum(least[0], self._least[at], out=least[0])
            contact[0] |= self._in_contact[at]
        slots = bins % self._size
        self._bin[slots], self._least[slots], self._in_contact[slots] = bins, least, contact

    def columns(self, end_ns: int, n: int, marks_ns: Iterable[int] = ()) -> PlotColumns:
        """Return n columns, the last of which contains `end_ns`, with the indices of those that contain marks."""
        each = max(1, round(_BINS / n))
        first = (end_ns // self._bin_ns // each - n + 1) * each
        bins = np.arange(first, first + n * each)
        slots = bins % self._size
        missing = self._bin[slots] != bins
        least = np.where(missing[:, None], np.inf, self._least[slots]).reshape(n, each, 12).min(axis=1).T
        least[np.isinf(least)] = np.nan
        contact = (self._in_contact[slots] & ~missing).reshape(n, each).any(axis=1)
        start_ns, column_ns = int(first * self._bin_ns), each * self._bin_ns
        marks = {(mark_ns - start_ns) // column_ns for mark_ns in marks_ns} & set(range(n))
        return PlotColumns(least[:6], -least[6:], contact, start_ns, column_ns, marks)
