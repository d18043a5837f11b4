"""The few calls of ur_rtde made in this process, typed, and the way to live with them.

Ref: ur_rtde 1.6.5, API reference; Universal Robots, "Dashboard Server, e-Series" manual.
Checked on hardware: no.

`RTDEControlInterface` is not here: it may hang or crash its process, so it has one of its own (`control_child.py`).
What is here always comes back, but only after up to five seconds when the controller is dead: it runs in threads.
"""

import ctypes
import platform
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from importlib import import_module
from typing import Final, Protocol, TypeVar, cast

from drivers.errors import ConnectError, DriverError, NoDashboard

T = TypeVar("T")

FREQUENCY_HZ: Final = 125.0
"""A quarter of the CPU that 500 Hz costs, and a fault is still seen within 10 ms."""
_NO_DASHBOARD: Final = (
    "enable the dashboard server at the pendant under Settings, Security, Services; restart the controller if it is"
)

_VARIABLES: Final = [  # only names ur_rtde can parse: it would read everything after an unknown one at the wrong place
    "timestamp",
    "target_q",
    "target_qd",
    "actual_q",
    "actual_qd",
    "actual_TCP_pose",
    "robot_mode",
    "safety_status_bits",
    "runtime_state",
]


class Receive(Protocol):
    """What is used of `RTDEReceiveInterface`. After a loss its getters go on to return the last values."""

    def isConnected(self) -> bool:
        """Tell the truth up to 2.5 s late."""

    def getTimestamp(self) -> float:
        """Controller time of the newest sample, s."""

    def getTargetQ(self) -> list[float]:
        """(6,) rad."""

    def getTargetQd(self) -> list[float]:
        """(6,) rad/s."""

    def getActualQ(self) -> list[float]:
        """(6,) rad."""

    def getActualQd(self) -> list[float]:
        """(6,) rad/s."""

    def getActualTCPPose(self) -> list[float]:
        """(6,) m and rotation vector, active TCP in base."""

    def getRobotMode(self) -> int:
        """7 is running."""

    def getSafetyStatusBits(self) -> int:
        """Bit field of the safety system."""

    def getRuntimeState(self) -> int:
        """1 stopped, 2 playing, 4 paused."""

    def disconnect(self) -> None:
        """Take up to 2.7 s when the controller is silent."""


class Dashboard(Protocol):
    """What is used of `DashboardClient`. Every refusal is a RuntimeError with the controller's words."""

    def connect(self, timeout_ms: int) -> None:
        """Connect and read the banner, the latter within 2.5 s."""

    def disconnect(self) -> None:
        """Close the connection."""

    def stop(self) -> None:
        """Stop the program, and the arm with it."""

    def getRobotModel(self) -> str:
        """Model without its generation, such as UR5."""

    def getSerialNumber(self) -> str:
        """Digits."""

    def polyscopeVersion(self) -> str:
        """Such as 5.15.0.1261331."""

    def programState(self) -> str:
        """Such as "PLAYING pick.urp"."""

    def isInRemoteControl(self) -> bool:
        """Whether programs sent over the network are accepted (e-Series from 5.6 on)."""


def require() -> None:
    """Raise `ConnectError` where ur_rtde is not installed."""
    for name in ("rtde_receive", "rtde_control", "dashboard_client"):
        _load(name)


def connect_receive(host: str) -> Receive:
    """Connect to a controller that has just answered over RTDE: a silent one would freeze the interpreter here."""
    try:
        return cast(Receive, _load("rtde_receive").RTDEReceiveInterface(host, FREQUENCY_HZ, _VARIABLES))
    except (RuntimeError, ValueError) as error:
        raise ConnectError(
            f"ur_rtde cannot read from {host}: {error}", "restart the controller if this stays"
        ) from error


def ask_dashboard(host: str, ask: Callable[[Dashboard], T], *, timeout_s: float, connect_s: float | None = None) -> T:
    """Connect to the dashboard server, ask, disconnect. Raises `NoDashboard`.

    What is not done within `timeout_s` goes on in a thread: for `connect_s`, which is `timeout_s` where not given, it
    tries to connect, then it waits 2.5 s for the banner.
    """

    def session() -> T:
        dashboard = cast(Dashboard, _load("dashboard_client").DashboardClient(host))
        dashboard.connect(round(1000 * (timeout_s if connect_s is None else connect_s)))
        try:
            return ask(dashboard)
        finally:
            dashboard.disconnect()

    try:
        return _in_background(session).result(timeout_s)
    except RuntimeError as error:
        raise NoDashboard(f"the dashboard server of {host} says: {str(error).rstrip('.')}", _NO_DASHBOARD) from error
    except DriverError:  # of what was asked; one of them is a TimeoutError too
        raise
    except TimeoutError as error:
        raise NoDashboard(
            f"the dashboard server of {host} did not answer within {timeout_s:.1f} s", _NO_DASHBOARD
        ) from error


def retire(receive: Receive) -> None:
    """Let a connection end by itself, which takes half a second, or three when the controller is silent.

    The object is never destroyed: its destructor would stop the whole interpreter for half a second (measured), long
    enough for a sensor to look dead. What is lost is a few kilobytes for each time an arm is opened.
    """
    ctypes.pythonapi.Py_IncRef(ctypes.py_object(receive))
    _in_background(receive.disconnect)


def _in_background(do: Callable[[], T]) -> "Future[T]":
    pool = ThreadPoolExecutor(1, "ur-rtde")  # not a daemon: leaving the interpreter in the middle of C++ would abort it
    future = pool.submit(do)
    pool.shutdown(wait=False)
    return future


class _Module(Protocol):
    RTDEReceiveInterface: Callable[[str, float, list[str]], object]
    DashboardClient: Callable[[str], object]


def _load(name: str) -> _Module:
    try:
        return cast(_Module, import_module(name))
    except ImportError as error:
        raise ConnectError(
            f"ur_rtde is not installed for Python {platform.python_version()} on {platform.system()} "
            f"{platform.machine()} ({error})",
            "install ftdrive with CPython 3.11 or 3.12 on 64-bit x86 Linux, for which ur_rtde has wheels",
        ) from error
