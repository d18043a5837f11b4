"""How fast a plan is driven, and how long it takes."""

import numpy as np
import pytest

from ftdrive.planning.approach import plan_approach
from ftdrive.planning.geometry.arm_model import ArmModel, Cylinder
from ftdrive.planning.geometry.certify import Certifier
from ftdrive.planning.geometry.scene import BASE_PLANE, Scene
from ftdrive.planning.motion import Speeds, move_duration_s
from ftdrive.planning.plan import Plan
from ftdrive.planning.planner import USUAL_POSTURE_RAD, guess_of, plan_tour
from ftdrive.session.drive import APPROACH_RAD_S, SLOW
from ftdrive.session.tour import moves_s


@pytest.fixture(scope="module")
def certifier() -> Certifier:
    return Certifier(ArmModel("UR5e", [Cylinder(0.0, 0.2, 0.1)]), Scene((BASE_PLANE,)))


@pytest.fixture(scope="module")
def plan(certifier: Certifier) -> Plan:
    return plan_tour(certifier, USUAL_POSTURE_RAD, 24, speeds=Speeds(), guess=guess_of(certifier))


def test_the_rest_of_a_tour_counts_what_is_left_and_the_ways_past_what_is_not(certifier: Certifier, plan: Plan) -> None:
    third = np.array(plan.steps[2].q_rad)
    there = plan_approach(certifier, third, third, SLOW)
    one = plan.steps[2].duration_s
    assert moves_s(plan, [3, 4], there) == pytest.approx(moves_s(plan, [3], there) + one)
    past = np.abs(np.subtract(plan.steps[8].q_rad, plan.steps[2].q_rad)).max()
    expected_s = float(move_duration_s(past, APPROACH_RAD_S, SLOW.joint_rad_s2))
    assert moves_s(plan, [3, 9], there) - moves_s(plan, [3], there) == pytest.approx(expected_s)
