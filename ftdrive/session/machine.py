"""The state machine of a tour: (MOVE, SETTLE, SAMPLE) for each pose, CLOSE; anything wrong is STOP, then HOLD.

The arm only ever makes moves that are certified: along the plan from one pose to the next or back, or along an approach
that is planned from where the arm stands, shown and confirmed.
"""

import logging
import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Final, Protocol

import numpy as np
from numpy.typing import NDArray

from calib.errors import TooFewSamples
from calib.routine import PoseRecord, Sampling, Stage, TourPose, take_pose
from drivers.errors import DeviceFault, DriverError
from drivers.interfaces import ForceTorqueSensor, RobotArm
from ftdrive.errors import Declined, NotAccepted, PlanRefused
from ftdrive.planning.approach import Approach, plan_approach
from ftdrive.planning.certify import Certifier
from ftdrive.planning.motion import Speeds, move_duration_s
from ftdrive.planning.plan import Plan
from ftdrive.planning.words import way_in_words, way_of
from ftdrive.runs import Run
from ftdrive.session.events import (
    Asked,
    Estimated,
    Event,
    GuardTripped,
    Noted,
    PoseTaken,
    RunOpened,
    State,
    StateChanged,
)
from ftdrive.session.guards import ContactGuard, RangeGuard, Tripped, by_safety, out_of_sight
from ftdrive.session.operator import Key, Operator, Question
from ftdrive.session.preflight import forbidden
from ftdrive.session.watch import Guards

log = logging.getLogger(__name__)

Array = NDArray[np.float64]

APPROACH_RAD_S: Final = float(np.radians(15))
SLOW_RAD_S: Final = float(np.radians(30))
SLOW_RAD_S2: Final = float(np.radians(40))
_AT_RAD: Final = float(np.radians(0.5))
_PATIENCE: Final = 20.0
"""A slow slider stretches a move; one that stands still is seen by its guard."""
_FIRST_WORD: Final = "MOVE"
_LOOK_AGAIN_S: Final = 0.4


class RunningFit(Protocol):
    """What a session needs of `ftdrive.session.running.Running`."""

    def add(self, record: PoseRecord) -> Estimated:
        """Take a pose in."""

    def remove(self, stop: int) -> None:
        """Leave a pose out."""

    def predict(self, R_base_flange: Array) -> Array | None:
        """Wrench of a free tool; None while nobody can know."""


class Stopped(Exception):
    """A person stopped the arm with a key."""


class Desk:
    """The person, and the diary: every event goes to both, from any thread, one at a time."""

    def __init__(self, operator: Operator) -> None:
        self._operator = operator
        self._lock = threading.RLock()
        self._run: Run | None = None
        self._early: list[Event] = []

    def keep_in(self, run: Run) -> None:
        """Write what was told so far, and all that follows, into the run."""
        with self._lock:
            self._run = run
            for event in self._early:
                run.append_event(event.to_dict())
            self._early.clear()
        self.tell(RunOpened(folder=str(run.folder), resume=f"ftdrive calibrate --resume {run.folder}"), sync=True)

    def tell(self, event: Event, *, sync: bool = False) -> None:
        """Show and keep an event."""
        with self._lock:
            self._operator.tell(event)
            if self._run is None:
                self._early.append(event)
                return
            try:
                self._run.append_event(event.to_dict(), sync=sync)
            except OSError as error:  # the poses' own files say so where it matters
                log.warning("events.ndjson cannot be written: %s", error)

    def ask(self, question: Question) -> str:
        """Ask, and keep the answer."""
        answer = self._operator.ask(question)
        self.tell(Asked(question=question.text, answer=answer))
        return answer

    def require(self, text: str, *, assumed: bool) -> None:
        """Ask a question that only yes answers; raises `Declined`."""
        if self.ask(Question(text, assumed="yes" if assumed else None)) != "yes":
            raise Declined(f"not confirmed, nothing moves on: {text}")

    def pressed(self) -> Key | None:
        """Take a key."""
        return self._operator.pressed()


@dataclass(frozen=True, slots=True)
class Pace:
    """How fast, and how much of it a person confirms."""

    slow: bool
    step: bool
    """Enter for each pose."""
    trusted: bool
    """This plan has run to its end on this arm, or nothing real moves: `--yes` may answer."""
    asks: bool = True


class Tour:
    """One plan on its way.

    Parameters
    ----------
    contact, load
        The two guards that the tour itself feeds.
    recheck : callable
        Looks at the devices once more after a stop, and raises when they are not ready.
    quiet_std : array, shape (6,)
        Of the resting sensor's samples.
    """

    def __init__(
        self,
        arm: RobotArm,
        sensor: ForceTorqueSensor,
        certifier: Certifier,
        plan: Plan,
        run: Run,
        desk: Desk,
        running: RunningFit,
        guards: Guards,
        *,
        contact: ContactGuard,
        load: RangeGuard,
        sampling: Sampling,
        pace: Pace,
        recheck: Callable[[], None],
        quiet_std: Array,
    ) -> None:
        self._arm, self._sensor, self._certifier = arm, sensor, certifier
        self._plan, self._run, self._desk, self._running, self._guards = plan, run, desk, running, guards
        self._contact, self._load, self._sampling, self._pace = contact, load, sampling, pace
        self._recheck, self._quiet_std = recheck, quiet_std
        self._nodes = np.array([step.q_rad for step in plan.steps])
        self._stops = len(self._nodes) + 1
        self._todo: deque[int] = deque()
        self._at: int | None = None  # index of the pose where the arm was left
        self._moved = False
        self._last: int | None = None  # stop taken last
        self._asked: set[Key] = set()
        self._reopened: set[int] = set()
        self._seen_events = 0

    # -------------------------------------------------------------------------------------------- the tour

    def run(self, todo: Sequence[int], taken: Sequence[PoseRecord]) -> None:
        """Take the poses of these stops, counted from 1; the return to the first pose is the last.

        Raises
        ------
        Declined
            A person ended it, or nobody was there to decide.
        Tripped, DriverError, OSError
            What stopped the arm, when a person then ended it.
        """
        for record in taken:
            self._desk.tell(self._running.add(record))
        self._contact.predict = self._running.predict
        self._todo = deque(todo)
        self._guards.begin()
        while self._todo:
            try:
                self._next()
            except (Tripped, DriverError, OSError, Stopped, TooFewSamples, NotAccepted) as error:
                self._hold(error)
        self._tell_sensor_events()
        self._tell(State.CLOSE)

    def _next(self) -> None:
        self._obey_keys()
        stop = self._todo[0]
        index = (stop - 1) % len(self._nodes)
        if self._pace.step and not self._step(stop):
            return
        self._go(index, stop)
        self._take(stop, index)
        if self._todo and self._todo[0] == stop:
            self._todo.popleft()
        self._last = stop

    def _step(self, stop: int) -> bool:
        """Ask for Enter; whether to go."""
        step = self._plan.steps[(stop - 1) % len(self._nodes)]
        answer = self._desk.ask(
            Question(
                f"Pose {stop} of {self._stops}, orientation {step.number:02d}: Enter moves the arm, s skips it, r "
                "takes the last pose again, q ends",
                ("", "s", "r", "q"),
            )
        )
        if answer == "q":
            raise Declined("ended by a person between two poses")
        if answer == "s":
            self._skip(stop)
        elif answer == "r":
            self._redo()
        return answer == ""

    def _obey_keys(self) -> None:
        while (key := self._desk.pressed()) is not None:
            self._asked.add(key)
        asked, self._asked = self._asked, set()
        if Key.STOP in asked or Key.PAUSE in asked:
            raise Stopped("paused by a person")
        if Key.REDO in asked:
            self._redo()
        elif Key.SKIP in asked:
            self._skip(self._todo[0])

    def _redo(self) -> None:
        if self._last is None:
            self._desk.tell(Noted(words="there is no pose yet to be taken again"))
            return
        self._running.remove(self._last)
        self._todo.appendleft(self._last)
        self._desk.tell(Noted(words=f"pose {self._last} is taken again"))
        self._last = None

    def _skip(self, stop: int) -> None:
        self._desk.tell(Noted(words=f"pose {stop} is skipped; --resume takes it later", warning=True))
        self._go((stop - 1) % len(self._nodes), stop)
        self._todo.popleft()

    def _take(self, stop: int, index: int) -> None:
        step = self._plan.steps[index]
        pose = TourPose(step.number, np.array(step.q_rad))
        began_s, settled_s, attempts = time.monotonic(), 0.0, 0

        def on_stage(stage: Stage) -> None:
            nonlocal settled_s, attempts
            if stage == "sample":
                settled_s, attempts = time.monotonic() - began_s, attempts + 1
            self._tell(State.SETTLE if stage == "settle" else State.SAMPLE, stop)

        with self._guards.watching(pose.q_rad, pose.q_rad, moving=False):
            record = take_pose(
                self._arm,
                self._sensor,
                stop,
                pose,
                self._sampling,
                guard=self._between_looks,
                on_stage=on_stage,
                quiet_std=self._quiet_std,
            )
        self._load.judge(record.samples.wrench)
        self._run.commit(record)
        self._desk.tell(
            PoseTaken(
                stop=stop,
                stops=self._stops,
                number=step.number,
                gravity_flange=record.before.R_base_flange.T @ self._certifier.scene.down_base,
                mean=record.mean.mean,
                sigma=np.sqrt(np.diag(record.mean.covariance)),
                samples=len(record.samples.t_host_ns),
                settle_s=settled_s,
                average_s=self._sampling.average_s,
                attempts=attempts,
                steady=record.steady,
            ),
            sync=True,
        )
        self._tell_sensor_events()
        self._desk.tell(self._running.add(record))

    # -------------------------------------------------------------------------------------------- moving

    def _go(self, index: int, stop: int) -> None:
        """Bring the arm to a pose of the plan, over certified moves only."""
        q = self._arm.state().q_rad
        at = self._at
        if at is not None and np.abs(q - self._nodes[at]).max() > _AT_RAD:
            self._at = None
            raise Tripped(21, DeviceFault("the arm is not where this program left it: somebody has moved it"))
        n = len(self._nodes)
        if at is None or (index - at) % n not in {0, 1, n - 1}:
            self._approach(q, index, stop)
        elif index != at:
            forward = (index - at) % n == 1
            speed = self._plan.steps[at if forward else index].speed_rad_s
            self._at = None
            self._tell(State.MOVE, stop)
            self._move(q, self._nodes[index], speed, self._plan.acceleration_rad_s2)
        self._at = index

    def _approach(self, q: Array, index: int, stop: int) -> None:
        self._at = None
        approach = approach_to(self._certifier, q, self._nodes[index], Speeds(SLOW_RAD_S, SLOW_RAD_S2))
        if not len(approach.q_rad):
            return
        if words := forbidden(self._arm, np.vstack([q, approach.q_rad])):
            raise PlanRefused(words)
        words = (
            f"the way to pose {stop} at {np.degrees(APPROACH_RAD_S):.0f}°/s at most: "
            f"{way_in_words(way_of(q, approach), approach.clearance_m)}"
        )
        self._tell(State.APPROACH, stop, words)
        self._confirm(f"The arm goes {words}.")
        for goal, speed in zip(approach.q_rad, approach.speed_rad_s, strict=True):
            self._move(q, goal, min(float(speed), APPROACH_RAD_S), SLOW_RAD_S2)
            q = goal
        if stop == 1:
            self._confirm(f"The arm stands at the first pose. The tour has {self._stops} stops. Begin?")

    def _confirm(self, text: str) -> None:
        """Ask before a motion; the first one of a workcell wants a word."""
        if not self._pace.asks:
            return
        if self._moved:
            self._desk.require(text, assumed=self._pace.trusted)
            return
        assumed = _FIRST_WORD if self._pace.trusted else None
        question = Question(f"{text} Hand on the emergency stop. Type {_FIRST_WORD}", (_FIRST_WORD,), assumed)
        if self._desk.ask(question) != _FIRST_WORD:
            raise Declined("the word was not typed: nothing moves")
        self._moved = True

    def _move(self, start: Array, goal: Array, speed_rad_s: float, acceleration_rad_s2: float) -> None:
        if not self._moved:
            self._confirm("The arm begins the tour.")
        if self._pace.slow:
            speed_rad_s, acceleration_rad_s2 = min(speed_rad_s, SLOW_RAD_S), min(acceleration_rad_s2, SLOW_RAD_S2)
        turn = np.abs(goal - start).max()
        duration_s = float(move_duration_s(turn, speed_rad_s, acceleration_rad_s2))
        with self._guards.watching(start, goal, moving=True):
            self._arm.move_to(
                goal.tolist(),
                timeout_s=_PATIENCE * (duration_s + 1.5),
                guard=self._between_looks,
                speed_rad_s=speed_rad_s,
                acceleration_rad_s2=acceleration_rad_s2,
            )

    def _between_looks(self) -> None:
        self._guards.check()
        key = self._desk.pressed()
        if key is Key.STOP or key is Key.PAUSE:
            raise Stopped("stopped by a person")
        if key is not None:
            self._asked.add(key)

    # -------------------------------------------------------------------------------------------- stop and hold

    def _hold(self, error: Exception) -> None:
        """Say why the arm stands, and wait for a person; returns when it may go on. The arm was stopped before."""
        self._arm.stop()
        trip = self._cause(error)
        if trip is not None and self._mended(trip):
            return
        self._at = None
        words = str(error if trip is None else trip).rstrip(".")
        if trip is not None and trip is not self._guards.tripped(wait_s=0.0):
            self._desk.tell(GuardTripped(hazard=trip.hazard, words=words))
        self._tell(State.STOP, words=words)
        self._tell_sensor_events()
        kept = len(self._run.stops())
        self._tell(State.HOLD, words=f"{words}. {kept} poses are kept in {self._run.folder}")
        cause = error if trip is None else trip.error
        question = Question(
            f"{words}. {kept} poses are kept. Type resume when it is mended, or quit and go on later with "
            f"ftdrive calibrate --resume {self._run.folder}",
            ("resume", "quit"),
        )
        while True:
            try:
                answer = self._desk.ask(question)
            except Declined:
                raise cause from error
            if answer != "resume":
                raise cause if not isinstance(error, Stopped) else Declined(words)
            try:
                self._recover()
            except (Tripped, DriverError, NotAccepted) as again:
                self._desk.tell(Noted(words=f"not yet: {again}", warning=True))
                continue
            return

    def _cause(self, error: Exception) -> Tripped | None:
        """What a guard has to say about it, or the row of the table that the error belongs to."""
        if isinstance(error, Tripped):
            return error
        if isinstance(error, OSError) and not isinstance(error, DriverError):
            return Tripped(26, error)
        if not isinstance(error, DriverError):
            return None
        if (trip := self._guards.tripped(wait_s=0.3)) is not None:
            return trip
        try:
            self._sensor.check()
        except DriverError:
            return Tripped(15, error)
        try:
            status = self._arm.status()
        except DriverError:
            return out_of_sight(error, moving=self._at is None)
        if status.fault is not None:
            return by_safety(status, str(error))
        return Tripped(21, error) if isinstance(error, DeviceFault) else Tripped(16, error)

    def _mended(self, trip: Tripped) -> bool:
        """Open a sensor that failed while the arm stood at a pose, once for each pose; the pose begins anew."""
        stop = self._todo[0]
        if trip.hazard != 15 or self._at is None or stop in self._reopened:
            return False
        self._reopened.add(stop)
        try:
            self._recover()
        except (Tripped, DriverError, NotAccepted) as error:
            log.info("the sensor does not come back: %s", error)
            return False
        self._desk.tell(Noted(words=f"{trip}; it is back, pose {stop} begins anew", warning=True))
        return True

    def _recover(self) -> None:
        """Open again what was lost, and look at everything once more. A safety stop is for the operator to clear."""
        self._arm.open(control=True)
        try:
            self._sensor.check()
        except DriverError:
            self._sensor.close()
            self._sensor.open()
            self._contact.forget()
            self._seen_events = 0
        self._recheck()
        self._guards.begin()
        q = self._arm.state().q_rad
        with self._guards.watching(q, q, moving=False):  # is what tripped them gone?
            time.sleep(_LOOK_AGAIN_S)

    # -------------------------------------------------------------------------------------------- telling

    def _tell(self, state: State, stop: int | None = None, words: str = "") -> None:
        number = None if stop is None else self._plan.steps[(stop - 1) % len(self._nodes)].number
        self._desk.tell(StateChanged(state=state, stop=stop, stops=self._stops, number=number, words=words))

    def _tell_sensor_events(self) -> None:
        events = self._sensor.health().events
        for t_host_ns, words in events[self._seen_events :]:
            self._desk.tell(Noted(words=f"sensor, at {t_host_ns} ns of the host's clock: {words}", warning=True))
        self._seen_events = len(events)


def approach_to(certifier: Certifier, q_rad: Array, goal_rad: Array, speeds: Speeds) -> Approach:
    """Plan an approach; one that is already there has no moves."""
    if np.abs(q_rad - goal_rad).max() < 1e-3:
        none: Any = np.zeros(0)
        return Approach(np.zeros((0, 6)), none, none, certified=True, clearance_m=np.inf, limited_by="")
    return plan_approach(certifier, q_rad, goal_rad, speeds)
