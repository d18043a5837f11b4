"""What happens while the arm is held, on the fake cell: a person says no, or an emergency stop is pressed meanwhile."""

from collections.abc import Callable

import pytest

from ftdrive.errors import Declined
from ftdrive.session.events import GuardTripped, Key, Noted, State, StateChanged
from ftdrivers.errors import ConnectError, DeviceFault
from tests.unit.ftdrive.fake_cell import Lab

QUESTIONS = ("Is the tool free", "Is the space within", "Is the emergency stop in reach")


def when_asked(lab: Lab, words: str, do: Callable[[], None]) -> None:
    """Let something happen each time a question with these words waits for its answer."""
    lab.operator.at_question.append((words, do))


def press_and_release(lab: Lab, mode: str = "robot emergency stop") -> None:
    """Press the emergency stop for a tenth of a second, in which the guards look at the arm, then release it."""
    lab.arm.set_status(fault=DeviceFault("a stop"), safety_mode=mode)
    lab.clock.sleep(0.1)
    lab.arm.set_status()
    lab.clock.sleep(0.1)


def once(do: Callable[[], None]) -> Callable[[], None]:
    left = [do]
    return lambda: left.pop()() if left else None


def pause_on_the_way(lab: Lab, move: int) -> None:
    lab.arm.at_move[move] = lambda: lab.operator.keys.append(Key.PAUSE)


def questions(lab: Lab) -> int:
    """How often each of the three was asked of a person."""
    times = dict.fromkeys(QUESTIONS, 0)
    for question in lab.operator.asked:
        for words in QUESTIONS:
            times[words] += question.text.startswith(words) and question.assumed is None
    (number,) = set(times.values())
    return number


def holds(lab: Lab) -> list[str]:
    return [event.words for event in lab.operator.of(StateChanged) if event.state is State.HOLD]


# ---------------------------------------------------------------------------------------------------- a person says no


@pytest.mark.parametrize("answer", ["resume", pytest.param("skip", marks=pytest.mark.slow)])
def test_a_way_that_is_not_confirmed_leads_back_to_the_hold(answer: str, lab: Lab) -> None:
    pause_on_the_way(lab, 4)
    lab.operator.answers["resume:"] = ["resume", answer]
    lab.operator.answers["Approach to pose 4"] = ["no"]
    moves: list[int] = []
    when_asked(lab, "resume:", lambda: moves.append(len(lab.arm.moves)))
    assert lab.take_poses() is not None
    assert moves == [4, 4]
    first, second = holds(lab)
    assert first == "paused by the operator"
    assert second.startswith("not confirmed: Approach")
    assert lab.operator.of(GuardTripped) == []
    assert lab.stops() == [1, 2, 3, *([4] if answer == "resume" else []), 5, 6, 7]


def test_who_does_not_confirm_a_way_can_end_it_there_and_keeps_the_poses(lab: Lab) -> None:
    pause_on_the_way(lab, 4)
    lab.operator.answers["resume:"] = ["resume", "quit"]
    lab.operator.answers["Approach to pose 4"] = ["no"]
    with pytest.raises(Declined, match="not confirmed: Approach"):
        lab.take_poses()
    assert len(lab.arm.moves) == 4
    assert lab.stops() == [1, 2, 3]
    assert f"--resume {lab.run().folder}" in lab.operator.of(Noted)[-1].words


def test_the_way_back_that_is_not_confirmed_is_not_gone_but_offered_again(lab: Lab) -> None:
    lab.push_on_the_way(4)
    lab.operator.answers["resume:"] = ["back", "resume"]
    lab.operator.answers["Approach back to pose 3"] = ["no"]
    assert lab.take_poses() is not None
    assert len(holds(lab)) == 2
    assert all("back" in answers for answers in lab.holds())
    assert lab.stops() == [1, 2, 3, 4, 5, 6, 7]


def test_a_tour_that_may_not_begin_yet_is_held_at_its_first_pose(lab: Lab) -> None:
    lab.operator.answers["Begin?"] = ["no"]
    lab.operator.answers["resume:"] = ["resume"]
    assert lab.take_poses() is not None
    assert [words.startswith("not confirmed: The arm stands") for words in holds(lab)] == [True]
    assert lab.stops() == [1, 2, 3, 4, 5, 6, 7]


@pytest.mark.parametrize("words", [*QUESTIONS, "Type MOVE"])
def test_a_no_before_the_first_motion_ends_the_session(words: str, lab: Lab) -> None:
    lab.operator.answers[words] = ["no"]
    with pytest.raises(Declined):
        lab.take_poses()
    assert holds(lab) == []
    assert lab.arm.moves == []


# ------------------------------------------------------------------------------- an emergency stop is pressed meanwhile


@pytest.mark.parametrize(
    "mode",
    [
        "robot emergency stop",
        *(pytest.param(mode, marks=pytest.mark.slow) for mode in ("system emergency stop", "safeguard stop")),
        "protective stop",
    ],
)
def test_an_emergency_stop_that_is_pressed_in_a_hold_brings_the_questions_again(mode: str, lab: Lab) -> None:
    pause_on_the_way(lab, 4)
    lab.operator.answers["resume:"] = ["resume"]
    when_asked(lab, "resume:", once(lambda: press_and_release(lab, mode)))
    assert lab.take_poses() is not None
    counts = mode != "protective stop"
    assert questions(lab) == 1 + counts
    rows = [event.hazard for event in lab.operator.of(GuardTripped)]
    assert rows == [11] * counts
    assert len(lab.arm.moves) == 8
    assert lab.stops() == [1, 2, 3, 4, 5, 6, 7]


def test_the_questions_come_until_they_are_all_answered_with_yes(lab: Lab) -> None:
    pause_on_the_way(lab, 4)
    lab.operator.answers["resume:"] = ["resume", "resume"]
    lab.operator.answers["Is the emergency stop in reach"] = ["yes", "no"]
    when_asked(lab, "resume:", once(lambda: press_and_release(lab)))
    assert lab.take_poses() is not None
    assert questions(lab) == 3
    assert [event.hazard for event in lab.operator.of(GuardTripped)] == [11]
    assert len([event for event in lab.operator.of(Noted) if event.words.startswith("not yet: not confirmed")]) == 1


def test_an_emergency_stop_that_is_still_pressed_is_refused_and_asked_about_once_released(lab: Lab) -> None:
    pause_on_the_way(lab, 4)
    lab.operator.answers["resume:"] = ["resume", "resume"]
    pressed_then_not = iter([{"fault": DeviceFault("a stop"), "safety_mode": "robot emergency stop"}, {}])
    when_asked(lab, "resume:", lambda: lab.arm.set_status(**next(pressed_then_not)))
    assert lab.take_poses() is not None
    (refused,) = [event.words for event in lab.operator.of(Noted) if event.words.startswith("not yet")]
    assert "safety: a stop" in refused
    assert questions(lab) == 2
    assert len(lab.arm.moves) == 8


@pytest.mark.parametrize("words", ["Is the tool free", "Approach to pose 4"])
def test_an_emergency_stop_that_is_pressed_at_a_question_counts_too(words: str, lab: Lab) -> None:
    lab.arm.at_move[4] = lambda: lab.arm.set_status(fault=DeviceFault("a stop"), safety_mode="safeguard stop")
    lab.operator.answers["resume:"] = ["resume", "resume"]
    when_asked(lab, "resume:", lab.arm.set_status)
    moves: list[int] = []

    def press() -> None:
        if lab.arm.moves:
            moves.append(len(lab.arm.moves))
            if len(moves) == 1:
                press_and_release(lab)

    when_asked(lab, words, press)
    assert lab.take_poses() is not None
    assert moves == [4, 4]
    assert questions(lab) == 3
    assert lab.stops() == [1, 2, 3, 4, 5, 6, 7]


def test_an_emergency_stop_between_two_steps_holds_the_arm_where_it_stands(lab: Lab) -> None:
    lab.operator.answers["resume:"] = ["resume"]
    when_asked(lab, "Pose 4 of 7", once(lambda: press_and_release(lab)))
    moves: list[int] = []
    when_asked(lab, "resume:", lambda: moves.append(len(lab.arm.moves)))
    assert lab.take_poses(mode="step") is not None
    assert moves == [3]
    assert holds(lab) == ["the arm stopped: a stop"]
    assert [event.hazard for event in lab.operator.of(GuardTripped)] == [11]
    assert questions(lab) == 2
    assert lab.stops() == [1, 2, 3, 4, 5, 6, 7]


def test_an_arm_that_was_out_of_sight_is_resumed_after_a_new_question(lab: Lab) -> None:
    pause_on_the_way(lab, 4)
    lab.operator.answers["resume:"] = ["resume"]

    def out_of_sight() -> None:
        def unseen() -> None:
            raise ConnectError("the arm is not open")

        lab.arm.at_look = unseen
        lab.clock.sleep(1.1)
        lab.arm.at_look = lambda: None

    when_asked(lab, "resume:", once(out_of_sight))
    assert lab.take_poses() is not None
    assert questions(lab) == 2
    assert [event for event in lab.operator.of(Noted) if "no status of the arm" in event.words]
    assert lab.operator.of(GuardTripped) == []


@pytest.mark.parametrize("words", QUESTIONS)
def test_an_emergency_stop_at_the_first_questions_brings_them_again(words: str, lab: Lab) -> None:
    lab.operator.answers["resume:"] = ["resume"]
    when_asked(lab, words, once(lambda: press_and_release(lab)))
    held_at: list[int] = []
    when_asked(lab, "resume:", lambda: held_at.append(len(lab.arm.moves)))
    assert lab.take_poses() is not None
    assert held_at == [0]
    assert questions(lab) == 2
    assert lab.stops() == [1, 2, 3, 4, 5, 6, 7]
