"""Tilts with a load on a string: the hook stays, and the load keeps clear wherever it hangs."""

from functools import cache
from pathlib import Path

import numpy as np
import pytest

from ftdrive.cell.config import CellConfig, RobotConfig, SensorConfig, ToolConfig, WorkcellConfig
from ftdrive.errors import PlanRefused
from ftdrive.planning.approach import plan_approach
from ftdrive.planning.geometry.certify import Certifier
from ftdrive.planning.motion import Speeds
from ftdrive.planning.plan import Plan
from ftdrive.planning.planner import HUNG_POSES, USUAL_POSTURE_RAD, certifier_for, plan_for
from ftdrive.planning.search.nodes import WRIST_6_RAD
from ftdrive.session.open_session import SessionOptions
from ftdrive.session.session import Calibrating
from ftdrivers.ur.kinematics import MODELS, Array

HOOK_M = (0.0, 0.0, 0.2)
CELL = CellConfig(
    RobotConfig("arm", "UR5e"),
    SensorConfig("fake://"),
    ToolConfig(cylinders_mm=((0.0, 200.0, 100.0),)),
    WorkcellConfig(),
)


@cache
def certifier() -> Certifier:
    return certifier_for(CELL, "UR5e", MODELS["UR5e"], HOOK_M)


@cache
def plan() -> Plan:
    return plan_for(CELL, certifier(), USUAL_POSTURE_RAD)


def hooks(q_rad: Array) -> Array:
    return certifier().arm.hook_m(certifier().arm.frames(q_rad))


@pytest.mark.slow
def test_the_arm_turns_about_the_hook() -> None:
    q = plan().nodes_rad
    assert len(q) == HUNG_POSES
    assert np.ptp(hooks(q), axis=0).max() < 1e-6
    share = np.linspace(0, 1, 50)[:, None, None]
    between = hooks(((1 - share) * q + share * np.roll(q, -1, axis=0)).reshape(-1, 6))
    assert np.linalg.norm(between - hooks(q[:1]), axis=1).max() < 0.065


@pytest.mark.slow
def test_the_tilts_are_reached_from_those_about_another_hook() -> None:
    q_rad = np.radians([-36.0, -59.0, -111.0, -129.0, 17.0, 76.0])
    tilts_rad = Calibrating(CELL, SessionOptions(Path())).plan(certifier(), q_rad, 24).nodes_rad
    assert np.abs(tilts_rad[:, 5] - q_rad[5]).max() <= WRIST_6_RAD
    assert plan_approach(certifier().without_load, q_rad, tilts_rad[0], Speeds()).certified


@pytest.mark.slow
def test_the_plan_is_proven_with_its_load() -> None:
    plan().require(certifier())
    assert certifier().without_load.arm.hung is None


@pytest.mark.slow
def test_a_load_has_no_room_under_a_low_ceiling() -> None:
    low = CellConfig(CELL.robot, CELL.sensor, CELL.tool, WorkcellConfig(planes_mm=((0, 0, -1, -450),)))
    with pytest.raises(PlanRefused, match="jog the arm to where there is room"):
        plan_for(low, certifier_for(low, "UR3e", MODELS["UR3e"], HOOK_M), USUAL_POSTURE_RAD)


@pytest.mark.slow
def test_a_plan_belongs_to_its_load() -> None:
    for hook_m in (None, (0.0, 0.0, 0.19)):
        with pytest.raises(PlanRefused, match="another tool"):
            plan().require(certifier_for(CELL, "UR5e", MODELS["UR5e"], hook_m))
