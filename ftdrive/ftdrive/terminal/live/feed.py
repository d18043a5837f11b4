"""The thread that reads a stream for the live screen."""

import threading
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from datetime import UTC, datetime
from operator import methodcaller
from pathlib import Path
from queue import SimpleQueue
from typing import Protocol

import numpy as np

from ftdrive.errors import ConfigError
from ftdrive.live.samples import Block, Stages, StreamEvent, StreamInfo, StreamStatus, WrenchFrame
from ftdrive.terminal.live.view import BAD, CONTACT, GOOD, STRONG, WARNING, Note
from ftdrivers.errors import DeviceError
from ftdrivers.interfaces import Array

MEAN_S = 0.1
"""The screen shows means of so long."""
_STATUS_NS = 50_000_000
_RETRY_S = 0.05
"""A failed stream may raise at once; this long the thread waits before it reads again."""
_MOST_BLOCKS = 2000
"""A screen that does not draw for many seconds misses the oldest ones; a recording never does."""
_MARKS = ("tare", "tare-undone", "stages", "gap", "mark")
"""Events whose time the plots show; contact has a colour, and a change of frame clears them."""
_STYLES = {
    "contact": CONTACT,
    "tare": GOOD,
    "tare-refused": BAD,
    "drift": WARNING,
    "gap": BAD,
    "stale": BAD,
    "recovered": GOOD,
    "mark": STRONG,
}


class Stream(Protocol):
    """What the screen needs of a `CompensatedStream` or a `ReplayedStream`."""

    info: StreamInfo
    frame: WrenchFrame
    stages: Stages

    def read(self) -> Block:
        """Return the next samples; none while a recording pauses."""

    def take_events(self) -> list[StreamEvent]:
        """Return the events since the last call."""

    def status(self) -> StreamStatus:
        """Return rates, ages, delay, tare and drift."""

    def sigma_of_mean(self, R_base_flange: Array, duration_s: float) -> Array:
        """Return the standard deviation (6,) of a mean of the wrench; NaN until the noise is known."""

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


class Feed:
    """Reads a stream in a thread of its own, so that the screen never waits for it.

    What a key changes is done between two reads, so that one thread uses the stream.

    Parameters
    ----------
    stream : Stream
    recorder : callable, optional
        Opens a recording in a new file.
    push : callable, optional
        Pushes the tool of an emulated cell.

    Attributes
    ----------
    blocks, notes : deque
        What is new; the screen takes it.
    status : StreamStatus
    sigma : array, shape (6,)
        Of a mean over `MEAN_S`; like the status at most 50 ms of the stream older than the newest block.
    failure : DeviceError or None
        Why the stream gives no samples now.
    crash : BaseException or None
        What ended the thread.
    newest_ns : int or None
        Time of the newest sample.
    recording_since_ns : int or None
        None without a recording.
    recorded : list of Path
        Files of all recordings.
    """

    def __init__(
        self,
        stream: Stream,
        recorder: Callable[[Path], Sink] | None = None,
        push: Callable[[], object] | None = None,
    ) -> None:
        self.stream = stream
        self.push = push
        self.blocks: deque[Block] = deque(maxlen=_MOST_BLOCKS)
        self.notes: deque[Note] = deque()
        self.status = stream.status()
        self.sigma = np.full(6, np.nan)
        self.failure: DeviceError | None = None
        self.crash: BaseException | None = None
        self.newest_ns: int | None = None
        self.recording_since_ns: int | None = None
        self.recorded: list[Path] = []
        self._recorder = recorder
        self._sink: Sink | None = None
        self._status_ns = 0
        self._requests: SimpleQueue[Callable[[], object]] = SimpleQueue()
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._run, name="live screen", daemon=True)

    def start(self) -> None:
        """Start to read."""
        self._thread.start()

    def stop(self) -> None:
        """Stop to read, and complete a recording."""
        self._ended.set()
        self._thread.join()
        self._stop_recording()

    def request(self, action: Callable[[], object]) -> None:
        """Let the reading thread do something with the stream."""
        self._requests.put(action)

    def note(self, text: str, style: str = "") -> None:
        """Add a line to the events of the screen."""
        self.notes.append(Note(self.newest_ns, text, style))

    def step(self) -> None:
        """Do what was requested, read once, and take the events."""
        while not self._requests.empty():
            try:
                self._requests.get_nowait()()
            except (ConfigError, DeviceError, OSError) as error:
                self.note(str(error), BAD)
        self._read()
        for event in self.stream.take_events():
            self._record(methodcaller("event", event))
            if event.kind == "tracked":
                continue  # the screen has a place for it
            text = f'mark "{event.text}"' if event.kind == "mark" else event.text
            self.notes.append(Note(event.t_host_ns, text, _STYLES.get(event.kind, ""), event.kind in _MARKS))

    def take(self, block: Block) -> None:
        """Hand samples on, if there are any."""
        if not len(block):
            return
        self.newest_ns = int(block.t_host_ns[-1])
        self.blocks.append(block)
        self._record(methodcaller("write", block))
        if abs(self.newest_ns - self._status_ns) > _STATUS_NS:
            self._status_ns = self.newest_ns
            self.status = self.stream.status()
            self.sigma = self.stream.sigma_of_mean(block.R_base_flange[-1], MEAN_S)

    def switch_recording(self) -> None:
        """Start a recording, or complete the one that runs; for `request`."""
        if self._sink is not None:
            self._stop_recording()
        elif self._recorder is None:
            self.note("recording is not available here: use `ftdrive record -o FILE`")
        else:
            utc = datetime.fromtimestamp((self._now_ns + self.stream.info.utc_offset_ns) * 1e-9, UTC)
            path = Path(f"live-{utc:%Y-%m-%dT%H%M%SZ}.mcap").absolute()
            self._sink, self.recording_since_ns = self._recorder(path), self._now_ns
            self.recorded.append(path)
            self.note(f"recording to {path}")

    def _run(self) -> None:
        try:
            while not self._ended.is_set():
                self.step()
        except BaseException as error:  # the main thread raises it
            self.crash = error

    @property
    def _now_ns(self) -> int:
        return self.newest_ns or 0

    def _read(self) -> None:
        try:
            block = self.stream.read()
        except DeviceError as error:
            self.failure, self.status = error, self.stream.status()
            self._ended.wait(_RETRY_S)
            return
        self.failure = None
        self.take(block)

    def _record(self, act: Callable[[Sink], object]) -> None:
        """Let the recorder do something; its failure ends the recording, never the screen."""
        if self._sink is None:
            return
        try:
            act(self._sink)
        except (ConfigError, OSError) as error:
            with suppress(ConfigError, OSError):
                self._sink.close()
            self._sink = self.recording_since_ns = None
            self.note(f"recording ended: {error}", BAD)

    def _stop_recording(self) -> None:
        self._record(methodcaller("close"))
        if self._sink is not None:
            self._sink = self.recording_since_ns = None
            self.note("recording complete")
