"""A whole recording compensated at once, without a device."""

from collections.abc import Collection
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ftcalib import CalibrationResult
from ftcalib.errors import BadDataset
from ftcalib.model import BIASES, jacobian
from ftdrive.checks.devices import belonging
from ftdrive.errors import ConfigError
from ftdrive.live.processing import Processor
from ftdrive.live.samples import StreamEvent, WrenchFrame
from ftdrive.recording.files import read_recording
from ftdrive.recording.recorder import Recorder
from ftdrive.recording.recording import ROW, Recording
from ftdrivers.interfaces import Array

_PIECE_ROWS = 1 << 13
_NOISE_S = 30.0
"""The noise is that of the beginning of a recording."""
_OF_FORCE_AND_TORQUE = np.kron(np.eye(2), np.ones((3, 1)))
NEEDED = ("t_host_ns", "seq", "raw", "p_base_flange_m", "quaternion_base_flange")
"""Columns without which there is no compensation."""
_READING_S = 0.1
_OUTLIER_SIGMAS = 4.0
_LEAST_READINGS = 20


def read_with_calibration(
    path: Path, calibration: CalibrationResult | None, name: str, columns: Collection[str] = ROW.names or ()
) -> Recording:
    """Read a recording, and replace its calibration unless there is no other.

    Parameters
    ----------
    path : Path
    calibration : CalibrationResult, optional
    name : str
        Of that calibration.
    columns : collection of str
        As in `read_recording`.

    Raises
    ------
    ConfigError
        The calibration is of other devices, or `read_recording` raises it.
    BadRecording, OSError
        As in `read_recording`.
    """
    recording = read_recording(path, columns)
    if calibration is None:
        return recording
    info = recording.header.info
    if others := belonging(calibration, {"arm": info.arm, "sensor": info.sensor}).others:
        raise ConfigError(f"{path.name} is of other devices than the calibration: {others[0]}")
    return recording.with_calibration(calibration, name)


def compensated(
    recording: Recording, frame: WrenchFrame, output: Path | None = None, *, estimate_bias: bool = False
) -> dict[str, Any]:
    """Compensate a recording with the calibration of its header, bias and gravity subtracted.

    Parameters
    ----------
    recording : Recording
    frame : WrenchFrame
        Of the result.
    output : Path, optional
        A new recording for the result, and for those events of the old one that still hold.
    estimate_bias : bool
        Whether `with_estimated_bias` replaces the bias of the calibration.

    Returns
    -------
    dict
        samples, duration_s, gaps; `raw` and `compensated` with root mean square and maximum of force in N and torque in
        N·m; `contacts` with time since the first sample in s, duration in s, peak in N and direction; `bias_change`, if
        it was estimated; axes, about; calibration, the name, and its marks.

    Raises
    ------
    ConfigError
        The frame needs what is not configured.
    BadDataset
        The recording is too short for an estimate.
    OSError
        The result cannot be written.
    """
    change = None
    if estimate_bias:
        recording, change = with_estimated_bias(recording)
    info = recording.header.info
    processor = Processor(info, frame)
    processor.learn_noise(recording.paired(slice(round(_NOISE_S * info.sensor_rate_Hz))))
    n, start_ns = len(recording.rows), int(recording.rows["t_host_ns"][0])
    squares, largest = np.zeros((2, 2)), np.zeros((2, 2))  # raw and compensated, force and torque
    events = [event for event in recording.events if event.kind in ("mark", "delay", "stale", "recovered")]
    contacts: list[dict[str, Any]] = []
    with ExitStack() as stack:
        recorder = None
        if output is not None:
            recorder = Recorder([output], info, recording.header.configuration)
            stack.callback(recorder.discard)
        for start in range(0, n, _PIECE_ROWS):
            paired = recording.paired(slice(start, start + _PIECE_ROWS))
            block = processor.process(paired, last=start + _PIECE_ROWS >= n)
            for i, wrench in enumerate((block.raw, block.wrench)):
                norms = np.square(wrench) @ _OF_FORCE_AND_TORQUE
                squares[i] += norms.sum(axis=0)
                largest[i] = np.maximum(largest[i], norms.max(axis=0))
            new = processor.take_events()
            contacts += [_contact(event, start_ns) for event in new if event.kind == "contact"]
            events += new
            if recorder is not None:
                recorder.write(block)
        if recorder is not None:
            for event in events:
                recorder.event(event)
            recorder.close()
    rms, largest = np.sqrt(squares / n), np.sqrt(largest)
    raw, compensated = (
        {"force_rms_N": f_rms, "force_max_N": f_max, "torque_rms_Nm": t_rms, "torque_max_Nm": t_max}
        for (f_rms, t_rms), (f_max, t_max) in zip(rms.tolist(), largest.tolist(), strict=True)
    )
    return {
        "samples": n,
        "duration_s": recording.duration_s,
        "raw": raw,
        "compensated": compensated,
        "contacts": contacts,
        "gaps": recording.gaps,
        "bias_change": change,
        **frame.to_dict(),
        "calibration": info.calibration_name,
        "marks": list(info.marks),
    }


def _contact(event: StreamEvent, start_ns: int) -> dict[str, Any]:
    values = {name: event.values[name] for name in ("duration_s", "peak_N", "direction")}
    return {"t_s": (event.t_host_ns - start_ns) * 1e-9, **values}


def with_estimated_bias(recording: Recording) -> tuple[Recording, dict[str, list[float]]]:
    """Estimate the bias from a recording of a mostly free tool; keep all other parameters and their uncertainty.

    The estimate is the mean of readings of 0.1 s of what the calibration leaves. Readings far from the median, such as
    contacts, do not count. Its covariance holds the error of the kept parameters at the orientations of the recording,
    and the scatter of the readings with its correlation in time.

    Returns
    -------
    recording : Recording
        With the new bias and its covariance in its calibration.
    change : dict
        `value`, new minus old bias, and `sigma`, one standard deviation of the new one: 6 numbers each, N and N·m.

    Raises
    ------
    BadDataset
        The recording is too short.
    """
    calibration, rate_Hz = recording.header.info.calibration, recording.header.info.sensor_rate_Hz
    size = max(1, round(_READING_S * rate_Hz))
    step = size * max(1, _PIECE_ROWS // size)
    readings, orientations = [np.empty((0, 6))], [np.empty((0, 3, 3))]
    for start in range(0, len(recording.rows), step):
        paired = recording.paired(slice(start, start + step))
        whole = len(paired) // size * size
        left = calibration.compensate(paired.raw[:whole], paired.R_base_flange[:whole])
        readings.append(left.reshape(-1, size, 6).mean(axis=1))
        orientations.append(paired.R_base_flange[:whole][size // 2 :: size])
    reading, R = np.concatenate(readings), np.concatenate(orientations)
    if len(reading) < _LEAST_READINGS:
        shortest_s = _LEAST_READINGS * _READING_S
        raise BadDataset(f"{recording.duration_s:.1f} s are too short for a bias: record at least {shortest_s:g} s")
    free = _free(reading)
    kept = reading[free]
    change = kept.mean(axis=0)
    scatter = kept - change
    correlation = np.clip((scatter[1:] * scatter[:-1]).sum(axis=0) / (scatter**2).sum(axis=0), 0.0, 0.95)
    J = jacobian(calibration.parameters, R[free]).mean(axis=0)
    errors = np.eye(15)  # of the new parameters by those of the old
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
    name = f"{recording.header.info.calibration_name}, bias estimated"
    sigma = np.sqrt(np.diag(covariance)[BIASES])
    return recording.with_calibration(estimated, name), {"value": change.tolist(), "sigma": sigma.tolist()}


def free_samples(left: Array, rate_Hz: float) -> NDArray[np.bool_]:
    """Return which samples (n,) belong to readings of a free tool; `left` (n, 6) is what the calibration leaves."""
    size = max(1, round(_READING_S * rate_Hz))
    whole = len(left) // size * size
    free = np.repeat(_free(left[:whole].reshape(-1, size, 6).mean(axis=1)), size)
    return np.concatenate([free, np.zeros(len(left) - whole, bool)])


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
