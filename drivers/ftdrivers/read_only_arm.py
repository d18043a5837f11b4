"""The base of drivers that read an arm and never move it."""

from collections.abc import Sequence
from typing import Final

from ftdrivers.errors import ConnectError, DeviceFault
from ftdrivers.interfaces import NOT_REPORTED, ArmStatus, Guard, RobotArm

_REFUSAL: Final = "the driver of this arm only reads it", "move the arm by hand, as calibrate --manual does"


class ReadOnlyArm(RobotArm):
    """An arm that is read and never moved: for a stream, a recording, or a calibration by hand.

    A subclass implements `identify` and `state`, and what it needs of `open` and `close`.

    Examples
    --------
    >>> import ftdrive, numpy as np
    >>> class Fixed(ftdrive.ReadOnlyArm):
    ...     def identify(self):
    ...         return ftdrive.DeviceInfo("bench", "1", "none")
    ...
    ...     def state(self):
    ...         return ftdrive.ArmState(0, 0.0, np.zeros(6), np.zeros(6), np.eye(3), np.zeros(3))
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
