"""The constant tour against the paper, and tours of chosen poses and of a free flange."""

import numpy as np
import pytest

from ftcalib.poses.information import T12, special
from ftdrive.errors import ConfigError, PlanRefused
from ftdrive.planning.approach import plan_approach
from ftdrive.planning.geometry.arm_model import ArmModel, Cylinder
from ftdrive.planning.geometry.certify import Certifier
from ftdrive.planning.geometry.scene import BASE_PLANE, Box, Plane, Scene
from ftdrive.planning.motion import Speeds
from ftdrive.planning.plan import Plan
from ftdrive.planning.planner import USUAL_POSTURE_RAD, _plan_box, _plan_cone, guess_of, plan_tour
from ftdrive.planning.search.nodes import NUMBERS, WINDOW_RAD

TOOL = (Cylinder(0, 0.2, 0.1),)
LUMP = (*TOOL, Cylinder(0.05, 0.1, 0.03, 0.06, 0.0))


def certifier_of(model: str = "UR5e", tool: tuple[Cylinder, ...] = TOOL, scene: Scene | None = None) -> Certifier:
    return Certifier(ArmModel(model, tool), scene or Scene())


def sampled_clear(certifier: Certifier, plan: Plan) -> bool:
    q = np.array([step.q_rad for step in plan.steps])
    share = np.linspace(0, 1, 91)[:, None, None]
    return bool(certifier.free(((1 - share) * q + share * np.roll(q, -1, axis=0)).reshape(-1, 6)).all())


@pytest.mark.slow
@pytest.mark.parametrize(
    ("model", "q6_deg", "poses"), [pytest.param("UR5e", -170, 24, marks=pytest.mark.slow), ("UR3e", 80, 12)]
)
def test_wrist_3_stays_within_200_degrees_of_where_it_stands(model: str, q6_deg: float, poses: int) -> None:
    certifier = certifier_of(model)
    stands = np.radians([45, -100, 60, -50, 90, q6_deg])
    plan = plan_tour(certifier, stands, poses, speeds=Speeds(), guess=guess_of(certifier))
    q = np.array([step.q_rad for step in plan.steps])
    assert np.degrees(np.abs(q[:, 5] - stands[5]).max()) <= 200 + 1e-6
    assert sampled_clear(certifier, plan)
    assert sorted(step.number for step in plan.steps) == sorted(NUMBERS if poses == 24 else T12)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("model", "tool", "half_angle_deg", "most_cond9", "least_gap"),
    # Conditions of the design table: 30 degrees 6.3, 60 degrees 2.8, 120 degrees 1.23.
    [
        ("UR3e", TOOL, 60, 3.0, 0.15),
        pytest.param("UR20", LUMP, 120, 1.3, 0.5, marks=pytest.mark.slow),
    ],
)
def test_cone_tour_stays_in_its_cone_clear_and_says_what_the_cone_allows(
    model: str, tool: tuple[Cylinder, ...], half_angle_deg: float, most_cond9: float, least_gap: float
) -> None:
    certifier = certifier_of(model, tool)
    plan = _plan_cone(certifier, half_angle_rad=np.radians(half_angle_deg), speeds=Speeds(), guess=guess_of(certifier))
    assert plan.kind == "cone"
    assert plan.why[1].startswith("Their predicted error is")  # not "of that": nothing was said before
    assert plan.certified
    assert plan.arm_rests
    assert sampled_clear(certifier, plan)
    tool_axis = np.array([step.R_base_flange for step in plan.steps])[:, :, 2]
    assert np.degrees(np.arccos(np.clip(-tool_axis[:, 2], -1, 1))).max() <= half_angle_deg + 1e-6
    assert sorted(step.number for step in plan.steps) == list(range(101, 125))
    assert plan.predicted["cond9"] <= most_cond9
    assert plan.predicted["second_basin_gap"] >= least_gap
    q = np.array([step.q_rad for step in plan.steps])
    assert (np.abs(q - q[0] * [1, 1, 1, 0, 0, 0] - USUAL_POSTURE_RAD * [0, 0, 0, 1, 1, 1]) <= WINDOW_RAD + 1e-6).all()
    assert "times that of all 24" in plan.why[-1]


@pytest.mark.parametrize("half_angle_deg", [30, *(pytest.param(deg, marks=pytest.mark.slow) for deg in (20, 60))])
def test_a_tour_in_a_cone_has_an_approach(half_angle_deg: float) -> None:
    """The same orientations with wrist 2 at 270 degrees have none: between, the tool folds against the forearm."""
    certifier = certifier_of()
    half_angle_rad = np.radians(half_angle_deg)
    plan = _plan_cone(certifier, half_angle_rad=half_angle_rad, speeds=Speeds(), guess=guess_of(certifier))
    assert plan_approach(certifier, USUAL_POSTURE_RAD, plan.nodes_rad[0], Speeds()).certified


@pytest.mark.slow
def test_the_cone_is_about_straight_down_however_the_arm_is_mounted() -> None:
    certifier = certifier_of(scene=Scene(lean_rad=np.pi / 2))
    plan = _plan_cone(certifier, poses=6, half_angle_rad=np.radians(40), speeds=Speeds(), guess=guess_of(certifier))
    tool_axis = np.array([step.R_base_flange for step in plan.steps])[:, :, 2]
    assert (tool_axis @ certifier.scene.down_base).min() >= np.cos(np.radians(40)) - 1e-9


@pytest.mark.parametrize(("half_angle_rad", "words"), [(0.0, "0 degrees"), (4.0, "180")])
def test_cone_that_cannot_be_is_refused(half_angle_rad: float, words: str) -> None:
    certifier = certifier_of()
    with pytest.raises(ConfigError, match=words):
        _plan_cone(certifier, half_angle_rad=half_angle_rad, speeds=Speeds(), guess=guess_of(certifier))


@pytest.mark.slow
def test_poses_that_leave_a_parameter_unobservable_are_refused() -> None:
    certifier = certifier_of()
    with pytest.raises(PlanRefused, match="informative enough"):
        _plan_cone(certifier, poses=6, half_angle_rad=1e-6, speeds=Speeds(), guess=guess_of(certifier))


@pytest.mark.slow
def test_free_box_tour_keeps_the_flange_in_its_box_and_the_moves_clear() -> None:
    certifier = certifier_of("UR3e")
    centre = np.array([0.283, 0.283, 0.3])
    guess = guess_of(certifier)
    plan = _plan_box(certifier, half_size_m=0.1, centre_m=centre, speeds=Speeds(), guess=guess)
    assert plan.kind == "box"
    assert plan.certified
    assert not plan.arm_rests
    assert sampled_clear(certifier, plan)
    at = certifier.arm.frames([step.q_rad for step in plan.steps])
    assert np.abs(at.flange_m - centre).max() <= 0.1 + 1e-9
    assert np.allclose(at.R_base_flange, special([step.number for step in plan.steps]), atol=1e-9)
    assert len({step.number for step in plan.steps}) == 24
    assert _plan_box(certifier, half_size_m=0.1, centre_m=centre, speeds=Speeds(), guess=guess) == plan
    # All of wrist and tool stays in the ball, also where the arm moves.
    q = np.array([step.q_rad for step in plan.steps])
    share = np.linspace(0, 1, 200)[:, None, None]
    at = certifier.arm.frames(((1 - share) * q + share * np.roll(q, -1, axis=0)).reshape(-1, 6))
    tip = at.flange_m + 0.2 * at.R_base_flange[:, :, 2]
    assert np.linalg.norm(tip - plan.ball_centre_m, axis=1).max() < plan.ball_m


def test_free_box_out_of_reach_is_refused() -> None:
    certifier = certifier_of("UR3e")
    with pytest.raises(PlanRefused, match="larger box"):
        _plan_box(certifier, centre_m=(0.9, 0.0, 0.3), speeds=Speeds(), guess=guess_of(certifier))


@pytest.mark.slow
def test_where_the_24_are_out_of_reach_the_most_informative_poses_are_taken_and_the_cost_is_said() -> None:
    # A ceiling just above the tool at rest: nothing points up.
    scene = Scene((BASE_PLANE, Plane((0.0, 0.0, -1.0), -0.42)), (Box((-0.9, -0.9, 0.0), (0.9, -0.5, 0.42)),))
    certifier = certifier_of("UR5e", (Cylinder(0, 0.3, 0.1),), scene)
    q = np.radians([0.0, -150.0, 130.0, -70.0, -90.0, 0.0])
    guess = guess_of(certifier)
    plan = plan_tour(certifier, q, speeds=Speeds(), guess=guess)
    assert plan.kind == "reachable"
    assert plan.certified
    assert sampled_clear(certifier, plan)
    words = " ".join(plan.why)
    assert "out of reach" in words
    assert "times that of all 24" in words
