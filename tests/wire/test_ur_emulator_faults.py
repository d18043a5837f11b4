"""Faults of link, program, safety and power: on the emulator's wires, and as the unmodified ur_rtde suffers them.

What the client does in each case was measured before this emulator existed; that it does the same here is the check
that the emulator is faithful.
"""

import contextlib
import json
import signal
import socket
import struct
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pytest

from ftmocks.ur import rtde
from tests.ur_rtde import require_ur_rtde
from tests.wire.station_process import StationProcess
from tests.wire.waiting import LIMIT_S

CLIENT = Path(__file__).with_name("ur_emulator_faults_client.py")
AT_ONCE = 2  # stations and clients side by side: they mostly wait
FAST = ("--time-scale", "20")
HANGS_S = 1.5


@pytest.fixture
def start() -> Iterator[Callable[..., StationProcess]]:
    """Start stations that end with the test."""
    with contextlib.ExitStack() as stack:
        yield lambda *options: stack.enter_context(StationProcess(*options))


@pytest.fixture(scope="module")
def station() -> Iterator[StationProcess]:
    """One for all tests that leave it as they found it."""
    with StationProcess() as shared:
        yield shared


@dataclass
class Played:
    """What a client reported, and how it ended: its return code, or None when it had to be killed after the limit."""

    facts: dict[str, Any] = field(default_factory=dict)
    ended: int | None = None
    talk: str = ""


def play(scenario: str, station: StationProcess, *, hangs: bool = False) -> Played:
    """Run a scenario of ur_emulator_faults_client.py in its own process and do what it asks for.

    It is killed when it takes far too long, or when it `hangs` after the fact that it has begun.
    """
    require_ur_rtde()
    client = subprocess.Popen(
        [sys.executable, str(CLIENT), scenario, station.host],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    assert client.stdin is not None
    assert client.stdout is not None
    assert client.stderr is not None
    late = threading.Event()

    def end() -> None:
        late.set()
        client.kill()

    alarm = threading.Timer(3 * LIMIT_S, end)
    alarm.start()
    played = Played()
    try:
        for line in client.stdout:
            if line.startswith("@fact "):
                played.facts |= json.loads(line[6:])
                if hangs and played.facts == {"begun": True}:
                    alarm.cancel()
                    alarm = threading.Timer(HANGS_S, end)
                    alarm.start()
            elif line.startswith("@ask "):
                answer = _serve(station, json.loads(line[5:]))
                with contextlib.suppress(BrokenPipeError):
                    client.stdin.write(json.dumps(answer) + "\n")
                    client.stdin.flush()
        played.talk = client.stderr.read()
        code = client.wait()
        played.ended = None if late.is_set() else code
    finally:
        alarm.cancel()
        client.kill()
        client.wait()
        for pipe in (client.stdin, client.stdout, client.stderr):
            with contextlib.suppress(BrokenPipeError):
                pipe.close()
    if station.process.poll() is None:
        assert station.ask("state")["bad_inputs"] == []
    return played


def _serve(station: StationProcess, request: dict[str, Any]) -> dict[str, Any]:
    if request["do"] == "kill":
        station.kill()
    elif request["do"] == "restart":
        station.start()
    else:
        return station.ask(**request)
    return {}


def play_all(start: Callable[..., StationProcess], *scenarios: str) -> dict[str, Played]:
    """Several scenarios side by side, each with a station of its own."""
    with ThreadPoolExecutor(AT_ONCE) as pool:
        return dict(zip(scenarios, pool.map(lambda name: play(name, start()), scenarios), strict=True))


# -- on the wires -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("what", "ports"), [("rtde", [30004]), ("dashboard", [29999]), ("script", [30002, 30003])])
def test_ports_close_and_open_one_by_one(station: StationProcess, what: str, ports: list[int]) -> None:
    known = len(station.ask("state")["events"])
    with station.connect(ports[0]) as before:
        station.wait_for(
            lambda state: any((e["by"], e["what"]) == (what, "connected") for e in state["events"][known:])
        )
        station.ask("listen", what=what, on=False)
        station.ask("listen", what=what, on=False)
        for port in (29999, 30002, 30003, 30004):
            if port in ports:
                with pytest.raises(ConnectionRefusedError):
                    station.connect(port)
            else:
                station.connect(port).close()
        before.settimeout(0.05)
        if what != "dashboard":
            with pytest.raises(TimeoutError):
                before.recv(1)  # still connected, nothing to say
        station.ask("listen", what=what, on=True)
        for port in ports:
            station.connect(port).close()


def test_a_silent_dashboard_accepts_and_answers_later(station: StationProcess) -> None:
    with station.connect(29999) as old:
        assert old.makefile("rb").readline().startswith(b"Connected")
        station.ask("silent", what="dashboard", on=True)
        old.sendall(b"robotmode\n")
        with station.connect(29999) as new:
            for client in (old, new):
                client.settimeout(0.05)
                with pytest.raises(TimeoutError):
                    client.recv(1)
            station.ask("silent", what="dashboard", on=False)
            for client, line in (
                (old, b"Robotmode: RUNNING\n"),
                (new, b"Connected: Universal Robots Dashboard Server\n"),
            ):
                client.settimeout(LIMIT_S)
                assert client.recv(100) == line


def kinds(client: socket.socket) -> Iterator[str]:
    """Yield the kinds of RTDE packages as they arrive."""
    buffer = bytearray()
    while True:
        yield from (chr(kind) for kind, _payload in rtde.take_packages(buffer))
        buffer += client.recv(4096)


@pytest.mark.parametrize("answers", [True, False])
def test_silent_rtde_stops_streaming_and_answers_only_if_asked_to(station: StationProcess, answers: bool) -> None:
    with station.connect(30004) as client:
        client.sendall(struct.pack(">HB", 20, ord("O")) + struct.pack(">d", 500.0) + b"timestamp"[:9])
        assert client.recv(100)[2:4] == b"O\x01"
        client.sendall(b"\x00\x03S")
        assert client.recv(4) == b"\x00\x04S\x01"
        assert client.recv(100)[2:3] == b"U"
        station.ask("silent", what="rtde", on=True, answers=answers)
        client.settimeout(0.1)
        with contextlib.suppress(TimeoutError):
            while client.recv(1000):
                pass  # what was on its way
        client.sendall(b"\x00\x03v")
        if answers:
            client.settimeout(LIMIT_S)
            assert client.recv(100)[2:3] == b"v"
            client.settimeout(0.1)
        with pytest.raises(TimeoutError):
            client.recv(100)
        station.ask("silent", what="rtde", on=False)
        client.settimeout(LIMIT_S)
        assert ("U" if answers else "v") in kinds(client), "what was asked in the silence is answered"


def test_connections_come_and_go_in_the_event_log(start: Callable[..., StationProcess]) -> None:
    station = start()
    with station.connect(30004) as client:
        station.wait_for(lambda state: [e["what"] for e in state["events"]] == ["connected"])
        before_ns = station.ask("state")["t_host_ns"]
        assert station.ask("drop", what="rtde", reset=True)["connections"] == 1
        with pytest.raises(ConnectionResetError):
            client.recv(1)
    drop, gone = (state := station.ask("state", since=1))["events"]
    assert (drop["by"], drop["what"], drop["reset"]) == ("network", "drop rtde", True)
    assert (gone["by"], gone["what"]) == ("rtde", "disconnected")
    assert before_ns <= drop["t_host_ns"] <= gone["t_host_ns"] <= state["t_host_ns"]


def test_any_mode_can_be_asked_for(start: Callable[..., StationProcess]) -> None:
    station = start()
    for number, name in ((2, "REDUCED"), (4, "RECOVERY"), (5, "SAFEGUARD_STOP"), (1, "NORMAL"), (3, "PROTECTIVE_STOP")):
        assert station.ask("mode", safety=number)["safety_mode"] == name
        assert station.ask("state")["robot_mode"] == "RUNNING"
    assert station.ask("mode", safety=9) == {"done": "mode", "robot_mode": "POWER_OFF", "safety_mode": "FAULT"}
    for number, name in ((-1, "NO_CONTROLLER"), (5, "IDLE"), (7, "RUNNING")):
        assert station.ask("mode", robot=number)["robot_mode"] == name


# -- the unmodified ur_rtde: the link ---------------------------------------------------------------------------------


@pytest.mark.slow
def test_the_server_goes_away(start: Callable[..., StationProcess]) -> None:
    played = play_all(start, "killed", "killed_moving", "command_after_loss")
    assert played["killed"].facts == {
        "receive_lost": True,
        "control_lost": True,
        "last_values": True,
        "program_seems_to_run": True,
        "receive_back": True,
        "control_back": True,
        "moves": True,
    }
    assert played["killed_moving"].facts == {
        "moving": True,
        "receive_lost": True,
        "hangs_after_the_kill": True,
        "hangs_after_the_restart": True,
    }
    assert played["command_after_loss"].facts == {"connected": False, "hangs": True}


@pytest.mark.slow
def test_the_link_is_cut(start: Callable[..., StationProcess]) -> None:
    played = play_all(start, "dropped_moving", "dropped_without_dashboard")
    assert played["dropped_moving"].facts == {"moving": True, "lost": True, "robot_finishes": True, "hangs": True}
    assert played["dropped_without_dashboard"].facts == {"lost": True, "back": True, "moves": True}


@pytest.mark.slow
def test_the_samples_stay_away(start: Callable[..., StationProcess]) -> None:
    played = play_all(start, "frozen", "silent")
    silent, frozen = played["silent"].facts, played["frozen"].facts
    silent.pop("after_s"), frozen.pop("after_s")
    assert silent == {
        "moving": True,
        "ended": True,
        "returned": False,
        "receive_lost": True,
        "control_says_connected": True,
        "program_runs": False,
    }
    assert frozen == {"moving": True, "receive_lost": True, "hangs": True, "receive_back": True}


@pytest.mark.realtime
def test_the_samples_stay_away_for_two_and_a_half_seconds(start: Callable[..., StationProcess]) -> None:
    """The limit is ur_rtde's own."""
    played = play_all(start, "frozen", "silent", "briefly_silent")
    assert played["briefly_silent"].facts == {
        "moving": True,
        "same_stamp": True,
        "connected": [True, True],
        "ended": True,
        "returned": True,
    }
    assert 2.4 < played["silent"].facts["after_s"] < 3.5
    assert 2.4 < played["frozen"].facts["after_s"] < 3.5


# -- the unmodified ur_rtde: program, safety, power -------------------------------------------------------------------


@pytest.mark.slow
def test_whatever_ends_or_holds_the_program_ends_the_blocking_move(start: Callable[..., StationProcess]) -> None:
    station = start(*FAST)
    facts = play("broken_program", station).facts
    assert facts.pop("moving")
    assert facts.pop("goes_on_by_itself")  # a closed safeguard
    states = {
        "crash-script": [1, 1, 7, 0x001],
        "dashboard-stop": [1, 1, 7, 0x001],
        "protective-stop": [4, 3, 7, 0x404],
        "emergency-stop": [1, 7, 3, 0x4C0],
        "safeguard": [4, 5, 7, 0x410],
        "mode": [1, 1, 5, 0x001],
    }
    assert list(facts) == list(states)
    for verb, fact in facts.items():
        assert [fact["ended"], fact["returned"]] == [True, False], verb
        assert fact["state"] == states[verb], verb
        assert fact["next"] == [False, False, "getTCPOffset() function did not succeed!"], verb
    assert station.events("play") == []
    assert {e["by"] for e in station.events("unlock protective stop") if e["accepted"]} == {"operator"}
    assert {e["by"] for e in station.events("stop")} == {"dashboard", "another dashboard client"}


@pytest.mark.slow
def test_a_foreign_program_ends_the_move_and_then_looks_like_ours(station: StationProcess) -> None:
    facts = play("foreign_program", station).facts
    assert facts == {
        "moving": True,
        "ended": True,
        "returned": False,
        "seems_to_run": True,
        "stands": True,
        "hangs": True,
        "moves": False,
    }
    assert [e["accepted"] for e in station.events("command 1")][-2:] == [True, False]
    station.ask("dashboard-stop")


@pytest.mark.slow
def test_a_stop_waits_for_a_blocking_move(station: StationProcess) -> None:
    played = play("stop_of_a_blocking_move", station)
    assert played.facts == {"moving": True, "arrived": True, "ended": True}


@pytest.mark.slow
def test_a_protective_stop_leaves_the_operation_running(start: Callable[..., StationProcess]) -> None:
    played = play("protective_stop_of_an_async_move", start(*FAST))
    assert played.facts == {"still_running": True, "stands_after_unlock": True, "play": True, "goes_on": True}


# -- the unmodified ur_rtde: who has the arm --------------------------------------------------------------------------


@pytest.mark.slow
def test_registers_of_a_fieldbus(start: Callable[..., StationProcess]) -> None:
    facts = play("registers", start()).facts
    for name in ("lower", "io", "upper"):
        assert "already in use" in facts.pop(name), name
    assert facts == {"upper_works": True, "free": None}


@pytest.mark.slow
def test_a_robot_whose_client_died_finishes_its_move(
    start: Callable[..., StationProcess],
) -> None:
    station = start(*FAST)
    played = play("die_in_async_move", station)
    assert played.ended == -signal.SIGKILL
    goal = pytest.approx(played.facts["goal"], abs=1e-3)
    state = station.wait_for(lambda state: bool(state["q_rad"] == goal))
    assert (state["runtime_state"], state["program"]) == ("PLAYING", "rtde_control")


@pytest.mark.slow
def test_a_watchdog_stops_the_arm_of_a_dead_client(start: Callable[..., StationProcess]) -> None:
    station = start()
    assert play("die_under_watchdog", station).facts == {"died": True}
    station.wait_for(lambda state: state["runtime_state"] == "STOPPED" and not state["moving"])
    (stopped,) = station.events("stopped rtde_control")
    assert "watchdog" in stopped["why"]
    assert station.events("stands")[-1]["t_host_ns"] > stopped["t_host_ns"]


@pytest.mark.slow
def test_a_new_client_ends_an_asynchronous_move_at_once(start: Callable[..., StationProcess]) -> None:
    station = start()
    goal = play("die_in_async_move", station).facts["goal"]
    assert play("constructor", station).facts == {"begun": True, "error": None}
    assert station.ask("state")["q_rad"][5] < goal[5] - 0.3


@pytest.mark.slow
def test_a_new_client_hangs_behind_a_blocking_move_until_the_program_is_stopped(
    start: Callable[..., StationProcess],
) -> None:
    station = start()
    goal = pytest.approx(play("die_in_blocking_move", station).facts["goal"], abs=1e-3)
    known = len(station.ask("state")["events"])
    with ThreadPoolExecutor(1) as pool:
        constructor = pool.submit(play, "constructor", station)
        station.wait_for_event("connected", since=known)
        assert station.ask("state")["moving"]
        station.wait_for(lambda state: bool(state["q_rad"] == goal))
        time.sleep(HANGS_S)  # that it does not end has no condition to wait for
        assert not constructor.done()
        station.ask("dashboard-stop")
        assert constructor.result().facts == {"begun": True, "error": None}


CONSTRUCTORS: dict[str, tuple[dict[str, Any], str | None]] = {
    "no RTDE port": ({"do": "listen", "what": "rtde", "on": False}, "Could not connect"),
    "no dashboard port": ({"do": "listen", "what": "dashboard", "on": False}, "Timeout connecting to UR dashboard"),
    "no script port": ({"do": "listen", "what": "script", "on": False}, "Connection refused"),
    "local control": ({"do": "remote-control", "on": False}, "enable remote control"),
    "silent dashboard": ({"do": "silent", "what": "dashboard"}, "Operation canceled"),
    "silent RTDE": ({"do": "silent", "what": "rtde"}, None),
    "no samples": ({"do": "silent", "what": "rtde", "answers": True}, None),
}
"""What is wrong, and the error; None where the constructor hangs."""


@pytest.mark.slow
def test_constructors(start: Callable[..., StationProcess]) -> None:
    def construct(name: str) -> Played:
        fault, error = CONSTRUCTORS[name]
        station = start()
        station.ask(**fault)
        return play("constructor", station, hangs=error is None)

    with ThreadPoolExecutor(AT_ONCE) as pool:
        for (name, (_fault, error)), played in zip(
            CONSTRUCTORS.items(), pool.map(construct, CONSTRUCTORS), strict=True
        ):
            if error is None:
                assert (played.ended, played.facts) == (None, {"begun": True}), name
            else:
                assert error in played.facts["error"], name


# -- the unmodified ur_rtde: versions and settings --------------------------------------------------------------------

GENERATIONS = ("3.15", "5.4", "5.10", "5.26")


@pytest.mark.slow
def test_every_generation(start: Callable[..., StationProcess]) -> None:
    with ThreadPoolExecutor(AT_ONCE) as pool:
        results = pool.map(lambda version: play("generation", start("--polyscope", version)), GENERATIONS)
        for version, played in zip(GENERATIONS, results, strict=True):
            facts = played.facts
            assert facts.pop("version").startswith(version)
            model = facts.pop("model")
            assert ("could not understand" in model) if version == "5.4" else (model == "UR5"), version
            assert (facts.pop("serial") is None) == (version not in ("3.15", "5.4"))
            assert [facts.pop("registers"), facts.pop("limits"), facts.pop("tcp")] == [False, [True, False], [0.0] * 6]
            assert {name for name, value in facts.items() if value is not True} == set(), version
            assert len(facts) == 10, version


@pytest.mark.slow
def test_variables_only_one_side_knows(station: StationProcess, start: Callable[..., StationProcess]) -> None:
    assert play("variables", station).facts == {"shifted": True}
    assert "[tcp_offset]" in play("variables_refused", start("--no-tcp-offset")).facts["error"]


def test_local_control_is_remembered_by_a_connection(station: StationProcess) -> None:
    facts = play("local_control", station).facts
    assert "Remote Control" in facts["stop"]
    assert "enable remote control" in facts["constructor"]
    assert [facts["remote"], facts["remote_again"]] == [False, True]
    assert facts["still"] == facts["stop"]
    assert facts["reconnected"] is None


@pytest.mark.slow
def test_slider_and_limiter(station: StationProcess) -> None:
    played = play("slider", station)
    station.ask("dashboard-stop")
    station.ask("slider", fraction=1.0)
    station.ask("speed-scaling", fraction=1.0)
    assert played.facts == {
        "quarter": True,
        "fraction": 0.25,
        "eighth": True,
        "scaling": 0.5,
        "stands": True,
        "running": True,
    }
