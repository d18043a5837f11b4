"""The controller's cycles and samples follow the cell's clock, whatever the computer does."""

import os
import selectors
import socket
import struct
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import numpy as np
import pytest

from ftmocks.clock import CellClock
from ftmocks.kinematics import MODELS, vector6
from ftmocks.station import free_hosts
from ftmocks.ur.modes import Runtime
from ftmocks.ur.robot import Robot, RobotSettings
from ftmocks.ur.server import UrServer
from ftmocks.ur.uploads import Upload, start_upload
from ftmocks.world import Truth, World
from tests.unit.mocks.real_time import RealTime

HOME = vector6(np.radians([45, -100, 60, -50, 90, 45]))
SLEEPING = Upload("other", "def other():\n  sleep(1000)\nend\n", secondary=False)


class Waiting(selectors.SelectSelector):
    """Waits no longer than it takes for the test's clock to move on."""

    def __init__(self, real: RealTime) -> None:
        super().__init__()
        self._real = real
        self.longest_s = 0.0
        self.idle: Callable[[], object] = lambda: None
        """Called before each wait."""

    def select(self, timeout: float | None = None) -> list[tuple[selectors.SelectorKey, int]]:
        assert timeout is not None
        self.idle()
        self.longest_s = max(self.longest_s, timeout)
        self._real.pass_s(timeout)
        return super().select(0)


class Controller:
    """A controller with its ports, on a clock of the test's."""

    def __init__(self, time_scale: float = 1.0, polyscope: tuple[int, int, int] = (5, 15, 0)) -> None:
        self.real = RealTime()
        self.clock = CellClock(self.real)
        world = World(Truth.drawn(0), MODELS["UR5e"], HOME, clock=self.clock)
        self.robot = Robot(world, RobotSettings(time_scale=time_scale, polyscope=polyscope))
        self.selector = Waiting(self.real)
        self.server = self._listen()

    def _listen(self) -> UrServer:
        for host in free_hosts():
            try:
                return UrServer(self.robot, host, self.selector)
            except OSError:
                continue
        raise OSError("no free loopback address")

    def run(self, duration_s: float, then: Callable[[], bool] = lambda: False) -> None:
        """Serve for so long in the cell's time, or until `then()`."""
        end_ns = self.clock.now_ns() + round(duration_s * 1e9)
        self.server.run(lambda: then() or self.clock.now_ns() >= end_ns)


@pytest.fixture
def controller() -> Iterator[Controller]:
    with running() as controller:
        yield controller


@contextmanager
def running(time_scale: float = 1.0, polyscope: tuple[int, int, int] = (5, 15, 0)) -> Iterator[Controller]:
    controller = Controller(time_scale, polyscope)
    try:
        yield controller
    finally:
        controller.server.close()
        controller.clock.close()


def start_guarded_program(controller: Controller) -> None:
    start_upload(controller.robot, SLEEPING)
    controller.run(0.2)
    assert controller.robot.runtime == Runtime.PLAYING
    controller.robot.set_watchdog("input_int_register_0", 10.0)


def test_the_watchdog_bites_in_the_time_of_the_cell() -> None:
    with running(time_scale=20.0) as controller:
        start_guarded_program(controller)
        begun_s = controller.clock.now_s()
        controller.run(1.0, then=lambda: controller.robot.runtime == Runtime.STOPPED)
        assert controller.clock.now_s() - begun_s == pytest.approx(0.1, abs=0.015)
        assert "watchdog" in controller.robot.events[-1].why


def test_while_the_clock_is_held_a_client_that_commands_gets_the_last_sample_again(controller: Controller) -> None:
    """ur_rtde stops the program and uploads it again after 2.5 s of real time without a sample."""

    def serve(real_s: float) -> None:
        end_ns = controller.real.ns + round(real_s * 1e9)
        controller.server.run(lambda: controller.real.ns >= end_ns)

    controller.clock._page[4], controller.clock._page[5] = os.getpid(), controller.clock.now_ns()  # a starved follower
    address = (controller.server.host, 30004)
    with socket.create_connection(address, 10.0) as commands, socket.create_connection(address, 10.0) as reads:
        serve(0.05)
        for client in (commands, reads):
            client.sendall(struct.pack(">HBd", 3 + 8 + 9, ord("O"), 125.0) + b"timestamp" + b"\x00\x03S")
        commands.sendall(struct.pack(">HB", 3 + 20, ord("I")) + b"input_int_register_0")
        serve(0.05)
        held_cycle = controller.robot.cycle
        serve(4.0)
        samples, others = (
            client.recv(65536).split(struct.pack(">HBB", 3 + 1 + 8, ord("U"), 1))[1:] for client in (commands, reads)
        )
    assert controller.robot.cycle == held_cycle
    assert (len(samples), len(set(samples)), others) == (8, 1, [])
