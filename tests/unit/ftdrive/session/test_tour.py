"""The state machine on the fake cell: states, questions, modes, what is written down."""

import json
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from ftcalib.sampling import Sampling
from ftdrive.cell.config import WorkcellConfig
from ftdrive.errors import NotAccepted
from ftdrive.planning.approach import plan_approach
from ftdrive.planning.motion import Speeds, move_duration_s, tips
from ftdrive.planning.plan import Plan
from ftdrive.planning.planner import USUAL_POSTURE_RAD, certifier_for, guess_of, plan_tour
from ftdrive.session import preflight
from ftdrive.session.along_plan import has_completed, remember_completed
from ftdrive.session.drive import APPROACH_RAD_S, SLOW, Progress
from ftdrive.session.events import Asked, Checked, Key, Noted, Planned, PoseTaken
from ftdrive.session.guards import Limits, StallGuard
from ftdrive.session.tour import moves_s
from ftdrive.words.session import in_words
from ftdrivers.interfaces import NOT_REPORTED, DeviceInfo
from tests.unit.ftdrive.fake_cell import MODEL, Lab
from tests.unit.ftdrive.session.scenarios import Case, once, press


def test_questions_come_in_order_and_the_first_motion_wants_a_word(lab: Lab) -> None:
    lab.take_poses()
    texts = [question.text for question in lab.operator.asked]
    order = ["tool free", "within 0.3", "emergency stop within reach", "Type MOVE", "Begin"]
    assert [next(word for word in order if word in text) for text in texts] == order
    assert all(question.assumed is None for question in lab.operator.asked)
    assert len(lab.operator.of(Asked)) == 5


@pytest.mark.slow
def test_the_first_run_is_slow_whatever_was_asked_and_the_second_may_be_fast(lab: Lab) -> None:
    lab.take_poses(fast=True)
    assert max(speed for _, speed, _ in lab.arm.moves) <= np.radians(30) + 1e-9
    assert max(acceleration for *_, acceleration in lab.arm.moves) <= np.radians(40) + 1e-9
    lab.arm.moves.clear()
    lab.operator.asked.clear()
    lab.take_poses(fast=True)
    assert max(speed for _, speed, _ in lab.arm.moves) > np.radians(31)
    assert all(question.assumed is not None for question in lab.operator.asked)
    lab.arm.moves.clear()
    lab.take_poses()
    assert max(speed for _, speed, _ in lab.arm.moves) <= np.radians(30) + 1e-9


@pytest.mark.slow
def test_a_plan_for_any_speed_is_driven_at_no_more_than_is_allowed(lab: Lab) -> None:
    certifier = certifier_for(lab.cell, "UR5e")
    speeds = Speeds(float(np.radians(180)), float(np.radians(80)), None)
    path = lab.folder / "plan.json"
    plan_tour(certifier, USUAL_POSTURE_RAD, 6, speeds=speeds, guess=guess_of(certifier)).save(path)
    remember_completed("A1", Plan.load(path).sha256)
    lab.take_poses(plan=path, fast=True)
    fastest = 0.0
    for (start, *_), (goal, speed, _) in pairwise(lab.arm.moves):
        assert speed <= np.radians(60) + 1e-9
        way = start + np.linspace(0, 1, 200)[:, None] * (goal - start)
        path_m = np.linalg.norm(np.diff(tips(MODEL, way), axis=0), axis=2).max() * 199
        fastest = max(fastest, path_m * speed / np.abs(goal - start).max())
    assert fastest == pytest.approx(0.25, rel=0.01)
    lab.cell = replace(lab.cell, robot=replace(lab.cell.robot, speed_deg_s=20.0, acceleration_deg_s2=30.0))
    lab.arm.moves.clear()
    lab.take_poses(plan=path, fast=True)
    assert max(speed for _, speed, _ in lab.arm.moves[1:]) <= np.radians(20) + 1e-9
    assert max(acceleration for *_, acceleration in lab.arm.moves[1:]) <= np.radians(30) + 1e-9


@pytest.mark.slow
def test_how_long_to_average_is_chosen_from_the_noise_of_the_sensor(lab: Lab) -> None:
    lab.cell = replace(lab.cell, sampling=Sampling())
    lab.take_poses()
    assert {pose.average_s for pose in lab.operator.of(PoseTaken)} == {1.0}
    lab.operator.shown.clear()
    lab.sensor.rng = np.random.default_rng(0)
    lab.sensor.noise = np.repeat([0.8, 0.001], 3)  # of 100 samples a second: 2 s give 0.057 N
    lab.take_poses()
    (average_s,) = {pose.average_s for pose in lab.operator.of(PoseTaken)}
    assert 1.5 <= average_s <= 4.0
    assert f"average {average_s:.1f} s at each pose" in " ".join(note.words for note in lab.operator.of(Noted))


def test_the_rest_of_a_tour_counts_what_is_left_and_the_ways_past_what_is_not(lab: Lab) -> None:
    certifier = certifier_for(lab.cell, "UR5e")
    plan = plan_tour(certifier, USUAL_POSTURE_RAD, 24, speeds=Speeds(), guess=guess_of(certifier))
    third = np.array(plan.steps[2].q_rad)
    there = plan_approach(certifier, third, third, SLOW)
    one = plan.steps[2].duration_s
    assert moves_s(plan, [3, 4], there) == pytest.approx(moves_s(plan, [3], there) + one)
    past = np.abs(np.subtract(plan.steps[8].q_rad, plan.steps[2].q_rad)).max()
    expected_s = float(move_duration_s(past, APPROACH_RAD_S, SLOW.joint_rad_s2))
    assert moves_s(plan, [3, 9], there) - moves_s(plan, [3], there) == pytest.approx(expected_s)


def has_run(lab: Lab) -> bool:
    """Return whether the plan of the run counts as run to its end."""
    return has_completed("A1", str(Plan.load(lab.run().plan_path).to_dict()["sha256"]))


RUNS = {
    "without interruption": (Case({}, noted={"slow again": 0}), True),
    "a pose skipped where the arm stands": (
        Case({"measuring 4": press(Key.SKIP)}, taken=(1, 2, 3, 5, 6, 7), noted={"poses are missing": 1}),
        False,
    ),
    "a move broken off": (
        Case(
            {"move 4": press(Key.PAUSE)},
            ("back", "resume"),
            holds=((4, "paused"), (5, "back at pose 3")),
            noted={"moves from pose": 1},
        ),
        False,
    ),
    "poses taken again and a pause while one is measured": (
        Case(
            {"taken 1": once(press(Key.REDO)), "move 4": press(Key.REDO), "measuring 6": press(Key.PAUSE)},
            ("resume",),
            holds=((6, "paused"),),
            taken=(1, 1, 2, 3, 3, 4, 5, 6, 7),
        ),
        True,
    ),
}


@pytest.mark.slow
@pytest.mark.parametrize("what", RUNS)
def test_a_run_counts_as_complete_if_every_move_of_the_plan_was_driven(what: str, lab: Lab) -> None:
    case, complete = RUNS[what]
    case.play(lab)
    assert has_run(lab) == complete


@pytest.mark.slow
def test_an_arm_that_reports_no_serial_number_runs_slowly_each_time_and_the_reason_is_said(lab: Lab) -> None:
    lab.arm.identify = lambda: DeviceInfo("UR5e", NOT_REPORTED, "5.5")  # type: ignore[method-assign]
    for _ in range(2):
        lab.arm.moves.clear()
        lab.operator.shown.clear()
        lab.operator.asked.clear()
        lab.take_poses(fast=True, yes=True)
        assert max(speed for _, speed, _ in lab.arm.moves) <= np.radians(30) + 1e-9
        assert len([question for question in lab.operator.asked if "Type MOVE" in question.text]) == 1
        assert lab.said().count("reports no serial number") == 2
        assert "every run of a plan" in lab.said()
    remember_completed(NOT_REPORTED, "p")  # as an earlier version did
    assert not has_completed(NOT_REPORTED, "p")


def test_a_dry_run_shows_all_and_moves_nothing(lab: Lab) -> None:
    assert lab.calibrate(dry_run=True) is None
    assert lab.arm.moves == []
    assert lab.operator.asked == []
    assert not (lab.folder / "runs").exists()
    assert len(lab.operator.of(Checked)) == len(preflight.CHECKS)


@pytest.mark.slow
def test_the_plan_is_shown_before_the_checks_and_kept_where_asked(lab: Lab) -> None:
    lab.cell = replace(lab.cell, workcell=WorkcellConfig(measured=False))
    path = lab.folder / "plan.json"
    with pytest.raises(NotAccepted):
        lab.take_poses(dry_run=True, output=path)
    (shown,) = lab.operator.of(Planned)
    assert lab.operator.shown.index(shown) < lab.operator.shown.index(lab.operator.of(Checked)[0])
    words = in_words(shown)
    for figure in ("wrist 3", "Smallest clearance", "within 0.3", "Predicted", "1 move (wrist 1 ", "proven clear by"):
        assert figure in words
    assert "whole arm" not in words
    written = json.loads(json.dumps(shown.to_dict(), allow_nan=False))
    assert written["event"] == "planned"
    assert written["plan"] == json.loads(path.read_text())
    np.testing.assert_allclose(written["way_rad"], [lab.arm.q, written["plan"]["steps"][0]["q_rad"]])
    assert not Plan.load(path).measured
    lab.cell = replace(lab.cell, workcell=WorkcellConfig(measured=True))
    with pytest.raises(FileExistsError):
        lab.take_poses(dry_run=True, output=path)
    assert lab.take_poses(dry_run=True, output=lab.folder / "measured.json") is None
    assert Plan.load(lab.folder / "measured.json").measured


@pytest.mark.slow
@pytest.mark.parametrize(("away_deg", "assumed"), [((0.0, 9.0), True), ((9.0, 0.0), False)])
def test_a_way_of_the_whole_arm_is_confirmed_by_a_person_though_the_plan_is_known(
    away_deg: tuple[float, float], assumed: bool, lab: Lab
) -> None:
    plan = lab.trust()
    elbow, wrist = away_deg
    lab.arm.q = lab.arm.q + np.radians([0, 0, elbow, 0, 0, wrist])
    lab.take_poses(plan=plan, fast=True)
    texts = {question.text: question.assumed is not None for question in lab.operator.asked}
    assert [texts[text] for text in texts if text.startswith("Is the")] == [assumed] * 3
    (way,) = [text for text in texts if "Type MOVE" in text]
    assert texts[way] == assumed
    assert ("elbow 9°" in way and "whole arm" in way) != assumed


def test_step_mode_waits_for_enter_before_each_move(lab: Lab) -> None:
    lab.operator.answers["Pose 3 of 7"] = ["s"]
    lab.operator.answers["Pose 5 of 7"] = ["r", ""]
    lab.take_poses(mode="step")
    third = np.array(Plan.load(lab.run().plan_path).steps[2].q_rad)
    assert min(np.abs(goal - third).max() for goal, *_ in lab.arm.moves) > np.radians(5)  # never sent there
    (way,) = [question for question in lab.operator.asked if "Approach to pose 4" in question.text]
    assert way.text.startswith("Approach to")  # certified again, shown, and confirmed
    assert lab.arm.moves[2][1] <= np.radians(15) + 1e-9
    asked = [question.text.split(",")[0] for question in lab.operator.asked if question.text.startswith("Pose")]
    assert asked == [f"Pose {stop} of 7" for stop in (1, 2, 3, 4, 5, 4, 5, 6, 7)]
    assert lab.stops() == [1, 2, 4, 5, 6, 7]
    assert (lab.run().folder / "poses" / "04-2.npz").exists()


def begun() -> Progress:
    return Progress(6, todo=[1, 2, 3, 4, 5, 6, 7])


def test_the_arm_stands_until_it_leaves_and_may_return_to_where_it_came_from() -> None:
    now = begun()
    now.arrive(0)
    del now.todo[0]
    now.under_way = 2
    assert (now.at, now.moving, now.came_from) == (0, False, None)
    now.standing = False
    assert (now.at, now.moving, now.came_from) == (None, True, 0)
    now.skip()
    assert now.came_from == 0
    now.skipped.add(0)
    assert now.came_from is None
    now.skipped.clear()
    now.lose_place()
    assert now.came_from is None


def test_the_plan_of_a_dry_run_is_looked_at_until_enter(lab: Lab) -> None:
    assert lab.take_poses(dry_run=True, watch=lambda *_: StallGuard(Limits())) is None
    assert [question.answers for question in lab.operator.asked] == [("",)]
    assert lab.arm.moves == []
