"""The two things a cell has: an arm and a wrist force/torque sensor.

Constructors only store configuration; `open` talks to the device and `close` is safe at any time, twice, and after the
device is gone. Every wait has a time-out. An old value is never returned: stale data is an error.
"""

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Final, Literal, Self

import numpy as np
from numpy.typing import NDArray

from drivers.errors import DeviceFault

Array = NDArray[np.float64]

Guard = Callable[[], None]
"""Called between two looks at the arm; raises when the motion must not go on."""


NOT_REPORTED: Final = "not reported"
"""What stands for a serial number or a firmware version that a device does not tell."""


@dataclass(frozen=True, slots=True)
class Fact:
    """Something known about a device, and from where."""

    value: float | str | tuple[float, ...]
    source: Literal["device", "documented", "configured", "assumed"]
    """Told by the device, fixed by its manual, given by the user, or none of these: to be checked."""


@dataclass(frozen=True, slots=True)
class DeviceInfo:
    """Who a device says it is, and what is known of it."""

    model: str
    serial: str
    firmware: str
    facts: dict[str, Fact] = field(default_factory=dict)
    """Of a sensor: `serial`; `counts_per_N` and `counts_per_Nm`, the scale of the device's own numbers; `range`, (6,)
    the largest force in N and torque in N·m on each axis of the sensor, either way; `sign`, 1 or -1. What is not known
    is not there."""


@dataclass(frozen=True, slots=True, eq=False)
class FtSamples:
    """n consecutive samples of one sensor, one row each, as measured: no bias, tare or filter applied.

    The wrench is exerted on the sensor by what hangs on it or pushes on it, in the sensor frame, about its origin.
    """

    t_host_ns: NDArray[np.int64]
    """(n,) `Clock.now_ns()` of the driver at receipt."""
    t_device_s: Array
    """(n,) the device's own clock, own epoch; NaN where it has none. Never subtract it from host time."""
    seq: NDArray[np.int64]
    """(n,) counts every sample the device sent or was asked for, so that gaps are visible."""
    counts: NDArray[np.int32]
    """(n, k) raw device counts; k = 0 where the device reports physical units."""
    wrench: Array
    """(n, 6) force in N, then torque in N·m."""
    status: NDArray[np.uint32]
    """(n,) the vendor's status word."""

    def __len__(self) -> int:
        """Count the rows."""
        return len(self.t_host_ns)

    @classmethod
    def concatenate(cls, blocks: Sequence["FtSamples"]) -> "FtSamples":
        """Join blocks in the order given."""
        return cls(
            *(
                np.concatenate([getattr(block, name) for block in blocks])
                for name in ("t_host_ns", "t_device_s", "seq", "counts", "wrench", "status")
            )
        )


@dataclass(frozen=True, slots=True)
class Health:
    """What a stream has been through since it was opened."""

    received: int
    lost: int
    """Samples the device sent, or was asked for, that never arrived, or too late to be new."""
    malformed: int
    """Frames that arrived damaged and were thrown away."""
    rate_Hz: float
    """Over the last second."""
    age_s: float
    """Since the newest sample."""
    duplicated: int = 0
    """Frames or samples that came twice; one of them was kept."""
    out_of_order: int = 0
    """Samples that came after a newer one and were thrown away; `lost` counts them too."""
    stale: int = 0
    """Silences longer than the stream allows, also while nobody read, after which samples came again."""
    reconnects: int = 0
    """Interruptions the driver has mended by itself; only where `recover` was asked for."""
    nominal_rate_Hz: float = math.nan
    """What the device says or documents about its rate; NaN where it does not."""
    events: tuple[tuple[int, str], ...] = ()
    """(`t_host_ns`, what happened): interruptions, reconnections, pauses in which nobody read, late samples, a wrong
    rate and when it was right again. A recording stores them."""


@dataclass(frozen=True, slots=True, eq=False)
class ArmState:
    """One look at the arm. The flange is the mechanical flange, whatever TCP is active."""

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


@dataclass(frozen=True, slots=True)
class ArmStatus:
    """What a controller says of itself, all in one moment. None where this controller does not tell."""

    t_host_ns: int
    t_device_s: float
    robot_mode: str
    """Such as "running", "idle", "power off"."""
    safety_mode: str
    """Such as "normal", "reduced", "protective stop"."""
    program: str
    """"stopped", "playing", "paused", or on the way to one of them; ours plays too while the arm is controlled."""
    fault: DeviceFault | None
    """Why the arm may not move, and what the operator has to do; None when nothing forbids it. Told, not raised."""
    speed_slider: float
    """0 to 1, as set at the pendant or by a program."""
    speed_scaling: float
    """0 to 1, how much of the programmed speed the controller allows at this moment."""
    payload_kg: float | None
    """What the controller was told to hang on the flange."""
    p_flange_payload_m: tuple[float, ...] | None
    """(3,) centre of mass of that payload."""
    tcp_offset: tuple[float, ...] | None
    """(6,) active TCP in the flange: m, then a rotation vector in rad."""


@dataclass(frozen=True, slots=True)
class Finding:
    """A check that a driver makes of its own device, beyond what every device of its kind reports."""

    name: str
    """What was checked, such as "registers"."""
    passed: bool
    found: str
    fix: str = ""


class _Device(ABC):
    @abstractmethod
    def close(self) -> None:
        """Let the device go. Idempotent; never raises on a lost device."""

    @abstractmethod
    def identify(self) -> DeviceInfo:
        """Tell model, serial number and firmware, as read when the device was opened."""


class ForceTorqueSensor(_Device):
    """A streaming six-axis force/torque sensor."""

    @abstractmethod
    def open(self) -> None:
        """Connect and start the stream. Raises `ConnectError`.

        Does nothing while there is a stream; opens one that has ended anew.
        """

    @abstractmethod
    def collect(self, duration_s: float) -> FtSamples:
        """Every sample received in the `duration_s` seconds that begin with this call.

        Raises `StreamBroken`, `DeviceTimeout` or `DeviceFault` as soon as the stream fails, never later than half a
        second after the end; never a result with missing time.
        """

    @abstractmethod
    def latest(self, *, timeout_s: float) -> FtSamples:
        """The newest sample (one row), waiting up to `timeout_s` for one that is fresh. Never an old value."""

    @abstractmethod
    def check(self) -> None:
        """Raise the stream's failure, if it has one: broken, silent for too long, or a critical device status."""

    @abstractmethod
    def health(self) -> Health:
        """Counters since `open`."""

    def __enter__(self) -> Self:
        self.open()
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


class RobotArm(_Device):
    """A six-joint arm."""

    @abstractmethod
    def open(self, *, control: bool = False) -> None:
        """Connect, read-only unless `control` is asked for. Idempotent. Raises `ConnectError`.

        Taking control ends no program that somebody else has on the controller: that is a `ConnectError`.
        """

    @abstractmethod
    def state(self) -> ArmState:
        """Read a fresh, consistent state; raises `DeviceTimeout` when the controller's clock stands still.

        From any thread, also while `move_to` runs in another.
        """

    @abstractmethod
    def status(self) -> ArmStatus:
        """Tell the controller's modes and settings. Quick; from any thread, whatever else the arm does in another.

        Never older than the last tenth of a second; raises `DeviceTimeout` or `StreamBroken` instead, `ConnectError`
        while it is not open.
        """

    def in_remote_control(self) -> bool | None:
        """Whether the controller takes programs from the network; None where there is no such switch."""
        return None

    def reported_program(self) -> str | None:
        """What the controller calls the program it runs, in its own words; None where it does not tell."""
        return None

    def diagnose(self) -> list[Finding]:
        """Check what only this kind of controller has and a program needs, such as its ports.

        Only reads. Errors become findings. The default has nothing to check.
        """
        return []

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

        Speed and acceleration are those of the leading joint; None takes what was given at construction.
        `guard` is called at least 20 times a second while the arm moves. Whatever ends the wait early (an exception
        of the guard, a fault, the time-out, Ctrl-C) stops the arm first and is raised after.
        """

    @abstractmethod
    def wait_until_still(self, *, timeout_s: float, guard: Guard) -> None:
        """Return when the joints have been at rest long enough for the structure to stop ringing."""

    @abstractmethod
    def stop(self) -> None:
        """Stop the arm. From any thread, any time; does nothing without control."""
