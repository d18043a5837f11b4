"""`doctor`, `devices` and `transcript` as a user runs them: on a healthy cell, and on two that are not."""

import json
import re
import subprocess
from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ftdrive.cell.emulated import Station
from ftdrive.commands.emulated_run import rehearse
from ftdrivers.ur.timing import UrTiming
from tests.system.command_line import CommandLine, listen_for

NAMED = {
    *("robot.reachable", "robot.identity", "robot.remote", "robot.safety", "robot.program", "robot.flange"),
    *("clock.pace", "sensor.identity", "sensor.rate", "sensor.lost", "sensor.age", "sensor.status", "sensor.counts"),
    *(
        "sensor.range",
        "sensor.sign",
        "robot.speed",
        "robot.payload",
        "robot.control",
        "robot.registers",
        "robot.programs",
        "robot.version",
    ),
    *("robot.version", "robot.link", "sensor.load", "noise.level", "noise.accuracy", "disk.runs", "workcell.measured"),
    *("permissions.port", "permissions.by-id", "permissions.latency_timer"),
}


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


def test_a_healthy_cell(ftdrive: CommandLine) -> None:
    answer = ftdrive.json("doctor", "--simulate", "--push")
    checks = {check["name"]: check for check in answer["checks"]}
    assert checks.keys() == NAMED | {"push.sign"}
    bad = {name: check for name, check in checks.items() if check["state"] == "failed"}
    assert not bad
    assert answer["verdict"] != "failed"
    assert answer["push"]["base"]["axis"] == "+X"
    assert answer["push"]["base"]["force_N"] == pytest.approx([15, 0, 0], abs=0.2)
    assert np.linalg.norm(answer["push"]["sensor"]["force_N"]) == pytest.approx(15, abs=0.2)
    assert not any(ftdrive.folder.iterdir())  # it only looked
    assert re.match(r"payload 0\.75 kg at \(-?\d+, -?\d+, \d+\) mm", checks["robot.payload"]["found"])
    assert re.search(r"answers within [0-9]+ ms", checks["robot.link"]["found"])


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
def test_an_arm_that_cannot_be_controlled(ftdrive: CommandLine) -> None:
    with ill_station() as station:
        station.control(do="claim-registers", range="lower")
        station.control(do="slider", fraction=0.02)
        station.control(do="listen", what="script", on=False)
        checks = checks_of(ftdrive.run("doctor", "--config", ftdrive.connect(station), "--json"))
        bad_inputs = station.control(do="state")["bad_inputs"]
    failed = {name: check["fix"] for name, check in checks.items() if check["state"] == "failed"}
    assert failed.keys() == {"robot.registers", "robot.speed", "robot.programs"}
    assert "EtherNet/IP" in failed["robot.registers"]
    assert "speed slider" in failed["robot.speed"]
    assert "real-time client interface" in failed["robot.programs"]
    assert bad_inputs == []


@pytest.mark.slow
def test_a_controller_without_dashboard_server(ftdrive: CommandLine) -> None:
    """It completes, and reports what cannot be known; then a calibration completes."""
    with Station("serial", ["--polyscope", "10.11.0"]) as station:
        checks = checks_of(ftdrive.run("doctor", "--config", ftdrive.connect(station), "--json"))
        outcome = rehearse(station, ftdrive.folder, "without-dashboard", poses=6)
    assert [name for name, check in checks.items() if check["state"] == "failed"] == []
    assert checks["robot.remote"]["state"] == "skipped"
    assert "does not report whether it accepts programs" in checks["robot.remote"]["found"]
    assert "serial not reported" in checks["robot.identity"]["found"]
    assert "script: PolyScope X has no dashboard server" in checks["robot.control"]["found"]
    assert outcome.result.verdict != "rejected"
    assert outcome.run.header()["devices"]["arm"]["facts"]["control"]["value"].startswith("script")


slow = partial(pytest.param, marks=pytest.mark.slow)


@pytest.mark.parametrize(
    ("polyscope", "request_", "found", "fix"),
    [
        ("5.4.0", None, "model", 'model = "ur5e" under [robot]'),
        slow("5.15.0", {"do": "silent", "what": "dashboard"}, "dashboard", "enable the dashboard server"),
        slow("5.15.0", {"do": "listen", "what": "dashboard", "on": False}, "dashboard", "enable the dashboard server"),
        slow("5.15.0", {"do": "listen", "what": "rtde", "on": False}, "refused", "enable RTDE"),
        slow("5.15.0", {"do": "silent", "what": "rtde"}, "did not answer", "finished starting"),
    ],
    ids=["no model", "silent dashboard", "no dashboard", "no RTDE", "silent RTDE"],
)
def test_each_way_not_to_reach_an_arm_has_its_own_cure(
    polyscope: str,
    request_: dict[str, Any] | None,
    found: str,
    fix: str,
    ftdrive: CommandLine,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    sooner = replace(UrTiming.emulated(), connect_s=5.0)  # a silent server is waited for to the end
    monkeypatch.setattr(UrTiming, "emulated", lambda: sooner)
    with Station("serial", ["--time-scale", "1", "--polyscope", polyscope]) as station:
        if request_ is not None:
            station.control(**request_)
        ftdrive.keep_time_of(station)
        arguments = ["doctor", "--robot", station.cell.robot.host, "--sensor", station.cell.sensor.url, "--json"]
        checks = checks_of(ftdrive.run(*arguments))
        if polyscope == "5.4.0":
            named = checks_of(ftdrive.run(*arguments, "--model", "ur5e"))
            assert [check for check in named.values() if check["state"] == "failed"] == []
    assert checks["robot.reachable"]["state"] == "failed"
    assert found in checks["robot.reachable"]["found"]
    assert fix in checks["robot.reachable"]["fix"]
    assert "ping" not in checks["robot.reachable"]["fix"]
    assert checks["sensor.rate"]["state"] == "ok", checks["sensor.rate"]


def test_an_unplugged_sensor(station: Station, cell: Path, ftdrive: CommandLine) -> None:
    # Not the path of an unplugged pseudo-terminal: the next one opened on this machine would take its name.
    cell.write_text(cell.read_text().replace(station.cell.sensor.url, "ati-serial:///dev/unplugged"))
    outcome = ftdrive.run("doctor", "--config", cell, "--push")
    assert outcome.returncode == 7
    assert "the port does not open" in outcome.stdout
    assert "fix: plug it in" in outcome.stdout
    assert "✔ remote control" in outcome.stdout
    assert "sensor.identity, permissions.port" in outcome.stderr


def test_an_arm_that_is_not_there(station: Station, cell: Path, ftdrive: CommandLine) -> None:
    cell.write_text(cell.read_text().replace(station.cell.robot.host, "no-such-arm.invalid"))
    outcome = ftdrive.run("doctor", "--config", cell, "--json")
    assert outcome.returncode == 7
    checks = checks_of(outcome)
    assert checks["robot.reachable"]["state"] == "failed"
    assert "IPv4 address" in checks["robot.reachable"]["fix"]
    assert checks["sensor.rate"]["state"] != "skipped"


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
    assert pushed["sensor"]["force_N"][2] == pytest.approx(-20, abs=0.3)
    assert pushed["base"] is None  # the mounting of the sensor is unknown


@pytest.mark.slow
def test_without_an_operator_the_push_is_skipped(cell: Path, ftdrive: CommandLine) -> None:
    outcome = ftdrive.run("doctor", "--config", cell, "--push", "--json")  # with an empty standard input
    assert outcome.returncode == 0, outcome.stderr
    checks = checks_of(outcome)
    assert checks.keys() == NAMED | {"push.sign"}
    assert json.loads(outcome.stdout)["push"] is None
    assert checks["push.sign"]["state"] == "skipped"
    assert "standard input is closed" in checks["push.sign"]["found"]


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


@pytest.mark.slow
def test_devices_asks_the_named_serial_port_and_can_bus(ftdrive: CommandLine) -> None:
    with Station("both", ["--time-scale", "1"]) as station:
        port, can = station.endpoints["sensors"]["serial"]["port"], station.endpoints["sensors"]["can"]
        bus = f"slcan://{can['channel']}?bitrate={can['bitrate']}"
        url = f"ati-can://{can['channel']}?interface=slcan&bitrate={can['bitrate']}"
        ftdrive.keep_time_of(station)
        serial_answer, can_answer = ftdrive.json("devices", "--probe", port, "--probe", bus)["answers"]
        assert (serial_answer["port"], serial_answer["url"]) == (port, f"ati-serial://{port}")
        assert (can_answer["port"], can_answer["url"]) == (bus, url)
        assert "ATI NETCANOEM, serial FT12345" in can_answer["what"]
        shown = ftdrive.run("devices", "--probe", bus, "--probe", f"{bus}&base=0x7F").stdout
        assert f" probed  {bus}   {can_answer['what']}   {url}\n" in shown
        assert f" probed  {bus}&base=0x7F   no known sensor answers\n" in shown


@pytest.mark.slow
def test_a_place_that_cannot_be_asked_does_not_take_the_answers_of_the_others(
    station: Station, ftdrive: CommandLine
) -> None:
    url = station.cell.sensor.url
    ftdrive.keep_time_of(station)
    places = ["--probe", "no-can", "--probe", url.removeprefix("ati-serial://"), "--probe", "ftp://x"]
    up = "sudo ip link set no-can up type can bitrate 250000"
    outcome = ftdrive.run("devices", *places, "--json")
    assert outcome.returncode == 3
    gone, there, wrong = json.loads(outcome.stdout)["answers"]
    assert (gone["url"], there["url"], wrong["url"]) == (None, url, None)
    assert up in gone["error"]
    assert there["error"] is None
    assert "ftp://x" in wrong["error"]
    assert up in outcome.stderr
    assert "Traceback" not in outcome.stderr
    shown = ftdrive.run("devices", *places[2:])
    assert shown.returncode == 2
    assert url in shown.stdout
    assert "probed  ftp://x   could not be probed: " in shown.stdout


def test_a_sensor_that_is_configured_otherwise_gets_the_cure_its_driver_names(
    station: Station, cell: Path, ftdrive: CommandLine
) -> None:
    cell.write_text(cell.read_text().replace(station.cell.sensor.url, f"{station.cell.sensor.url}?serial=WRONG"))
    identity = checks_of(ftdrive.run("doctor", "--config", cell, "--json"))["sensor.identity"]
    assert identity["state"] == "failed"
    assert "FT12345" in identity["found"]
    assert "WRONG" in identity["found"]
    assert "option serial" in identity["fix"]


def test_transcript_of_a_sensor(ftdrive: CommandLine) -> None:
    recording = ftdrive.run("transcript", "record", "--simulate", "-o", "sensor.jsonl", "--duration", "1", "--json")
    assert "Saved sensor.jsonl" in recording.stderr
    recorded = json.loads(recording.stdout)["recorded"]
    played = ftdrive.json("transcript", "play", ftdrive.folder / "sensor.jsonl")
    assert played["recorded"] == recorded
    assert played["played"]["identity"] == recorded["identity"]
    assert played["played"]["mean_force_N"] == pytest.approx(recorded["mean_force_N"], abs=0.02)


def test_the_transcript_of_a_simulated_play_is_not_said_to_be_saved(ftdrive: CommandLine) -> None:
    played = ftdrive.run("transcript", "play", "--simulate")
    assert played.returncode == 0, played.stderr
    assert "Saved" not in played.stderr
    refused = ftdrive.run("transcript", "record", "--simulate", "-o", "nope/sensor.jsonl", "--duration", "0.1")
    assert refused.returncode == 2
    assert "nope" in refused.stderr
    assert "Saved" not in refused.stderr


def test_transcript_of_a_sensor_that_is_gone(ftdrive: CommandLine) -> None:
    url = "ati-serial:///dev/unplugged"  # as above: the path of an unplugged pseudo-terminal is soon that of another
    assert ftdrive.run("transcript", "record", "--sensor", url, "-o", "gone.jsonl").returncode == 3
    last = (ftdrive.folder / "gone.jsonl").read_text().splitlines()[-1]
    assert "the port does not open" in json.loads(last)["error"]
    assert ftdrive.run("transcript", "play", ftdrive.folder / "gone.jsonl").returncode == 6
    arm = "ur-ft://192.168.1.1?counts_per_N=1&counts_per_Nm=1"
    refused = ftdrive.run("transcript", "record", "--sensor", arm, "-o", "net.jsonl")
    assert refused.returncode == 2
    assert "with Wireshark" in refused.stderr
