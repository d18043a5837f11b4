"""All sensor drivers against their emulators, which run in a process of their own: one suite, eight wires."""

import gc
import math
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import pytest

from ftdrivers.clock import Clock
from ftdrivers.errors import ConnectError, DeviceFault, DeviceTimeout, StreamBroken
from ftdrivers.probe import probe_serial
from ftdrivers.sensors import SENSORS
from ftdrivers.streaming.sensor import StreamingSensor
from tests.wire.sensor_kinds import KINDS

WRENCH = np.array([10.0, -5.0, 20.0, 0.5, -0.25, 0.1])  # what the emulators of conftest.py measure, with
NOISE = np.array([0.03] * 3 + [0.001] * 3)

SCHEMES = tuple(name for name in KINDS if name != "ur-ft")


class Emulator(Protocol):
    """What the tests use of an emulated sensor."""

    kind: Any
    clock: Clock
    endpoint: Any

    def sensor(self, options: str = "", sign: int = 1) -> StreamingSensor: ...

    def faults(self, **options: Any) -> None: ...

    def unplug(self) -> None: ...

    def reset(self) -> None: ...


Start = Callable[..., Emulator]


def test_wrench_counts_and_samples(shared: Emulator) -> None:
    kind = shared.kind
    with shared.sensor() as sensor:
        samples = sensor.collect(0.3)
        info, health = sensor.identify(), sensor.health()
    n = len(samples)
    bound = np.repeat(kind.resolution, 3) / 2 + 5 * np.hypot(NOISE, np.repeat(kind.resolution, 3)) / math.sqrt(n)
    assert (np.abs(samples.wrench.mean(axis=0) - WRENCH) < bound).all()
    assert (np.diff(samples.seq) >= 1).all()
    assert samples.seq[-1] - samples.seq[0] + 1 - n <= health.lost <= max(3, 0.01 * n)
    assert (np.diff(samples.t_host_ns) >= 0).all()
    if kind.scheme == "ati-can":  # polled: as many as the machine can
        assert 10 < n < 0.33 * kind.rate_Hz
    else:
        assert n == pytest.approx(0.3 * kind.rate_Hz, rel=0.1)
    assert samples.counts.shape == (n, kind.counts)
    assert (samples.status == 0).all()
    assert info.serial.startswith(kind.serial)
    assert health.malformed == 0
    if kind.scheme != "ati-can":
        assert health.nominal_rate_Hz == pytest.approx(kind.rate_Hz, rel=0.01)


def test_open_close_reopen_and_nothing_stays(shared: Emulator) -> None:
    def descriptors() -> int:
        gc.collect()  # other tests' descriptors, which would be closed in between
        return len(list(Path("/proc/self/fd").iterdir()))

    with shared.sensor():
        pass  # what libraries open once and for all is open now
    before, threads = descriptors(), threading.active_count()
    sensor = shared.sensor()
    for _ in range(2):
        sensor.open()
        sensor.open()
        sensor.check()
        sensor.close()
        sensor.close()
    assert (descriptors(), threading.active_count()) == (before, threads)


@pytest.mark.parametrize("scheme", [scheme for scheme in SCHEMES if scheme not in {"ati-can", "robotiq-urcap"}])
def test_already_streaming_when_opened(start: Start, scheme: str) -> None:
    """A client died, or the sensor streams from power-up on. Nothing arrives unasked on CAN or from a URCap."""
    with start(scheme, streaming_at_start=("127.0.0.1", 9) if scheme == "ati-netft" else True).sensor() as sensor:
        np.testing.assert_allclose(sensor.collect(0.1).wrench.mean(axis=0), WRENCH, atol=0.1)


@pytest.mark.slow
@pytest.mark.parametrize("scheme", [name for name in SCHEMES if SENSORS[KINDS[name].scheme].wire == "serial"])
def test_a_probe_finds_it(start: Start, scheme: str) -> None:
    emulator = start(scheme)
    if isinstance(emulator.endpoint, dict):
        pytest.skip("a sensor on the controller has no port to probe")
    answer = probe_serial(emulator.endpoint, emulator.clock)
    assert answer is not None
    assert answer.url is not None
    assert answer.url.startswith(f"{emulator.kind.scheme}://")


def test_unplugged_is_broken_at_once_and_for_good(start: Start) -> None:
    """Of one driver: what all share, `streaming/`. The slow `test_sensor_faults.py` has all of them."""
    emulator = start("robotous-serial")
    sensor = emulator.sensor()
    sensor.open()
    unplugging = threading.Thread(target=emulator.unplug)
    begin_s = emulator.clock.now_s()
    unplugging.start()
    with pytest.raises(StreamBroken) as caught:
        sensor.collect(60.0)
    unplugging.join()
    assert "again" in caught.value.fix
    assert emulator.clock.now_s() - begin_s < 10.0  # long before the collection would have ended
    with pytest.raises(StreamBroken):
        sensor.latest(timeout_s=0.1)
    with pytest.raises(StreamBroken):
        sensor.check()
    sensor.close()
    with pytest.raises(ConnectError):
        sensor.open()


def test_silence_is_an_error(start: Start) -> None:
    emulator = start("robotous-serial")
    with emulator.sensor() as sensor:
        emulator.faults(stall=True)
        with pytest.raises((DeviceTimeout, StreamBroken), match=r"no new sample|ended"):
            sensor.collect(60.0)


@pytest.mark.parametrize(
    "scheme",
    [
        pytest.param(scheme, marks=[] if scheme == "robotous-serial" else pytest.mark.slow)
        for scheme in SCHEMES
        if scheme not in {"bota", "robotiq-urcap"}  # the first may boot, the second is connected
    ],
)
def test_a_silent_device_is_no_device(start: Start, scheme: str) -> None:
    emulator = start(scheme)
    emulator.faults(stall=True)
    with pytest.raises(ConnectError) as caught:
        emulator.sensor().open()
    assert "supply" in caught.value.fix


@pytest.mark.parametrize(
    ("scheme", "fault"),
    [
        ("robotous-serial", "drop"),
        ("robotous-serial", "corrupt"),
        ("robotous-serial", "byte_slip"),
        ("robotous-can", "drop"),
        ("bota", "drop"),
    ],
)
def test_damage_is_dropped_and_counted(start: Start, scheme: str, fault: str) -> None:
    emulator = start(scheme)
    has_no_number = (scheme, fault) == ("robotous-serial", "drop")  # its frames: documented
    with emulator.sensor() as sensor:
        # a sample is two frames on CAN
        emulator.faults(**{fault: 0.05 if scheme == "robotous-can" else 0.2})
        for _ in range(20):  # by chance a short record has no damage
            samples = sensor.collect(0.25)
            gaps = int((np.diff(samples.seq) - 1).sum())
            if gaps or has_no_number:
                break
        health = sensor.health()
    assert np.abs(samples.wrench - WRENCH).max() < 0.3
    if has_no_number:
        assert gaps == 0
    else:
        assert 0 < gaps <= health.lost
    # with a lost half on CAN goes all that came together with it: much, where this program is starved
    assert len(samples) > (0 if scheme == "robotous-can" else gaps)


@pytest.mark.parametrize(
    ("status", "says"), [(2, "overrange"), pytest.param(4, "invalid", marks=pytest.mark.slow), (8, "not in N")]
)
def test_bota_unusable_samples_are_a_fault(start: Start, status: int, says: str) -> None:
    with pytest.raises(DeviceFault, match=says):
        start("bota", status=status).sensor().open()


def test_bota_too_slow_is_a_warning(start: Start, caplog: pytest.LogCaptureFixture) -> None:
    with start("bota", status=1).sensor() as sensor:
        assert (sensor.collect(0.1).status == 1).all()
    assert caplog.text.count("application too slow") == 1


@pytest.mark.parametrize(
    ("options", "query"),
    [
        ({"baud_code": 1}, "baud=57600"),
        pytest.param({"baud_code": 3, "boot_s": 1}, "", marks=pytest.mark.slow),
        pytest.param({}, "sinc=256", marks=pytest.mark.slow),
    ],
)
def test_bota_is_found_at_its_baud_rate_while_it_boots(start: Start, options: dict[str, Any], query: str) -> None:
    with start("bota", **options).sensor(query) as sensor:
        np.testing.assert_allclose(sensor.collect(0.2).wrench.mean(axis=0), WRENCH, atol=0.1)
        assert sensor.identify().serial == "12345"
        assert sensor.health().nominal_rate_Hz == pytest.approx(200 if query == "sinc=256" else 100)


@pytest.mark.parametrize(
    ("options", "query"),
    [
        ({"calibration": {"counts_per_force": 416_666, "counts_per_torque": 1_000}}, ""),
        ({"calibration": {"force_unit": 1, "torque_unit": 4}}, ""),
        (
            {
                "calibration": {"counts_per_force": 10_000, "counts_per_torque": 100_000, "serial": "X"},
                "tool_transform": [0.0] * 6,
            },
            "onrobot=1",
        ),
        ({"tool_transform": [10.0, -20.0, 132.71, 20.0, -30.0, 40.0]}, ""),
        ({"tool_transform": [1.0, -2.0, 5.0, 0.3, -0.5, 0.7], "distance_unit": 1, "angle_unit": 2}, ""),
    ],
)
def test_netft_scale(start: Start, options: dict[str, Any], query: str) -> None:
    with start("ati-netft", **options).sensor(query) as sensor:
        samples = sensor.collect(0.1)
        health = sensor.health()
    np.testing.assert_allclose(samples.wrench.mean(axis=0), WRENCH, atol=0.03)
    assert (np.diff(samples.seq) == 1).all()
    assert health.lost == 0


def test_netft_latched_monitor_is_a_warning(start: Start, caplog: pytest.LogCaptureFixture) -> None:
    with start("ati-netft", status=0x80010000).sensor() as sensor:
        sensor.collect(0.1)
    assert caplog.text.count("monitor condition latched") == 1


@pytest.mark.slow
def test_netft_without_rdt_says_so(start: Start) -> None:
    with pytest.raises(ConnectError, match="enable RDT"):
        start("ati-netft", rdt_enabled=False).sensor().open()
