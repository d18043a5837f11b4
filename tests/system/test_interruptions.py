"""What happens when a tour is broken off: the exit code, in time; the arm stopped; the poses kept."""

import os
import signal
import subprocess
from collections.abc import Iterator

import pytest

from ftdrive.cell.emulated import Station
from tests.system.command_line import CommandLine, end_of, left_at_a_hold, say

ANSWERS = "yes\nyes\nyes\nMOVE\nyes\n"
"""Tool free, ball free, emergency stop in reach; the first motion; the tour."""


@pytest.fixture
def station() -> Iterator[Station]:
    with Station("robotous-serial", ["--seed", "3"]) as station:
        yield station


@pytest.fixture
def tour(station: Station, ftdrive: CommandLine) -> subprocess.Popen[str]:
    """A calibration on its way, two poses taken."""
    process = ftdrive.start("calibrate", "--config", ftdrive.connect(station), "--minimal")
    say(process, ANSWERS)
    ftdrive.wait_for_poses(process, 2)
    return process


@pytest.mark.slow
@pytest.mark.parametrize("by", [signal.SIGINT, signal.SIGTERM])
def test_ctrl_c_stops_the_arm_and_keeps_the_poses(
    station: Station, tour: subprocess.Popen[str], ftdrive: CommandLine, by: signal.Signals
) -> None:
    tour.send_signal(by)
    code, printed = end_of(tour)
    assert code == 130, printed
    assert "Traceback" not in printed
    assert not station.control(do="state")["moving"]
    kept = ftdrive.poses()
    assert f"{len(kept)} poses" in printed
    solved = ftdrive.run("solve", kept[0].parent.parent)
    assert solved.returncode == 7
    assert "Traceback" not in solved.stderr


@pytest.mark.slow
def test_unplugged_sensor_stops_the_arm_and_keeps_the_poses(
    station: Station, tour: subprocess.Popen[str], ftdrive: CommandLine
) -> None:
    station.control(do="unplug", device="sensor")
    code, printed = left_at_a_hold(tour)
    assert code == 4, printed
    assert "Traceback" not in printed
    assert not station.control(do="state")["moving"]
    assert len(ftdrive.poses()) >= 2


@pytest.mark.slow
def test_killed_station_is_a_lost_stream(station: Station, tour: subprocess.Popen[str], ftdrive: CommandLine) -> None:
    os.kill(station.pid, signal.SIGKILL)
    code, printed = left_at_a_hold(tour)
    assert code == 4, printed
    assert "Traceback" not in printed
    assert len(ftdrive.poses()) >= 2


def test_a_device_that_does_not_answer(ftdrive: CommandLine) -> None:
    outcome = ftdrive.run("calibrate", "--robot", "127.213.7.9", "--sensor", "ati-serial:///dev/no-such-port")
    assert outcome.returncode == 3
    assert outcome.stderr.startswith("error: ")
