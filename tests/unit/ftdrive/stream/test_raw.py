"""A sensor alone: its readings minus a tare, without a word about an arm or a calibration."""

import json
from pathlib import Path

import numpy as np
import pytest

from ftdrive import cli
from ftdrive.cell.config import CellConfig, RobotConfig, SensorConfig, ToolConfig
from ftdrive.recording.compensation import compensate_recording
from ftdrive.recording.foreign import TablePair
from ftdrive.recording.recorder import RawTable
from ftdrive.stream.sources import CellSource
from ftdrive.stream.stream import Stream
from ftdrive.tables.table import Table
from ftdrivers.errors import DeviceTimeout
from tests.fake_clock import FakeClock
from tests.unit.ftdrive.stream.simulated import NOISE, calibrated
from tests.unit.ftdrive.stream.test_stream import RATE_HZ, Sensor

LOAD = np.array([30.0, -20.0, 80.0, 2.0, -1.0, 0.5])


@pytest.fixture
def sensor(monkeypatch: pytest.MonkeyPatch) -> Sensor:
    monkeypatch.setenv("TZ", "UTC")
    return Sensor(FakeClock(), RATE_HZ)


def raw(sensor: Sensor) -> Stream:
    config = CellConfig(RobotConfig(""), SensorConfig("fake://"), ToolConfig(""), clock=sensor.clock)
    return Stream(CellSource(config, None, devices=(sensor, None)))  # type: ignore[arg-type]  # a link of the tests


def test_readings_are_as_measured_and_a_tare_is_subtracted(sensor: Sensor) -> None:
    with raw(sensor) as stream:
        sensor.push = LOAD
        blocks = [stream.read() for _ in range(250)]
        assert all((block.wrench == block.raw).all() and not block.in_contact.any() for block in blocks)
        assert np.isnan(blocks[-1].chi2).all()
        assert blocks[-1].sigma == pytest.approx(NOISE, rel=0.2)
        # the load is no error of the sensor here: sigma is that of the noise of 100 samples
        assert stream.processor.sigma_of_mean(np.eye(3), 0.1) == pytest.approx(NOISE / 10, rel=0.4)
        assert stream.tare().kind == "tare"
        after = [stream.read() for _ in range(120)]
        wrench, as_read = (np.concatenate([getattr(one, name) for one in after]) for name in ("wrench", "raw"))
        assert np.abs(wrench.mean(axis=0) / NOISE).max() < 0.3
        assert as_read.mean(axis=0) == pytest.approx(
            np.concatenate([one.raw for one in blocks[-100:]]).mean(axis=0), abs=0.05
        )
        assert stream.undo_tare().kind == "tare-undone"
        block = stream.read()
        assert (block.wrench == block.raw).all()
        assert stream.undo_tare().kind == "tare-refused"
        assert not {"contact", "drift"} & {event.kind for event in stream.take_events()}


def test_what_is_saved_is_compensated_beside_a_table_of_poses(sensor: Sensor, tmp_path: Path) -> None:
    path = tmp_path / "raw.csv"
    with raw(sensor) as stream:
        stream.tare()
        table = RawTable(path, stream.info)
        blocks = [stream.read() for _ in range(150)]
        for block in blocks:
            table.add(block, [])
        table.end()
        t_s = (np.concatenate([block.t_host_ns for block in blocks]) + stream.info.utc_offset_ns) * 1e-9
    seconds = np.arange(t_s[0] - 0.1, t_s[-1] + 0.1, 0.01)
    rows = np.c_[seconds, np.tile(sensor.motion.pose(np.zeros(1))[0].reshape(9), (len(seconds), 1))]
    header = "t,r11,r12,r13,r21,r22,r23,r31,r32,r33"
    np.savetxt(tmp_path / "poses.csv", rows, delimiter=",", header=header, comments="", fmt="%.6f")
    pair = TablePair(Table(path), Table(tmp_path / "poses.csv"), calibrated(), "calibration", 0.0)
    found, failure = compensate_recording(pair, stream.frame, None)
    assert failure is None
    assert found["samples"] == len(t_s)
    # the free tool of the calibration hangs on the sensor
    assert found["compensated"]["force_rms_N"] == pytest.approx(NOISE[0] * np.sqrt(3), rel=0.2)


def test_a_silent_sensor_raises_and_recovers(sensor: Sensor) -> None:
    with raw(sensor) as stream:
        stream.read()
        sensor.silent = True
        with pytest.raises(DeviceTimeout):
            list(stream)
        status = stream.status()
        assert status.sensor.error
        assert not status.arm.error
        sensor.silent = False
        assert len(stream.read())


def test_a_program_gets_readings_and_no_verdict(
    sensor: Sensor, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    sensor.push = LOAD
    monkeypatch.setattr("ftdrive.commands.live.CellSource", lambda *_: raw(sensor).source)
    assert cli.run(["live", "--raw", "--sensor", "fake://", "--once", "--json"]) == 0
    reading = json.loads(capsys.readouterr().out)
    assert reading["raw"]["force_N"] == pytest.approx((sensor.motion.wrench(np.zeros(1))[0] + LOAD)[:3], abs=0.05)
    for name in ("compensated", "contact", "calibration", "calibration_id", "verdict", "delay_s", "verification"):
        assert reading[name] is None
