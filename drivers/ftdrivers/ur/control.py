"""The interface of a control path, which moves the arm. `UrArm` uses both paths in the same way."""

import logging
from abc import ABC, abstractmethod
from collections.abc import Callable
from math import radians
from typing import Any, Final, Literal

from ftdrivers.errors import ConnectError, DeviceError

log = logging.getLogger(__name__)

ControlPath = Literal["ur-rtde", "script"]
ControlSetting = Literal["auto", "ur-rtde", "script"]
CONTROL_SETTINGS: Final[tuple[ControlSetting, ...]] = ("auto", "ur-rtde", "script")

# The largest deceleration that UR's staff recommend. From 60 °/s the stopping angle is 1.8° smaller than at 4 rad/s².
STOP_RAD_S2: Final = radians(300)
"""Default deceleration of a stop, rad/s². UR's own programs use 2 to 4 rad/s²."""

LookOut = Callable[[], object]
"""Function that is called about 20 times per second during a wait. It raises an error to end the wait."""


class ProgramRefused(ConnectError):
    """The controller did not accept the control program, which therefore does not run."""


class Control(ABC):
    """The control program on the controller, and the connection to it. Methods may be called from any thread.

    A constructor opens connections or starts processes on this computer. The program is started afterwards.
    """

    stops_itself = False
    """Whether the program stops the arm and ends if the connection is lost, which a sweep requires."""

    @property
    @abstractmethod
    def alive(self) -> bool:
        """Whether the control program accepts calls."""

    @property
    def has_ended(self) -> bool:
        """Whether the control program has reported its end. A program that runs afterwards is a different one."""
        return False

    @abstractmethod
    def wait_until_ready(self, look_out: LookOut) -> None:
        """Return when the control program runs on the controller. Raises the exceptions of `call` and `look_out`."""

    @abstractmethod
    def call(self, name: str, *args: object, timeout_s: float | None = None, look_out: LookOut = lambda: None) -> Any:
        """Call one of the methods of `control_child.Calls`. The default time-out is `UrTiming.call_s`.

        Raises `StreamBroken` if the connection was lost or the call failed, and the exceptions of `look_out`. After the
        time-out, the connection is killed and `DeviceTimeout` is raised.
        """

    def quit(self, *, timeout_s: float) -> bool:
        """Stop the arm, end the control program and the connection; return whether that was confirmed in time."""
        try:
            self.call("quit", timeout_s=timeout_s)
        except DeviceError as error:
            log.debug("our program did not end by itself: %s", error)
            return False
        finally:
            self.kill()
        return True

    @abstractmethod
    def kill(self) -> None:
        """End the connection immediately, without waiting for the program. Idempotent."""

    def end_reason(self) -> DeviceError | None:
        """Return the reason why the control program has ended, or None if it is unknown."""
        return None

    def explained(self, error: DeviceError) -> DeviceError:
        """Return the error of a lost controller, completed by a sentence about what the arm does in this case."""
        return error
