"""The control channel of a station: what happens to the tool, the sensor and the arm shows where it should."""

import json
import math
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest


class Answering:
    """A station process and its control channel."""

    def __init__(self, *options: str) -> None:
        command = [sys.executable, "-m", "mocks", "station", "--seed", "2", "--sensor", "bota", *options]
        self.process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
        assert self.process.stdout
        self.hello = json.loads(self.process.stdout.readline())

    def do(self, verb: str, **how: Any) -> dict[str, Any]:
        assert self.process.stdin
        assert self.process.stdout
        self.process.stdin.write(json.dumps({"do": verb, **how}) + "\n")
        self.process.stdin.flush()
        answer: dict[str, Any] = json.loads(self.process.stdout.readline())
        return answer

    def wrench(self) -> np.ndarray:
        return np.array(self.do("state")["true_wrench"])

    def until(self, condition: Callable[[dict[str, Any]], bool], within_s: float = 5.0) -> dict[str, Any]:
        deadline = time.monotonic() + within_s
        while not condition(state := self.do("state")):
            assert time.monotonic() < deadline, state
            time.sleep(0.01)
        return state

    def close(self) -> None:
        self.process.communicate(timeout=5)


@pytest.fixture(scope="module")
def station() -> Iterator[Answering]:
    station = Answering()
    yield station
    station.close()


def test_a_bump_comes_and_goes_beside_a_push(station: Answering) -> None:
    before = station.wrench()
    station.do("push", wrench=[0, 0, 3, 0, 0, 0])
    station.do("bump", seconds=0.2)
    assert np.linalg.norm((station.wrench() - before)[:3] - [0, 0, 3]) == pytest.approx(15)
    station.until(lambda s: np.allclose(np.array(s["true_wrench"]) - before, [0, 0, 3, 0, 0, 0]))
    station.do("push", wrench=[0] * 6)
    np.testing.assert_allclose(station.wrench(), before)


def test_cables_drift_and_payload(station: Answering) -> None:
    before = station.wrench()
    q6_deg = math.degrees(station.do("state")["q_rad"][5])
    station.do("cable", joint=6, beyond_deg=q6_deg - 10, force_N_deg=[0.5, 0, 0])
    assert np.linalg.norm((station.wrench() - before)[:3]) == pytest.approx(5.0)
    up = -np.sign(before[2] - station.hello["truth"]["force_bias_N"][2])  # 1 where the sensor's z axis points up
    station.do("cable", towards=[0, 0, -up], within_deg=60, force_N=[8, 0, 0])
    np.testing.assert_allclose(station.wrench(), before)
    station.do("cable", towards=[0, 0, up], within_deg=60, force_N=[8, 0, 0])
    assert np.linalg.norm((station.wrench() - before)[:3]) == pytest.approx(8.0)
    station.do("cable", on=False)
    station.do("drift", force_N=[0, 0, 0.5], seconds=0.05)
    station.until(lambda s: np.allclose(np.array(s["true_wrench"]) - before, [0, 0, 0.5, 0, 0, 0]))
    truth = station.do("payload_shift", mass_kg=3.0)["truth"]
    assert (truth["mass_kg"], truth["p_sensor_com_m"]) == (3.0, station.hello["truth"]["p_sensor_com_m"])
    weight_N = station.wrench()[:3] - truth["force_bias_N"] - [0, 0, 0.5]
    assert np.linalg.norm(weight_N) == pytest.approx(3 * 9.80665)


@pytest.mark.parametrize(
    ("verb", "how", "why"),
    [
        ("push", {"wrench": [1, 2, 3]}, "expected 6 numbers"),
        ("push", {"wrench": [0] * 6, "axes": "tool"}, "tool"),
        ("cable", {"joint": 7, "beyond_deg": 0, "force_N_deg": [1, 0, 0]}, "joint 7"),
        ("cable", {}, "force_N"),
        ("payload-shift", {}, "mass_kg"),
        ("saturate", {"axis": 6}, "axis 6"),
        ("saturate", {"device": "can"}, "can"),
        ("sensor-faults", {"dropp": 1}, "unknown fault dropp"),
        ("hand-move", {"q_rad": [0] * 5}, "hand-move"),
        ("hand-move", {"q_rad": [0] * 6, "speed_rad_s": 0}, "positive speed"),
        ("hand-guide", {"rest_s": 0}, "rest_s 0"),
        ("pendant-program", {"rest_s": "long"}, "long"),
        ("push-joint", {"joint": 0, "off_deg": 1}, "joint 0"),
        ("set-payload", {"payload_kg": -1}, "payload -1"),
        ("set-payload", {"payload_kg": 1, "payload_cog_m": [0, 0]}, "not enough values"),
        ("slider", {"fraction": 2}, "not between"),
    ],
)
def test_a_wrong_request_is_an_error_and_changes_nothing(
    station: Answering, verb: str, how: dict[str, Any], why: str
) -> None:
    before = station.wrench()
    assert why in station.do(verb, **how)["error"]
    np.testing.assert_allclose(station.wrench(), before)


def test_a_hand_moves_the_arm(station: Answering) -> None:
    q_rad = station.do("state")["q_rad"]
    goal = [*q_rad[:5], q_rad[5] - 0.1]
    assert station.do("hand_move", q_rad=goal, speed_rad_s=0.5) == {"done": "hand-move"}
    assert station.until(lambda s: s["moving"])["runtime_state"] == "STOPPED"
    station.until(lambda s: not s["moving"] and s["q_rad"] == pytest.approx(goal, abs=1e-6))


def test_somebody_guides_the_arm_and_lets_go(station: Answering) -> None:
    before = station.do("state")
    try:
        assert station.do("hand-guide", rest_s=0.05) == {"done": "hand-guide"}
        state = station.until(lambda s: s["moving"] and abs(s["q_rad"][4] - before["q_rad"][4]) > 0.3)
    finally:
        station.do("hand-guide", on=False)
    assert state["runtime_state"] == "STOPPED"
    assert state["q_rad"][:3] == before["q_rad"][:3]
    station.until(lambda s: s["steady"])


def test_somebody_starts_a_program_on_the_pendant(station: Answering) -> None:
    assert station.do("pendant-program", rest_s=0.05)["accepted"]
    station.until(lambda s: s["program"] == "turns" and s["moving"])
    station.do("dashboard-stop")
    station.until(lambda s: s["steady"] and s["runtime_state"] == "STOPPED")


def test_a_pushed_joint_and_a_changed_payload(station: Answering) -> None:
    before = station.do("state")
    station.do("push-joint", joint=2, off_deg=3)
    pushed = station.until(lambda s: s["q_rad"][1] - before["q_rad"][1] == pytest.approx(math.radians(3), abs=1e-6))
    assert pushed["target_q_rad"] == before["target_q_rad"]
    station.do("push-joint", joint=2, off_deg=0)
    station.until(lambda s: s["q_rad"] == pytest.approx(before["q_rad"], abs=1e-6))
    station.do("set-payload", payload_kg=2.5, payload_cog_m=[0.01, 0, 0.05])
    station.do("set-payload", payload_kg=2.6)  # its centre stays
    state = station.do("state")
    assert (state["payload_kg"], state["payload_cog_m"]) == (2.6, [0.01, 0, 0.05])


def test_another_client_moves_the_arm(station: Answering) -> None:
    q_rad = station.do("state")["q_rad"]
    goal = [*q_rad[:5], q_rad[5] + 0.1]
    assert station.do("foreign_program", q_rad=goal, speed_rad_s=0.5)["accepted"]
    assert station.until(lambda s: s["moving"])["program"] == "other"
    station.until(lambda s: s["runtime_state"] == "STOPPED" and s["q_rad"] == pytest.approx(goal, abs=1e-6))


def test_a_silent_arm_keeps_its_connections_and_answers_later(station: Answering) -> None:
    with socket.create_connection((station.hello["arm"]["host"], 29999), 2.0) as dashboard:
        assert dashboard.recv(100).startswith(b"Connected")
        station.do("silence_arm")
        dashboard.sendall(b"robotmode\n")
        dashboard.settimeout(0.1)
        with pytest.raises(TimeoutError):
            dashboard.recv(100)
        station.do("silence_arm", on=False)
        dashboard.settimeout(2.0)
        assert dashboard.recv(100) == b"Robotmode: RUNNING\n"


def test_a_pendant_program_arrives_by_the_script_port(station: Answering) -> None:
    program = b'# checks\ndef ask():\n  popup("free?", blocking=True)\n  textmsg("go")\nend\n'
    with socket.create_connection((station.hello["arm"]["host"], 30002), 2.0) as script:
        script.sendall(program)
        station.until(lambda s: s["popup"] == "free?")
    assert station.do("close-popup")["accepted"]
    events = station.until(lambda s: s["runtime_state"] == "STOPPED")["events"]
    assert [event["why"] for event in events if event["what"] == "textmsg"] == ["go"]


def test_requests_to_begin_with() -> None:
    drift = {"do": "drift", "force_N": [0, 0, 0.5], "seconds": 0}
    station = Answering("--do", json.dumps(drift), "--do", '{"do": "slider", "fraction": 0.5}')
    try:
        truth, state = station.hello["truth"], station.do("state")
        weight_N = np.array(state["true_wrench"])[:3] - truth["force_bias_N"] - [0, 0, 0.5]
        assert np.linalg.norm(weight_N) == pytest.approx(truth["weight_N"])
        assert state["speed_fraction"] == 0.5
    finally:
        station.close()


@pytest.mark.parametrize(
    ("options", "why"),
    [
        (["--do", '{"do": "dance"}'], "not understood"),
        (["--sensor", "ur-ft", "--sensor-rotvec-deg", "0,0,30"], "leave --sensor-rotvec-deg out"),
        (["--sensor", "lab"], "invalid choice"),
    ],
)
def test_wrong_options_are_exit_code_2(options: list[str], why: str) -> None:
    command = [sys.executable, "-m", "mocks", "station", *options]
    ended = subprocess.run(command, stdin=subprocess.DEVNULL, capture_output=True, text=True, timeout=20, check=False)
    assert (ended.returncode, ended.stdout) == (2, "")
    assert why in ended.stderr
