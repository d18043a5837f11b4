"""Services of a controller other than RTDE: the dashboard server, or the Robot API of PolyScope X.

Ref: Universal Robots, "Dashboard Server, e-Series" and "Dashboard Server, CB-Series" manuals;
"Robot API" (OpenAPI document of PolyScope X); `dashboard_client_implementation_x.cpp` of
Universal Robots' client library, which lists the first version with each path: `program/v1/state` 10.11,
`system/v1/controlmode` 10.12, `system/v1/information` and `versions/v1` 10.14.
Checked on hardware: no.

Every request runs in a thread of its own, because a request to a dead controller takes seconds.
"""

import json
import re
import socket
import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from http.client import HTTPConnection, HTTPException
from typing import Any, Final, Protocol, TypeVar

from ftdrivers.clock import Clock
from ftdrivers.errors import NoDashboard

DASHBOARD_PORT: Final = 29999
_REPLY_S: Final = 2.5


# The client of ur_rtde is not used, because it does not exist on most platforms.
class _Dashboard:
    """A connection to the dashboard server, see `Services`. Raises `OSError` if it is lost or silent for 2.5 s."""

    def __init__(self, host: str, connect_s: float) -> None:
        self._socket = socket.create_connection((host, DASHBOARD_PORT), timeout=connect_s)
        self._socket.settimeout(_REPLY_S)
        self._lines = self._socket.makefile("r", encoding="utf-8", errors="replace", newline="\n")
        try:
            self._read()  # the server sends a greeting first
        except BaseException:
            self.close()
            raise

    def stop(self) -> None:
        if (reply := self._ask("stop")) != "Stopped":
            raise RuntimeError(reply)

    def model(self) -> str | None:
        """Return the model without its generation, such as UR5; reported since PolyScope 3.12 and 5.6."""
        reply = self._ask("get robot model")
        return reply if reply.startswith("UR") else None

    def serial(self) -> str | None:
        """Return the digits of the serial number; reported since PolyScope 3.12 and 5.6."""
        reply = self._ask("get serial number")
        return reply if reply.isdigit() else None

    def polyscope(self) -> str | None:
        found = re.search(r"\d+(\.\d+)+", self._ask("PolyscopeVersion"))
        return found and found[0]

    def program(self) -> str | None:
        return self._ask("programState") or None

    def in_remote_control(self) -> bool | None:
        """Return whether programs from the network are accepted; reported by the e-Series since 5.6."""
        return {"true": True, "false": False}.get(self._ask("is in remote control").lower())

    def close(self) -> None:
        self._lines.close()
        self._socket.close()

    def _ask(self, command: str) -> str:
        self._socket.sendall(command.encode() + b"\n")
        return self._read()

    def _read(self) -> str:
        line = self._lines.readline()
        if not line.endswith("\n"):
            raise ConnectionError("the server closed the connection")
        return line.strip()


ROBOT_API_PORT: Final = 80
_PATH: Final = "/universal-robots/robot-api"


class _RobotApi:
    """Requests to the Robot API of one controller, see `Services`. Raises `OSError` if it does not answer."""

    def __init__(self, host: str, port: int, connect_s: float) -> None:
        self._connection = HTTPConnection(host, port, timeout=connect_s)
        self._connection.connect()
        self._connection.sock.settimeout(_REPLY_S)

    def stop(self) -> None:
        """Stop the program and the arm, which is refused in local control."""
        self._request("PUT", "/program/v1/state", {"action": "stop"})

    def model(self) -> str | None:
        """Return the model that the Robot API reports, such as UR15."""
        return self._value("/system/v1/information", "robotType")

    def serial(self) -> str | None:
        # PolyScope X reports these since 10.14, the control mode since 10.12.
        return self._value("/system/v1/information", "serialNumber")

    def polyscope(self) -> str | None:
        return self._value("/versions/v1", "marketingVersion")

    def program(self) -> str | None:
        """Return the state of the program, such as PLAYING."""
        return self._value("/program/v1/state", "state")

    def in_remote_control(self) -> bool | None:
        mode = self._value("/system/v1/controlmode", "mode")
        return None if mode is None else mode == "REMOTE"

    def close(self) -> None:
        self._connection.close()

    def _value(self, path: str, key: str) -> str | None:
        answer = self._request("GET", path)
        value = answer.get(key) if isinstance(answer, dict) else None
        return value if isinstance(value, str) and value else None

    def _request(self, method: str, path: str, content: dict[str, str] | None = None) -> Any:
        """Send an HTTP request and return the answer; None if this version of the Robot API lacks the path."""
        body = None if content is None else json.dumps(content)
        try:
            self._connection.request(method, _PATH + path, body, {"Content-Type": "application/json"})
            response = self._connection.getresponse()
            text = response.read().decode("utf-8", "replace")
        except HTTPException as error:
            raise RuntimeError(f"no valid answer to {method} {path} ({type(error).__name__}: {error})") from error
        if response.status == 404 and method == "GET":
            return None
        if not 200 <= response.status < 300:
            raise RuntimeError(f"{method} {path} is refused with status {response.status}: {text[:200]}")
        try:
            return json.loads(text) if text else None
        except ValueError as error:
            raise RuntimeError(f"the answer to {method} {path} is not JSON: {text[:200]}") from error


T = TypeVar("T")

_ENABLE: Final = (
    "enable the dashboard server on the pendant under Settings, Security, Services; if it is, restart the controller"
)
_ENABLE_API: Final = "check the address, and that PolyScope X is 10.11 or later and has finished starting"
POLYSCOPE_X: Final = 10
"""First major version with a Robot API instead of a dashboard server."""


class Services(Protocol):
    """Questions and requests to a controller. An answer is None if this version does not report it.

    A refusal raises RuntimeError with the message of the controller.
    """

    def stop(self) -> None:
        """Stop the program and the arm."""

    def model(self) -> str | None:
        """Return the model. A dashboard server omits the generation: UR5 for a UR5e."""

    def serial(self) -> str | None:
        """Return the serial number."""

    def polyscope(self) -> str | None:
        """Return the version of PolyScope, such as 5.15.0.1261331."""

    def program(self) -> str | None:
        """Return state and name of the program, such as "PLAYING pick.urp"."""

    def in_remote_control(self) -> bool | None:
        """Return whether programs from the network are accepted."""

    def close(self) -> None:
        """Disconnect from the service."""


@dataclass(frozen=True, slots=True)
class ServicesOf:
    """Sends requests to the services of one controller."""

    host: str
    version: tuple[int, int, int, int]
    """Version of the controller, as RTDE reports it."""
    clock: Clock
    api_port: int = ROBOT_API_PORT

    @property
    def name(self) -> str:
        """Name of the service, dashboard server or Robot API, for messages."""
        return "Robot API" if self.has_api else "dashboard server"

    @property
    def has_api(self) -> bool:
        """Whether the controller has a Robot API, as PolyScope X does."""
        return self.version[0] >= POLYSCOPE_X

    def ask(self, question: Callable[[Services], T], *, timeout_s: float, connect_s: float | None = None) -> T:
        """Connect, return the answer to a question, and disconnect.

        Raises `NoDashboard` if there is no server, no answer in time, or a refusal. After `timeout_s` the request
        continues in its thread: it tries to connect for `connect_s` (default `timeout_s`), then waits 2.5 s for each
        answer.
        """
        limit_s = timeout_s if connect_s is None else connect_s

        def session() -> T:
            services: Services = (
                _RobotApi(self.host, self.api_port, limit_s) if self.has_api else _Dashboard(self.host, limit_s)
            )
            try:
                return question(services)
            finally:
                services.close()

        pool = ThreadPoolExecutor(1, "ur-services")  # not a daemon: a requested stop is completed before exit
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
