"""What a controller answers beside RTDE: its dashboard server, or the Robot API of PolyScope X.

A call to a dead controller takes seconds. So every request runs in its own thread.
"""

import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Final, Protocol, TypeVar

from ftdrivers.clock import Clock
from ftdrivers.errors import NoDashboard
from ftdrivers.ur.dashboard import Dashboard
from ftdrivers.ur.robot_api import PORT, RobotApi

T = TypeVar("T")

_ENABLE: Final = (
    "enable the dashboard server at the pendant under Settings, Security, Services; if it is, restart the controller"
)
_ENABLE_API: Final = "check the address, and that PolyScope X is 10.11 or later and has finished starting"
POLYSCOPE_X: Final = 10
"""The first major version that has a Robot API in place of a dashboard server."""


class Services(Protocol):
    """Questions and requests. None where this version of the controller does not report it.

    Every refusal is a RuntimeError with the controller's message.
    """

    def stop(self) -> None:
        """Stop the program, and the arm with it."""

    def model(self) -> str | None:
        """Return the model; a dashboard server leaves out the generation, such as UR5."""

    def serial(self) -> str | None:
        """Return the serial number."""

    def polyscope(self) -> str | None:
        """Return the version, such as 5.15.0.1261331."""

    def program(self) -> str | None:
        """Return state and name, such as "PLAYING pick.urp"."""

    def in_remote_control(self) -> bool | None:
        """Return whether programs sent over the network are accepted."""

    def close(self) -> None:
        """Disconnect."""


@dataclass(frozen=True, slots=True)
class ServicesOf:
    """Asks the services of one controller."""

    host: str
    version: tuple[int, int, int, int]
    """As RTDE reports it."""
    clock: Clock
    api_port: int = PORT

    @property
    def name(self) -> str:
        """In words."""
        return "Robot API" if self.has_api else "dashboard server"

    @property
    def has_api(self) -> bool:
        """Whether the controller is one of PolyScope X."""
        return self.version[0] >= POLYSCOPE_X

    def ask(self, question: Callable[[Services], T], *, timeout_s: float, connect_s: float | None = None) -> T:
        """Connect, ask, disconnect.

        After `timeout_s` the request continues in its thread: it tries to connect for `connect_s` (default
        `timeout_s`), then it waits 2.5 s for each answer. Raises `NoDashboard` where there is no server, no answer in
        time, or a refusal.
        """
        limit_s = timeout_s if connect_s is None else connect_s

        def session() -> T:
            services: Services = (
                RobotApi(self.host, self.api_port, limit_s) if self.has_api else Dashboard(self.host, limit_s)
            )
            try:
                return question(services)
            finally:
                services.close()

        pool = ThreadPoolExecutor(1, "ur-services")  # no daemon: an exit of the interpreter still stops the arm
        answered = threading.Event()
        future = pool.submit(session)
        future.add_done_callback(lambda _: answered.set())
        pool.shutdown(wait=False)
        fix = _ENABLE_API if self.has_api else _ENABLE
        if not self.clock.wait(answered, timeout_s):
            raise NoDashboard(f"the {self.name} of {self.host} did not answer within {timeout_s:.1f} s", fix)
        try:
            return future.result()
        except (RuntimeError, OSError) as error:
            raise NoDashboard(f"the {self.name} of {self.host} reports: {error}", fix) from error
