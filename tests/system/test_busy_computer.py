"""A computer that is busy or stalls makes an emulated cell slow, never wrong."""

import json
import os
import signal
import sys
import time
from pathlib import Path

import pytest

from tests.busy_loops import busy_loops
from tests.system.command_line import CommandLine

pytestmark = [pytest.mark.slow, pytest.mark.timeout(600)]

LOOPS = 2
"""They take all the computing time there is on two cores."""


def station_of(program: int) -> int:
    """Find the process of the emulated cell, which the program has started."""
    for folder in Path("/proc").glob("[0-9]*"):
        try:
            parent = (folder / "stat").read_text().rpartition(")")[2].split()[1]
            arguments = (folder / "cmdline").read_bytes().split(b"\0")
        except OSError:
            continue  # ended meanwhile
        if int(parent) == program and b"ftmocks" in arguments:
            return int(folder.name)
    raise AssertionError("no station was started")


def test_a_session_beside_two_busy_loops_ends_well(ftdrive: CommandLine) -> None:
    with busy_loops(LOOPS):
        cell = ("--simulate", "--sensor", "emulated://serial")
        process = ftdrive.start("calibrate", *cell, "--minimal", "--yes", "--json")
        _, err = process.communicate()
    assert process.returncode == 0, err
    assert len(ftdrive.poses()) == 7


@pytest.mark.skipif(sys.platform != "linux", reason="looks for the station in /proc")
def test_a_session_whose_processes_are_stopped_for_seconds_in_mid_tour_ends_well(ftdrive: CommandLine) -> None:
    process = ftdrive.start("calibrate", "--simulate", "--minimal", "--yes", "--json")
    ftdrive.wait_for_poses(process, 1)
    program, station = process.pid, station_of(process.pid)
    for poses, stopped, stall_s in (
        (1, (program, station), 1.5),
        (3, (program,), 3.0),  # ur_rtde gives a link up after 2.5 s without a sample
        (5, (station,), 1.5),
    ):
        ftdrive.wait_for_poses(process, poses)
        for pid in stopped:
            os.kill(pid, signal.SIGSTOP)
        time.sleep(stall_s)
        for pid in reversed(stopped):
            os.kill(pid, signal.SIGCONT)
        assert len(ftdrive.poses()) < 7, "the tour has ended before"
    out, err = process.communicate()
    assert process.returncode == 0, err
    limits = [one["code"] for one in json.loads(out.splitlines()[-1])["findings"] if one["severity"] != "note"]
    assert limits == ["gain_unknown"], "of six poses"
