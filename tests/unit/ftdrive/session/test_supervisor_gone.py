"""Row 27: what a session does when no operator follows it any more, on the fake cell."""

import json

import pytest

from ftdrive.errors import SupervisorGone, exit_code
from ftdrive.session.events import Event, GuardTripped
from tests.unit.ftdrive.fake_cell import Lab, Scripted

WHY = "the reader of standard output is gone"


def leave(lab: Lab) -> None:
    lab.operator.gone = WHY


def recorded(lab: Lab) -> list[dict[str, object]]:
    lines = (lab.run().folder / "events.ndjson").read_text().splitlines()
    events = [json.loads(line) for line in lines]
    return [event for event in events if event["event"] == "guard-tripped" and event["hazard"] == 27]


def resumes(lab: Lab, poses: int) -> None:
    """Continue the run with another operator."""
    kept = lab.stops()
    assert kept == list(range(1, poses + 1))
    lab.operator = Scripted()
    assert lab.take_poses(resume=lab.run().folder) is not None
    assert lab.stops() == [1, 2, 3, 4, 5, 6, 7]


def test_the_arm_stops_in_mid_move_before_anything_else(lab: Lab) -> None:
    begun_s: list[float] = []

    def gone() -> None:
        leave(lab)
        begun_s.append(lab.clock.now_s())

    def on_event(event: Event) -> None:
        if isinstance(event, GuardTripped):
            assert lab.arm.halted.is_set()
            assert lab.clock.now_s() - begun_s[0] < 0.03

    lab.arm.at_move[4] = gone
    lab.operator.on_event = on_event
    with pytest.raises(SupervisorGone, match=f"{WHY}.*--resume") as error:
        lab.take_poses()
    assert exit_code(error.value) == 9
    assert lab.arm.stops
    assert len(lab.arm.moves) == 4
    (event,) = recorded(lab)
    assert WHY in str(event["words"])
    assert not lab.holds()  # there is no operator to ask
    resumes(lab, 3)


def test_no_question_is_answered_for_an_absent_operator(lab: Lab) -> None:
    lab.operator.gone = WHY
    with pytest.raises(SupervisorGone):
        lab.take_poses(yes=True, real=False)
    assert not lab.arm.moves
