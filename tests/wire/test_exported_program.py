"""An exported program on the emulated controller, which reads URScript by itself."""

import re
import socket
from collections.abc import Callable
from math import degrees, radians
from typing import Any

import numpy as np
import pytest

from ftdrive.exports.urscript import program
from ftdrive.planning.arm_model import ArmModel, Cylinder
from ftdrive.planning.certify import Certifier
from ftdrive.planning.motion import Speeds
from ftdrive.planning.plan import Plan
from ftdrive.planning.planner import guess_of, plan_tour
from ftdrive.planning.scene import Scene

SCRIPT_PORT = 30003


@pytest.fixture(scope="module")
def plan() -> Plan:
    certifier = Certifier(ArmModel("ur5e", [Cylinder(0.0, 0.2, 0.1)]), Scene())
    return plan_tour(certifier, poses=24, speeds=Speeds(), guess=guess_of(certifier)).marked(measured=True)


@pytest.fixture
def start(plan: Plan, start_station: Callable[..., Any]) -> Callable[[float], Any]:
    """Start a controller whose arm is this far from the first pose, and send it the program."""

    def start(away_deg: float) -> Any:
        q_deg = [degrees(angle) for angle in plan.steps[0].q_rad]
        q_deg[5] += away_deg
        station = start_station("--time-scale", "20", "--start-q-deg", ",".join(f"{angle:.3f}" for angle in q_deg))
        with socket.create_connection((station.host, SCRIPT_PORT), timeout=2) as sock:
            sock.sendall(program(plan, dwell_s=1.0).encode("ascii"))
        station.wait_for(lambda state: state["popup"] is not None, 5.0)
        return station

    return start


def events(state: dict[str, Any], what: str) -> list[str]:
    return [event["why"] for event in state["events"] if event["what"] == what]


def test_it_asks_and_then_visits_every_pose_at_rest(plan: Plan, start: Callable[[float], Any]) -> None:
    station = start(25.0)
    asked = station.do("state")
    assert "Keep a ball of 0.35 m" in asked["popup"]
    assert not asked["moving"]
    assert asked["q_rad"][5] == pytest.approx(plan.steps[0].q_rad[5] + radians(25), abs=1e-3)

    assert station.do("close-popup")["accepted"]
    rests: dict[int, list[float]] = {}

    def done(state: dict[str, Any]) -> bool:
        poses = [words for words in events(state, "textmsg") if ": pose " in words]
        if poses and not state["moving"]:
            rests.setdefault(len(poses), state["q_rad"])
        return bool(state["runtime_state"] == "STOPPED")

    station.wait_for(done, 30.0)
    said = [words for words in events(station.do("state"), "textmsg") if ": pose " in words]
    numbers = [step.number for step in plan.steps]
    assert [int(re.findall(r"R(\d\d)", words)[0]) for words in said] == [*numbers, numbers[0]]
    goals = [*(step.q_rad for step in plan.steps), plan.steps[0].q_rad]
    assert len(rests) > len(goals) // 2  # a rest of 1 s lasts 50 ms here: we may miss some
    for i, q_rad in rests.items():
        np.testing.assert_allclose(q_rad, goals[i - 1], atol=2e-3)
    assert "The tour is complete." in events(station.do("state"), "popup")


@pytest.mark.parametrize("away_deg", [35.0, -35.0])
def test_far_from_the_first_pose_it_moves_nothing(plan: Plan, start: Callable[[float], Any], away_deg: float) -> None:
    station = start(away_deg)
    station.do("close-popup")
    station.wait_for(lambda state: "jog all joints" in (state["popup"] or ""), 5.0)
    station.do("close-popup")
    station.wait_for(lambda state: state["runtime_state"] == "STOPPED", 5.0)
    state = station.do("state")
    assert state["q_rad"][5] == pytest.approx(plan.steps[0].q_rad[5] + radians(away_deg), abs=1e-3)
    assert not any(": pose " in words for words in events(state, "textmsg"))
