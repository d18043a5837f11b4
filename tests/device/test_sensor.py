"""A real sensor at rest: who it is, and ten seconds of its stream, judged as `ftdrive doctor` judges it."""

import pytest

from ftcalib.poses.information import Guess
from ftcalib.sensor_matrix import SensorMatrix
from ftdrive.checks.computer import SensorAddress
from ftdrive.checks.sensor import check_noise, check_stream
from ftdrivers.interfaces import NOT_REPORTED, ForceTorqueSensor, FtSamples, Health
from ftdrivers.registry import sensor_from_url

DURATION_S = 10.0


@pytest.fixture(scope="module")
def stream(sensor: ForceTorqueSensor) -> tuple[FtSamples, Health]:
    samples = sensor.collect(DURATION_S)
    return samples, sensor.health()


def test_it_reports_who_it_is(sensor: ForceTorqueSensor) -> None:
    info = sensor.identify()
    assert info.model not in {"", NOT_REPORTED}
    assert {"counts_per_N", "counts_per_Nm", "sign"} <= info.facts.keys()


def test_rate_losses_and_status(stream: tuple[FtSamples, Health], url: str) -> None:
    samples, health = stream
    checks = check_stream(samples, health, SensorAddress.of(url), DURATION_S)
    assert [check for check in checks if check.state != "ok"] == []
    assert (samples.t_host_ns[1:] >= samples.t_host_ns[:-1]).all()
    assert (samples.seq[1:] > samples.seq[:-1]).all()


def test_noise(stream: tuple[FtSamples, Health]) -> None:
    samples, _ = stream
    checks = check_noise(samples.wrench, DURATION_S, 2.0, Guess(1.0, 1.0, 1.0, sensor=SensorMatrix.usual()))
    assert [check for check in checks if check.state != "ok"] == []


def test_it_opens_again(sensor: ForceTorqueSensor, url: str) -> None:
    info = sensor.identify()
    sensor.close()
    with sensor_from_url(url) as again:
        assert again.identify() == info
        assert len(again.collect(1.0))
    sensor.open()
    assert len(sensor.collect(1.0))
