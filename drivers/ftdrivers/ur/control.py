"""A control path: what moves the arm. `UrArm` does not know which one is in use."""

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

# 300 °/s² is the most that UR's staff recommend for a joint; from 60 °/s the arm turns 1.8° less than at 4 rad/s².
STOP_RAD_S2: Final = radians(300)
"""Default deceleration of a stop. UR's own programs stop with 2 to 4."""

LookOut = Callable[[], object]
"""Called about 20 times a second during a wait; may raise."""


class ProgramRefused(ConnectError):
    """The controller did not take our program, so none of ours runs there."""


class Control(ABC):
    """A program of ours on the controller, and the link to it. Any thread may call.

    A constructor connects or starts what is needed on this computer. It returns before a program can run.
    """

    stops_itself = False
    """Whether the program stops the arm and ends when the link is lost. Only such a program follows a sweep."""

    @property
    @abstractmethod
    def alive(self) -> bool:
        """Whether it accepts calls."""

    @property
    def has_ended(self) -> bool:
        """Whether our program has reported its end, so that a program on the controller is not ours."""
        return False

    @abstractmethod
    def wait_until_ready(self, look_out: LookOut) -> None:
        """Return when our program runs on the controller. Raises what `call` and `look_out` raise."""

    @abstractmethod
    def call(self, name: str, *args: object, timeout_s: float | None = None, look_out: LookOut = lambda: None) -> Any:
        """Call one of the methods of `control_child.Calls`, within `call_s` of the timing if no time-out is given.

        Raises `StreamBroken` when the link is gone or the call failed, `DeviceTimeout` after `kill` of a link that
        hangs, and the errors of `look_out`.
        """

    def quit(self, *, timeout_s: float) -> bool:
        """Stop the arm, end our program and the link; return whether that was confirmed in time."""
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
        """End the link at once, whatever the program does. Idempotent."""

    def end_reason(self) -> DeviceError | None:
        """Return why our program has ended, if that is known."""
        return None

    def explained(self, error: DeviceError) -> DeviceError:
        """Return the error of a lost controller, with what the arm does about it."""
        return error
