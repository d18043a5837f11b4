"""Keys, and how a run goes on, on the fake cell: pause, stop, skip, redo, --resume, by hand."""

from collections.abc import Callable
from dataclasses import replace
from itertools import count
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ftdrive.cell.config import ToolConfig
from ftdrive.errors import ConfigError, Declined, NotAccepted, PlanRefused
from ftdrive.planning.search.nodes import constant_tour
from ftdrive.runs.run import Run
from ftdrive.session import drive
from ftdrive.session.events import (
    Estimated,
    Event,
    Key,
    Noted,
    PoseTaken,
    RunOpened,
)
from ftdrivers.interfaces import NOT_REPORTED, DeviceInfo, Fact
from tests.unit.ftdrive.fake_cell import Lab
from tests.unit.ftdrive.session.scenarios import Case, at, both, cases, once, press


def broken_off(lab: Lab, mode: str = "auto") -> Path:
    """Begin a run and stop it at its third move."""
    lab.arm.at_move[3] = lambda: lab.operator.keys.append(Key.STOP)
    with pytest.raises(Declined):
        lab.take_poses(mode=mode)
    lab.arm.moves.clear()
    return lab.run().folder


ON_ITS_WAY = {
    "pause holds the arm on its way and goes on": Case(
        {"move 3": press(Key.PAUSE)}, ("resume",), holds=((3, "paused by the operator"),)
    ),
    "a pause without an operator to end it is no fault": Case(
        {"move 3": press(Key.PAUSE)},
        ends="paused by the operator",
        error=Declined,
        holds=((3, "paused by the operator"),),
        taken=(1, 2),
    ),
    "stop ends the session without a question": Case(
        {"move 3": press(Key.STOP)}, ends="stopped by the operator", error=Declined, taken=(1, 2), moves=3
    ),
    "redo stops the arm and goes back from there": Case(
        {"move 4": press(Key.REDO)}, taken=(1, 2, 3, 3, 4, 5, 6, 7), asked={"Approach to pose 3": 1}
    ),
    "skip stops the arm and goes round that pose": Case(
        {"move 4": press(Key.SKIP)},
        taken=(1, 2, 3, 5, 6, 7),
        asked={"Approach to pose 5": 1},
        noted={"skipped: pose 4; the arm": 1},
    ),
    "another key stops the arm": Case(
        {"move 4": press(Key.OTHER)}, ("resume",), holds=((4, ""),), asked={"Approach to pose 4": 1}
    ),
}
WHILE_IT_STANDS = {
    "skip while a pose is measured skips that one": Case(
        {"measuring 4": press(Key.SKIP)}, taken=(1, 2, 3, 5, 6, 7), moves=7, asked={"Approach to pose 5": 0}
    ),
    "redo before any pose or twice does nothing more": Case(
        {"approach": once(press(Key.REDO)), "taken 2": once(press(Key.REDO, Key.REDO))},
        ("resume",),
        holds=((1, ""),),
        taken=(1, 2, 2, 3, 4, 5, 6, 7),
        noted={"no pose yet": 1, "pose 2 is already being taken": 1},
    ),
}


@cases(ON_ITS_WAY | WHILE_IT_STANDS)
def test_a_key(case: Case, lab: Lab) -> None:
    case.play(lab)


def test_an_approach_past_a_skipped_pose_is_shown_and_confirmed_by_the_operator(
    lab: Lab, monkeypatch: pytest.MonkeyPatch
) -> None:
    lab.trust()
    lab.operator.asked.clear()
    lab.operator.answers["Pose 3 of 7"] = ["s"] * 2
    lab.take_poses(mode="step")
    monkeypatch.setattr(drive, "_NEAR_RAD", np.pi)
    lab.take_poses(mode="step")
    ways = [question for question in lab.operator.asked if "Approach to pose 4" in question.text]
    assert ["skipped pose 3" in question.text for question in ways] == [False, True]
    assert [question.assumed for question in ways] == ["yes", None]


@pytest.mark.slow
def test_resume_takes_what_is_missing_and_redo_takes_one_again(lab: Lab) -> None:
    def drift(event: Event) -> None:
        if isinstance(event, PoseTaken):
            lab.sensor.push = lab.sensor.push + np.array([0.1, 0, 0, 0, 0, 0])

    lab.operator.on_event = drift
    run = Run(broken_off(lab))
    lab.operator.shown.clear()
    outcome = lab.calibrate(resume=run.folder)
    assert outcome is not None
    assert outcome.run.folder == run.folder
    assert [event.stop for event in lab.operator.of(PoseTaken)] == [3, 4, 5, 6, 7]
    estimate = lab.operator.of(Estimated)[-1].values
    assert estimate["force_bias_N"].tolist() == outcome.result.force_bias_N.tolist()  # their times are those on disk
    assert len((run.folder / "events.ndjson").read_text().splitlines()) > len(lab.operator.shown)
    first = run.calibration_path.read_bytes()
    lab.operator.shown.clear()
    assert lab.calibrate(resume=run.folder, redo=(3,)) is not None
    assert [event.stop for event in lab.operator.of(PoseTaken)] == [3]
    assert run.calibration_path.name == "calibration-2.json"
    assert (run.folder / "calibration.json").read_bytes() == first


def test_a_run_is_not_gone_on_with_another_tool(lab: Lab) -> None:
    folder = broken_off(lab)
    lab.cell = replace(lab.cell, tool=ToolConfig(cylinders_mm=((0.0, 210.0, 100.0),)))
    for redo in ((), (1,)):
        with pytest.raises(NotAccepted, match="another tool"):
            lab.take_poses(resume=folder, redo=redo)
    assert lab.arm.moves == []


def report(
    lab: Lab,
    model: str = "Robotiq FT 300",
    serial: str = "S1",
    facts: dict[str, Any] | None = None,
    arm: tuple[str, str] = ("UR5e", "A1"),
    **sensor: Any,
) -> None:
    """Let the devices report who they are."""
    known = {name: Fact(value, "device") for name, value in (BEGUN | (facts or {})).items()}
    lab.sensor.identify = lambda: DeviceInfo(model, serial, "1", known)  # type: ignore[method-assign]
    lab.arm.identify = lambda: DeviceInfo(*arm, "5.5")  # type: ignore[method-assign]
    lab.cell = replace(lab.cell, sensor=replace(lab.cell.sensor, **({"url": "ati-can://can0"} | sensor)))


@pytest.mark.slow
def test_a_run_that_another_process_resumes_is_refused_before_anything_moves(lab: Lab) -> None:
    folder = broken_off(lab)
    events = (folder / "events.ndjson").read_bytes()
    with Run(folder), pytest.raises(ConfigError, match=r"is in use by process \d+ on .* since "):
        lab.take_poses(resume=folder)
    assert lab.arm.moves == []
    assert (folder / "events.ndjson").read_bytes() == events
    assert lab.take_poses(resume=folder) is not None


NO_SERIAL = {"serial": NOT_REPORTED}
BEGUN: dict[str, Any] = {"counts_per_N": 100.0, "counts_per_Nm": 1000.0, "range": (300.0,) * 6}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("then", "now", "changed"),
    [
        (NO_SERIAL, NO_SERIAL | {"model": "UR wrist"}, "serial not reported, but UR wrist.*serial=… in its address"),
        ({}, {"model": "UR wrist"}, "serial S1, but UR wrist.*connect the sensor of the run"),
        (NO_SERIAL, NO_SERIAL, ""),
        ({}, {"url": "ati-can://can0?slot=2"}, "slot was 0"),
        ({}, {"url": "ati-can:///dev/ttyACM0?interface=slcan&slot=0x0&recover=1&bitrate=250000"}, ""),
        ({}, {"sign": -1}, r"sign .*1 .*-1"),
        ({}, {"facts": {"counts_per_N": 200.0}}, "counts_per_N was 100.0"),
        ({"arm": ("UR5e", NOT_REPORTED)}, {"arm": ("UR7e", NOT_REPORTED)}, "not reported, but UR7e"),
    ],
)
def test_a_run_goes_on_only_with_its_arm_and_sensor_and_where_the_numbers_mean_the_same(
    then: dict[str, Any], now: dict[str, Any], changed: str, lab: Lab
) -> None:
    report(lab, **then)
    folder = broken_off(lab)
    report(lab, **now)
    if not changed:
        assert lab.take_poses(resume=folder) is not None
        return
    with pytest.raises(PlanRefused, match=changed):
        lab.take_poses(resume=folder)
    assert lab.arm.moves == []


# ----------------------------------------------------------------------------------------------------------- by hand


@pytest.mark.parametrize("mode", ["manual", "listen"])
def test_a_run_by_hand_goes_on_by_hand(mode: str, lab: Lab) -> None:
    lab.operator.keys = [Key.STOP]
    with pytest.raises(Declined, match="ended before the first pose"):
        lab.take_poses(mode=mode)
    run = lab.run()
    assert not lab.arm.control
    for asked in ("auto", mode):
        lab.operator.shown.clear()
        lab.operator.keys = [Key.STOP]
        with pytest.raises(Declined, match="ended before the first pose"):
            lab.take_poses(resume=run.folder, mode=asked)
        assert len(lab.operator.of(RunOpened)) == 1
    assert not lab.arm.control
    assert (run.folder / "run.json").exists()
    with pytest.raises(ConfigError, match=f"with --{mode}, .* leave out --step"):
        lab.take_poses(resume=run.folder, mode="step")
    with pytest.raises(ConfigError, match="leave out --redo"):
        lab.take_poses(resume=run.folder, redo=(1,))


def test_options_that_cannot_be_used_are_reported_before_anything_opens(lab: Lab) -> None:
    lab.take_poses()
    opened, run = lab.arm.opened, lab.run()
    passive = Run.create(lab.folder, "passive", {"mode": "passive"}).folder
    damaged = lab.folder / "damaged.json"
    damaged.write_text(run.plan_path.read_text().replace('"clearance_m"', '"clearance"', 1))
    options: dict[str, dict[str, Any]] = {
        "name the run with --resume": {"redo": (3,)},
        "poses 1 to 7": {"resume": run.folder, "redo": (7, 8)},
        "start again with --passive": {"resume": passive},
        "along a plan": {"resume": run.folder, "mode": "listen"},
        "leave out --dry-run": {"mode": "manual", "dry_run": True},
        "leave out --fast": {"mode": "manual", "fast": True},
        "leave out --plan": {"mode": "manual", "plan": Path("plan.json")},
        "damaged.json": {"plan": damaged},
    }
    for words, given in options.items():
        with pytest.raises((ConfigError, PlanRefused), match=words):
            lab.take_poses(**given)
    assert lab.arm.opened == opened


@pytest.mark.slow
def test_a_pose_that_was_to_be_taken_again_and_is_skipped_stays(lab: Lab) -> None:
    at(lab, "taken 3", both(press(Key.REDO), lambda lab: at(lab, "measuring 3", press(Key.SKIP))))
    outcome = lab.calibrate()
    assert lab.taken() == [1, 2, 3, 4, 5, 6, 7]
    assert "pose 3 keeps" in lab.said()
    assert outcome is not None
    assert outcome.result.n_poses == 6
    assert [event.poses for event in lab.operator.of(Estimated)][:5] == [1, 2, 3, 3, 4]


def by_hand(lab: Lab, at_pose: Callable[[int], None] = lambda _: None) -> None:
    """Another client moves the arm on after each pose; there are no keys."""
    poses, clock_s, state = constant_tour(lab.arm.q), count(step=0.6), lab.arm.state

    def on_event(event: Event) -> None:
        if isinstance(event, PoseTaken):
            at_pose(event.stop)
            lab.arm.q = poses[event.stop]

    lab.arm.state = lambda: replace(state(), t_device_s=next(clock_s))  # type: ignore[method-assign]
    lab.operator.has_keys, lab.operator.on_event = False, on_event


def test_a_session_that_is_interrupted_says_how_to_solve_what_is_there(lab: Lab) -> None:
    def at_pose(stop: int) -> None:
        if stop == 3:
            raise KeyboardInterrupt

    by_hand(lab, at_pose)
    with pytest.raises(KeyboardInterrupt):
        lab.take_poses(mode="manual")
    words = lab.operator.of(Noted)[-1].words
    assert words.endswith(f"or solve them with\n{lab.run().solve_command}")
    assert lab.run().stops() == [1, 2, 3]
