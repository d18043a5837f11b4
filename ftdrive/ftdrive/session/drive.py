"""Motion of the arm between the poses of a plan, by certified moves only. After an error the arm stops and holds.

The arm moves along the plan from one pose to the next or back, or along an approach that is planned from its present
posture, shown and confirmed. `GuardedCell` recovers from a stop: it finds the cause, and checks whether it is gone.
"""

import logging
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Final

import numpy as np

from ftcalib.errors import TooFewSamples
from ftcalib.model import Array
from ftdrive.checks.arm import SLOWEST_SLIDER
from ftdrive.errors import Declined, NotAccepted, PlanRefused, SupervisorGone
from ftdrive.planning.approach import plan_approach
from ftdrive.planning.motion import Speeds, arm_moves, move_duration_s
from ftdrive.planning.plan import way_in_words
from ftdrive.session.events import GuardTripped, Hazard, Key, Question, SensorEvents, State, StateChanged
from ftdrive.session.guards import ContactGuard, RangeGuard, Tripped, arm_lost, by_safety, fault
from ftdrive.session.open_session import OpenCell, SessionOptions
from ftdrive.session.preflight import Before, forbidden
from ftdrive.session.watchdog import Watcher
from ftdrivers.errors import DeviceError, DeviceFault

log = logging.getLogger(__name__)

APPROACH_RAD_S: Final = float(np.radians(15))
# Speed of the return to the previous pose, after a stop between two poses.
BACK_RAD_S: Final = float(np.radians(10))
SLOW: Final = Speeds.first_run()
AT_RAD: Final = float(np.radians(0.5))
# An approach that comes closer than this to a skipped posture is reported as passing it.
_NEAR_RAD: Final = float(np.radians(10))
# Time, s, for which the guards watch the resting arm before it moves on after a stop.
_LOOK_AGAIN_S: Final = 0.4
_FIRST_WORD: Final = "MOVE"


@dataclass(slots=True)
class Progress:
    """Progress of a tour.

    Stops are numbered from 1 to `poses + 1`; the last one is the return to the first pose. An index counts the poses of
    the plan from 0.
    """

    poses: int
    todo: list[int] = field(default_factory=list)
    """Numbers of the stops that are still to be taken, in order."""
    stood_at: int | None = None
    """Index of the last pose at which the arm stood; None if something else has moved the arm since."""
    standing: bool = False
    """Whether the arm still stands at the pose `stood_at`."""
    under_way: int | None = None
    """Number of the stop to which the arm moves, or at which it measures; None otherwise."""
    back: tuple[int, str] | None = None
    """Index of the pose to which the arm must return, and the cause of its stop on the way; None for no return."""
    confirmed: bool = False
    """Whether the operator has typed the word that starts the first motion."""
    taken_last: int | None = None
    """Number of the stop at which the last pose was taken; None before the first."""
    skipped: set[int] = field(default_factory=set)
    """Indices of the skipped poses, whose postures the arm should avoid."""
    reopened: set[int] = field(default_factory=set)
    """Numbers of the stops at which a failed sensor was reopened."""
    driven: set[int] = field(default_factory=set)
    """Indices of poses from which the arm has completed the planned move to the next pose."""
    payload_kg: float | None = None
    """Payload set in the controller when it was last compared with the identified mass, kg; None before that."""

    @property
    def stops(self) -> int:
        """Number of stops, including the return to the first pose."""
        return self.poses + 1

    @property
    def at(self) -> int | None:
        """Index of the pose at which the arm stands; None between poses."""
        return self.stood_at if self.standing else None

    @property
    def moving(self) -> bool:
        """Whether the arm is moving to a stop."""
        return self.under_way is not None and not self.standing

    @property
    def came_from(self) -> int | None:
        """Index of the pose to which the arm can return after a stop between two poses; None if there is none."""
        gone = {self.index(self.todo[0]), *self.skipped}
        return None if self.standing or self.stood_at in gone else self.stood_at

    @property
    def undriven(self) -> list[int]:
        """Numbers, from 1, of the poses from which the planned move to the next pose has not been completed."""
        return [index + 1 for index in range(self.poses) if index not in self.driven]

    def index(self, stop: int) -> int:
        """Return the index, from 0, of the pose at a stop, whose number counts from 1."""
        return (stop - 1) % self.poses

    def lose_place(self) -> None:
        """Forget where the arm stood, because something else has moved it."""
        self.standing, self.stood_at = False, None

    def arrive(self, index: int, *, driven_from: int | None = None) -> None:
        """Note that the arm stands at a pose; `driven_from` is the index of the pose where the planned move began."""
        self.stood_at, self.standing = index, True
        if driven_from is not None:
            self.driven.add(driven_from)

    def redo(self, stop: int) -> None:
        """Put a stop that was already taken at the front of the remaining stops."""
        self.todo.insert(0, stop)
        self.skipped.discard(self.index(stop))

    def skip(self) -> list[int]:
        """Leave out the next pose and any return to it; return the numbers of the skipped stops."""
        index = self.index(self.todo[0])
        dropped = [stop for stop in self.todo if self.index(stop) == index]
        self.todo = [stop for stop in self.todo if stop not in dropped]
        self.skipped.add(index)
        return dropped


class _OperatorStop(Exception):
    """Raised when the operator presses a key that stops the arm, or does not confirm a motion; the arm then holds."""

    def __init__(self, words: str, *, for_good: bool = False) -> None:
        super().__init__(words)
        self.for_good = for_good


STOPS: Final = (Tripped, DeviceError, OSError, _OperatorStop, TooFewSamples, NotAccepted, SupervisorGone)
"""Errors after which the arm stops and holds until the operator decides."""


class GuardedCell:
    """A cell under control with its guards, and the recovery from a stop.

    The guard `contact` must accept the new zero of a reopened sensor; the guard `load` judges every sample of a pose.
    `recheck` repeats the checks, and if called with True also the safety questions; it raises if the arm may not go on.
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
        self._cause: Tripped | None = None  # why the arm holds
        self._answered: Tripped | None = None  # last emergency or safeguard stop after which the operator answered

    def show_new(self) -> None:
        """Show the events of the sensor, such as a reconnection, that were not shown yet."""
        self._sensor_events.show_new()

    def cause(self, error: Exception, *, moving: bool) -> Tripped | None:
        """Return the trip of the guard that caused an error, or a new one for its hazard; None if no hazard fits."""
        self.watcher.unseen = False
        self._cause = self._row_of(error, moving=moving)
        if self._cause is not None:
            self.watcher.keep(self._cause)
        return self._cause

    def require_answers(self) -> None:
        """Raise the last emergency or safeguard stop unless the safety questions were answered after it."""
        self.watcher.look_aside()
        stop = self.watcher.safety_stop
        if stop is not None and stop is not self._answered:
            raise stop

    def reopen(self) -> None:
        """Reopen arm and sensor after a stop; raise if its cause persists. Only the operator clears a safety stop."""
        self.watcher.look_aside()
        unseen = self.watcher.unseen
        try:
            self.cell.arm.open(control=True)
        except DeviceError:
            with suppress(DeviceError):
                self.cell.arm.open()  # a new connection shows an emergency stop that was pressed meanwhile
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
        if stop is not None and stop not in {self._answered, self._cause}:  # the safety system stopped a holding arm
            self._cause = stop
            self.cell.journal.show(GuardTripped(hazard=stop.hazard, words=str(stop)))
        elif unseen:
            words = "no status of the arm for a while: its emergency stop may have been pressed meanwhile"
            self.cell.note(words, warning=True)
        self._recheck(unseen or stop is not self._answered)
        self._answered = stop
        self.watcher.begin()
        q = self.cell.arm.state().q_rad
        with self.watcher.watching(q, q, moving=False):  # a cause that persists trips a guard here
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
                # A guard sees only that the program has ended; the driver of the arm may know why.
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


class Drive:
    """Moves the arm between the poses of a plan under the guards: only certified moves and confirmed approaches.

    Parameters
    ----------
    guarded : GuardedCell
    driven : Before
        The plan, with the speeds of this session.
    options : SessionOptions
    numbers : sequence of int or None
        Number of the orientation of each pose, for events.
    obey : callable
        Handles a key that neither pauses nor stops: returns a note for the operator, or raises.
    """

    def __init__(
        self,
        guarded: GuardedCell,
        driven: Before,
        options: SessionOptions,
        numbers: Sequence[int | None],
        obey: Callable[[Key], str],
    ) -> None:
        self.guarded, self.watcher = guarded, guarded.watcher
        self.arm, self.sensor, self.journal = guarded.cell.arm, guarded.cell.sensor, guarded.cell.journal
        self.note = guarded.cell.note
        self.certifier = driven.certifier
        """Certifier for the current tool, with or without its hanging load; it plans the approaches."""
        # Whether `--yes` may answer: this arm has completed the plan before, or the cell is emulated.
        self.trusted = driven.known
        self.nodes_rad = driven.plan.nodes_rad
        self.now = Progress(len(self.nodes_rad))
        self._options, self._numbers, self._obey = options, numbers, obey

    def obey_keys(self) -> None:
        """Obey the pressed keys: r retakes the last pose taken, s skips the pose in progress, as the screen shows.

        Every key stops a moving arm and takes effect after the stop. Keys are read before the screen shows another
        pose.
        """
        while (key := self.journal.pressed()) is not None:
            if key is Key.STOP:
                raise _OperatorStop(f"stopped by {self.journal.pressed_by}", for_good=True)
            note = self._obey(key)
            if key is Key.PAUSE or self.now.moving:
                raise _OperatorStop("paused by the operator" if key is Key.PAUSE else "stopped by a key")
            if note:
                self.note(note)

    def approach(self, index: int, stop: int, *, back: bool = False) -> bool:
        """Move the arm from its posture to a pose by moves outside the plan; return False if the arm is already there.

        These moves are proven clear, shown and confirmed separately.
        """
        q = self.arm.state().q_rad
        approach = plan_approach(self.certifier, q, self.nodes_rad[index], SLOW)
        if not len(approach.q_rad):
            return False
        way = approach.way_rad
        if words := forbidden(self.arm, way):
            raise PlanRefused(words)
        passed = self._passed(way, index)
        most_rad_s = BACK_RAD_S if back else APPROACH_RAD_S
        words = (
            f"{'back ' if back else ''}to pose {stop}, at most {np.degrees(most_rad_s):.0f} °/s: "
            f"{way_in_words(way, approach.clearance_m)}"
        )
        if passed:
            words += f"; it passes close to the skipped pose {' and '.join(passed)} without stopping there"
        self.show_state(State.APPROACH, stop, words)
        self.confirm(f"Approach {words}.", by_operator=back or bool(passed) or arm_moves(way))
        for goal, speed in zip(approach.q_rad, approach.speed_rad_s, strict=True):
            self.move(q, goal, min(float(speed), most_rad_s), SLOW.joint_rad_s2)
            q = goal
        return True

    def go_back(self, index: int, why: str) -> None:
        """Return to the previous pose, then hold until the operator decides again."""
        self.now.back, self.now.under_way = None, self.now.todo[0]
        self.approach(index, index + 1, back=True)
        self.now.arrive(index)
        raise _OperatorStop(f"back at pose {index + 1}; cause of the stop: {why}")

    def _passed(self, way: Array, goal: int) -> list[str]:
        """Return the numbers of the skipped poses that an approach through postures (k, 6) passes closely."""
        share = np.linspace(0.0, 1.0, 181)[:, None]
        points = np.concatenate([start + share * (end - start) for start, end in pairwise(way)])
        return [
            str(index + 1)
            for index in sorted(self.now.skipped - {goal})
            if np.abs(points - self.nodes_rad[index]).max(axis=1).min() < _NEAR_RAD
        ]

    def confirm(self, text: str, *, by_operator: bool = False) -> None:
        """Ask before a motion; the first motion needs a typed word. `by_operator` excludes an answer by `--yes`."""
        if not self._options.questions:
            return
        trusted = self.trusted and not by_operator
        if self.now.confirmed:
            if self.journal.ask(Question(text, assumed="yes" if trusted else None)) != "yes":
                raise _OperatorStop(f"not confirmed: {text}")
            return
        assumed = _FIRST_WORD if trusted else None
        question = Question(f"{text} Hand on the emergency stop. Type {_FIRST_WORD}", (_FIRST_WORD,), assumed)
        if self.journal.ask(question) != _FIRST_WORD:
            raise Declined(f"{_FIRST_WORD} was not typed: nothing moves")
        self.now.confirmed = True

    def move(self, start: Array, goal: Array, speed_rad_s: float, acceleration_rad_s2: float) -> None:
        """Make one certified move; raises unless the arm stands at its start."""
        self.require_at(start)
        turn = np.abs(goal - start).max()
        duration_s = float(move_duration_s(turn, speed_rad_s, acceleration_rad_s2))
        self.now.standing = False
        with self.watcher.watching(start, goal, moving=True):
            self.arm.move_to(
                goal.tolist(),
                # `StallGuard` detects a stalled arm much earlier.
                timeout_s=(duration_s + 1.5) / SLOWEST_SLIDER,
                guard=self.between_looks,
                speed_rad_s=speed_rad_s,
                acceleration_rad_s2=acceleration_rad_s2,
            )

    def require_at(self, start: Array) -> None:
        """Raise unless the first motion is confirmed, the safety questions are answered, and the arm is at `start`."""
        if not self.now.confirmed:
            self.confirm("The arm starts the tour.")
        self.guarded.require_answers()
        off_rad = np.abs(self.arm.state().q_rad - start)
        if off_rad.max() > AT_RAD:
            self.now.lose_place()
            raise fault(
                Hazard.OTHER_CLIENT,
                f"joint {off_rad.argmax() + 1} is {np.degrees(off_rad.max()):.1f}° off the start of the next move: "
                "stop whatever else moved the arm, then resume",
            )

    def between_looks(self) -> None:
        """Raise the trip of a guard, or the exception for a pressed key."""
        self.watcher.check()
        self.obey_keys()

    def hold(self, error: Exception, choices: Callable[[int | None, str], tuple[str, Mapping[str, str]]]) -> str:
        """Stop the arm, show the cause, and ask the operator; return the answer when the arm may go on.

        `choices` is called with the index of the pose to which the arm can return, and with a description of the cause.
        It returns a sentence about the saved data, and the effect of each possible answer.
        """
        # First of all, stop the arm.
        self.arm.stop()
        if isinstance(error, _OperatorStop) and error.for_good:
            self.show_state(State.STOP, words=str(error))
            raise Declined(str(error))
        trip = self.guarded.cause(error, moving=not self.now.standing)
        if trip is not None and trip.hazard == Hazard.SUPERVISOR_GONE:
            self.show_state(State.STOP, words=str(trip))
            raise trip.error
        if trip is not None and self._reopened_sensor(trip):
            return "resume"
        back = self.now.came_from
        self.now.standing = False
        words = str(error if trip is None else trip)
        reported, report_error = self.watcher.tripped(wait_s=0.0), self.watcher.report_error
        if trip is not None and (trip is not reported or report_error is not None):
            self.journal.show(GuardTripped(hazard=trip.hazard, words=words))
        if report_error is not None:
            self.note(f"{reported} (reported late, {report_error!r}: check screen, pipe and disk)", warning=True)
        self.show_state(State.STOP, words=words)
        self.guarded.show_new()
        self.show_state(State.HOLD, words=words)
        by_operator = isinstance(error, _OperatorStop)
        end = Declined(words) if by_operator else error if trip is None else trip.error
        if trip is not None and trip.error is not error and trip is not error and trip.error.__cause__ is None:
            end.__cause__ = error  # a guard may have tripped first, because a failing arm ends its own program
        kept, ways = choices(back, "" if by_operator else " after fixing the cause")
        effects = ". ".join(f"{answer}: {effect}" for answer, effect in ways.items())
        question = Question(f"{kept} {effects}", tuple(ways))
        while True:
            answer = self._choose(question, end)
            try:
                self.guarded.reopen()
            except (Tripped, DeviceError, NotAccepted, Declined) as again:
                self.note(f"not yet: {again}", warning=True)
                continue
            if answer == "back" and back is not None:
                self.now.back = (back, words)
            return answer

    def _choose(self, question: Question, end: Exception) -> str:
        """Ask how to continue; raise `end`, the original cause, if the operator quits or does not answer."""
        try:
            answer = self.journal.ask(question)
        except SupervisorGone as gone:
            raise (gone if isinstance(end, Declined) else end) from gone
        except Declined:
            raise end from end.__cause__
        if answer == "quit":
            raise end
        return answer

    def _reopened_sensor(self, trip: Tripped) -> bool:
        """Reopen a sensor that failed while the arm stood at a pose, once per pose; return whether that succeeded."""
        stop = self.now.todo[0]
        if trip.hazard != Hazard.SENSOR_LOST or not self.now.standing or stop in self.now.reopened:
            return False
        self.now.reopened.add(stop)
        try:
            self.guarded.reopen()
        except (Tripped, DeviceError, NotAccepted, Declined) as error:
            log.info("the sensor cannot be reopened: %s", error)
            return False
        self.note(f"{trip}; the sensor was reopened, and pose {stop} restarts", warning=True)
        return True

    def show_state(self, state: State, stop: int | None = None, words: str = "") -> None:
        """Show the state of the session, with the number of the stop to which the state refers."""
        number = None if stop is None else self._numbers[self.now.index(stop)]
        self.journal.show(StateChanged(state=state, stop=stop, stops=self.now.stops, number=number, words=words))
