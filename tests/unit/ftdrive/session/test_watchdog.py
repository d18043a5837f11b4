"""The guards' looks and their thread: how often, what counts as late, how a stop is reported, and who misses them."""

import threading
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from dataclasses import replace

import numpy as np
import pytest

from ftdrive.session.events import Event, GuardTripped, Noted, PoseTaken, State, StateChanged
from ftdrive.session.guards import Guard, Limits, Seen, Tripped
from ftdrive.session.open_session import Journal, OpenCell
from ftdrive.session.watchdog import Watcher
from ftdrivers.clock import REAL
from ftdrivers.errors import ConnectError, DeviceFault, DeviceTimeout
from tests.fake_clock import FakeClock
from tests.unit.ftdrive.fake_cell import FakeArm, FakeSensor, Lab, Scripted, SteppedWatcher
from tests.unit.ftdrive.session.scenarios import end_guards


class Looks(Guard):
    """Remembers what it was shown."""

    def __init__(self) -> None:
        self.seen: list[Seen] = []

    def look(self, seen: Seen) -> None:
        self.seen.append(seen)


@contextmanager
def trips(hazard: int) -> Iterator[None]:
    """Expect that a guard of this row of the hazard table trips in the block."""
    with pytest.raises(Tripped) as found:
        yield
    assert found.value.hazard == hazard


def opened(arm: FakeArm, sensor: FakeSensor | None = None, limits: Limits | None = None) -> OpenCell:
    return OpenCell(arm, sensor or FakeSensor(arm), arm.clock, Journal(Scripted()), limits or Limits())


class Cell:
    """An arm that stands, controlled, and its sensor; looked at by guards that are stepped by a fake clock."""

    def __init__(self, *guards: Guard) -> None:
        self.clock = FakeClock()
        self.arm = FakeArm(self.clock)
        self.arm.control = True
        self.arm.answers_s = 0.0
        self.sensor = FakeSensor(self.arm)
        self.trips: list[tuple[float, Tripped]] = []
        self.watcher = SteppedWatcher(opened(self.arm, self.sensor), guards, self._on_trip)

    def _on_trip(self, trip: Tripped) -> None:
        self.trips.append((self.clock.now_s(), trip))

    @contextmanager
    def watched(self, *, moving: bool = True) -> Iterator[SteppedWatcher]:
        with self.watcher as watcher:
            watcher.begin()
            with watcher.watching(self.arm.q, self.arm.q + moving, moving=moving):
                yield watcher


# ------------------------------------------------------------------------------------------------------ when they look


def test_a_block_begins_with_a_look_and_goes_on_a_hundred_times_a_second() -> None:
    looks = Looks()
    cell = Cell(looks)
    with cell.watched():
        assert len(looks.seen) == 1
        cell.clock.advance(1.0)
        assert len(looks.seen) == pytest.approx(101, abs=1)


@pytest.mark.parametrize(("between_s", "counted_s"), [(0.01, 0.01), (0.018, 0.018), (0.022, 0.02), (3.0, 0.02)])
def test_the_time_that_this_computer_takes_counts_only_in_part(between_s: float, counted_s: float) -> None:
    looks = Looks()
    cell = Cell(looks)
    with cell.watched():
        cell.clock.stall(looks.seen[-1].t_s + between_s - cell.clock.now_s())
        cell.clock.advance(0.0)
    assert looks.seen[-1].dt_s == pytest.approx(counted_s)


# --------------------------------------------------------------------------------------------------- the sensor's age


def silent(sensor: FakeSensor) -> None:
    """Let the newest sample stay the newest."""
    newest = sensor.latest(timeout_s=0)
    sensor.latest = lambda **_: newest  # type: ignore[method-assign]  # this sensor only


# ----------------------------------------------------------------------------------------------- a stop, and its report


@pytest.mark.parametrize(("takes_s", "told_after_s"), [(0.0, 0.0), (0.17, 0.17), (0.23, 0.2), (5.0, 0.2)])
def test_a_stop_is_reported_when_it_is_done_or_after_a_fifth_of_a_second(takes_s: float, told_after_s: float) -> None:
    cell = Cell()
    with cell.watcher as watcher:
        watcher.begin()
        with trips(16), watcher.watching(cell.arm.q, cell.arm.q, moving=False):
            cell.watcher.stop_takes_s = takes_s
            cell.arm.gone = DeviceTimeout("silent")
            begin_s = cell.clock.now_s()
            cell.clock.advance(6.0)
            assert cell.arm.halted.is_set()
            assert watcher.tripped(wait_s=0.0) is not None
    ((told_s, _),) = cell.trips
    assert told_s - begin_s == pytest.approx(told_after_s, abs=0.011)  # one look


def test_a_stop_that_cannot_be_reported_ends_no_guard_and_is_shown_in_the_hold(lab: Lab) -> None:
    failed: list[bool] = []

    def on_event(event: Event) -> None:
        if isinstance(event, GuardTripped) and not failed:
            failed.append(lab.guards_look)
            raise BlockingIOError("the terminal takes no more")
        if isinstance(event, StateChanged) and event.state is State.HOLD:
            assert lab.arm.halted.is_set()
            lab.sensor.push = np.zeros(6)

    lab.push_on_the_way(3, 6)
    lab.operator.on_event = on_event
    lab.operator.answers["resume:"] = ["resume", "resume"]
    assert lab.take_poses() is not None
    assert failed == [True]
    diary = (lab.run().folder / "events.ndjson").read_text()
    assert diary.count('"guard-tripped"') == 2  # one for each of the two pushes
    (note,) = [event.words for event in lab.operator.of(Noted) if "reported late" in event.words]
    assert "the terminal takes no more" in note
    assert "unexpected contact" in note
    assert lab.stops() == [1, 2, 3, 4, 5, 6, 7]


# ---------------------------------------------------------------------------------------------- guards that do not look


@pytest.mark.parametrize(("late_s", "missed"), [(0.95, False), (1.05, True)])
def test_guards_that_hang_for_a_second_are_missed(late_s: float, missed: bool) -> None:
    cell = Cell()
    with cell.watcher as watcher:
        watcher.begin()
        with watcher.watching(cell.arm.q, cell.arm.q, moving=False):
            cell.clock.stall(late_s)
            with trips(18) if missed else nullcontext():
                watcher.check()
            cell.clock.advance(0.0)


@pytest.mark.parametrize(("gone_s", "unseen"), [(0.9, False), (1.06, True)])
def test_an_arm_that_reports_nothing_for_a_second_was_out_of_sight(gone_s: float, unseen: bool) -> None:
    def out_of_sight() -> None:
        raise ConnectError("the arm is not open")

    cell = Cell()
    with cell.watcher as watcher:
        cell.arm.at_look = out_of_sight
        watcher.look_aside()
        cell.clock.advance(gone_s)
        cell.arm.at_look = lambda: None
        assert watcher.unseen == unseen


@pytest.mark.parametrize("stop", [0, 3])
def test_nothing_moves_without_a_watchdog(stop: int, lab: Lab) -> None:
    def on_event(event: Event) -> None:
        if isinstance(event, PoseTaken) and event.stop == stop:
            end_guards(lab)
            lab.clock.sleep(0.1)

    if stop == 0:
        lab.operator.at_question.append(("Is the tool free", lambda: setattr(lab.watchers[-1], "ended", True)))
    lab.operator.on_event = on_event
    with pytest.raises(DeviceFault, match="the arm is not watched"):
        lab.take_poses()
    assert len(lab.arm.moves) == stop


# ---------------------------------------------------------------------------------------------------------- the thread


@contextmanager
def thread_of(arm: FakeArm, *guards: Guard) -> Iterator[Watcher]:
    """Let the thread itself watch an arm that stands, by the computer's clock; it may be as late as it likes."""
    patient = replace(Limits(), hung_s=60.0)
    with Watcher(opened(arm, limits=patient), guards, lambda _: None) as watcher:
        watcher.begin()
        with watcher.watching(arm.q, arm.q, moving=False):
            yield watcher


def real_arm() -> FakeArm:
    arm = FakeArm(REAL)
    arm.control, arm.answers_s = True, 0.0
    return arm


def test_the_thread_stops_an_arm_that_does_not_answer_the_stop() -> None:
    arm = real_arm()
    answered, reported = threading.Event(), threading.Event()
    stop = arm.stop

    def slow() -> None:
        assert reported.wait(60.0), "the hazard is reported meanwhile"
        stop()
        answered.set()

    arm.stop = slow  # type: ignore[method-assign]  # this arm only
    with (
        trips(16),
        Watcher(opened(arm), [], lambda _: reported.set()) as watcher,
    ):
        watcher.begin()
        with watcher.watching(arm.q, arm.q, moving=False):
            arm.gone = DeviceTimeout("silent")
            assert watcher.tripped(wait_s=60.0) is not None
            assert answered.is_set()


@pytest.mark.filterwarnings("ignore::pytest.PytestUnhandledThreadExceptionWarning")
def test_a_thread_that_has_ended_is_missed() -> None:
    def leave() -> None:
        if threading.current_thread().name == "guards":
            raise SystemExit

    arm = real_arm()
    with trips(18), thread_of(arm) as watcher:
        arm.at_look = leave
        (guards,) = [thread for thread in threading.enumerate() if thread.name == "guards"]
        guards.join(60.0)
        watcher.check()
