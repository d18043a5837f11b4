"""Processing of paired samples into blocks: the stages in order, and the estimates of noise, contact and drift.

`Processor` runs the stages, also for a sensor alone. `ToolMonitor` is used with a calibration: it follows the free
tool, its motion, contacts, drift and the held part.
"""

import math
from collections import deque
from collections.abc import Callable, Iterable, Mapping
from contextlib import AbstractContextManager
from threading import RLock

import numpy as np
from numpy.typing import NDArray

from ftcalib.after.series import BiasTemperature
from ftcalib.after.state import Update, with_bias_change
from ftcalib.after.weighing import Weight
from ftcalib.files import JSON
from ftcalib.sensor_matrix import Calibrated
from ftdrive.errors import ConfigError
from ftdrive.stream.contact import Contact, ContactTest, ContactTracker, Inertia
from ftdrive.stream.free_tool import NOTHING_KG, Following, weight_of
from ftdrive.stream.noise import READING_S, REST, NoiseEstimator, variance_at_next_use, wrench_by_acceleration
from ftdrive.stream.samples import (
    Block,
    EventKind,
    Links,
    Paired,
    Stages,
    StreamEvent,
    StreamInfo,
    StreamStatus,
    Tracked,
    Tracking,
    WrenchFrame,
    find_gaps,
)
from ftdrive.stream.stages import (
    TARE_S,
    FrameChange,
    FreeTool,
    Neighbours,
    Passing,
    Stage,
    stages_in_words,
    stages_of,
    standard_stages,
    try_tare,
)
from ftdrivers.interfaces import WRIST_SENSOR, Array

SENSOR_FRAME = WrenchFrame()
FALSE_ALARM_RATE = 1e-6
"""Fraction of the independent readings of a free tool that exceed the contact limit."""
# A block with more samples is processed in chunks of this many samples, which fit the processor's cache.
_CHUNK_ROWS = 8192
# A tracked bias is applied only while the sigma of each axis is below this, N and N·m.
_APPLIED = np.repeat([0.1, 0.003], 3)


class ToolMonitor:
    """Follows a calibrated tool in a stream: prediction for the free tool, motion, contact, drift and held part.

    `noise` is estimated from the residuals of the free tool, and contacts are reported in `frame`. `lock` is the lock
    of the processor, because a tare may come from another thread.
    """

    track: Tracking = "off"
    delay_sigma_s = 0.0

    def __init__(
        self,
        info: StreamInfo,
        temperature: BiasTemperature | None,
        noise: NoiseEstimator,
        frame: FrameChange,
        note: Callable[..., StreamEvent],
        lock: AbstractContextManager[object],
    ) -> None:
        self._calibration, self._noise, self._note, self._frame = info.calibration, noise, note, frame
        self._lock = lock
        self.tool = FreeTool(info, temperature)
        self.response = info.calibration.contact
        self._neighbours = Neighbours(info)
        self._motion = self.tool.motion_tracker()
        # the force/torque sensor inside the arm measures the friction of wrist 3
        friction_axis = info.calibration.R_flange_sensor[2] if info.sensor.model == WRIST_SENSOR else None
        self.test = ContactTest(
            info.sensor_rate_Hz, FALSE_ALARM_RATE, variance_at_next_use(info.calibration), friction_axis
        )
        self._tracker = ContactTracker(info.sensor_rate_Hz)
        self.following = Following(info, self.tool.bias_growth)
        self.contacts: list[Contact] = []
        """Contacts that began or ended, until `take_contacts` of the processor returns them."""
        self._is_learning = True
        self.state = REST
        self._newest_ns = 0
        self.reading = np.zeros(6)
        """(6,) mean wrench of the newest 20 ms minus that predicted for the free tool."""

    # -------------------------------------------------------------------------------------------------------- samples

    def arrange(self, rows: Paired, *, subtracts_inertia: bool, last: bool) -> Passing:
        """Add samples; return the samples to process now, with the prediction for the free tool."""
        if len(rows):
            self._newest_ns = int(rows.t_host_ns[-1])
        motion = self._motion.follow(rows.R_base_flange, rows.p_base_flange_m)
        due = self._neighbours.arrange(rows, *motion, self.tool.load, on=subtracts_inertia, last=last)
        return Passing(*due, *self.tool.predict(due[0]))

    def learn(self, recording: Iterable[Paired], *, subtracts_inertia: bool) -> None:
        """Estimate the noise from blocks of a recording before they are judged; `judge` then does not estimate it."""
        motion = self.tool.motion_tracker()
        for rows in recording:
            self._is_learning = False
            states, _ = motion.follow(rows.R_base_flange, rows.p_base_flange_m)
            gravity, bias = self.tool.predict(rows)
            residual = rows.raw - gravity - bias
            if subtracts_inertia:
                inertial, _ = self._neighbours.wrench(rows, self.tool.load)
                residual -= np.where((states == REST)[:, None], 0.0, inertial)
            self._noise.add(residual, states)

    def judge(self, residual: Array, passing: Passing) -> tuple[Array, NDArray[np.bool_]]:
        """Return per sample its squared distance from a free tool, and whether in contact, for residuals (n, 6)."""
        rows, states = passing.rows, passing.states
        # bias, weight and inertia are subtracted even if their stages are off, because chi2 is defined for a free tool
        if (inertial := passing.inertial) is not None:
            known, left = Inertia.EXACT, residual
        else:
            known = Inertia.COARSE if np.isfinite(rows.p_base_flange_m).all() else Inertia.UNKNOWN
            inertial = np.where((states == REST)[:, None], 0.0, passing.felt)
            left = residual - inertial
        if self._is_learning:
            self._noise.add(left, states)
        self.test.expect(self.tool.expected, self.tool.mass_kg, tensor_known=self._neighbours.knows_tensor)
        if self.track != "off":
            self.following.begin()
        readings, chi2, beyond = self.test.judge(
            left,
            passing.gravity + inertial,
            rows,
            (states, passing.felt),
            self._noise,
            self.following,
            delay_sigma_s=self.delay_sigma_s,
            inertia=known,
        )
        if len(rows):
            self.state, self.reading = int(states[-1]), readings[-1]
        self._follow_load()
        soon = (states == REST) & (known is Inertia.EXACT)
        readings = self._frame(self.response.decode(readings), passing)
        in_contact, contacts = self._tracker.follow(rows.t_host_ns, beyond, readings, soon)
        self._take(contacts)
        return chi2, in_contact

    def covariance(self, noise: Array, settings: Stages, t_ns: int, *, loaded: bool) -> Array:
        """Return the covariance (6, 6) of a compensated wrench, sensor axes: `noise`, prediction, bias and sensor."""
        covariance = noise
        if settings.gravity or settings.bias:
            covariance = covariance + self.test.uncertainty
        if settings.bias:
            covariance = covariance + np.diag(self.tool.bias_growth(t_ns))
        if loaded:
            covariance = covariance + self.response.covariance(self.response.decode(self.reading))
        return covariance

    def _follow_load(self) -> None:
        found, self.following.found = self.following.found, []
        for tracked, events in found:
            if (warning := self.following.filter.warning(float(self._calibration.likely_error()[0]))) is not None:
                self._note("drift", *warning)
            if self.track == "off":
                continue
            for event in events:
                # The contact test reports contacts, except those hidden from it by a tracked part that is not applied.
                if event.kind != "contact" or (self.tool.held is None and tracked.part_kg > NOTHING_KG):
                    self._note(event.kind, event.text, event.values, event.t_host_ns)
            if self.track != "apply":
                continue
            if any(event.kind == "load-step" for event in events):
                self.hold(None if tracked.part_kg < NOTHING_KG else weight_of(tracked, self._calibration))
            if (tracked.sigma < _APPLIED).all():
                update = with_bias_change(self._calibration, tracked.bias, tracked.sigma**2, measured=True)
                self.following.filter.subtract(self.tool.follow(update, self._newest_ns))

    @property
    def tracked(self) -> Tracked | None:
        """Tracked bias and part; None if tracking is off, and before the first window."""
        return None if self.track == "off" else self.following.tracked

    def reference(self) -> tuple[Calibrated, float]:
        """Return the empty tool with its bias, and the time since the last tare, s; infinite without a tare."""
        with self._lock:
            tare_ns = self.tool.tare_t_ns
            return self.tool.empty, math.inf if tare_ns is None else (self._newest_ns - tare_ns) * 1e-9

    # -------------------------------------------------------------------------------------------------------- changes

    def tare(self, update: Update, rows: Paired) -> None:
        """Use the bias of a tare from now on, measured from these samples of the free tool."""
        change = self.tool.set_tare(update, self._newest_ns)
        noise = np.cov(rows.raw.T) / len(rows)
        self.following.filter.tare(change, noise, self.test.uncertainty, rows.R_base_flange[-1])
        self.test.restart()

    def undo_tare(self) -> None:
        """Use the bias before the last tare again."""
        self.following.filter.undo_tare(self.tool.undo_tare())
        self.test.restart()

    def warm(self, temperature_C: float) -> None:
        """Correct the bias for a sensor temperature, if a model and the temperature at calibration are known."""
        if self.tool.is_warmed_by(temperature_C):
            self.following.filter.warm(self.tool.warm(temperature_C))
            if (warming := self.tool.warming()) is not None:
                self._note("temperature", *warming)

    def hold(self, weight: Weight | None) -> None:
        """Treat a weighed part as part of the tool from now on; None empties the gripper."""
        with self._lock:
            self.end_contact()
            self.tool.hold(weight)
            self.following.hold(weight)
            # The tracker computes the inertial wrench, which depends on the load.
            self._motion = self.tool.motion_tracker()
            self.test.restart()

    def restart(self) -> None:
        """Discard the samples before an interruption; the effects of tares and drift remain."""
        self.end_contact()
        self.test.restart()
        self._motion = self.tool.motion_tracker()
        self.following.windows.restart()
        self._neighbours.restart()

    def end_contact(self) -> None:
        """End a contact that is not over yet, and report it."""
        self._take(self._tracker.end())

    def turn_to(self, frame: FrameChange) -> None:
        """Report contacts in another frame from now on."""
        self.end_contact()
        self._frame = frame

    def _take(self, contacts: list[Contact]) -> None:
        self.contacts += contacts
        for contact in contacts:
            if contact.over:
                text = f"contact {contact.peak_N:.1f} N, {contact.duration_s:.1f} s"
                self._note("contact", text, contact.to_dict() | self._frame.frame.to_dict(), contact.begin_ns)


class Processor:
    """Compensates paired samples block by block; a whole recording may be one block.

    Without a calibration, for a sensor alone, only a tare is subtracted and no contact is detected. `settings` defaults
    to `standard_stages`. Raises `ConfigError` if frame or stages need a setting that is missing.
    """

    def __init__(
        self,
        info: StreamInfo,
        frame: WrenchFrame = SENSOR_FRAME,
        settings: Stages | None = None,
        *,
        temperature: BiasTemperature | None = None,
    ) -> None:
        # other threads may set the frame and the stages, and tare
        self._lock = RLock()
        self.info, self._frame, self._settings = info, frame, settings or standard_stages(info)
        self.stages: tuple[Stage, ...] = stages_of(self._settings, frame, info)
        """The stages applied to the raw wrench, in order."""
        self.events: list[StreamEvent] = []
        """Events of the stream, until `take_events` returns them."""
        moved = np.zeros((6, 3))
        if not info.is_raw:
            moved = wrench_by_acceleration(info.calibration.mass_kg, info.calibration.parameters.p_sensor_com_m)
        self._noise = NoiseEstimator(info.sensor_rate_Hz, moved)
        self._monitor: ToolMonitor | None = None
        if not info.is_raw:
            self._monitor = ToolMonitor(info, temperature, self._noise, self._turn, self.note, self._lock)
        # Tare of a sensor alone: subtracted wrench, and time.
        self._zero: tuple[Array, int] | None = None
        self._recent: deque[Paired] = deque()
        self._newest_ns = 0
        self._newest_seq: int | None = None

    @property
    def _turn(self) -> FrameChange:
        return next(stage for stage in self.stages if isinstance(stage, FrameChange))

    # -------------------------------------------------------------------------------------------------------- settings

    @property
    def frame(self) -> WrenchFrame:
        """Axes and reference point of the wrench; a change adds an event, or raises `ConfigError` if unsupported."""
        return self._frame

    @frame.setter
    def frame(self, frame: WrenchFrame) -> None:
        if frame == self._frame or self._monitor is None:
            return
        turn = FrameChange(frame, self.info)
        with self._lock:
            self._monitor.turn_to(turn)
            self._frame = frame
            self.stages = tuple(turn if isinstance(stage, FrameChange) else stage for stage in self.stages)
            self.note("frame", str(frame), frame.to_dict())

    @property
    def settings(self) -> Stages:
        """Settings of the stages; a change adds an event, or raises `ConfigError` if a setting is missing."""
        return self._settings

    @settings.setter
    def settings(self, settings: Stages) -> None:
        if settings == self._settings:
            return
        stages = stages_of(settings, self._frame, self.info)
        with self._lock:
            self.stages, self._settings = stages, settings
            self.note("stages", stages_in_words(settings), {})

    @property
    def monitor(self) -> ToolMonitor:
        """The monitor of the tool. Raises `ConfigError` for a sensor alone."""
        if self._monitor is None:
            raise ConfigError("a sensor alone has no tool: start with --calibration PATH or --tool NAME")
        return self._monitor

    # ------------------------------------------------------------------------------------------------------ processing

    def process(
        self, paired: Paired, *, last: bool = False, temperature_C: float | None = None, delay_sigma_s: float = 0.0
    ) -> Block:
        """Process the next samples, with the sensor temperature and the sigma of the delay after the pose.

        With the inertia stage the last milliseconds wait for later poses, unless these samples are the `last`. A block
        may therefore be empty.
        """
        with self._lock:
            if self._monitor is not None:
                self._monitor.delay_sigma_s = delay_sigma_s
                if temperature_C is not None:
                    self._monitor.warm(temperature_C)
            if len(paired) <= 2 * _CHUNK_ROWS:
                return self._process_chunk(paired, last)
            chunks = [paired.rows(slice(i, i + _CHUNK_ROWS)) for i in range(0, len(paired), _CHUNK_ROWS)]
            if self._noise.of(REST) is None:
                self.learn_noise([paired])
            return Block.concatenate([self._process_chunk(chunk, last and chunk is chunks[-1]) for chunk in chunks])

    def _process_chunk(self, paired: Paired, last: bool) -> Block:
        if len(paired):
            self.events += find_gaps(paired, self._newest_seq)
            self._newest_seq, self._newest_ns = int(paired.seq[-1]), int(paired.t_host_ns[-1])
            self._recent.append(paired)
            since_ns = self._newest_ns - round(TARE_S * 1e9)
            while self._recent[0].t_host_ns[-1] < since_ns:
                self._recent.popleft()
        if self._monitor is None:
            bias = np.zeros(6) if self._zero is None else self._zero[0]
            states, nothing = np.full(len(paired), REST, np.int8), np.zeros((len(paired), 6))
            self._noise.add(paired.raw, states)
            return self._block(Passing(paired, states, nothing, None, nothing, bias))
        passing = self._monitor.arrange(paired, subtracts_inertia=self._settings.inertia, last=last)
        block = self._block(passing)
        if last:
            self._monitor.end_contact()
        return block

    def _block(self, passing: Passing) -> Block:
        rows, wrench, n = passing.rows, passing.rows.raw, len(passing.rows)
        of_free_tool = sum(stage.is_of_free_tool for stage in self.stages)
        for stage in self.stages[:of_free_tool]:
            wrench = stage(wrench, passing)
        chi2, in_contact = np.full(n, np.nan), np.zeros(n, np.bool_)
        if self._monitor is not None:
            chi2, in_contact = self._monitor.judge(wrench, passing)
        for stage in self.stages[of_free_tool:]:
            wrench = stage(wrench, passing)
        return Block(
            **rows.columns(),
            wrench=wrench,
            chi2=chi2,
            in_contact=in_contact,
            sigma=self.sigma_of_mean(rows.R_base_flange[-1]) if n else np.full(6, np.nan),
            frame=self._frame,
            stages=self._settings,
        )

    def learn_noise(self, recording: Iterable[Paired]) -> None:
        """Estimate the noise from blocks of a recording before they are processed, and not during processing."""
        if self._monitor is not None:
            pieces = (one.rows(slice(i, i + _CHUNK_ROWS)) for one in recording for i in range(0, len(one), _CHUNK_ROWS))
            with self._lock:
                self._monitor.learn(pieces, subtracts_inertia=self._settings.inertia)

    def restart(self, *, elsewhere: bool = False) -> None:
        """Discard the samples before an interruption; noise, tares and drift remain.

        With `elsewhere` the next sample is at another position of a recording, which is not a gap.
        """
        with self._lock:
            if self._monitor is not None:
                self._monitor.restart()
            self._begin_filters()
            self._recent.clear()
            if elsewhere:
                self._newest_seq = None

    def _begin_filters(self) -> None:
        self.stages = stages_of(self._settings, self._frame, self.info)

    def sigma_of_mean(self, R_base_flange: Array, duration_s: float = 0.0, *, loaded: bool = True) -> Array:
        """Return the standard deviation (6,) of the newest sample in the frame, or of a mean over `duration_s`.

        NaN until the noise is known. `R_base_flange` (3, 3) is the orientation at the sample. The result grows with the
        age of the bias, if earlier runs of the sensor show how the bias changes. With `loaded` it contains the errors
        of the sensor under the current contact; otherwise it applies to a free tool.
        """
        monitor = self._monitor
        noise = self._noise.of(REST if monitor is None else monitor.state)
        if noise is None:
            return np.full(6, np.nan)
        if duration_s > 0:
            covariance = noise.reading * min(READING_S / duration_s, 1.0)
        else:
            covariance = noise.sample * math.prod(stage.power_gain for stage in self.stages)
        if monitor is not None:
            covariance = monitor.covariance(covariance, self._settings, self._newest_ns, loaded=loaded)
        T = self._turn.matrix(R_base_flange)
        return np.asarray(np.sqrt(np.einsum("ij,ij->i", T @ covariance, T)))

    @property
    def rest_sigma(self) -> Array | None:
        """(6,) standard deviation of one raw sample at rest, N and N·m, sensor axes; None until it is known."""
        noise = self._noise.of(REST)
        return None if noise is None else np.sqrt(np.diag(noise.sample))

    def status(self, links: Links) -> StreamStatus:
        """Return the status of the stream, whose source has the given `links`."""
        if (monitor := self._monitor) is None:
            tare, tare_t_ns = self._zero or (None, None)
            return StreamStatus(*links, tare, tare_t_ns, 0.0, 0.0, math.inf, FALSE_ALARM_RATE)
        tare, tare_t_ns = monitor.tool.tare_wrench, monitor.tool.tare_t_ns
        rate_N_h, limit = monitor.following.filter.force_rate_N_h, monitor.test.limit
        return StreamStatus(*links, tare, tare_t_ns, *rate_N_h, limit, FALSE_ALARM_RATE, monitor.tracked)

    # ---------------------------------------------------------------------------------------------------------- events

    def take_events(self) -> list[StreamEvent]:
        """Return the events since the last call."""
        events, self.events = self.events, []
        return events

    def take_contacts(self) -> list[Contact]:
        """Return the contacts that have begun or ended since the last call."""
        if self._monitor is None:
            return []
        with self._lock:
            contacts, self._monitor.contacts = self._monitor.contacts, []
        return contacts

    def take_event(self, event: StreamEvent) -> None:
        """Add an event that the source reports, such as a lost device."""
        self.events.append(event)

    def note(self, kind: EventKind, text: str, values: Mapping[str, JSON], t_ns: int | None = None) -> StreamEvent:
        """Add an event, by default at the time of the newest sample."""
        event = StreamEvent(self._newest_ns if t_ns is None else t_ns, kind, text, values)
        self.events.append(event)
        return event

    # ------------------------------------------------------------------------------------------------------ bias, load

    def tare(self) -> StreamEvent:
        """Change the bias so that the free tool reads zero over the last half second, or refuse; see `try_tare`.

        For a sensor alone the mean is subtracted, even if the sensor carries a load.
        """
        with self._lock:
            if (rows := self.recent()) is None:
                return self.note("tare-refused", "tare refused: no sample has arrived yet. Tare again", {})
            rows = rows.rows(rows.t_host_ns >= self._newest_ns - round(TARE_S * 1e9))
            if self._monitor is None:
                mean = rows.raw.mean(axis=0)
                self._zero = mean, self._newest_ns
                text = f"tare: {float(np.linalg.norm(mean[:3])):.2f} N are now subtracted"
                values: Mapping[str, JSON] = {"tare": mean.tolist()}
            else:
                update, text, values = try_tare(rows, self._monitor.tool.empty)
                if update is None:
                    return self.note("tare-refused", text, values)
                self._monitor.tare(update, rows)
            self._begin_filters()
            return self.note("tare", text, values)

    def undo_tare(self) -> StreamEvent:
        """Undo the last tare."""
        with self._lock:
            if self.tare_wrench is None:
                return self.note("tare-refused", "no tare to undo", {})
            self._zero = None
            if self._monitor is not None:
                self._monitor.undo_tare()
            self._begin_filters()
            left = self.tare_wrench
            return self.note("tare-undone", "tare undone", {"tare": None if left is None else left.tolist()})

    @property
    def tare_wrench(self) -> Array | None:
        """(6,) change of the bias by tares, N and N·m, sensor axes; None without a tare."""
        if self._monitor is None:
            return None if self._zero is None else self._zero[0]
        return self._monitor.tool.tare_wrench

    def recent(self) -> Paired | None:
        """Return the samples of the last half second; None before the first sample."""
        with self._lock:
            return Paired.concatenate(list(self._recent)) if self._recent else None
