"""What stops the arm on the fake cell: each fault injected on the way, the hold, and how it goes on."""

import numpy as np
import pytest

from ftcalib.routine import PoseRecord
from ftdrive.errors import SupervisorGone
from ftdrive.planning.plan import Plan
from ftdrive.runs.run import Run
from ftdrive.session.events import Checked, Event, GuardTripped, Key, State, StateChanged
from ftdrive.session.preflight import Before
from ftdrivers.errors import DeviceFault, DeviceTimeout, StreamBroken
from ftdrivers.interfaces import FtSamples
from tests.unit.ftdrive.fake_cell import Lab
from tests.unit.ftdrive.session.scenarios import (
    Action,
    Case,
    at,
    both,
    cases,
    end_guards,
    lose_sensor,
    press,
    push,
    status,
    turn,
)


def lose_controller(lab: Lab) -> None:
    lab.arm.gone = DeviceTimeout("silent")


def heal_with_another_zero(lab: Lab) -> None:
    lab.sensor.heals = True
    push()(lab)


def lose_sensor_and_heal(lab: Lab) -> None:
    lab.sensor.heals = True
    lose_sensor(lab)


def forbid_once(lab: Lab) -> None:
    lab.arm.forbidden = None if lab.arm.forbidden is not None else lab.arm.q.copy()  # no pose of the plan


NO_PUSH = push(0.0)
FAULTS: dict[str, tuple[int, Action, Action]] = {
    "a joint pushed off": (
        2,
        lambda lab: setattr(lab.arm, "push_rad", np.radians([0, 1.0, 0, 0, 0, 0])),
        lambda lab: setattr(lab.arm, "push_rad", np.zeros(6)),
    ),
    "the TCP changed": (8, status(tcp_offset=(0.0, 0.0, 0.0, 0.3, 0.0, 0.0)), status()),
    "a protective stop": (10, status("protective stop"), status()),
    "an emergency stop": (11, status("robot emergency stop"), status()),
    "an emergency stop between two looks": (
        11,
        lambda lab: lab.arm.lose_power(),
        lambda lab: lab.arm.power_up(),
    ),
    "reduced mode": (12, status("reduced"), status()),
    "a push before the tool is known": (14, push(), NO_PUSH),
    "a silent sensor": (15, lose_sensor, lambda lab: setattr(lab.sensor, "failure", None)),
    "a stuck sensor": (
        15,
        lambda lab: setattr(lab.sensor, "stuck", True),
        lambda lab: setattr(lab.sensor, "stuck", False),
    ),
    "a silent controller": (16, lose_controller, lambda lab: setattr(lab.arm, "gone", None)),
    "another client's program": (21, status(program="stopped"), status()),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_a_fault_on_the_way_stops_the_arm_and_resume_goes_on(fault: str, lab: Lab) -> None:
    hazard, inject, repair = FAULTS[fault]

    def in_hold(lab: Lab) -> None:
        assert lab.arm.halted.is_set()
        assert lab.stops() == [1, 2, 3]
        repair(lab)

    at(lab, "move 4", inject)
    at(lab, "hold", in_hold)
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


LEFT = "the reader of standard output is gone"
CONTACT = "unexpected contact"
STOPS = {
    "a controller that does not hear the stop may end its move": Case(
        {"move 4": lose_controller},
        ends="silent",
        error=DeviceTimeout,
        rows=(16,),
        holds=((4, "completes the current move"),),
        taken=(1, 2, 3),
    ),
    "a push once the tool is known": Case(
        {"move 7": push(0.0, 2.0)}, ends=CONTACT, rows=(14,), holds=((7, CONTACT),), taken=(1, 2, 3, 4, 5, 6)
    ),
    "resume before the cause is fixed is refused": Case(
        {"move 3": status("protective stop")},
        ("resume", "resume", "quit"),
        ends="protective stop",
        rows=(10,),
        holds=((3, "protective stop"),),
        taken=(1, 2),
        moves=3,
        noted={"not yet": 2},
    ),
    "what became wrong while the arm stood is found before it goes on": Case(
        {
            "move 4": push(),
            "hold": both(push(0.0), lambda lab: setattr(lab.arm, "remote", False)),
            "noted not yet": lambda lab: setattr(lab.arm, "remote", True),
        },
        ("resume", "resume"),
        rows=(14,),
        holds=((4, CONTACT),),
        noted={"not yet": 1, "remote: local control": 1},
    ),
    "the way on is asked of the controller too": Case(
        {"move 4": press(Key.PAUSE), "hold": forbid_once},
        ("resume", "resume"),
        holds=((4, "paused"), (4, "the controller's safety limits forbid")),
    ),
    "a sensor that was switched off may have another zero": Case(
        {"move 2": lose_sensor, "hold": heal_with_another_zero},
        ("resume",),
        rows=(15,),
        holds=((2, "a cable came off"),),
        noted={"not yet": 0},
    ),
    "a sensor that comes back while the arm stands needs no operator": Case(
        {"measuring 3": lose_sensor_and_heal}, rows=(15,), noted={"restarts": 1}
    ),
    "a sensor that fails twice at a pose needs a person": Case(
        {"sample 3": lose_sensor_and_heal},
        ends="a cable came off",
        error=StreamBroken,
        rows=(15, 15),
        holds=((3, "a cable came off"),),
        taken=(1, 2),
        noted={"restarts": 1},
    ),
    "an arm that was moved between two poses is noticed": Case(
        {"taken 2": turn(6, 2.0)},
        ends=r"joint 6 is 2\.0° off",
        rows=(21,),
        holds=((2, "joint 6"),),
        taken=(1, 2),
    ),
    **{
        f"an arm that was moved while the way {way} waits for its word does not begin it": Case(
            {"move 4": push(), "hold": push(0.0), f"asked Approach {way}": turn(1, 25.0)},
            answers,
            ends=r"joint 1 is 25\.0° off",
            rows=rows,
            holds=holds,
            taken=taken,
            moves=moves,
        )
        for way, answers, rows, holds, taken, moves in (
            ("to pose 1", (), (21,), ((0, "joint 1"),), (), 0),
            ("back", ("back",), (14, 21), ((4, CONTACT), (4, "joint 1")), (1, 2, 3), 4),
        )
    },
    "guards that ended on the way are missed at once": Case(
        {"move 3": end_guards},
        ("resume", "quit"),
        ends="guard thread has ended",
        rows=(18,),
        holds=((3, "guard thread has ended"),),
        taken=(1, 2),
        moves=3,
        noted={"not yet: the guard thread": 1},
    ),
    "a pose in progress is given up when the supervisor leaves": Case(
        {"sample 3": lambda lab: setattr(lab.operator, "gone", LEFT)},
        ends=LEFT,
        error=SupervisorGone,
        rows=(27,),
        taken=(1, 2),
        moves=3,
    ),
    "reduced mode that stays is confirmed before the arm goes on": Case(
        {"move 4": status("reduced")},
        ("resume",),
        rows=(12,),
        holds=((4, "reduced"),),
        asked={"in reduced mode": 1},
    ),
    "reduced mode that comes a second time is confirmed again": Case(
        {"move 3": status("reduced"), "move 5": status(), "move 7": status("reduced")},
        ("resume",) * 3,
        rows=(12, 12, 12),
        holds=((3, "reduced"), (5, "reduced"), (7, "reduced")),
        asked={"in reduced mode": 2},
    ),
}


@cases(STOPS)
def test_what_stops_the_arm(case: Case, lab: Lab) -> None:
    case.play(lab)


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


@pytest.mark.parametrize("seen_by_guards", [True, False])
def test_saturation_that_the_guards_or_only_the_samples_of_a_pose_show_discards_it(
    seen_by_guards: bool, lab: Lab, monkeypatch: pytest.MonkeyPatch
) -> None:
    collect = lab.sensor.collect

    def one_high(duration_s: float) -> FtSamples:
        samples = collect(duration_s)
        if len(lab.arm.moves) == 4:
            samples.wrench[7, 5] = -3.8  # the newest ones, which the guards see, are as ever
        return samples

    monkeypatch.setattr(Before, "sensor_range", np.array([40.0, 40, 40, 4, 4, 4]))
    if seen_by_guards:
        lab.arm.at_move[4] = lambda: setattr(lab.sensor, "push", np.array([0, 0, 0, 0, 0, 3.8]))
    else:
        monkeypatch.setattr(lab.sensor, "collect", one_high)
    with pytest.raises(DeviceFault, match="of its range"):
        lab.take_poses()
    assert lab.operator.of(GuardTripped)[0].hazard == 13
    assert lab.stops() == [1, 2, 3]


QUESTIONS = ("Is the tool free", "Is the space within", "Is the emergency stop within reach")


def test_after_an_emergency_stop_the_whole_preflight_is_done_again_questions_too(lab: Lab) -> None:
    limits: list[int] = []

    def repair(lab: Lab) -> None:
        lab.operator.asked.clear()
        lab.operator.shown.clear()
        lab.arm.asked_limits = 0
        lab.arm.set_status()

    def on_event(event: Event) -> None:
        if isinstance(event, Checked) and event.name == "limits":
            limits.append(lab.arm.asked_limits)

    lab.operator.on_event = on_event
    lab.operator.answers["resume:"] = ["resume"]
    at(lab, "move 4", status("robot emergency stop"))
    at(lab, "hold", repair)
    lab.take_poses()
    names = [event.name for event in lab.operator.of(Checked)]
    assert names == [
        *("safety", "remote", "model", "payload", "slider", "link", "sensor", "load", "workcell", "plan", "cable"),
        *("disk", "limits"),
    ]
    asked = [question for question in lab.operator.asked if question.text.startswith(QUESTIONS)]
    assert len(asked) == 3
    assert all(question.assumed is None for question in asked)
    first, again = limits
    assert first > 50  # the poses and the ways between
    assert again == 7
