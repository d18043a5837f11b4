"""The TCP ports of the controller on one loopback address, and its control cycles.

A single thread runs the control cycles and waits for the sockets in between, so no lock is needed.
"""

import select
import selectors
import socket
from collections.abc import Callable

from ftmocks.clock import time_out_s
from ftmocks.ur import api
from ftmocks.ur.clients import ApiClient, Client, DashboardClient, PrimaryClient, ScriptClient, SecondaryClient
from ftmocks.ur.robot import Robot
from ftmocks.ur.rtde_client import RtdeClient, RtdeLink

PORTS = {30001: "primary", 30002: "secondary", 30003: "script", 30004: "rtde"}
DASHBOARD_PORT = 29999
"""Port of the dashboard server, which PolyScope X does not have."""
API_PORT = 30080
"""Port of the Robot API of PolyScope X, instead of port 80, which not every user may open."""
KEEP_ALIVE_NS = 500_000_000
"""Interval at which clients with commands receive the last sample again while the cell's clock is held, ns.

After 2.5 s without a sample ur_rtde reconnects, stops the running program and uploads it again.
"""

Select = selectors.BaseSelector
_KINDS: tuple[type[Client], ...] = (PrimaryClient, SecondaryClient, ScriptClient, DashboardClient, ApiClient)
CLIENTS = {c.kind: c for c in _KINDS}
"""Classes of clients by the name of their kind, except RTDE."""


def _ports_of(polyscope: tuple[int, int, int]) -> dict[int, str]:
    """Return the ports that only some versions have."""
    if polyscope < (api.POLYSCOPE_X, 0, 0):
        return {DASHBOARD_PORT: "dashboard"}
    return {API_PORT: "api"} if polyscope[:2] >= min(api.API_VERSIONS) else {}


class UrServer:
    """The TCP ports of a controller.

    Parameters
    ----------
    robot
        The controller behind the ports.
    host
        Loopback address on which the ports listen.
    selector
        Selector of the sockets. The data of every key is a callable without arguments.

    Raises
    ------
    OSError
        A port of `host` is not available.
    """

    def __init__(self, robot: Robot, host: str, selector: Select) -> None:
        self.robot = robot
        self.host = host
        self.rtde = RtdeLink()
        self.frozen = False
        """If true, no cycle runs and no byte is read or sent, but connections stay open."""
        self.streaming = True
        """If false, RTDE clients are answered, but receive no samples."""
        self.ports = {**PORTS, **_ports_of(robot.settings.polyscope)}
        """Kind of client (a key of `CLIENTS`, or "rtde") that each TCP port serves."""
        self._silent: set[str] = set()
        self._cycle_real_ns = robot.clock.real_ns()
        self._selector = selector
        self._clients: list[Client] = []
        self._listeners: dict[int, socket.socket] = {}
        try:
            for port, kind in self.ports.items():
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
            return  # the client has closed the connection
        connection.setblocking(False)
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        client: Client
        if kind == RtdeClient.kind:
            client = RtdeClient(self.robot, connection, self._forget, link=self.rtde)
        else:
            client = CLIENTS[kind](self.robot, connection, self._forget)
        self._clients.append(client)
        self.robot.note(kind, "connected")
        if kind not in self._silent:
            self._wake(client)

    def _wake(self, client: Client) -> None:
        self._selector.register(client, selectors.EVENT_READ, client.on_ready)
        if not client.greeted:
            client.greeted = True
            client.send(client.greeting())

    def _forget(self, client: Client) -> None:
        """Remove a client whose connection has ended from clients and selector."""
        if client in self._selector.get_map():
            self._selector.unregister(client)
        self._clients.remove(client)
        self.robot.note(client.kind, "disconnected")

    def drop(self, kind: str, *, reset: bool = False) -> int:
        """Disconnect all clients of a kind, see `ports`. The port still listens."""
        clients = self._of_kind(kind)
        for client in clients:
            client.close(reset=reset)
        return len(clients)

    def set_listening(self, kind: str, on: bool) -> None:
        """Open or close the ports of a kind. Existing connections stay open."""
        self._of_kind(kind)
        for port in [port for port, its_kind in self.ports.items() if its_kind == kind]:
            if on and port not in self._listeners:
                self._listen(port, kind)
            elif not on and port in self._listeners:
                self._close_listener(port)

    def set_silent(self, kind: str, on: bool) -> None:
        """Accept clients of a kind without reading or sending while this is on. They are served afterwards."""
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
        if kind not in self.ports.values():
            raise ValueError(f"{kind!r} is none of {', '.join(dict.fromkeys(self.ports.values()))}")
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
        """Wait for the sockets and the control channel; while frozen only for the control channel."""
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
            client.on_cycle()
        if self.streaming:
            for client in self._rtde_clients:
                client.sample()

    def _deliver(self, now_s: float) -> list[float]:
        """Send the RTDE samples that are due; return the times until the next sample of each client, s."""
        waits_s = [client.deliver(now_s) for client in self._rtde_clients]
        return [wait_s for wait_s in waits_s if wait_s is not None]

    def _keep_alive(self) -> None:
        """Send the last RTDE samples again while the cell's clock is held, so that clients keep their connections."""
        real_ns = self.robot.clock.real_ns()
        if self.streaming and real_ns - self._cycle_real_ns >= KEEP_ALIVE_NS:
            self._cycle_real_ns = real_ns
            for client in self._rtde_clients:
                client.repeat()
