"""Connections of clients to the controller: one class per kind of port, except RTDE."""

import socket
import struct
from abc import ABC, abstractmethod
from collections.abc import Callable

from ftmocks.ur import api, dashboard, http_wire, primary
from ftmocks.ur.robot import Robot
from ftmocks.ur.uploads import start_upload, take_uploads

BACKLOG_LIMIT_S = 10.0  # s until a client that does not read is disconnected


class Client(ABC):
    """A non-blocking TCP connection. It calls `forget` with itself after it has ended."""

    kind = ""

    def __init__(self, robot: Robot, connection: socket.socket, forget: Callable[["Client"], None]) -> None:
        self.robot = robot
        self._forget = forget
        self.open = True
        self.greeted = False
        """Whether the greeting was sent to this client."""
        self._socket = connection
        self._in = bytearray()
        self._out = bytearray()
        self._stuck_since: float | None = None

    def fileno(self) -> int:
        """File descriptor of the socket."""
        return self._socket.fileno()

    @property
    def lagging(self) -> bool:
        """Whether bytes are waiting that the client has not read."""
        return bool(self._out)

    def greeting(self) -> bytes:
        """Return the bytes that are sent first on this port."""
        return b""

    def on_cycle(self) -> None:
        """Send what this port sends in each control cycle, and bytes that are still waiting."""
        self.flush()

    def on_ready(self) -> None:
        """Read and process the bytes that have arrived."""
        try:
            data = self._socket.recv(65536)
        except BlockingIOError:
            return
        except OSError:
            data = b""
        if not data:
            self.close()
            return
        self._in += data
        self.on_bytes(self._in)

    @abstractmethod
    def on_bytes(self, buffer: bytearray) -> None:
        """Process and remove complete units at the start of `buffer`."""

    def send(self, data: bytes) -> None:
        """Send as many bytes as the socket accepts, and keep the others."""
        self._out += data
        self.flush()

    def flush(self) -> None:
        """Send waiting bytes; disconnect a client that has not read for `BACKLOG_LIMIT_S`."""
        if not self._out or not self.open:
            return
        try:
            sent = self._socket.send(self._out)
        except BlockingIOError:
            sent = 0
        except OSError:
            self.close()
            return
        del self._out[:sent]
        now = self.robot.clock.now_s()
        if sent or self._stuck_since is None:
            self._stuck_since = now
        elif now - self._stuck_since > BACKLOG_LIMIT_S:
            self.close()
        if not self._out:
            self._stuck_since = None

    def close(self, *, reset: bool = False) -> None:
        """Close the connection, regularly or with a TCP reset."""
        if self.open:
            self.open = False
            self._forget(self)
            if reset:
                self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
            self._socket.close()


class ScriptClient(Client):
    """Port 30003, which receives programs and sends nothing."""

    kind = "script"

    def on_bytes(self, buffer: bytearray) -> None:
        """Take the complete programs from `buffer` and start them."""
        for upload in take_uploads(buffer):
            start_upload(self.robot, upload)


class PrimaryClient(Client):
    """Port 30001, which receives programs and sends the state, messages of programs, and errors.

    A connection that was opened in local control remains read-only, also after the pendant was switched to remote
    control. A connection that was opened in remote control ends when the pendant is switched to local control.
    """

    kind = "primary"

    def __init__(self, robot: Robot, connection: socket.socket, forget: Callable[["Client"], None]) -> None:
        super().__init__(robot, connection, forget)
        self._can_write = self.robot.remote_control
        self._switches = self.robot.remote_switches
        self._every = self.robot.frequency_hz // primary.STATES_HZ
        self._seen = len(self.robot.events)
        """Number of entries of the event log that need not be sent: sent already, or older than this connection."""

    def greeting(self) -> bytes:
        """Return the first bytes of a connection: version, tolerances and a complete robot state."""
        return primary.greeting(self.robot)

    def on_bytes(self, buffer: bytearray) -> None:
        """Take the complete programs from `buffer` and start them."""
        by = f"{self.kind} port"
        for upload in take_uploads(buffer):
            command = primary.COMMANDS.get(upload.text.strip())
            if not self._can_write:
                self.robot.note(by, f"program {upload.name}", accepted=False, why="read-only connection")
                self._report(primary.read_only_error(self.robot))
            elif command is not None:
                self.robot.note(by, upload.text.strip())
                command(self.robot)
            else:
                start_upload(self.robot, upload, by=by)

    def on_cycle(self) -> None:
        """Send messages of new events, and the state if it is due."""
        super().on_cycle()
        if self._can_write and self._switches != self.robot.remote_switches:
            self.close()
            return
        news, self._seen = self.robot.events[self._seen :], len(self.robot.events)
        self._report(b"".join(map(primary.messages_of, news)))
        if self.robot.cycle % self._every == 0 and not self.lagging:
            self.send(primary.state_package(self.robot))

    def _report(self, messages: bytes) -> None:
        if messages:
            self.send(messages)


class SecondaryClient(PrimaryClient):
    """Port 30002, which equals port 30001 except that it sends no messages after the greeting."""

    kind = "secondary"

    def _report(self, messages: bytes) -> None:
        """Send no messages of events, which port 30002 does not have."""


class DashboardClient(Client):
    """Port 29999, which sends a banner, then one line per received line."""

    kind = "dashboard"

    def __init__(self, robot: Robot, connection: socket.socket, forget: Callable[["Client"], None]) -> None:
        super().__init__(robot, connection, forget)
        self._switches = self.robot.remote_switches
        self._opened_remote = self.robot.remote_control

    def greeting(self) -> bytes:
        """Return the banner of the dashboard server."""
        return dashboard.BANNER.encode() + b"\n"

    @property
    def trusted(self) -> bool:
        """Whether the pendant was in remote control since this client connected. Other clients can only query."""
        return self._opened_remote and self._switches == self.robot.remote_switches

    def on_bytes(self, buffer: bytearray) -> None:
        """Take the complete lines from `buffer`, execute them as dashboard commands, and send the replies."""
        while b"\n" in buffer and self.open:
            line, _, rest = bytes(buffer).partition(b"\n")
            buffer[:] = rest
            text = line.decode("utf-8", "replace")
            self.send(dashboard.answer(self.robot, text, trusted=self.trusted).encode() + b"\n")
            if text.strip().lower() == "quit":
                self.close()


class ApiClient(Client):
    """The port of the Robot API, which answers HTTP requests in their order."""

    kind = "api"

    def on_bytes(self, buffer: bytearray) -> None:
        """Take the complete HTTP requests from `buffer` and answer them."""
        try:
            while self.open and (request := http_wire.take_request(buffer)):
                status, answer = api.respond(self.robot, request.method, request.path, request.body)
                self.send(http_wire.response(status, answer))
                if request.is_last:
                    self.close()
        except http_wire.HttpError as error:
            self.send(http_wire.response(400, {"message": str(error)}))
            self.close()
