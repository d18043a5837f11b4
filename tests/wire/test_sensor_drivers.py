"""Robotous, Robotiq, Bota and Net F/T drivers against their emulators, which run in a process of their own."""

import json
import math
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from drivers._stream import StreamingSensor
from drivers.errors import ConnectError, DeviceFault, DeviceTimeout, StreamBroken
from drivers.registry import BadUrl, sensor_from_url

WRENCH = np.array([10.0, -5.0, 20.0, 0.5, -0.25, 0.1])
NOISE = np.array([0.03] * 3 + [0.001] * 3)

PROGRAM = """
import json, sys
import numpy as np
from mocks.bota import BotaBox
from mocks.faults import Faults
from mocks.netft import Calibration, NetFtBox
from mocks.robotiq import RobotiqBox
from mocks.robotous import Model, RobotousCanNode, RobotousSerialBox

wrench, noise = np.array(json.loads(sys.argv[1])), np.array(json.loads(sys.argv[2]))
rng = np.random.default_rng(1)
measure = lambda n: wrench + rng.normal(size=(n, 6)) * noise
kinds = {"robotous-can": RobotousCanNode, "robotous-serial": RobotousSerialBox, "robotiq-ft300": RobotiqBox,
         "bota": BotaBox, "ati-netft": NetFtBox}
parts = {"faults": Faults, "model": Model, "calibration": Calibration}
devices = []
for line in sys.stdin:
    word, argument, options = json.loads(line)
    if word == "start":
        options = {key: parts[key](**value) if key in parts else tuple(value) if isinstance(value, list) else value
                   for key, value in options.items()}
        devices.append(kinds[argument](measure, seed=2, **options))
        print(json.dumps([len(devices) - 1, devices[-1].start()]), flush=True)
    elif word == "faults":
        for key, value in options.items():
            setattr(devices[argument].faults, key, value)
        print("done", flush=True)
    else:
        getattr(devices[argument], word)()
        print("done", flush=True)
"""


@dataclass(frozen=True)
class Kind:
    """What a test must know about one sort of device."""

    scheme: str
    query: str
    quantisation: tuple[float, float]
    rate_Hz: float
    counts: int
    serial: str
    options: dict[str, Any]


KINDS = {
    kind.scheme: kind
    for kind in (
        Kind("robotous-can", "interface=slcan", (0.02, 0.0005), 200, 6, "A60HA00123", {}),
        Kind("robotous-serial", "", (0.02, 0.0005), 200, 6, "A60HA00123", {}),
        Kind("robotiq-ft300", "", (0.01, 0.001), 100, 6, "FTS-1234", {}),
        Kind("bota", "", (1e-5, 1e-6), 100, 0, "not reported", {}),
        Kind("ati-netft", "", (1e-6, 1e-6), 1000, 6, "FT12345", {"rdt_port": 0, "rate_hz": 1000}),
    )
}


class Laboratory:
    """Emulated sensors in one child process."""

    def __init__(self) -> None:
        arguments = [sys.executable, "-c", PROGRAM, json.dumps(WRENCH.tolist()), json.dumps(NOISE.tolist())]
        self.process = subprocess.Popen(arguments, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
        self._lock = threading.Lock()

    def tell(self, word: str, argument: str | int, options: dict[str, Any] | None = None) -> str:
        assert self.process.stdin
        assert self.process.stdout
        with self._lock:
            self.process.stdin.write(json.dumps([word, argument, options]) + "\n")
            self.process.stdin.flush()
            return self.process.stdout.readline().strip()

    def close(self) -> None:
        self.process.communicate(timeout=5)


class Emulator:
    """One emulated sensor."""

    def __init__(self, laboratory: Laboratory, scheme: str, options: dict[str, Any]) -> None:
        self.kind = KINDS[scheme]
        self._laboratory = laboratory
        self._number, self.endpoint = json.loads(laboratory.tell("start", scheme, self.kind.options | options))

    def sensor(self, options: str = "", sign: int = 1) -> StreamingSensor:
        where, ports = self.endpoint, []
        if isinstance(where, dict):
            ports = [f"{key}={where[key]}" for key in ("rdt_port", "http_port")]
            where = where["host"]
        query = "&".join(filter(None, [self.kind.query, *ports, options]))
        sensor = sensor_from_url(f"{self.kind.scheme}://{where}?{query}".rstrip("?"), sign=sign)
        assert isinstance(sensor, StreamingSensor)
        return sensor

    def faults(self, **options: Any) -> None:
        assert self._laboratory.tell("faults", self._number, options) == "done"

    def unplug(self) -> None:
        assert self._laboratory.tell("unplug", self._number) == "done"

    def reset(self) -> None:
        assert self._laboratory.tell("reset", self._number) == "done"

    def stop(self) -> None:
        assert self._laboratory.tell("stop", self._number) == "done"


Start = Callable[..., Emulator]


@pytest.fixture(scope="module")
def laboratory() -> Iterator[Laboratory]:
    laboratory = Laboratory()
    yield laboratory
    laboratory.close()


@pytest.fixture
def start(laboratory: Laboratory) -> Iterator[Start]:
    running: list[Emulator] = []

    def run(scheme: str, **options: Any) -> Emulator:
        running.append(Emulator(laboratory, scheme, options))
        return running[-1]

    yield run
    for emulator in running:
        emulator.stop()


@pytest.fixture(scope="module", params=KINDS)
def shared(request: pytest.FixtureRequest, laboratory: Laboratory) -> Iterator[Emulator]:
    """A healthy emulator for tests that leave it as they found it."""
    emulator = Emulator(laboratory, request.param, {})
    yield emulator
    emulator.stop()


@pytest.fixture(params=KINDS)
def scheme(request: pytest.FixtureRequest) -> str:
    return str(request.param)


def test_wrench_counts_and_samples(shared: Emulator) -> None:
    kind = shared.kind
    with shared.sensor() as sensor:
        samples = sensor.collect(0.5)
        info, health = sensor.identify(), sensor.health()
    n = len(samples)
    bound = np.repeat(kind.quantisation, 3) / 2 + 5 * np.hypot(NOISE, np.repeat(kind.quantisation, 3)) / math.sqrt(n)
    assert (np.abs(samples.wrench.mean(axis=0) - WRENCH) < bound).all()
    assert (np.diff(samples.seq) == 1).all()
    assert (np.diff(samples.t_host_ns) >= 0).all()
    assert 0.1 * kind.rate_Hz < n < 0.65 * kind.rate_Hz  # few on a busy computer, never more
    assert samples.counts.shape == (n, kind.counts)
    assert (samples.status == 0).all()
    assert info.serial == kind.serial
    assert (health.lost, health.malformed) == (0, 0)


def test_counts_and_wrench_tell_the_same(shared: Emulator) -> None:
    with shared.sensor() as sensor:
        samples = sensor.collect(0.2)
    if not shared.kind.counts:
        return
    scale = {"ati-netft": [1e6] * 6, "robotiq-ft300": [100] * 3 + [1000] * 3}.get(
        shared.kind.scheme, [50] * 3 + [2000] * 3
    )
    np.testing.assert_allclose(samples.counts / np.array(scale), samples.wrench, rtol=1e-12)


def test_sign_turns_the_reading(shared: Emulator) -> None:
    with shared.sensor(sign=-1) as sensor:
        np.testing.assert_allclose(sensor.collect(0.3).wrench.mean(axis=0), -WRENCH, atol=0.1)


def test_latest_is_fresh_and_moves_on(shared: Emulator) -> None:
    with shared.sensor() as sensor:
        first = sensor.latest(timeout_s=0.5)
        sensor.collect(0.05)
        second = sensor.latest(timeout_s=0.5)
        assert time.monotonic_ns() - second.t_host_ns[0] < 0.1e9
        assert len(first) == len(second) == 1
        assert second.seq[0] > first.seq[0]


def test_open_close_reopen_and_nothing_stays(shared: Emulator) -> None:
    def descriptors() -> int:
        return len(list(Path("/proc/self/fd").iterdir()))

    with shared.sensor():
        pass  # what libraries open once and for all is open now
    before, threads = descriptors(), threading.active_count()
    sensor = shared.sensor()
    for _ in range(2):
        sensor.open()
        sensor.open()
        sensor.check()
        begin = time.monotonic()
        sensor.close()
        sensor.close()
        assert time.monotonic() - begin < 0.5
    assert (descriptors(), threading.active_count()) == (before, threads)


def test_already_streaming_when_opened(start: Start, scheme: str) -> None:
    """A client died, or the sensor streams from power-up on."""
    with start(scheme, streaming_at_start=("127.0.0.1", 9) if scheme == "ati-netft" else True).sensor() as sensor:
        np.testing.assert_allclose(sensor.collect(0.3).wrench.mean(axis=0), WRENCH, atol=0.1)


def test_unplugged_is_broken_at_once_and_for_good(start: Start, scheme: str) -> None:
    emulator = start(scheme)
    sensor = emulator.sensor()
    sensor.open()
    begin = time.monotonic()
    threading.Timer(0.2, emulator.unplug).start()
    with pytest.raises(StreamBroken, match="again"):
        sensor.collect(5.0)
    assert time.monotonic() - begin < 0.2 + 0.5
    with pytest.raises(StreamBroken):
        sensor.latest(timeout_s=0.1)
    with pytest.raises(StreamBroken):
        sensor.check()
    begin = time.monotonic()
    sensor.close()
    assert time.monotonic() - begin < 1.0
    with pytest.raises(ConnectError):
        sensor.open()


def test_silence_is_an_error(start: Start, scheme: str) -> None:
    emulator = start(scheme)
    with emulator.sensor() as sensor:
        emulator.faults(stall=True)
        with pytest.raises((DeviceTimeout, StreamBroken), match=r"silent|ended"):
            sensor.collect(2.0)


@pytest.mark.parametrize("scheme", sorted(KINDS.keys() - {"bota"}))  # a Bota is given 3 s to boot: see the unit tests
def test_a_silent_device_is_no_device(start: Start, scheme: str) -> None:
    emulator = start(scheme)
    emulator.faults(stall=True)
    begin = time.monotonic()
    with pytest.raises(ConnectError, match="supply"):
        emulator.sensor().open()
    assert time.monotonic() - begin < 4.0


@pytest.mark.parametrize(
    ("scheme", "fault"),
    [
        (scheme, fault)
        for scheme in KINDS
        for fault in ("drop", "corrupt", "byte_slip")
        # CAN controllers and UDP drop damaged frames themselves
        if fault == "drop" or scheme not in {"robotous-can", "ati-netft"}
    ],
)
def test_damage_is_dropped_and_counted(start: Start, scheme: str, fault: str) -> None:
    emulator = start(scheme)
    with emulator.sensor() as sensor:
        emulator.faults(**{fault: 0.2})
        samples = sensor.collect(0.35)
        health = sensor.health()
    assert np.abs(samples.wrench - WRENCH).max() < 0.3
    gaps = int((np.diff(samples.seq) - 1).sum())
    if fault == "drop" and scheme in {"robotous-serial", "robotiq-ft300"}:
        assert gaps == 0  # frames carry no number: documented
    else:
        assert 0 < gaps <= health.lost
    assert len(samples) > gaps


def test_swapped_and_doubled_frames_are_no_new_samples(start: Start) -> None:
    emulator = start("ati-netft")
    with emulator.sensor() as sensor:
        emulator.faults(swap=0.1, duplicate=0.1)
        samples = sensor.collect(0.5)
    assert (np.diff(samples.seq) >= 1).all()


@pytest.mark.parametrize("axis", [0, 4])
def test_robotous_overload_names_its_axis(start: Start, axis: int) -> None:
    for scheme in ("robotous-can", "robotous-serial"):
        name = ["Fx", "Fy", "Fz", "Tx", "Ty", "Tz"][axis]
        with pytest.raises(DeviceFault, match=f"overload of {name};"):
            start(scheme, overload=0b100000 >> axis).sensor().open()


@pytest.mark.parametrize(
    ("name", "torque_divisor"), [("RFT40-SA01", 2000), ("RFT76-HA01", 2000), ("RFT80-6A01", 1000), ("RFT82-HA01", 1000)]
)
def test_robotous_scale_follows_the_model(start: Start, name: str, torque_divisor: float) -> None:
    with start("robotous-can", model={"name": name, "torque_divisor": torque_divisor}).sensor() as sensor:
        assert sensor.identify().model == f"Robotous {name}"
        np.testing.assert_allclose(sensor.collect(0.3).wrench.mean(axis=0), WRENCH, atol=0.05)


def test_robotous_of_unknown_model_is_refused(start: Start) -> None:
    with pytest.raises(ConnectError, match="scale of model 'RFT99-X' is not known"):
        start("robotous-serial", model={"name": "RFT99-X"}).sensor().open()


def test_robotous_rate(start: Start) -> None:
    with start("robotous-can").sensor("rate=1000") as sensor:
        assert 75 < len(sensor.collect(0.3)) < 330  # more than the 60 of the factory
    slow = start("robotous-serial")
    with slow.sensor("rate=50") as sensor:
        assert 8 < len(sensor.collect(0.4)) < 24
    with slow.sensor() as sensor:  # not asked for: stays as it is
        assert 8 < len(sensor.collect(0.4)) < 24


def test_robotous_uart_carries_a_kilohertz_at_921600_only(start: Start) -> None:
    with pytest.raises(BadUrl, match="500 Hz is the most"):
        sensor_from_url("robotous-serial:///dev/x?rate=1000")
    with start("robotous-serial", baud_code=1).sensor("baud=921600&rate=1000") as sensor:
        assert 75 < len(sensor.collect(0.3)) < 330  # more than the 60 of the factory


def test_robotiq_saturation_is_a_fault(start: Start) -> None:
    with pytest.raises(DeviceFault, match="end of its range"):
        start("robotiq-ft300", saturated_axis=2).sensor().open()


def test_robotiq_unknown_serial_number(start: Start) -> None:
    with start("robotiq-ft300", serial=("FTS", 0)).sensor() as sensor:
        assert sensor.identify().serial == "not reported"
        assert sensor.identify().firmware == "FTS-2.0.1"


@pytest.mark.parametrize(("status", "says"), [(2, "overrange"), (4, "invalid"), (8, "no newtons")])
def test_bota_unusable_samples_are_a_fault(start: Start, status: int, says: str) -> None:
    with pytest.raises(DeviceFault, match=says):
        start("bota", status=status).sensor().open()


def test_bota_too_slow_is_a_warning(start: Start, caplog: pytest.LogCaptureFixture) -> None:
    with start("bota", status=1).sensor() as sensor:
        assert (sensor.collect(0.1).status == 1).all()
    assert caplog.text.count("application too slow") == 1


def test_bota_clock_is_the_sensors(start: Start) -> None:
    with start("bota").sensor() as sensor:
        samples = sensor.collect(0.2)
    np.testing.assert_allclose(np.diff(samples.t_device_s), 0.01, atol=2e-6)


def test_bota_that_boots_is_awaited(start: Start) -> None:
    with start("bota", streaming_at_start=False, boot_s=0.5).sensor() as sensor:
        sensor.collect(0.1)


def test_bota_that_restarts_is_broken(start: Start) -> None:
    emulator = start("bota")
    with emulator.sensor() as sensor:
        sensor.collect(0.2)  # longer than it takes to boot: its clock goes back
        emulator.reset()
        with pytest.raises(StreamBroken, match="it has restarted"):
            sensor.collect(1.0)


def test_bota_is_configured_when_asked(start: Start) -> None:
    emulator = start("bota", sinc_length=512)
    with emulator.sensor("sinc=64") as sensor:
        assert 40 < len(sensor.collect(0.2)) < 180  # it was 20
    with emulator.sensor() as sensor:  # and left as it is, streaming
        assert 40 < len(sensor.collect(0.2)) < 180  # it was 20


@pytest.mark.parametrize(
    ("options", "query"),
    [
        ({"calibration": {"counts_per_force": 416_666, "counts_per_torque": 1_000}}, ""),
        ({"calibration": {"force_unit": 1, "torque_unit": 4}}, ""),
        ({"calibration": {"counts_per_force": 10_000, "counts_per_torque": 100_000, "serial": "X"}}, "onrobot=1"),
        ({"product": "Ethernet Axia"}, ""),
        ({"rate_hz": 7000}, ""),
    ],
)
def test_netft_scale(start: Start, options: dict[str, Any], query: str) -> None:
    with start("ati-netft", **options).sensor(query) as sensor:
        samples = sensor.collect(0.2)
        health = sensor.health()
    np.testing.assert_allclose(samples.wrench.mean(axis=0), WRENCH, atol=0.03)
    assert (np.diff(samples.seq) == 1).all()
    assert health.lost == 0


@pytest.mark.parametrize(
    ("status", "product", "query", "says"),
    [
        (0x80020000, "Net F/T", "", r"0x80020000 \(bit 17: transducer saturated or A/D error, bit 31: any error\)"),
        (0x88000000, "Ethernet Axia", "", "bit 27: gauge out of range"),
        (0x00000020, "", "onrobot=1", "bit 5: overload Fy"),
    ],
)
def test_netft_status_is_a_fault(start: Start, status: int, product: str, query: str, says: str) -> None:
    with pytest.raises(DeviceFault, match=says):
        start("ati-netft", status=status, product=product).sensor(query).open()


def test_netft_latched_monitor_is_a_warning(start: Start, caplog: pytest.LogCaptureFixture) -> None:
    with start("ati-netft", status=0x80010000).sensor() as sensor:
        sensor.collect(0.1)
    assert caplog.text.count("monitor condition latched") == 1


def test_netft_without_rdt_says_so(start: Start) -> None:
    with pytest.raises(ConnectError, match="is RDT enabled"):
        start("ati-netft", rdt_enabled=False).sensor().open()
