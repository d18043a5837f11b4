"""What stops the arm on the fake cell: each fault injected on the way, the hold, and how it goes on."""

from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from ftcalib.routine import PoseRecord
from ftdrive.errors import Declined
from ftdrive.planning.approach import Approach, plan_approach
from ftdrive.planning.geometry.certify import Certifier
from ftdrive.planning.motion import Speeds
from ftdrive.planning.plan import Plan
from ftdrive.runs.run import Run
from ftdrive.session import drive
from ftdrive.session.events import Checked, Event, GuardTripped, Key, Noted, PoseTaken, State, StateChanged
from ftdrive.session.preflight import Before
from ftdrivers.errors import DeviceFault, DeviceTimeout, StreamBroken
from ftdrivers.interfaces import FtSamples
from tests.unit.ftdrive.fake_cell import Lab

Array = NDArray[np.float64]

FAULTS: dict[str, tuple[int, Callable[[Lab], None], Callable[[Lab], None], type[Exception]]] = {
    "a joint pushed off": (
        2,
        lambda lab: setattr(lab.arm, "push_rad", np.radians([0, 1.0, 0, 0, 0, 0])),
        lambda lab: setattr(lab.arm, "push_rad", np.zeros(6)),
        DeviceFault,
    ),
    "the TCP changed": (
        8,
        lambda lab: lab.arm.set_status(tcp_offset=(0.0, 0.0, 0.0, 0.3, 0.0, 0.0)),
        lambda lab: lab.arm.set_status(),
        DeviceFault,
    ),
    "a protective stop": (
        10,
        lambda lab: lab.arm.set_status(fault=DeviceFault("protective stop", "…"), safety_mode="protective stop"),
        lambda lab: lab.arm.set_status(),
        DeviceFault,
    ),
    "an emergency stop": (
        11,
        lambda lab: lab.arm.set_status(fault=DeviceFault("emergency stop", "…"), safety_mode="robot emergency stop"),
        lambda lab: lab.arm.set_status(),
        DeviceFault,
    ),
    "an emergency stop between two looks": (
        11,
        lambda lab: lab.arm.lose_power(),
        lambda lab: lab.arm.power_up(),
        DeviceFault,
    ),
    "reduced mode": (
        12,
        lambda lab: lab.arm.set_status(safety_mode="reduced"),
        lambda lab: lab.arm.set_status(),
        DeviceFault,
    ),
    "a push before the tool is known": (
        14,
        lambda lab: setattr(lab.sensor, "push", np.array([150.0, 0, 0, 0, 0, 0])),
        lambda lab: setattr(lab.sensor, "push", np.zeros(6)),
        DeviceFault,
    ),
    "a silent sensor": (
        15,
        lambda lab: setattr(lab.sensor, "failure", StreamBroken("gone")),
        lambda lab: setattr(lab.sensor, "failure", None),
        StreamBroken,
    ),
    "a stuck sensor": (
        15,
        lambda lab: setattr(lab.sensor, "stuck", True),
        lambda lab: setattr(lab.sensor, "stuck", False),
        DeviceFault,
    ),
    "a silent controller": (
        16,
        lambda lab: setattr(lab.arm, "gone", DeviceTimeout("silent")),
        lambda lab: setattr(lab.arm, "gone", None),
        DeviceTimeout,
    ),
    "another client's program": (
        21,
        lambda lab: lab.arm.set_status(program="stopped"),
        lambda lab: lab.arm.set_status(),
        DeviceFault,
    ),
}


@pytest.mark.parametrize(
    "fault",
    [
        "a protective stop",
        "an emergency stop",
        "a silent sensor",
        "a silent controller",
        *(
            pytest.param(fault, marks=pytest.mark.slow)
            for fault in ("a joint pushed off", "reduced mode", "a stuck sensor", "another client's program")
        ),
    ],
)
def test_a_fault_on_the_way_stops_the_arm_and_resume_goes_on(fault: str, lab: Lab) -> None:
    hazard, inject, repair, _ = FAULTS[fault]
    lab.arm.at_move[4] = lambda: inject(lab)

    def on_event(event: Event) -> None:
        if isinstance(event, StateChanged) and event.state is State.HOLD:
            assert lab.arm.halted.is_set()
            assert lab.stops() == [1, 2, 3]
            repair(lab)

    lab.operator.on_event = on_event
    lab.operator.answers["resume:"] = ["resume"]
    outcome = lab.calibrate()
    assert outcome is not None
    (trip,) = lab.operator.of(GuardTripped)
    assert trip.hazard == hazard
    assert lab.arm.opened == 3  # to look, to take control, and again
    assert lab.stops() == [1, 2, 3, 4, 5, 6, 7]
    states = lab.operator.states()
    stop = states.index(State.STOP)
    assert states[stop : stop + 3] == [State.STOP, State.HOLD, State.APPROACH]
    assert outcome.result.mass_kg == pytest.approx(1.2, abs=0.01)
    # The way on was asked for, planned from where the arm stood, and slow.
    assert any("Approach to pose 4" in question.text for question in lab.operator.asked)
    assert lab.arm.moves[4][1] <= np.radians(15) + 1e-9


def test_a_protective_stop_that_the_driver_reports_names_its_usual_causes_too(lab: Lab) -> None:
    def stop() -> None:
        lab.arm.set_status(fault=DeviceFault("protective stop", "…"), safety_mode="protective stop")
        raise DeviceFault("the arm stopped: protective stop")

    lab.arm.at_move[4] = stop
    with pytest.raises(DeviceFault, match="wrong payload"):
        lab.take_poses()
    assert lab.operator.of(GuardTripped)[0].hazard == 10


def test_a_controller_that_does_not_hear_the_stop_may_end_its_move(lab: Lab) -> None:
    lab.arm.at_move[4] = lambda: setattr(lab.arm, "gone", DeviceTimeout("silent"))
    with pytest.raises(DeviceTimeout):
        lab.take_poses()
    holds = [event for event in lab.operator.of(StateChanged) if event.state is State.HOLD]
    assert "completes the current move" in holds[0].words


@pytest.mark.parametrize("fault", FAULTS)
def test_without_an_operator_the_reason_is_raised_and_the_poses_are_kept(fault: str, lab: Lab) -> None:
    hazard, inject, _, error = FAULTS[fault]
    lab.arm.at_move[4] = lambda: inject(lab)
    with pytest.raises(error):
        lab.take_poses()
    assert lab.stops() == [1, 2, 3]
    assert lab.operator.of(GuardTripped)[0].hazard == hazard
    assert f"--resume {lab.run().folder}" in lab.operator.of(Noted)[-1].words


def test_a_push_once_the_tool_is_known(lab: Lab) -> None:
    def push() -> None:
        lab.sensor.push = np.array([0, 0, 0, 0, 2.0, 0])

    lab.arm.at_move[7] = push
    lab.operator.answers["resume:"] = ["quit"]
    with pytest.raises(DeviceFault, match="unexpected contact"):
        lab.take_poses()
    assert lab.operator.of(GuardTripped)[0].hazard == 14


def test_resume_before_the_cause_is_fixed_is_refused(lab: Lab) -> None:
    lab.arm.at_move[3] = lambda: lab.arm.set_status(
        fault=DeviceFault("protective stop", "…"), safety_mode="protective stop"
    )
    lab.operator.answers["resume:"] = ["resume", "resume", "quit"]
    with pytest.raises(DeviceFault, match="protective stop"):
        lab.take_poses()
    assert len([event for event in lab.operator.of(Noted) if event.words.startswith("not yet")]) == 2
    assert len(lab.arm.moves) == 3


def goals(lab: Lab) -> list[int]:
    """Poses that the arm was sent to, by their place in the plan."""
    nodes = np.array([step.q_rad for step in Plan.load(lab.run().plan_path).steps])
    return [int(np.abs(nodes - goal).max(axis=1).argmin()) + 1 for goal, *_ in lab.arm.moves]


def test_after_a_contact_the_arm_goes_back_or_round_it_where_a_person_says_so(lab: Lab) -> None:
    lab.push_on_the_way(4, 5, 7)  # to pose 4, back to pose 3, to pose 4 again
    lab.operator.answers["resume:"] = ["back", "back", "resume", "skip"]
    lab.take_poses()
    anywhere = ("resume", "skip", "back", "quit")
    assert lab.holds() == [anywhere, anywhere, ("resume", "skip", "quit"), anywhere]
    assert [event.hazard for event in lab.operator.of(GuardTripped)] == [14, 14, 14]
    assert goals(lab) == [1, 2, 3, 4, 3, 3, 4, 5, 6, 1]
    assert max(speed for _, speed, _ in lab.arm.moves[4:6]) <= np.radians(10) + 1e-9
    ways = [question.text for question in lab.operator.asked if question.text.startswith("Approach ")]
    assert [text.split(",")[0].removeprefix("Approach ") for text in ways] == [
        "to pose 1",
        "back to pose 3",
        "back to pose 3",
        "to pose 4",
        "to pose 5",
    ]
    reasons = [event.words for event in lab.operator.of(StateChanged) if event.state is State.HOLD]
    assert reasons[2].startswith("back at pose 3")
    assert lab.taken() == [1, 2, 3, 5, 6, 7]
    assert "skipped: pose 4; the arm" in lab.said()


def test_the_way_back_is_confirmed_by_a_person_though_the_plan_is_known(lab: Lab) -> None:
    lab.take_poses()  # trusted from here on
    for answer, words in (("resume", "Approach to pose 4"), ("back", "Approach back to pose 3")):
        lab.operator.asked.clear()
        lab.arm.moves.clear()
        lab.push_on_the_way(3)
        lab.operator.answers["resume:"] = [answer, "quit"]
        lab.operator.answers["Approach back"] = ["no"]
        with suppress(Declined):
            lab.take_poses()
        (way,) = [question for question in lab.operator.asked if words in question.text]
        assert (way.assumed is None) == (answer == "back")
    assert len(lab.arm.moves) == 3


def test_back_is_offered_only_on_the_way_from_a_pose_that_was_not_skipped(lab: Lab) -> None:
    lab.press((Key.PAUSE, StateChanged, 1), (Key.PAUSE, PoseTaken, 2))  # on the first approach; where the arm stands
    lab.operator.answers["resume:"] = ["resume"] * 3

    def skip_then_pause() -> None:
        if len(lab.arm.moves) == 5 and not done:
            done.append(True)
            lab.operator.keys.append(Key.SKIP)
            lab.arm.at_move[6] = lambda: lab.operator.keys.append(Key.PAUSE)

    done: list[bool] = []
    lab.sensor.collecting = skip_then_pause
    lab.take_poses()
    assert lab.holds() == [("resume", "skip", "quit")] * 3


def test_a_pause_without_an_operator_to_end_it_is_no_fault(lab: Lab) -> None:
    lab.arm.at_move[3] = lambda: lab.operator.keys.append(Key.PAUSE)
    with pytest.raises(Declined, match="paused by the operator"):
        lab.take_poses()


def test_resume_with_something_still_pushing_is_not_believed_though_the_tool_is_unknown(lab: Lab) -> None:
    lab.arm.at_move[3] = lambda: setattr(lab.sensor, "push", np.array([150.0, 0, 0, 0, 0, 0]))
    lab.operator.answers["resume:"] = ["resume", "quit"]
    with pytest.raises(DeviceFault, match="unexpected contact"):
        lab.take_poses()
    (refused,) = [event for event in lab.operator.of(Noted) if event.words.startswith("not yet")]
    assert "unexpected contact" in refused.words
    assert len(lab.arm.moves) == 3


def test_a_sensor_that_was_switched_off_may_have_another_zero(lab: Lab) -> None:
    def fail() -> None:
        lab.sensor.failure = StreamBroken("gone")

    def on_event(event: Event) -> None:
        if isinstance(event, StateChanged) and event.state is State.HOLD:
            lab.sensor.heals = True
            lab.sensor.push = np.array([150.0, 0, 0, 0, 0, 0])

    lab.arm.at_move[2] = fail
    lab.operator.on_event = on_event
    lab.operator.answers["resume:"] = ["resume"]
    lab.take_poses()
    assert not [event for event in lab.operator.of(Noted) if event.words.startswith("not yet")]


def test_a_sensor_that_comes_back_while_the_arm_stands_needs_no_operator(lab: Lab) -> None:
    def fail() -> None:
        if len(lab.arm.moves) == 3 and not lab.sensor.heals:
            lab.sensor.heals = True
            lab.sensor.failure = StreamBroken("a cable came off")
            raise lab.sensor.failure

    lab.sensor.collecting = fail
    assert lab.take_poses() is not None
    assert lab.stops() == [1, 2, 3, 4, 5, 6, 7]
    assert State.HOLD not in lab.operator.states()
    assert any("restarts" in event.words for event in lab.operator.of(Noted))


def test_a_sensor_that_fails_twice_at_a_pose_needs_a_person(lab: Lab) -> None:
    samplings: list[int] = []

    def on_event(event: Event) -> None:
        if isinstance(event, StateChanged) and (event.state, event.stop) == (State.SAMPLE, 3):
            assert len(samplings) < 2
            samplings.append(len(lab.arm.moves))
            lab.sensor.failure = StreamBroken("a cable came off")

    lab.sensor.heals = True
    lab.operator.on_event = on_event
    with pytest.raises(StreamBroken, match="a cable came off"):
        lab.take_poses()
    assert samplings == [3, 3]
    assert len([event for event in lab.operator.of(Noted) if "restarts" in event.words]) == 1
    assert lab.stops() == [1, 2]


def test_a_full_disk_holds_before_the_arm_moves_on(lab: Lab, monkeypatch: pytest.MonkeyPatch) -> None:
    commit, failed = Run.commit, list[int]()

    def full(run: Run, record: PoseRecord) -> PoseRecord:
        if record.stop == 3 and not failed:
            failed.append(len(lab.arm.moves))
            raise OSError(28, "No space left on device")
        return commit(run, record)

    monkeypatch.setattr(Run, "commit", full)
    lab.operator.answers["resume:"] = ["resume"]
    lab.take_poses()
    assert lab.operator.of(GuardTripped)[0].hazard == 26
    assert failed == [3]
    assert lab.stops() == [1, 2, 3, 4, 5, 6, 7]


def test_an_arm_that_was_moved_between_two_poses_is_noticed(lab: Lab) -> None:
    def on_event(event: Event) -> None:
        if isinstance(event, PoseTaken) and event.stop == 2:
            lab.arm.q = lab.arm.q + np.radians([0, 0, 0, 0, 0, 2.0])

    lab.operator.on_event = on_event
    with pytest.raises(DeviceFault, match=r"joint 6 is 2\.0° off"):
        lab.take_poses()
    assert lab.operator.of(GuardTripped)[0].hazard == 21


@pytest.mark.parametrize(
    ("way", "moves", "answers"), [("to pose 1", 0, []), ("to pose 4", 4, ["resume"]), ("back", 4, ["back"])]
)
def test_an_arm_that_was_moved_while_a_way_waits_for_its_word_does_not_begin_it(
    way: str, moves: int, answers: list[str], lab: Lab
) -> None:
    def move() -> None:
        lab.arm.q = lab.arm.q + np.radians([25.0, 0, 0, 0, 0, 0])

    lab.push_on_the_way(4)
    lab.operator.answers["resume:"] = answers
    lab.operator.at_question.append((f"Approach {way}", move))
    with pytest.raises(DeviceFault, match=r"joint 1 is 25\.0° off"):
        lab.take_poses()
    assert lab.operator.of(GuardTripped)[-1].hazard == 21
    assert len(lab.arm.moves) == moves


def test_each_part_of_a_way_begins_where_the_one_before_should_have_ended(
    lab: Lab, monkeypatch: pytest.MonkeyPatch
) -> None:
    move_to = lab.arm.move_to

    def in_two(certifier: Certifier, q_now: Array, q_first: Array, speeds: Speeds) -> Approach:
        whole = plan_approach(certifier, q_now, q_first, speeds)
        way_rad = np.linspace(whole.way_rad[0], whole.way_rad[-1], 3)
        return replace(whole, way_rad=way_rad, speed_rad_s=np.repeat(whole.speed_rad_s, 2))

    def past_it(*args: Any, **kwargs: Any) -> None:
        move_to(*args, **kwargs)
        lab.arm.q = lab.arm.q + np.radians([0, 0, 0, 0, 1.0, 0])

    monkeypatch.setattr(drive, "plan_approach", in_two)
    monkeypatch.setattr(lab.arm, "move_to", past_it)
    with pytest.raises(DeviceFault, match=r"joint 5 is 1\.0° off"):
        lab.take_poses()
    assert len(lab.arm.moves) == 1


def test_the_controller_is_asked_for_the_way_on_itself(lab: Lab) -> None:
    def on_event(event: Event) -> None:
        if isinstance(event, StateChanged) and event.state is State.HOLD:
            lab.arm.forbidden = None if lab.arm.forbidden is not None else lab.arm.q.copy()  # no pose of the plan

    lab.arm.at_move[4] = lambda: lab.operator.keys.append(Key.PAUSE)
    lab.operator.on_event = on_event
    moves: list[int] = []
    lab.operator.at_question.append(("resume:", lambda: moves.append(len(lab.arm.moves))))
    lab.operator.answers["resume:"] = ["resume", "resume"]
    assert lab.take_poses() is not None
    assert moves == [4, 4]
    words = [event.words for event in lab.operator.of(StateChanged) if event.state is State.HOLD]
    assert words[1].startswith("the controller's safety limits forbid")


def test_saturation_that_only_the_samples_of_a_pose_show_discards_it(lab: Lab, monkeypatch: pytest.MonkeyPatch) -> None:
    collect = lab.sensor.collect

    def one_high(duration_s: float) -> FtSamples:
        samples = collect(duration_s)
        if len(lab.arm.moves) == 4:
            samples.wrench[7, 5] = -3.8  # the newest ones, which the guards see, are as ever
        return samples

    monkeypatch.setattr(Before, "sensor_range", np.array([40.0, 40, 40, 4, 4, 4]))
    monkeypatch.setattr(lab.sensor, "collect", one_high)
    with pytest.raises(DeviceFault, match="95 % of its range"):
        lab.take_poses()
    assert lab.operator.of(GuardTripped)[0].hazard == 13
    assert lab.stops() == [1, 2, 3]


def test_saturated_samples_discard_the_pose(lab: Lab, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Before, "sensor_range", np.array([40.0, 40, 40, 4, 4, 4]))
    lab.arm.at_move[4] = lambda: setattr(lab.sensor, "push", np.array([0, 0, 0, 0, 0, 3.8]))
    with pytest.raises(DeviceFault, match="of its range"):
        lab.take_poses()
    assert lab.operator.of(GuardTripped)[0].hazard == 13
    assert lab.stops() == [1, 2, 3]


QUESTIONS = ("Is the tool free", "Is the space within", "Is the emergency stop in reach")


def hold_and_resume(lab: Lab, fault: Callable[[], None], repair: Callable[[], None]) -> None:
    """Let something stop the arm in its fourth move, and be gone when the operator is asked."""

    def on_event(event: Event) -> None:
        if isinstance(event, StateChanged) and event.state is State.HOLD:
            lab.operator.asked.clear()
            lab.operator.shown.clear()
            lab.arm.asked_limits = 0
            repair()

    lab.arm.at_move[4] = fault
    lab.operator.on_event = on_event
    lab.operator.answers.setdefault("resume:", ["resume"])
    lab.take_poses()


@pytest.mark.parametrize(
    "mode", ["robot emergency stop", pytest.param("safeguard stop", marks=pytest.mark.slow), "protective stop"]
)
def test_after_an_emergency_stop_the_whole_preflight_is_done_again_questions_too(mode: str, lab: Lab) -> None:
    hold_and_resume(lab, lambda: lab.arm.set_status(fault=DeviceFault("a stop"), safety_mode=mode), lab.arm.set_status)
    names = [event.name for event in lab.operator.of(Checked)]
    assert names == [
        *("safety", "remote", "model", "payload", "slider", "link", "sensor", "load", "workcell", "plan", "cable"),
        *("disk", "limits"),
    ]
    asked = [question for question in lab.operator.asked if question.text.startswith(QUESTIONS)]
    assert len(asked) == (0 if mode == "protective stop" else 3)
    assert all(question.assumed is None for question in asked)


def test_the_controller_is_asked_for_every_pose_once_more_but_not_for_the_ways_between(lab: Lab) -> None:
    asked: list[int] = []

    def on_event(event: Event) -> None:
        if isinstance(event, Checked) and event.name == "limits":
            asked.append(lab.arm.asked_limits)
        if isinstance(event, StateChanged) and event.state is State.HOLD:
            lab.arm.asked_limits = 0
            lab.arm.set_status()

    lab.operator.on_event = on_event
    lab.arm.at_move[4] = lambda: lab.arm.set_status(fault=DeviceFault("a stop"), safety_mode="protective stop")
    lab.operator.answers["resume:"] = ["resume"]
    lab.take_poses()
    first, again = asked
    assert first > 50
    assert again == 7


def test_what_became_wrong_while_the_arm_stood_is_found_before_it_goes_on(lab: Lab) -> None:
    def repair() -> None:
        lab.sensor.push = np.zeros(6)
        lab.arm.remote = False  # meanwhile the operator switched to local control

    def on_event(event: Event) -> None:
        if isinstance(event, Noted) and event.words.startswith("not yet"):
            lab.arm.remote = True
        held(event)

    lab.operator.answers["resume:"] = ["resume", "resume"]
    lab.arm.at_move[4] = lambda: setattr(lab.sensor, "push", np.array([150.0, 0, 0, 0, 0, 0]))

    def held(event: Event) -> None:
        if isinstance(event, StateChanged) and event.state is State.HOLD:
            repair()

    lab.operator.on_event = on_event
    lab.take_poses()
    (refused,) = [event.words for event in lab.operator.of(Noted) if event.words.startswith("not yet")]
    assert "remote: local control" in refused
    assert lab.stops() == [1, 2, 3, 4, 5, 6, 7]


def test_a_question_that_is_not_answered_with_yes_leads_back_to_the_hold(lab: Lab) -> None:
    lab.operator.answers["Is the emergency stop in reach"] = ["yes", "no", "yes"]
    lab.operator.answers["resume:"] = ["resume", "resume"]
    hold_and_resume(
        lab,
        lambda: lab.arm.set_status(fault=DeviceFault("a stop"), safety_mode="robot emergency stop"),
        lab.arm.set_status,
    )
    (refused,) = [event.words for event in lab.operator.of(Noted) if event.words.startswith("not yet")]
    assert "not confirmed" in refused
    assert lab.stops() == [1, 2, 3, 4, 5, 6, 7]


@pytest.mark.parametrize("stays", [True, False])
def test_reduced_mode_that_stays_is_confirmed_before_the_arm_goes_on(stays: bool, lab: Lab) -> None:
    hold_and_resume(
        lab,
        lambda: lab.arm.set_status(safety_mode="reduced"),
        lambda: None if stays else lab.arm.set_status(),
    )
    asked = [question for question in lab.operator.asked if "in reduced mode" in question.text]
    assert len(asked) == stays
    assert lab.stops() == [1, 2, 3, 4, 5, 6, 7]


def test_reduced_mode_that_comes_a_second_time_is_confirmed_again(lab: Lab) -> None:
    lab.arm.at_move |= {
        3: lambda: lab.arm.set_status(safety_mode="reduced"),
        5: lab.arm.set_status,
        7: lambda: lab.arm.set_status(safety_mode="reduced"),
    }
    lab.operator.answers["resume:"] = ["resume"] * 3
    asked: list[int] = []
    lab.operator.at_question.append(("in reduced mode", lambda: asked.append(len(lab.arm.moves))))
    assert lab.take_poses() is not None
    assert asked == [3, 7]


def test_the_failure_of_an_arm_that_ends_its_own_program_is_kept_as_the_cause(lab: Lab) -> None:
    late = DeviceTimeout("the move has not ended")

    def fail_and_end_the_program() -> None:
        lab.arm.set_status(program="stopped")
        lab.clock.sleep(0.2)  # the guards look meanwhile
        raise late

    lab.arm.at_move[4] = fail_and_end_the_program
    with pytest.raises(DeviceFault, match="the control program is stopped") as stopped:
        lab.calibrate()
    assert stopped.value.__cause__ is late


def test_what_the_arm_reports_of_its_program_is_shown_instead_of_a_guess(lab: Lab) -> None:
    failed = DeviceFault("the control program failed in line 60: is a joint limit violated?", "read the log")

    def fail_and_end_the_program() -> None:
        lab.arm.set_status(program="stopped")
        lab.clock.sleep(0.2)  # the guards look meanwhile, and stop the arm
        raise DeviceFault("a stop was requested before the arm arrived") from failed

    lab.arm.at_move[4] = fail_and_end_the_program
    with pytest.raises(DeviceFault, match="line 60"):
        lab.calibrate()
    (held,) = [one for one in lab.operator.of(StateChanged) if one.state is State.HOLD]
    assert "line 60" in held.words
    assert "client" not in held.words
