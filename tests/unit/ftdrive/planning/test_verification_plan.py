"""Plans for a verification: far from the calibration, proven clear, the same each time, short."""

from functools import cache

import numpy as np
import pytest

from ftcalib.poses.information import special
from ftdrive.errors import ConfigError
from ftdrive.planning.geometry.arm_model import ArmModel, Cylinder
from ftdrive.planning.geometry.certify import Certifier
from ftdrive.planning.geometry.scene import BASE_PLANE, Plane, Scene
from ftdrive.planning.motion import Speeds
from ftdrive.planning.plan import Plan
from ftdrive.planning.planner import USUAL_POSTURE_RAD, guess_of, plan_verification

CERTIFIER = Certifier(ArmModel("UR5e", [Cylinder(0.0, 0.2, 0.1)]), Scene((BASE_PLANE,)))
FITTED = special(range(1, 25))
DOWN = np.array([0.0, 0.0, -1.0])


@cache
def plan(poses: int, certifier: Certifier = CERTIFIER) -> Plan:
    guess = guess_of(certifier)
    return plan_verification(certifier, USUAL_POSTURE_RAD, poses, FITTED, speeds=Speeds(), guess=guess)


def test_gravity_is_far_from_where_it_was_in_the_calibration() -> None:
    made = plan(2)
    assert made.certified
    assert made.arm_rests
    assert len({step.number for step in made.steps}) == 2
    R = np.array([step.R_base_flange for step in made.steps])
    nearest = ((DOWN @ R) @ (DOWN @ FITTED).T).max(axis=1)
    assert np.degrees(np.arccos(nearest)).min() > 20


def test_one_pose_is_too_few() -> None:
    with pytest.raises(ConfigError, match="1 poses cannot verify"):
        plan(1)


@pytest.mark.slow
def test_another_posture_is_found_and_named() -> None:
    ceiling = Plane((0.0, 0.0, -1.0), -0.75)
    made = plan(6, Certifier(CERTIFIER.arm, Scene((BASE_PLANE, ceiling))))
    assert made.certified
    assert "A tour exists with joints 1 to 3 at" in made.why[1]
