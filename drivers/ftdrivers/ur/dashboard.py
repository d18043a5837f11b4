"""The dashboard server: lines of text on port 29999.

Ref: Universal Robots, "Dashboard Server, e-Series" and "Dashboard Server, CB-Series" manuals.
Checked on hardware: no.
"""

import re
import socket
from typing import Final

PORT: Final = 29999
_REPLY_S: Final = 2.5


class Dashboard:
    """One connection; see `services.Services`. Raises `OSError` when it is lost or silent for 2.5 s."""

    def __init__(self, host: str, connect_s: float) -> None:
        self._socket = socket.create_connection((host, PORT), timeout=connect_s)
        self._socket.settimeout(_REPLY_S)
        self._lines = self._socket.makefile("r", encoding="utf-8", errors="replace", newline="\n")
        try:
            self._read()  # a line of greeting
        except BaseException:
            self.close()
            raise

    def stop(self) -> None:
        """Stop the program, and the arm with it."""
        if (reply := self._ask("stop")) != "Stopped":
            raise RuntimeError(reply)

    def model(self) -> str | None:
        """Return the model without its generation, such as UR5; from PolyScope 3.12 and 5.6 on."""
        reply = self._ask("get robot model")
        return reply if reply.startswith("UR") else None

    def serial(self) -> str | None:
        """Return the serial number, in digits; from PolyScope 3.12 and 5.6 on."""
        reply = self._ask("get serial number")
        return reply if reply.isdigit() else None

    def polyscope(self) -> str | None:
        """Return the version, such as 5.15.0.1261331."""
        found = re.search(r"\d+(\.\d+)+", self._ask("PolyscopeVersion"))
        return found and found[0]

    def program(self) -> str | None:
        """Return state and name, such as "PLAYING pick.urp"."""
        return self._ask("programState") or None

    def in_remote_control(self) -> bool | None:
        """Return whether programs sent over the network are accepted; e-Series from 5.6 on."""
        return {"true": True, "false": False}.get(self._ask("is in remote control").lower())

    def close(self) -> None:
        """Disconnect."""
        self._lines.close()
        self._socket.close()

    def _ask(self, command: str) -> str:
        self._socket.sendall(command.encode() + b"\n")
        return self._read()

    def _read(self) -> str:
        line = self._lines.readline()
        if not line.endswith("\n"):
            raise ConnectionError("it closed the connection")
        return line.strip()
