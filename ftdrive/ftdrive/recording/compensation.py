"""Compensation of stored recordings of any length, read in blocks."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ftcalib import CalibrationResult
from ftcalib.after.state import reestimate
from ftcalib.compensation import Compensator
from ftcalib.errors import BadDataset
from ftcalib.model import BIASES
from ftdrive.checks.check import compare_devices
from ftdrive.errors import BadRecording, ConfigError
from ftdrive.recording.files import RecordingReader
from ftdrive.recording.foreign import TablePair, table_words, tables_of
from ftdrive.recording.recorder import Recorder
from ftdrive.recording.recording import NEEDED, ROW, AnyRecording, Header, Measured, read_ahead, with_calibration
from ftdrive.runs.source import SolveOptions
from ftdrive.stream.samples import Block, Paired, StreamEvent, StreamInfo, WrenchFrame
from ftdrive.stream.sources import Read, SampleSource
from ftdrive.stream.stream import Sink, Stream, pump
from ftdrivers.interfaces import Array

# Duration of the first part of a recording, from which the noise is estimated, s.
_NOISE_S = 30.0
_OF_FORCE_AND_TORQUE = np.kron(np.eye(2), np.ones((3, 1)))
# Kinds of events that are copied from a recording to the compensated one.
_KEPT = ("mark", "delay", "stale", "recovered")
_READING_S = 0.1
_OUTLIER_SIGMAS = 4.0
_LEAST_READINGS = 20


def source_to_compensate(
    path: Path,
    options: SolveOptions,
    calibration: CalibrationResult | None,
    name: str,
    delay_s: float | str | None,
    *,
    everything: bool,
    say: Callable[[str], object],
) -> tuple[AnyRecording, dict[str, float] | None]:
    """Return the recording with its calibration; if another program wrote it, also the wrench's delay and sigma, s.

    `name` names the calibration, `delay_s` is a number, "auto" or None. With `everything`, all columns are read. `say`
    receives a description of what was recognised in the tables.
    """
    try:
        tables = tables_of(path, options.table, options.pair, options.topics)
    except (BadDataset, ConfigError) as error:
        if calibration is None:
            raise type(error)(f"{error}. Give --calibration PATH too") from error
        raise
    if tables is None:
        if delay_s is not None or options.table is not None:
            raise ConfigError("--delay and --columns are for recordings of other programs: leave them out")
        reader = RecordingReader(path, ROW.names or () if everything else NEEDED)
        if calibration is not None:
            info = reader.header.info
            if others := compare_devices(calibration, {"arm": info.arm, "sensor": info.sensor}).others:
                raise ConfigError(f"{path.name} and the calibration belong to different devices: {others[0]}")
            reader.header = with_calibration(reader.header, calibration, name)
        return reader, None
    if calibration is None:
        raise ConfigError("the recording has no calibration: give --calibration PATH")
    if words := table_words(tables):
        say(f" {words}")
    pair = TablePair(*tables, calibration, name, delay_s if isinstance(delay_s, float) else None)
    return pair, {"value": pair.delay_s, "sigma": pair.delay_sigma_s}


def compensate_recording(
    source: AnyRecording,
    frame: WrenchFrame,
    output: Path | None = None,
    *,
    estimate_bias: bool = False,
    show: Callable[[str], object] = lambda _: None,
) -> tuple[dict[str, Any], BaseException | None]:
    """Compensate a recording with the calibration in its header: subtract the bias and gravity.

    The first 30 s are read to estimate the noise, then the whole recording; with `estimate_bias`, the whole recording
    is read once more before. The result is given in `frame`. `output` is a new recording for the result and the events
    that still apply. `show` receives progress messages.

    Returns samples, duration_s, gaps; `raw` and `compensated`, each with the root mean square and the maximum of the
    force in N and the torque in N·m; `contacts` with time since the first sample in s, duration in s, peak in N and
    direction; `bias_change`, if estimated; axes, about; calibration (its name) and its marks; `cut`, why the recording
    ends early; `delay_s`, the last delay in the recording, with value and sigma. The second value is the damage or
    Ctrl-C that ended the pass early, or None; the numbers and the file then cover only the samples before it.

    Raises `ConfigError` for a frame that needs a missing setting, `BadDataset` for a recording that is too short for an
    estimate, `BadRecording` if its first block is damaged, and `OSError` if the result cannot be written; its message
    names what was kept.
    """
    header, change = source.header, None
    if estimate_bias:
        header, change = estimated_bias(source, show=show)
    info = header.info
    blocks, found = _Blocks(source, info, show), _RunningSums()
    failure: BaseException | None = None
    stream = Stream(blocks, frame=frame)
    sinks: list[Sink] = [found]
    if output is not None:
        sinks.append(Recorder([output], info, header.configuration, repeatable=True))
    try:
        with stream:
            for _ in pump(stream, sinks):
                pass
    except KeyboardInterrupt as error:
        if not found.samples:
            raise
        failure = error
        # end a contact that lasts to the end of the recording
        stream.processor.restart()
        found.add(None, stream.take_events())
    failure = failure or blocks.failure
    numbers = {
        **found.to_dict(),
        "delay_s": blocks.delay_s,
        "bias_change": change,
        **frame.to_dict(),
        "calibration": info.calibration_name,
        "marks": list(info.marks),
        "cut": source.cut if failure is None else str(failure) or "interrupted",
    }
    return numbers, failure


class _Blocks(SampleSource):
    """Source of samples that reads a recording without waiting, and copies the events that still apply."""

    def __init__(self, recording: AnyRecording, info: StreamInfo, show: Callable[[str], object]) -> None:
        self.info, self._recording, self._show = info, recording, show
        self._newest: Paired | None = None
        self.failure: Exception | None = None
        """Damage in the recording that ended reading early; None if there is none."""
        self.delay_s: dict[str, Any] | None = None

    def open(self) -> None:
        self._coming = read_ahead(self._recording.blocks())

    def close(self) -> None:
        self._coming.close()

    def beginning(self) -> Iterator[Paired]:
        """Yield the first 30 s of samples for the noise estimate; damage only ends them, because `read` reports it."""
        left = round(_NOISE_S * self.info.sensor_rate_Hz)
        with suppress(BadDataset, BadRecording):
            for block in self._recording.blocks():
                yield block.samples.rows(slice(left))
                left -= len(block.samples)
                if left <= 0:
                    return

    def read(self, _timeout_s: float = 0.0) -> Read:
        measured: Measured | None = None
        try:
            measured = next(self._coming, None)
        except (BadDataset, BadRecording) as error:
            if self._newest is None:
                raise
            self.failure = error
        if measured is None and self._newest is not None:
            # an empty read lets the stream process the samples that wait for later poses
            self.has_ended = True
            return Read(self._newest.rows(slice(0)))
        elif measured is None:
            raise BadDataset("the recording has no samples")
        samples, events, share = measured
        for event in events:
            if event.kind in _KEPT:
                self.note(event)
            if event.kind == "delay":
                self.delay_s = {name: event.values[name] for name in ("value", "sigma")}
        self._show(f"Compensating: {share:.0%}")
        self._newest = samples
        return Read(samples)


class _RunningSums(Sink):
    def __init__(self) -> None:
        self.samples, self._gaps = 0, 0
        self._begin_ns, self._end_ns, self._seq = 0, 0, 0
        # rows: raw and compensated wrench; columns: norms of force and torque
        self._squares, self._largest = np.zeros((2, 2)), np.zeros((2, 2))
        self._contacts: list[dict[str, Any]] = []

    def add(self, block: Block | None, events: Sequence[StreamEvent]) -> None:
        if block:
            if not self.samples:
                self._begin_ns, self._seq = int(block.t_host_ns[0]), int(block.seq[0]) - 1
            self.samples += len(block)
            self._gaps += int(np.count_nonzero(np.diff(block.seq, prepend=self._seq) != 1))
            self._end_ns, self._seq = int(block.t_host_ns[-1]), int(block.seq[-1])
            for i, wrench in enumerate((block.raw, block.wrench)):
                norms = np.square(wrench) @ _OF_FORCE_AND_TORQUE
                self._squares[i] += norms.sum(axis=0)
                self._largest[i] = np.maximum(self._largest[i], norms.max(axis=0))
        for event in events:
            if event.kind == "contact":
                values = {name: event.values[name] for name in ("duration_s", "peak_N", "direction")}
                self._contacts.append({"t_s": (event.t_host_ns - self._begin_ns) * 1e-9, **values})

    def to_dict(self) -> dict[str, Any]:
        """Return the statistics."""
        rms, largest = np.sqrt(self._squares / self.samples), np.sqrt(self._largest)
        raw, compensated = (
            {"force_rms_N": f_rms, "force_max_N": f_max, "torque_rms_Nm": t_rms, "torque_max_Nm": t_max}
            for (f_rms, t_rms), (f_max, t_max) in zip(rms.tolist(), largest.tolist(), strict=True)
        )
        return {
            "samples": self.samples,
            "duration_s": (self._end_ns - self._begin_ns) * 1e-9,
            "raw": raw,
            "compensated": compensated,
            "contacts": self._contacts,
            "gaps": self._gaps,
        }


def estimated_bias(
    source: AnyRecording, *, show: Callable[[str], object] = lambda _: None
) -> tuple[Header, dict[str, list[float]]]:
    """Estimate the bias from a recording with a mostly free tool; keep the other parameters and their uncertainty.

    The bias changes by the mean residual of readings averaged over 0.1 s. Readings far from the median, such as
    contacts, are excluded. The covariance includes the error of the kept parameters at the mean orientation, and the
    scatter of the readings with its correlation in time. Returns the header with the new calibration, and `value`, new
    minus old bias, and `sigma`, one standard deviation of the new one: 6 numbers each, N and N·m. Raises `BadDataset`
    for a recording that is too short.
    """
    info = source.header.info
    calibration = info.calibration
    size = max(1, round(_READING_S * info.sensor_rate_Hz))
    readings, orientations = [np.empty((0, 6))], [np.empty((0, 3, 3))]
    waiting: list[Paired] = []
    # damage only ends the estimate, because the next pass over the recording reports it
    with suppress(BadRecording):
        for samples, _, share in read_ahead(source.blocks()):
            show(f"Estimating the bias: {share:.0%}")
            paired = Paired.concatenate([*waiting, samples])
            whole = len(paired) // size * size
            waiting = [paired.rows(slice(whole, None))]
            readings.append(paired.raw[:whole].reshape(-1, size, 6).mean(axis=1))
            orientations.append(paired.R_base_flange[:whole].reshape(-1, size, 3, 3).mean(axis=1))
    reading, R = np.concatenate(readings), np.concatenate(orientations)
    if len(reading) < _LEAST_READINGS:
        seconds = len(reading) * _READING_S + sum(map(len, waiting)) / info.sensor_rate_Hz
        shortest_s = _LEAST_READINGS * _READING_S
        raise BadDataset(f"{seconds:.1f} s is too short to estimate a bias: record at least {shortest_s:g} s")
    # The bias belongs to readings that no sensor matrix has decoded. The wrench of a free tool is linear in R, so
    # means of R are as good as rotations.
    free_tool = Compensator(calibration.parameters, response=calibration.response)
    left = np.asarray(free_tool.batch(reading, R), np.float64)
    free = _near_median(left)
    scatter = left[free] - left[free].mean(axis=0)
    correlation = np.clip((scatter[1:] * scatter[:-1]).sum(axis=0) / (scatter**2).sum(axis=0), 0.0, 0.95)
    noise = scatter.T @ scatter / (len(scatter) - 1) * ((1 + correlation) / (1 - correlation)).max() / len(scatter)
    update = reestimate(calibration, R[free].mean(axis=0)[None], reading[free].mean(axis=0)[None], noise, "bias")
    estimated = replace(
        calibration, parameters=update.parameters, covariance=update.covariance, response=update.response
    )
    change = update.parameters.bias - calibration.parameters.bias
    sigma = np.sqrt(np.diag(update.covariance)[BIASES])
    header = with_calibration(source.header, estimated, f"{info.calibration_name}, bias estimated")
    return header, {"value": change.tolist(), "sigma": sigma.tolist()}


def _near_median(reading: Array) -> NDArray[np.bool_]:
    """Return a mask (n,) of the readings (n, 6) without outliers, which are far from the median of the others."""
    free = np.ones(len(reading), bool)
    for _ in range(20):
        centre = np.median(reading[free], axis=0)
        spread = 1.4826 * np.median(np.abs(reading[free] - centre), axis=0)
        before, free = free, np.asarray((np.abs(reading - centre) <= _OUTLIER_SIGMAS * spread).all(axis=1))
        if not free.any() or (free == before).all():
            break
    return free
