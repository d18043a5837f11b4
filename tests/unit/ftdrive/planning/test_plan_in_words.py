"""A plan in words."""

from dataclasses import replace

import numpy as np
import pytest

from ftdrive.cell.config import RobotConfig
from ftdrive.planning.geometry.arm_model import ArmModel, Cylinder
from ftdrive.planning.geometry.certify import Certifier
from ftdrive.planning.geometry.scene import Scene
from ftdrive.planning.motion import Speeds
from ftdrive.planning.plan import Plan
from ftdrive.planning.planner import guess_of, plan_tour


@pytest.fixture(scope="module")
def plan() -> Plan:
    certifier = Certifier(ArmModel("ur5e", [Cylinder(0.0, 0.2, 0.1)]), Scene())
    return plan_tour(certifier, speeds=Speeds(), guess=guess_of(certifier))


def test_a_plan_that_is_not_proven_does_not_look_proven(plan: Plan) -> None:
    steps = (replace(plan.steps[0], certified=False), *plan.steps[1:])
    assert "NOT ALL PROVEN" in replace(plan, steps=steps).in_words()


def test_the_way_of_a_stop_follows_from_speed_and_deceleration(plan: Plan) -> None:
    assert max(step.speed_rad_s for step in plan.steps) == pytest.approx(np.radians(60))
    assert "60 °/s brakes with 300 °/s²: the arm rests after 0.20 s and 6.0°" in plan.stop_in_words(RobotConfig("ur"))
    soft = RobotConfig("ur", stop_deceleration_deg_s2=100.0)
    assert "with 100 °/s²: the arm rests after 0.60 s and 18.0°" in plan.stop_in_words(soft)
    assert not plan.stop_in_words(RobotConfig("ur", driver="another"))
