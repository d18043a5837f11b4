"""From paired samples to a block: stages, frame, uncertainty, contact, drift."""

from collections import deque
from collections.abc import Iterable, Mapping
from threading import RLock

import numpy as np
from numpy.typing import NDArray

from ftcalib.after.series import BiasTemperature
from ftcalib.after.weighing import Weight
from ftcalib.files import JSON
from ftdrive.errors import ConfigError
from ftdrive.live.contact import Contact, ContactTest, ContactTracker, Inertia
from ftdrive.live.motion import READING_S, REST, wrench_by_acceleration
from ftdrive.live.noise import DriftFilter, NoiseEstimator, variance_at_next_use
from ftdrive.live.samples import (
    Block,
    EventKind,
    FrameTransform,
    Paired,
    Stages,
    StreamEvent,
    StreamInfo,
    Tracking,
    WrenchFrame,
    find_gaps,
)
from ftdrive.live.stages import TARE_S, Filter, FreeTool, InertiaStage, deadband, stages_in_words, standard_stages
from ftdrive.live.tracking import NOTHING_KG, Following, part_of, update_by
from ftdrivers.interfaces import WRIST_SENSOR, Array

SENSOR_FRAME = WrenchFrame()
FALSE_ALARM_RATE = 1e-6
# More rows are processed in pieces that stay in the cache.
_CHUNK_ROWS = 8192


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
        Of the sensor: a stream then corrects the bias.

    Raises
    ------
    ConfigError
        Frame or stages need something that is not configured.
    """

    track: Tracking = "off"
    """Whether bias and held part are followed, and applied. May be set at any time; see `StreamStatus.tracked`."""

    def __init__(
        self,
        info: StreamInfo,
        frame: WrenchFrame = SENSOR_FRAME,
        stages: Stages | None = None,
        *,
        false_alarm_rate: float = FALSE_ALARM_RATE,
        temperature: BiasTemperature | None = None,
    ) -> None:
        # frame, stages and tare may come from another thread
        self._lock = RLock()
        self._false_alarm_rate = false_alarm_rate
        self._frame, self._stages = frame, stages or standard_stages(info)
        self._events: list[StreamEvent] = []
        self._contacts: list[Contact] = []
        self._apply_calibration(info, temperature)

    def _apply_calibration(self, info: StreamInfo, temperature: BiasTemperature | None) -> None:
        """Begin with the calibration of `info`; frame, stages and the events that nothing has taken remain."""
        calibration = info.calibration
        with self._lock:
            self.info = info
            self._transform = FrameTransform(self._frame, info)
            self._filter = self._filter_of(self._stages)
            self._tool = FreeTool(info, temperature)
            self._contact = calibration.contact
            self._inertia = InertiaStage(info)
            self._motion = self._tool.motion_tracker()
            self._noise = NoiseEstimator(
                info.sensor_rate_Hz, wrench_by_acceleration(calibration.mass_kg, calibration.parameters.p_sensor_com_m)
            )
            self._noise_is_learnt = False
            # the arm's own sensor feels the friction of wrist 3
            friction_axis = calibration.R_flange_sensor[2] if info.sensor.model == WRIST_SENSOR else None
            self._test = ContactTest(
                info.sensor_rate_Hz, self._false_alarm_rate, variance_at_next_use(calibration), friction_axis
            )
            self._tracker = ContactTracker(info.sensor_rate_Hz)
            self._following = Following(info)
            self._drift = DriftFilter()
            self._recent: deque[Paired] = deque()
            self._state = REST
            self._reading = np.zeros(6)
            self._newest_ns = 0
            self._newest_seq: int | None = None
            self.delay_sigma_s = 0.0
            """One sigma of the delay of the wrench after the pose."""

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
            self._note_contacts(self._tracker.end())
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
                return self._compensate(paired, (np.zeros(0, np.int8), np.zeros((0, 6))), None)
            if len(paired) <= 2 * _CHUNK_ROWS:
                return self._process_chunk(paired, last)
            chunks = [paired.rows(slice(i, i + _CHUNK_ROWS)) for i in range(0, len(paired), _CHUNK_ROWS)]
            if self._noise.of(REST) is None:
                self.learn_noise([paired])
            return Block.concatenate([self._process_chunk(chunk, last and chunk is chunks[-1]) for chunk in chunks])

    def _process_chunk(self, paired: Paired, last: bool) -> Block:
        self._events += find_gaps(paired, self._newest_seq)
        self._newest_seq = int(paired.seq[-1])
        self._recent.append(paired)
        since_ns = int(paired.t_host_ns[-1]) - round(TARE_S * 1e9)
        while self._recent[0].t_host_ns[-1] < since_ns:
            self._recent.popleft()
        self._newest_ns = int(paired.t_host_ns[-1])
        self._inertia.add(paired, *self._motion.follow(paired.R_base_flange, paired.p_base_flange_m))
        return self._advance(last)

    def finish(self) -> Block:
        """Process the samples that wait for poses after them: there are none at the end of a recording."""
        with self._lock:
            if not len(self._inertia):
                raise ValueError("no samples were processed")
            return self._advance(last=True)

    def _advance(self, last: bool) -> Block:
        block = self._compensate(*self._inertia.take(self._tool.load, on=self._stages.inertia, last=last))
        if last:
            self._note_contacts(self._tracker.end())
        return block

    def learn_noise(self, recording: Iterable[Paired]) -> None:
        """Learn the noise from blocks of a recording, before it is processed and instead of during that."""
        with self._lock:
            self._noise_is_learnt = True
            motion = self._tool.motion_tracker()
            for block in recording:
                for i in range(0, len(block), _CHUNK_ROWS):
                    rows = block.rows(slice(i, i + _CHUNK_ROWS))
                    states, _ = motion.follow(rows.R_base_flange, rows.p_base_flange_m)
                    gravity, bias = self._tool.predict(rows)
                    residual = rows.raw - gravity - bias
                    if self._stages.inertia:
                        inertial, _ = self._inertia.wrench(rows, self._tool.load)
                        residual -= np.where((states == REST)[:, None], 0.0, inertial)
                    self._noise.add(residual, states)

    def _compensate(self, rows: Paired, motion: tuple[NDArray[np.int8], Array], inertial: Array | None) -> Block:
        stages, tool, (states, felt), n = self._stages, self._tool, motion, len(rows)
        # chi2 is that of a free tool, so bias, weight and inertia are subtracted whatever is switched off
        gravity, bias = tool.predict(rows)
        residual = rows.raw - gravity - bias
        if inertial is not None:
            residual -= inertial
            known, left = Inertia.EXACT, residual
        else:
            known = Inertia.COARSE if np.isfinite(rows.p_base_flange_m).all() else Inertia.UNKNOWN
            inertial = np.where((states == REST)[:, None], 0.0, felt)
            left = residual - inertial
        if not self._noise_is_learnt:
            self._noise.add(left, states)
        self._test.expect(tool.expected, tool.mass_kg, tensor_known=self._inertia.knows_tensor)
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
            self._state, self._reading = int(states[-1]), readings[-1]
        if self.track != "off":
            self._follow_load(rows, states)
        readings = self._transform(self._contact.decode(readings), rows.R_base_flange)
        soon = (states == REST) & (known is Inertia.EXACT)
        in_contact, contacts = self._tracker.follow(rows.t_host_ns, beyond, readings, soon)
        self._note_contacts(contacts)
        wrench = self._contact.decode(residual)
        if not stages.gravity:
            wrench = wrench + gravity
        if not stages.bias:
            wrench = wrench + bias
        wrench = self._transform(self._filter(wrench), rows.R_base_flange)
        wrench = deadband(wrench, stages.deadband_N, stages.deadband_Nm)
        self._follow_drift(rows, residual)
        return Block(
            **rows.columns(),
            wrench=wrench,
            chi2=chi2,
            in_contact=in_contact,
            sigma=self.sigma_of_mean(rows.R_base_flange[-1]) if n else np.full(6, np.nan),
            frame=self._frame,
            stages=stages,
        )

    def sigma_of_mean(self, R_base_flange: Array, duration_s: float = 0.0, *, loaded: bool = True) -> Array:
        """Standard deviation (6,) of the newest sample in the frame, or of the mean over `duration_s`.

        NaN until the noise is known. `R_base_flange` (3, 3) is that of the sample. It grows with the age of the bias,
        where earlier runs of the sensor show how that moves. With `loaded` it has the errors of the sensor under the
        present contact; without, it is that of a free tool.
        """
        noise = self._noise.of(self._state)
        if noise is None:
            return np.full(6, np.nan)
        if duration_s > 0:
            covariance = noise.reading * min(READING_S / duration_s, 1.0)
        else:
            covariance = noise.sample * self._filter.power_gain
        if self._stages.gravity or self._stages.bias:
            covariance = covariance + self._test.uncertainty
        if self._stages.bias:
            covariance = covariance + np.diag(self._tool.bias_growth(self._newest_ns))
        if loaded:
            covariance = covariance + self._contact.covariance(self._contact.decode(self._reading))
        T = self._transform.matrix(R_base_flange)
        return np.asarray(np.sqrt(np.einsum("ij,ij->i", T @ covariance, T)))

    def restart(self, *, elsewhere: bool = False) -> None:
        """Forget the samples before an interruption; noise, tares and drift remain.

        With `elsewhere` the next sample is at another place of a recording, and none were lost.
        """
        with self._lock:
            self._note_contacts(self._tracker.end())
            self._test.restart()
            self._motion = self._tool.motion_tracker()
            self._filter = self._filter_of(self._stages)
            self._following.restart()
            self._recent.clear()
            self._inertia.restart()
            if elsewhere:
                self._newest_seq = None

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

    def _note_contacts(self, contacts: list[Contact]) -> None:
        self._contacts += contacts
        for contact in contacts:
            if contact.over:
                values = contact.to_dict() | self._frame.to_dict()
                self.note(
                    "contact", f"contact {contact.peak_N:.1f} N, {contact.duration_s:.1f} s", values, contact.begin_ns
                )

    # ---------------------------------------------------------------------------------------------------- bias, noise

    def hold(self, weight: Weight | None) -> None:
        """Count a part that was weighed as part of the tool from now on; None empties the gripper."""
        with self._lock:
            self._note_contacts(self._tracker.end())
            self._tool.hold(weight)
            # The motion of another load is felt differently.
            self._motion = self._tool.motion_tracker()
            self._test.restart()

    def recent(self) -> Paired | None:
        """Return the samples of the last half second; None before the first."""
        with self._lock:
            return Paired.concatenate(list(self._recent)) if self._recent else None

    def _follow_load(self, rows: Paired, states: NDArray[np.int8]) -> None:
        for tracked, events in self._following.add(rows, states, self._noise):
            for event in events:
                # Without a part the contact test reports contacts; one that is not applied hides them from that test.
                if event.kind != "contact" or (self._tool.held is None and tracked.part_kg > NOTHING_KG):
                    self._events.append(event)
            if self.track != "apply":
                continue
            if any(event.kind == "load-step" for event in events):
                self.hold(part_of(tracked, self.info.calibration))
            if (update := update_by(self.info.calibration, tracked)) is not None:
                self._drift.shift(self._tool.follow(update, self._newest_ns))

    def _follow_drift(self, rows: Paired, residual: Array) -> None:
        noise = self._noise.of(REST)
        if noise is None or not self._drift.follow(
            rows.t_host_ns, residual, rows.R_base_flange, noise, np.diag(self._test.uncertainty)
        ):
            return
        if (warning := self._drift.warning(float(self.info.calibration.likely_error()[0]))) is not None:
            self.note("drift", *warning)
