"""The compensated stream, the loop that reads it, and the interface of its sinks: recorders, servers, scale, screen.

A stream has a source and a processor. It does not depend on screens or files.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable, Generator, Iterator, Sequence
from contextlib import ExitStack, suppress
from functools import partial
from typing import Any, ClassVar, Final, Self

import numpy as np

from ftcalib.display import Displayed, Row, Summary
from ftcalib.errors import FtdriveError
from ftcalib.shown import wrench_figure
from ftdrive.cell.config import CellConfig
from ftdrive.cell.emulated import Station
from ftdrive.errors import ConfigError
from ftdrive.stream.contact import Contact
from ftdrive.stream.processing import SENSOR_FRAME, Processor
from ftdrive.stream.samples import Block, Sample, Stages, StreamEvent, StreamInfo, StreamStatus, Tracking, WrenchFrame
from ftdrive.stream.sources import STALE_S, CellSource, SampleSource
from ftdrive.stream.stages import stages_in_words
from ftdrivers.clock import Clock
from ftdrivers.errors import DeviceError

RECOVER_S: Final = 10.0
"""Default time-out, s, of an interruption: the loop that reads a stream ends after a longer one."""
# A sink may be late by this much, s, before it misses samples, because a busy computer can stop any for a moment.
_LATE_S: Final = 1.0


class Stream(Displayed):
    """Stream of paired and compensated samples inside a `with` block. The arm is read, never moved.

    Get samples with `read` or by iteration. No sample is skipped; a lost one leaves a gap in `Block.seq` and an event.
    After `read` has raised a device error, the next `read` reconnects.

    Parameters
    ----------
    source : SampleSource
        A cell, the sensor of a cell alone, or a recording.
    frame : WrenchFrame
        Axes and reference point; may be set at any time.
    stages : Stages
        Processing steps; may be set at any time. Default: `standard_stages`.
    track : "off", "show" or "apply"
        Whether bias and held part are tracked, and applied; may be set at any time. See `StreamStatus.tracked`.
    on_contact : callable
        Called by the reading thread 40 to 60 ms after the start of a contact and again at its end. May be set at any
        time.

    Raises
    ------
    ConfigError
        On entry: the calibration belongs to another arm, sensor or mount, the tool has none, or the frame needs a
        setting that is missing.
    ConnectError
        On entry: a device does not answer.
    """

    def __init__(
        self,
        source: SampleSource,
        *,
        frame: WrenchFrame = SENSOR_FRAME,
        stages: Stages | None = None,
        track: Tracking = "off",
        on_contact: Callable[[Contact], object] | None = None,
    ) -> None:
        self.source, self.on_contact = source, on_contact
        self._begin = frame, stages, track
        self._processor: Processor | None = None

    def open(self) -> Self:
        """Open the source and return the stream; `close` or the end of a `with` block closes it.

        Useful in a notebook, where a `with` block cannot span several cells.
        """
        self.source.open()
        try:
            self._process_with(*self._begin)
        except BaseException:
            self.source.close()
            raise
        return self

    def close(self) -> None:
        """Close the devices, and stop an emulated cell; may be called twice."""
        self.source.close()

    def __enter__(self) -> Self:
        return self.open()

    def __exit__(self, *_: object) -> None:
        self.close()

    def _process_with(self, frame: WrenchFrame, stages: Stages | None, track: Tracking) -> None:
        self._processor = processor = Processor(self.source.info, frame, stages, temperature=self.source.temperature)
        processor.learn_noise(self.source.beginning())
        self.source.note = processor.take_event
        if track != "off":
            processor.monitor.track = track

    @property
    def processor(self) -> Processor:
        """The processor of the samples. Raises `ConfigError` before the stream is open."""
        if self._processor is None:
            raise ConfigError("the stream is not open: use it in a with block, or call open")
        return self._processor

    @property
    def info(self) -> StreamInfo:
        """Constant description of the stream with its calibration."""
        return self.processor.info

    @property
    def clock(self) -> Clock:
        """Clock of the times in the stream."""
        return self.source.clock

    @property
    def devices(self) -> CellSource:
        """The source, which reads devices; raises `ConfigError` for a recording."""
        if not isinstance(self.source, CellSource):
            raise ConfigError("a recording has no devices: open a cell")
        return self.source

    @property
    def cell(self) -> CellConfig:
        """Configuration of the cell; raises `ConfigError` for a recording."""
        return self.devices.cell

    @property
    def warnings(self) -> tuple[str, ...]:
        """Doubts about the calibration, and checks that were not possible."""
        return self.source.warnings

    @property
    def station(self) -> Station:
        """The emulated cell, such as `station.control(do="push", wrench=[0, 0, -5, 0, 0, 0], seconds=1)`.

        docs/contributing/emulated-cell.md lists the requests. Raises `ConfigError` for a real cell.
        """
        return self.devices.station

    @property
    def has_ended(self) -> bool:
        """Whether a recording has ended."""
        return self.source.has_ended

    # -------------------------------------------------------------------------------------------------------- reading

    def read(self, timeout_s: float = STALE_S) -> Block:
        """Return the next samples: at least one of a cell, none while a recording is paused.

        Raises
        ------
        DeviceTimeout
            A device is silent, or no sample came within `timeout_s`.
        StreamBroken, DeviceFault, ConnectError
            A device has failed. The next call reconnects.
        """
        source, processor = self.source, self.processor
        while True:
            rows, begin, temperature_C, delay_sigma_s = source.read(timeout_s)
            if begin:
                processor.restart(elsewhere=begin == "elsewhere")
            block = processor.process(
                rows, last=source.has_ended, temperature_C=temperature_C, delay_sigma_s=delay_sigma_s
            )
            self._call_on_contact(processor)
            # samples may wait for later poses
            if len(block) or not len(rows):
                return block

    def _call_on_contact(self, processor: Processor) -> None:
        # Called without the processor's lock, because the function may call the stream.
        for contact in processor.take_contacts():
            if self.on_contact is not None:
                self.on_contact(contact)

    def __iter__(self) -> Iterator[Sample]:
        for block in pump(self, patience_s=0.0):
            if block:
                yield from block

    def status(self) -> StreamStatus:
        """Return the status: rates, losses and ages of the devices, delay, tare and drift."""
        return self.processor.status(self.source.links())

    def use_tool(self, name: str) -> StreamEvent:
        """Continue with the newest accepted calibration of another tool, after a tool change.

        The devices stay open. Noise, contact, tares and drift are reset; the delay is kept. Call it between two
        reads, and open new recorders and servers, because each keeps the calibration with which it was opened.

        Raises
        ------
        ConfigError
            The tool has no accepted calibration. The stream continues with the current one.
        """
        before = self.processor
        info = self.devices.use_tool(name)
        # end an open contact
        before.restart()
        self._call_on_contact(before)
        self._process_with(before.frame, before.settings, self.track)
        self.processor.events += before.take_events()
        values = {"tool": name, "calibration": info.calibration.id}
        return self.processor.note(
            "tool", f"tool {name}, calibration {info.calibration_name}", values, self.clock.now_ns()
        )

    # -------------------------------------------------------------------------------------------------------- settings

    @property
    def frame(self) -> WrenchFrame:
        """Axes and reference point of the wrench; a change adds an event, or raises `ConfigError` if unsupported."""
        return self.processor.frame

    @frame.setter
    def frame(self, frame: WrenchFrame) -> None:
        self.processor.frame = frame

    @property
    def stages(self) -> Stages:
        """Settings of the stages; a change adds an event, or raises `ConfigError` if a setting is missing."""
        return self.processor.settings

    @stages.setter
    def stages(self, stages: Stages) -> None:
        self.processor.settings = stages

    @property
    def track(self) -> Tracking:
        """Whether bias and held part are tracked, and applied; see `StreamStatus.tracked`."""
        return "off" if self.info.is_raw else self.processor.monitor.track

    @track.setter
    def track(self, track: Tracking) -> None:
        self.processor.monitor.track = track

    def tare(self) -> StreamEvent:
        """Change the bias so that the free tool reads zero over the last half second, or refuse."""
        return self.processor.tare()

    def undo_tare(self) -> StreamEvent:
        """Undo the last tare."""
        return self.processor.undo_tare()

    def mark(self, text: str) -> StreamEvent:
        """Add a mark to the events."""
        return self.processor.note("mark", text, {})

    def take_events(self) -> list[StreamEvent]:
        """Return the events since the last call."""
        return self.processor.take_events()

    # -------------------------------------------------------------------------------------------------------- display

    def _summary(self) -> Summary:
        name = type(self).__name__
        if self._processor is None:
            return Summary(f"{name}, not open: use it in a with block, or call open")
        info, sigma = self.info, self.processor.rest_sigma
        noise = "unknown yet" if sigma is None else f"{sigma[:3].max():.2g} N, {sigma[3:].max():.2g} N·m"
        now = Row("force now", ["no sample was read yet"])
        if self.processor.recent() is not None:
            force_N = self.processor.monitor.reading[:3]
            now = Row("force now x, y, z", [f"{value:.2f}" for value in force_N], "N in sensor axes")
        rows = [
            Row("arm", [f"{info.arm.model} {info.arm.serial}, {info.arm_rate_Hz:.4g} Hz"]),
            Row("sensor", [f"{info.sensor.model} {info.sensor.serial}, {info.sensor_rate_Hz:.4g} Hz"]),
            Row("wrench", [str(self.frame)]),
            Row("stages", [stages_in_words(self.stages)]),
            now,
            Row("sigma of a sample at rest", [noise]),
        ]
        return Summary(f"{name}: {info.calibration_state or info.calibration.id}", rows)

    def plot(self, duration_s: float = 2.0) -> Any:
        """Read for `duration_s`, and plot the wrench in `frame`, after `stages`.

        Parameters
        ----------
        duration_s : float
            Time to read, s. A loop over the stream does not receive these samples.

        Returns
        -------
        matplotlib.figure.Figure
            Forces above torques. The band is one sigma: noise, calibration, and errors of the sensor under contact.

        Raises
        ------
        UsageError
            matplotlib is not installed.
        DeviceError
            Raised by `read`.
        """
        begin_ns, blocks = self.clock.now_ns(), list[Block]()
        for block in pump(self, patience_s=0.0):
            # samples from before the call are not plotted
            if block and block.t_host_ns[-1] >= begin_ns:
                blocks.append(block)
            if blocks and blocks[-1].t_host_ns[-1] >= begin_ns + 1e9 * duration_s:
                break
        t_ns = np.concatenate([block.t_host_ns for block in blocks])
        drawn = t_ns >= begin_ns
        return wrench_figure(
            (t_ns[drawn] - begin_ns) * 1e-9,
            np.concatenate([block.wrench for block in blocks])[drawn],
            label="time, s",
            title=f"Contact wrench, {blocks[-1].frame}; band: one sigma",
            sigma=np.concatenate([np.broadcast_to(block.sigma, block.wrench.shape) for block in blocks])[drawn],
        )


class Sink(ABC):
    """A consumer of a stream, such as a recorder; `pump` calls it between two reads, in the reading thread."""

    label: ClassVar[str] = "output"
    """Name of the sink in messages."""
    keeps_all: ClassVar[bool] = False
    """Whether the sink needs every sample: then the stream waits for it, and its failure ends the loop."""
    missed = 0
    """Number of samples that the sink did not receive because it was too slow."""

    def begin(self, stream: Stream) -> None:  # noqa: B027 - most have nothing to prepare
        """Prepare for a stream; called before its first block."""

    @abstractmethod
    def add(self, block: Block | None, events: Sequence[StreamEvent]) -> None:
        """Add samples, and the events since the last call.

        `if block:` tests for samples. A block is empty while a recording is paused. It is None while a device has
        failed, and with the last events at the end.
        """

    def end(self) -> None:  # noqa: B027 - most have nothing to complete
        """Complete the output, for whatever reason the loop ended; also called after an error of `begin` or `add`."""


def pump(
    stream: Stream,
    sinks: list[Sink] | None = None,
    *,
    until: Callable[[], object] | None = None,
    patience_s: float = RECOVER_S,
    say: Callable[[str], object] = lambda _: None,
    meanwhile: str = "",
) -> Generator[Block | None, None, None]:
    """Read a stream block by block, pass each block to the sinks, and yield it; yield None while a device has failed.

    Without sinks the events stay in the stream. A sink that fails is ended and removed. A sink that is more than 1 s
    late misses the next samples until it has caught up, unless it `keeps_all`.

    Parameters
    ----------
    stream : Stream
        Open; its `read` reconnects after a failure.
    sinks : list of Sink
        Between two reads the caller may add a sink, or end and remove one. At its end the loop ends the other sinks.
    until : callable, optional
        Ends the loop before a read if it returns true; by default the loop ends with the recording.
    patience_s : float
        Longest duration of a failure; 0 raises the first one.
    say : callable
        Receives a sentence if a sink fails or has missed samples; with `meanwhile` also at the start and end of an
        interruption.
    meanwhile : str
        What happens during an interruption, in one sentence.

    Raises
    ------
    DeviceError
        A device has failed for `patience_s`, or had failed when `until` ended the loop.
    FtdriveError, OSError
        A sink of the first turn has failed, and it `keeps_all` or was the last sink.
    """
    outlets = _Outlets(stream, [] if sinks is None else sinks, say)
    failure: DeviceError | None = None
    failing_since_s = 0.0
    try:
        outlets.begin()
        while not (stream.has_ended if until is None else until()):
            block = None
            try:
                block = stream.read()
            except DeviceError as error:
                now_s = stream.clock.now_s()
                if failure is None:
                    failing_since_s = now_s
                    if meanwhile:
                        say(f"{error}. {meanwhile}")
                failure = error
                # No pause is needed, because each read has already waited for the device.
                if now_s - failing_since_s >= patience_s:
                    raise
            else:
                if failure is not None and meanwhile:
                    say("Samples arrive again.")
                failure = None
            outlets.add(block)
            yield block
            outlets.begin()
        if failure is not None:
            raise failure
    finally:
        outlets.end()


class _Outlets:
    """The sinks of one `pump` loop, and by how much each is late, s."""

    def __init__(self, stream: Stream, sinks: list[Sink], say: Callable[[str], object]) -> None:
        self._stream, self._sinks, self._say = stream, sinks, say
        self._given = [*sinks]
        self._late_s: dict[Sink, float] = {}

    def begin(self) -> None:
        """Begin the new sinks."""
        for sink in [one for one in self._sinks if one not in self._late_s]:
            self._late_s[sink] = 0.0
            self._try(sink, sink.begin, self._stream)

    def add(self, block: Block | None) -> None:
        """Pass a block and the events since the previous block to each sink."""
        events = self._stream.take_events() if self._sinks else []
        for sink in [*self._sinks]:
            add = sink.add if not block or sink.keeps_all else partial(self._add_in_time, sink)
            self._try(sink, add, block, events)

    def _add_in_time(self, sink: Sink, block: Block, events: Sequence[StreamEvent]) -> None:
        clock, begin_ns = self._stream.clock, self._stream.clock.now_ns()
        if self._late_s[sink] <= _LATE_S:
            sink.add(block, events)
        else:
            sink.missed += len(block)
            if events:
                sink.add(block.rows(slice(0)), events)
        took_s = (clock.now_ns() - begin_ns) * 1e-9
        lasted_s = len(block) / self._stream.info.sensor_rate_Hz
        self._late_s[sink] = max(self._late_s[sink] + took_s - lasted_s, 0.0)

    def end(self) -> None:
        """Pass the last events to each sink and end it, even if another sink fails."""
        events = self._stream.take_events() if self._sinks else []
        with ExitStack() as stack:
            for sink in reversed(self._sinks):
                stack.callback(self._try, sink, self._end, sink, events)

    def _end(self, sink: Sink, events: Sequence[StreamEvent]) -> None:
        if sink.missed:
            self._say(f"{sink.label} missed {sink.missed} samples because it is slower than the sensor")
        try:
            if events:
                sink.add(None, events)
        finally:
            sink.end()

    def _try(self, sink: Sink, act: Callable[..., None], *arguments: object) -> None:
        """Call a method of a sink; if it fails, end and remove the sink, and raise or report its error."""
        try:
            act(*arguments)
        except (FtdriveError, OSError) as error:
            self._sinks.remove(sink)
            with suppress(FtdriveError, OSError):
                sink.end()
            if sink in self._given and (sink.keeps_all or not self._sinks):
                raise
            self._say(f"{sink.label} stopped with an error: {error}")
