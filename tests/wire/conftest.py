"""The emulated UR controller and the emulated sensors, as the tests of their drivers use them."""

from collections.abc import Callable, Generator, Iterator
from contextlib import ExitStack, closing
from math import radians
from typing import Any

import numpy as np
import pytest

from ftdrive.cell.emulated_clock import EmulatedClock
from ftdrivers.clock import Clock
from ftdrivers.registry import sensor_from_url
from ftdrivers.streaming.sensor import StreamingSensor
from ftdrivers.ur.arm import UrArm
from ftdrivers.ur.control import Control, ControlPath
from ftdrivers.ur.opening import Opening, path_for
from ftdrivers.ur.timing import UrTiming
from tests.cell_time import CellTime
from tests.ur_rtde import require_ur_rtde
from tests.wire.laboratory import Laboratory
from tests.wire.sensor_kinds import KINDS
from tests.wire.station_process import StationProcess

TIME_SCALE = 10
"""The arm lives so many times faster: a protective stop can be unlocked after 5 s of its time."""
SPEED_RAD_S, ACCELERATION_RAD_S2 = radians(60) / TIME_SCALE, radians(200) / TIME_SCALE


class Station(StationProcess):
    """The emulator's process, its control lines and its clock."""

    def start(self) -> None:
        super().start()
        self.clock = EmulatedClock(self.hello["clock"])

    def dashboard(self, command: str) -> str:
        """Ask as another client does."""
        with self.connect(29999) as sock, sock.makefile("rw") as lines:
            lines.readline()
            lines.write(command + "\n")
            lines.flush()
            return lines.readline().strip()

    def arm(self, **how: Any) -> UrArm:
        """Make an arm that lives by the clock of this cell, if nothing else is said."""
        api_port = self.hello["arm"].get("api_port", 80)
        given: dict[str, Any] = {"clock": self.clock, "timing": UrTiming.emulated(), "api_port": api_port, **how}
        return UrArm(self.host, speed_rad_s=SPEED_RAD_S, acceleration_rad_s2=ACCELERATION_RAD_S2, **given)

    def is_as_new(self) -> bool:
        if self.process.poll() is not None:
            return False
        state = self.ask("state")
        return bool(
            (state["safety_mode"], state["robot_mode"], state["remote_control"]) == ("NORMAL", "RUNNING", True)
            and (state["runtime_state"], state["speed_fraction"]) == ("STOPPED", 1.0)
            and not any(state["tcp_offset"])
        )


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(item: pytest.Item) -> Generator[None, pytest.TestReport, pytest.TestReport]:
    report = yield
    item.stash[FAILED] = item.stash.get(FAILED, False) or report.failed
    return report


FAILED = pytest.StashKey[bool]()


@pytest.fixture(scope="module")
def start_station() -> Iterator[Callable[..., Station]]:
    with ExitStack() as stations:
        yield lambda *options: stations.enter_context(Station(*options))


@pytest.fixture(scope="module")
def kept() -> list[Station]:
    """The station at hand, in a list: a test may break it, and the next gets another."""
    return []


@pytest.fixture
def station(
    kept: list[Station], start_station: Callable[..., Station], request: pytest.FixtureRequest
) -> Iterator[Station]:
    """Give a station whose arm stands and has no program; one that a test has failed with is not used again."""
    if not kept or not kept[0].is_as_new():
        kept[:] = [start_station("--time-scale", str(TIME_SCALE))]
    station = kept[0]
    yield station
    if request.node.stash.get(FAILED, False):
        station.kill()
    elif station.process.poll() is None and (bad := station.ask("state")["bad_inputs"]):
        station.kill()  # the next test would find them too
        # A thread of ur_rtde may write before its reconnection, which an event causes, has set the recipes up.
        assert "event" in request.fixturenames, bad
        assert all(one.startswith("data for unknown input recipe") for one in bad), bad


@pytest.fixture(params=["auto", pytest.param("script", marks=pytest.mark.slow)])
def control(request: pytest.FixtureRequest) -> ControlPath:
    """The control path of the arms of a test: the one that is taken here, and the one that is there everywhere."""
    if request.param == "ur-rtde":
        require_ur_rtde()
    return path_for(request.param, (5, 15))[0]


one_path = pytest.mark.parametrize("control", ["auto"], indirect=True)
"""For tests of what has nothing to do with the control path."""
on_ur_rtde = pytest.mark.parametrize("control", ["ur-rtde"], indirect=True)


@pytest.fixture
def controls(monkeypatch: pytest.MonkeyPatch) -> list[Control]:
    """The control paths that arms have opened, the newest last."""
    opened: list[Control] = []
    open_control = Opening.open

    def open_and_remember(opening: Opening) -> Control:
        opened.append(open_control(opening))
        return opened[-1]

    monkeypatch.setattr(Opening, "open", open_and_remember)
    return opened


@pytest.fixture
def new_arm(station: Station, control: ControlPath) -> Iterator[Callable[..., UrArm]]:
    """Make arms at the station, and close them after the test."""
    with ExitStack() as arms:
        yield lambda **how: arms.enter_context(closing(station.arm(**{"control": control, **how})))


@pytest.fixture
def arm(new_arm: Callable[..., UrArm]) -> UrArm:
    arm = new_arm()
    arm.open(control=True)
    return arm


# ---------------------------------------------------------------------- sensors

WRENCH = np.array([10.0, -5.0, 20.0, 0.5, -0.25, 0.1])
NOISE = np.array([0.03] * 3 + [0.001] * 3)


@pytest.fixture
def cell_time() -> Iterator[CellTime]:
    """The clocks of emulated sensors and of their drivers, where both are in the test's process."""
    with closing(CellTime()) as cell_time:
        yield cell_time


class Emulator:
    """One emulated sensor."""

    def __init__(self, laboratory: Laboratory, scheme: str, options: dict[str, Any]) -> None:
        self.kind = KINDS[scheme]
        self.laboratory = laboratory
        self.clock = laboratory.clock
        self._sensors: list[StreamingSensor] = []
        self._number, self.endpoint = laboratory.request("start", scheme, self.kind.options | options)

    def sensor(self, options: str = "", sign: int = 1, clock: Clock | None = None) -> StreamingSensor:
        """Make a driver of it, in the cell's time unless another clock is given; it is closed with the emulator."""
        where, ports = self.endpoint, []
        if isinstance(where, dict):
            ports = [f"{key}={port}" for key, port in where.items() if key != "host"]
            where = where["host"]
        query = "&".join(filter(None, [self.kind.query, *ports, options]))
        url = f"{self.kind.scheme}://{where}?{query}".rstrip("?")
        sensor = sensor_from_url(url, sign=sign, clock=clock or self.clock)
        assert isinstance(sensor, StreamingSensor)
        self._sensors.append(sensor)
        return sensor

    def faults(self, **options: Any) -> None:
        self.laboratory.request("faults", self._number, options)

    def unplug(self) -> None:
        self.laboratory.request("unplug", self._number)

    def reset(self) -> None:
        self.laboratory.request("reset", self._number)

    def stop(self) -> None:
        for sensor in self._sensors:
            sensor.close()
        self.laboratory.request("stop", self._number)


@pytest.fixture(scope="module")
def laboratory() -> Iterator[Laboratory]:
    laboratory = Laboratory(WRENCH, NOISE)
    yield laboratory
    laboratory.close()


@pytest.fixture
def start(laboratory: Laboratory) -> Iterator[Callable[..., Emulator]]:
    """Start an emulated sensor of its own for a test: a scheme, and options of the emulator."""
    running: list[Emulator] = []

    def run(scheme: str, **options: Any) -> Emulator:
        running.append(Emulator(laboratory, scheme, options))
        return running[-1]

    yield run
    for emulator in running:
        emulator.stop()


@pytest.fixture(scope="module", params=[name for name in KINDS if name != "ur-ft"])
def shared(request: pytest.FixtureRequest, laboratory: Laboratory) -> Iterator[Emulator]:
    """A healthy emulator of every kind, for tests that leave it as they found it."""
    emulator = Emulator(laboratory, request.param, {})
    yield emulator
    emulator.stop()
