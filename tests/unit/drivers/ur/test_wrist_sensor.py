"""The wrist sensor over RTDE, with a subscription in memory and a fake clock."""

import math
from collections.abc import Iterator, Mapping

import numpy as np
import pytest
from numpy.typing import NDArray

from ftdrivers.clock import Clock
from ftdrivers.errors import BadUrl, ConnectError, StreamBroken
from ftdrivers.interfaces import Fact
from ftdrivers.registry import sensor_from_url
from ftdrivers.ur import sensor as sensor_module
from ftdrivers.ur.sensor import UrWristSensor
from tests.fake_clock import FakeClock
from tests.unit.drivers.in_one_thread import InOneThread

HOST = "192.0.2.1"
RAW = [20_000.0, -4_000.0, 1_000.0, 50.0, -20.0, 10.0]
CYCLE_S = 0.002


class Wrist(InOneThread, UrWristSensor):
    """A wrist sensor whose reader takes its turns in the test's thread."""


class SubscriptionInMemory:
    """Sends a sample every 2 ms: with the times of `times` first, then going on from 100 s."""

    version = (5, 15, 0, 1)

    def __init__(self, clock: FakeClock) -> None:
        self.clock = clock
        self.times: list[float] = []
        self.raw = RAW
        self.missing: list[str] = []
        self.ends_after_s = math.inf
        self.asked: list[object] = []

    def subscribe(
        self, host: str, outputs: Mapping[str, str], frequency_Hz: float, *, timeout_s: float, clock: Clock
    ) -> "SubscriptionInMemory":
        assert timeout_s == 2.0
        assert clock is self.clock
        self.asked.append((host, dict(outputs), frequency_Hz))
        self._ends_s = clock.now_s() + self.ends_after_s
        self._t_s = 100.0
        return self

    def read(self, timeout_s: float) -> list[tuple[float, list[float]]]:
        assert timeout_s <= 0.05
        self.clock.advance(CYCLE_S)
        if self.clock.now_s() > self._ends_s:
            raise ConnectionResetError
        self._t_s = self.times.pop(0) if self.times else self._t_s + CYCLE_S
        return [(self._t_s, self.raw)]

    def decode(self, samples: list[tuple[float, list[float]]]) -> dict[str, NDArray[np.float64]]:
        times, raw = zip(*samples, strict=True)
        return {"timestamp": np.array(times), "ft_raw_wrench": np.array(raw)}

    def close(self) -> None: ...


@pytest.fixture
def controller(monkeypatch: pytest.MonkeyPatch) -> SubscriptionInMemory:
    controller = SubscriptionInMemory(FakeClock())
    monkeypatch.setattr(sensor_module, "Subscription", controller.subscribe)
    return controller


@pytest.fixture
def sensor(controller: SubscriptionInMemory) -> Iterator[Wrist]:
    sensor = Wrist(HOST, counts_per_N=200.0, counts_per_Nm=100.0, clock=controller.clock)
    yield sensor
    sensor.close()


def test_raw_wrench_is_scaled_as_configured(controller: SubscriptionInMemory, sensor: Wrist) -> None:
    sensor.open()
    samples = sensor.collect(0.1)
    info = sensor.identify()
    np.testing.assert_allclose(samples.wrench[0], [100, -20, 5, 0.5, -0.2, 0.1])
    assert samples.counts.shape == (len(samples), 0)
    assert len(samples) > 30
    assert sensor.health().lost == 0
    assert (np.diff(samples.seq) == 1).all()
    np.testing.assert_allclose(np.diff(samples.t_device_s), 0.002, atol=1e-9)
    assert "ft_raw_wrench" in info.model
    assert info.facts["counts_per_N"] == Fact(200.0, "configured")
    assert "serial" not in info.facts
    assert info.has_arbitrary_zero
    assert info.firmware == "5.15.0.1"
    assert controller.asked == [(HOST, {"timestamp": "DOUBLE", "ft_raw_wrench": "VECTOR6D"}, 500.0)]


def test_a_clock_that_goes_back_ends_the_stream(controller: SubscriptionInMemory, sensor: Wrist) -> None:
    controller.times = [*(50 + 0.002 * k for k in range(50)), 1.0]
    sensor.open()
    with pytest.raises(StreamBroken, match=r"1\.000 s"):
        sensor.collect(1.0)


def test_old_controllers_do_not_report_it(controller: SubscriptionInMemory, sensor: Wrist) -> None:
    controller.missing = ["ft_raw_wrench"]
    with pytest.raises(ConnectError) as error:
        sensor.open()
    assert "ft_raw_wrench" in error.value.found
    assert "5.9" in error.value.fix


@pytest.mark.parametrize(
    ("query", "says"),
    [
        ("", "'counts_per_N' is missing"),
        ("?counts_per_N=1", "'counts_per_Nm' is missing"),
        ("?counts_per_N=0&counts_per_Nm=1", "must be a positive number"),
        ("?counts_per_N=nan&counts_per_Nm=1", "must be a positive number"),
        ("?counts_per_N=1&counts_per_Nm=x", "must be a positive number"),
    ],
)
def test_without_a_scale_there_is_no_sensor(query: str, says: str) -> None:
    with pytest.raises(BadUrl, match=says):
        sensor_from_url(f"ur-ft://192.168.1.10{query}")


def test_lost_connection(controller: SubscriptionInMemory, sensor: Wrist) -> None:
    controller.ends_after_s = 0.1
    sensor.open()
    begin_s = controller.clock.now_s()
    with pytest.raises(StreamBroken, match="connection was lost"):
        sensor.collect(5.0)
    assert controller.clock.now_s() - begin_s < 0.12


def test_a_wrench_that_is_no_number_ends_the_stream(controller: SubscriptionInMemory, sensor: Wrist) -> None:
    controller.raw = [math.nan] * 6
    with pytest.raises(ConnectError, match="not finite"):
        sensor.open()
