"""The thread that reads a stream for the live screen and the page in the browser."""

import math
import threading
from collections import deque
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from pathlib import Path
from queue import SimpleQueue
from typing import TypeVar, get_args

import numpy as np

from ftdrive.errors import ConfigError
from ftdrive.live.replay import ReplayedStream
from ftdrive.live.samples import Axes, Block, Point, Sink, StreamEvent, WrenchFrame
from ftdrive.live.stream import BlockReader, ProcessedStream
from ftdrive.terminal.lines import BAD, CONTACT, GOOD, STRONG, WARNING
from ftdrivers.errors import DeviceError

T = TypeVar("T")

MEAN_S = 0.1
"""The screen shows means of so long."""
_STATUS_NS = 50_000_000
# A failed stream may raise at once; this long the thread waits before it reads again.
_RETRY_S = 0.05
_SEEK_S = 5.0
# Cut-off of the low-pass that key 4 switches on.
_LOWPASS_HZ = 40.0
# A reader that takes nothing for many seconds misses the oldest ones; a recording never does.
_MOST_BLOCKS, _MOST_NOTES = 2000, 200
# Keys of stages, and those that mean nothing for readings of a sensor alone.
_STAGES = {"1": "bias", "2": "gravity", "3": "inertia"}
_OF_CALIBRATION = {"x", "a", *_STAGES}
# Events whose time the plots show; contact has a colour, and a change of frame clears them.
_MARKS = ("tare", "tare-undone", "stages", "gap", "mark")
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


class Feed:
    """Reads a stream in a thread of its own, so that the screen never waits for it.

    What a key changes is done between two reads, so that one thread uses the stream.

    Parameters
    ----------
    stream : ProcessedStream
    recorder : callable, optional
        Opens a recording in a new file.
    push : callable, optional
        Pushes the tool of an emulated cell.

    Attributes
    ----------
    status : StreamStatus
    sigma : array, shape (6,)
        Standard deviation of a mean over `MEAN_S`, under the present contact. Like the status it is at most 50 ms of
        the stream older than the newest block.
    rest_sigma, sample_sigma : array, shape (6,)
        The same of a free tool, and that of one of its samples.
    reader : BlockReader
        Its `failure` is why the stream gives no samples now.
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
        stream: ProcessedStream,
        recorder: Callable[[Path], Sink] | None = None,
        push: Callable[[], object] | None = None,
    ) -> None:
        self.stream = stream
        self.push = push
        self.status = stream.status()
        self.sigma = self.rest_sigma = self.sample_sigma = np.full(6, np.nan)
        self.reader = BlockReader(stream, math.inf)
        self.crash: BaseException | None = None
        self.newest_ns: int | None = None
        self.recording_since_ns: int | None = None
        self.recorded: list[Path] = []
        self._news: list[News] = []
        self._recorder = recorder
        self._sink: Sink | None = None
        self._status_ns = 0
        self._requests: SimpleQueue[tuple[str, str]] = SimpleQueue()
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

    def subscribe(self) -> "News":
        """Return the queues of one more reader; what is read from now on is in them."""
        self._news.append(news := News())
        return news

    def request(self, key: str, text: str = "") -> None:
        """Let the reading thread do what a key stands for; the text is its mark, time or speed."""
        if self.stream.info.is_raw and key in _OF_CALIBRATION:
            self.note("raw readings have neither stages nor other axes: start with --calibration for these")
            return
        self._requests.put((key, text))

    def note(self, text: str, style: str = "") -> None:
        """Add a line to the events."""
        self._add_note(Note(self.newest_ns, text, style))

    def step(self) -> None:
        """Do what was requested, read once, and take the events."""
        while not self._requests.empty():
            try:
                self._press(*self._requests.get_nowait())
            except (ConfigError, DeviceError, OSError) as error:
                self.note(str(error), BAD)
        block = self.reader.read()
        if block is None:
            self.status = self.stream.status()
            self._ended.wait(_RETRY_S)
        else:
            self.take(block)
        for event in self.stream.take_events():
            self._record(event)
            if event.kind == "tracked":
                # the screen has a place for it
                continue
            text = f'mark "{event.text}"' if event.kind == "mark" else event.text
            self._add_note(Note(event.t_host_ns, text, _STYLES.get(event.kind, ""), event.kind in _MARKS))

    def take(self, block: Block) -> None:
        """Hand samples on, if there are any."""
        if not len(block):
            return
        self.newest_ns = int(block.t_host_ns[-1])
        for news in self._news:
            news.blocks.append(block)
        self._record(block)
        if abs(self.newest_ns - self._status_ns) > _STATUS_NS:
            self._status_ns = self.newest_ns
            self.status = self.stream.status()
            R_base_flange = block.R_base_flange[-1]
            self.sigma = self.stream.sigma_of_mean(R_base_flange, MEAN_S)
            self.rest_sigma = self.stream.sigma_of_mean(R_base_flange, MEAN_S, loaded=False)
            self.sample_sigma = self.stream.sigma_of_mean(R_base_flange, loaded=False)

    def _add_note(self, note: "Note") -> None:
        for news in self._news:
            news.notes.append(note)

    def _switch_recording(self) -> None:
        if self._sink is not None:
            self._stop_recording()
        elif self._recorder is None:
            self.note("recording is not available here: use `ftdrive record -o FILE`")
        else:
            now_ns = self.newest_ns or 0
            utc = datetime.fromtimestamp((now_ns + self.stream.info.utc_offset_ns) * 1e-9, UTC)
            # a recording has poses and a calibration, a table of readings has not
            kind, ending = ("raw", "csv") if self.stream.info.is_raw else ("live", "mcap")
            path = Path(f"{kind}-{utc:%Y-%m-%dT%H%M%SZ}.{ending}").absolute()
            self._sink, self.recording_since_ns = self._recorder(path), now_ns
            self.recorded.append(path)
            self.note(f"recording to {path}")

    def _run(self) -> None:
        try:
            while not self._ended.is_set():
                self.step()
        except BaseException as error:  # the main thread raises it
            self.crash = error

    def _record(self, item: Block | StreamEvent | None) -> None:
        """Hand something to the recorder, None to complete it; its failure ends the recording, never the screen."""
        if self._sink is None:
            return
        try:
            if item is None:
                self._sink.close()
            elif isinstance(item, Block):
                self._sink.write(item)
            else:
                self._sink.event(item)
        except (ConfigError, OSError) as error:
            with suppress(ConfigError, OSError):
                self._sink.close()
            self._sink = self.recording_since_ns = None
            self.note(f"recording ended: {error}", BAD)

    def _stop_recording(self) -> None:
        self._record(None)
        if self._sink is not None:
            self._sink = self.recording_since_ns = None
            self.note("recording complete")

    # ------------------------------------------------------------------------------------------------------------ keys

    def _press(self, key: str, text: str) -> None:
        stream = self.stream
        if key == "b":
            stream.mark(text)
        elif key == "t":
            stream.tare()
        elif key == "u":
            stream.undo_tare()
        elif key == "f" and self.push is not None:
            self.push()
            self.note("the emulated tool is pushed")
        elif key == "r":
            self._switch_recording()
        elif key == "x":
            self._set_frame([replace(stream.frame, axes=axes) for axes in after(stream.frame.axes, get_args(Axes))])
        elif key == "a":
            self._set_frame([replace(stream.frame, about=one) for one in after(stream.frame.about, get_args(Point))])
        elif name := _STAGES.get(key):
            stream.stages = replace(stream.stages, **{name: not getattr(stream.stages, name)})
        elif key == "4":
            highest_Hz = min(_LOWPASS_HZ, stream.info.sensor_rate_Hz / 4)
            stream.stages = replace(stream.stages, lowpass_Hz=None if stream.stages.lowpass_Hz else highest_Hz)
        elif isinstance(stream, ReplayedStream):
            self._press_of_replay(stream, key, text)

    def _press_of_replay(self, stream: ReplayedStream, key: str, text: str) -> None:
        if key == "seek":
            stream.seek(float(text))
        elif key == "speed":
            stream.speed = float(text)
        elif key == "space":
            (stream.resume if stream.is_paused else stream.pause)()
        elif key in {"left", "right"}:
            stream.seek(stream.at_s + (_SEEK_S if key == "right" else -_SEEK_S))
        elif key == ".":
            self.take(stream.step())
        elif key in {"+", "=", "-"}:
            stream.speed *= 0.5 if key == "-" else 2

    def _set_frame(self, frames: Iterable[WrenchFrame]) -> None:
        """Choose the first frame that the cell has; the others say what to configure."""
        for each in frames:
            try:
                self.stream.frame = each
            except ConfigError as error:
                self.note(str(error), BAD)
            else:
                return


def after(value: object, values: Sequence[T]) -> Sequence[T]:
    """Return the values in turn, beginning after `value`."""
    start = values.index(value) + 1 if value in values else 0
    return [*values[start:], *values[:start]]


@dataclass(frozen=True, slots=True)
class Note:
    """An event, or an answer to a key."""

    t_host_ns: int | None
    text: str
    style: str = ""
    is_mark: bool = False
    """Whether the plots show its time."""
    times: int = 1
    """How often it came in a row."""

    @property
    def words(self) -> str:
        """The text, with how often it came."""
        return self.text if self.times == 1 else f"{self.text} ({self.times} times)"


@dataclass(frozen=True, slots=True, eq=False)
class News:
    """What one reader of a `Feed` has not taken yet."""

    blocks: deque[Block] = field(default_factory=lambda: deque(maxlen=_MOST_BLOCKS))
    notes: deque[Note] = field(default_factory=lambda: deque(maxlen=_MOST_NOTES))
