"""What is peculiar to the ATI drivers, against the emulators; what all sensors share is in `test_sensor_drivers.py`."""

from collections.abc import Callable
from typing import Any, Protocol

import numpy as np
import pytest

from ftdrivers.clock import Clock
from ftdrivers.errors import ConnectError, DeviceFault
from ftdrivers.streaming.sensor import StreamingSensor

WRENCH = np.array([10.0, -5.0, 20.0, 0.5, -0.25, 0.1])  # what the emulators of conftest.py measure


class Emulator(Protocol):
    """What the tests use of an emulated sensor."""

    laboratory: Any

    def sensor(self, options: str = "", sign: int = 1, clock: Clock | None = None) -> StreamingSensor: ...

    def unplug(self) -> None: ...


Start = Callable[..., Emulator]


@pytest.fixture(params=["ati-can", "ati-serial"])
def scheme(request: pytest.FixtureRequest) -> str:
    return str(request.param)


def test_gauges_and_wrench_give_the_same(start: Start, scheme: str) -> None:
    """One linear map, found from the data, takes all gauges to all wrenches."""
    with start(scheme).sensor() as sensor:
        samples = sensor.collect(0.2)
    counts = samples.counts.astype(float)
    matrix, *_ = np.linalg.lstsq(counts, samples.wrench, rcond=None)
    np.testing.assert_allclose(counts @ matrix, samples.wrench, atol=1e-9)
    np.testing.assert_allclose(matrix.T[0], np.array([0, 0, 0, -4250, 0, 4250]) * 1e-6, atol=1e-9)


def test_saturated_gauge_is_a_fault(start: Start, scheme: str) -> None:
    with pytest.raises(DeviceFault, match="gauge G3"):
        start(scheme, saturated_axis=3).sensor().open()


def test_critical_status_is_a_fault(start: Start, scheme: str) -> None:
    with pytest.raises(DeviceFault, match=r"0x8010 \(bit 4: .*, bit 15: "):
        start(scheme, status=0x8010).sensor().open()


def test_can_error_bit_alone_is_only_a_warning(start: Start, scheme: str, caplog: pytest.LogCaptureFixture) -> None:
    with start(scheme, status=0x4000).sensor() as sensor:
        assert (sensor.collect(0.1).status == 0x4000).all()
    assert caplog.text.count("CAN bus error") == 1


def test_any_error_without_a_critical_one_is_only_a_warning(start: Start, scheme: str) -> None:
    """Such as of a NETCANOEM on RS-485 whose CAN side is not connected: bits 14 and 15."""
    for status in (0x8000, 0xC000, 0x8100):
        with start(scheme, status=status).sensor() as sensor:
            samples = sensor.collect(0.3)
            health = sensor.health()
        assert (samples.status == status).all()
        assert np.abs(samples.wrench - WRENCH).max() < 0.3
        assert health.lost <= 3  # a poll may be late on a busy computer


def test_can_survives_foreign_late_swapped_and_doubled_frames(start: Start) -> None:
    emulator = start(
        "ati-can", faults={"foreign": 0.3, "swap": 0.2, "duplicate": 0.2, "delay_s": 0.001, "jitter_s": 0.002}
    )
    with emulator.sensor() as sensor:
        samples = sensor.collect(0.5)
        health = sensor.health()
    assert np.abs(samples.wrench - WRENCH).max() < 0.3
    assert len(samples) > 10
    assert health.lost <= 3 + health.malformed  # late on a busy machine, or contradicted by another answer


def test_can_lost_frames_are_gaps_not_wrong_samples(start: Start) -> None:
    with start("ati-can", faults={"drop": 0.02}).sensor() as sensor:
        samples = sensor.collect(0.5)
        health = sensor.health()
    assert np.abs(samples.wrench - WRENCH).max() < 0.3
    gaps = int((np.diff(samples.seq) - 1).sum())
    assert 0 < gaps <= health.lost


def test_can_wrong_slot_echo_is_refused(start: Start) -> None:
    with pytest.raises(ConnectError, match="slot 0, the sensor selected 5"):
        start("ati-can", wrong_echo=5).sensor().open()


def test_can_empty_slot_is_a_fault(start: Start) -> None:
    with pytest.raises(DeviceFault, match="slot 9 is empty"):
        start("ati-can").sensor("slot=9").open()


def test_can_base_and_bit_rate_must_match(start: Start) -> None:
    emulator = start("ati-can", base=0x7F, bitrate=500_000)
    with emulator.sensor("base=0x7F&bitrate=500000") as sensor:
        sensor.collect(0.05)
    with pytest.raises(ConnectError, match="bit rate"):
        emulator.sensor("base=0x7F").open()
    with pytest.raises(ConnectError, match="base identifier"):
        emulator.sensor("bitrate=500000").open()


def test_can_old_firmware(start: Start, caplog: pytest.LogCaptureFixture) -> None:
    with start("ati-can", firmware=(3, 6, 1)).sensor() as sensor:
        np.testing.assert_allclose(sensor.collect(0.1).wrench.mean(axis=0), WRENCH, atol=0.05)
        assert sensor.identify().firmware == "3.6 build 1"
    assert "does not report its units" in caplog.text
    with start("ati-can", firmware=(3, 6, 1)).sensor("units=lbf,lbf-in&counts=4448222,112985") as sensor:
        np.testing.assert_allclose(sensor.collect(0.1).wrench.mean(axis=0), WRENCH, atol=0.05)
        assert sensor.identify().facts["counts_per_N"].source == "configured"
    with pytest.raises(ConnectError, match=r"per lbf .*1000000 per N-m"):
        start("ati-can").sensor("units=lbf,N-m").open()


def test_serial_bad_checksums_are_dropped_and_counted(start: Start) -> None:
    with start("ati-serial", bad_checksum=0.01).sensor() as sensor:
        samples = sensor.collect(0.5)
        health = sensor.health()
    assert np.abs(samples.wrench - WRENCH).max() < 0.3
    gaps = int((np.diff(samples.seq) - 1).sum())
    assert gaps == pytest.approx(35, abs=25)
    assert 0 < gaps <= health.lost
    assert health.malformed == health.lost


def test_serial_slips_are_noticed_and_the_stream_restarted(start: Start) -> None:
    with start("ati-serial", faults={"byte_slip": 0.001}).sensor() as sensor:
        samples = sensor.collect(1.0)
        health = sensor.health()
    assert (np.abs(samples.wrench - WRENCH).max(axis=1) > 0.3).sum() <= 1  # one in 128 slips passes a checksum
    assert health.lost > 0
    gaps = int((np.diff(samples.seq) - 1).sum())
    assert gaps > 50
    lasted_s = (samples.t_host_ns[-1] - samples.t_host_ns[0]) / 1e9
    assert samples.seq[-1] - samples.seq[0] == pytest.approx(7000 * lasted_s, rel=0.1)  # an estimate


def test_serial_refused_start(start: Start) -> None:
    with pytest.raises(ConnectError, match="refused command 0x46 0x55"):
        start("ati-serial", refuse_start=True).sensor().open()


def test_serial_empty_calibration(start: Start) -> None:
    with pytest.raises(ConnectError, match=r"^ATI serial.*slot 9: .*empty"):
        start("ati-serial").sensor("calibration=9").open()
