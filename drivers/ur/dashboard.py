"""Questions and requests to the dashboard server, through ur_rtde's `DashboardClient`.

Ref: ur_rtde 1.6.5, API reference; Universal Robots, "Dashboard Server, e-Series" manual.
Checked on hardware: no.

A call of `DashboardClient` takes up to 5 s when the controller is dead. So every request runs in its own thread.
"""

import platform
import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from importlib import import_module
from typing import Final, Protocol, TypeVar, cast

from drivers.clock import REAL, Clock
from drivers.errors import ConnectError, NoDashboard

T = TypeVar("T")

_NO_DASHBOARD: Final = (
    "enable the dashboard server at the pendant under Settings, Security, Services; if it is, restart the controller"
)


class Dashboard(Protocol):
    """The used part of `DashboardClient`. Every refusal is a RuntimeError with the controller's message."""

    def connect(self, timeout_ms: int) -> None:
        """Connect and read the banner, the latter within 2.5 s."""

    def disconnect(self) -> None:
        """Close the connection."""

    def stop(self) -> None:
        """Stop the program, and the arm with it."""

    def getRobotModel(self) -> str:
        """Return the model without its generation, such as UR5."""

    def getSerialNumber(self) -> str:
        """Return the serial number, in digits."""

    def polyscopeVersion(self) -> str:
        """Return the version, such as 5.15.0.1261331."""

    def programState(self) -> str:
        """Return state and name, such as "PLAYING pick.urp"."""

    def isInRemoteControl(self) -> bool:
        """Return whether programs sent over the network are accepted (e-Series from 5.6 on)."""


def ask_dashboard(
    host: str,
    ask: Callable[[Dashboard], T],
    *,
    timeout_s: float,
    connect_s: float | None = None,
    clock: Clock = REAL,
) -> T:
    """Connect to the dashboard server, ask, disconnect.

    After `timeout_s` the request continues in its thread: it tries to connect for `connect_s` (default `timeout_s`),
    then it waits 2.5 s for the banner.

    Raises
    ------
    NoDashboard
        No server, no answer in time, or a refusal.
    ConnectError
        ur_rtde is not installed.
    """
    client = _client()

    def session() -> T:
        dashboard = client(host)
        dashboard.connect(round(1000 * (timeout_s if connect_s is None else connect_s)))
        try:
            return ask(dashboard)
        finally:
            dashboard.disconnect()

    pool = ThreadPoolExecutor(1, "ur-dashboard")  # no daemon: an exit of the interpreter during C++ code would abort
    answered = threading.Event()
    future = pool.submit(session)
    future.add_done_callback(lambda _: answered.set())
    pool.shutdown(wait=False)
    if not clock.wait(answered, timeout_s):
        raise NoDashboard(f"the dashboard server of {host} did not answer within {timeout_s:.1f} s", _NO_DASHBOARD)
    try:
        return future.result()
    except RuntimeError as error:
        raise NoDashboard(f"the dashboard server of {host} reports: {str(error).rstrip('.')}", _NO_DASHBOARD) from error


def _client() -> Callable[[str], Dashboard]:
    try:
        return cast(Callable[[str], Dashboard], import_module("dashboard_client").DashboardClient)
    except ImportError as error:
        raise ConnectError(
            f"ur_rtde is not installed for Python {platform.python_version()} on {platform.system()} "
            f"{platform.machine()} ({error})",
            "install ftdrive with CPython 3.11 or 3.12 on 64-bit x86 Linux, for which ur_rtde has wheels",
        ) from error
