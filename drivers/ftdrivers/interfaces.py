"""The two devices of a cell: an arm and a wrist force/torque sensor.

A constructor only stores the configuration. `open` connects to the device. `close` is safe at any time, twice, and
after the device is gone. Every wait has a time-out. Stale data is an error and is never returned.
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
"""Called between two samples of the arm; raises when the motion must not go on."""


NOT_REPORTED: Final = "not reported"
"""Stands for a serial number or a firmware version that a device does not report."""
WRIST_SENSOR: Final = "UR e-Series wrist sensor (ft_raw_wrench)"
"""Model of the sensor in the wrist of an arm, which feels the friction of the last joint."""


@dataclass(frozen=True, slots=True)
class Fact:
    """A property of a device, and its source."""

    value: float | str | tuple[float, ...]
    source: Literal["device", "documented", "configured", "assumed"]
    """Reported by the device, fixed by its manual, set by the user, or assumed: check it."""


@dataclass(frozen=True, slots=True)
class DeviceInfo:
    """What a device reports about itself, and what is known about it otherwise.

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
    """Of a sensor, as far as known: `serial`; `counts_per_N` and `counts_per_Nm`, the scale of the device's numbers;
    `range`, (6,) the largest force in N and torque in N·m on each axis, in both directions; `sign`, 1 or -1;
    `software_bias`, which the device subtracts, in its own unit; `tool_transformation` of the device, which the driver
    undoes; `zero`, "arbitrary" where it is. Of an arm: `control`, by what it is moved and why; `kinematics`, theta, a,
    d and alpha (24,) of its joints, as measured."""

    @property
    def has_arbitrary_zero(self) -> bool:
        """Whether a sensor without load may read anything, so that its range holds for changes of the reading."""
        return "zero" in self.facts


class Columns:
    """n consecutive samples, one array for each quantity, one row for each sample."""

    __slots__ = ()
    # Fields that are no arrays by rows: one value for all of them, and of joined blocks that of the last.
    _COMMON: ClassVar[frozenset[str]] = frozenset()
    t_host_ns: NDArray[np.int64]

    def __len__(self) -> int:
        """Count the rows."""
        return len(self.t_host_ns)

    def columns(self) -> dict[str, Any]:
        """Return the fields, for samples that have further ones."""
        return {name: getattr(self, name) for name in self._names()}

    @classmethod
    def concatenate(cls, blocks: Sequence[Self]) -> Self:
        """Join blocks in the order given."""
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
        """Select samples."""
        return type(self)(
            *(getattr(self, name) if name in self._COMMON else getattr(self, name)[which] for name in self._names())
        )

    @classmethod
    @cache  # `fields` takes longer than the rest
    def _names(cls) -> tuple[str, ...]:
        return tuple(column.name for column in fields(cls))  # type: ignore[arg-type]  # every subclass is a dataclass


@dataclass(frozen=True, slots=True, eq=False)
class FtSamples(Columns):
    """n consecutive samples of one sensor, one row each, as measured: no bias, tare or filter applied.

    The wrench is exerted on the sensor by what hangs on it or pushes on it, in the sensor frame, about its origin.

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
    """(n,) the device's own clock, own epoch; NaN where it has none. Never subtract it from host time."""
    seq: NDArray[np.int64]
    """(n,) numbers every sample that the device sent or was polled for, so that gaps are visible."""
    counts: NDArray[np.int32]
    """(n, k) raw device counts; k = 0 where the device reports physical units."""
    wrench: Array
    """(n, 6) force in N, then torque in N·m."""
    status: NDArray[np.uint32]
    """(n,) the vendor's status word."""

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
        """Build n samples from `wrench` (n, 6). Where all rows share a value, it may be a single number."""
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
    """Counters of a stream since it was opened."""

    received: int
    lost: int
    """Samples that the device sent or was polled for and that never arrived, or arrived too late."""
    malformed: int
    """Frames that arrived damaged and were dropped."""
    rate_Hz: float
    """Mean rate over the last second."""
    age_s: float
    """Time since the newest sample."""
    duplicated: int = 0
    """Frames or samples that arrived twice; one of them was kept."""
    out_of_order: int = 0
    """Samples that arrived after a newer one and were dropped; `lost` counts them too."""
    stale: int = 0
    """Silences longer than the stream allows, after which samples came again; also while the driver did not read."""
    reconnects: int = 0
    """Interruptions after which the driver reconnected by itself; only with `recover`."""
    nominal_rate_Hz: float = math.nan
    """The rate that the device reports or its manual fixes; NaN where unknown."""
    events: tuple[tuple[int, str], ...] = ()
    """(`t_host_ns`, what happened): interruptions, reconnections, pauses of the reader, late samples, start and end of
    a wrong rate. A recording stores them."""


@dataclass(frozen=True, slots=True, eq=False)
class ArmState:
    """One sample of the arm. The flange is the mechanical flange, whatever TCP is active.

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
    """(3,)"""


@dataclass(frozen=True, slots=True, eq=False)
class ArmStates(Columns):
    """n consecutive samples of the arm, one row each. The flange is the mechanical flange, whatever TCP is active."""

    t_host_ns: NDArray[np.int64]
    """(n,) `Clock.now_ns()` of the driver at receipt."""
    t_device_s: Array
    """(n,) the controller's own clock, own epoch. Never subtract it from host time."""
    q_rad: Array
    """(n, 6) actual joint angles."""
    qd_rad_s: Array
    """(n, 6) actual joint speeds."""
    R_base_flange: Array
    """(n, 3, 3) maps flange coordinates to base coordinates."""
    p_base_flange_m: Array
    """(n, 3)"""

    @classmethod
    def of(cls, states: Sequence[ArmState]) -> Self:
        """Join at least one state."""
        return cls(*(np.array([getattr(state, name) for state in states]) for name in cls._names()))


@dataclass(frozen=True, slots=True)
class ArmStatus:
    """What a controller reports about itself in one sample. None where it does not report a value."""

    t_host_ns: int
    t_device_s: float
    robot_mode: str
    """Such as "running", "idle", "power off"."""
    safety_mode: str
    """Such as "normal", "reduced", "protective stop"."""
    program: str
    """"stopped", "playing", "paused", or a transition to one of them. Our control program plays too."""
    fault: DeviceFault | None
    """Why the arm may not move, and what the operator has to do; None where it may. Returned, not raised."""
    speed_slider: float
    """0 to 1, as set at the pendant or by a program."""
    speed_scaling: float
    """0 to 1, the fraction of the programmed speed that the controller allows now."""
    payload_kg: float | None
    """The payload that is configured in the controller."""
    p_flange_payload_m: tuple[float, ...] | None
    """(3,) centre of mass of that payload."""
    tcp_offset: tuple[float, ...] | None
    """(6,) active TCP in the flange: m, then a rotation vector in rad."""


@dataclass(frozen=True, slots=True)
class ControllerSettings:
    """What a controller assumes about its load and about gravity. None where it does not report a value."""

    mass_kg: float | None = None
    p_flange_com_m: tuple[float, ...] | None = None
    """(3,) centre of mass of everything below the flange."""
    inertia_kg_m2: tuple[float, ...] | None = None
    """(6,) Ixx, Iyy, Izz, Ixy, Ixz, Iyz about the centre of mass, along the flange axes."""
    up_base_m_s2: tuple[float, ...] | None = None
    """(3,) acceleration away from the earth, in base axes: (0, 0, 9.82) on a level floor."""


@dataclass(frozen=True, slots=True)
class Diagnosis:
    """A check that a driver makes of its own device, beyond what every device of its kind reports."""

    name: str
    """What was checked, such as "registers"."""
    passed: bool
    found: str
    fix: str = ""


class _Device(ABC):
    @abstractmethod
    def open(self) -> None:
        """Connect. Idempotent. Raises `ConnectError`."""

    @abstractmethod
    def close(self) -> None:
        """Disconnect. Idempotent; never raises on a lost device."""

    @abstractmethod
    def identify(self) -> DeviceInfo:
        """Return model, serial number and firmware, as read when the device was opened."""

    def diagnose(self) -> list[Diagnosis]:
        """Check what only this kind of device has and a program needs, such as the ports of a controller.

        Only reads. The default has nothing to check.
        """
        return []

    def __enter__(self) -> Self:
        self.open()
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


class ForceTorqueSensor(_Device):
    """A streaming six-axis force/torque sensor. `StreamingSensor` is the base of a driver.

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
        """Connect and start the stream. Raises `ConnectError`.

        Does nothing while there is a stream; reopens one that has ended.
        """

    @abstractmethod
    def collect(self, duration_s: float) -> FtSamples:
        """Return every sample received in the `duration_s` seconds that begin with this call.

        Raises `StreamBroken`, `DeviceTimeout` or `DeviceFault` as soon as the stream fails, at most 0.5 s after the
        end. A result never has missing time.
        """

    @abstractmethod
    def follow(self) -> AbstractContextManager[Follow[FtSamples]]:
        """Read every sample from now on; see `Follow`. Any number of followers, each from any thread.

        A lost sample is a gap in `seq`. After the stream has reconnected by itself, the same follower reads on.
        """

    @abstractmethod
    def latest(self, *, timeout_s: float) -> FtSamples:
        """Return the newest sample (one row); wait up to `timeout_s` for one that is not stale."""

    @abstractmethod
    def check(self) -> None:
        """Raise the stream's failure, if it has one: broken, stale, or a critical device status."""

    @abstractmethod
    def health(self) -> Health:
        """Return the counters since `open`."""

    def temperature_C(self) -> float | None:
        """Return the sensor's temperature, as it came with its newest sample; None where a sensor reports none."""
        return None


class RobotArm(_Device):
    """A six-joint arm. `with arm:` opens it for reading. `ReadOnlyArm` is the base of a driver that only reads.

    Examples
    --------
    >>> import ftdrive
    >>> with ftdrive.open_arm("emulated://") as arm:
    ...     arm.status().safety_mode
    'normal'
    """

    @abstractmethod
    def open(self, *, control: bool = False) -> None:
        """Connect, read-only unless `control` is requested. Idempotent. Raises `ConnectError`.

        It never stops a program of another client: while one is on the controller, taking control is a `ConnectError`.
        """

    @abstractmethod
    def state(self) -> ArmState:
        """Read a new, consistent state; raises `DeviceTimeout` when the controller's clock stands still.

        From any thread, also while `move_to` runs in another.
        """

    def follow(self) -> AbstractContextManager[Follow[ArmStates]]:
        """Read every state from now on; see `Follow`. Any number of followers, each from any thread.

        The default calls `state()` once a read, so its rate is that of the reads.
        """

        def read(_: float) -> ArmStates:
            return ArmStates.of([self.state()])

        return nullcontext(Follow(read))

    @abstractmethod
    def status(self) -> ArmStatus:
        """Return the controller's modes and settings. Quick; from any thread, whatever the arm does in another.

        Never older than 0.1 s; otherwise raises `DeviceTimeout` or `StreamBroken`. Raises `ConnectError` while closed.
        """

    def controller_settings(self) -> ControllerSettings:
        """Read the load and the gravity that the controller assumes. Needs no control.

        The default knows what `status` reports.
        """
        status = self.status()
        return ControllerSettings(status.payload_kg, status.p_flange_payload_m)

    def set_payload(
        self, mass_kg: float, p_flange_com_m: Sequence[float], inertia_kg_m2: Sequence[float] = (0.0,) * 6
    ) -> None:
        """Set the payload in the controller; read it back with `controller_settings`. Needs control and an arm at rest.

        Parameters as in `ControllerSettings`; an inertia of zeros is a point mass. The default raises `DeviceFault`.
        """
        payload = f"a payload of {mass_kg:g} kg at {[*p_flange_com_m]} m with the inertia {[*inertia_kg_m2]} kg·m²"
        raise DeviceFault(f"the driver of this arm cannot set {payload}", "set it at the controller")

    def set_gravity(self, up_base_m_s2: Sequence[float]) -> None:
        """Set the direction of gravity in the controller, as in `ControllerSettings`; otherwise as `set_payload`."""
        gravity = f"a gravity of {[*up_base_m_s2]} m/s²"
        raise DeviceFault(f"the driver of this arm cannot set {gravity}", "set the mounting at the controller")

    def in_remote_control(self) -> bool | None:
        """Return whether the controller accepts programs from the network; None where it has no such switch."""
        return None

    def reported_program(self) -> str | None:
        """Return the program that runs, as the controller reports it; None where it does not."""
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

        Speed and acceleration are those of the leading joint; None takes those of the constructor. `guard` is called at
        least 20 times a second while the arm moves. Whatever ends the wait early (an exception of the guard, a fault,
        the time-out, Ctrl-C) stops the arm first and is raised afterwards.
        """

    def sweep(self, sweep: Sweep, *, guard: Guard) -> None:
        """Follow a sweep from the posture where it begins, and return when the arm stands there again. Needs control.

        `guard` and early ends as in `move_to`. The default raises `DeviceFault`.
        """
        guard()
        raise DeviceFault(
            f"the driver of this arm cannot follow a sweep of {sweep.duration_s:g} s", "calibrate without --sweep"
        )

    @abstractmethod
    def wait_until_still(self, *, timeout_s: float, guard: Guard) -> None:
        """Return when the joints have been at rest long enough for the structure to stop ringing."""

    @abstractmethod
    def stop(self) -> None:
        """Stop the arm. From any thread, at any time; does nothing without control."""


_REFUSAL: Final = "the driver of this arm only reads it", "move the arm by hand, as calibrate --manual does"


class ReadOnlyArm(RobotArm):
    """An arm that is read and never moved: for a stream, a recording, or a calibration by hand.

    A subclass implements `identify` and `state`, and what it needs of `open` and `close`.

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
        """Do nothing; raises `ConnectError` if control is requested."""
        if control:
            raise ConnectError(*_REFUSAL)

    def close(self) -> None:
        """Do nothing."""

    def status(self) -> ArmStatus:
        """Return what is known of an arm that reports only its state."""
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
