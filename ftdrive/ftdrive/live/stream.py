"""The compensated stream: arm, sensor and calibration in, samples out. It knows no screen and no file.

`BlockReader` is the loop that reads a stream over interruptions.
"""

import math
import time
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, NoReturn, Self

import numpy as np
from scipy.spatial.transform import Rotation

from ftcalib import CalibrationResult
from ftcalib.after.series import BiasTemperature
from ftcalib.after.state import Calibrated
from ftcalib.display import Displayed, Row, Summary
from ftcalib.notebook import figure_of
from ftdrive.cell.config import CellConfig
from ftdrive.cell.devices import build_arm, build_sensor
from ftdrive.cell.emulated import Station
from ftdrive.checks.check import compare_devices
from ftdrive.errors import ConfigError
from ftdrive.live.contact import Contact
from ftdrive.live.motion import REST
from ftdrive.live.pairing import DelayEstimator, Pairing
from ftdrive.live.processing import SENSOR_FRAME, Processor
from ftdrive.live.samples import (
    Block,
    LinkStatus,
    Paired,
    Sample,
    Stages,
    StreamEvent,
    StreamInfo,
    StreamStatus,
    Tracked,
    WrenchFrame,
    mean_rate_Hz,
    sensor_origin_m,
)
from ftdrive.live.stages import TARE_S, stages_in_words, try_tare
from ftdrive.runs.run import versions
from ftdrive.runs.verification import VerificationRecord, calibration_in_words, marks_of, verification_near
from ftdrivers.clock import Clock
from ftdrivers.errors import DeviceError, DeviceTimeout
from ftdrivers.follow import Follow
from ftdrivers.interfaces import ArmStates, ArmStatus, Array, DeviceInfo, ForceTorqueSensor, FtSamples, RobotArm

STALE_S = 0.3
"""Without a new sample of either device for so long, `CompensatedStream.read` raises."""

RECOVER_S = 10.0
"""So long a stream with an interruption may take to deliver again; then its reader ends."""

# Between two attempts to reconnect.
_RETRY_S = 0.2
# At the beginning both rates are measured.
_RATE_S = 0.5
_RATE_WINDOW_NS = 1_000_000_000


class ProcessedStream(Displayed, Processor, ABC):
    """A processor that reads its own samples: of a cell, or of a recording that replaces it."""

    clock: Clock
    on_contact: Callable[[Contact], object] | None = None
    """Called by the thread that reads, once when a contact has lasted 40 to 60 ms and once when it is over."""

    @abstractmethod
    def read(self) -> Block:
        """Return the next samples; none while a recording pauses."""

    @abstractmethod
    def status(self) -> StreamStatus:
        """Return rates, losses, ages, delay, tare and drift."""

    def _process_read(self, paired: Paired, *, last: bool = False) -> Block:
        block = self.process(paired, last=last)
        self._call_on_contact()
        return block

    def _summary(self) -> Summary:
        name = type(self).__name__
        if not hasattr(self, "info"):
            return Summary(f"{name}, not open: use it in a with block, or call open")
        info = self.info
        sigma = self.rest_sigma
        noise = "unknown yet" if sigma is None else f"{sigma[:3].max():.2g} N, {sigma[3:].max():.2g} N·m"
        now = Row("force now", ["no sample was read yet"])
        if self._newest_ns:
            force_N = self.contact_reading()[:3]
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

    def take_contacts(self) -> list[Contact]:
        """Return the contacts that have begun or ended since the last call."""
        with self._lock:
            contacts, self._contacts = self._contacts, []
        return contacts

    def _call_on_contact(self) -> None:
        # Outside of the lock of the processor: the function may call the stream.
        for contact in self.take_contacts():
            if self.on_contact is not None:
                self.on_contact(contact)

    def _status_of(self, sensor: LinkStatus, arm: LinkStatus, delay: tuple[float, float]) -> StreamStatus:
        """Return the state of a stream with these links and this delay and its sigma, s."""
        drift_N_h, drift_sigma_N_h = self._drift.force_rate_N_h
        return StreamStatus(
            sensor=sensor,
            arm=arm,
            delay_s=delay[0],
            delay_sigma_s=delay[1],
            tare=self._tool.tare_wrench,
            tare_t_host_ns=self._tool.tare_t_ns,
            drift_N_h=drift_N_h,
            drift_sigma_N_h=drift_sigma_N_h,
            contact_limit=self._test.limit,
            false_alarm_rate=self._test.false_alarm_rate,
            tracked=self.tracked,
        )

    def tare(self) -> StreamEvent:
        """Change the bias so that the free tool reads zero in the last half second, or refuse; see `try_tare`."""
        with self._lock:
            if (rows := self.recent()) is None:
                return self.note("tare-refused", "tare refused: no sample has arrived yet; tare again", {})
            rows = rows.rows(rows.t_host_ns >= self._newest_ns - round(TARE_S * 1e9))
            update, text, values = try_tare(rows, self._tool.empty)
            if update is None:
                return self.note("tare-refused", text, values)
            self._begin_bias(self._tool.set_tare(update, self._newest_ns))
            self._following.trust()
            return self.note("tare", text, values)

    def undo_tare(self) -> StreamEvent:
        """Take the last tare back."""
        with self._lock:
            if self.tare_wrench is None:
                return self.note("tare-refused", "there is no tare to undo", {})
            self._begin_bias(self._tool.undo_tare())
            left = self.tare_wrench
            return self.note("tare-undone", "tare undone", {"tare": None if left is None else left.tolist()})

    @property
    def tare_wrench(self) -> Array | None:
        """(6,) change of the bias by tares, N and N·m, sensor axes; None without a tare."""
        return self._tool.tare_wrench

    def _begin_bias(self, change: Array) -> None:
        self._drift.shift(change)
        self._test.restart()
        self._filter = self._filter_of(self._stages)

    def warm(self, temperature_C: float) -> None:
        """Correct the bias for this temperature of the sensor, if it is known how, and at which it was calibrated."""
        if not self._tool.is_warmed_by(temperature_C):
            return
        with self._lock:
            self._drift.shift(self._tool.warm(temperature_C))
            if (warming := self._tool.warming()) is not None:
                self.note("temperature", *warming)

    def mark(self, text: str) -> StreamEvent:
        """Add a mark to the events."""
        return self.note("mark", text, {})

    def reference(self) -> tuple[Calibrated, float]:
        """Return the empty tool, and how many seconds ago it was tared; infinite without a tare."""
        with self._lock:
            tare_ns = self._tool.tare_t_ns
            return self._tool.empty, float("inf") if tare_ns is None else (self._newest_ns - tare_ns) * 1e-9

    @property
    def rest_sigma(self) -> Array | None:
        """(6,) standard deviation of one sample at rest; None until it is known."""
        noise = self._noise.of(REST)
        return None if noise is None else np.sqrt(np.diag(noise.sample))

    def contact_reading(self) -> Array:
        """Return the mean (6,) of the newest 20 ms minus the load, sensor axes, about its origin."""
        return self._reading

    @property
    def contact_limit(self) -> float:
        """Limit of `Block.chi2`."""
        return self._test.limit

    @property
    def tracked(self) -> Tracked | None:
        """Bias and part as followed; None unless they are, and before the first window."""
        return None if self.track == "off" else self._following.tracked


class CompensatedStream(ProcessedStream):
    """Paired and compensated samples of a cell, as long as `with` lasts. The arm is only read.

    Samples come from `read` or by iteration, without gaps: a lost sample is a gap in `Block.seq` and an event. After
    `read` has raised an error of a device, the next `read` reconnects and goes on.

    Parameters
    ----------
    cell : CellConfig or Station
        An emulated cell is started on entry and ended with the stream.
    calibration : CalibrationResult or str
        Of these devices, or the name of a tool: its newest accepted calibration is looked up on entry.
    name : str
        Of the calibration, such as its path.
    force : bool
        Warn instead of raising an error if the calibration is of another arm, sensor or mount; of a tool, take one
        that was edited by hand too.
    frame : WrenchFrame
        Axes and reference point; may be set at any time.
    stages : Stages
        May be set at any time.
    devices : ForceTorqueSensor and RobotArm, optional
        Used in place of those that the cell names.

    Raises
    ------
    ConfigError
        On entry: the calibration is of another arm, sensor or mount, the tool has none, or the frame needs what is
        not configured.
    ConnectError
        On entry: a device does not answer.
    """

    def __init__(
        self,
        cell: CellConfig | Station,
        calibration: CalibrationResult | str,
        *,
        name: str = "",
        force: bool = False,
        frame: WrenchFrame = SENSOR_FRAME,
        stages: Stages | None = None,
        devices: tuple[ForceTorqueSensor | None, RobotArm | None] = (None, None),
    ) -> None:
        self._given = cell
        self._devices = devices
        self._wanted = calibration
        self._name = name
        self._force = force
        self._begin = frame, stages
        self._foreign = False
        self._hour_change: Array | None = None
        self.block_s = 0.003
        """A block has the samples of so long, because it costs about the same with one sample as with many. May be set
        at any time: longer blocks arrive later and take less of the processor."""
        self._stack = ExitStack()
        self._follows = ExitStack()
        # The device that has failed, "sensor" or "arm", and why.
        self._failure: tuple[str, DeviceError] | None = None
        self._silent_since_ns: int | None = None
        self._arrivals: deque[tuple[int, int]] = deque()
        self._arm_lost = 0
        self._arm_newest: tuple[int, float] | None = None
        self._next_ns = 0

    def open(self) -> Self:
        """Open the devices and return the stream; `close` or the end of a `with` block closes them.

        For a notebook, where one `with` block cannot span several cells.
        """
        with ExitStack() as stack:
            self.cell = self._given if isinstance(self._given, CellConfig) else stack.enter_context(self._given).cell
            self.clock: Clock = self.cell.clock
            sensor_device, arm_device = self._devices
            self._sensor = stack.enter_context(sensor_device or build_sensor(self.cell))
            self._arm = stack.enter_context(closing(arm_device or build_arm(self.cell)))
            self._arm.open()
            arm, sensor = self._arm.identify(), self._sensor.identify()
            self._calibration, self._name, self.warnings, self._temperature = self._chosen(arm, sensor)
            """What is doubtful about the calibration, and what could not be checked."""
            stack.callback(self._unfollow)
            self._follow()
            samples, states = self._first_samples()
            nominal_Hz = self._sensor.health().nominal_rate_Hz
            sensor_rate_Hz = nominal_Hz if np.isfinite(nominal_Hz) else mean_rate_Hz(samples.t_host_ns)
            arm_rate_Hz = mean_rate_Hz(states.t_host_ns)
            self._arm_step_s = float(np.median(np.diff(states.t_device_s)))
            status = self._arm.status()
            self.payload_kg = status.payload_kg
            """As configured in the controller; None where it is not reported."""
            self.info = self._described(arm, sensor, sensor_rate_Hz, arm_rate_Hz, status)
            # only now are the rates known that the processing needs
            super().__init__(self.info, *self._begin, temperature=self._temperature)
            delay_ms, p_flange_sensor_m = self.cell.sensor.delay_ms, self.info.p_flange_sensor_m
            delay = DelayEstimator(self._calibration, p_flange_sensor_m) if delay_ms is None else delay_ms / 1e3
            self._pairing = Pairing(nominal_Hz, delay)
            self._pairing.add_states(states)
            self._pairing.add_samples(samples)
            self._stack = stack.pop_all()
        return self

    def close(self) -> None:
        """Close the devices, and end an emulated cell; safe twice."""
        self._stack.close()

    def __enter__(self) -> Self:
        return self.open()

    def __exit__(self, *_: object) -> None:
        self.close()

    @property
    def station(self) -> Station:
        """The emulated cell, such as `station.control(do="push", wrench=[0, 0, -5, 0, 0, 0], seconds=1)`.

        docs/contributing/emulated-cell.md lists the requests. Raises `ConfigError` for a real cell.
        """
        if not isinstance(self._given, Station):
            raise ConfigError("this is a real cell: only a stream with simulate=True has a station")
        return self._given

    def _chosen(
        self, arm: DeviceInfo, sensor: DeviceInfo
    ) -> tuple[CalibrationResult, str, tuple[str, ...], BiasTemperature | None]:
        """Return the calibration of the devices and their mounting, its name, warnings, and what temperature does."""
        calibration, name, warnings = self._wanted, self._name, tuple[str, ...]()
        temperature = self._hour_change = None
        mount = self.cell.sensor.mount
        if isinstance(calibration, str):
            from ftdrive.store.tools import calibration_of_tool

            url = self.cell.store.url
            tool = calibration_of_tool(calibration, arm, sensor, mount, url=url, force=self._force)
            calibration, name, warnings = tool.calibration, str(tool.path), tool.warnings
            temperature, self._hour_change = tool.temperature, tool.hour_change
        belongs = compare_devices(calibration, {"arm": arm, "sensor": sensor}, mount)
        if belongs.others and not self._force:
            raise ConfigError(f"{belongs.others[0]}: calibrate this cell, or apply it all the same with --force")
        self._foreign = bool(belongs.others)
        return calibration, name, (*warnings, *belongs.others, *belongs.unknown), temperature

    def _described(
        self, arm: DeviceInfo, sensor: DeviceInfo, sensor_rate_Hz: float, arm_rate_Hz: float, status: ArmStatus
    ) -> StreamInfo:
        tcp = np.full(6, np.nan) if status.tcp_offset is None else np.array(status.tcp_offset)
        verification, state = self._trusted()
        return StreamInfo(
            calibration=self._calibration,
            calibration_name=self._name,
            arm=arm,
            sensor=sensor,
            tool=self._wanted if isinstance(self._wanted, str) else self.cell.tool.name,
            # the anchor of all times in files
            utc_offset_ns=time.time_ns() - self.clock.now_ns(),
            sensor_rate_Hz=sensor_rate_Hz,
            arm_rate_Hz=arm_rate_Hz,
            p_flange_sensor_m=sensor_origin_m(self.cell.sensor.height_mm, self._calibration),
            R_flange_tcp=np.eye(3) if status.tcp_offset is None else Rotation.from_rotvec(tcp[3:]).as_matrix(),
            p_flange_tcp_m=tcp[:3],
            versions=versions(),
            verification=verification,
            calibration_state=state,
            emulated=self.cell.is_emulated,
            foreign=self._foreign,
            hour_change=self._hour_change,
        )

    def _trusted(self) -> tuple[VerificationRecord | None, str]:
        """Return the last verification of the calibration, and what is said of its age and of that."""
        path = Path(self._name)
        verification = verification_near(path, self._calibration.id) if path.name and path.exists() else None
        marks = marks_of(self._calibration, emulated=self.cell.is_emulated, foreign=self._foreign)
        return verification, calibration_in_words(self._calibration, verification, datetime.now(UTC), marks)

    def use_tool(self, name: str) -> StreamEvent:
        """Continue with the newest accepted calibration of another tool, after a change of tools.

        The devices stay open. Noise, contact, tares and drift begin again; the delay is kept. Call it between two
        reads, and open new recorders and servers: each keeps the calibration with which it was opened.

        Raises
        ------
        ConfigError
            There is no such calibration. The stream continues with the one it has.
        """
        before, self._wanted = self._wanted, name
        try:
            self._calibration, self._name, self.warnings, self._temperature = self._chosen(
                self.info.arm, self.info.sensor
            )
        except ConfigError:
            self._wanted = before
            raise
        verification, state = self._trusted()
        # a contact is not continued
        self.restart()
        self._call_on_contact()
        info = replace(
            self.info,
            calibration=self._calibration,
            calibration_name=self._name,
            tool=name,
            verification=verification,
            calibration_state=state,
            hour_change=self._hour_change,
        )
        self._apply_calibration(info, self._temperature)
        self._pairing.use(DelayEstimator(self._calibration, self.info.p_flange_sensor_m))
        values = {"tool": name, "calibration": self._calibration.id}
        return self.note("tool", f"tool {name}, calibration {self._name}", values, self.clock.now_ns())

    # -------------------------------------------------------------------------------------------------------- reading

    def read(self, timeout_s: float = STALE_S) -> Block:
        """Return every sample since the last read whose pose is known, at least one.

        Raises
        ------
        DeviceTimeout
            A device is silent, or no sample came within `timeout_s`.
        StreamBroken, DeviceFault, ConnectError
            A device has failed. The next call reconnects.
        """
        if self._failure is not None:
            self._reopen(*self._failure)
        for left_s in self.clock.looks(timeout_s):
            if (block := self._next_block(left_s)) is not None:
                self._report_recovery()
                return block
        role = "arm" if self._pairing.waits_for_pose else "sensor"
        self._fail(role, DeviceTimeout(f"the {role} sent nothing new for {timeout_s:g} s", "check cable and supply"))

    def _next_block(self, wait_s: float) -> Block | None:
        waits_for_pose = self._pairing.waits_for_pose
        role = "sensor"
        try:
            samples = self._sensor_follow.read(0.0) if waits_for_pose else self._read_sensor(wait_s)
            role = "arm"
            states = self._arm_follow.read(wait_s if waits_for_pose else 0.0)
        except DeviceError as error:
            self._fail(role, error)
        self._count(states)
        self._pairing.add_states(states)
        self._pairing.add_samples(samples)
        paired = self._pairing.take()
        if paired is None:
            return None
        self.delay_sigma_s = self._pairing.delay_sigma_s
        if (temperature_C := self._sensor.temperature_C()) is not None:
            self.warm(temperature_C)
        block = self._process_read(paired)
        return block if len(block) else None

    def _read_sensor(self, wait_s: float) -> FtSamples:
        """Wait for the first samples, then for those of one block; the last of them have just arrived."""
        blocks = [self._sensor_follow.read(wait_s)]
        rows = len(blocks[0])
        wanted = self.block_s * self.info.sensor_rate_Hz
        # A pause between reads left the newest sample waiting for up to 5 ms, so the block ends with one that just
        # arrived.
        while 0 < rows < wanted and len(more := self._sensor_follow.read(self.block_s)):
            blocks.append(more)
            rows += len(more)
        return FtSamples.concatenate(blocks)

    def __iter__(self) -> Iterator[Sample]:
        while True:
            yield from self.read()

    def plot(self, duration_s: float = 2.0) -> Any:
        """Read for so long, and draw what was read: the wrench in `frame`, after `stages`.

        Parameters
        ----------
        duration_s : float
            A loop over the stream does not get the samples of this time.

        Returns
        -------
        matplotlib.figure.Figure
            Forces above torques. The band is one sigma: noise, calibration, and errors of the sensor under contact.

        Raises
        ------
        UsageError
            matplotlib is not installed.
        DeviceError
            As `read`.
        """
        begin_ns, blocks = self.clock.now_ns(), list[Block]()
        while not blocks or blocks[-1].t_host_ns[-1] < begin_ns + 1e9 * duration_s:
            block = self.read()
            # what a pause between reads left is older
            if block.t_host_ns[-1] >= begin_ns:
                blocks.append(block)
        t_ns = np.concatenate([block.t_host_ns for block in blocks])
        drawn = t_ns >= begin_ns
        return figure_of(
            (t_ns[drawn] - begin_ns) * 1e-9,
            np.concatenate([block.wrench for block in blocks])[drawn],
            label="time, s",
            title=f"Contact wrench, {blocks[-1].frame}; band: one sigma",
            sigma=np.concatenate([np.broadcast_to(block.sigma, block.wrench.shape) for block in blocks])[drawn],
        )

    # ---------------------------------------------------------------------------------------------------- interruption

    def _follow(self) -> None:
        with ExitStack() as stack:
            self._sensor_follow: Follow[FtSamples] = stack.enter_context(self._sensor.follow())
            self._arm_follow: Follow[ArmStates] = stack.enter_context(self._arm.follow())
            self._follows = stack.pop_all()

    def _unfollow(self) -> None:
        self._follows.close()

    def _first_samples(self) -> tuple[FtSamples, ArmStates]:
        samples, states = [], []
        for left_s in self.clock.looks(_RATE_S):
            samples.append(self._sensor_follow.read(min(left_s, 0.01)))
            states.append(self._arm_follow.read(0.0))
        found = FtSamples.concatenate(samples), ArmStates.concatenate(states)
        for device, rows in (("sensor", found[0]), ("arm", found[1])):
            if len(rows) < 2:
                raise DeviceTimeout(f"the {device} sent {len(rows)} samples in {_RATE_S:g} s", "check cable and supply")
        return found

    def _fail(self, role: str, error: DeviceError) -> NoReturn:
        if self._silent_since_ns is None:
            self._silent_since_ns = self.clock.now_ns()
            self.note("stale", f"{role}: {error}", {"device": role}, self._silent_since_ns)
        self._failure = role, error
        raise error

    def _reopen(self, role: str, failure: DeviceError) -> None:
        """Open what has ended again; raises the failure that remains."""
        self.clock.sleep((self._next_ns - self.clock.now_ns()) * 1e-9)
        self._next_ns = self.clock.now_ns() + round(_RETRY_S * 1e9)
        self._unfollow()
        try:
            self._sensor.open()
            self._arm.open()
            self._sensor.check()
            self._follow()
        except DeviceError as error:
            self._failure = role, error
            raise
        if (arm := self._arm.identify()) != self.info.arm or self._sensor.identify() != self.info.sensor:
            raise ConfigError(f"another device answers ({arm.model} {arm.serial}): start again") from failure
        self._pairing.forget()
        self.restart()
        self._failure = None
        self._arm_newest = None

    def _report_recovery(self) -> None:
        if self._silent_since_ns is not None:
            silent_s = (self.clock.now_ns() - self._silent_since_ns) * 1e-9
            self._silent_since_ns = None
            text = f"samples arrive again after {silent_s:.1f} s"
            self.note("recovered", text, {"silent_s": silent_s}, self.clock.now_ns())

    def status(self) -> StreamStatus:
        """Return rates, losses, ages, delay, tare and drift."""
        health = self._sensor.health()
        texts = {} if self._failure is None else {self._failure[0]: str(self._failure[1])}
        now_ns = self.clock.now_ns()
        newest_ns = self._arm_newest[0] if self._arm_newest else 0
        sensor = LinkStatus(
            health.rate_Hz, self.info.sensor_rate_Hz, health.lost, health.age_s, texts.get("sensor", "")
        )
        recent = sum(n for t_ns, n in self._arrivals if t_ns > now_ns - _RATE_WINDOW_NS)
        age_s = (now_ns - newest_ns) * 1e-9
        arm = LinkStatus(float(recent), self.info.arm_rate_Hz, self._arm_lost, age_s, texts.get("arm", ""))
        return self._status_of(sensor, arm, (self._pairing.delay_s, self._pairing.delay_sigma_s))

    def _count(self, states: ArmStates) -> None:
        if not len(states):
            return
        t_ns = int(states.t_host_ns[-1])
        self._arrivals.append((t_ns, len(states)))
        while self._arrivals[0][0] < t_ns - _RATE_WINDOW_NS:
            self._arrivals.popleft()
        newest_s = float(states.t_device_s[-1])
        if self._arm_newest is not None and math.isfinite(duration_s := newest_s - self._arm_newest[1]):
            self._arm_lost += max(round(duration_s / self._arm_step_s) - len(states), 0)
        self._arm_newest = t_ns, newest_s


class BlockReader:
    """Reads a stream block after block. While a device has failed it yields None, and raises the failure if it lasts.

    Parameters
    ----------
    stream : ProcessedStream
        Open; its `read` reconnects after a failure.
    patience_s : float
        So long a failure may last; 0 raises it at once. May be set at any time.
    say : callable
        Gets a sentence when an interruption begins, and one when it is over.
    meanwhile : str
        What the interruption means, for the first sentence.

    Attributes
    ----------
    failure : DeviceError or None
        Why the stream gives no samples now.
    """

    def __init__(
        self,
        stream: ProcessedStream,
        patience_s: float = RECOVER_S,
        *,
        say: Callable[[str], object] = lambda _: None,
        meanwhile: str = "",
    ) -> None:
        self.patience_s = patience_s
        self.failure: DeviceError | None = None
        self._stream, self._say, self._meanwhile = stream, say, meanwhile
        self._failing_since_s = 0.0

    def __iter__(self) -> Iterator[Block | None]:
        while True:
            yield self.read()

    def read(self) -> Block | None:
        """Return the next block; None while a device has failed."""
        try:
            block = self._stream.read()
        except DeviceError as error:
            now_s = self._stream.clock.now_s()
            if self.failure is None:
                self._failing_since_s = now_s
                self._say(f"{error}. {self._meanwhile}")
            self.failure = error
            # Each read has waited for the device already, so there is no pause here.
            if now_s - self._failing_since_s >= self.patience_s:
                raise
            return None
        if self.failure is not None:
            self.failure = None
            self._say("Samples arrive again.")
        return block
