"""The state machine of a tour: (MOVE, SETTLE, SAMPLE) for each pose, CLOSE; anything wrong is STOP, then HOLD.

The arm only ever makes moves that are certified: along the plan from one pose to the next or back, or along an approach
that is planned from where the arm stands, shown and confirmed.
"""

import logging
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Final

import numpy as np
from numpy.typing import NDArray

from calib.errors import TooFewSamples
from calib.routine import PoseRecord, Sampling, Stage, TourPose, take_pose
from drivers.errors import DeviceFault, DriverError
from ftdrive.checks.controller_settings import payload_in_words
from ftdrive.checks.devices import SLOWEST_SLIDER
from ftdrive.errors import Declined, NotAccepted, PlanRefused
from ftdrive.planning.approach import arm_moves, plan_approach
from ftdrive.planning.geometry.certify import Certifier
from ftdrive.planning.motion import Speeds, move_duration_s
from ftdrive.planning.plan import Plan
from ftdrive.planning.show.words import way_in_words
from ftdrive.runs.run import Run
from ftdrive.session.events import (
    GuardTripped,
    Noted,
    PoseTaken,
    State,
    StateChanged,
    Weighed,
)
from ftdrive.session.guards import RangeGuard, Tripped
from ftdrive.session.hazards import Hazard
from ftdrive.session.live_fit import Running
from ftdrive.session.operator import Key, Question
from ftdrive.session.preflight import forbidden
from ftdrive.session.progress import Progress
from ftdrive.session.recovery import GuardedCell, Recovery

log = logging.getLogger(__name__)

Array = NDArray[np.float64]

APPROACH_RAD_S: Final = float(np.radians(15))
BACK_RAD_S: Final = float(np.radians(10))
"""To the pose the arm came from, after it was stopped on its way."""
SLOW: Final = Speeds.first_run()
_AT_RAD: Final = float(np.radians(0.5))
_NEAR_RAD: Final = float(np.radians(10))
"""A way that comes so close to a skipped posture passes it."""
_FIRST_WORD: Final = "MOVE"


class Stopped(Exception):
    """A person had the arm stop, to pause or to end, sent it back or said no, and has to say how it goes on."""

    def __init__(self, words: str, *, for_good: bool = False) -> None:
        super().__init__(words)
        self.for_good = for_good


class Turned(Exception):
    """A person wants another pose than the one under way: the next, or the last one again."""

    def __init__(self, key: Key) -> None:
        super().__init__(key.name)
        self.key = key


@dataclass(frozen=True, slots=True)
class Pace:
    """How much of it a person confirms."""

    step: bool
    """Enter for each pose."""
    trusted: bool
    """This plan has run to its end on this arm, or nothing real moves: `--yes` may answer."""
    asks: bool = True
    yes: bool = False
    """`--yes` answers where it may."""


@dataclass(frozen=True, slots=True, eq=False)
class Measuring:
    """How the sensor is averaged at a pose."""

    sampling: Sampling
    quiet_std: Array
    """(6,) standard deviation of the resting sensor's samples."""
    load: RangeGuard
    """Judges every sample of a pose."""
    sensor_kg: float | None
    """Mass of sensor and adapter; None if unknown. The payload is compared with it."""


class Tour:
    """Takes the arm along one plan.

    Parameters
    ----------
    cell : GuardedCell
    plan : Plan
        With the speeds of this session.
    certifier : Certifier
    run : Run
        Keeps every pose.
    running : Running
    recovery : Recovery
    measuring : Measuring
    pace : Pace
    """

    def __init__(
        self,
        cell: GuardedCell,
        plan: Plan,
        certifier: Certifier,
        run: Run,
        running: Running,
        recovery: Recovery,
        measuring: Measuring,
        pace: Pace,
    ) -> None:
        self._arm, self._sensor, self._journal, self._watcher = cell.arm, cell.sensor, cell.journal, cell.watcher
        self._plan, self._certifier, self._run, self._running = plan, certifier, run, running
        self._recovery, self._measuring, self._pace = recovery, measuring, pace
        self._nodes = np.array([step.q_rad for step in plan.steps])
        self._now = Progress(len(plan.steps))

    # -------------------------------------------------------------------------------------------- the tour

    def run(self, todo: Sequence[int]) -> None:
        """Take the poses of these stops, counted from 1; the return to the first pose is the last.

        Raises
        ------
        Declined
            A person ended it, or nobody was there to decide.
        Tripped, DriverError, OSError
            What stopped the arm, when a person then ended it.
        """
        self._now = replace(self._now, todo=tuple(todo))
        self._watcher.begin()
        while self._now.todo:
            try:
                self._next()
            except Turned as turned:
                self._turn(turned.key)
            except (Tripped, DriverError, OSError, Stopped, TooFewSamples, NotAccepted) as error:
                self._hold(error)
        self._recovery.show_new()
        self._show_state(State.CLOSE)

    @property
    def undriven(self) -> list[int]:
        """As `Progress.undriven`."""
        return self._now.undriven

    def _next(self) -> None:
        if self._now.back is not None:
            self._go_back(*self._now.back)
        self._now = replace(self._now, under_way=None)
        self._hear()
        stop = self._now.todo[0]
        index = self._now.index(stop)
        if self._pace.step and not self._step(stop, index):
            return
        self._now = replace(self._now, under_way=stop)
        self._go(index, stop)
        self._hear()
        self._take(stop, index)
        self._now = replace(self._now, taken_last=stop)
        self._compare_payload()
        self._now = self._now.finish()

    def _compare_payload(self) -> None:
        """Row 7: say what hangs on the sensor, and where the controller was told otherwise; once for each payload."""
        mass_kg = self._running.weighed_kg
        told_kg = None if mass_kg is None else self._arm.status().payload_kg
        if mass_kg is None or told_kg is None or told_kg == self._now.payload_kg:
            return
        self._now = replace(self._now, payload_kg=told_kg)
        self._journal.show(Weighed(mass_kg=mass_kg, payload_kg=told_kg))
        if words := payload_in_words(told_kg, mass_kg, self._measuring.sensor_kg):
            self._note(words, warning=True)

    def _step(self, stop: int, index: int) -> bool:
        """Ask for Enter; whether to go."""
        answer = self._journal.ask(
            Question(
                f"Pose {stop} of {self._now.stops}, orientation {self._plan.steps[index].number:02d}: "
                f"{self._way(index)}, s skips it, r takes the last pose again, q ends",
                ("", "s", "r", "q"),
            )
        )
        if answer == "q":
            raise Declined("ended by a person between two poses")
        if answer == "s":
            self._skip()
        elif answer == "r" and self._redoable() is not None:
            self._redo()
        return answer == ""

    def _way(self, index: int) -> str:
        """Say what Enter does in step mode."""
        turn_rad = np.abs(self._nodes[index] - self._arm.state().q_rad)
        moving = [str(joint + 1) for joint in np.flatnonzero(turn_rad > _AT_RAD)]
        if not moving:
            return "the arm stands there, Enter measures"
        joints = f"joint{'s' if len(moving) > 1 else ''} {', '.join(moving)}"
        largest = f"largest turn {np.degrees(turn_rad.max()):.0f}°"
        speed_rad_s = self._own_speed(index)
        if speed_rad_s is None:
            drives = ", and drives it where --yes may confirm it" if self._pace.trusted and self._pace.yes else ""
            return f"Enter plans the way and shows it{drives}, {joints}, {largest}"
        return f"Enter moves {joints}, {largest}, at {np.degrees(speed_rad_s):.0f}°/s"

    def _hear(self) -> None:
        """Take the keys. Each means what the screen shows: r the pose taken last, s the one under way.

        Called between two looks, so before another pose is shown.
        """
        moving = self._now.moving
        if self._now.again and not moving:
            raise Turned(Key.REDO)
        while (key := self._journal.pressed()) is not None:
            if key is Key.PAUSE:
                raise Stopped("paused by a person")
            if key is Key.STOP:
                raise Stopped("stopped by a person", for_good=True)
            if key is Key.KEEP:
                self._note("a pose is kept by itself; r takes it again")
            if key is Key.SKIP:
                if self._now.under_way is not None:
                    raise Turned(key)
                self._note("s skips a pose while the arm goes there or measures: none is under way")
            if key is Key.REDO and (last := self._redoable()) is not None:
                self._now = replace(self._now, again=True)
                if not moving:
                    raise Turned(key)
                self._note(f"the arm ends its move, then goes back to pose {last}")

    def _turn(self, key: Key) -> None:
        if key is Key.REDO:
            self._redo()
            return
        if not self._now.standing:
            self._arm.stop()
        self._skip()

    def _redoable(self) -> int | None:
        """Stop that r takes again; None, and why, where there is none."""
        last = self._now.taken_last
        if last is None:
            self._note("there is no pose yet to be taken again")
        elif self._now.todo[0] == last:
            self._note(f"pose {last} is being taken again already")
        else:
            return last
        return None

    def _redo(self) -> None:
        stop = self._now.taken_last
        if stop is None:
            return
        self._running.remove(stop)
        self._now = self._now.redo(stop)
        self._note(f"pose {stop} is taken again")

    def _skip(self) -> None:
        """Drop the pose, and the return to it: the arm does not go there. What was to be taken again stays."""
        self._now, dropped = self._now.skip()
        names = {stop: "the return to pose 1" if stop == self._now.stops else f"pose {stop}" for stop in dropped}
        stay = set(dropped).intersection(self._run.stops())
        for record in self._run.records() if stay else ():
            if record.stop in stay:
                self._journal.show(self._running.add(record))
                self._note(f"{names[record.stop]} stays as it was taken", warning=True)
        if left := [name for stop, name in names.items() if stop not in stay]:
            way = f"the arm goes on to pose {self._now.todo[0]}" if self._now.todo else "it was the last"
            self._note(f"skipped: {' and '.join(left)}, {way}; --resume takes what was skipped", warning=True)

    def _take(self, stop: int, index: int) -> PoseRecord:
        step = self._plan.steps[index]
        pose = TourPose(step.number, np.array(step.q_rad))
        clock = self._watcher.clock
        began_s, settled_s, attempts = clock.now_s(), 0.0, 0

        def on_stage(stage: Stage) -> None:
            nonlocal settled_s, attempts
            if stage == "sample":
                settled_s, attempts = clock.now_s() - began_s, attempts + 1
            self._show_state(State.SETTLE if stage == "settle" else State.SAMPLE, stop)

        with self._watcher.watching(pose.q_rad, pose.q_rad, moving=False):
            record = take_pose(
                self._arm,
                self._sensor,
                stop,
                pose,
                self._measuring.sampling,
                guard=self._between_looks,
                on_stage=on_stage,
                quiet_std=self._measuring.quiet_std,
            )
        self._measuring.load.judge(record.samples.wrench)
        self._run.commit(record)
        self._journal.show(
            PoseTaken.of(
                record,
                self._certifier.scene.down_base,
                stops=self._now.stops,
                settle_s=settled_s,
                average_s=self._measuring.sampling.average_s,
                attempts=attempts,
            ),
            sync=True,
        )
        self._recovery.show_new()
        self._journal.show(self._running.add(record))
        return record

    # -------------------------------------------------------------------------------------------- moving

    def _go(self, index: int, stop: int) -> None:
        """Bring the arm to a pose of the plan, over certified moves only."""
        at, speed_rad_s, driven_from = self._now.at, self._own_speed(index), None
        if index == at:
            return
        if at is None or speed_rad_s is None:
            self._approach(self._arm.state().q_rad, index, stop)
        else:
            self._show_state(State.MOVE, stop)
            self._move(self._nodes[at], self._nodes[index], speed_rad_s, self._plan.acceleration_rad_s2)
            driven_from = at if index == (at + 1) % len(self._nodes) else None
        self._now = self._now.arrive(index, driven_from=driven_from)

    def _go_back(self, index: int, why: str) -> None:
        """Return to the pose the arm came from, then raise `Stopped`: a person decides again."""
        self._now = replace(self._now, back=None, under_way=self._now.todo[0])
        self._approach(self._arm.state().q_rad, index, index + 1, back=True)
        self._now = self._now.arrive(index)
        raise Stopped(f"back at pose {index + 1}; what stopped the arm: {why}")

    def _own_speed(self, index: int) -> float | None:
        """Speed of the plan's own move from where the arm was left to a pose, rad/s; None where it has none."""
        at, n = self._now.at, len(self._nodes)
        if at is None or (index - at) % n not in {1, n - 1}:
            return None
        return self._plan.steps[at if (index - at) % n == 1 else index].speed_rad_s

    def _approach(self, q: Array, index: int, stop: int, *, back: bool = False) -> None:
        approach = plan_approach(self._certifier, q, self._nodes[index], SLOW)
        if not len(approach.q_rad):
            return
        way = approach.way_rad
        if words := forbidden(self._arm, way):
            raise PlanRefused(words)
        passed = self._passed(way, index)
        most_rad_s = BACK_RAD_S if back else APPROACH_RAD_S
        words = (
            f"the way {'back ' if back else ''}to pose {stop} at {np.degrees(most_rad_s):.0f}°/s at most: "
            f"{way_in_words(way, approach.clearance_m)}"
        )
        if passed:
            words += f"; it passes close to the skipped pose {' and '.join(passed)} and does not stop there"
        self._show_state(State.APPROACH, stop, words)
        self._confirm(f"The arm goes {words}.", by_person=back or bool(passed) or arm_moves(way))
        for goal, speed in zip(approach.q_rad, approach.speed_rad_s, strict=True):
            self._move(q, goal, min(float(speed), most_rad_s), SLOW.joint_rad_s2)
            q = goal
        if stop == 1 and not back:
            self._confirm(f"The arm stands at the first pose. The tour has {self._now.stops} stops. Begin?")

    def _passed(self, way: Array, goal: int) -> list[str]:
        """Skipped poses that a way (k, 6), which ends at another one, comes close to."""
        share = np.linspace(0.0, 1.0, 181)[:, None]
        points = np.concatenate([start + share * (end - start) for start, end in pairwise(way)])
        return [
            str(index + 1)
            for index in sorted(self._now.skipped - {goal})
            if np.abs(points - self._nodes[index]).max(axis=1).min() < _NEAR_RAD
        ]

    def _confirm(self, text: str, *, by_person: bool = False) -> None:
        """Ask before a motion; the first one of a workcell wants a word."""
        if not self._pace.asks:
            return
        trusted = self._pace.trusted and not by_person
        if self._now.confirmed:
            if self._journal.ask(Question(text, assumed="yes" if trusted else None)) != "yes":
                raise Stopped(f"not confirmed: {text}")
            return
        assumed = _FIRST_WORD if trusted else None
        question = Question(f"{text} Hand on the emergency stop. Type {_FIRST_WORD}", (_FIRST_WORD,), assumed)
        if self._journal.ask(question) != _FIRST_WORD:
            raise Declined("the word was not typed: nothing moves")
        self._now = replace(self._now, confirmed=True)

    def _move(self, start: Array, goal: Array, speed_rad_s: float, acceleration_rad_s2: float) -> None:
        """Make one certified move, from nowhere else than where it was certified to begin."""
        if not self._now.confirmed:
            self._confirm("The arm begins the tour.")
        self._recovery.require_answers()
        off_rad = np.abs(self._arm.state().q_rad - start)
        if off_rad.max() > _AT_RAD:
            self._now = self._now.lose_place()
            raise Tripped(
                Hazard.OTHER_CLIENT,
                DeviceFault(
                    f"joint {off_rad.argmax() + 1} is {np.degrees(off_rad.max()):.1f}° from where its move begins: "
                    "somebody has moved the arm; end that, then go on"
                ),
            )
        turn = np.abs(goal - start).max()
        duration_s = float(move_duration_s(turn, speed_rad_s, acceleration_rad_s2))
        self._now = self._now.start_move()
        with self._watcher.watching(start, goal, moving=True):
            self._arm.move_to(
                goal.tolist(),
                timeout_s=(duration_s + 1.5) / SLOWEST_SLIDER,  # that the arm stands still is seen by its guard
                guard=self._between_looks,
                speed_rad_s=speed_rad_s,
                acceleration_rad_s2=acceleration_rad_s2,
            )

    def _between_looks(self) -> None:
        self._watcher.check()
        self._hear()

    # -------------------------------------------------------------------------------------------- stop and hold

    def _hold(self, error: Exception) -> None:
        """Say why the arm stands, and wait for a person; returns when it may go on. The arm was stopped before."""
        self._arm.stop()
        if isinstance(error, Stopped) and error.for_good:
            self._show_state(State.STOP, words=str(error))
            raise Declined(str(error))
        trip = self._recovery.cause(error, moving=not self._now.standing)
        if trip is not None and self._mended(trip):
            return
        stop, back = self._now.todo[0], self._now.came_from
        self._now = self._now.start_move()
        words = str(error if trip is None else trip).rstrip(".")
        told, untold = self._watcher.tripped(wait_s=0.0), self._watcher.untold
        if trip is not None and (trip is not told or untold is not None):
            self._journal.show(GuardTripped(hazard=trip.hazard, words=words))
        if untold is not None:
            self._note(f"not told at once, for {untold!r}, see to screen, pipe and disk: {told}", warning=True)
        self._show_state(State.STOP, words=words)
        self._recovery.show_new()
        self._show_state(State.HOLD, words=words)
        by_person = isinstance(error, Stopped)
        end = Declined(words) if by_person else error if trip is None else trip.error
        ways = {"resume": f"resume {'to go on' if by_person else 'when it is mended'}"}
        ways["skip"] = f"skip to leave pose {stop} out"
        if back is not None:
            ways["back"] = f"back to return to pose {back + 1} at {np.degrees(BACK_RAD_S):.0f}°/s"
        ways["quit"] = "or quit: --resume goes on later"
        question = Question(f"{len(self._run.stops())} poses are kept. Type {', '.join(ways.values())}", tuple(ways))
        while True:
            try:
                answer = self._journal.ask(question)
            except Declined:
                raise end from error
            if answer == "quit":
                raise end
            try:
                self._recovery.make_sure()
            except (Tripped, DriverError, NotAccepted, Declined) as again:
                self._journal.show(Noted(words=f"not yet: {again}", warning=True))
                continue
            if answer == "skip":
                self._skip()
            if answer == "back" and back is not None:
                self._now = replace(self._now, back=(back, words))
            return

    def _mended(self, trip: Tripped) -> bool:
        """Open a sensor that failed while the arm stood at a pose, once for each pose; the pose begins anew."""
        stop = self._now.todo[0]
        if trip.hazard != Hazard.SENSOR_LOST or not self._now.standing or stop in self._now.reopened:
            return False
        self._now = replace(self._now, reopened=self._now.reopened | {stop})
        try:
            self._recovery.make_sure()
        except (Tripped, DriverError, NotAccepted, Declined) as error:
            log.info("the sensor does not come back: %s", error)
            return False
        self._journal.show(Noted(words=f"{trip}; it is back, pose {stop} begins anew", warning=True))
        return True

    # -------------------------------------------------------------------------------------------- telling

    def _show_state(self, state: State, stop: int | None = None, words: str = "") -> None:
        number = None if stop is None else self._plan.steps[self._now.index(stop)].number
        self._journal.show(StateChanged(state=state, stop=stop, stops=self._now.stops, number=number, words=words))

    def _note(self, words: str, *, warning: bool = False) -> None:
        self._journal.show(Noted(words=words, warning=warning))
