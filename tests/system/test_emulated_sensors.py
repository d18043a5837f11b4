"""Every emulated sensor behind its real driver, on the wrist of an emulated arm or by itself."""

import math
import os
import signal
import time

import numpy as np
import pytest

from ftdrive.cell.config import CellConfig, RobotConfig, SensorConfig
from ftdrive.cell.devices import build_sensor
from ftdrive.cell.emulated import SENSORS, Station, sensor_reached
from ftdrive.errors import ConfigError
from ftdrivers.clock import REAL
from ftdrivers.errors import DeviceFault, ProtocolError
from ftmocks.sensors.catalogue import CHOICES


def test_the_application_knows_all_sensors_of_a_station() -> None:
    assert set(SENSORS) == set(CHOICES) - {"both", "none"}


@pytest.mark.slow
@pytest.mark.parametrize("name", SENSORS)
def test_a_driver_reads_the_truth_of_the_cell_and_refuses_what_is_none(name: str) -> None:
    """On the emulated wrist: bias, weight, mounting and a push arrive; frozen, saturated and no number are errors."""
    mounting = [] if name == "ur-ft" else ["--sensor-rotvec-deg", "0,0,30"]
    with Station(name, ["--seed", "5", "--gain", "0", "--cross-talk", "0", *mounting]) as station:
        truth = station.truth
        with build_sensor(station.cell) as sensor:
            samples = sensor.collect(0.3)
            expected = np.array(station.control(do="state")["true_wrench"])
            sigma = np.repeat([truth["noise_force_N"], truth["noise_torque_Nm"]], 3) / math.sqrt(len(samples))
            resolution = np.array([0.02] * 3 + [0.002] * 3)  # the counts of Robotiq and Robotous
            assert (np.abs(samples.wrench.mean(axis=0) - expected) < 6 * sigma + resolution).all()

            station.control(do="push", wrench=[0, 0, -30, 0, 0, 0], axes="base")
            sensor.collect(0.1)  # what was under way
            push_N = sensor.collect(0.3).wrench.mean(axis=0)[:3] - expected[:3]
            weight_N = expected[:3] - truth["force_bias_N"]  # gravity pulls the same way, nearly: the base leans 2°
            cosine = push_N @ weight_N / np.linalg.norm(push_N) / truth["weight_N"]
            assert np.linalg.norm(push_N) == pytest.approx(30, abs=0.5)
            assert math.degrees(math.acos(min(1.0, cosine))) < 3

            station.control(do="freeze_sensor")
            with pytest.raises(DeviceFault, match="identical"):
                sensor.collect(2.0)
        station.control(do="freeze_sensor", on=False)
        with build_sensor(station.cell) as sensor:
            answer = station.control(do="nan")
            if name in {"bota", "ur-ft"}:
                with pytest.raises(ProtocolError):
                    sensor.collect(1.0)
            else:
                assert "whole numbers" in answer["error"]
                station.control(do="saturate", axis=1)
                with pytest.raises(DeviceFault):
                    sensor.collect(1.0)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["can", "ur-ft"])
def test_a_station_that_is_stopped_for_a_while_loses_no_sample(name: str) -> None:
    """Its clock stands still as well: the arm's, which is 20 times faster, and that of its sensor."""
    with Station(name) as station, build_sensor(station.cell) as sensor:
        sensor.collect(0.2)
        for _ in range(3):
            os.kill(station.pid, signal.SIGSTOP)
            time.sleep(0.1)
            os.kill(station.pid, signal.SIGCONT)
            sensor.collect(0.1)
        assert sensor.health().lost == 0


@pytest.mark.slow
def test_an_emulated_address_starts_a_sensor_without_an_arm() -> None:
    url, clock = sensor_reached("emulated://bota")
    assert url.startswith("bota:///dev/pts/")
    assert sensor_reached("emulated://bota") == (url, clock), "one process for one name"
    with build_sensor(CellConfig(RobotConfig("127.0.0.1"), SensorConfig("emulated://bota"))) as sensor:
        assert len(sensor.collect(0.3)) >= 20
    assert sensor_reached("ati-can://can0") == ("ati-can://can0", REAL)


def test_an_unknown_emulated_sensor_is_a_mistake_in_the_configuration() -> None:
    with pytest.raises(ConfigError, match="emulated://robotiq"):
        sensor_reached("emulated://lab")
