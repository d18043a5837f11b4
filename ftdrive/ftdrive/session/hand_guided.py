"""Poses to which the operator moves the arm by hand or pendant, or to which a program on the pendant moves it.

This module never commands the arm, which may be open for reading only. Each time the arm has stood still for 1 s at a
new orientation, the sensor is averaged and the pose is written to disk.
"""

from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import replace
from math import degrees, radians
from typing import Final, TypeVar

import numpy as np

from ftcalib.data.dwell_mean import CHANNELS, restless_channels
from ftcalib.model import Array
from ftcalib.routine import MOVED_RAD, PoseRecord, Stage, TourPose, take_pose, turned_rad
from ftcalib.sampling import Sampling
from ftdrive.planning.geometry.scene import down_of
from ftdrive.runs.run import Run
from ftdrive.session.events import Compared, Estimated, Key, SensorEvents, State, StateChanged
from ftdrive.session.open_session import OpenCell, OpenSession, PoseBook
from ftdrivers.errors import DeviceError, DeviceTimeout, StreamBroken
from ftdrivers.interfaces import ArmState, FtSamples

# Standstill before a pose, s on the controller's clock, judged by joint speeds: in freedrive `is_steady` is false.
STILL_S: Final = 1.0
STILL_RAD_S: Final = 0.002
# The arm counts as moved to another pose if the flange has rotated by more than this.
LEFT_RAD: Final = radians(1)
REPEAT_RAD: Final = radians(10)
# Largest angle between the first pose of a program and a pose that counts as its return there.
RETURN_RAD: Final = radians(0.1)
LOOK_S: Final = 0.1
# Time-out for an arm or sensor that is lost, s; a driver that reconnects gives up after 10 s.
BACK_S: Final = 12.0
# A pose that differs from the fit of the others by more than both of these was probably disturbed by contact.
SURPRISE_SIGMA: Final = 5.0
SURPRISE_N: Final = 0.5
# A new pose is compared with the fit of the others once there are this many poses, including the new one.
LEAST_TO_COMPARE: Final = 6

T = TypeVar("T")


class _Interrupted(Exception):
    """Raised when the stream of the sensor was interrupted and has recovered."""


class _Moved(Exception):
    """Raised when the arm moved while a pose was measured; `state` is its new state."""

    def __init__(self, state: ArmState) -> None:
        super().__init__()
        self.state = state


class _Held:
    """Gives `take_pose` the interface of arm and sensor that it needs, for an arm that already stands still."""

    def __init__(self, state: Callable[[], ArmState], collect: Callable[[float], FtSamples]) -> None:
        self._state, self._collect = state, collect
        self._before: ArmState | None = None
        self.samples: FtSamples | None = None
        """Samples that the sensor collected last; None before the first collection."""

    def wait_until_still(self, **_: object) -> None:
        self._before = None

    def state(self) -> ArmState:
        """Return the arm's state; raises `_Moved` if the arm has moved since the measurement began."""
        state = self._state()
        if self._before is None:
            self._before = state
        elif turned_rad(self._before, state) >= MOVED_RAD or np.abs(state.qd_rad_s).max() >= STILL_RAD_S:
            raise _Moved(state)
        return state

    def collect(self, duration_s: float) -> FtSamples:
        self.samples = self._collect(duration_s)
        return self.samples

    def check(self) -> None:
        """Do nothing, because `collect` already raises if the stream of the sensor is interrupted."""


def take_by_hand(session: OpenSession) -> Run:
    """Take poses without commanding the arm, which the operator or a program moves; return the run."""
    cell, task, run = session.cell, session.task, session.resumed
    if run is None:
        run = session.new_run()
        cell.journal.keep_in(run)
    if (load := task.load) is not None:
        cell.note(f"{load} is on the tool in every pose. Keep clear of it and of the space below.", warning=True)
    book = PoseBook(cell, run, task.judge(by_hand=True), down_of(task.cell.workcell.mounting))
    with cell.journal.reporting_early_end(run):
        sampling, swing_N = task.cell.sampling, None
        if load is not None:
            sampling, swing_N = load.sampling(sampling), load.most_swing_N
        guide = HandGuided(cell, book, sampling, listen=session.options.mode == "listen", most_swing_N=swing_N)
        guide.run(run.records() if session.resumed else (), task.goal)
    return run


class HandGuided:
    """Takes poses at each standstill of the arm until they suffice.

    Keys: keep ends the session when the light is green, stop ends it at once. Redo replaces the newest pose with the
    next one, skip leaves out the current pose, pause pauses and resumes. A key takes effect within the averaging time.
    Without keys, the session ends with the first good pose that makes the light green.

    Parameters
    ----------
    cell : OpenCell
        The arm may be open for reading only. A sensor with `recover` may reconnect after an interruption.
    book : PoseBook
    sampling : Sampling
    listen : bool
        A program moves the arm, so no pose is suggested. Poses are taken until the program ends, or returns to its
        first pose when the poses suffice. This return is saved too and serves `ftcalib.routine.drift_check`. If the
        program passes its first pose before the poses suffice, poses are taken until it ends.
    most_swing_N : float, optional
        As in `ftcalib.routine.take_pose`.

    Notes
    -----
    Poses and their orientations are numbered in the order of measurement. The return to the first pose has
    the orientation number 1. `pose.q_rad` are the joint angles at which the arm stood.
    """

    def __init__(
        self,
        cell: OpenCell,
        book: PoseBook,
        sampling: Sampling,
        *,
        listen: bool,
        most_swing_N: float | None = None,
    ) -> None:
        self._arm, self._sensor, self._operator, self._clock = cell.arm, cell.sensor, cell.journal, cell.clock
        self._note = cell.note
        self._book, self._sampling, self._listen, self._most_swing_N = book, sampling, listen, most_swing_N
        self._sensor_events = SensorEvents(cell.sensor, cell.journal.show)
        self._taken: dict[int, PoseRecord] = {}
        self._level: Array | None = None
        self._redo: int | None = None
        self._light = "red"
        self._paused = False
        # State reported when the arm came to rest; None while it moves.
        self._rests_at: ArmState | None = None
        self._still_since_s = 0.0
        # Whether the pose at which the arm stands now was already taken or left out.
        self._dealt_with = False
        self._program_ran = False
        # State of the pendant's program as the controller reports it; empty before the program starts.
        self._program = ""
        # Whether the program came back to its first pose before there were enough poses, as when it is restarted.
        self._passes_first = False
        self._fault: str | None = None
        self._over = False
        self._ends_by_itself = not (listen or cell.journal.has_keys)
        # Whether the poses suffice: their coverage is green and the newest pose is good.
        self._enough = False

    def run(self, earlier: Sequence[PoseRecord], goal: str) -> None:
        """Take poses until they suffice; `goal` describes when, and `earlier` are the poses of a resumed run.

        Raises `TooFewSamples` if the sensor is too slow for the averaging time, and the errors of the arm and the
        sensor; the poses saved before remain.
        """
        self._passes_first = bool(earlier)
        # An emulated clock waits for this thread, so that it sees each standstill.
        with self._clock.keeping_up():
            self._greet(goal)
            for record in earlier:
                self._learn(record, self._book.judge.add(record))
            if self._ends_by_itself and self._enough:
                self._note("The poses of the run suffice: the session ends with the next pose.")
            self._show_state(State.MOVE)
            while not self._over:
                state = self._ask(self._arm.state)
                with suppress(_Interrupted):
                    self._collect(LOOK_S)  # sets the pace of the loop, and raises as soon as the sensor fails
                self._obey_keys()
                if self._over or not self._may_measure():
                    continue
                if self._at_rest(state):
                    self._take(state)
                elif self._program == "stopped" and self._dealt_with and self._rests_at is not None:
                    self._end("The program has ended")

    def _ask(self, arm: Callable[[], T]) -> T:
        """Read the arm; wait up to `BACK_S` for its answer, which is safe because ftdrive does not move the arm."""
        try:
            return arm()
        except DeviceTimeout as silence:
            self._note(f"The measurement waits until the arm answers again: {silence.found}.", warning=True)
        return self._wait_out(arm, DeviceTimeout)

    def _collect(self, duration_s: float) -> FtSamples:
        """Collect samples. Raises `_Interrupted` if the stream was interrupted and the driver has reconnected."""
        try:
            return self._sensor.collect(duration_s)
        except (StreamBroken, DeviceTimeout) as error:
            if not getattr(self._sensor, "recover", False):
                raise
            self._wait_out(self._sensor.check, StreamBroken, DeviceTimeout)
            raise _Interrupted from error
        finally:
            self._sensor_events.show_new()

    def _wait_out(self, ask: Callable[[], T], *losses: type[DeviceError]) -> T:
        """Repeat `ask` until it succeeds, for at most `BACK_S`."""
        deadline_s = self._clock.now_s() + BACK_S
        while True:
            try:
                return ask()
            except losses:
                if self._clock.now_s() > deadline_s:
                    raise
            self._sensor_events.show_new()
            self._clock.sleep(LOOK_S)

    def _may_measure(self) -> bool:
        status = self._ask(self._arm.status)
        fault = str(status.fault or "")
        if fault and fault != self._fault:
            self._note(f"No measurement now: {fault}.", warning=True)
        self._fault = fault
        if self._listen:
            self._program_ran |= status.program == "playing"
            self._program = status.program if self._program_ran else ""
        return not (self._paused or self._fault) and (not self._listen or self._program in {"playing", "stopped"})

    def _at_rest(self, state: ArmState) -> bool:
        """Return whether the arm has stood still long enough at a new pose, neither taken nor left out before."""
        still = float(np.abs(state.qd_rad_s).max()) < STILL_RAD_S
        if self._rests_at is not None and turned_rad(self._rests_at, state) > LEFT_RAD:
            self._rests_at = None
            if not self._dealt_with:
                self._show_state(State.MOVE)
        if self._rests_at is None:
            if not still:
                return False
            self._dealt_with = False
            self._show_state(State.SETTLE)
        elif still and turned_rad(self._rests_at, state) < MOVED_RAD:
            return not self._dealt_with and state.t_device_s - self._still_since_s >= STILL_S
        elif self._dealt_with:
            return False
        self._rests_at = state
        self._still_since_s = state.t_device_s
        return False

    def _take(self, state: ArmState) -> None:
        others = {stop: turned_rad(record.before, state) for stop, record in self._taken.items() if stop != self._redo}
        nearest = min(others, key=others.__getitem__, default=0)
        first = min(self._taken, default=0)
        back = self._listen and len(others) > 1 and nearest == first and others[first] < RETURN_RAD
        returned = back and self._light == "green" and not self._passes_first
        if others and others[nearest] < REPEAT_RAD and not returned:
            self._passes_first |= back
            further = " Press k to finish, or turn the tool further." if self._may_finish else " Turn the tool further."
            self._note(
                f"This orientation is {degrees(others[nearest]):.0f}° from pose {nearest} and is left out."
                + ("" if self._listen else further)
            )
            self._deal_with()
            return
        stop = self._next_stop()
        number = self._taken[first].pose.number if returned else stop
        if not self._measure(stop, number, state):
            return
        if returned:
            self._end("The program is back at its first pose")
        elif self._ends_by_itself and self._enough:
            self._end("These poses are enough")

    def _measure(self, stop: int, number: int, state: ArmState) -> bool:
        """Average until the samples are quiet, and save the pose; False if the arm moved or the operator intervened."""
        settle_s = state.t_device_s - self._still_since_s
        held = _Held(lambda: self._ask(self._arm.state), self._collect)

        def on_stage(stage: Stage) -> None:
            if stage == "sample":
                self._show_state(State.SAMPLE)
            elif held.samples is not None:
                swings = self._most_swing_N is not None
                advice = "Wait until the weight hangs still." if swings else "Let go of tool and cable."
                self._note_unrest(stop, held.samples, advice)

        pose = TourPose(number, state.q_rad)
        try:
            record = take_pose(
                held,
                held,
                stop,
                pose,
                self._sampling,
                on_stage=on_stage,
                quiet_std=self._level,
                most_swing_N=self._most_swing_N,
            )
        except _Moved as moved:
            self._still_since_s = moved.state.t_device_s
            self._note(f"The arm moved while pose {stop} was measured: {self._hold_still()}.", warning=True)
            self._show_state(State.SETTLE)
            return False
        except _Interrupted:
            return False
        if not record.steady and held.samples is not None:
            again = "; press r to take it again" if self._operator.has_keys else ""
            self._note_unrest(stop, held.samples, f"The pose is saved and marked as not quiet{again}.")
        self._obey_keys()  # r pressed before the screen shows this pose refers to the previous one
        if self._over or self._paused or self._dealt_with:
            return False
        if self._redo is not None:
            stop = number = self._redo
        record = replace(record, stop=stop, pose=TourPose(number, record.before.q_rad))
        self._redo = None
        stops, average_s = max(stop, len(self._taken)), self._sampling.average_s
        self._learn(record, self._book.keep(record, stops=stops, settle_s=settle_s, average_s=average_s))
        self._deal_with()
        return True

    def _deal_with(self) -> None:
        """Mark the current pose as finished: the next measurement needs another pose."""
        self._dealt_with = True
        words = "the program goes on" if self._listen else "move on to another orientation"
        if self._may_finish:
            words = f"enough: press k to finish, or {words}"
        self._show_state(State.MOVE, words)

    @property
    def _may_finish(self) -> bool:
        return self._light == "green" and not (self._listen or self._ends_by_itself)

    def _learn(self, record: PoseRecord, judged: Estimated | Compared) -> None:
        self._taken[record.stop] = record
        # The smallest noise among the poses is taken for that of the undisturbed sensor.
        if record.steady:
            std = record.samples.wrench.std(axis=0, ddof=1)
            self._level = std if self._level is None else np.minimum(self._level, std)
        self._operator.show(replace(judged, hint="") if self._listen else judged)
        touched = isinstance(judged, Estimated) and self._note_if_touched(record, judged)
        self._enough = judged.light == "green" and record.steady and not touched
        if judged.light == "green" != self._light and not (self._listen or self._ends_by_itself):
            self._note("These poses are enough: press k to finish, or go on for a better result.")
        self._light = judged.light

    def _note_if_touched(self, record: PoseRecord, estimated: Estimated) -> bool:
        sigmas, force_N = estimated.residual_sigma or 0.0, estimated.residual_force_N or 0.0
        touched = estimated.poses >= LEAST_TO_COMPARE and sigmas > SURPRISE_SIGMA and force_N > SURPRISE_N
        if touched:
            again = " and press r to take the pose again" if self._operator.has_keys else ""
            self._note(
                f"Pose {record.stop} differs by {force_N:.1f} N from the fit of the others: if something touched the "
                f"tool, remove the contact{again}.",
                warning=True,
            )
        return touched

    def _note_unrest(self, stop: int, samples: FtSamples, advice: str) -> None:
        unrest, wrench = "its mean still changes", samples.wrench
        if self._level is not None:
            for c in np.flatnonzero(restless_channels(wrench, self._level))[:1]:
                found, unit = wrench[:, c].std(ddof=1), "N" if c < 3 else "N·m"
                unrest = f"sigma of {CHANNELS[c]} is {found:.2g} {unit}, but {self._level[c]:.2g} in the quietest pose"
        self._note(f"Pose {stop} is not quiet: {unrest}. {advice}", warning=True)

    def _obey_keys(self) -> None:
        self._operator.require_operator()
        while not self._over and (key := self._operator.pressed()):
            self._obey(key)

    def _obey(self, key: Key) -> None:
        if key is Key.STOP:
            self._end(f"Stopped by {self._operator.pressed_by}")
        elif key is Key.KEEP and self._light == "green":
            self._end("Finished")
        elif key is Key.KEEP:
            self._note(f"The light is {self._light}: take more poses, or press q to stop anyway.")
        elif key is Key.REDO and self._taken:
            self._redo = max(self._taken)
            self._dealt_with = False
            self._note(f"The next pose replaces pose {self._redo}.")
        elif key is Key.SKIP and self._rests_at is not None:
            self._note("This pose is left out: move the arm to the next one.")
            self._deal_with()
        elif key is Key.PAUSE:
            self._paused = not self._paused
            self._rests_at = None
            self._note("Paused: press p again to resume." if self._paused else "Resumed.")

    def _greet(self, goal: str) -> None:
        if self._listen:
            self._note(f"Start the program on the pendant. Each standstill counts as a pose: {self._hold_still()}.")
        elif self._most_swing_N is not None:
            self._note(
                "Move the arm slowly, by hand or with the pendant: tilt the tool by 45 to 75° from straight down, to "
                f"all sides. At each tilt {self._hold_still()}, and wait until the weight hangs still."
            )
        else:
            self._note(
                "Move the arm by hand or with the pendant to orientations of the tool that differ as much as possible. "
                f"At each one let go of the tool and {self._hold_still()}."
            )
        if self._ends_by_itself:
            self._note(f"The session ends when {goal}. Press Ctrl-C to end it earlier.")

    def _hold_still(self) -> str:
        seconds = STILL_S + self._sampling.average_s + 3 * LOOK_S
        return f"let it dwell {seconds:.1f} s at each pose" if self._listen else f"let the arm rest for {seconds:.1f} s"

    def _end(self, why: str) -> None:
        self._over = True
        saved = f"{len(self._taken)} {'pose is' if len(self._taken) == 1 else 'poses are'} saved"
        enough = "" if self._light == "green" else f"; the light is {self._light}: poses may be too few or too similar"
        self._note(f"{why}: {saved}{enough}.", warning=bool(enough))

    def _show_state(self, state: State, words: str = "") -> None:
        self._operator.show(StateChanged(state=state, stop=self._next_stop(), words=words))

    def _next_stop(self) -> int:
        return self._redo or max(self._taken, default=0) + 1
