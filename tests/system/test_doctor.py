"""`doctor` and `devices` as a user runs them: on a healthy cell, and on some that are not."""

import json
import re
import subprocess
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ftdrive.cell.emulated import Station
from ftdrive.session.rehearsal import NoOperator, rehearse
from tests.system.command_line import CommandLine, listen_for

NAMED = {
    f"{room}.{name}"
    for room, names in {
        "clock": "pace",
        "disk": "runs",
        "noise": "accuracy level",
        "permissions": "by-id latency_timer port",
        "robot": "control flange identity kinematics link payload program programs reachable registers remote safety "
        "speed version",
        "sensor": "age counts identity load lost range rate rest sign status",
        "workcell": "measured",
    }.items()
    for name in names.split()
}

GAIN = 3 * 0.02
"""What the emulated sensor may be off, three sigmas."""


def ill_station() -> Station:
    """Start a cell that the test may harm."""
    return Station("serial", ["--seed", "3", "--time-scale", "1"])


@pytest.fixture(scope="module")
def station() -> Iterator[Station]:
    """A healthy cell for all tests; a test that pushes it lets it go."""
    with ill_station() as station:
        yield station


@pytest.fixture
def cell(station: Station, ftdrive: CommandLine) -> Path:
    return ftdrive.connect(station)


def checks_of(outcome: subprocess.CompletedProcess[str]) -> dict[str, dict[str, Any]]:
    return {check["name"]: check for check in json.loads(outcome.stdout)["checks"]}


@pytest.mark.slow
def test_a_healthy_cell(ftdrive: CommandLine) -> None:
    answer = ftdrive.json("doctor", "--simulate", "--push")
    checks = {check["name"]: check for check in answer["checks"]}
    assert checks.keys() == NAMED | {"push.sign"}
    bad = {name: check for name, check in checks.items() if check["state"] == "failed"}
    assert not bad
    assert answer["verdict"] != "failed"
    assert answer["push"]["base"]["axis"] == "+X"
    assert answer["push"]["base"]["force_N"] == pytest.approx([15, 0, 0], abs=15 * GAIN)
    assert np.linalg.norm(answer["push"]["sensor"]["force_N"]) == pytest.approx(15, abs=15 * GAIN)
    assert not any(ftdrive.folder.iterdir())  # it only looked
    assert re.match(r"payload 0\.75 kg at \(-?\d+, -?\d+, \d+\) mm", checks["robot.payload"]["found"])
    assert re.search(r"answers in [0-9]+ ms", checks["robot.link"]["found"])


@pytest.mark.slow
def test_a_stopped_arm_in_local_control(ftdrive: CommandLine) -> None:
    with ill_station() as station:
        station.control(do="protective-stop")
        station.control(do="remote-control", on=False)
        before = station.control(do="state")["q_rad"]
        outcome = ftdrive.run("doctor", "--config", ftdrive.connect(station), "--json")
        after = station.control(do="state")
    assert outcome.returncode == 7
    checks = checks_of(outcome)
    assert checks["robot.safety"]["state"] == "failed"
    assert "protective stop" in checks["robot.safety"]["found"]
    assert "pendant" in checks["robot.safety"]["fix"]
    assert checks["robot.remote"]["state"] == "failed"
    assert "Remote Control" in checks["robot.remote"]["fix"]
    assert checks["noise.level"]["state"] == "ok"  # the sensor does not mind
    assert "robot.safety" in outcome.stderr
    assert after["q_rad"] == before
    assert after["safety_mode"] == "PROTECTIVE_STOP"
    assert after["bad_inputs"] == []


@pytest.mark.slow
def test_a_controller_without_dashboard_server(ftdrive: CommandLine) -> None:
    """It completes, and reports what cannot be known; then a calibration completes."""
    with Station("serial", ["--polyscope", "10.11.0"]) as station:
        checks = checks_of(ftdrive.run("doctor", "--config", ftdrive.connect(station), "--json"))
        outcome = rehearse(station, ftdrive.folder, "without-dashboard", NoOperator(), poses=6)
    assert [name for name, check in checks.items() if check["state"] == "failed"] == []
    assert checks["robot.remote"]["state"] == "skipped"
    assert "does not report whether it accepts programs" in checks["robot.remote"]["found"]
    assert "serial not reported" in checks["robot.identity"]["found"]
    assert "script: PolyScope X has no dashboard server" in checks["robot.control"]["found"]
    assert outcome.result.verdict != "rejected"
    assert outcome.run.header()["devices"]["arm"]["facts"]["control"]["value"].startswith("script")


@pytest.mark.slow
def test_an_old_controller_needs_its_model(ftdrive: CommandLine) -> None:
    with Station("serial", ["--time-scale", "1", "--polyscope", "5.4.0"]) as station:
        ftdrive.keep_time_of(station)
        arguments = ["doctor", "--robot", station.cell.robot.host, "--sensor", station.cell.sensor.url, "--json"]
        checks = checks_of(ftdrive.run(*arguments))
        named = checks_of(ftdrive.run(*arguments, "--model", "ur5e"))
    assert checks["robot.reachable"]["state"] == "failed"
    assert 'model = "ur5e" under [robot]' in checks["robot.reachable"]["fix"]
    assert checks["sensor.rate"]["state"] == "ok", checks["sensor.rate"]
    assert [check for check in named.values() if check["state"] == "failed"] == []


@pytest.mark.slow
def test_an_unplugged_sensor(station: Station, cell: Path, ftdrive: CommandLine) -> None:
    # Not the path of an unplugged pseudo-terminal: the next one opened on this machine would take its name.
    cell.write_text(cell.read_text().replace(station.cell.sensor.url, "ati-serial:///dev/unplugged"))
    outcome = ftdrive.run("doctor", "--config", cell, "--push", "--all")
    assert outcome.returncode == 7
    assert "the port cannot be opened" in outcome.stdout
    assert "fix: plug the adapter in" in outcome.stdout
    assert "✔ remote control" in outcome.stdout
    assert "sensor.identity, permissions.port" in outcome.stderr


@pytest.mark.slow
def test_a_person_pushes(station: Station, cell: Path, ftdrive: CommandLine) -> None:
    process = ftdrive.start("doctor", "--config", cell, "--push", "--json")
    listen_for(process, "press Enter")
    station.control(do="push", wrench=[0, 0, -20, 0, 0, 0])
    out, err = process.communicate("\n")
    station.control(do="push", wrench=[0.0] * 6)
    assert process.returncode == 0, err
    pushed = json.loads(out)["push"]
    assert pushed["sensor"]["axis"] == "-Z"
    assert pushed["sensor"]["force_N"][2] == pytest.approx(-20, abs=20 * GAIN)
    assert pushed["base"] is None  # the mounting of the sensor is unknown


@pytest.mark.slow
def test_devices_of_this_computer_and_of_an_emulated_cell(station: Station, ftdrive: CommandLine) -> None:
    url = station.cell.sensor.url
    ftdrive.keep_time_of(station)
    own = ftdrive.json("devices", "--probe", url.removeprefix("ati-serial://"))
    assert all(port["port"].startswith("/dev/") for port in own["serial"])
    assert [answer["url"] for answer in own["answers"]] == [url]
    emulated = ftdrive.json("devices", "--simulate")
    assert [answer["url"].partition(":")[0] for answer in emulated["answers"]] == ["ati-serial", "ati-can"]
    assert all("FT12345" in answer["what"] for answer in emulated["answers"])  # asked, not known
    keys = {"port", "by_id", "description", "usb", "serial_number", "findings"}
    assert all(port.keys() == keys for port in (*own["serial"], *emulated["serial"]))
