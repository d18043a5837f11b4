"""From paired samples to a block: stages, frame, uncertainty, contact, tare, drift."""

from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Callable, Iterable, Mapping
from threading import RLock
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ftcalib.after.inertia import inertial_wrench, motion_of_poses
from ftcalib.after.series import BiasTemperature
from ftcalib.after.state import Calibrated, with_bias_change
from ftcalib.after.weighing import Weight, holding
from ftcalib.compensation import Compensator
from ftcalib.files import JSON
from ftcalib.rounding import with_sigma
from ftdrive.errors import ConfigError
from ftdrive.live.contact import Contact, ContactTest, ContactTracker, Inertia
from ftdrive.live.drift import DriftFilter
from ftdrive.live.filters import LOWPASS_ORDER, NOTCH_Q, Filter, deadband
from ftdrive.live.following import Following, applied, part_of
from ftdrive.live.frames import FrameTransform
from ftdrive.live.motion import READING_S, REST, MotionTracker, accelerated
from ftdrive.live.noise import NoiseEstimator
from ftdrive.live.samples import (
    Block,
    EventKind,
    LinkStatus,
    Paired,
    Stages,
    StreamEvent,
    StreamInfo,
    StreamStatus,
    Tracked,
    Tracking,
    WrenchFrame,
)
from ftdrive.live.tare import TARE_S, try_tare
from ftdrive.live.tracking import NOTHING_KG
from ftdrivers.clock import Clock
from ftdrivers.interfaces import WRIST_SENSOR, Array

SENSOR_FRAME = WrenchFrame()
FALSE_ALARM_RATE = 1e-6
_CHUNK_ROWS = 8192
"""More rows are processed in pieces that stay in the cache."""
_KNOT_S = 0.002
"""Poses of this spacing give the acceleration."""
_REACH_S = 0.015
"""Half the time over which poses give the acceleration: longer ones lose the edges of a move, and are later."""
_DRIFT_SIGMAS = 5.0
_STEP_K, _NOTED_K = 0.05, 1.0
"""Changes of the temperature that move the bias, and that are an event."""


class _Reference(NamedTuple):
    """The empty tool as calibrated, or since a tare."""

    empty: Calibrated
    t_ns: int
    temperature_C: float
    """Of the sensor then; NaN where it is not known."""


class Processor:
    """Compensates paired samples, one block after the other; a whole recording may be one block.

    Parameters
    ----------
    info : StreamInfo
    frame : WrenchFrame
    stages : Stages, optional
        Without it, `standard_stages`.
    false_alarm_rate : float
        Share of independent readings of a free tool beyond the limit. See `ftdrive.live.contact`.
    temperature : BiasTemperature, optional
        Of the sensor: `warm` then corrects the bias.

    Raises
    ------
    ConfigError
        Frame or stages need something that is not configured.
    """

    def __init__(
        self,
        info: StreamInfo,
        frame: WrenchFrame = SENSOR_FRAME,
        stages: Stages | None = None,
        *,
        false_alarm_rate: float = FALSE_ALARM_RATE,
        temperature: BiasTemperature | None = None,
    ) -> None:
        self.info = info
        self._lock = RLock()  # frame, stages and tare may come from another thread
        calibration = info.calibration
        self._compensator: Compensator = calibration.compensator
        self._inertia = None if calibration.motion is None else calibration.motion.inertia_kg_m2
        self.delay_sigma_s = 0.0
        """Of the wrench after the pose."""
        self._held: Weight | None = None
        self.reading = np.zeros(6)
        """Mean of the newest 20 ms minus the load, sensor axes, about its origin."""
        known_C = calibration.provenance.get("temperature_C")
        self._temperature, made_C = (None, np.nan) if known_C is None else (temperature, float(known_C))
        self._now_C = self._noted_C = made_C
        self._references = [_Reference(calibration, 0, made_C)]
        self._empty: Calibrated = calibration
        """The newest reference at the present temperature."""
        self._bias_change = np.zeros(6)
        """Of that, since the calibration."""
        self._expected: Calibrated = calibration
        """The same with a part that is held."""
        likely_error = calibration.likely_error()
        self._usual_error_N = float(likely_error[0])
        beyond = np.repeat((likely_error**2 - np.square(calibration.predicted_error())).clip(0.0) / 3, 3)
        self._motion = self._motion_tracker()
        self._noise = NoiseEstimator(
            info.sensor_rate_Hz, accelerated(calibration.mass_kg, calibration.parameters.p_sensor_com_m)
        )
        self._noise_is_learnt = False
        self.track: Tracking = "off"
        self._following = Following(info)
        in_wrist = info.sensor.model == WRIST_SENSOR
        self._test = ContactTest(
            info.sensor_rate_Hz, false_alarm_rate, beyond, calibration.R_flange_sensor[2] if in_wrist else None
        )
        self._tracker = ContactTracker(info.sensor_rate_Hz)
        self._drift = DriftFilter()
        self._drift_warned = False
        self._recent: deque[Paired] = deque()
        self._stride = max(1, round(_KNOT_S * info.sensor_rate_Hz))
        knot_s = self._stride / info.sensor_rate_Hz
        self._reach = max(2, round(max(_REACH_S, 2 / info.arm_rate_Hz) / knot_s))
        self._buffer: Paired | None = None
        self._states = np.zeros(0, np.int8), np.zeros((0, 6))
        """Of the rows of the buffer, as `MotionTracker.follow` returns them."""
        self._state = REST
        self._done = 0
        """Rows of the buffer that are processed; they remain as neighbours for the acceleration."""
        self._newest_ns = 0
        self._newest_seq: int | None = None
        self._events: list[StreamEvent] = []
        self._contacts: list[Contact] = []
        self._frame, self._transform = frame, FrameTransform(frame, info)
        self._stages = stages or _standard_stages(info)
        self._filter = self._filter_of(self._stages)

    # ------------------------------------------------------------------------------------------------ what is settable

    @property
    def frame(self) -> WrenchFrame:
        """Axes and reference point of the wrench; setting them is an event. Raises `ConfigError`."""
        return self._frame

    @frame.setter
    def frame(self, frame: WrenchFrame) -> None:
        if frame == self._frame:
            return
        transform = FrameTransform(frame, self.info)
        with self._lock:
            self._report_contacts(self._tracker.end())
            self._frame, self._transform = frame, transform
            self.note("frame", str(frame), frame.to_dict())

    @property
    def stages(self) -> Stages:
        """What is done to the raw wrench; setting it is an event. Raises `ConfigError`."""
        return self._stages

    @stages.setter
    def stages(self, stages: Stages) -> None:
        if stages == self._stages:
            return
        new = self._filter_of(stages)
        with self._lock:
            self._filter, self._stages = new, stages
            self.note("stages", stages_in_words(stages), {})

    def _filter_of(self, stages: Stages) -> Filter:
        if stages.inertia and not np.isfinite(self.info.p_flange_sensor_m).all():
            raise ConfigError(
                "the inertia stage needs the position of the sensor: set [sensor] height_mm, the height of its origin "
                "above the flange face"
            )
        return Filter(stages, self.info.sensor_rate_Hz)

    # ------------------------------------------------------------------------------------------------------ processing

    def process(self, paired: Paired, *, last: bool = False) -> Block:
        """Process the next samples.

        With the inertia stage the last milliseconds wait for the poses after them, unless these samples are the `last`;
        a block may then be empty.
        """
        with self._lock:
            if not len(paired):
                return self._processed(paired, (np.zeros(0, np.int8), np.zeros((0, 6))), None)
            if len(paired) <= 2 * _CHUNK_ROWS:
                return self._process(paired, last)
            chunks = [paired.rows(slice(i, i + _CHUNK_ROWS)) for i in range(0, len(paired), _CHUNK_ROWS)]
            if self._noise.of(REST) is None:
                self.learn_noise([paired])
            return Block.concatenate([self._process(chunk, last and chunk is chunks[-1]) for chunk in chunks])

    def _process(self, paired: Paired, last: bool) -> Block:
        self._note_gaps(paired)
        self._recent.append(paired)
        since_ns = int(paired.t_host_ns[-1]) - round(TARE_S * 1e9)
        while self._recent[0].t_host_ns[-1] < since_ns:
            self._recent.popleft()
        self._newest_ns = int(paired.t_host_ns[-1])
        buffer = paired if self._buffer is None else Paired.concatenate([self._buffer, paired])
        found = self._motion.follow(paired.R_base_flange, paired.p_base_flange_m)
        self._states = np.concatenate([self._states[0], found[0]]), np.concatenate([self._states[1], found[1]])
        return self._advance(buffer, last)

    def finish(self) -> Block:
        """Process the samples that wait for poses after them: there are none at the end of a recording."""
        with self._lock:
            if self._buffer is None or not len(self._buffer):
                raise ValueError("no samples were processed")
            return self._advance(self._buffer, last=True)

    def _advance(self, buffer: Paired, last: bool) -> Block:
        """Process the rows of the buffer that have neighbours on both sides; keep those that others need."""
        states, felt = self._states
        end, inertial = len(buffer), None
        neighbours = self._reach * self._stride
        positions = bool(np.isfinite(buffer.p_base_flange_m[-1]).all())
        if self._stages.inertia and positions:
            inertial, ready = self._inertial(buffer)
            end = end if last else max(ready, self._done)
            ahead = np.minimum(np.arange(self._done, end) + neighbours, len(states) - 1)  # the poses after them
            state = states[ahead]
            inertial = np.where((state == REST)[:, None], 0.0, inertial[self._done : end])
        else:
            state = states[self._done : end]
        rows = buffer.rows(slice(self._done, end))
        motion = state, felt[self._done : end]
        keep = max(0, end - neighbours - self._stride) // self._stride * self._stride  # knots stay where they are
        self._buffer, self._done = buffer.rows(slice(keep, None)), end - keep
        self._states = states[keep:], felt[keep:]
        block = self._processed(rows, motion, inertial)
        if last:
            self._report_contacts(self._tracker.end())
        return block

    def learn_noise(self, recording: Iterable[Paired]) -> None:
        """Learn the noise from blocks of a recording, before it is processed and instead of during that."""
        with self._lock:
            self._noise_is_learnt = True
            motion = self._motion_tracker()
            for block in recording:
                for i in range(0, len(block), _CHUNK_ROWS):
                    rows = block.rows(slice(i, i + _CHUNK_ROWS))
                    states, _ = motion.follow(rows.R_base_flange, rows.p_base_flange_m)
                    residual = self._free(rows)[0]
                    if self._stages.inertia:
                        residual -= np.where((states == REST)[:, None], 0.0, self._inertial(rows)[0])
                    self._noise.add(residual, states)

    def hold(self, weight: Weight | None) -> None:
        """Count a part that was weighed as part of the tool from now on; None empties the gripper."""
        with self._lock:
            self._report_contacts(self._tracker.end())
            self._held = weight
            load = self._loaded(self.info.calibration)
            self._compensator = Compensator(load.parameters, response=load.response)
            self._expected = self._loaded(self._empty)
            self._motion = self._motion_tracker()
            self._test.restart()

    def _loaded(self, empty: Calibrated) -> Calibrated:
        return empty if self._held is None else holding(empty, self._held, self.info.calibration.g_m_s2)

    def _motion_tracker(self) -> MotionTracker:
        load = self._expected.parameters
        return MotionTracker(self.info.sensor_rate_Hz, self._mass_kg, load, self.info.p_flange_sensor_m)

    @property
    def _mass_kg(self) -> float:
        """Of the load, with a part that is held."""
        return float(np.linalg.norm(self._expected.parameters.gravity_force_base_N)) / self.info.calibration.g_m_s2

    def _free(self, rows: Paired) -> tuple[Array, Array, Array]:
        """Return the residual of a free tool at rest, (n, 6), its weight (n, 6) and the bias (6,)."""
        gravity = rows.R_base_flange.reshape(-1, 9) @ self._compensator.matrix.T
        bias = self._compensator.offset + self._bias_change
        return rows.raw - gravity - bias, gravity, np.asarray(bias)

    def _inertial(self, buffer: Paired) -> tuple[Array, int]:
        """Return the inertial wrench of all rows, and the number of those with neighbours on both sides."""
        knots = np.arange(0, len(buffer), self._stride)
        t_s = (buffer.t_host_ns - buffer.t_host_ns[0]) * 1e-9
        knots = knots[np.diff(t_s[knots], prepend=-1.0) > 0]  # a coarse clock repeats times
        if len(knots) < 2 * self._reach + 2:
            return np.zeros((len(buffer), 6)), 0
        parameters = self._loaded(self.info.calibration).parameters
        motion = motion_of_poses(
            t_s[knots],
            buffer.R_base_flange[knots],
            np.nan_to_num(buffer.p_base_flange_m[knots]),  # an unknown position does not move
            R_flange_sensor=parameters.R_flange_sensor,
            p_flange_sensor_m=self.info.p_flange_sensor_m,
            reach=self._reach,
        )
        mass_kg = float(np.linalg.norm(parameters.gravity_force_base_N)) / self.info.calibration.g_m_s2
        at_knots = inertial_wrench(mass_kg, parameters.p_sensor_com_m, motion, self._inertia)
        wrench = np.stack([np.interp(t_s, motion.t_s, column) for column in at_knots.T], axis=1)
        return wrench, int(knots[-1 - self._reach]) + 1

    def _processed(self, rows: Paired, motion: tuple[NDArray[np.int8], Array], inertial: Array | None) -> Block:
        stages, n = self._stages, len(rows)
        residual, gravity, bias = self._free(rows)  # chi2 is that of a free tool, whatever is switched off
        states, felt = motion
        if inertial is not None:
            residual -= inertial
            known, left = Inertia.EXACT, residual
        else:
            known = Inertia.COARSE if np.isfinite(rows.p_base_flange_m).all() else Inertia.UNKNOWN
            inertial = np.where((states == REST)[:, None], 0.0, felt)
            left = residual - inertial
        if not self._noise_is_learnt:
            self._noise.add(left, states)
        current = self._expected
        self._test.expect(
            (current.parameters, current.covariance, current.response),
            self._mass_kg,
            tensor_known=self._inertia is not None,
        )
        readings, chi2, beyond = self._test.judge(
            left,
            gravity + inertial,
            rows.R_base_flange,
            motion,
            self._noise,
            delay_sigma_s=self.delay_sigma_s,
            inertia=known,
        )
        if n:
            self._state, self.reading = int(states[-1]), readings[-1]
        if self.track != "off":
            self._follow_load(rows, states)
        readings = self._transform(readings, rows.R_base_flange)
        soon = (states == REST) & (known is Inertia.EXACT)
        in_contact, contacts = self._tracker.follow(rows.t_host_ns, beyond, readings, soon)
        self._report_contacts(contacts)
        wrench = residual
        if not stages.gravity:
            wrench = wrench + gravity
        if not stages.bias:
            wrench = wrench + bias
        wrench = self._transform(self._filter(wrench), rows.R_base_flange)
        wrench = deadband(wrench, stages.deadband_N, stages.deadband_Nm)
        self._follow_drift(rows, residual)
        return Block(
            rows.t_host_ns,
            rows.t_device_s,
            rows.seq,
            rows.status,
            rows.raw,
            wrench,
            chi2,
            in_contact,
            rows.q_rad,
            rows.R_base_flange,
            rows.p_base_flange_m,
            self.sigma(rows.R_base_flange[-1]) if n else np.full(6, np.nan),
            self._frame,
            stages,
        )

    def sigma(self, R_base_flange: Array, mean_s: float = 0.0) -> Array:
        """Standard deviation (6,) of the newest sample in the frame, or of the mean over `mean_s`.

        NaN until it is known. `R_base_flange` (3, 3) is that of the sample.
        """
        noise = self._noise.of(self._state)
        if noise is None:
            return np.full(6, np.nan)
        if mean_s > 0:
            covariance = noise.reading * min(READING_S / mean_s, 1.0)
        else:
            covariance = noise.sample * self._filter.power_gain
        if self._stages.gravity or self._stages.bias:
            covariance = covariance + self._test.uncertainty
        T = self._transform.matrix(R_base_flange)
        return np.asarray(np.sqrt(np.einsum("ij,jk,ik->i", T, covariance, T)))

    def restart(self, *, elsewhere: bool = False) -> None:
        """Forget the samples before an interruption; noise, tares and drift remain.

        With `elsewhere` the next sample is at another place of a recording, and none were lost.
        """
        with self._lock:
            self._report_contacts(self._tracker.end())
            self._test.restart()
            self._motion = self._motion_tracker()
            self._filter = self._filter_of(self._stages)
            self._following.restart()
            self._recent.clear()
            self._buffer, self._done = None, 0
            self._states = np.zeros(0, np.int8), np.zeros((0, 6))
            if elsewhere:
                self._newest_seq = None

    @property
    def contact_limit(self) -> float:
        """Of `Block.chi2`."""
        return self._test.limit

    def status(self, sensor: LinkStatus, arm: LinkStatus, delay: tuple[float, float]) -> StreamStatus:
        """Return the state of a stream with these links and this delay and its sigma, s."""
        drift_N_h, drift_sigma_N_h = self._drift.force_rate_N_h
        tare_wrench = self.tare_wrench
        return StreamStatus(
            sensor=sensor,
            arm=arm,
            delay_s=delay[0],
            delay_sigma_s=delay[1],
            tare=tare_wrench,
            tare_t_host_ns=None if tare_wrench is None else self._references[-1].t_ns,
            drift_N_h=drift_N_h,
            drift_sigma_N_h=drift_sigma_N_h,
            contact_limit=self._test.limit,
            false_alarm_rate=self._test.false_alarm_rate,
            tracked=self.tracked,
        )

    @property
    def tracked(self) -> Tracked | None:
        """Bias and part as followed; None unless they are, and before the first window."""
        return None if self.track == "off" else self._following.tracked

    # ---------------------------------------------------------------------------------------------------------- events

    def take_events(self) -> list[StreamEvent]:
        """Return the events since the last call."""
        events, self._events = self._events, []
        return events

    def note(self, kind: EventKind, text: str, values: Mapping[str, JSON], t_ns: int | None = None) -> StreamEvent:
        """Add an event, by default at the time of the newest sample."""
        event = StreamEvent(self._newest_ns if t_ns is None else t_ns, kind, text, values)
        self._events.append(event)
        return event

    def _note_gaps(self, paired: Paired) -> None:
        before = int(paired.seq[0]) - 1 if self._newest_seq is None else self._newest_seq
        self._newest_seq = int(paired.seq[-1])
        if self._newest_seq - before == len(paired):
            return
        missing = np.diff(paired.seq, prepend=before) - 1
        for i in np.flatnonzero(missing > 0):
            lost = int(missing[i])
            text = f"{lost} sample{'s' if lost > 1 else ''} lost before sample {int(paired.seq[i])}"
            self.note("gap", text, {"lost": lost, "seq": int(paired.seq[i])}, int(paired.t_host_ns[i]))

    def take_contacts(self) -> list[Contact]:
        """Return the contacts that have begun or ended since the last call."""
        with self._lock:
            contacts, self._contacts = self._contacts, []
        return contacts

    def _report_contacts(self, contacts: list[Contact]) -> None:
        self._contacts += contacts
        for contact in contacts:
            if not contact.over:
                continue
            values: dict[str, JSON] = {
                "duration_s": contact.duration_s,
                "peak_N": contact.peak_N,
                "peak_wrench": contact.peak.tolist(),
                "direction": contact.direction.tolist(),
                "line_point_m": contact.line_m.tolist(),
                "line_distance_m": float(np.linalg.norm(contact.line_m)),
                **self._frame.to_dict(),
            }
            words = f"contact {contact.peak_N:.1f} N, {contact.duration_s:.1f} s"
            self.note("contact", words, values, contact.begin_ns)

    # ---------------------------------------------------------------------------------------------------- bias, noise

    @property
    def tare_wrench(self) -> Array | None:
        """(6,) change of the bias by tares, N and N·m, sensor axes; None without a tare."""
        if len(self._references) == 1:
            return None
        return self._references[-1].empty.parameters.bias - self.info.calibration.parameters.bias

    def tare(self) -> StreamEvent:
        """Set the bias so that the free tool reads zero in the last half second, or refuse; see `try_tare`."""
        with self._lock:
            if not self._recent:
                return self.note("tare-refused", "tare refused: no sample has arrived yet; tare again", {})
            rows = Paired.concatenate(list(self._recent))
            rows = rows.rows(rows.t_host_ns >= self._newest_ns - round(TARE_S * 1e9))
            update, text, values = try_tare(rows, self._empty)
            if update is None:
                return self.note("tare-refused", text, values)
            self._set_tare([*self._references, _Reference(update, self._newest_ns, self._now_C)])
            return self.note("tare", text, values)

    def recent(self) -> Paired | None:
        """Return the samples of the last half second; None before the first."""
        with self._lock:
            return Paired.concatenate(list(self._recent)) if self._recent else None

    def reference(self) -> tuple[Calibrated, float]:
        """Return the empty tool, and how many seconds ago it was tared; infinite without a tare."""
        with self._lock:
            tared = len(self._references) > 1
            return self._empty, (self._newest_ns - self._references[-1].t_ns) * 1e-9 if tared else float("inf")

    @property
    def rest_sigma(self) -> Array | None:
        """(6,) standard deviation of one sample at rest; None until it is known."""
        noise = self._noise.of(REST)
        return None if noise is None else np.sqrt(np.diag(noise.sample))

    def undo_tare(self) -> StreamEvent:
        """Take the last tare back."""
        with self._lock:
            if len(self._references) == 1:
                return self.note("tare-refused", "there is no tare to undo", {})
            self._set_tare(self._references[:-1])
            left = self.tare_wrench
            return self.note("tare-undone", "tare undone", {"tare": None if left is None else left.tolist()})

    def warm(self, temperature_C: float) -> None:
        """Correct the bias for this temperature of the sensor, if it is known how, and at which it was calibrated."""
        if self._temperature is None or abs(temperature_C - self._now_C) < _STEP_K:
            return
        with self._lock:
            self._now_C = temperature_C
            self._refer()
            if abs(temperature_C - self._noted_C) < _NOTED_K:
                return
            self._noted_C = temperature_C
            change, _ = self._temperature.change(self._references[-1].temperature_C, temperature_C)
            text = f"sensor at {temperature_C:.1f} °C: bias corrected by {np.linalg.norm(change[:3]):.2f} N"
            self.note("temperature", text, {"temperature_C": temperature_C, "change": change.tolist()})

    def _refer(self) -> None:
        """Take the newest reference, at the present temperature, as the empty tool."""
        empty, _, then_C = self._references[-1]
        if self._temperature is not None:
            empty = with_bias_change(empty, *self._temperature.change(then_C, self._now_C))
        before, self._bias_change = self._bias_change, empty.parameters.bias - self.info.calibration.parameters.bias
        self._empty, self._expected = empty, self._loaded(empty)
        self._drift.shift(self._bias_change - before)

    def _set_tare(self, references: list[_Reference]) -> None:
        self._references = references
        self._refer()
        self._test.restart()
        self._filter = self._filter_of(self._stages)

    def _follow_load(self, rows: Paired, states: NDArray[np.int8]) -> None:
        """Follow bias and part; apply them if that is wanted."""
        for tracked, events in self._following.add(rows, states, self._noise):
            for event in events:
                # Without a part the contact test reports contacts; one that is not applied hides them from that test.
                if event.kind != "contact" or (self._held is None and tracked.part_kg > NOTHING_KG):
                    self._events.append(event)
            if self.track != "apply":
                continue
            if any(event.kind == "load-step" for event in events):
                self.hold(part_of(tracked))
            if (update := applied(self.info.calibration, tracked)) is not None:
                self._references = [self._references[0], _Reference(update, self._newest_ns, self._now_C)]
                self._refer()

    def _follow_drift(self, rows: Paired, residual: Array) -> None:
        noise = self._noise.of(REST)
        if noise is None or not self._drift.follow(
            rows.t_host_ns, residual, rows.R_base_flange, noise, np.diag(self._test.uncertainty)
        ):
            return
        rate, sigma = self._drift.force_rate_N_h
        worth = max(self._usual_error_N, _DRIFT_SIGMAS * sigma)
        if rate > worth and not self._drift_warned:
            text = f"the bias drifts by {with_sigma(rate, sigma)} N/h (1 sigma); tare when the tool is free"
            self.note("drift", text, {"drift_N_h": rate, "sigma_N_h": sigma})
        self._drift_warned = rate > (0.5 if self._drift_warned else 1.0) * worth


class ProcessedStream(ABC):
    """What a live and a replayed stream share: everything that the processing shows and lets set."""

    info: StreamInfo
    clock: Clock
    on_contact: Callable[[Contact], object] | None = None
    """Called by the thread that reads, once when a contact has lasted 40 to 60 ms and once when it is over."""
    _processor: Processor
    _track: Tracking = "off"

    def _process(self, paired: Paired, *, last: bool = False) -> Block:
        block = self._processor.process(paired, last=last)
        self._report_contacts()
        return block

    def _report_contacts(self) -> None:
        for contact in self._processor.take_contacts():
            if self.on_contact is not None:
                self.on_contact(contact)

    @property
    def frame(self) -> WrenchFrame:
        """Axes and reference point of the wrench. Setting raises `ConfigError` if it needs what is not configured."""
        return self._processor.frame

    @frame.setter
    def frame(self, frame: WrenchFrame) -> None:
        self._processor.frame = frame

    @property
    def track(self) -> Tracking:
        """Whether bias and held part are followed, and applied. May be set at any time; see `StreamStatus.tracked`."""
        return self._track

    @track.setter
    def track(self, track: Tracking) -> None:
        self._track = track
        if (processor := getattr(self, "_processor", None)) is not None:  # else it is set when the stream is opened
            processor.track = track

    @property
    def tracked(self) -> Tracked | None:
        """Bias and held part as followed; None unless `track` is set, and before the first look."""
        return self._processor.tracked

    @property
    def stages(self) -> Stages:
        """What is done to the raw wrench. Setting raises `ConfigError` for an impossible filter."""
        return self._processor.stages

    @stages.setter
    def stages(self, stages: Stages) -> None:
        self._processor.stages = stages

    def take_events(self) -> list[StreamEvent]:
        """Return the events since the last call."""
        return self._processor.take_events()

    def tare(self) -> StreamEvent:
        """Change the bias so that the free tool reads zero; the event says how much, or why it was refused."""
        return self._processor.tare()

    def undo_tare(self) -> StreamEvent:
        """Take the last tare back."""
        return self._processor.undo_tare()

    def recent(self) -> Paired | None:
        """Return the samples of the last half second; None before the first."""
        return self._processor.recent()

    def reference(self) -> tuple[Calibrated, float]:
        """Return the empty tool, and how many seconds ago it was tared; infinite without a tare."""
        return self._processor.reference()

    @property
    def rest_sigma(self) -> Array | None:
        """(6,) standard deviation of one sample at rest; None until it is known."""
        return self._processor.rest_sigma

    def hold(self, weight: Weight | None) -> None:
        """Count a part that was weighed as part of the tool from now on; None empties the gripper."""
        self._processor.hold(weight)

    def contact_reading(self) -> Array:
        """Return the mean (6,) of the newest 20 ms minus the load, sensor axes, about its origin."""
        return self._processor.reading

    def note(self, kind: EventKind, text: str, values: Mapping[str, JSON]) -> StreamEvent:
        """Add an event at the time of the newest sample."""
        return self._processor.note(kind, text, values)

    def mark(self, text: str) -> StreamEvent:
        """Add a mark to the events."""
        return self._processor.note("mark", text, {})

    @abstractmethod
    def status(self) -> StreamStatus:
        """Return rates, losses, ages, delay, tare and drift."""

    def sigma_of_mean(self, R_base_flange: Array, duration_s: float) -> Array:
        """Standard deviation (6,) of the mean of the wrench over `duration_s`, `READING_S` or longer, in the frame.

        NaN until the noise is known. `R_base_flange` is (3, 3).
        """
        return self._processor.sigma(R_base_flange, duration_s)


def _standard_stages(info: StreamInfo) -> Stages:
    """Return bias and gravity, with inertia where calibration and cell have what it needs."""
    return Stages(inertia=info.calibration.motion is not None and bool(np.isfinite(info.p_flange_sensor_m).all()))


def stages_in_words(stages: Stages) -> str:
    """Return the stages that are on, in their order."""
    words = ["raw"] + [name for name in ("bias", "gravity", "inertia") if getattr(stages, name)]
    if stages.notch_Hz is not None:
        words.append(f"notch {stages.notch_Hz:g} Hz (Q {NOTCH_Q:g})")
    if stages.lowpass_Hz is not None:
        words.append(f"low-pass {stages.lowpass_Hz:g} Hz (Butterworth, order {LOWPASS_ORDER})")
    if stages.deadband_N or stages.deadband_Nm:
        words.append(f"deadband {stages.deadband_N:g} N, {stages.deadband_Nm:g} N·m")
    return ", ".join(words)
