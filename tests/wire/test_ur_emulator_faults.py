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

ROOT = Path(__file__).parents[2]
CLIENT = Path(__file__).with_name("ur_emulator_faults_client.py")
AT_ONCE = 4  # stations and clients side by side: they mostly wait
FAST = ("--time-scale", "20")


class Station:
    """A station process that can be killed and started again on the same address."""

    def __init__(self, *options: str) -> None:
        self._options = options
        self.host = ""
        self.start()

    def start(self) -> None:
        host = ("--host", self.host) if self.host else ()
        self.process = subprocess.Popen(
            [sys.executable, "-m", "mocks", "station", "--sensor", "none", *self._options, *host],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            cwd=ROOT,
        )
        self.host = self._answer()["arm"]["host"]

    def _answer(self) -> dict[str, Any]:
        assert self.process.stdout is not None
        answer: dict[str, Any] = json.loads(self.process.stdout.readline())
        return answer

    def ask(self, **request: Any) -> dict[str, Any]:
        assert self.process.stdin is not None
        self.process.stdin.write(json.dumps(request) + "\n")
        self.process.stdin.flush()
        answer = self._answer()
        assert "error" not in answer, answer
        return answer

    def kill(self) -> None:
        self.process.kill()
        self.process.communicate()

    def wait_for(self, condition: Callable[[dict[str, Any]], bool], timeout_s: float = 5.0) -> dict[str, Any]:
        end = time.monotonic() + timeout_s
        while not condition(state := self.ask(do="state")):
            assert time.monotonic() < end, state
            time.sleep(0.01)
        return state

    def events(self, what: str) -> list[dict[str, Any]]:
        return [event for event in self.ask(do="state")["events"] if event["what"] == what]

    def connect(self, port: int) -> socket.socket:
        return socket.create_connection((self.host, port), 2.0)


@pytest.fixture
def start() -> Iterator[Callable[..., Station]]:
    """Start stations that end with the test."""
    stations: list[Station] = []

    def new(*options: str) -> Station:
        stations.append(Station(*options))
        return stations[-1]

    yield new
    for station in stations:
        station.kill()


@pytest.fixture(scope="module")
def station() -> Iterator[Station]:
    """One for all tests that leave it as they found it."""
    shared = Station()
    yield shared
    shared.kill()


@dataclass
class Played:
    """What a client told, and how it ended: its return code, or None when it had to be killed after the limit."""

    facts: dict[str, Any] = field(default_factory=dict)
    ended: int | None = None
    talk: str = ""


def play(scenario: str, station: Station, limit_s: float = 20.0) -> Played:
    """Run a scenario of ur_emulator_faults_client.py in its own process and do what it asks for."""
    pytest.importorskip("rtde_control")
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

    alarm = threading.Timer(limit_s, end)
    alarm.start()
    played = Played()
    try:
        for line in client.stdout:
            if line.startswith("@fact "):
                played.facts |= json.loads(line[6:])
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
        assert station.ask(do="state")["bad_inputs"] == []
    return played


def _serve(station: Station, request: dict[str, Any]) -> dict[str, Any]:
    if request["do"] == "kill":
        station.kill()
    elif request["do"] == "restart":
        station.start()
    else:
        return station.ask(**request)
    return {}


def play_all(start: Callable[..., Station], *scenarios: str) -> dict[str, Played]:
    """Several scenarios side by side, each with a station of its own."""
    with ThreadPoolExecutor(AT_ONCE) as pool:
        return dict(zip(scenarios, pool.map(lambda name: play(name, start()), scenarios), strict=True))


# -- on the wires -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("what", "ports"), [("rtde", [30004]), ("dashboard", [29999]), ("script", [30002, 30003])])
def test_ports_close_and_open_one_by_one(station: Station, what: str, ports: list[int]) -> None:
    known = len(station.ask(do="state")["events"])
    with station.connect(ports[0]) as before:
        station.wait_for(
            lambda state: any((e["by"], e["what"]) == (what, "connected") for e in state["events"][known:])
        )
        station.ask(do="listen", what=what, on=False)
        station.ask(do="listen", what=what, on=False)
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
        station.ask(do="listen", what=what, on=True)
        for port in ports:
            station.connect(port).close()


def test_a_silent_dashboard_accepts_and_answers_later(station: Station) -> None:
    with station.connect(29999) as old:
        assert old.makefile("rb").readline().startswith(b"Connected")
        station.ask(do="silent", what="dashboard", on=True)
        old.sendall(b"robotmode\n")
        with station.connect(29999) as new:
            for client in (old, new):
                client.settimeout(0.05)
                with pytest.raises(TimeoutError):
                    client.recv(1)
            station.ask(do="silent", what="dashboard", on=False)
            for client, line in (
                (old, b"Robotmode: RUNNING\n"),
                (new, b"Connected: Universal Robots Dashboard Server\n"),
            ):
                client.settimeout(2.0)
                assert client.recv(100) == line


@pytest.mark.parametrize("answers", [True, False])
def test_silent_rtde_stops_streaming_and_answers_only_if_asked_to(station: Station, answers: bool) -> None:
    with station.connect(30004) as client:
        client.sendall(struct.pack(">HB", 20, ord("O")) + struct.pack(">d", 500.0) + b"timestamp"[:9])
        assert client.recv(100)[2:4] == b"O\x01"
        client.sendall(b"\x00\x03S")
        assert client.recv(4) == b"\x00\x04S\x01"
        assert client.recv(100)[2:3] == b"U"
        station.ask(do="silent", what="rtde", on=True, answers=answers)
        client.settimeout(0.1)
        with contextlib.suppress(TimeoutError):
            while client.recv(1000):
                pass  # what was on its way
        client.sendall(b"\x00\x03v")
        if answers:
            assert client.recv(100)[2:3] == b"v"
        with pytest.raises(TimeoutError):
            client.recv(100)
        station.ask(do="silent", what="rtde", on=False)
        client.settimeout(2.0)
        assert client.recv(100)[2:3] == (b"U" if answers else b"v")


def test_connections_come_and_go_in_the_diary(start: Callable[..., Station]) -> None:
    station = start()
    with station.connect(30004) as client:
        station.wait_for(lambda state: [e["what"] for e in state["events"]] == ["connected"])
        before = time.monotonic_ns()
        assert station.ask(do="drop", what="rtde", reset=True)["connections"] == 1
        with pytest.raises(ConnectionResetError):
            client.recv(1)
    drop, gone = station.ask(do="state", since=1)["events"]
    assert (drop["by"], drop["what"], drop["reset"]) == ("network", "drop rtde", True)
    assert (gone["by"], gone["what"]) == ("rtde", "disconnected")
    assert before < drop["t_host_ns"] <= gone["t_host_ns"] < time.monotonic_ns()


def test_any_mode_can_be_asked_for(start: Callable[..., Station]) -> None:
    station = start()
    for number, name in ((2, "REDUCED"), (4, "RECOVERY"), (5, "SAFEGUARD_STOP"), (1, "NORMAL"), (3, "PROTECTIVE_STOP")):
        assert station.ask(do="mode", safety=number)["safety_mode"] == name
        assert station.ask(do="state")["robot_mode"] == "RUNNING"
    assert station.ask(do="mode", safety=9) == {"done": "mode", "robot_mode": "POWER_OFF", "safety_mode": "FAULT"}
    for number, name in ((-1, "NO_CONTROLLER"), (5, "IDLE"), (7, "RUNNING")):
        assert station.ask(do="mode", robot=number)["robot_mode"] == name


# -- the unmodified ur_rtde: the link ---------------------------------------------------------------------------------


def test_the_server_goes_away(start: Callable[..., Station]) -> None:
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
        "returns_after_the_kill": False,
        "returns_after_the_restart": False,
    }
    assert played["command_after_loss"].facts == {"connected": False, "hangs": True}


def test_the_link_is_cut(start: Callable[..., Station]) -> None:
    stations = {name: start() for name in ("dropped_moving", "dropped_idle", "dropped_without_dashboard")}
    with ThreadPoolExecutor(AT_ONCE) as pool:
        played = {name: pool.submit(play, name, station) for name, station in stations.items()}
    moving = played["dropped_moving"].result().facts
    assert moving.pop("after_s") < 1.0
    # it polls for the loss once per millisecond: on a busy machine the reconnection is faster, and the call hangs
    assert (moving.pop("ended"), moving.pop("returned")) in ((True, False), (False, None))
    assert moving == {"moving": True, "lost": True, "robot_finishes": True}
    idle = played["dropped_idle"].result()
    assert idle.facts["lost"]
    crashed = idle.ended == -signal.SIGSEGV
    assert crashed or idle.facts["survived"]
    assert crashed or len(stations["dropped_idle"].events("program rtde_control")) >= 3  # uploads again and again
    assert played["dropped_without_dashboard"].result().facts == {"lost": True, "back": True, "moves": True}


def test_the_samples_stay_away(start: Callable[..., Station]) -> None:
    played = play_all(start, "frozen", "silent", "briefly_silent")
    assert played["briefly_silent"].facts == {
        "moving": True,
        "same_stamp": True,
        "connected": [True, True],
        "ended": True,
        "returned": True,
    }
    silent = played["silent"]
    assert 2.4 < silent.facts.pop("after_s") < 3.5
    assert silent.facts.pop("survived", True)  # or the client has crashed
    assert silent.ended in (0, -signal.SIGSEGV)
    expected = {
        "moving": True,
        "ended": True,
        "returned": False,
        "receive_lost": True,
        "control_says_connected": True,
        "program_runs": False,
        "receive_back": True,
    }
    assert {name: silent.facts.get(name, expected["receive_back"]) for name in expected} == expected
    frozen = played["frozen"].facts
    assert 2.4 < frozen.pop("after_s") < 3.5
    assert frozen == {"moving": True, "receive_lost": True, "returns": False, "receive_back": True}


# -- the unmodified ur_rtde: program, safety, power -------------------------------------------------------------------


def test_whatever_ends_or_holds_the_program_ends_the_blocking_move(start: Callable[..., Station]) -> None:
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
        assert fact["after_s"] < 1.0, verb
        assert fact["state"] == states[verb], verb
        assert fact["next"] == [False, False, "getTCPOffset() function did not succeed!"], verb
    assert station.events("play") == []
    assert {e["by"] for e in station.events("unlock protective stop") if e["accepted"]} == {"operator"}
    assert {e["by"] for e in station.events("stop")} == {"dashboard", "another dashboard client"}


def test_a_foreign_program_ends_the_move_and_then_looks_like_ours(station: Station) -> None:
    facts = play("foreign_program", station).facts
    assert facts == {
        "moving": True,
        "ended": True,
        "returned": False,
        "seems_to_run": True,
        "stands": True,
        "answered": False,
        "moves": False,
    }
    assert [e["accepted"] for e in station.events("command 1")][-2:] == [True, False]
    station.ask(do="dashboard-stop")


def test_a_stop_waits_for_a_blocking_move(station: Station) -> None:
    played = play("stop_of_a_blocking_move", station)
    assert played.facts == {"moving": True, "arrived": True, "ended": True}


def test_a_protective_stop_leaves_the_operation_running(start: Callable[..., Station]) -> None:
    played = play("protective_stop_of_an_async_move", start(*FAST))
    assert played.facts == {"still_running": True, "stands_after_unlock": True, "play": True, "goes_on": True}


# -- the unmodified ur_rtde: who has the arm --------------------------------------------------------------------------


def test_registers_of_a_fieldbus(start: Callable[..., Station]) -> None:
    facts = play("registers", start()).facts
    for name in ("lower", "io", "upper"):
        assert "already in use" in facts.pop(name), name
    assert facts == {"upper_works": True, "free": None}


def test_a_robot_whose_client_died_finishes_its_move_and_keeps_the_program(start: Callable[..., Station]) -> None:
    station = start(*FAST)
    played = play("die_in_async_move", station)
    assert played.ended == -signal.SIGKILL
    goal = pytest.approx(played.facts["goal"], abs=1e-3)
    state = station.wait_for(lambda state: bool(state["q_rad"] == goal))
    assert (state["runtime_state"], state["program"]) == ("PLAYING", "rtde_control")


def test_a_watchdog_stops_the_arm_of_a_dead_client(start: Callable[..., Station]) -> None:
    station = start()
    played = play("die_under_watchdog", station)
    station.wait_for(lambda state: state["runtime_state"] == "STOPPED" and not state["moving"])
    (stopped,) = station.events("stopped rtde_control")
    assert "watchdog" in stopped["why"]
    assert 0.1 < (stopped["t_host_ns"] - played.facts["died_ns"]) * 1e-9 < 1.0
    assert station.events("stands")[-1]["t_host_ns"] > stopped["t_host_ns"]


def test_a_new_client_ends_an_asynchronous_move_at_once(start: Callable[..., Station]) -> None:
    station = start()
    goal = play("die_in_async_move", station).facts["goal"]
    facts = play("constructor", station).facts
    assert facts["error"] is None
    assert facts["seconds"] < 1.0
    assert station.ask(do="state")["q_rad"][5] < goal[5] - 0.3


def test_a_new_client_hangs_behind_a_blocking_move_until_somebody_stops_the_program(
    start: Callable[..., Station],
) -> None:
    station = start()
    goal = pytest.approx(play("die_in_blocking_move", station).facts["goal"], abs=1e-3)
    with ThreadPoolExecutor(1) as pool:
        constructor = pool.submit(play, "constructor", station)
        station.wait_for(lambda state: bool(state["q_rad"] == goal))
        time.sleep(1.0)  # that it does not end has no condition to wait for
        assert not constructor.done()
        station.ask(do="dashboard-stop")
        assert constructor.result().facts["error"] is None


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


def test_constructors(start: Callable[..., Station]) -> None:
    def construct(name: str) -> Played:
        fault, error = CONSTRUCTORS[name]
        station = start()
        station.ask(**fault)
        return play("constructor", station, 10.0 if error else 1.5)

    with ThreadPoolExecutor(AT_ONCE) as pool:
        for (name, (_fault, error)), played in zip(
            CONSTRUCTORS.items(), pool.map(construct, CONSTRUCTORS), strict=True
        ):
            if error is None:
                assert (played.ended, played.facts) == (None, {}), name
            else:
                assert error in played.facts["error"], name


# -- the unmodified ur_rtde: versions and settings --------------------------------------------------------------------

GENERATIONS = ("3.15", "5.4", "5.9", "5.10", "5.15", "5.23", "5.26")


def test_every_generation(start: Callable[..., Station]) -> None:
    with ThreadPoolExecutor(AT_ONCE) as pool:
        results = pool.map(lambda version: play("generation", start("--polyscope", version)), GENERATIONS)
        for version, played in zip(GENERATIONS, results, strict=True):
            facts = played.facts
            assert facts.pop("version").startswith(version)
            assert facts.pop("period_s") == pytest.approx(0.008 if version == "3.15" else 0.002), version
            model = facts.pop("model")
            assert ("could not understand" in model) if version == "5.4" else (model == "UR5"), version
            assert (facts.pop("serial") is None) == (version not in ("3.15", "5.4"))
            assert [facts.pop("registers"), facts.pop("limits"), facts.pop("tcp")] == [False, [True, False], [0.0] * 6]
            assert {name for name, value in facts.items() if value is not True} == set(), version
            assert len(facts) == 10, version


def test_variables_only_one_side_knows(station: Station, start: Callable[..., Station]) -> None:
    assert play("variables", station).facts == {"shifted": True}
    assert "[tcp_offset]" in play("variables_refused", start("--no-tcp-offset")).facts["error"]


def test_local_control_is_remembered_by_a_connection(station: Station) -> None:
    facts = play("local_control", station).facts
    assert "Remote Control" in facts["stop"]
    assert "enable remote control" in facts["constructor"]
    assert [facts["remote"], facts["remote_again"]] == [False, True]
    assert facts["still"] == facts["stop"]
    assert facts["reconnected"] is None


def test_slider_and_limiter(station: Station) -> None:
    played = play("slider", station)
    station.ask(do="dashboard-stop")
    station.ask(do="slider", fraction=1.0)
    station.ask(do="speed-scaling", fraction=1.0)
    assert played.facts == {
        "quarter": True,
        "fraction": 0.25,
        "eighth": True,
        "scaling": 0.5,
        "stands": True,
        "running": True,
    }
