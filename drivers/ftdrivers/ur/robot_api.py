"""The Robot API of PolyScope X: requests over HTTP, in place of the dashboard server.

Ref: Universal Robots, "Robot API" (OpenAPI document of PolyScope X); `dashboard_client_implementation_x.cpp` of
Universal Robots' client library, which lists since when there is each path: `program/v1/state` 10.11,
`system/v1/controlmode` 10.12, `system/v1/information` and `versions/v1` 10.14.
Checked on hardware: no.
"""

import json
from http.client import HTTPConnection, HTTPException
from typing import Any, Final

PORT: Final = 80
_PATH: Final = "/universal-robots/robot-api"
_REPLY_S: Final = 2.5


class RobotApi:
    """Requests to one controller; see `services.Services`. Raises `OSError` when it does not answer."""

    def __init__(self, host: str, port: int, connect_s: float) -> None:
        self._connection = HTTPConnection(host, port, timeout=connect_s)
        self._connection.connect()
        self._connection.sock.settimeout(_REPLY_S)

    def stop(self) -> None:
        """Stop the program, and the arm with it; refused in local control."""
        self._request("PUT", "/program/v1/state", {"action": "stop"})

    def model(self) -> str | None:
        """Return the model, such as UR15."""
        return self._value("/system/v1/information", "robotType")

    def serial(self) -> str | None:
        """Return the serial number."""
        return self._value("/system/v1/information", "serialNumber")

    def polyscope(self) -> str | None:
        """Return the version."""
        return self._value("/versions/v1", "marketingVersion")

    def program(self) -> str | None:
        """Return the state of the program, such as PLAYING."""
        return self._value("/program/v1/state", "state")

    def in_remote_control(self) -> bool | None:
        """Return whether programs sent over the network are accepted."""
        mode = self._value("/system/v1/controlmode", "mode")
        return None if mode is None else mode == "REMOTE"

    def close(self) -> None:
        """Disconnect."""
        self._connection.close()

    def _value(self, path: str, key: str) -> str | None:
        answer = self._request("GET", path)
        value = answer.get(key) if isinstance(answer, dict) else None
        return value if isinstance(value, str) and value else None

    def _request(self, method: str, path: str, content: dict[str, str] | None = None) -> Any:
        """Return the answer; None for a path that this version does not have."""
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
            raise RuntimeError(f"the answer to {method} {path} is no JSON: {text[:200]}") from error
