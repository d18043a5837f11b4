"""Interfaces of the two devices of a cell: an arm and a wrist force/torque sensor.

A constructor only stores the configuration. `open` connects to the device. `close` may be called at any time, twice, or
after the device was lost. Every wait has a time-out. Stale data raise an error and are never returned.
"""

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, field, fields
from functools import cache
from typing import Any, ClassVar, Final, Literal, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ftdrivers.errors import ConnectError, DeviceFault
from ftdrivers.follow import Follow
from ftdrivers.sweep import Sweep

Array = NDArray[np.float64]

Guard = Callable[[], None]
"""Function that is called between two samples of a moving arm. It raises an error if the motion must not go on."""


NOT_REPORTED: Final = "not reported"
"""Placeholder for a serial number or firmware version that a device does not report."""
WRIST_SENSOR: Final = "UR e-Series wrist sensor (ft_raw_wrench)"
"""Model name of the sensor in the wrist of a UR arm, whose readings contain the friction of the last joint."""


@dataclass(frozen=True, slots=True)
class Fact:
    """A property of a device, and the source of its value."""

    value: float | str | tuple[float, ...]
    source: Literal["device", "documented", "configured", "assumed"]
    """Reported by the device, fixed by its manual, set by the user, or assumed (to be checked)."""


@dataclass(frozen=True, slots=True)
class DeviceInfo:
    """Model, serial number and firmware of a device, and further facts about it.

    Examples
    --------
    >>> import ftdrivers
    >>> ftdrivers.DeviceInfo("Acme FT", "A1", "1.0").serial
    'A1'
    """

    model: str
    serial: str
    firmware: str
    facts: dict[str, Fact] = field(default_factory=dict)
    """Keys of a sensor, each only if known: `serial`; `counts_per_N` and `counts_per_Nm`, the scale of the raw values;
    `range`, (6,) largest force in N and torque in N·m on each axis, in both directions; `sign`, 1 or -1;
    `software_bias`, which the device subtracts, in its own unit; `tool_transformation`, which the device applies and
    the driver undoes; `zero`, "arbitrary" if the reading without load may have any value. Keys of an arm: `control`,
    the control path and the reason for it; `kinematics`, (24,) theta, a, d and alpha of its joints, as measured."""

    @property
    def has_arbitrary_zero(self) -> bool:
        """Whether the reading without load may have any value; the range then limits changes of the reading."""
        return "zero" in self.facts


class Columns:
    """n consecutive samples: one array per quantity, one row per sample."""

    __slots__ = ()
    # Fields with one value for all rows. When blocks are joined, the value of the last block is kept.
    _COMMON: ClassVar[frozenset[str]] = frozenset()
    t_host_ns: NDArray[np.int64]

    def __len__(self) -> int:
        """Return the number of rows."""
        return len(self.t_host_ns)

    def columns(self) -> dict[str, Any]:
        """Return the fields by name, for a subclass with further fields."""
        return {name: getattr(self, name) for name in self._names()}

    @classmethod
    def concatenate(cls, blocks: Sequence[Self]) -> Self:
        """Return one block with the rows of all blocks, in their order."""
        if len(blocks) == 1:
            return blocks[0]
        last = blocks[-1]
        return cls(
            *(
                getattr(last, name)
                if name in cls._COMMON
                else np.concatenate([getattr(block, name) for block in blocks])
                for name in cls._names()
            )
        )

    def rows(self, which: slice | NDArray[np.bool_]) -> Self:
        """Return a block that contains only the selected rows."""
        return type(self)(
            *(getattr(self, name) if name in self._COMMON else getattr(self, name)[which] for name in self._names())
        )

    @classmethod
    @cache  # `fields` takes longer than the rest
    def _names(cls) -> tuple[str, ...]:
        return tuple(column.name for column in fields(cls))  # type: ignore[arg-type]  # every subclass is a dataclass


@dataclass(frozen=True, slots=True, eq=False)
class FtSamples(Columns):
    """n consecutive samples from one sensor, one row each, as measured: no bias, tare or filter applied.

    The wrench is exerted on the sensor by its load and by contacts, in sensor axes, about the sensor's origin.

    Examples
    --------
    >>> import ftdrivers
    >>> samples = ftdrivers.FtSamples.of(t_host_ns=[0, 10**6], seq=[0, 1], wrench=[[0, 0, 9.8, 0, 0, 0]] * 2)
    >>> len(samples), samples.wrench[:, 2]
    (2, array([9.8, 9.8]))
    """

    t_host_ns: NDArray[np.int64]
    """(n,) `Clock.now_ns()` of the driver at receipt."""
    t_device_s: Array
    """(n,) time on the device's own clock, s; NaN if it has none. Its epoch differs from that of host time."""
    seq: NDArray[np.int64]
    """(n,) sequence number. Every sample that the device sent or was polled for has one, which makes gaps visible."""
    counts: NDArray[np.int32]
    """(n, k) raw counts of the device; k = 0 if the device reports physical units."""
    wrench: Array
    """(n, 6) force in N, then torque in N·m."""
    status: NDArray[np.uint32]
    """(n,) status word of the device, with the bits of its vendor."""

    @classmethod
    def of(
        cls,
        t_host_ns: ArrayLike,
        seq: ArrayLike,
        wrench: ArrayLike,
        *,
        counts: ArrayLike | None = None,
        t_device_s: ArrayLike = math.nan,
        status: ArrayLike = 0,
    ) -> Self:
        """Build n samples from `wrench` (n, 6). A value that all rows share may be a single number."""
        n = len(wrench := np.asarray(wrench, np.float64))
        return cls(
            t_host_ns=np.full(n, t_host_ns, np.int64),
            t_device_s=np.full(n, t_device_s, np.float64),
            seq=np.full(n, seq, np.int64),
            counts=np.zeros((n, 0), np.int32) if counts is None else np.asarray(counts, np.int32),
            wrench=wrench,
            status=np.full(n, status, np.uint32),
        )


@dataclass(frozen=True, slots=True)
class Health:
    """Statistics of a stream since it was opened."""

    received: int
    lost: int
    """Number of samples that the device sent, or was polled for, but that never arrived or arrived too late."""
    malformed: int
    """Number of damaged frames, which were dropped."""
    rate_Hz: float
    """Mean sample rate over the last second, Hz."""
    age_s: float
    """Time since the newest sample, s."""
    duplicated: int = 0
    """Number of frames or samples that arrived a second time and were dropped."""
    out_of_order: int = 0
    """Number of samples that arrived after a newer one and were dropped. They are part of `lost`."""
    stale: int = 0
    """Number of gaps without a sample, longer than `StreamLimits.stale_s`, after which samples arrived again."""
    reconnects: int = 0
    """Number of interruptions after which the driver has reconnected, see `StreamingSensor.recover`."""
    nominal_rate_Hz: float = math.nan
    """Rate that the device reports or its manual states, Hz; NaN if unknown."""
    events: tuple[tuple[int, str], ...] = ()
    """Pairs of `t_host_ns` and a phrase: interruption, reconnection, pause of the reader, late samples, start and end
    of a wrong rate. A recording stores them."""


@dataclass(frozen=True, slots=True, eq=False)
class ArmState:
    """One sample of the arm. The flange is the mechanical flange and does not depend on the active TCP.

    Examples
    --------
    >>> import ftdrivers, time, numpy as np
    >>> state = ftdrivers.ArmState(
    ...     t_host_ns=time.monotonic_ns(),
    ...     t_device_s=0.0,
    ...     q_rad=np.zeros(6),
    ...     qd_rad_s=np.zeros(6),
    ...     R_base_flange=np.eye(3),
    ...     p_base_flange_m=np.zeros(3),
    ... )
    """

    t_host_ns: int
    t_device_s: float
    q_rad: Array
    """(6,) actual joint angles."""
    qd_rad_s: Array
    """(6,) actual joint speeds."""
    R_base_flange: Array
    """(3, 3) maps flange coordinates to base coordinates."""
    p_base_flange_m: Array
    """(3,) position of the flange in base coordinates, m."""


@dataclass(frozen=True, slots=True, eq=False)
class ArmStates(Columns):
    """n consecutive samples of the arm, one row each. The flange does not depend on the active TCP."""

    t_host_ns: NDArray[np.int64]
    """(n,) `Clock.now_ns()` of the driver at receipt."""
    t_device_s: Array
    """(n,) time on the controller's own clock, s. Its epoch differs from that of host time."""
    q_rad: Array
    """(n, 6) actual joint angles."""
    qd_rad_s: Array
    """(n, 6) actual joint speeds."""
    R_base_flange: Array
    """(n, 3, 3) maps flange coordinates to base coordinates."""
    p_base_flange_m: Array
    """(n, 3) position of the flange in base coordinates, m."""

    @classmethod
    def of(cls, states: Sequence[ArmState]) -> Self:
        """Build a block of samples from one or more single states."""
        return cls(*(np.array([getattr(state, name) for state in states]) for name in cls._names()))


@dataclass(frozen=True, slots=True)
class ArmStatus:
    """Modes and settings that a controller reports. A value that it does not report is None."""

    t_host_ns: int
    t_device_s: float
    robot_mode: str
    """Mode of the robot, such as "running", "idle" or "power off"."""
    safety_mode: str
    """Safety mode, such as "normal", "reduced" or "protective stop"."""
    program: str
    """State of the program: "stopped", "playing", "paused", or a transition. The control program of ftdrive counts."""
    fault: DeviceFault | None
    """Reason why the arm may not move, and what the operator must do; None if it may move."""
    speed_slider: float
    """Speed slider, 0 to 1, as set on the pendant or by a program."""
    speed_scaling: float
    """Fraction of the programmed speed that the controller currently allows, 0 to 1."""
    payload_kg: float | None
    """Mass of the payload that is configured in the controller, kg."""
    p_flange_payload_m: tuple[float, ...] | None
    """(3,) centre of mass of the configured payload in flange coordinates, m."""
    tcp_offset: tuple[float, ...] | None
    """(6,) pose of the active TCP in the flange: position in m, then rotation vector in rad."""


@dataclass(frozen=True, slots=True)
class ControllerSettings:
    """Load and gravity that a controller assumes. A value that it does not report is None."""

    mass_kg: float | None = None
    p_flange_com_m: tuple[float, ...] | None = None
    """(3,) centre of mass of all that is mounted on the flange, in flange coordinates, m."""
    inertia_kg_m2: tuple[float, ...] | None = None
    """(6,) Ixx, Iyy, Izz, Ixy, Ixz, Iyz about the centre of mass, in flange axes, kg·m²."""
    up_base_m_s2: tuple[float, ...] | None = None
    """(3,) gravitational acceleration with reversed sign, in base axes: (0, 0, 9.82) on a level floor."""


@dataclass(frozen=True, slots=True)
class Diagnosis:
    """Result of a check that only one driver offers, because only its device has the checked property."""

    name: str
    """Name of the check, such as "registers"."""
    passed: bool
    found: str
    fix: str = ""


class _Device(ABC):
    @abstractmethod
    def open(self) -> None:
        """Connect to the device. Idempotent. Raises `ConnectError` if the device cannot be opened."""

    @abstractmethod
    def close(self) -> None:
        """Disconnect. Idempotent. Never raises if the device was lost."""

    @abstractmethod
    def identify(self) -> DeviceInfo:
        """Return model, serial number and firmware, as read when the device was opened."""

    def diagnose(self) -> list[Diagnosis]:
        """Run the checks that only this driver has, such as the ports of a controller. These checks only read.

        The base method returns an empty list.
        """
        return []

    def __enter__(self) -> Self:
        self.open()
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


class ForceTorqueSensor(_Device):
    """A streaming six-axis force/torque sensor. `StreamingSensor` is the base class of drivers.

    Examples
    --------
    >>> import ftdrive
    >>> with ftdrive.open_sensor("emulated://") as sensor:
    ...     newest = sensor.latest(timeout_s=1.0)
    ...     with sensor.follow() as follow:
    ...         samples = follow.read(timeout_s=1.0)  # every sample since the last read
    >>> newest.wrench.shape
    (1, 6)
    """

    @abstractmethod
    def open(self) -> None:
        """Connect and start the stream. Raises `ConnectError` if that fails.

        Does nothing while the stream runs. Reopens a stream that has ended.
        """

    @abstractmethod
    def collect(self, duration_s: float) -> FtSamples:
        """Return every sample received within `duration_s` seconds from this call.

        If the stream fails meanwhile, `StreamBroken`, `DeviceTimeout` or `DeviceFault` is raised at once, at the latest
        0.5 s after the end. A result never has an undetected interruption.
        """

    @abstractmethod
    def follow(self) -> AbstractContextManager[Follow[FtSamples]]:
        """Read every sample from now on, see `Follow`. There may be any number of followers, in any thread.

        A lost sample is a gap in `seq`. If the driver reconnects, the follower continues with the new samples.
        """

    @abstractmethod
    def latest(self, *, timeout_s: float) -> FtSamples:
        """Return the newest sample (one row). If it is stale, wait up to `timeout_s` for another one."""

    @abstractmethod
    def check(self) -> None:
        """Raise the failure of the stream if it is broken or stale, or if the status of the device is critical."""

    @abstractmethod
    def health(self) -> Health:
        """Return the statistics of the stream since `open`."""

    def temperature_C(self) -> float | None:
        """Return the temperature that came with the newest sample, °C; None if the sensor reports none."""
        return None


class RobotArm(_Device):
    """A six-joint arm. `with arm:` opens it for reading. `ReadOnlyArm` is the base class of drivers that only read.

    Examples
    --------
    >>> import ftdrive
    >>> with ftdrive.open_arm("emulated://") as arm:
    ...     arm.status().safety_mode
    'normal'
    """

    @abstractmethod
    def open(self, *, control: bool = False) -> None:
        """Connect, read-only unless `control` is requested. Idempotent. Raises `ConnectError` if that fails.

        It never stops the program of another client. While one runs on the controller, requesting control raises
        `ConnectError`.
        """

    @abstractmethod
    def state(self) -> ArmState:
        """Read a new, consistent state. Raises `DeviceTimeout` if the controller's clock stands still.

        May be called from any thread, also while `move_to` runs in another thread.
        """

    def follow(self) -> AbstractContextManager[Follow[ArmStates]]:
        """Read every state from now on, see `Follow`. There may be any number of followers, in any thread.

        The base method calls `state()` once per read.
        """

        def read(_: float) -> ArmStates:
            return ArmStates.of([self.state()])

        return nullcontext(Follow(read))

    @abstractmethod
    def status(self) -> ArmStatus:
        """Return the modes and settings of the controller without delay. May be called from any thread at any time.

        Raises `DeviceTimeout` or `StreamBroken` if the newest status is older than 0.1 s, and `ConnectError` if the arm
        is closed.
        """

    def controller_settings(self) -> ControllerSettings:
        """Read the load and the gravity that the controller assumes. Control is not needed.

        The base method returns the values that `status` reports.
        """
        status = self.status()
        return ControllerSettings(status.payload_kg, status.p_flange_payload_m)

    def set_payload(
        self, mass_kg: float, p_flange_com_m: Sequence[float], inertia_kg_m2: Sequence[float] = (0.0,) * 6
    ) -> None:
        """Set the payload in the controller. Needs control and an arm at rest.

        The parameters are those of `ControllerSettings`; an inertia of zeros is a point mass. The base method raises
        `DeviceFault`.
        """
        payload = f"a payload of {mass_kg:g} kg at {[*p_flange_com_m]} m with the inertia {[*inertia_kg_m2]} kg·m²"
        raise DeviceFault(f"the driver of this arm cannot set {payload}", "set it at the controller")

    def set_gravity(self, up_base_m_s2: Sequence[float]) -> None:
        """Set gravity in the controller, see `ControllerSettings`. Needs control. Here, it raises `DeviceFault`."""
        gravity = f"a gravity of {[*up_base_m_s2]} m/s²"
        raise DeviceFault(f"the driver of this arm cannot set {gravity}", "set the mounting at the controller")

    def in_remote_control(self) -> bool | None:
        """Return whether the controller accepts programs from the network; None if it has no such switch."""
        return None

    def reported_program(self) -> str | None:
        """Return the name of the running program; None if the controller does not report it."""
        return None

    @abstractmethod
    def within_safety_limits(self, q_rad: Sequence[float]) -> bool:
        """Ask the controller whether it would accept these joint angles (6,). Needs control."""

    @abstractmethod
    def move_to(
        self,
        q_rad: Sequence[float],
        *,
        timeout_s: float,
        guard: Guard,
        speed_rad_s: float | None = None,
        acceleration_rad_s2: float | None = None,
    ) -> None:
        """Move all joints to `q_rad` (6,) and return when they have arrived.

        Speed and acceleration are those of the leading joint; None selects the values of the constructor. `guard` is
        called at least 20 times per second while the arm moves. An exception of the guard, a fault, the time-out or
        Ctrl-C stops the arm first and is raised afterwards.
        """

    def sweep(self, sweep: Sweep, *, guard: Guard) -> None:
        """Follow a sweep from its first posture, and return when the arm rests there again. Needs control.

        `guard` and exceptions are those of `move_to`. The base method raises `DeviceFault`.
        """
        guard()
        raise DeviceFault(
            f"the driver of this arm cannot follow a sweep of {sweep.duration_s:g} s", "calibrate without --sweep"
        )

    @abstractmethod
    def wait_until_still(self, *, timeout_s: float, guard: Guard) -> None:
        """Return when the joints have been at rest for so long that vibrations of the structure have decayed."""

    @abstractmethod
    def stop(self) -> None:
        """Stop the arm. May be called from any thread at any time. Does nothing without control."""


_REFUSAL: Final = "the driver of this arm only reads it", "move the arm by hand, as calibrate --manual does"


class ReadOnlyArm(RobotArm):
    """An arm that is only read: for a stream, a recording, or a calibration by hand.

    A subclass implements `identify` and `state`, and `open` and `close` if it needs them.

    Examples
    --------
    >>> import ftdrivers, numpy as np
    >>> class Fixed(ftdrivers.ReadOnlyArm):
    ...     def identify(self):
    ...         return ftdrivers.DeviceInfo("bench", "1", "none")
    ...
    ...     def state(self):
    ...         return ftdrivers.ArmState(0, 0.0, np.zeros(6), np.zeros(6), np.eye(3), np.zeros(3))
    >>> with Fixed() as arm:
    ...     print(arm.status().safety_mode)
    not reported
    """

    def open(self, *, control: bool = False) -> None:
        """Do nothing; raise `ConnectError` if control is requested, because this arm is only read."""
        if control:
            raise ConnectError(*_REFUSAL)

    def close(self) -> None:
        """Do nothing."""

    def status(self) -> ArmStatus:
        """Return a status in which no value is reported."""
        state = self.state()
        unknown = NOT_REPORTED, NOT_REPORTED, "stopped"
        return ArmStatus(state.t_host_ns, state.t_device_s, *unknown, None, 1.0, 1.0, None, None, None)

    def within_safety_limits(self, q_rad: Sequence[float]) -> bool:
        """Raise `DeviceFault`."""
        raise DeviceFault(*_REFUSAL)

    def move_to(
        self,
        q_rad: Sequence[float],
        *,
        timeout_s: float,
        guard: Guard,
        speed_rad_s: float | None = None,
        acceleration_rad_s2: float | None = None,
    ) -> None:
        """Raise `DeviceFault`."""
        raise DeviceFault(*_REFUSAL)

    def wait_until_still(self, *, timeout_s: float, guard: Guard) -> None:
        """Raise `DeviceFault`."""
        raise DeviceFault(*_REFUSAL)

    def stop(self) -> None:
        """Do nothing, because this program never moves the arm."""
