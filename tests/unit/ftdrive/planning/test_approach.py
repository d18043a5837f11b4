"""The way to the first pose, and the cell it is judged in."""

import numpy as np
import pytest

from ftdrive.cell.config import CellConfig, RobotConfig, SensorConfig, ToolConfig, WorkcellConfig
from ftdrive.cell.rules import Rows
from ftdrive.errors import ConfigError, PlanRefused
from ftdrive.planning.approach import Approach, plan_approach
from ftdrive.planning.geometry.arm_model import ArmModel, Cylinder
from ftdrive.planning.geometry.certify import Certifier
from ftdrive.planning.geometry.scene import BASE_PLANE, Box, Plane, Scene
from ftdrive.planning.motion import Speeds
from ftdrive.planning.planner import USUAL_POSTURE_RAD, certifier_for
from ftdrivers.ur.kinematics import Array

TOOL = (Cylinder(0, 0.2, 0.1),)
CROWDED = Scene(
    (BASE_PLANE, Plane((0.0, -1.0, 0.0), -0.45), Plane((-1.0, 0.0, 0.0), -0.6)),
    (Box((-0.9, -0.6, 0.0), (-0.3, -0.2, 0.3)), Box((0.3, -0.6, 0.0), (0.5, 0.2, 0.9))),
)
SLOW = Speeds.first_run()


def sampled_clear(certifier: Certifier, q_now: Array, approach: Approach) -> bool:
    ends = np.vstack([q_now, approach.q_rad])
    share = np.linspace(0, 1, 721)[:, None, None]
    path = (1 - share) * ends[:-1] + share * ends[1:]
    return bool(certifier.free(path.reshape(-1, 6)).all())


def random_free(certifier: Certifier, rng: np.random.Generator) -> Array:
    while True:
        q = rng.uniform(-np.pi, np.pi, 6) * [1, 0.5, 0.9, 1, 1, 1] - [0, np.pi / 2, 0, 0, 0, 0]
        if certifier.free(q)[0]:
            return np.asarray(q)


@pytest.mark.slow
def test_ways_through_a_crowded_cell_are_clear_where_sampled() -> None:
    rng = np.random.default_rng(2)
    detours = 0
    for model in ("UR3e", "UR5e") * 3:
        certifier = Certifier(ArmModel(model, TOOL), CROWDED)
        now = random_free(certifier, rng)
        approach = plan_approach(certifier, now, USUAL_POSTURE_RAD, SLOW)
        assert approach.certified
        assert np.array_equal(approach.q_rad[-1], USUAL_POSTURE_RAD)
        assert np.abs(approach.q_rad).max() <= 2 * np.pi
        assert sampled_clear(certifier, now, approach)
        detours += len(approach.q_rad) > 1
        again = plan_approach(certifier, now, USUAL_POSTURE_RAD, SLOW)
        assert np.array_equal(again.q_rad, approach.q_rad)
    assert detours > 1


def test_a_wound_joint_is_unwound_and_never_wound_further() -> None:
    certifier = Certifier(ArmModel("UR5e", TOOL), Scene())
    now = USUAL_POSTURE_RAD.copy()
    now[5] = np.radians(350)
    approach = plan_approach(certifier, now, USUAL_POSTURE_RAD, SLOW)
    assert np.array_equal(approach.q_rad, [USUAL_POSTURE_RAD])
    with pytest.raises(ConfigError, match="within ±360"):
        plan_approach(certifier, now + np.radians([0, 0, 0, 0, 0, 20]), USUAL_POSTURE_RAD, SLOW)


def test_the_error_names_what_an_arm_stands_too_near_to() -> None:
    arm = ArmModel("UR5e", TOOL)
    low = float(arm.frames(USUAL_POSTURE_RAD).wrist_m[0, 2])
    certifier = Certifier(arm, Scene((Plane((0.0, 0.0, 1.0), low - 0.06),)))
    away = USUAL_POSTURE_RAD - np.radians([0, 20, 0, 0, 0, 0])
    with pytest.raises(PlanRefused, match=r"plane 1\b.* 30 mm"):
        plan_approach(certifier, USUAL_POSTURE_RAD, away, SLOW)


TOOL_MM: Rows = ((0, 200, 100), (20, 60, 30, 70, -10))
AROUND = WorkcellConfig("wall", ((0, -2, 0, -800),), ((400, 0, 300, 300, -600, 0),))


def cell(tool: Rows = TOOL_MM, workcell: WorkcellConfig = AROUND) -> CellConfig:
    return CellConfig(RobotConfig(""), SensorConfig(""), ToolConfig(cylinders_mm=tool), workcell)


def test_a_cell_in_millimetres_becomes_what_judges_moves() -> None:
    certifier = certifier_for(cell(), "ur10e")
    assert certifier.arm.name == "UR10e"
    assert certifier.arm.tool == (Cylinder(0, 0.2, 0.1), Cylinder(0.02, 0.06, 0.03, 0.07, -0.01))
    assert tuple(certifier.scene.planes) == (BASE_PLANE, Plane((0.0, -1.0, 0.0), -0.8))
    assert certifier.scene.boxes == (Box((0.3, -0.6, 0.0), (0.4, 0.0, 0.3)),)
    assert np.allclose(certifier.scene.down_base, [-1, 0, 0])


PILLAR = Box((-0.2, -0.39, 0.0), (-0.08, -0.26, 1.2))
"""Where the flange stands in the usual posture."""


def panned_deg(angle: float) -> Array:
    return USUAL_POSTURE_RAD + np.radians([angle, 0, 0, 0, 0, 0])


def test_a_pillar_in_the_way_is_passed_on_a_proven_path() -> None:
    certifier = Certifier(ArmModel("UR5e", TOOL), Scene((BASE_PLANE,), (PILLAR,)))
    now, first = panned_deg(-60), panned_deg(60)
    approach = plan_approach(certifier, now, first, SLOW)
    assert len(approach.q_rad) == 2
    assert np.array_equal(approach.q_rad[-1], first)
    assert sampled_clear(certifier, now, approach)


def test_a_first_pose_that_is_not_clear_asks_for_a_new_plan() -> None:
    certifier = Certifier(ArmModel("UR5e", TOOL), Scene((BASE_PLANE,), (PILLAR,)))
    with pytest.raises(PlanRefused, match="first pose of the plan is not clear"):
        plan_approach(certifier, panned_deg(-60), panned_deg(40), SLOW)
