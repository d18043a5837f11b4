"""A thread that keeps up has claimed its place before anything can time it."""

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from time import sleep  # by name: the controller in memory replaces that of the module

import pytest

from ftdrivers.clock import Follower
from ftdrivers.errors import ConnectError
from ftdrivers.interfaces import DeviceInfo, FtSamples
from ftdrivers.streaming.sensor import NOTHING, StreamingSensor
from ftdrivers.ur.reading import Reader
from ftdrivers.ur.timing import STRICT
from tests.fake_clock import FakeClock
from tests.unit.drivers.ur.controller_in_memory import HOST, Controller, install


class SlowToClaim(FakeClock):
    """The clock of an emulated cell on a computer that gives a new thread no time."""

    def __init__(self) -> None:
        super().__init__()
        self.following: list[str] = []
        self.refusal: Exception | None = None

    @contextmanager
    def keeping_up(self) -> Iterator[None]:
        if threading.current_thread() is not threading.main_thread():
            sleep(0.02)
            if self.refusal:
                raise self.refusal
        self.following.append(threading.current_thread().name)
        yield


class Sensor(StreamingSensor):
    followers: tuple[str, ...] = ()

    def _connect(self) -> DeviceInfo:
        return DeviceInfo("fake", "F1", "1.0")

    def _read_block(self) -> FtSamples:
        sleep(0.001)
        return NOTHING

    def _disconnect(self) -> None: ...

    def _await_first_sample(self) -> None:
        assert isinstance(self._clock, SlowToClaim)
        self.followers = tuple(self._clock.following)


def test_an_arm_is_timed_only_when_its_reader_follows_the_clock(monkeypatch: pytest.MonkeyPatch) -> None:
    clock = SlowToClaim()
    controller = Controller(clock)
    install(controller, monkeypatch)
    followers: list[str] = []

    class Identified(Reader):
        def _identify(self, model: str | None, lacking: set[str]) -> DeviceInfo:
            followers.extend(clock.following)
            return super()._identify(model, lacking)

        def _run(self) -> None:
            pass  # a fake clock is for one thread

    Identified(HOST, None, clock=clock, timing=STRICT).close()
    assert followers == ["ur-reader"]


def test_a_clock_that_has_no_place_left_ends_the_start() -> None:
    clock = SlowToClaim()
    clock.refusal = ConnectError("too many threads use one emulated cell")
    with pytest.raises(ConnectError, match="too many"), Sensor("fake", clock=clock):
        pass
    follower = Follower(clock, lambda: pytest.fail("it works without a place"), "late")
    with pytest.raises(ConnectError):
        follower.start()
    follower.join()
