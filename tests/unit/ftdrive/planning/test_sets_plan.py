"""Plans through the sets of Yu's Fig. 6, and verifications of many poses."""

from typing import Any

import pytest

from ftcalib.poses.selection import EVERY_SET, paper_set
from ftdrive.cell.config import CellConfig, RobotConfig, SensorConfig
from ftdrive.errors import ConfigError, PlanRefused
from ftdrive.planning.geometry.arm_model import ArmModel, Cylinder
from ftdrive.planning.geometry.certify import Certifier
from ftdrive.planning.geometry.scene import BASE_PLANE, Plane, Scene
from ftdrive.planning.motion import Speeds
from ftdrive.planning.planner import USUAL_POSTURE_RAD, guess_of, plan_for, plan_verification

CERTIFIER = Certifier(ArmModel("UR5e", [Cylinder(0.0, 0.2, 0.1)]), Scene((BASE_PLANE,)))
CELL = CellConfig(RobotConfig("arm"), SensorConfig("fake://"))
HOW: dict[str, Any] = {"speeds": Speeds(), "guess": guess_of(CERTIFIER)}


@pytest.mark.slow
def test_wrong_sets_are_refused() -> None:
    with pytest.raises(ConfigError, match="no set 'X'"):
        plan_for(CELL, CERTIFIER, USUAL_POSTURE_RAD, sets="X")
    low = Certifier(CERTIFIER.arm, Scene((BASE_PLANE, Plane((0.0, 0.0, -1.0), -0.45))))
    with pytest.raises(PlanRefused, match="no tour of the sets A"):
        plan_for(CELL, low, USUAL_POSTURE_RAD, sets="A")
    with pytest.raises(PlanRefused, match=r"no tour of the sets A\+H"):  # enough poses, but too few of A
        plan_for(CELL, low, USUAL_POSTURE_RAD, sets="A+H")


@pytest.mark.slow
def test_the_sets_of_the_table_are_one_tour() -> None:
    made = plan_for(CELL, CERTIFIER, USUAL_POSTURE_RAD, sets=EVERY_SET)
    assert made.certified
    assert len(made.steps) == 294
    assert made.motion_time_s < 400


@pytest.mark.slow
def test_a_verification_of_160_poses_is_planned() -> None:
    made = plan_verification(CERTIFIER, USUAL_POSTURE_RAD, 160, paper_set("A"), **HOW)
    assert made.certified
    assert len({step.number for step in made.steps}) == 160
