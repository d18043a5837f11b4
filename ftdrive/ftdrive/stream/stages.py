"""The stages between raw and compensated wrench, listed in `STAGES`, and the prediction for the free tool.

A stage is a class that `Stage.of` creates from the settings, or None if it has nothing to do. `Processor` runs the
stages in this order. Weight, bias and inertia of the free tool are always subtracted first, because contact is detected
from the residual. The decoder adds weight or bias again if the settings keep them.
"""

from abc import ABC, abstractmethod
from collections.abc import Mapping
from datetime import datetime
from typing import ClassVar, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from ftcalib.after.series import BiasTemperature
from ftcalib.after.state import Update, compare_with_prediction, tare, with_bias_change
from ftcalib.after.weighing import Weight, holding
from ftcalib.compensation import Compensator, MovedLoad
from ftcalib.data.dwell_mean import LEAST_SAMPLES, is_stationary, mean_and_covariance
from ftcalib.errors import BadDataset
from ftcalib.files import JSON
from ftcalib.sensor_matrix import Calibrated
from ftdrive.errors import ConfigError
from ftdrive.stream.noise import REST, MotionTracker
from ftdrive.stream.samples import FrameTransform, Paired, Stages, StreamInfo, WrenchFrame
from ftdrivers.interfaces import Array

# Changes of the sensor's temperature after which its bias is corrected, and after which an event says so, K.
_STEP_K, _NOTED_K = 0.05, 1.0
_HOUR_NS = 3600e9
LOWPASS_ORDER = 2
"""Order of the Butterworth low-pass filter."""
NOTCH_Q = 10.0
"""Quality of the notch filter: its centre frequency divided by its width at -3 dB."""
TARE_S = 0.5
TARE_DRIFT_N, TARE_DRIFT_NM = 0.5, 0.015
"""Drift of the bias since the calibration or the last tare that a tare accepts as usual, one standard deviation."""

# The acceleration comes from poses at this spacing, s, up to this time before and after; a longer one blurs moves.
_KNOT_S, _REACH_S = 0.002, 0.015
# Largest motion of the flange during a tare, rad and m.
_STILL_RAD, _STILL_M = 5e-4, 5e-4


class Passing(NamedTuple):
    """n samples on their way through the stages, with the predicted wrench of the free tool, N and N·m."""

    rows: Paired
    states: NDArray[np.int8]
    """(n,) states of motion, as `MotionTracker.follow` returns them."""
    felt: Array
    """(n, 6) inertial wrench computed from earlier poses only."""
    inertial: Array | None
    """(n, 6) inertial wrench from the poses before and after each sample; None if it is not subtracted."""
    gravity: Array
    """(n, 6) wrench of the tool's weight."""
    bias: Array
    """(6,) bias of the sensor, tares included."""


class Stage(ABC):
    """A step from the raw to the compensated wrench."""

    is_of_free_tool: ClassVar = False
    """Whether the stage subtracts the wrench of the free tool: contact is judged after the last of these stages."""
    power_gain = 1.0
    """Factor by which the stage multiplies the noise variance of a sample; a nonlinear stage has one, too."""

    @classmethod
    @abstractmethod
    def of(cls, settings: Stages, frame: WrenchFrame, info: StreamInfo) -> Self | None:
        """Create the stage; None if it has nothing to do. Raises `ConfigError` if it needs a missing setting."""

    @classmethod
    def words(cls, _settings: Stages) -> str:
        """Return the description of the stage for the list of stages; empty if it is not listed."""
        return ""

    @abstractmethod
    def __call__(self, wrench: Array, passing: Passing) -> Array:
        """Apply the stage to the next samples; return their wrenches (n, 6), N and N·m."""


class _FreeToolAtRest(Stage):
    """Subtract weight and bias; for a sensor alone, the tare."""

    is_of_free_tool = True

    @classmethod
    def of(cls, _settings: Stages, _frame: WrenchFrame, _info: StreamInfo) -> Self:
        return cls()

    @classmethod
    def words(cls, settings: Stages) -> str:
        return ", ".join(name for name in ("bias", "gravity") if getattr(settings, name))

    def __call__(self, wrench: Array, passing: Passing) -> Array:
        return wrench - passing.gravity - passing.bias


class _InertialWrench(Stage):
    """Subtract the inertial wrench of the load; this needs a calibration and the position of the sensor."""

    is_of_free_tool = True

    @classmethod
    def of(cls, settings: Stages, _frame: WrenchFrame, info: StreamInfo) -> Self | None:
        if not settings.inertia or info.is_raw:
            return None
        if not np.isfinite(info.p_flange_sensor_m).all():
            raise ConfigError(
                "the inertia stage needs the position of the sensor: set [sensor] height_mm, the height of its "
                "origin above the flange face"
            )
        return cls()

    @classmethod
    def words(cls, settings: Stages) -> str:
        return "inertia" if settings.inertia else ""

    def __call__(self, wrench: Array, passing: Passing) -> Array:
        return wrench if passing.inertial is None else wrench - passing.inertial


class _Decoder(Stage):
    """Decode the contact wrench with the sensor matrix from known loads; this needs a calibration.

    Weight and bias that the settings keep are added as read, because the matrix applies to contacts only.
    """

    def __init__(self, settings: Stages, info: StreamInfo) -> None:
        self._settings, self._decode = settings, info.calibration.contact.decode

    @classmethod
    def of(cls, settings: Stages, _frame: WrenchFrame, info: StreamInfo) -> Self | None:
        return None if info.is_raw else cls(settings, info)

    def __call__(self, wrench: Array, passing: Passing) -> Array:
        wrench = self._decode(wrench)
        if not self._settings.gravity:
            wrench = wrench + passing.gravity
        return wrench if self._settings.bias else wrench + passing.bias


class _Filter(Stage):
    """Notch and low-pass filters as second-order sections; their state continues from block to block.

    The filter starts in the steady state of the first sample, to avoid a transient. Frequencies lie between 0 and half
    the sensor rate.
    """

    def __init__(self, settings: Stages, rate_Hz: float) -> None:
        from scipy import signal

        sections = []
        for name, f_Hz in (("notch", settings.notch_Hz), ("low-pass", settings.lowpass_Hz)):
            if f_Hz is None:
                continue
            if not 0 < f_Hz < rate_Hz / 2:
                raise ConfigError(
                    f"a {name} at {f_Hz:g} Hz is not possible with samples at {rate_Hz:g} Hz: choose more than 0 "
                    f"and less than {rate_Hz / 2:g} Hz"
                )
            if name == "notch":
                sections.append(signal.tf2sos(*signal.iirnotch(f_Hz, NOTCH_Q, rate_Hz)))
            else:
                sections.append(signal.butter(LOWPASS_ORDER, f_Hz, fs=rate_Hz, output="sos"))
        self._sections = np.concatenate(sections)
        self._steady = signal.sosfilt_zi(self._sections)
        self._run = signal.sosfilt
        self._state: Array | None = None
        # the sum of |H|² is exact on this grid unless the cut-off is below a thousandth of the rate
        self.power_gain = float(np.mean(np.abs(signal.sosfreqz(self._sections, 1 << 14)[1]) ** 2))

    @classmethod
    def of(cls, settings: Stages, _frame: WrenchFrame, info: StreamInfo) -> Self | None:
        is_on = settings.notch_Hz is not None or settings.lowpass_Hz is not None
        return cls(settings, info.sensor_rate_Hz) if is_on else None

    @classmethod
    def words(cls, settings: Stages) -> str:
        words = [] if settings.notch_Hz is None else [f"notch {settings.notch_Hz:g} Hz (Q {NOTCH_Q:g})"]
        if settings.lowpass_Hz is not None:
            words.append(f"low-pass {settings.lowpass_Hz:g} Hz (Butterworth, order {LOWPASS_ORDER})")
        return ", ".join(words)

    def __call__(self, wrench: Array, _: Passing) -> Array:
        if not len(wrench):
            return wrench
        if self._state is None:
            self._state = self._steady[:, :, None] * wrench[0]
        filtered, self._state = self._run(self._sections, wrench, axis=0, zi=self._state)
        return np.asarray(filtered)


class FrameChange(Stage):
    """Transform the wrench to a frame; raises `ConfigError` as `FrameTransform` does."""

    def __init__(self, frame: WrenchFrame, info: StreamInfo) -> None:
        self.frame, self._transform = frame, FrameTransform(frame, info)
        self.matrix = self._transform.matrix

    @classmethod
    def of(cls, _settings: Stages, frame: WrenchFrame, info: StreamInfo) -> Self:
        return cls(frame, info)

    def __call__(self, wrench: Array, passing: Passing) -> Array:
        return self._transform(wrench, passing.rows.R_base_flange)


class _Deadband(Stage):
    """Shorten force and torque vectors by the deadband; vectors shorter than the deadband become zero.

    The norm of the vector is compared, so the deadband is equal in all directions. The noise of longer vectors
    does not change.
    """

    def __init__(self, settings: Stages) -> None:
        self._deadband = np.array([[settings.deadband_N], [settings.deadband_Nm]])

    @classmethod
    def of(cls, settings: Stages, _frame: WrenchFrame, _info: StreamInfo) -> Self | None:
        return cls(settings) if settings.deadband_N or settings.deadband_Nm else None

    @classmethod
    def words(cls, settings: Stages) -> str:
        is_on = settings.deadband_N or settings.deadband_Nm
        return f"deadband {settings.deadband_N:g} N, {settings.deadband_Nm:g} N·m" if is_on else ""

    def __call__(self, wrench: Array, _: Passing) -> Array:
        vectors = wrench.reshape(-1, 2, 3)
        length = np.maximum(np.linalg.norm(vectors, axis=2, keepdims=True), 1e-300)
        left = np.maximum(1 - self._deadband / length, 0.0)
        return np.asarray((vectors * left).reshape(-1, 6))


STAGES: tuple[type[Stage], ...] = (_FreeToolAtRest, _InertialWrench, _Decoder, _Filter, FrameChange, _Deadband)
"""All stages in the order in which they are applied."""


def stages_of(settings: Stages, frame: WrenchFrame, info: StreamInfo) -> tuple[Stage, ...]:
    """Return the stages for these settings; raises `ConfigError` if a stage needs a setting that is missing."""
    return tuple(stage for kind in STAGES if (stage := kind.of(settings, frame, info)) is not None)


def standard_stages(info: StreamInfo) -> Stages:
    """Return bias and gravity, plus inertia if the calibration and the cell allow it; for a sensor alone, no stages."""
    if info.is_raw:
        return Stages(bias=False, gravity=False)
    return Stages(inertia=info.calibration.motion is not None and bool(np.isfinite(info.p_flange_sensor_m).all()))


def words_of(settings: Stages) -> list[str]:
    """Return the descriptions of the active stages in order."""
    return [words for kind in STAGES if (words := kind.words(settings))]


def stages_in_words(settings: Stages) -> str:
    """Return the active stages as one line."""
    return ", ".join(["raw", *words_of(settings)])


# --------------------------------------------------------------------------------------------------- bias and gravity


class Neighbours:
    """Buffer that pairs samples with the poses before and after them, which give the inertial wrench of the load.

    While the inertial wrench is subtracted, the newest samples wait for later poses.
    """

    def __init__(self, info: StreamInfo) -> None:
        motion = info.calibration.motion
        self._tensor = None if motion is None else motion.inertia_kg_m2
        self._g_m_s2, self._p_flange_sensor_m = info.calibration.g_m_s2, info.p_flange_sensor_m
        self._stride = max(1, round(_KNOT_S * info.sensor_rate_Hz))
        knot_s = self._stride / info.sensor_rate_Hz
        self._reach = max(2, round(max(_REACH_S, 2 / info.arm_rate_Hz) / knot_s))
        self.restart()

    def restart(self) -> None:
        """Discard the samples before an interruption."""
        self._buffer: Paired | None = None
        self._states, self._felt = np.zeros(0, np.int8), np.zeros((0, 6))
        # Number of rows of the buffer that `arrange` has already returned.
        self._done = 0

    @property
    def knows_tensor(self) -> bool:
        """Whether the inertia tensor of the tool was calibrated."""
        return self._tensor is not None

    def arrange(
        self, rows: Paired, states: NDArray[np.int8], felt: Array, load: Calibrated, *, on: bool, last: bool
    ) -> tuple[Paired, NDArray[np.int8], Array, Array | None]:
        """Add samples with their motion; return the samples to process now, and their inertial wrench (n, 6) if `on`.

        With `last`, no later poses follow, so no sample waits.
        """
        if self._buffer is None and not (on and len(rows)):
            return rows, states, felt, None
        buffer = rows if self._buffer is None else Paired.concatenate([self._buffer, rows])
        self._states, self._felt = np.concatenate([self._states, states]), np.concatenate([self._felt, felt])
        end, inertial = len(buffer), None
        neighbours = self._reach * self._stride
        if on and np.isfinite(buffer.p_base_flange_m[-1]).all():
            inertial, ready = self.wrench(buffer, load)
            end = end if last else max(ready, self._done)
            ahead = np.minimum(
                np.arange(self._done, end) + neighbours, len(self._states) - 1
            )  # last neighbour of each pose
            state = self._states[ahead]
            # at rest inertia is not subtracted, because that would amplify the noise of the joints
            inertial = np.where((state == REST)[:, None], 0.0, inertial[self._done : end])
        else:
            state = self._states[self._done : end]
        rows, felt = buffer.rows(slice(self._done, end)), self._felt[self._done : end]
        # cut at a knot, so that the knots stay where they are
        keep = max(0, end - neighbours - self._stride) // self._stride * self._stride
        self._buffer, self._done = buffer.rows(slice(keep, None)), end - keep
        self._states, self._felt = self._states[keep:], self._felt[keep:]
        if not on:
            self.restart()
        return rows, state, felt, inertial

    def wrench(self, rows: Paired, load: Calibrated) -> tuple[Array, int]:
        """Return the inertial wrench (n, 6) of all rows, and how many of the rows have neighbours on both sides."""
        knots = np.arange(0, len(rows), self._stride)
        t_s = (rows.t_host_ns - rows.t_host_ns[0]) * 1e-9
        # a coarse clock gives several samples the same time
        knots = knots[np.diff(t_s[knots], prepend=-1.0) > 0]
        if len(knots) < 2 * self._reach + 2:
            return np.zeros((len(rows), 6)), 0
        moved = MovedLoad(load.parameters, self._g_m_s2, self._p_flange_sensor_m, self._reach)
        motion = moved.motion(t_s[knots], rows.R_base_flange[knots], rows.p_base_flange_m[knots])
        at_knots = moved.wrench(motion, self._tensor)
        wrench = np.stack([np.interp(t_s, motion.t_s, column) for column in at_knots.T], axis=1)
        return wrench, int(knots[-1 - self._reach]) + 1


class _Reference(NamedTuple):
    empty: Calibrated
    t_ns: int
    # Temperature of the sensor at the time `t_ns`; NaN if unknown.
    temperature_C: float


class FreeTool:
    """Prediction for a tool at rest without contact: bias and weight, with tares, temperature and a held part."""

    def __init__(self, info: StreamInfo, temperature: BiasTemperature | None) -> None:
        self._calibration, self._rate_Hz = info.calibration, info.sensor_rate_Hz
        self._p_flange_sensor_m = info.p_flange_sensor_m
        known_C = self._calibration.provenance.get("temperature_C")
        # without the temperature at the calibration, the change since then is unknown
        self._temperature, made_C = (None, np.nan) if known_C is None else (temperature, float(known_C))
        self._now_C = self._noted_C = made_C
        self._hour_change = info.hour_change
        created = self._calibration.provenance.get("created_utc")
        # Time of the calibration on the cell's clock; None if unknown.
        self._made_ns = (
            round(datetime.fromisoformat(created).timestamp() * 1e9) - info.utc_offset_ns
            if isinstance(created, str)
            else None
        )
        self._references = [_Reference(self._calibration, 0, made_C)]
        self.held: Weight | None = None
        self.empty: Calibrated = self._calibration
        """The tool without a part, with the bias of the newest tare or calibration at the current temperature."""
        self.expected: Calibrated = self._calibration
        """The tool of `empty` plus the held part."""
        self.load: Calibrated = self._calibration
        """The calibrated tool plus the held part: weight and inertia do not depend on the bias."""
        self._compensator: Compensator = self._calibration.compensator
        self._bias_change = np.zeros(6)

    def predict(self, rows: Paired) -> tuple[Array, Array]:
        """Return the wrench (n, 6) of the weight of tool and part in the orientations of rows, and the bias (6,)."""
        gravity = rows.R_base_flange.reshape(-1, 9) @ self._compensator.matrix.T
        return gravity, np.asarray(self._compensator.offset + self._bias_change)

    @property
    def mass_kg(self) -> float:
        """Mass of the tool and the held part."""
        return float(np.linalg.norm(self.expected.parameters.gravity_force_base_N)) / self._calibration.g_m_s2

    def motion_tracker(self) -> MotionTracker:
        """Return a new motion tracker for the tool with its held part."""
        return MotionTracker(self._rate_Hz, self.mass_kg, self.expected.parameters, self._p_flange_sensor_m)

    def hold(self, weight: Weight | None) -> None:
        """Treat a part as part of the tool from now on; None empties the gripper."""
        self.held = weight
        self.load = self._with_part(self._calibration)
        self._compensator = Compensator(self.load.parameters, response=self.load.response)
        self.expected = self._with_part(self.empty)

    def _with_part(self, empty: Calibrated) -> Calibrated:
        return empty if self.held is None else holding(empty, self.held, self._calibration.g_m_s2)

    # The following methods change the bias, and return by how much (6,).

    def set_tare(self, update: Update, t_ns: int) -> Array:
        """Use the bias of a new tare from now on; return the change (6,) of the bias."""
        return self._refer([*self._references, _Reference(update, t_ns, self._now_C)])

    def undo_tare(self) -> Array:
        """Use the bias before the last tare again; return the change (6,) of the bias."""
        return self._refer(self._references[:-1])

    def follow(self, update: Update, t_ns: int) -> Array:
        """Use a tracked bias in place of all tares; return the change (6,) of the bias."""
        return self._refer([self._references[0], _Reference(update, t_ns, self._now_C)])

    def warm(self, temperature_C: float) -> Array:
        """Use the bias for this temperature of the sensor; return the change (6,) of the bias."""
        self._now_C = temperature_C
        return self._refer(self._references)

    def _refer(self, references: list[_Reference]) -> Array:
        self._references = references
        empty, _, then_C = references[-1]
        if self._temperature is not None:
            change, sigma = self._temperature.change(then_C, self._now_C)
            empty = with_bias_change(empty, change, sigma**2)
        before, self._bias_change = self._bias_change, empty.parameters.bias - self._calibration.parameters.bias
        self.empty, self.expected = empty, self._with_part(empty)
        return np.asarray(self._bias_change - before)

    def bias_growth(self, t_ns: int) -> Array:
        """Return the variance (6,) that the bias has gained since calibration or tare, judged by earlier runs."""
        looked_ns = self._made_ns if self.tare_t_ns is None else self.tare_t_ns
        if self._hour_change is None or looked_ns is None:
            return np.zeros(6)
        return self._hour_change**2 * (max(t_ns - looked_ns, 0) / _HOUR_NS)

    def is_warmed_by(self, temperature_C: float) -> bool:
        """Return whether this sensor temperature differs enough from the last for a correction of the bias."""
        return self._temperature is not None and not abs(temperature_C - self._now_C) < _STEP_K

    def warming(self) -> tuple[str, Mapping[str, JSON]] | None:
        """Return text and values of a temperature event if the change since the last event is large; else None."""
        if self._temperature is None or abs(self._now_C - self._noted_C) < _NOTED_K:
            return None
        self._noted_C = self._now_C
        change, _ = self._temperature.change(self._references[-1].temperature_C, self._now_C)
        text = f"sensor at {self._now_C:.1f} °C: bias corrected by {np.linalg.norm(change[:3]):.2f} N"
        return text, {"temperature_C": self._now_C, "change": change.tolist()}

    @property
    def tare_wrench(self) -> Array | None:
        """(6,) change of the bias by tares, N and N·m, sensor axes; None without a tare."""
        if self.tare_t_ns is None:
            return None
        return self._references[-1].empty.parameters.bias - self._calibration.parameters.bias

    @property
    def tare_t_ns(self) -> int | None:
        """Time of the last tare on the cell's clock, ns; None without a tare."""
        return self._references[-1].t_ns if len(self._references) > 1 else None


# --------------------------------------------------------------------------------------------------------------- tare


def try_tare(rows: Paired, current: Calibrated) -> tuple[Update | None, str, Mapping[str, JSON]]:
    """Estimate the bias from the last `TARE_S` seconds; return the update (None if refused), a text, and values.

    A tare is refused if the arm moves, if the reading changes, or if the reading differs from the prediction for a free
    tool by more than noise, calibration and typical drift explain (significance 0.001). The values are the `change` of
    the bias (6,), its norms `force_N` and `torque_Nm`, and the distance in `sigmas`.
    """
    again = "tare again when arm and tool have rested for half a second"
    if len(rows) < LEAST_SAMPLES or rows.t_host_ns[-1] - rows.t_host_ns[0] < 0.5e9 * TARE_S:
        return None, f"tare refused: only {len(rows)} samples; {again}", {}
    R = rows.R_base_flange[-1:]
    if not is_still(rows):
        return None, f"tare refused: the arm moves; {again}", {}
    dwell = mean_and_covariance(rows.raw)
    (change,), (sigmas,) = compare_with_prediction(
        current, R, dwell.mean[None], dwell.covariance[None], TARE_DRIFT_N, TARE_DRIFT_NM
    )
    force_N, torque_Nm = float(np.linalg.norm(change[:3])), float(np.linalg.norm(change[3:]))
    values: dict[str, JSON] = {
        "change": change.tolist(),
        "force_N": force_N,
        "torque_Nm": torque_Nm,
        "sigmas": float(sigmas),
    }
    found = f"{force_N:.2f} N and {torque_Nm:.3f} N·m ({sigmas:.1f} sigma)"
    if not is_stationary(rows.raw):
        return None, f"tare refused: the reading changes; {again}", values
    try:
        update = tare(current, R, [rows.raw], drift_N=TARE_DRIFT_N, drift_Nm=TARE_DRIFT_NM)
    except BadDataset:
        why = f"{found} away from the free tool, more than drift explains"
        return None, f"tare refused: {why}; take hand or contact away, or calibrate again", values
    return update, f"tare: the bias has changed by {found}", values


def is_still(rows: Paired) -> bool:
    """Return whether the arm rests; an unknown position counts as resting."""
    R, p = rows.R_base_flange[-1:], rows.p_base_flange_m[-1]
    return not (
        np.abs(rows.R_base_flange - R).max() > _STILL_RAD or (np.abs(rows.p_base_flange_m - p) > _STILL_M).any()
    )
