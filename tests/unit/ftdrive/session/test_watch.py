"""The thread of the guards: it looks before anything moves, lives on, counts fairly, and is missed where it is not."""

import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
import pytest

from drivers.errors import DeviceFault
from drivers.interfaces import FtSamples
from ftdrive.session.events import Event, GuardTripped, Noted, PoseTaken, State, StateChanged
from ftdrive.session.guards import Guard, Limits, Seen, SensorGuard
from ftdrive.session.watch import Watcher
from tests.unit.ftdrive.fake_cell import FakeArm, FakeSensor, Lab


@contextmanager
def watched(guard: Guard, arm: FakeArm, sensor: FakeSensor) -> Iterator[Watcher]:
    """Let one guard look at an arm that stands."""
    with Watcher(arm, sensor, [guard], lambda _: None) as watcher:
        watcher.begin()
        with watcher.watching(arm.q, arm.q, moving=True):
            yield watcher


def test_a_stop_that_cannot_be_told_ends_no_guard_and_is_told_in_the_hold(lab: Lab) -> None:
    failed: list[str] = []

    def on_event(event: Event) -> None:
        if isinstance(event, GuardTripped) and not failed:
            failed.append(threading.current_thread().name)
            raise BlockingIOError("the terminal takes no more")
        if isinstance(event, StateChanged) and event.state is State.HOLD:
            assert lab.arm.halted.is_set()
            lab.sensor.push = np.zeros(6)

    lab.push_on_the_way(3, 6)
    lab.operator.on_event = on_event
    lab.operator.answers["Type resume"] = ["resume", "resume"]
    assert lab.calibrate() is not None
    assert failed == ["guards"]
    diary = (lab.run().folder / "events.ndjson").read_text()
    assert diary.count('"guard-tripped"') == 2  # one for each of the two pushes
    (note,) = [event.words for event in lab.operator.of(Noted) if "not told at once" in event.words]
    assert "the terminal takes no more" in note
    assert "unexpected contact" in note
    assert lab.stops() == [1, 2, 3, 4, 5, 6, 7]


ENDED = pytest.mark.filterwarnings("ignore::pytest.PytestUnhandledThreadExceptionWarning")


def end_thread() -> None:
    """Let the guards' thread end whatever it does."""
    if threading.current_thread().name == "guards":
        raise SystemExit


@ENDED
def test_guards_that_ended_on_the_way_are_missed_at_once(lab: Lab) -> None:
    lab.arm.at_move[3] = lambda: setattr(lab.arm, "at_look", end_thread)
    lab.operator.answers["Type resume"] = ["resume", "quit"]
    with pytest.raises(DeviceFault, match="the guards' thread has ended, nothing is watched"):
        lab.calibrate()
    assert [event.hazard for event in lab.operator.of(GuardTripped)] == [18]
    assert len([event for event in lab.operator.of(Noted) if event.words.startswith("not yet: the guards'")]) == 1
    assert len(lab.arm.moves) == 3


@ENDED
@pytest.mark.parametrize("stop", [0, 3])
def test_nothing_moves_where_nobody_watches(stop: int, lab: Lab) -> None:
    def on_event(event: Event) -> None:
        if isinstance(event, PoseTaken) and event.stop == stop:
            end()

    def end() -> None:
        lab.arm.at_look = end_thread
        (guards,) = [thread for thread in threading.enumerate() if thread.name == "guards"]
        guards.join(5.0)

    if stop == 0:
        lab.operator.at_question.append(("Is the tool free", end))
    lab.operator.on_event = on_event
    with pytest.raises(DeviceFault, match="nothing is watched"):
        lab.calibrate()
    assert len(lab.arm.moves) == stop


def test_what_is_wrong_already_is_seen_before_the_arm_moves(lab: Lab) -> None:
    def on_event(event: Event) -> None:
        if isinstance(event, PoseTaken) and event.stop == 2:
            lab.arm.set_status(program="paused")

    lab.operator.on_event = on_event
    with pytest.raises(DeviceFault, match="the control program is paused"):
        lab.calibrate()
    assert len(lab.arm.moves) == 2


def test_the_time_that_this_computer_takes_is_no_silence_of_the_sensor() -> None:
    arm = FakeArm()
    sensor = FakeSensor(arm)
    late = threading.Event()
    looks = [0]
    latest = sensor.latest

    def every_second(*, timeout_s: float) -> FtSamples:
        looks[0] += 1
        if looks[0] == 5:
            time.sleep(3 * Limits().sensor_age_moving_s)  # the guards' thread gets no time
        samples = latest(timeout_s=timeout_s)
        samples.seq[:] = looks[0] // 2  # look 5 sees the same sample as look 4
        if looks[0] == 8:
            late.set()
        return samples

    sensor.latest = every_second  # type: ignore[method-assign]  # this sensor only
    arm.control = True
    with watched(SensorGuard(Limits()), arm, sensor) as watcher:
        assert late.wait(5.0)
        watcher.check()


def test_a_block_begins_with_a_look() -> None:
    class Looks(Guard):
        number = 0

        def look(self, seen: Seen) -> None:
            del seen
            self.number += 1

    arm, guard = FakeArm(), Looks()
    with watched(guard, arm, FakeSensor(arm)):
        assert guard.number >= 1
