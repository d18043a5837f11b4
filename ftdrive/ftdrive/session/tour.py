"""The state machine of a tour: (MOVE, SETTLE, SAMPLE) for each pose, CLOSE; after an error STOP, then HOLD.

The arm makes certified moves only: along the plan from one pose to the next or back, or along an approach that is
planned from where the arm stands, shown and confirmed. `GuardedCell` leads from a stop back to motion: it finds what
stopped the arm, and whether the cause is gone.
"""

import logging
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Final

import numpy as np

from ftcalib.errors import TooFewSamples
from ftcalib.judge import described_cell
from ftcalib.model import Array
from ftcalib.routine import Stage, TourPose, take_pose
from ftdrive.checks.arm import SLOWEST_SLIDER
from ftdrive.errors import Declined, NotAccepted, PlanRefused, SupervisorGone
from ftdrive.planning.approach import plan_approach
from ftdrive.planning.motion import Speeds, arm_moves, move_duration_s
from ftdrive.planning.plan import way_in_words
from ftdrive.session.events import GuardTripped, Hazard, Key, Question, SensorEvents, State, StateChanged, Weighed
from ftdrive.session.guards import ContactGuard, RangeGuard, Tripped, arm_lost, by_safety, fault
from ftdrive.session.open_session import OpenCell, PoseBook
from ftdrive.session.options import SessionOptions
from ftdrive.session.preflight import Before, forbidden
from ftdrive.session.watchdog import Watcher
from ftdrivers.errors import DeviceError, DeviceFault

log = logging.getLogger(__name__)

APPROACH_RAD_S: Final = float(np.radians(15))
# Speed back to the previous pose, after a stop between two poses.
BACK_RAD_S: Final = float(np.radians(10))
SLOW: Final = Speeds.first_run()
_AT_RAD: Final = float(np.radians(0.5))
# An approach that comes closer than this to a skipped posture passes it.
_NEAR_RAD: Final = float(np.radians(10))
# How long the guards look at a resting arm before it moves on after a stop.
_LOOK_AGAIN_S: Final = 0.4
_FIRST_WORD: Final = "MOVE"


@dataclass(slots=True)
class Progress:
    """State of a tour between two steps.

    A stop counts from 1 to `poses + 1`, the return to the first pose. An index counts the poses of the plan from 0.
    """

    poses: int
    todo: list[int] = field(default_factory=list)
    """Stops left, in order."""
    stood_at: int | None = None
    """Index of the pose where the arm stood last; None where it was moved from there by something else."""
    standing: bool = False
    """Whether the arm still stands there."""
    under_way: int | None = None
    """Stop that the arm moves to or measures."""
    back: tuple[int, str] | None = None
    """Index of the pose to return to, and what stopped the arm."""
    confirmed: bool = False
    """Whether the operator has typed the word for the first motion."""
    taken_last: int | None = None
    """Stop of the newest pose."""
    skipped: set[int] = field(default_factory=set)
    """Indices of postures that the arm should avoid."""
    reopened: set[int] = field(default_factory=set)
    """Stops at which the sensor was reopened."""
    driven: set[int] = field(default_factory=set)
    """Indices of poses whose move to the next pose was completed."""
    payload_kg: float | None = None
    """Payload reported by the controller when it was last compared."""

    @property
    def stops(self) -> int:
        """Number of stops, the return included."""
        return self.poses + 1

    @property
    def at(self) -> int | None:
        """Index of the pose where the arm stands; None between poses."""
        return self.stood_at if self.standing else None

    @property
    def moving(self) -> bool:
        """Whether the arm is on its way to a stop."""
        return self.under_way is not None and not self.standing

    @property
    def came_from(self) -> int | None:
        """Index of the pose to which the arm can return, where it was stopped on its way to another."""
        gone = {self.index(self.todo[0]), *self.skipped}
        return None if self.standing or self.stood_at in gone else self.stood_at

    @property
    def undriven(self) -> list[int]:
        """Poses, from 1, whose planned move to the next pose was replaced by an approach or left out."""
        return [index + 1 for index in range(self.poses) if index not in self.driven]

    def index(self, stop: int) -> int:
        """Index of the pose of a stop."""
        return (stop - 1) % self.poses

    def lose_place(self) -> None:
        """Forget where the arm stood: something else has moved it."""
        self.standing, self.stood_at = False, None

    def arrive(self, index: int, *, driven_from: int | None = None) -> None:
        """Stand at a pose; `driven_from` is the index where its planned move began."""
        self.stood_at, self.standing = index, True
        if driven_from is not None:
            self.driven.add(driven_from)

    def redo(self, stop: int) -> None:
        """Put a stop that was taken in front of the others."""
        self.todo.insert(0, stop)
        self.skipped.discard(self.index(stop))

    def skip(self) -> list[int]:
        """Leave out the next pose, and the return to it; return the dropped stops."""
        index = self.index(self.todo[0])
        dropped = [stop for stop in self.todo if self.index(stop) == index]
        self.todo = [stop for stop in self.todo if stop not in dropped]
        self.skipped.add(index)
        return dropped


class _OperatorStop(Exception):
    """The operator paused, stopped, sent the arm back or answered no; the tour holds until the operator decides."""

    def __init__(self, words: str, *, for_good: bool = False) -> None:
        super().__init__(words)
        self.for_good = for_good


class _Turned(Exception):
    """The operator wants another pose than the one under way: the next, or the last one again."""

    def __init__(self, key: Key) -> None:
        super().__init__(key.name)
        self.key = key


class GuardedCell:
    """A cell under control with its guards, and what leads from a stop back to motion.

    Of the guards, `contact` accepts the zero of a reopened sensor, and `load` judges every sample of a pose. `recheck`
    repeats the checks, with True the safety questions too; it raises if the arm may not go on.
    """

    def __init__(
        self,
        cell: OpenCell,
        watcher: Watcher,
        *,
        contact: ContactGuard,
        load: RangeGuard,
        recheck: Callable[[bool], None],
    ) -> None:
        self.cell, self.watcher, self.load = cell, watcher, load
        self._contact, self._recheck = contact, recheck
        self._sensor_events = SensorEvents(cell.sensor, cell.journal.show)
        self._cause: Tripped | None = None  # why the arm is held
        self._answered: Tripped | None = None  # last stop of row 11 whose questions were answered

    def show_new(self) -> None:
        """Show new events of the sensor."""
        self._sensor_events.show_new()

    def cause(self, error: Exception, *, moving: bool) -> Tripped | None:
        """Return the trip behind an error: that of a guard, or the row of the table that the error belongs to."""
        self.watcher.unseen = False
        self._cause = self._row_of(error, moving=moving)
        if self._cause is not None:
            self.watcher.keep(self._cause)
        return self._cause

    def require_answers(self) -> None:
        """Raise a stop of row 11, however short, until its questions are answered."""
        self.watcher.look_aside()
        stop = self.watcher.safety_stop
        if stop is not None and stop is not self._answered:
            raise stop

    def reopen(self) -> None:
        """Raise unless the cause is gone. Only the operator clears a stop of the safety system."""
        self.watcher.look_aside()
        unseen = self.watcher.unseen
        try:
            self.cell.arm.open(control=True)
        except DeviceError:
            with suppress(DeviceError):
                self.cell.arm.open()  # to see an emergency stop that is pressed meanwhile
            raise
        try:
            self.cell.sensor.check()
        except DeviceError:
            self._sensor_events.show_new()
            self.cell.sensor.close()
            self.cell.sensor.open()
            self._contact.forget()
            self._sensor_events = SensorEvents(self.cell.sensor, self.cell.journal.show)
        stop = self.watcher.safety_stop
        if stop is not None and stop not in {self._answered, self._cause}:  # pressed while the arm was already held
            self._cause = stop
            self.cell.journal.show(GuardTripped(hazard=stop.hazard, words=str(stop)))
        elif unseen:
            words = "the arm was out of sight: its emergency stop may have been pressed meanwhile"
            self.cell.note(words, warning=True)
        self._recheck(unseen or stop is not self._answered)
        self._answered = stop
        self.watcher.begin()
        q = self.cell.arm.state().q_rad
        with self.watcher.watching(q, q, moving=False):  # raises if the cause is still there
            self.watcher.clock.sleep(_LOOK_AGAIN_S)
        self.require_answers()

    def _row_of(self, error: Exception, *, moving: bool) -> Tripped | None:
        if isinstance(error, Tripped):
            return error
        if isinstance(error, SupervisorGone):
            return Tripped(Hazard.SUPERVISOR_GONE, error)
        if isinstance(error, OSError) and not isinstance(error, DeviceError):
            return Tripped(Hazard.DISK_FULL, error)
        if not isinstance(error, DeviceError):
            return None
        if (trip := self.watcher.tripped(wait_s=0.3)) is not None:
            reported = error.__cause__
            if trip.hazard is Hazard.OTHER_CLIENT and isinstance(reported, DeviceFault):
                # A guard sees only that the program has ended; the arm may know why.
                return Tripped(trip.hazard, type(reported)(reported.found, reported.fix))
            return trip
        try:
            self.cell.sensor.check()
        except DeviceError:
            return Tripped(Hazard.SENSOR_LOST, error)
        try:
            status = self.cell.arm.status()
        except DeviceError:
            return arm_lost(error, moving=moving)
        if status.fault is not None:
            return by_safety(status, str(error))
        return Tripped(Hazard.OTHER_CLIENT if isinstance(error, DeviceFault) else Hazard.CONTROLLER_LOST, error)


class Tour:
    """Takes the arm along a plan; the book keeps every pose.

    `driven` has the speeds and the sampling of this session, `quiet_std` (6,) the standard deviation of the samples of
    the resting sensor.
    """

    def __init__(
        self, guarded: GuardedCell, driven: Before, quiet_std: Array, book: PoseBook, options: SessionOptions
    ) -> None:
        self._guarded, self._watcher = guarded, guarded.watcher
        self._arm, self._sensor, self._journal = guarded.cell.arm, guarded.cell.sensor, guarded.cell.journal
        self._note = guarded.cell.note
        self._plan, self._certifier, self._config = driven.plan, driven.certifier, driven.config
        # Whether `--yes` may answer: the plan has run to its end on this arm, or the cell is emulated.
        self._trusted = driven.known
        self._quiet_std, self._book, self._options = quiet_std, book, options
        self._nodes = driven.plan.nodes_rad
        self._now = Progress(len(self._nodes))
        # A load that is to hang from the tool, and is not on it yet.
        self._to_hang = None if driven.certifier.arm.hung is None else driven.load

    def run(self, todo: Sequence[int]) -> None:
        """Take the poses of these stops, counted from 1; the return to the first pose is the last.

        Raises
        ------
        Declined
            The operator ended it, or no operator answered.
        Tripped, DeviceError, OSError, SupervisorGone
            What stopped the arm, if the operator then ended the tour.
        """
        self._now.todo = list(todo)
        self._watcher.begin()
        while self._now.todo:
            try:
                self._next()
            except _Turned as turned:
                self._turn(turned.key)
            except (Tripped, DeviceError, OSError, _OperatorStop, TooFewSamples, NotAccepted, SupervisorGone) as error:
                self._hold(error)
        self._guarded.show_new()
        self._show_state(State.CLOSE)

    @property
    def _begin_words(self) -> str:
        return f"The arm stands at the first pose. The tour has {self._now.stops} stops. Begin?"

    @property
    def undriven(self) -> list[int]:
        """As `Progress.undriven`."""
        return self._now.undriven

    def _next(self) -> None:
        if self._now.back is not None:
            self._go_back(*self._now.back)
        self._now.under_way = None
        self._obey_keys()
        stop = self._now.todo[0]
        index = self._now.index(stop)
        if self._options.mode == "step" and not self._step(stop, index):
            return
        self._now.under_way = stop
        self._go(index, stop)
        self._obey_keys()
        if (load := self._to_hang) is not None:
            words = f"Pose {stop}: hang {load} now, and let it hang still. Its string must be free. Go on?"
            self._confirm(words, by_operator=self._options.real)
            self._to_hang = None
        self._take(stop, index)
        del self._now.todo[0]

    def _compare_payload(self) -> None:
        """Row 7: show the mass on the sensor, and whether the configured payload differs; once for each payload."""
        mass_kg = self._book.judge.weighed_kg
        if mass_kg is None:
            return
        status = self._arm.status()
        payload_kg, com_m = status.payload_kg, status.p_flange_payload_m
        if payload_kg is None or payload_kg == self._now.payload_kg:
            return
        self._now.payload_kg = payload_kg
        self._journal.show(Weighed(mass_kg=mass_kg, payload_kg=payload_kg, p_flange_payload_m=com_m))
        for finding in described_cell.payload(payload_kg, mass_kg, self._config.sensor.mass_kg):
            self._note(finding.words, warning=True)

    def _step(self, stop: int, index: int) -> bool:
        """Ask for Enter; return whether to move."""
        answer = self._journal.ask(
            Question(
                f"Pose {stop} of {self._now.stops}, orientation {self._plan.steps[index].number:02d}: "
                f"{self._way(index)}, s skips it, r retakes the last pose, q ends",
                ("", "s", "r", "q"),
            )
        )
        if answer == "q":
            raise Declined("ended by the operator between two poses")
        if answer == "s":
            self._skip()
        elif answer == "r" and self._redoable():
            self._redo()
        return answer == ""

    def _way(self, index: int) -> str:
        """Describe what Enter does in step mode."""
        turn_rad = np.abs(self._nodes[index] - self._arm.state().q_rad)
        moving = [str(joint + 1) for joint in np.flatnonzero(turn_rad > _AT_RAD)]
        if not moving:
            return "the arm stands there, Enter measures"
        joints = f"joint{'s' if len(moving) > 1 else ''} {', '.join(moving)}"
        largest = f"largest turn {np.degrees(turn_rad.max()):.0f}°"
        speed_rad_s = self._own_speed(index)
        if speed_rad_s is None:
            drives = ", and drives it where --yes may confirm it" if self._trusted and self._options.yes else ""
            return f"Enter plans the approach and shows it{drives}, {joints}, {largest}"
        return f"Enter moves {joints}, {largest}, at {np.degrees(speed_rad_s):.0f} °/s"

    def _obey_keys(self) -> None:
        """Obey the keys pressed: r refers to the last pose taken, s to the one under way, as on the screen.

        Every key stops an arm in motion; what it means is done after the stop. Called between two looks, so before
        another pose is shown.
        """
        while (key := self._journal.pressed()) is not None:
            if key is Key.STOP:
                raise _OperatorStop(f"stopped by {self._journal.pressed_by}", for_good=True)
            if key is Key.SKIP and self._now.under_way is not None:
                raise _Turned(key)
            if key is Key.REDO and self._redoable():
                raise _Turned(key)
            if key is Key.PAUSE or self._now.moving:
                raise _OperatorStop("paused by the operator" if key is Key.PAUSE else "stopped by a key")
            if key is Key.KEEP:
                self._note("every pose is saved without a key; press r to take it again")
            if key is Key.SKIP:
                self._note("no pose in progress: nothing to skip")

    def _turn(self, key: Key) -> None:
        if not self._now.standing:
            self._arm.stop()
        if key is Key.REDO:
            self._redo()
        else:
            self._skip()

    def _redoable(self) -> bool:
        """Whether r can take the last pose again; a note says why it cannot."""
        last = self._now.taken_last
        if last is None:
            self._note("r takes the last pose again: there is no pose yet")
        elif self._now.todo[0] == last:
            self._note(f"pose {last} is being taken again already")
        return last is not None and self._now.todo[0] != last

    def _redo(self) -> None:
        stop = self._now.taken_last
        if stop is None:
            return
        self._book.judge.remove(stop)
        self._now.redo(stop)
        self._note(f"pose {stop} is taken again")

    def _skip(self) -> None:
        """Drop the pose, and the return to it. A pose that was to be taken again keeps its earlier samples."""
        dropped = self._now.skip()
        names = {stop: "the return to pose 1" if stop == self._now.stops else f"pose {stop}" for stop in dropped}
        stay = set(dropped).intersection(self._book.run.stops())
        for record in self._book.run.records() if stay else ():
            if record.stop in stay:
                self._journal.show(self._book.judge.add(record))
                self._note(f"{names[record.stop]} stays as it was measured", warning=True)
        if left := [name for stop, name in names.items() if stop not in stay]:
            way = f"the arm goes on to pose {self._now.todo[0]}" if self._now.todo else "it was the last"
            self._note(f"skipped: {' and '.join(left)}, {way}; --resume takes skipped poses", warning=True)

    def _take(self, stop: int, index: int) -> None:
        step, sampling, clock = self._plan.steps[index], self._config.sampling, self._watcher.clock
        pose = TourPose(step.number, np.array(step.q_rad))
        began_s, settled_s = clock.now_s(), 0.0

        def on_stage(stage: Stage) -> None:
            nonlocal settled_s
            settled_s = clock.now_s() - began_s
            self._show_state(State.SETTLE if stage == "settle" else State.SAMPLE, stop)

        with self._watcher.watching(pose.q_rad, pose.q_rad, moving=False):
            record = take_pose(
                self._arm,
                self._sensor,
                stop,
                pose,
                sampling,
                guard=self._between_looks,
                on_stage=on_stage,
                quiet_std=self._quiet_std,
                most_swing_N=None if self._options.load is None else self._options.load.most_swing_N,
            )
        self._guarded.load.judge(record.samples.wrench)
        judged = self._book.keep(record, stops=self._now.stops, settle_s=settled_s, average_s=sampling.average_s)
        self._guarded.show_new()
        self._journal.show(judged)
        self._now.taken_last = stop
        self._compare_payload()

    def _go(self, index: int, stop: int) -> None:
        """Move the arm to a pose of the plan, along certified moves only."""
        at, speed_rad_s, driven_from = self._now.at, self._own_speed(index), None
        if index == at:
            return
        if at is None or speed_rad_s is None:
            self._approach(self._arm.state().q_rad, index, stop)
        else:
            self._show_state(State.MOVE, stop)
            self._move(self._nodes[at], self._nodes[index], speed_rad_s, self._plan.acceleration_rad_s2)
            driven_from = at if index == (at + 1) % len(self._nodes) else None
        self._now.arrive(index, driven_from=driven_from)

    def _go_back(self, index: int, why: str) -> None:
        """Return to the previous pose, then raise `OperatorStop`: the operator decides again."""
        self._now.back, self._now.under_way = None, self._now.todo[0]
        self._approach(self._arm.state().q_rad, index, index + 1, back=True)
        self._now.arrive(index)
        raise _OperatorStop(f"back at pose {index + 1}; what stopped the arm: {why}")

    def _own_speed(self, index: int) -> float | None:
        """Speed of the plan's move from where the arm stands to a pose, rad/s; None if the plan has no such move."""
        at, n = self._now.at, len(self._nodes)
        if at is None or (index - at) % n not in {1, n - 1}:
            return None
        return self._plan.steps[at if (index - at) % n == 1 else index].speed_rad_s

    def _approach(self, q: Array, index: int, stop: int, *, back: bool = False) -> None:
        # The only moves that are not in the plan, so they are proven, shown and confirmed by themselves.
        certifier = self._certifier if self._to_hang is None else self._certifier.without_load
        approach = plan_approach(certifier, q, self._nodes[index], SLOW)
        if not len(approach.q_rad):
            return
        way = approach.way_rad
        if words := forbidden(self._arm, way):
            raise PlanRefused(words)
        passed = self._passed(way, index)
        most_rad_s = BACK_RAD_S if back else APPROACH_RAD_S
        words = (
            f"{'back ' if back else ''}to pose {stop}, at most {np.degrees(most_rad_s):.0f} °/s: "
            f"{way_in_words(way, approach.clearance_m)}"
        )
        if passed:
            words += f"; it passes close to the skipped pose {' and '.join(passed)} and does not stop there"
        self._show_state(State.APPROACH, stop, words)
        self._confirm(f"Approach {words}.", by_operator=back or bool(passed) or arm_moves(way))
        for goal, speed in zip(approach.q_rad, approach.speed_rad_s, strict=True):
            self._move(q, goal, min(float(speed), most_rad_s), SLOW.joint_rad_s2)
            q = goal
        if stop == 1 and not back and self._to_hang is None:
            self._confirm(self._begin_words)

    def _passed(self, way: Array, goal: int) -> list[str]:
        """Return the skipped poses that an approach (k, 6) to another pose comes close to."""
        share = np.linspace(0.0, 1.0, 181)[:, None]
        points = np.concatenate([start + share * (end - start) for start, end in pairwise(way)])
        return [
            str(index + 1)
            for index in sorted(self._now.skipped - {goal})
            if np.abs(points - self._nodes[index]).max(axis=1).min() < _NEAR_RAD
        ]

    def _confirm(self, text: str, *, by_operator: bool = False) -> None:
        """Ask before a motion; the first motion needs a typed word."""
        if not self._options.questions:
            return
        trusted = self._trusted and not by_operator
        if self._now.confirmed:
            if self._journal.ask(Question(text, assumed="yes" if trusted else None)) != "yes":
                raise _OperatorStop(f"not confirmed: {text}")
            return
        assumed = _FIRST_WORD if trusted else None
        question = Question(f"{text} Hand on the emergency stop. Type {_FIRST_WORD}", (_FIRST_WORD,), assumed)
        if self._journal.ask(question) != _FIRST_WORD:
            raise Declined(f"{_FIRST_WORD} was not typed: nothing moves")
        self._now.confirmed = True

    def _move(self, start: Array, goal: Array, speed_rad_s: float, acceleration_rad_s2: float) -> None:
        """Make one certified move, only from where it was certified to begin."""
        self._require_at(start)
        turn = np.abs(goal - start).max()
        duration_s = float(move_duration_s(turn, speed_rad_s, acceleration_rad_s2))
        self._now.standing = False
        with self._watcher.watching(start, goal, moving=True):
            self._arm.move_to(
                goal.tolist(),
                # `StallGuard` sees an arm that stands still.
                timeout_s=(duration_s + 1.5) / SLOWEST_SLIDER,
                guard=self._between_looks,
                speed_rad_s=speed_rad_s,
                acceleration_rad_s2=acceleration_rad_s2,
            )

    def _require_at(self, start: Array) -> None:
        """Raise unless the first motion is confirmed, every question is answered, and the arm stands at `start`."""
        if not self._now.confirmed:
            self._confirm("The arm begins the tour.")
        self._guarded.require_answers()
        off_rad = np.abs(self._arm.state().q_rad - start)
        if off_rad.max() > _AT_RAD:
            self._now.lose_place()
            raise fault(
                Hazard.OTHER_CLIENT,
                f"joint {off_rad.argmax() + 1} is {np.degrees(off_rad.max()):.1f}° from where its move begins: "
                "something else has moved the arm; stop that, then resume",
            )

    def _between_looks(self) -> None:
        self._watcher.check()
        self._obey_keys()

    def _hold(self, error: Exception) -> None:
        """Show why the arm has stopped, and wait for the operator; returns when the tour may go on."""
        # The arm stops first, whatever the cause is.
        self._arm.stop()
        if isinstance(error, _OperatorStop) and error.for_good:
            self._show_state(State.STOP, words=str(error))
            raise Declined(str(error))
        trip = self._guarded.cause(error, moving=not self._now.standing)
        if trip is not None and trip.hazard == Hazard.SUPERVISOR_GONE:
            self._show_state(State.STOP, words=str(trip))
            raise trip.error
        if trip is not None and self._reopened_sensor(trip):
            return
        back = self._now.came_from
        self._now.standing = False
        words = str(error if trip is None else trip)
        reported, report_error = self._watcher.tripped(wait_s=0.0), self._watcher.report_error
        if trip is not None and (trip is not reported or report_error is not None):
            self._journal.show(GuardTripped(hazard=trip.hazard, words=words))
        if report_error is not None:
            self._note(f"{reported} (reported late, {report_error!r}: check screen, pipe and disk)", warning=True)
        self._show_state(State.STOP, words=words)
        self._guarded.show_new()
        self._show_state(State.HOLD, words=words)
        by_operator = isinstance(error, _OperatorStop)
        end = Declined(words) if by_operator else error if trip is None else trip.error
        if trip is not None and trip.error is not error and trip is not error and trip.error.__cause__ is None:
            end.__cause__ = error  # which a guard may have overtaken: an arm that fails ends its own program
        question = self._how_to_go_on(back, "" if by_operator else " after fixing the cause")
        while True:
            answer = self._choose(question, end)
            try:
                self._guarded.reopen()
            except (Tripped, DeviceError, NotAccepted, Declined) as again:
                self._note(f"not yet: {again}", warning=True)
                continue
            if answer == "skip":
                self._skip()
            if answer == "back" and back is not None:
                self._now.back = (back, words)
            return

    def _how_to_go_on(self, back: int | None, fixed: str) -> Question:
        """Return the question in a hold; `back` is the index of the pose to which the arm can return."""
        kept, ways, later = self._choices(fixed)
        if back is not None:
            ways["back"] = f"return to pose {back + 1} at {np.degrees(BACK_RAD_S):.0f} °/s"
        ways["quit"] = later
        choices = ". ".join(f"{answer}: {effect}" for answer, effect in ways.items())
        return Question(f"{kept} {choices}", tuple(ways))

    def _choices(self, fixed: str) -> tuple[str, dict[str, str], str]:
        """Return what is kept, the ways on with their effects, and the effect of quitting."""
        stop = self._now.todo[0]
        ways = {"resume": f"go on with pose {stop}{fixed}", "skip": f"leave pose {stop} out"}
        return f"{len(self._book.run.stops())} poses are saved.", ways, "stop; continue later with --resume"

    def _choose(self, question: Question, end: Exception) -> str:
        """Ask how to go on; raise `end`, the first cause, if the operator quits or does not answer."""
        try:
            answer = self._journal.ask(question)
        except SupervisorGone as gone:
            raise (gone if isinstance(end, Declined) else end) from gone
        except Declined:
            raise end from end.__cause__
        if answer == "quit":
            raise end
        return answer

    def _reopened_sensor(self, trip: Tripped) -> bool:
        """Reopen a sensor that failed while the arm stood at a pose, once for each pose; the pose is restarted."""
        stop = self._now.todo[0]
        if trip.hazard != Hazard.SENSOR_LOST or not self._now.standing or stop in self._now.reopened:
            return False
        self._now.reopened.add(stop)
        try:
            self._guarded.reopen()
        except (Tripped, DeviceError, NotAccepted, Declined) as error:
            log.info("the sensor cannot be reopened: %s", error)
            return False
        self._note(f"{trip}; the sensor was reopened, pose {stop} restarts", warning=True)
        return True

    def _show_state(self, state: State, stop: int | None = None, words: str = "") -> None:
        number = None if stop is None or self._plan.sweep else self._plan.steps[self._now.index(stop)].number
        self._journal.show(StateChanged(state=state, stop=stop, stops=self._now.stops, number=number, words=words))
