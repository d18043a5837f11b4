"""A sweep on the fake cell: what is asked, its speed, the hazards of the tour, and what is kept."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from ftcalib.model import Array
from ftdrive.cell.config import CellConfig
from ftdrive.errors import ConfigError, Declined, NotAccepted, SupervisorGone
from ftdrive.planning import sweep_planner
from ftdrive.planning.plan import Plan
from ftdrive.planning.planner import certifier_for, sweep_for
from ftdrive.runs.motion import MotionRecording
from ftdrive.session import sweep
from ftdrive.session.events import GuardTripped, Key, MotionRecorded, State
from ftdrive.session.guards import ExpectedMotion, Seen
from ftdrive.session.sweep import on_script_path
from ftdrivers.clock import REAL
from ftdrivers.interfaces import ArmState
from tests.unit.ftdrive.fake_cell import STATUS, Lab
from tests.unit.ftdrive.session.scenarios import Case, at, cases, press, status
from tests.unit.ftdrive.session.test_stops import FAULTS

LATE_S = 4.5
"""Then the tool is known."""


@cache
def planned(q_rad: tuple[float, ...], cell: CellConfig, seconds: float) -> Plan:
    return sweep_for(cell, certifier_for(cell, "UR5e"), np.array(q_rad), seconds)


@pytest.fixture(autouse=True)
def _short_search(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sweep_planner, "RANDOM", 2)
    monkeypatch.setattr(sweep_planner, "CHANGED", 0)

    def planned_once(cell: CellConfig, _: object, q_rad: Array, seconds: float) -> Plan:
        return planned(tuple(q_rad.tolist()), replace(cell, clock=REAL), seconds)

    monkeypatch.setattr(sweep, "sweep_for", planned_once)


@pytest.mark.slow
def test_the_first_run_is_slow_and_the_second_is_not(lab: Lab) -> None:
    for _ in range(2):
        lab.sweep()
    first, second = lab.arm.sweeps
    assert first.duration_s == pytest.approx(2 * second.duration_s)
    assert second.duration_s == 10.0
    words = [question for question in lab.operator.asked if question.answers == ("MOVE",)]
    assert [question.assumed for question in words] == [None, "MOVE"]
    assert [question.text[:6] for question in lab.operator.asked].count("Is the") == 6


@pytest.mark.slow
def test_everything_is_kept_in_one_file_and_a_sweep_is_not_continued(lab: Lab) -> None:
    run = lab.sweep(real=False)
    assert run.in_motion
    assert run.stops() == []
    (event,) = lab.operator.of(MotionRecorded)
    recording = MotionRecording.load(run.motion_path)
    assert (event.samples, event.states) == (len(recording.samples), len(recording.states))
    assert recording.nominal_rate_Hz != recording.nominal_rate_Hz
    assert State.SWEEP in lab.operator.states()
    with pytest.raises(ConfigError, match="start again with --sweep"):
        lab.take_poses(resume=run.folder)
    with pytest.raises(ConfigError, match="is the plan of a sweep: leave out --plan"):
        lab.take_poses(plan=run.plan_path)
    assert len(lab.arm.sweeps) == 1


@pytest.mark.slow
@pytest.mark.parametrize("fault", ["a joint pushed off", "an emergency stop", "a silent sensor", "a silent controller"])
def test_a_fault_in_a_sweep_stops_the_arm_and_resume_starts_again(fault: str, lab: Lab) -> None:
    hazard, inject, repair = FAULTS[fault]

    def in_hold(lab: Lab) -> None:
        assert lab.arm.halted.is_set()
        assert not lab.run().in_motion
        repair(lab)

    at(lab, f"sweep {LATE_S}", inject)
    at(lab, "hold", in_hold)
    lab.operator.answers["resume:"] = ["resume"]
    assert lab.sweep(real=False).in_motion
    assert [event.hazard for event in lab.operator.of(GuardTripped)] == [hazard]
    assert len(lab.arm.sweeps) == 2
    assert lab.holds() == [("resume", "quit")]


@pytest.mark.slow
def test_a_sweep_starts_at_the_speed_of_the_slider(lab: Lab) -> None:
    lab.arm.set_status(speed_slider=0.8)
    lab.sweep(real=False)
    assert lab.arm.sweeps[0].duration_s == pytest.approx(10.0 / 0.8)
    lab.arm.set_status(speed_slider=0.4)
    with pytest.raises(NotAccepted, match="40 %"):
        lab.sweep(real=False)


WRONG = {
    "a push that the weight of a heavy tool would hide is seen once the tool is known": Case(
        {f"sweep {LATE_S}": lambda lab: setattr(lab.sensor, "push", np.array([0, 22.0, 0, 0, 0, 0]))},
        ends="from the weight of the free tool",
        rows=(14,),
        holds=((0, "from the weight of the free tool"),),
    ),
    "a joint off the curve stops the arm": Case(
        {"sweep 1.0": lambda lab: setattr(lab.arm, "push_rad", np.radians([0, 0, 0, 0, 3.0, 0]))},
        ends="off its planned position",
        rows=(2,),
        holds=((0, "off its planned position"),),
    ),
    "a slider that moves stops the arm": Case(
        {"sweep 1.0": status(speed_slider=0.7)},
        ends="speed slider was moved from 100 to 70 %",
        rows=(22,),
        holds=((0, "speed slider"),),
    ),
    "a supervisor that leaves stops the arm": Case(
        {"sweep 1.0": lambda lab: setattr(lab.operator, "gone", "the terminal was closed")},
        ends="the terminal was closed",
        error=SupervisorGone,
        rows=(27,),
    ),
    "q ends a sweep": Case(
        {"sweep 1.0": press(Key.STOP)},
        ends="stopped by the operator",
        error=Declined,
        noted={"sweep not completed": 1},
    ),
    "s stops a sweep, which has no pose to skip, and it starts again": Case(
        {"sweep 1.0": press(Key.SKIP)}, ("resume",), holds=((0, ""),)
    ),
}


@pytest.mark.slow
@cases({name: replace(case, mode="sweep", taken=()) for name, case in WRONG.items()})
def test_what_ends_a_sweep(case: Case, lab: Lab) -> None:
    case.play(lab)
    assert lab.arm.halted.is_set() == bool(case.ends)
    assert lab.run().in_motion != bool(case.ends)


def test_the_other_control_path_is_refused_at_once(lab: Lab) -> None:
    cell = replace(lab.cell, robot=replace(lab.cell.robot, control="ur-rtde"))
    with pytest.raises(ConfigError, match="--control script"):
        on_script_path(cell)
    assert on_script_path(lab.cell).robot.control == "script"


def seen(t_s: float, R: Array, wrench: Array, sample: int, curve: Array | None) -> Seen:
    motion = ExpectedMotion(np.zeros(6), np.zeros(6), True, curve)
    state = ArmState(0, 0.0, np.zeros(6), np.zeros(6), R, np.zeros(3))
    return Seen(t_s, 0.01, motion, state, STATUS, wrench, sample, 0.0)


@pytest.mark.slow
def test_the_plan_of_a_sweep_is_not_driven_as_a_tour(lab: Lab) -> None:
    run = lab.sweep(real=False)
    sweeps = len(lab.arm.sweeps)
    with pytest.raises(ConfigError, match="is the plan of a sweep: leave out --plan"):
        lab.take_poses(plan=run.plan_path)
    assert len(lab.arm.sweeps) == sweeps
