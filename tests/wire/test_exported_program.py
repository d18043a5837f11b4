"""An exported program on the emulated controller, which reads URScript by itself."""

import re
from collections.abc import Callable
from math import degrees, radians
from typing import Any

import numpy as np
import pytest

from ftdrive.exports.urscript import program
from ftdrive.planning.geometry.arm_model import ArmModel, Cylinder
from ftdrive.planning.geometry.certify import Certifier
from ftdrive.planning.geometry.scene import Scene
from ftdrive.planning.motion import Speeds
from ftdrive.planning.plan import Plan
from ftdrive.planning.planner import guess_of, plan_tour
from ftdrivers.ur.script_control import without_comments
from tests.wire.conftest import Station

pytestmark = pytest.mark.slow  # every test needs a process of its own

SCRIPT_PORT = 30003
DWELL_S = 1.0


@pytest.fixture(scope="module")
def plan() -> Plan:
    certifier = Certifier(ArmModel("ur5e", [Cylinder(0.0, 0.2, 0.1)]), Scene())
    return plan_tour(certifier, poses=24, speeds=Speeds(), guess=guess_of(certifier)).marked(measured=True)


@pytest.fixture
def start(plan: Plan, start_station: Callable[..., Station]) -> Callable[[float], Station]:
    """Start a controller whose arm is this far from the first pose, and send it the program."""

    def start(away_deg: float) -> Station:
        q_deg = [degrees(angle) for angle in plan.steps[0].q_rad]
        q_deg[5] += away_deg
        station = start_station("--time-scale", "20", "--start-q-deg", ",".join(f"{angle:.3f}" for angle in q_deg))
        with station.connect(SCRIPT_PORT) as sock:
            sock.sendall(without_comments(program(plan, dwell_s=DWELL_S)).encode("ascii"))
        station.wait_for(lambda state: state["popup"] is not None)
        return station

    return start


def events(state: dict[str, Any], what: str) -> list[str]:
    return [event["why"] for event in state["events"] if event["what"] == what]


@pytest.mark.slow
def test_it_asks_and_then_visits_every_pose_at_rest(plan: Plan, start: Callable[[float], Station]) -> None:
    station = start(25.0)
    asked = station.ask("state")
    assert "Keep the space within 0.35 m" in asked["popup"]
    assert not asked["moving"]
    assert asked["q_rad"][5] == pytest.approx(plan.steps[0].q_rad[5] + radians(25), abs=1e-3)

    assert station.ask("close-popup")["accepted"]
    state = station.wait_for(lambda state: state["runtime_state"] == "STOPPED")
    diary = [event for event in state["events"] if event["what"] in ("moves", "stands") or ": pose " in event["why"]]
    steps = [*plan.steps, plan.steps[0]]
    assert [event["what"] for event in diary] == ["moves", "stands", "textmsg"] * len(steps)
    for step, stands, said in zip(steps, diary[1::3], diary[2::3], strict=True):
        assert re.findall(r"R(\d\d)", said["why"])[0] == f"{step.number:02}"
        np.testing.assert_allclose(stands["q_rad"], step.q_rad, atol=2e-3)
    for stands, moves in zip(diary[1:-2:3], diary[3::3], strict=True):
        assert moves["t_robot_s"] - stands["t_robot_s"] == pytest.approx(DWELL_S, abs=0.1)
    assert "The tour is complete." in events(state, "popup")


def test_far_from_the_first_pose_it_moves_nothing(plan: Plan, start: Callable[[float], Station]) -> None:
    station = start(-35.0)
    station.ask("close-popup")
    station.wait_for(lambda state: "jog all joints" in (state["popup"] or ""))
    station.ask("close-popup")
    station.wait_for(lambda state: state["runtime_state"] == "STOPPED")
    state = station.ask("state")
    assert state["q_rad"][5] == pytest.approx(plan.steps[0].q_rad[5] + radians(-35.0), abs=1e-3)
    assert not any(": pose " in words for words in events(state, "textmsg"))
