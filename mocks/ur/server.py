"""The controller's TCP ports on one loopback address, and the clock that drives them.

One thread does everything: between two control cycles it waits for the sockets. Nothing needs a lock.
"""

import select
import selectors
import socket
import struct
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Callable

from mocks.clock import time_out_s
from mocks.ur import dashboard, rtde
from mocks.ur.robot import Robot
from mocks.ur.script import take_uploads
from mocks.ur.variables import INPUTS, OUTPUTS, Reader, output_type

PORTS = {30001: "script", 30002: "script", 30003: "script", 30004: "rtde", 29999: "dashboard"}
BACKLOG_LIMIT_S = 10.0  # a client that does not read for so long is disconnected
KEEP_ALIVE_NS = 500_000_000
"""While the cell's clock is held, clients that command the robot get the last sample again after so much real time.

After 2.5 s without a sample ur_rtde reconnects, stops the running program and uploads it again.
"""

Select = selectors.BaseSelector


class Client(ABC):
    """One TCP connection: bytes in, bytes out, never blocking."""

    kind = ""
    banner = b""
    """What the port sends first."""

    def __init__(self, server: "UrServer", connection: socket.socket) -> None:
        self.server = server
        self.robot = server.robot
        self.open = True
        self.greeted = False
        """Whether the banner was sent."""
        self._socket = connection
        self._in = bytearray()
        self._out = bytearray()
        self._stuck_since: float | None = None

    def fileno(self) -> int:
        """The socket's."""
        return self._socket.fileno()

    @property
    def lagging(self) -> bool:
        """Whether the client has not yet read what was sent before."""
        return bool(self._out)

    def on_ready(self) -> None:
        """Read what has arrived and act on it."""
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
        """Consume what is complete at the start of `buffer`."""

    def send(self, data: bytes) -> None:
        """Send what the socket takes, keep the rest."""
        self._out += data
        self.flush()

    def flush(self) -> None:
        """Send what is left; disconnect a client that has not read for `BACKLOG_LIMIT_S`."""
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
        """Close the connection: in order, or with a TCP reset."""
        if self.open:
            self.open = False
            self.server.forget(self)
            if reset:
                self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
            self._socket.close()


class ScriptClient(Client):
    """Ports 30001 to 30003: receives programs, sends nothing."""

    kind = "script"

    def on_bytes(self, buffer: bytearray) -> None:
        """Start every complete program."""
        for upload in take_uploads(buffer):
            self.robot.upload(upload)


class DashboardClient(Client):
    """Port 29999: a banner, then one line for each line."""

    kind = "dashboard"
    banner = dashboard.BANNER.encode() + b"\n"

    def __init__(self, server: "UrServer", connection: socket.socket) -> None:
        super().__init__(server, connection)
        self._switches = self.robot.remote_switches
        self._opened_remote = self.robot.remote_control

    @property
    def trusted(self) -> bool:
        """Whether the pendant was in remote control since this client connected; else it can only query."""
        return self._opened_remote and self._switches == self.robot.remote_switches

    def on_bytes(self, buffer: bytearray) -> None:
        """Answer every complete line."""
        while b"\n" in buffer and self.open:
            line, _, rest = bytes(buffer).partition(b"\n")
            buffer[:] = rest
            text = line.decode("utf-8", "replace")
            self.send(dashboard.answer(self.robot, text, trusted=self.trusted).encode() + b"\n")
            if text.strip().lower() == "quit":
                self.close()


class RtdeClient(Client):
    """Port 30004: one output recipe, any number of input recipes."""

    kind = "rtde"

    def __init__(self, server: "UrServer", connection: socket.socket) -> None:
        super().__init__(server, connection)
        self._outputs: rtde.Recipe | None = None
        self._readers: list[Reader] = []
        self._every = 1
        self._inputs: list[rtde.Recipe] = []
        self._started = False
        self._outbox: deque[tuple[float, bytes]] = deque()
        """Samples on their way, and when each is sent, on the cell's clock."""
        self._last = b""

    def on_bytes(self, buffer: bytearray) -> None:
        """Answer every complete package."""
        try:
            for kind, payload in rtde.take_packages(buffer):
                self._on_package(kind, payload)
        except rtde.RtdeError as error:
            self.server.reject(str(error))
            self.close()

    def sample(self) -> None:
        """Take the outputs if this cycle is due; they are sent after the delay of the link."""
        if self._started and self.robot.cycle % self._every == 0 and self._outputs is not None:
            self._outbox.append((self.robot.cycle_s + self.server.delay_s, self._packed(self._outputs)))

    def _packed(self, outputs: rtde.Recipe) -> bytes:
        return outputs.pack([read(self.robot) for read in self._readers])

    def deliver(self, now_s: float) -> float | None:
        """Send the samples that are due, without those a lagging client has no room for.

        Returns
        -------
        Seconds until the next one is due, None when there is none.
        """
        while self._outbox and self._outbox[0][0] <= now_s:
            self._last = self._outbox.popleft()[1]
            if not self.lagging:
                self.send(self._last)
        return self._outbox[0][0] - now_s if self._outbox else None

    def repeat(self) -> None:
        """Send the last sample again to a client that commands."""
        if self._started and self._inputs and not self.lagging and self._outputs is not None:
            self._last = self._last or self._packed(self._outputs)
            self.send(self._last)

    def _on_package(self, kind: int, payload: bytes) -> None:
        if kind == rtde.VERSION:
            self._reply(kind, bytes([payload == b"\x00\x02"]))
        elif kind == rtde.CONTROLLER_VERSION:
            self._reply(kind, struct.pack(">4I", *self.robot.settings.polyscope, dashboard.BUILD))
        elif kind == rtde.SETUP_OUTPUTS:
            self._set_up_outputs(payload)
        elif kind == rtde.SETUP_INPUTS:
            self._set_up_inputs(payload)
        elif kind == rtde.START:
            self._started = self._outputs is not None
            self._reply(kind, bytes([self._started]))
        elif kind == rtde.PAUSE:
            self._started = False
            self._outbox.clear()
            self._reply(kind, b"\x01")
        elif kind == rtde.DATA:
            self._take_inputs(payload)
        elif kind != rtde.TEXT:
            self.server.reject(f"package type {kind}")

    def _reply(self, kind: int, payload: bytes) -> None:
        self.send(rtde.package(kind, payload))

    def _set_up_outputs(self, payload: bytes) -> None:
        if len(payload) < 8:
            self.server.reject(f"output setup of {len(payload)} bytes")
            return
        (frequency_hz,) = struct.unpack_from(">d", payload)
        names = rtde.names_in(payload[8:])
        recipe = rtde.Recipe(1, names, [output_type(self.robot, name) for name in names])
        self._outputs, self._last = recipe if recipe.valid else None, b""
        self._readers = [OUTPUTS[name][1] for name in names] if recipe.valid else []
        base_hz = self.robot.frequency_hz
        self._every = max(1, int(base_hz / frequency_hz)) if frequency_hz > 1e-3 else 1
        self._reply(rtde.SETUP_OUTPUTS, recipe.answer())

    def _set_up_inputs(self, payload: bytes) -> None:
        names = rtde.names_in(payload)
        owners = self.server.input_owners
        types = []
        for name in names:
            owner = owners.get(name)
            taken = owner is not self and (owner is not None or name in self.server.claimed)
            types.append("IN_USE" if taken else INPUTS.get(name, "NOT_FOUND"))
        recipe = rtde.Recipe(len(self._inputs) + 1, names, types)
        self._inputs.append(recipe)
        if recipe.valid:
            owners.update(dict.fromkeys(names, self))
        self._reply(rtde.SETUP_INPUTS, recipe.answer())

    def _take_inputs(self, payload: bytes) -> None:
        recipe_id = payload[0] if payload else 0
        if not 1 <= recipe_id <= len(self._inputs) or not self._inputs[recipe_id - 1].valid:
            self.server.reject(f"data for unknown input recipe {recipe_id}")
            return
        recipe = self._inputs[recipe_id - 1]
        size = len(payload) - 1
        if size != recipe.size:
            self.server.reject(f"{size} bytes of data for input recipe {recipe_id}, which has {recipe.size}")
        if size >= recipe.size:
            self.robot.write_inputs(recipe.unpack(payload[1:]))


CLIENTS: dict[str, type[Client]] = {c.kind: c for c in (ScriptClient, DashboardClient, RtdeClient)}


class UrServer:
    """The controller on the network.

    Parameters
    ----------
    robot
        The controller behind the ports.
    host
        Exact loopback address to listen on.
    selector
        Where sockets wait; the data of every key is a callable without arguments.

    Raises
    ------
    OSError
        When a port of `host` cannot be had.
    """

    def __init__(self, robot: Robot, host: str, selector: Select) -> None:
        self.robot = robot
        self.host = host
        self.input_owners: dict[str, RtdeClient] = {}
        self.claimed: set[str] = set()
        """Input variables that a fieldbus holds, without those a client had before."""
        self.bad_inputs: list[str] = []
        """Packages that break the protocol."""
        self.frozen = False
        """While true no cycle runs and no byte is read or sent, but connections stay."""
        self.streaming = True
        """While false RTDE clients are answered, but get no samples."""
        self.delay_s = 0.0
        """Time between the cycle in which a sample is taken and its sending."""
        self._silent: set[str] = set()
        self._cycle_real_ns = robot.clock.real_ns()
        self._selector = selector
        self._clients: list[Client] = []
        self._listeners: dict[int, socket.socket] = {}
        try:
            for port, kind in PORTS.items():
                self._listen(port, kind)
        except OSError:
            self.close()
            raise

    def _listen(self, port: int, kind: str) -> None:
        self._listeners[port] = listener = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        listener.bind((self.host, port))
        listener.listen(16)
        listener.setblocking(False)
        self._selector.register(listener, selectors.EVENT_READ, lambda: self._accept(listener, kind))

    def _close_listener(self, port: int) -> None:
        listener = self._listeners.pop(port)
        if listener in self._selector.get_map():
            self._selector.unregister(listener)
        listener.close()

    def _accept(self, listener: socket.socket, kind: str) -> None:
        try:
            connection, _peer = listener.accept()
        except OSError:
            return  # gone again
        connection.setblocking(False)
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        client = CLIENTS[kind](self, connection)
        self._clients.append(client)
        self.robot.note(kind, "connected")
        if kind not in self._silent:
            self._wake(client)

    def _wake(self, client: Client) -> None:
        self._selector.register(client, selectors.EVENT_READ, client.on_ready)
        if not client.greeted:
            client.greeted = True
            client.send(client.banner)

    def forget(self, client: Client) -> None:
        """Remove a client whose connection has ended; its input variables are free again."""
        if client in self._selector.get_map():
            self._selector.unregister(client)
        self._clients.remove(client)
        self.input_owners = {name: owner for name, owner in self.input_owners.items() if owner is not client}
        self.robot.note(client.kind, "disconnected")

    def reject(self, what: str) -> None:
        """Note a package that breaks the protocol."""
        self.bad_inputs.append(what)

    def drop(self, kind: str, *, reset: bool = False) -> int:
        """Disconnect all clients of a kind (rtde, dashboard, script); the port still listens."""
        clients = self._of_kind(kind)
        for client in clients:
            client.close(reset=reset)
        return len(clients)

    def set_listening(self, kind: str, on: bool) -> None:
        """Open or close the ports of a kind; open connections stay."""
        self._of_kind(kind)
        for port in [port for port, its_kind in PORTS.items() if its_kind == kind]:
            if on and port not in self._listeners:
                self._listen(port, kind)
            elif not on and port in self._listeners:
                self._close_listener(port)

    def set_silent(self, kind: str, on: bool) -> None:
        """While on, accept clients of a kind without reading or sending; afterwards serve what has waited."""
        clients = self._of_kind(kind)
        if on and kind not in self._silent:
            self._silent.add(kind)
            for client in clients:
                self._selector.unregister(client)
        elif not on and kind in self._silent:
            self._silent.remove(kind)
            for client in clients:
                self._wake(client)

    def _of_kind(self, kind: str) -> list[Client]:
        if kind not in CLIENTS:
            raise ValueError(f"{kind!r} is none of {', '.join(CLIENTS)}")
        return [client for client in self._clients if client.kind == kind]

    def close(self) -> None:
        """Close all connections and stop listening."""
        for client in list(self._clients):
            client.close()
        for port in list(self._listeners):
            self._close_listener(port)

    def run(self, ended: Callable[[], bool]) -> None:
        """Serve until `ended()`, which is called at least once per control cycle."""
        clock, period_ns = self.robot.clock, round(1e9 * self.robot.period_s)
        with clock.keeping_up():
            due_ns = clock.now_ns() + period_ns
            while not ended():
                now_ns = clock.follow()
                while due_ns <= now_ns:
                    if not self.frozen:
                        self.robot.tick(1e-9 * due_ns)
                        self._take_samples()
                    due_ns += period_ns
                waits_s = [1e-9 * (due_ns - now_ns)]
                if not self.frozen:
                    waits_s += self._deliver(1e-9 * now_ns)
                    self._keep_alive()
                for key in self._ready(time_out_s(min(waits_s))):
                    key.data()

    def _ready(self, time_out_s: float) -> list[selectors.SelectorKey]:
        """Wait for the network and the control channel; while frozen only for the latter, as sockets stay unread."""
        if not self.frozen:
            return [key for key, _events in self._selector.select(time_out_s)]
        keys = self._selector.get_map().values()
        others = {key.fd: key for key in keys if not isinstance(key.fileobj, (Client, socket.socket))}
        return [others[fd] for fd in select.select(list(others), [], [], time_out_s)[0]]

    @property
    def _served(self) -> list[Client]:
        return [client for client in self._clients if client.kind not in self._silent]

    @property
    def _rtde_clients(self) -> list[RtdeClient]:
        return [client for client in self._served if isinstance(client, RtdeClient)]

    def _take_samples(self) -> None:
        self._cycle_real_ns = self.robot.clock.real_ns()
        for client in self._served:
            client.flush()
        if self.streaming:
            for client in self._rtde_clients:
                client.sample()

    def _deliver(self, now_s: float) -> list[float]:
        """Send the samples that are due; return the seconds until others are."""
        waits_s = [client.deliver(now_s) for client in self._rtde_clients]
        return [wait_s for wait_s in waits_s if wait_s is not None]

    def _keep_alive(self) -> None:
        """Repeat the last samples while the clock is held."""
        real_ns = self.robot.clock.real_ns()
        if self.streaming and real_ns - self._cycle_real_ns >= KEEP_ALIVE_NS:
            self._cycle_real_ns = real_ns
            for client in self._rtde_clients:
                client.repeat()
