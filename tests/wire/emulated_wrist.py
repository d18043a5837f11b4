"""The wrist sensor of an emulated UR controller, whose readings a test chooses, behind a TCP wire that fails.

What TCP carries comes whole and in order, but in other pieces than were sent, late, not at all, or up to a point.
"""

import random
import selectors
import socket
import struct
import threading
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from contextlib import suppress
from typing import TypeVar

from ftmocks.arrays import Array
from ftmocks.clock import CellClock
from ftmocks.kinematics import MODELS, ZERO6
from ftmocks.station import free_hosts
from ftmocks.ur.robot import Robot, RobotSettings
from ftmocks.ur.server import UrServer
from ftmocks.wires.faults import Faults
from ftmocks.world import Truth, World

T = TypeVar("T")

RTDE_PORT = 30004
RESET = struct.pack("ii", 1, 0)
"""SO_LINGER: closing sends RST."""


class EmulatedWrist:
    """A controller and the wire to it, with the methods of an emulated sensor; of `faults`, delay and stall apply."""

    def __init__(
        self,
        measure: Callable[[int], Array],
        *,
        seed: int,
        faults: Faults | None = None,
        host: str | None = None,
        clock: CellClock | None = None,
    ) -> None:
        self.faults = faults or Faults()
        self._clock = clock or CellClock()
        self._measure = measure
        self._rng = random.Random(seed)
        self._host = host
        self._ended = threading.Event()
        self._threads: list[threading.Thread] = []

    def start(self) -> dict[str, str]:
        """Listen; the address at which clients find the controller."""
        self._controller = Controller(self._measure, self._clock)
        self._listener = first_that_works(
            lambda host: socket.create_server((host, RTDE_PORT)), [self._host] if self._host else wire_hosts()
        )
        self._listener.settimeout(0.02)
        self._run(self._accept)
        return {"host": self._listener.getsockname()[0]}

    def reset(self) -> None:
        """Restart the controller: it hangs up, and its clock restarts."""
        self._controller.stop()
        self._controller = Controller(self._measure, self._clock)

    def unplug(self) -> None:
        """Reset all connections and refuse new ones. May come twice."""
        self._ended.set()
        for thread in self._threads:
            thread.join()
        self._threads.clear()
        self._listener.close()
        self._controller.stop()

    stop = unplug

    def _run(self, what: Callable[..., None], *args: object) -> None:
        self._threads.append(threading.Thread(target=what, args=args, daemon=True))
        self._threads[-1].start()

    def _accept(self) -> None:
        while not self._ended.is_set():
            with suppress(TimeoutError):
                client, _ = self._listener.accept()
                try:
                    server = socket.create_connection((self._controller.host, RTDE_PORT), 1.0)
                except OSError:  # it restarts
                    client.close()
                else:
                    self._run(self._carry, client, server)

    def _carry(self, client: socket.socket, server: socket.socket) -> None:
        """Carry bytes both ways until one side hangs up: late and in pieces to the client."""
        late: deque[tuple[float, bytes]] = deque()
        with client, server, selectors.DefaultSelector() as selector, suppress(OSError), self._clock.keeping_up():
            for side in (client, server):
                selector.register(side, selectors.EVENT_READ)
            while not self._ended.is_set():
                for key, _ in selector.select(0.002):
                    data = (client if key.fileobj is client else server).recv(65536)
                    if not data:
                        return
                    if key.fileobj is client:
                        server.sendall(data)
                    else:
                        cut = self._rng.randrange(len(data) + 1)
                        late += [(self._clock.now_s() + self.faults.delay_s, part) for part in (data[:cut], data[cut:])]
                self._clock.follow()
                while late and late[0][0] <= self._clock.now_s() and not self.faults.stall:
                    client.sendall(late.popleft()[1])
            client.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, RESET)


class Controller:
    """A running controller, with readings of the test's making."""

    def __init__(self, measure: Callable[[int], Array], clock: CellClock) -> None:
        robot = Robot(World(Truth.drawn(1), MODELS["UR5e"], ZERO6, clock=clock), RobotSettings())
        robot.wrist_sensor = measure
        selector = selectors.SelectSelector()
        self._server = first_that_works(lambda host: UrServer(robot, host, selector), free_hosts())
        self.host = self._server.host
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._server.run, args=(self._ended.is_set,), daemon=True)
        self._thread.start()

    def stop(self) -> None:
        """Hang up and be gone. May come twice."""
        self._ended.set()
        self._thread.join()
        self._server.close()


def first_that_works(listen: Callable[[str], T], hosts: Iterable[str]) -> T:
    for host in hosts:
        with suppress(OSError):
            return listen(host)
    raise OSError("none of these loopback addresses is free")


def wire_hosts() -> Iterator[str]:
    """Loopback addresses that no controller takes: a wire comes back at its own."""
    for _ in range(100):
        yield f"127.32.{random.randrange(256)}.{random.randrange(1, 255)}"
