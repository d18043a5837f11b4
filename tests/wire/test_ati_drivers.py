"""Both ATI drivers against the emulators, which run in a process of their own: one suite, two wires."""

import json
import math
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from drivers._stream import StreamingSensor
from drivers.errors import ConnectError, DeviceFault, DeviceTimeout, StreamBroken
from drivers.interfaces import ForceTorqueSensor
from drivers.registry import sensor_from_url

WRENCH = np.array([10.0, -5.0, 20.0, 0.5, -0.25, 0.1])
QUANTISATION = np.array([0.01] * 3 + [0.5e-3] * 3)

PROGRAM = """
import json, sys
import numpy as np
from mocks.ati_can import AtiCanNode
from mocks.ati_serial import AtiSerialBox
from mocks.faults import Faults

wrench = np.array(json.loads(sys.argv[1]))
rng = np.random.default_rng(1)
measure = lambda n: wrench + rng.normal(size=(n, 6)) * ([0.03] * 3 + [0.001] * 3)
kinds = {"can": AtiCanNode, "serial": AtiSerialBox}
devices = []
for line in sys.stdin:
    word, argument, options = json.loads(line)
    if word == "start":
        faults = Faults(**options.pop("faults", {}))
        devices.append(kinds[argument](measure, seed=2, faults=faults, **options))
        print(len(devices) - 1, devices[-1].start(), flush=True)
    else:
        getattr(devices[argument], word)()
        print("done", flush=True)
"""


class Laboratory:
    """Emulated sensors in one child process."""

    def __init__(self) -> None:
        arguments = [sys.executable, "-c", PROGRAM, json.dumps(WRENCH.tolist())]
        self.process = subprocess.Popen(arguments, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)

    def tell(self, word: str, argument: str | int, options: dict[str, Any] | None = None) -> str:
        assert self.process.stdin
        assert self.process.stdout
        self.process.stdin.write(json.dumps([word, argument, options]) + "\n")
        self.process.stdin.flush()
        return self.process.stdout.readline().strip()

    def close(self) -> None:
        self.process.communicate(timeout=5)


class Emulator:
    """One emulated sensor."""

    def __init__(self, laboratory: Laboratory, wire: str, options: dict[str, Any]) -> None:
        self.wire = wire
        self.laboratory = laboratory
        number, self.path = laboratory.tell("start", wire, options).split()
        self._number = int(number)

    def sensor(self, options: str = "", sign: int = 1) -> ForceTorqueSensor:
        query = "&".join(filter(None, ["interface=slcan" if self.wire == "can" else "", options]))
        sensor = sensor_from_url(f"ati-{self.wire}://{self.path}?{query}".rstrip("?"), sign=sign)
        assert isinstance(sensor, StreamingSensor)
        return sensor

    def unplug(self) -> None:
        assert self.laboratory.tell("unplug", self._number) == "done"

    def stop(self) -> None:
        assert self.laboratory.tell("stop", self._number) == "done"


Start = Callable[..., Emulator]


@pytest.fixture(scope="module")
def laboratory() -> Iterator[Laboratory]:
    laboratory = Laboratory()
    yield laboratory
    laboratory.close()


@pytest.fixture
def start(laboratory: Laboratory) -> Iterator[Start]:
    running: list[Emulator] = []

    def run(wire: str, **options: Any) -> Emulator:
        running.append(Emulator(laboratory, wire, options))
        return running[-1]

    yield run
    for emulator in running:
        emulator.stop()


@pytest.fixture(params=["can", "serial"])
def wire(request: pytest.FixtureRequest) -> str:
    return str(request.param)


@pytest.fixture(scope="module", params=["can", "serial"])
def shared(request: pytest.FixtureRequest, laboratory: Laboratory) -> Iterator[Emulator]:
    """A healthy emulator for tests that leave it as they found it."""
    emulator = Emulator(laboratory, request.param, {})
    yield emulator
    emulator.stop()


def test_wrench_counts_and_samples(shared: Emulator) -> None:
    with shared.sensor() as sensor:
        samples = sensor.collect(0.5)
        info, health = sensor.identify(), sensor.health()
    standard_error = np.array([0.03] * 3 + [0.001] * 3) / math.sqrt(len(samples))
    assert (np.abs(samples.wrench.mean(axis=0) - WRENCH) < QUANTISATION + 5 * standard_error).all()
    assert samples.seq[-1] - samples.seq[0] + 1 - len(samples) <= health.lost  # no gap that is not accounted for
    assert (np.diff(samples.seq) >= 1).all()
    assert (np.diff(samples.t_host_ns) >= 0).all()
    assert samples.counts.shape == (len(samples), 6)
    assert len(samples) > (150 if shared.wire == "can" else 3000)
    assert np.isnan(samples.t_device_s).all()
    assert info.serial.startswith("FT")
    assert health.lost <= 0.01 * len(samples)
    assert health.malformed == 0
    assert health.rate_Hz == pytest.approx(2 * len(samples), rel=0.3)


def test_counts_and_wrench_tell_the_same(shared: Emulator) -> None:
    """One linear map, found from the data, takes all counts to all wrenches."""
    with shared.sensor() as sensor:
        samples = sensor.collect(0.2)
    counts = samples.counts.astype(float)
    matrix, *_ = np.linalg.lstsq(counts, samples.wrench, rcond=None)
    np.testing.assert_allclose(counts @ matrix, samples.wrench, atol=1e-9)
    np.testing.assert_allclose(matrix.T[0], np.array([0, 0, 0, -4250, 0, 4250]) * 1e-6, atol=1e-9)


def test_sign_turns_the_reading(shared: Emulator) -> None:
    with shared.sensor(sign=-1) as sensor:
        np.testing.assert_allclose(sensor.collect(0.1).wrench.mean(axis=0), -WRENCH, atol=0.05)


def test_latest_is_fresh_and_moves_on(shared: Emulator) -> None:
    with shared.sensor() as sensor:
        first = sensor.latest(timeout_s=0.5)
        sensor.collect(0.05)
        second = sensor.latest(timeout_s=0.5)
        assert time.monotonic_ns() - second.t_host_ns[0] < 0.1e9
        assert len(first) == len(second) == 1
        assert second.seq[0] > first.seq[0]


def test_open_close_reopen(shared: Emulator) -> None:
    sensor = shared.sensor()
    for _ in range(3):
        sensor.open()
        sensor.open()
        sensor.check()
        start = time.monotonic()
        sensor.close()
        sensor.close()
        assert time.monotonic() - start < 1.0
    assert not any("reader" in thread.name for thread in threading.enumerate())


def test_nothing_stays_open(shared: Emulator) -> None:
    def descriptors() -> int:
        return len(list(Path("/proc/self/fd").iterdir()))

    with shared.sensor():
        pass
    before = descriptors()
    for _ in range(3):
        with shared.sensor():
            pass
    assert descriptors() == before


def test_unplugged_is_a_broken_stream_at_once(start: Start, wire: str) -> None:
    emulator = start(wire)
    sensor = emulator.sensor()
    calls: list[Callable[[], object]] = [
        lambda: sensor.collect(5.0),
        lambda: sensor.latest(timeout_s=0.01),
        sensor.check,
    ]
    broken_at: list[float] = []

    def call_until_broken(call: Callable[[], object]) -> None:
        try:
            while not pause.wait(0.01):
                call()
        except StreamBroken:
            broken_at.append(time.monotonic())

    pause = threading.Event()
    with sensor:
        threads = [threading.Thread(target=call_until_broken, args=[call]) for call in calls]
        for thread in threads:
            thread.start()
        sensor.collect(0.05)
        emulator.unplug()
        unplugged = time.monotonic()
        for thread in threads:
            thread.join(3.0)
        assert len(broken_at) == 3
        assert max(broken_at) - unplugged < 0.5
        closing = time.monotonic()
        sensor.close()
        assert time.monotonic() - closing < 1.0


def test_silent_device_is_no_device(start: Start, wire: str) -> None:
    with pytest.raises(ConnectError, match="supply"):
        start(wire, faults={"stall": True}).sensor().open()


def test_saturated_gauge_is_a_fault(start: Start, wire: str) -> None:
    with pytest.raises(DeviceFault, match="gauge G3 at the end of its range"):
        start(wire, saturated_gauge=3).sensor().open()


def test_critical_status_is_a_fault(start: Start, wire: str) -> None:
    with pytest.raises(DeviceFault, match=r"0x8010 \(bit 4: power supply too high, bit 15: any error\)"):
        start(wire, status=0x8010).sensor().open()


def test_can_error_bit_alone_is_only_a_warning(start: Start, wire: str, caplog: pytest.LogCaptureFixture) -> None:
    with start(wire, status=0x4000).sensor() as sensor:
        assert (sensor.collect(0.1).status == 0x4000).all()
    assert caplog.text.count("CAN bus error") == 1


def test_can_survives_foreign_late_swapped_and_doubled_frames(start: Start) -> None:
    emulator = start("can", faults={"foreign": 0.3, "swap": 0.2, "duplicate": 0.2, "delay_s": 0.001, "jitter_s": 0.002})
    with emulator.sensor() as sensor:
        samples = sensor.collect(0.5)
        health = sensor.health()
    assert np.abs(samples.wrench - WRENCH).max() < 0.3
    assert len(samples) > 50
    assert health.lost <= 3  # an answer is late on a busy machine, none is lost


def test_can_lost_frames_are_gaps_not_wrong_samples(start: Start) -> None:
    with start("can", faults={"drop": 0.02}).sensor() as sensor:
        samples = sensor.collect(0.5)
        health = sensor.health()
    assert np.abs(samples.wrench - WRENCH).max() < 0.3
    gaps = int((np.diff(samples.seq) - 1).sum())
    assert 0 < gaps <= health.lost


def test_can_wrong_slot_echo_is_refused(start: Start) -> None:
    with pytest.raises(ConnectError, match="slot 0, the sensor answered 5"):
        start("can", wrong_echo=5).sensor().open()


def test_can_empty_slot_is_a_fault(start: Start) -> None:
    with pytest.raises(DeviceFault, match="slot 9 is empty"):
        start("can").sensor("slot=9").open()


def test_can_base_and_bit_rate_must_match(start: Start) -> None:
    emulator = start("can", base=0x7F, bitrate=500_000)
    with emulator.sensor("base=0x7F&bitrate=500000") as sensor:
        sensor.collect(0.05)
    with pytest.raises(ConnectError, match="bit rate"):
        emulator.sensor("base=0x7F").open()
    with pytest.raises(ConnectError, match="base identifier"):
        emulator.sensor("bitrate=500000").open()


def test_can_old_firmware(start: Start, caplog: pytest.LogCaptureFixture) -> None:
    with start("can", firmware=(3, 6, 1)).sensor() as sensor:
        np.testing.assert_allclose(sensor.collect(0.1).wrench.mean(axis=0), WRENCH, atol=0.05)
        assert sensor.identify().firmware == "3.6 build 1"
    assert "does not tell its units" in caplog.text


def test_serial_left_streaming_by_a_dead_program(start: Start) -> None:
    with start("serial", streaming_at_start=True).sensor() as sensor:
        np.testing.assert_allclose(sensor.collect(0.1).wrench.mean(axis=0), WRENCH, atol=0.05)


def test_serial_bad_checksums_are_dropped_and_counted(start: Start) -> None:
    with start("serial", bad_checksum=0.01).sensor() as sensor:
        samples = sensor.collect(0.5)
        health = sensor.health()
    assert np.abs(samples.wrench - WRENCH).max() < 0.3
    gaps = int((np.diff(samples.seq) - 1).sum())
    assert gaps == pytest.approx(35, abs=25)
    assert 0 < gaps <= health.lost
    assert health.malformed == health.lost


def test_serial_slips_are_noticed_and_the_stream_restarted(start: Start) -> None:
    with start("serial", faults={"byte_slip": 0.0005}).sensor() as sensor:
        samples = sensor.collect(1.0)
        health = sensor.health()
    assert (np.abs(samples.wrench - WRENCH).max(axis=1) > 0.3).sum() <= 1  # one in 128 slips passes a checksum
    assert health.lost > 0
    gaps = int((np.diff(samples.seq) - 1).sum())
    assert gaps > 50
    assert samples.seq[-1] - samples.seq[0] == pytest.approx(7000, rel=0.05)


def test_serial_refused_start(start: Start) -> None:
    with pytest.raises(ConnectError, match="refused command 0x46 0x55"):
        start("serial", refuse_start=True).sensor().open()


def test_serial_empty_calibration(start: Start) -> None:
    with pytest.raises(ConnectError, match="slot is empty"):
        start("serial").sensor("calibration=9").open()


def test_stopped_emulator_process_is_silence_not_old_values(start: Start, wire: str) -> None:
    emulator = start(wire)
    with emulator.sensor() as sensor:
        emulator.laboratory.process.send_signal(signal.SIGSTOP)
        try:
            with pytest.raises(DeviceTimeout, match=r"silent|in a row"):
                sensor.collect(1.0)
            with pytest.raises(DeviceTimeout, match=r"silent|in a row"):
                sensor.latest(timeout_s=0.05)
            started = time.monotonic()
            sensor.close()
            assert time.monotonic() - started < 1.0
        finally:
            emulator.laboratory.process.send_signal(signal.SIGCONT)
