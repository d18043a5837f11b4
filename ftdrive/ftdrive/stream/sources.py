"""Sources of paired samples for a stream: a cell, the sensor of a cell alone, or a recording."""

import math
import time
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Callable, Iterable
from contextlib import ExitStack, closing
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Literal, NamedTuple, NoReturn

import numpy as np
from scipy.spatial.transform import Rotation

from ftcalib import CalibrationResult
from ftcalib.after.series import BiasTemperature
from ftcalib.errors import BadDataset
from ftdrive.cell.config import CellConfig
from ftdrive.cell.devices import build_arm, build_sensor
from ftdrive.cell.emulated import Station
from ftdrive.checks.check import compare_devices
from ftdrive.errors import ConfigError
from ftdrive.runs.calibration import marks_of, versions
from ftdrive.runs.verification import VerificationRecord, age_and_check, verification_near
from ftdrive.stream.pairing import DelayEstimator, Pairing
from ftdrive.stream.samples import Links, LinkStatus, Paired, StreamEvent, StreamInfo, mean_rate_Hz, sensor_origin_m
from ftdrivers.clock import REAL, Clock
from ftdrivers.errors import DeviceError, DeviceTimeout
from ftdrivers.follow import Follow
from ftdrivers.interfaces import ArmStates, Array, DeviceInfo, ForceTorqueSensor, FtSamples, RobotArm

STALE_S = 0.3
"""`CellSource.read` raises if one of the devices sends no new sample for this time, s."""

# Time between two attempts to reconnect, s.
_RETRY_S = 0.2
# After opening, the rates of the sensor and the arm are measured over this time, s.
_RATE_S = 0.5
_RATE_WINDOW_NS = 1_000_000_000
_ALONE = DeviceInfo("", "", "")
STEP_S = 0.01
"""Duration, s, of the samples that one read of a recording returns, or one step while it is paused."""
# Longest wait of one read of a recording, s; it is short so that the reading thread reacts to keys.
_WAIT_S = 0.1


class Read(NamedTuple):
    """Result of one read of a sample source."""

    rows: Paired
    begin: Literal["", "interrupted", "elsewhere"] = ""
    """Why `rows` do not continue those read before: an interruption, or another position in a recording; or empty."""
    temperature_C: float | None = None
    """Sensor temperature; None if unknown."""
    delay_sigma_s: float = 0.0
    """Standard deviation of the delay of the sensor's samples after the arm's poses."""


class SampleSource(ABC):
    """Source of the paired samples of one stream.

    Attributes
    ----------
    info : StreamInfo
        Description of the cell; available once the source is open.
    temperature : BiasTemperature or None
        How the bias of the sensor changes with its temperature.
    warnings : tuple of str
        Doubts about the calibration, and checks that were not possible.
    note : callable
        Receives the events of the devices; set by the stream.
    has_ended : bool
        Whether there are no further samples.
    """

    clock: Clock = REAL
    info: StreamInfo
    temperature: BiasTemperature | None = None
    warnings: tuple[str, ...] = ()
    note: Callable[[StreamEvent], object]
    has_ended = False

    def open(self) -> None:  # noqa: B027 - a recording has nothing to open
        """Start reading."""

    def close(self) -> None:  # noqa: B027
        """Stop reading; may be called twice."""

    @abstractmethod
    def read(self, timeout_s: float) -> Read:
        """Return the next samples; none while a recording is paused. `DeviceError` if a device fails; then retry."""

    def links(self) -> Links:
        """Return rates, losses and ages of the devices, and their delay; the base class gives those of a recording."""
        rate_Hz, arm_rate_Hz = self.info.sensor_rate_Hz, self.info.arm_rate_Hz
        return Links(LinkStatus(rate_Hz, rate_Hz, 0, 0.0), LinkStatus(arm_rate_Hz, arm_rate_Hz, 0, 0.0), 0.0, 0.0)

    def beginning(self) -> Iterable[Paired]:
        """Return the samples, of a recording only, from which the noise is estimated before the first read."""
        return ()


class CellSource(SampleSource):
    """Samples from the sensor of a cell, paired with the poses of its arm; without a calibration, the sensor alone.

    Parameters
    ----------
    cell : CellConfig or Station
        `open` starts an emulated cell, and `close` stops it. Nothing moves the arm.
    calibration : CalibrationResult or str, optional
        A calibration of these devices, or the name of a tool: `open` looks up its newest accepted calibration. Without
        it only the sensor is read.
    name : str
        Name of the calibration, such as its path.
    force : bool
        Warn instead of raising an error if the calibration belongs to another arm, sensor or mount; for a tool, also
        accept a calibration that was edited by hand.
    devices : ForceTorqueSensor and RobotArm, optional
        Devices to use instead of those in the configuration of the cell.

    Raises
    ------
    ConfigError
        On `open`: the calibration belongs to another arm, sensor or mount, or the tool has none.
    ConnectError
        On `open`: a device does not answer.
    """

    def __init__(
        self,
        cell: CellConfig | Station,
        calibration: CalibrationResult | str | None,
        *,
        name: str = "",
        force: bool = False,
        devices: tuple[ForceTorqueSensor | None, RobotArm | None] = (None, None),
    ) -> None:
        self._given, self._wanted, self._name, self._force = cell, calibration, name, force
        self._devices = devices
        self.block_s = 0.003
        """Duration of the samples per read, s; a block costs about the same with one sample as with many. May be set at
        any time: longer blocks arrive later and need less processor time."""
        self.payload_kg: float | None = None
        """Payload set in the controller; None if the controller does not report it."""
        self._arm: RobotArm | None = None
        self._stack, self._follows = ExitStack(), ExitStack()
        # The device that failed, "sensor" or "arm", and its error; None while both work.
        self._failure: tuple[str, DeviceError] | None = None
        self._silent_since_ns: int | None = None
        self._was_interrupted = False
        self._arrivals: deque[tuple[int, int]] = deque()
        self._arm_lost = 0
        self._arm_newest: tuple[int, float] | None = None
        self._next_ns = 0

    def open(self) -> None:
        with ExitStack() as stack:
            self.cell = self._given if isinstance(self._given, CellConfig) else stack.enter_context(self._given).cell
            self.clock: Clock = self.cell.clock
            self._sensor = stack.enter_context(self._devices[0] or build_sensor(self.cell))
            if self._wanted is not None:
                self._arm = stack.enter_context(closing(self._devices[1] or build_arm(self.cell)))
                self._arm.open()
            info = self._chosen(self._wanted, self._described())
            stack.callback(self._unfollow)
            self._follow()
            samples, states = self._first_samples()
            nominal_Hz = self._sensor.health().nominal_rate_Hz
            rate_Hz = nominal_Hz if np.isfinite(nominal_Hz) else mean_rate_Hz(samples.t_host_ns)
            self.info = replace(info, sensor_rate_Hz=rate_Hz)
            if states is not None:
                self.info = replace(self.info, arm_rate_Hz=mean_rate_Hz(states.t_host_ns))
                self._arm_step_s = float(np.median(np.diff(states.t_device_s)))
            delay_ms = self.cell.sensor.delay_ms
            delay = self._estimator() if delay_ms is None and self._arm is not None else (delay_ms or 0.0) / 1e3
            self._pairing = Pairing(nominal_Hz, delay, has_arm=self._arm is not None)
            if states is not None:
                self._pairing.add_states(states)
            self._pairing.add_samples(samples)
            self._stack = stack.pop_all()

    def close(self) -> None:
        self._stack.close()

    @property
    def station(self) -> Station:
        """The emulated cell, which can be controlled; raises `ConfigError` for a real cell."""
        if not isinstance(self._given, Station):
            raise ConfigError("only a stream with simulate=True has an emulated cell: this is a real cell")
        return self._given

    def _described(self) -> StreamInfo:
        arm, offset = _ALONE, None
        if self._arm is not None:
            arm, status = self._arm.identify(), self._arm.status()
            self.payload_kg, offset = status.payload_kg, status.tcp_offset
        tcp = np.full(6, np.nan) if offset is None else np.array(offset)
        return StreamInfo(
            result=None,
            calibration_name="",
            arm=arm,
            sensor=self._sensor.identify(),
            tool=self.cell.tool.name,
            # reference of all times in files
            utc_offset_ns=time.time_ns() - self.clock.now_ns(),
            sensor_rate_Hz=math.nan,
            arm_rate_Hz=0.0,
            p_flange_sensor_m=sensor_origin_m(self.cell.sensor.height_mm),
            R_flange_tcp=np.eye(3) if offset is None else Rotation.from_rotvec(tcp[3:]).as_matrix(),
            p_flange_tcp_m=tcp[:3],
            versions=versions(),
            calibration_state="raw readings of the sensor alone: no arm, no calibration",
            emulated=self.cell.is_emulated,
        )

    def use_tool(self, name: str) -> StreamInfo:
        """Use the newest accepted calibration of another tool; without one, raise `ConfigError` and change nothing."""
        self.info, self._wanted = self._chosen(name, self.info), name
        self._pairing.use(self._estimator())
        return self.info

    def _estimator(self) -> DelayEstimator:
        return DelayEstimator(self.info.calibration, self.info.p_flange_sensor_m)

    def _chosen(self, wanted: CalibrationResult | str | None, info: StreamInfo) -> StreamInfo:
        if wanted is None:
            return info
        calibration, name, warnings = wanted, self._name, tuple[str, ...]()
        temperature: BiasTemperature | None = None
        hour_change: Array | None = None
        mount, tool_name = self.cell.sensor.mount, self.cell.tool.name
        if isinstance(calibration, str):
            from ftdrive.store.tools import calibration_of_tool

            url, tool_name = self.cell.store.url, calibration
            tool = calibration_of_tool(calibration, info.arm, info.sensor, mount, url=url, force=self._force)
            calibration, name, warnings = tool.calibration, str(tool.path), tool.warnings
            temperature, hour_change = tool.temperature, tool.hour_change
        belongs = compare_devices(calibration, {"arm": info.arm, "sensor": info.sensor}, mount)
        if belongs.others and not self._force:
            raise ConfigError(f"{belongs.others[0]}: calibrate this cell, or apply the calibration anyway with --force")
        foreign = bool(belongs.others)
        verification, state = _trusted(
            calibration, name, marks_of(calibration, emulated=info.emulated, foreign=foreign)
        )
        self.warnings, self.temperature = (*warnings, *belongs.others, *belongs.unknown), temperature
        return replace(
            info,
            result=calibration,
            calibration_name=name,
            tool=tool_name,
            p_flange_sensor_m=sensor_origin_m(self.cell.sensor.height_mm, calibration),
            verification=verification,
            calibration_state=state,
            foreign=foreign,
            hour_change=hour_change,
        )

    # -------------------------------------------------------------------------------------------------------- reading

    def read(self, timeout_s: float = STALE_S) -> Read:
        if self._failure is not None:
            self._reopen(*self._failure)
        for left_s in self.clock.looks(timeout_s):
            if (rows := self._next_rows(left_s)) is not None:
                self._report_recovery()
                begin: Literal["", "interrupted"] = "interrupted" if self._was_interrupted else ""
                self._was_interrupted = False
                return Read(rows, begin, self._sensor.temperature_C(), self._pairing.delay_sigma_s)
        role = "arm" if self._pairing.waits_for_pose else "sensor"
        self._fail(role, DeviceTimeout(f"the {role} sent no new sample for {timeout_s:g} s", "check cable and power"))

    def _next_rows(self, wait_s: float) -> Paired | None:
        waits_for_pose = self._pairing.waits_for_pose
        role = "sensor"
        try:
            samples = self._sensor_follow.read(0.0) if waits_for_pose else self._read_sensor(wait_s)
            if self._arm is not None:
                role = "arm"
                states = self._arm_follow.read(wait_s if waits_for_pose else 0.0)
                self._count(states)
                self._pairing.add_states(states)
        except DeviceError as error:
            self._fail(role, error)
        self._pairing.add_samples(samples)
        return self._pairing.take()

    def _read_sensor(self, wait_s: float) -> FtSamples:
        """Wait for the first samples, then for a full block that ends with a sample that has just arrived."""
        blocks = [self._sensor_follow.read(wait_s)]
        rows = len(blocks[0])
        wanted = self.block_s * self.info.sensor_rate_Hz
        # After a pause between reads the newest sample may be 5 ms old, so wait for one that has just arrived.
        while 0 < rows < wanted and len(more := self._sensor_follow.read(self.block_s)):
            blocks.append(more)
            rows += len(more)
        return FtSamples.concatenate(blocks)

    def links(self) -> Links:
        health = self._sensor.health()
        texts = {} if self._failure is None else {self._failure[0]: str(self._failure[1])}
        error = texts.get("sensor", "")
        sensor = LinkStatus(health.rate_Hz, self.info.sensor_rate_Hz, health.lost, health.age_s, error)
        # without an arm, the age is 0
        arm = LinkStatus(0.0, 0.0, 0, 0.0)
        if self._arm is not None:
            now_ns = self.clock.now_ns()
            recent = sum(n for t_ns, n in self._arrivals if t_ns > now_ns - _RATE_WINDOW_NS)
            age_s = (now_ns - (self._arm_newest[0] if self._arm_newest else 0)) * 1e-9
            arm = LinkStatus(float(recent), self.info.arm_rate_Hz, self._arm_lost, age_s, texts.get("arm", ""))
        return Links(sensor, arm, self._pairing.delay_s, self._pairing.delay_sigma_s)

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

    # ---------------------------------------------------------------------------------------------------- interruption

    def _follow(self) -> None:
        with ExitStack() as stack:
            self._sensor_follow: Follow[FtSamples] = stack.enter_context(self._sensor.follow())
            if self._arm is not None:
                self._arm_follow: Follow[ArmStates] = stack.enter_context(self._arm.follow())
            self._follows = stack.pop_all()

    def _unfollow(self) -> None:
        self._follows.close()

    def _first_samples(self) -> tuple[FtSamples, ArmStates | None]:
        samples, states = [], []
        for left_s in self.clock.looks(_RATE_S):
            samples.append(self._sensor_follow.read(min(left_s, 0.01)))
            if self._arm is not None:
                states.append(self._arm_follow.read(0.0))
        found = FtSamples.concatenate(samples), ArmStates.concatenate(states) if states else None
        for device, rows in zip(("sensor", "arm"), found, strict=True):
            if rows is not None and len(rows) < 2:
                raise DeviceTimeout(f"the {device} sent {len(rows)} samples in {_RATE_S:g} s", "check cable and power")
        return found

    def _fail(self, role: str, error: DeviceError) -> NoReturn:
        if self._silent_since_ns is None:
            self._silent_since_ns = self.clock.now_ns()
            self.note(StreamEvent(self._silent_since_ns, "stale", f"{role}: {error}", {"device": role}))
        self._failure = role, error
        raise error

    def _reopen(self, role: str, failure: DeviceError) -> None:
        self.clock.sleep((self._next_ns - self.clock.now_ns()) * 1e-9)
        self._next_ns = self.clock.now_ns() + round(_RETRY_S * 1e9)
        self._unfollow()
        try:
            self._sensor.open()
            if self._arm is not None:
                self._arm.open()
            self._sensor.check()
            self._follow()
        except DeviceError as error:
            self._failure = role, error
            raise
        arm = _ALONE if self._arm is None else self._arm.identify()
        if arm != self.info.arm or self._sensor.identify() != self.info.sensor:
            raise ConfigError(f"another device answers ({arm.model} {arm.serial}): start again") from failure
        self._pairing.forget()
        self._was_interrupted = True
        self._failure = None
        self._arm_newest = None

    def _report_recovery(self) -> None:
        if self._silent_since_ns is not None:
            silent_s = (self.clock.now_ns() - self._silent_since_ns) * 1e-9
            self._silent_since_ns = None
            text = f"samples arrive again after {silent_s:.1f} s"
            self.note(StreamEvent(self.clock.now_ns(), "recovered", text, {"silent_s": silent_s}))


class RecordingSource(SampleSource):
    """Paired samples of a recording, played at `speed` times real time; infinity reads without waiting.

    While paused and at the end, `read` returns no rows. `clock` times the playback.
    """

    def __init__(self, info: StreamInfo, rows: Paired, *, speed: float = 1.0, clock: Clock = REAL) -> None:
        if not len(rows):
            raise BadDataset("the recording has no samples: replay another one")
        self.info, self.rows, self.clock = info, rows, clock
        self._seconds = (rows.t_host_ns - rows.t_host_ns[0]) * 1e-9
        self._speed = speed
        # Index of the next row, whether the position has jumped since the last read, and end of a single step or -1.
        self._next, self._has_jumped, self._step_to_s = 0, False, -1.0
        self.is_paused = False

    def open(self) -> None:
        self._set_out(self.at_s)

    # ----------------------------------------------------------------------------------------------------------- time

    @property
    def at_s(self) -> float:
        """Position in the recording, s from its start, of the newest row that was read."""
        return float(self._seconds[max(self._next - 1, 0)])

    @property
    def duration_s(self) -> float:
        """Duration of the recording."""
        return float(self._seconds[-1])

    @property
    def has_ended(self) -> bool:  # type: ignore[override]  # derived from the position
        return self._next >= len(self.rows)

    @property
    def speed(self) -> float:
        """Playback speed relative to real time; settable."""
        return self._speed

    @speed.setter
    def speed(self, speed: float) -> None:
        if not speed > 0:
            raise ValueError(f"speed {speed} is not possible: give a positive speed")
        self._speed = speed
        self._set_out(self.at_s)

    def toggle(self) -> None:
        """Pause, continue after a pause, or start again after the end."""
        if self.has_ended:
            self.seek(0.0)
        else:
            self.is_paused = not self.is_paused
            self._set_out(self.at_s)

    def seek(self, t_s: float) -> None:
        """Go to a time in the recording; filters and contacts restart there."""
        self._next = int(np.searchsorted(self._seconds, min(max(t_s, 0.0), self.duration_s)))
        self._has_jumped = True
        self._set_out(float(self._seconds[self._next]))

    def step(self) -> None:
        """Let the next read return the next `STEP_S` of the recording, even while paused."""
        self._step_to_s = float(self._seconds[min(self._next, len(self.rows) - 1)]) + STEP_S

    def _set_out(self, at_s: float) -> None:
        self._begin_s, self._begin_ns = at_s, self.clock.now_ns()

    # -------------------------------------------------------------------------------------------------------- reading

    def read(self, timeout_s: float = _WAIT_S) -> Read:
        """Wait shortly, and return the rows that playback has reached since the last read."""
        if self._step_to_s >= 0:
            end_s, self._step_to_s = self._step_to_s, -1.0
        elif self.is_paused or self.has_ended:
            self.clock.sleep(min(timeout_s, _WAIT_S))
            end_s = -1.0
        elif math.isinf(self._speed):
            end_s = float(self._seconds[self._next]) + STEP_S
        else:
            next_s = float(self._seconds[self._next])
            due_s = (next_s + STEP_S - self._begin_s) / self._speed - (self.clock.now_ns() - self._begin_ns) * 1e-9
            self.clock.sleep(min(due_s, timeout_s, _WAIT_S))
            end_s = self._begin_s + (self.clock.now_ns() - self._begin_ns) * 1e-9 * self._speed
        end = max(self._next, int(np.searchsorted(self._seconds, end_s, "right")))
        rows = self.rows.rows(slice(self._next, end))
        self._next = end
        if self.is_paused:
            self._set_out(self.at_s)
        begin: Literal["", "elsewhere"] = "elsewhere" if self._has_jumped else ""
        self._has_jumped = False
        return Read(rows, begin)

    def beginning(self) -> Iterable[Paired]:
        return [self.rows]

    def links(self) -> Links:
        recent = slice(int(np.searchsorted(self._seconds, self.at_s - 1.0, "right")), self._next)
        seq = self.rows.seq[: self._next]
        lost = int(seq[-1] - seq[0]) + 1 - len(seq) if len(seq) else 0
        rate_Hz = len(self.rows.seq[recent]) / min(1.0, max(self.at_s, 1e-3))
        return super().links()._replace(sensor=LinkStatus(rate_Hz, self.info.sensor_rate_Hz, lost, 0.0))


def _trusted(
    calibration: CalibrationResult, name: str, marks: tuple[str, ...]
) -> tuple[VerificationRecord | None, str]:
    """Return a calibration's last verification, and a text on the calibration's id, verdict, age and verification."""
    path = Path(name)
    verification = verification_near(path, calibration.id) if path.name and path.exists() else None
    state = age_and_check(calibration, verification, datetime.now(UTC))
    return verification, ", ".join([f"calibration {calibration.id[:6]}", calibration.verdict, *marks, state])
