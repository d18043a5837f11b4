"""A recording of any length compensated in blocks, without a device."""

from collections.abc import Callable, Collection, Generator, Iterator, Sequence
from contextlib import ExitStack, closing, suppress
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ftcalib import CalibrationResult
from ftcalib.errors import BadDataset
from ftcalib.model import BIASES, jacobian
from ftdrive.checks.check import compare_devices
from ftdrive.errors import BadRecording, ConfigError
from ftdrive.live.processing import Processor
from ftdrive.live.samples import Block, Paired, StreamEvent, WrenchFrame
from ftdrive.recording.files import RecordingReader
from ftdrive.recording.recorder import Recorder
from ftdrive.recording.recording import ROW, Header, Measured, Source, read_ahead, with_calibration
from ftdrivers.interfaces import Array

# The noise is that of the beginning of a recording.
_NOISE_S = 30.0
_OF_FORCE_AND_TORQUE = np.kron(np.eye(2), np.ones((3, 1)))
NEEDED = ("t_host_ns", "seq", "raw", "p_base_flange_m", "quaternion_base_flange")
"""Columns without which there is no compensation."""
# Events of a recording that hold for its compensated one too.
_KEPT = ("mark", "delay", "stale", "recovered")
_READING_S = 0.1
_OUTLIER_SIGMAS = 4.0
_LEAST_READINGS = 20


class Compensated(NamedTuple):
    """The result of `compensated`."""

    numbers: dict[str, Any]
    failure: BaseException | None = None
    """What ended the recording early: damage, or Ctrl-C; the numbers and the file hold what was before."""


def read_with_calibration(
    path: Path, calibration: CalibrationResult | None, name: str, columns: Collection[str] = ROW.names or ()
) -> RecordingReader:
    """Open a recording, and replace its calibration unless there is no other.

    Parameters
    ----------
    path : Path
    calibration : CalibrationResult, optional
    name : str
        Of that calibration.
    columns : collection of str
        As in `RecordingReader`.

    Raises
    ------
    ConfigError
        The calibration is of other devices, or `RecordingReader` raises it.
    BadRecording, OSError
        As in `RecordingReader`.
    """
    reader = RecordingReader(path, columns)
    if calibration is not None:
        info = reader.header.info
        if others := compare_devices(calibration, {"arm": info.arm, "sensor": info.sensor}).others:
            raise ConfigError(f"{path.name} is of other devices than the calibration: {others[0]}")
        reader.header = with_calibration(reader.header, calibration, name)
    return reader


def compensate_recording(
    source: Source,
    frame: WrenchFrame,
    output: Path | None = None,
    *,
    estimate_bias: bool = False,
    show: Callable[[str], object] = lambda _: None,
) -> Compensated:
    """Compensate a recording of any length with the calibration of its header, bias and gravity subtracted.

    It is read once, after its beginning was read for the noise; for the bias it is read once more before.

    Parameters
    ----------
    source : Source
    frame : WrenchFrame
        Of the result.
    output : Path, optional
        A new recording for the result, and for those events of the old one that still hold.
    estimate_bias : bool
        Whether `estimated_bias` replaces the bias of the calibration.
    show : callable
        Gets what is done and how much of it, in words.

    Returns
    -------
    numbers : dict
        samples, duration_s, gaps; `raw` and `compensated` with root mean square and maximum of force in N and torque in
        N·m; `contacts` with time since the first sample in s, duration in s, peak in N and direction; `bias_change`, if
        it was estimated; axes, about; calibration, the name, and its marks; `cut`, why it ends early; `delay_s`, the
        last one that the recording names, with value and sigma.
    failure : exception or None
        A file that is damaged and Ctrl-C end the recording at the last valid block.

    Raises
    ------
    ConfigError
        The frame needs what is not configured.
    BadDataset
        The recording is too short for an estimate.
    BadRecording
        Its first block is damaged.
    OSError
        The result cannot be written; the error names what was kept.
    """
    header, change = source.header, None
    if estimate_bias:
        header, change = estimated_bias(source, show=show)
    info = header.info
    processor = Processor(info, frame)
    processor.learn_noise(_beginning(source, round(_NOISE_S * info.sensor_rate_Hz)))
    found = _Sums()
    failure: BaseException | None = None
    with ExitStack() as stack:
        recorder = None
        if output is not None:
            recorder = Recorder([output], info, header.configuration, repeatable=True)
            stack.callback(recorder.discard)
        try:
            blocks = _processed(read_ahead(source.blocks()), processor)
            # so that no thread processes further
            with closing(read_ahead(blocks)) as coming:
                for block, old, new, share in coming:
                    found.add(block, old, new, recorder)
                    show(f"Compensating: {share:.0%}")
        except (BadDataset, BadRecording, KeyboardInterrupt) as error:
            if not found.samples:
                raise
            failure = error
        # a contact at the end is over
        processor.restart()
        found.add(None, [], [one for one in processor.take_events() if one.t_host_ns <= found.end_ns], recorder)
        if recorder is not None:
            recorder.close()
    numbers = {
        **found.to_dict(),
        "bias_change": change,
        **frame.to_dict(),
        "calibration": info.calibration_name,
        "marks": list(info.marks),
        "cut": source.cut if failure is None else str(failure) or "interrupted",
    }
    return Compensated(numbers, failure)


def _processed(
    measured: Iterator[Measured], processor: Processor
) -> Generator[tuple[Block | None, Sequence[StreamEvent], Sequence[StreamEvent], float], None, None]:
    """Yield each block with the events of its recording that still hold, those of the processing, and its share."""
    for samples, events, share in measured:
        block = processor.process(samples) if len(samples) else None
        yield block, [one for one in events if one.kind in _KEPT], processor.take_events(), share
    yield processor.finish(), [], processor.take_events(), 1.0


def _beginning(source: Source, samples: int) -> Iterator[Paired]:
    """Yield the first samples; damage behind them is left to the pass that follows."""
    with suppress(BadDataset, BadRecording):
        for block in source.blocks():
            yield block.samples.rows(slice(samples))
            samples -= len(block.samples)
            if samples <= 0:
                return


class _Sums:
    """What is known of a result, block after block."""

    def __init__(self) -> None:
        self.samples, self._gaps = 0, 0
        self._begin_ns, self.end_ns, self._seq = 0, 0, 0
        # raw and compensated, force and torque
        self._squares, self._largest = np.zeros((2, 2)), np.zeros((2, 2))
        self._contacts: list[dict[str, Any]] = []
        self._delay: dict[str, Any] | None = None

    def add(
        self, block: Block | None, old: Sequence[StreamEvent], new: Sequence[StreamEvent], recorder: Recorder | None
    ) -> None:
        """Add the next block, and the events of the recording and of the result since the one before."""
        block = block if block is not None and len(block) else None
        if block is not None:
            if not self.samples:
                self._begin_ns, self._seq = int(block.t_host_ns[0]), int(block.seq[0]) - 1
            self.samples += len(block)
            self._gaps += int(np.count_nonzero(np.diff(block.seq, prepend=self._seq) != 1))
            self.end_ns, self._seq = int(block.t_host_ns[-1]), int(block.seq[-1])
            for i, wrench in enumerate((block.raw, block.wrench)):
                norms = np.square(wrench) @ _OF_FORCE_AND_TORQUE
                self._squares[i] += norms.sum(axis=0)
                self._largest[i] = np.maximum(self._largest[i], norms.max(axis=0))
        for event in old:
            if event.kind == "delay":
                self._delay = {name: event.values[name] for name in ("value", "sigma")}
        self._contacts += [_contact(event, self._begin_ns) for event in new if event.kind == "contact"]
        if recorder is not None:
            for event in (*old, *new):
                recorder.event(event)
            if block is not None:
                recorder.write(block)

    def to_dict(self) -> dict[str, Any]:
        """Return the numbers."""
        rms, largest = np.sqrt(self._squares / self.samples), np.sqrt(self._largest)
        raw, compensated = (
            {"force_rms_N": f_rms, "force_max_N": f_max, "torque_rms_Nm": t_rms, "torque_max_Nm": t_max}
            for (f_rms, t_rms), (f_max, t_max) in zip(rms.tolist(), largest.tolist(), strict=True)
        )
        return {
            "samples": self.samples,
            "duration_s": (self.end_ns - self._begin_ns) * 1e-9,
            "raw": raw,
            "compensated": compensated,
            "contacts": self._contacts,
            "gaps": self._gaps,
            "delay_s": self._delay,
        }


def _contact(event: StreamEvent, start_ns: int) -> dict[str, Any]:
    values = {name: event.values[name] for name in ("duration_s", "peak_N", "direction")}
    return {"t_s": (event.t_host_ns - start_ns) * 1e-9, **values}


def estimated_bias(
    source: Source, *, show: Callable[[str], object] = lambda _: None
) -> tuple[Header, dict[str, list[float]]]:
    """Estimate the bias from a recording of a mostly free tool; keep all other parameters and their uncertainty.

    The estimate is the mean of readings of 0.1 s of what the calibration leaves. Readings far from the median, such as
    contacts, do not count. Its covariance holds the error of the kept parameters at the orientations of the recording,
    and the scatter of the readings with its correlation in time.

    Returns
    -------
    header : Header
        With the new bias and its covariance in its calibration.
    change : dict
        `value`, new minus old bias, and `sigma`, one standard deviation of the new one: 6 numbers each, N and N·m.

    Raises
    ------
    BadDataset
        The recording is too short.
    """
    info = source.header.info
    calibration = info.calibration
    size = max(1, round(_READING_S * info.sensor_rate_Hz))
    readings, orientations = [np.empty((0, 6))], [np.empty((0, 3, 3))]
    waiting: list[Paired] = []
    # the pass that follows ends there too
    with suppress(BadRecording):
        for samples, _, share in read_ahead(source.blocks()):
            show(f"Estimating the bias: {share:.0%}")
            paired = Paired.concatenate([*waiting, samples])
            whole = len(paired) // size * size
            waiting = [paired.rows(slice(whole, None))]
            left = calibration.compensate(paired.raw[:whole], paired.R_base_flange[:whole])
            readings.append(left.reshape(-1, size, 6).mean(axis=1))
            # a view keeps the block
            orientations.append(paired.R_base_flange[:whole][size // 2 :: size].copy())
    reading, R = np.concatenate(readings), np.concatenate(orientations)
    if len(reading) < _LEAST_READINGS:
        seconds = len(reading) * _READING_S + sum(map(len, waiting)) / info.sensor_rate_Hz
        shortest_s = _LEAST_READINGS * _READING_S
        raise BadDataset(f"{seconds:.1f} s are too short for a bias: record at least {shortest_s:g} s")
    free = _free(reading)
    kept = reading[free]
    change = kept.mean(axis=0)
    scatter = kept - change
    correlation = np.clip((scatter[1:] * scatter[:-1]).sum(axis=0) / (scatter**2).sum(axis=0), 0.0, 0.95)
    J = jacobian(calibration.parameters, R[free]).mean(axis=0)
    # of the new parameters by those of the old
    errors = np.eye(15)
    errors[BIASES] = -J
    errors[np.ix_(BIASES, BIASES)] = 0.0
    covariance = errors @ calibration.covariance @ errors.T
    noise = scatter.T @ scatter / (len(kept) - 1) * ((1 + correlation) / (1 - correlation)).max() / len(kept)
    covariance[np.ix_(BIASES, BIASES)] += noise
    old = calibration.parameters
    parameters = replace(
        old, force_bias_N=old.force_bias_N + change[:3], torque_bias_Nm=old.torque_bias_Nm + change[3:]
    )
    estimated = replace(calibration, parameters=parameters, covariance=covariance)
    sigma = np.sqrt(np.diag(covariance)[BIASES])
    header = with_calibration(source.header, estimated, f"{info.calibration_name}, bias estimated")
    return header, {"value": change.tolist(), "sigma": sigma.tolist()}


def _free(reading: Array) -> NDArray[np.bool_]:
    """Return which readings (n, 6) are near the median of those that are, in units of their own spread."""
    free = np.ones(len(reading), bool)
    for _ in range(20):
        centre = np.median(reading[free], axis=0)
        spread = 1.4826 * np.median(np.abs(reading[free] - centre), axis=0)
        before, free = free, np.asarray((np.abs(reading - centre) <= _OUTLIER_SIGMAS * spread).all(axis=1))
        if not free.any() or (free == before).all():
            break
    return free
