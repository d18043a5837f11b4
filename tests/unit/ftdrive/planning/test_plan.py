"""The choice of a plan, its file, its speeds, and when it is refused."""

import json
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ftdrive.cell.config import CellConfig, RobotConfig, SensorConfig
from ftdrive.errors import ConfigError, PlanRefused
from ftdrive.planning.geometry.arm_model import ArmModel, Cylinder
from ftdrive.planning.geometry.certify import Certifier, Margins
from ftdrive.planning.geometry.scene import Box, Plane, Scene
from ftdrive.planning.motion import Speeds, tips
from ftdrive.planning.plan import Plan, digest, fingerprints
from ftdrive.planning.planner import TOOL_POSES, USUAL_POSTURE_RAD, guess_of, plan_for, plan_tour
from ftdrivers.sweep import Sweep
from ftdrivers.ur.kinematics import MODELS, Array, Kinematics
from tests.own_kinematics import drawn

TOOLS = (
    (Cylinder(0, 0.15, 0.1),),
    (Cylinder(0, 0.2, 0.1),),
    (Cylinder(0, 0.25, 0.1),),
    (Cylinder(0, 0.05, 0.08), Cylinder(0.05, 0.2, 0.15)),
)
CELL = CellConfig(RobotConfig("arm"), SensorConfig("fake://"))


def certifier_of(
    model: str = "UR5e",
    tool: tuple[Cylinder, ...] = TOOLS[1],
    scene: Scene | None = None,
    margins: Margins | None = None,
    kinematics: Kinematics | None = None,
) -> Certifier:
    return Certifier(ArmModel(model, tool, kinematics), scene or Scene(), margins)


def planned(certifier: Certifier, q: Array = USUAL_POSTURE_RAD, poses: int = 24, speeds: Speeds | None = None) -> Plan:
    return plan_tour(certifier, q, poses, speeds=speeds or Speeds(), guess=guess_of(certifier))


@cache
def usual(poses: int = 24) -> Plan:
    return planned(certifier_of(), poses=poses)


@pytest.mark.slow
def test_poses_of_a_new_tool_spread_gravity_like_a_tetrahedron(monkeypatch: pytest.MonkeyPatch) -> None:
    certifier = certifier_of()
    plan = plan_for(CELL, certifier, USUAL_POSTURE_RAD, TOOL_POSES)
    assert (plan.kind, len(plan.steps), plan.certified) == ("tool", TOOL_POSES, True)
    u = -np.array([step.R_base_flange for step in plan.steps])[:, 2]
    X = np.column_stack([u.ravel(), np.tile(np.eye(3), (len(u), 1))])  # force of a weight of 1, and its bias
    variance = np.trace(np.linalg.inv(X.T @ X))
    assert variance < 1.1 * (1 / 4 + 3 / 4)
    assert not any("times that of all 24" in sentence for sentence in plan.why)
    monkeypatch.setattr("ftdrive.planning.planner.chosen_tour", lambda *_: None)  # as without room
    with pytest.raises(PlanRefused, match="new tool"):
        plan_for(CELL, certifier, USUAL_POSTURE_RAD, TOOL_POSES)


def test_another_posture_is_proposed_where_the_arm_stands_badly() -> None:
    q = USUAL_POSTURE_RAD.copy()
    q[1:3] = np.radians([-30, 20])  # stretched over the table
    certifier = certifier_of()
    plan = planned(certifier, q)
    assert plan.kind == "posture"
    assert plan.certified
    assert "approach to them" in " ".join(plan.why)
    plan.require(certifier)


@pytest.mark.slow
def test_no_room_at_all_is_refused_in_a_sentence() -> None:
    ceiling = Plane((0.0, 0.0, -1.0), -0.3)
    certifier = certifier_of(scene=Scene(planes=(*Scene().planes, ceiling)))
    with pytest.raises(PlanRefused, match="proven clear"):
        planned(certifier, poses=6)


@pytest.mark.slow
def test_plan_is_deterministic_and_comes_back_from_its_file(tmp_path: Path) -> None:
    certifier = certifier_of(scene=Scene(boxes=(Box((0.6, 0.6, 0.0), (0.8, 0.8, 0.2)),)))
    plan = planned(certifier, poses=6)
    assert planned(certifier, poses=6).to_dict() == plan.to_dict()
    plan.save(tmp_path / "plan.json")
    again = Plan.load(tmp_path / "plan.json")
    assert again.to_dict() == plan.to_dict()
    assert again.steps == plan.steps
    again.require(certifier)


@pytest.mark.parametrize(
    ("other", "named"),
    [
        (certifier_of(model="UR10e"), "model"),
        (certifier_of(tool=TOOLS[0]), "tool"),
        (certifier_of(scene=Scene(lean_rad=np.pi)), "scene"),
        (certifier_of(margins=Margins(scene_m=0.01)), "scene"),
    ],
)
def test_plan_is_refused_for_anything_else_than_it_was_made_for(other: Certifier, named: str) -> None:
    with pytest.raises(PlanRefused, match=f"another {named}"):
        usual().require(other)


def old_file(plan: Plan) -> dict[str, Any]:
    """Contents of a plan of version 1, which has no kinematics."""
    document = {**plan.to_dict(), "format": "ftdrive.plan/1"}
    document["made_for"] = {
        "model": "2d83d53e55ee9aeaf10c8b48c2b4a7e6389d7d0beffb02b6d4b35ce4b280395a",  # of a UR5e, as then
        "tool": plan.made_for["tool"],
        "scene": plan.made_for["scene"],
    }
    document["description"] = {key: value for key, value in document["description"].items() if key != "kinematics"}
    del document["sha256"]
    return document | {"sha256": digest(document)}


def test_a_plan_of_version_1_is_read_and_proven_for_this_arm(tmp_path: Path) -> None:
    own, path = drawn("UR5e"), tmp_path / "plan.json"
    path.write_text(json.dumps(old_file(usual())))
    old, certifier = Plan.load(path), certifier_of(kinematics=own)
    assert old.kinematics is None
    old.require(certifier)
    plan = old.of_arm(certifier)
    plan.require(certifier)
    assert plan.of_arm(certifier) is plan
    assert plan.kinematics == own
    assert np.degrees(np.abs(plan.nodes_rad - old.nodes_rad).max()) < 3
    assert np.allclose(plan.R_base_flange, old.R_base_flange, atol=1e-9)
    assert np.array_equal(plan.nodes_rad[:, :3], old.nodes_rad[:, :3])
    again = tmp_path / "again.json"
    plan.save(again)
    assert Plan.load(again).of_arm(certifier).sha256 == plan.sha256


@pytest.mark.slow
def test_a_plan_that_only_another_arm_has_room_for_is_refused() -> None:
    """A wall as near as the margin allows to the arm that the plan was made for is too near for another one."""
    one, other = MODELS["UR5e"], drawn("UR5e")
    plan = planned(certifier_of(kinematics=one))
    tip = [tips(certifier_of(kinematics=k).arm, plan.nodes_rad)[:, 0] for k in (one, other)]
    nearer = (tip[1] - tip[0]).mean(axis=0)
    normal = tuple((-nearer / np.linalg.norm(nearer)).tolist())

    def behind_wall(kinematics: Kinematics, offset_m: float) -> Certifier:
        return certifier_of(scene=Scene(planes=(Plane(normal, offset_m),)), kinematics=kinematics)

    def nearest_wall_m(kinematics: Kinematics) -> float:
        clear, blocked = -2.0, 2.0
        for _ in range(14):
            middle = (clear + blocked) / 2
            is_clear = behind_wall(kinematics, middle).clear_around(plan.nodes_rad)
            clear, blocked = (middle, blocked) if is_clear else (clear, middle)
        return clear

    wall_m = (nearest_wall_m(one) + nearest_wall_m(other)) / 2
    plan = replace(plan, made_for=fingerprints(behind_wall(one, wall_m)))
    plan.require(behind_wall(one, wall_m))
    with pytest.raises(PlanRefused, match="made with other kinematics, and with this arm's own a move"):
        plan.of_arm(behind_wall(other, wall_m))


def test_plan_changed_by_hand_is_refused(tmp_path: Path) -> None:
    plan = usual()
    path = tmp_path / "plan.json"
    document = plan.to_dict()
    document["steps"][3]["q_rad"][4] += 0.1
    path.write_text(json.dumps(document))
    with pytest.raises(PlanRefused, match="changed after it was made"):
        Plan.load(path)


def test_a_forged_plan_that_collides_is_refused() -> None:
    plan = usual()
    q = [tuple(np.add(step.q_rad, [0, 1.5, 0, 0, 0, 0])) for step in plan.steps]
    forged = replace(plan, steps=tuple(replace(step, q_rad=one) for step, one in zip(plan.steps, q, strict=True)))
    with pytest.raises(PlanRefused, match="cannot be proven clear"):
        forged.require(certifier_of())


def test_posture_that_cannot_be_is_refused() -> None:
    with pytest.raises(ConfigError, match="degrees"):
        planned(certifier_of(), np.full(6, np.nan))


def test_a_sweep_of_another_arm_is_refused() -> None:
    plan = replace(
        usual(), sweep=Sweep(USUAL_POSTURE_RAD.tolist(), np.zeros((3, 2)), np.ones((3, 2)), np.zeros((3, 2)), 20, 3)
    )
    with pytest.raises(PlanRefused, match="other kinematics"):
        plan.of_arm(certifier_of(kinematics=drawn("UR5e")))
