"""A tour: MOVE, SETTLE and SAMPLE for each pose of a plan, then CLOSE; each pose is on disk before the next move."""

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise
from typing import Final

import numpy as np

from ftcalib.data.dwell_mean import averaging_time, mean_and_covariance
from ftcalib.judge import described_cell
from ftcalib.model import Array
from ftcalib.rounding import to_place_of
from ftcalib.routine import Stage, TourPose, take_pose
from ftcalib.sampling import Sampling
from ftdrive.errors import Declined
from ftdrive.planning.approach import Approach
from ftdrive.planning.motion import move_duration_s
from ftdrive.planning.plan import Plan
from ftdrive.planning.planner import speeds_of
from ftdrive.runs.run import Run
from ftdrive.session.along_plan import NO_SERIAL, AlongPlan
from ftdrive.session.drive import APPROACH_RAD_S, AT_RAD, BACK_RAD_S, SLOW, STOPS, Drive, GuardedCell
from ftdrive.session.events import Key, Question, State, Weighed, rms_sigma
from ftdrive.session.open_session import OpenSession, PoseBook, SessionOptions
from ftdrive.session.preflight import LISTEN_S, Before

# Target sigma of the average at one pose; 24 poses then determine the force bias with a sigma of 0.02 N.
_TARGET_N, _TARGET_NM = 0.057, 0.0035
# Factor on the averaging time for a new tool on a calibrated sensor: its four poses then have the information of eight.
# Drift acts for twice as long, but four long poses are as accurate as six usual ones, with two moves fewer.
_TOOL_AVERAGES: Final = 2.0


def take_tour(session: OpenSession) -> Run | None:
    """Take the poses of the given plan, or of a plan made from the current posture; return None after a dry run."""
    options = session.options
    along = AlongPlan(session, lambda certifier, q_rad: session.task.plan(certifier, q_rad, options.poses))
    driven = _choose_pace(along)
    if options.dry_run:
        along.end_dry_run()
        return None
    quiet_std = driven.quiet_std(driven.config.sampling.average_s)
    with along.guarding(driven, quiet_std, along.judge.predict) as (guarded, book):
        tour = Tour(guarded, driven, quiet_std, book, options)
        tour.run(along.todo)
    missing = "poses are missing" if len(book.run.stops()) <= len(driven.plan.steps) else ""
    along.judge_completed(f"moves from {_list_poses(tour.undriven)} were replaced" if tour.undriven else missing)
    return book.run


class _Turned(Exception):
    """Raised when the operator presses s to skip the pose in progress, or r to take the last pose again."""

    def __init__(self, key: Key) -> None:
        super().__init__(key.name)
        self.key = key


class Tour:
    """Moves the arm along a plan and takes its poses, which `book` saves.

    `driven` has the speeds and the sampling of this session; `quiet_std` (6,) is the standard deviation of the samples
    of the resting sensor.
    """

    def __init__(
        self, guarded: GuardedCell, driven: Before, quiet_std: Array, book: PoseBook, options: SessionOptions
    ) -> None:
        self._plan, self._config, self._load = driven.plan, driven.config, driven.task.load
        self._drive = Drive(guarded, driven, options, [step.number for step in self._plan.steps], self._obey)
        self._arm, self._journal, self._note = self._drive.arm, self._drive.journal, self._drive.note
        self._nodes, self._now = self._drive.nodes_rad, self._drive.now
        self._quiet_std, self._book, self._options = quiet_std, book, options
        self._certifier = driven.certifier
        # A load is hung on its string only when the arm is at the first pose.
        self._to_hang = self._certifier.arm.hung is not None
        self._drive.certifier = self._certifier.without_load

    def run(self, todo: Sequence[int]) -> None:
        """Take the poses of these stops, numbered from 1; the last stop is the return to the first pose.

        Raises
        ------
        Declined
            The operator ended the tour, or did not answer.
        Tripped, DeviceError, OSError, SupervisorGone
            The cause of a stop, if the operator then ended the tour.
        """
        self._now.todo = list(todo)
        self._drive.watcher.begin()
        while self._now.todo:
            try:
                self._next()
            except _Turned as turned:
                self._turn(turned.key)
            except STOPS as error:
                if self._drive.hold(error, self._choices) == "skip":
                    self._skip()
        self._drive.guarded.show_new()
        self._drive.show_state(State.CLOSE)

    @property
    def undriven(self) -> list[int]:
        """Numbers of the poses from which the planned move was not completed; see `Progress.undriven`."""
        return self._now.undriven

    def _next(self) -> None:
        if self._now.back is not None:
            self._drive.go_back(*self._now.back)
        self._now.under_way = None
        self._drive.obey_keys()
        stop = self._now.todo[0]
        index = self._now.index(stop)
        if self._options.mode == "step" and not self._step(stop, index):
            return
        self._now.under_way = stop
        self._go(index, stop)
        self._drive.obey_keys()
        if self._to_hang:
            words = f"Pose {stop}: hang {self._load} now, and wait until it hangs still on its free string. Go on?"
            self._drive.confirm(words, by_operator=self._options.real)
            self._to_hang, self._drive.certifier = False, self._certifier
        self._take(stop, index)
        del self._now.todo[0]

    def _compare_payload(self) -> None:
        """Hazard 7: show the mass on the sensor, and warn if the controller's payload differs; once per payload."""
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
        """Ask the operator before a pose in step mode; return whether to move to it."""
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
        """Describe the motion that Enter starts in step mode."""
        turn_rad = np.abs(self._nodes[index] - self._arm.state().q_rad)
        moving = [str(joint + 1) for joint in np.flatnonzero(turn_rad > AT_RAD)]
        if not moving:
            return "the arm is already there, Enter starts the measurement"
        joints = f"joint{'s' if len(moving) > 1 else ''} {', '.join(moving)}"
        largest = f"largest turn {np.degrees(turn_rad.max()):.0f}°"
        speed_rad_s = self._own_speed(index)
        if speed_rad_s is None:
            drives = ", and moves along it if --yes may confirm it" if self._drive.trusted and self._options.yes else ""
            return f"Enter plans and shows the approach{drives} ({joints}, {largest})"
        return f"Enter moves {joints}, {largest}, at {np.degrees(speed_rad_s):.0f} °/s"

    def _turn(self, key: Key) -> None:
        if not self._now.standing:
            self._arm.stop()
        if key is Key.REDO:
            self._redo()
        else:
            self._skip()

    def _redoable(self) -> bool:
        """Return whether the key r can take the last pose again; if not, show a note that says why."""
        last = self._now.taken_last
        if last is None:
            self._note("no pose yet: nothing to take again with r")
        elif self._now.todo[0] == last:
            self._note(f"pose {last} is already being taken again")
        return last is not None and self._now.todo[0] != last

    def _redo(self) -> None:
        stop = self._now.taken_last
        if stop is None:
            return
        self._book.judge.remove(stop)
        self._now.redo(stop)
        self._note(f"pose {stop} is taken again")

    def _skip(self) -> None:
        """Leave out the next pose and any return to it. A pose that was to be taken again keeps its earlier samples."""
        dropped = self._now.skip()
        names = {stop: "the return to pose 1" if stop == self._now.stops else f"pose {stop}" for stop in dropped}
        stay = set(dropped).intersection(self._book.run.stops())
        for record in self._book.run.records() if stay else ():
            if record.stop in stay:
                self._journal.show(self._book.judge.add(record))
                self._note(f"{names[record.stop]} keeps its earlier measurement", warning=True)
        if left := [name for stop, name in names.items() if stop not in stay]:
            way = f"the arm goes on to pose {self._now.todo[0]}" if self._now.todo else "no pose is left"
            self._note(f"skipped: {' and '.join(left)}; {way}; --resume measures skipped poses", warning=True)

    def _take(self, stop: int, index: int) -> None:
        step, sampling, clock = self._plan.steps[index], self._config.sampling, self._drive.watcher.clock
        pose = TourPose(step.number, np.array(step.q_rad))
        began_s, settled_s = clock.now_s(), 0.0

        def on_stage(stage: Stage) -> None:
            nonlocal settled_s
            settled_s = clock.now_s() - began_s
            self._drive.show_state(State.SETTLE if stage == "settle" else State.SAMPLE, stop)

        with self._drive.watcher.watching(pose.q_rad, pose.q_rad, moving=False):
            record = take_pose(
                self._arm,
                self._drive.sensor,
                stop,
                pose,
                sampling,
                guard=self._drive.between_looks,
                on_stage=on_stage,
                quiet_std=self._quiet_std,
                most_swing_N=None if self._load is None else self._load.most_swing_N,
            )
        self._drive.guarded.load.judge(record.samples.wrench)
        judged = self._book.keep(record, stops=self._now.stops, settle_s=settled_s, average_s=sampling.average_s)
        self._drive.guarded.show_new()
        self._journal.show(judged)
        self._now.taken_last = stop
        self._compare_payload()

    def _go(self, index: int, stop: int) -> None:
        """Move the arm to a pose, along a move of the plan or an approach."""
        at, speed_rad_s, driven_from = self._now.at, self._own_speed(index), None
        if index == at:
            return
        if at is None or speed_rad_s is None:
            if self._drive.approach(index, stop) and stop == 1 and not self._to_hang:
                words = f"The arm is at the first pose. The tour has {self._now.stops} stops. Begin?"
                self._drive.confirm(words)
        else:
            self._drive.show_state(State.MOVE, stop)
            self._drive.move(self._nodes[at], self._nodes[index], speed_rad_s, self._plan.acceleration_rad_s2)
            driven_from = at if index == (at + 1) % len(self._nodes) else None
        self._now.arrive(index, driven_from=driven_from)

    def _own_speed(self, index: int) -> float | None:
        """Return the planned speed, rad/s, of the move from the current pose to another; None if no move is planned."""
        at, n = self._now.at, len(self._nodes)
        if at is None or (index - at) % n not in {1, n - 1}:
            return None
        return self._plan.steps[at if (index - at) % n == 1 else index].speed_rad_s

    def _choices(self, back: int | None, fixed: str) -> tuple[str, dict[str, str]]:
        """Return a sentence about the saved poses, and for each answer in a hold its effect; see `Drive.hold`."""
        stop = self._now.todo[0]
        ways = {"resume": f"go on with pose {stop}{fixed}", "skip": f"skip pose {stop}"}
        if back is not None:
            ways["back"] = f"return to pose {back + 1} at {np.degrees(BACK_RAD_S):.0f} °/s"
        ways["quit"] = "stop; continue later with --resume"
        return f"{len(self._book.run.stops())} poses are saved.", ways

    def _obey(self, key: Key) -> str:
        """Raise `_Turned` for the keys s and r if they have an effect; otherwise return a note on the key, or ""."""
        if (key is Key.SKIP and self._now.under_way is not None) or (key is Key.REDO and self._redoable()):
            raise _Turned(key)
        if key is Key.KEEP:
            return "every pose is saved automatically; press r to take the last one again"
        return "no pose in progress: nothing to skip" if key is Key.SKIP else ""


def _choose_pace(along: AlongPlan) -> Before:
    """Return the input of a tour with speeds and sampling for this session; show expected accuracy and duration."""
    before, todo, cell, task, options = along.before, along.todo, along.cell, along.task, along.options
    sampling, sigma = _chosen_sampling(before, todo)
    force_N, torque_Nm = rms_sigma(sigma)
    noise = f"sigma of {sampling.average_s:g} s averages: {force_N:.2g} N, {to_place_of(torque_Nm, torque_Nm)} N·m"
    cell.note("; ".join(filter(None, (noise, task.forecast(before.plan, before.certifier, sigma)))))
    slow = options.real and not (options.fast and before.known)
    if options.fast and slow:
        why = "" if along.serial else f": {NO_SERIAL}"
        cell.note(f"--fast has no effect: {'every' if why else 'the first'} run of a plan is slow{why}", warning=True)
    speeds = speeds_of(task.cell)
    plan = before.plan.limited(before.certifier, speeds.limited(SLOW) if slow else speeds)
    total_s = moves_s(plan, todo, before.approach) + len(todo) * (sampling.average_s + 0.6)
    taken = f"; {along.taken} poses taken before" if along.taken else ""
    cell.note(
        f"{len(todo)} stops left, at most {np.degrees(plan.top_speed_rad_s):.0f} °/s: "
        f"about {total_s / 60:.1f} min{taken}"
    )
    return replace(before, plan=plan, config=replace(before.config, sampling=sampling))


def moves_s(plan: Plan, todo: Sequence[int], approach: Approach) -> float:
    """Return the duration of the approach and of all moves between these stops at the speeds of the plan, s.

    Stops are numbered from 1. Between two stops that do not follow each other, an approach is counted as a straight
    move.
    """
    total_s = approach.duration_s(APPROACH_RAD_S, SLOW.joint_rad_s2)
    for stop, following in pairwise(todo):
        step = plan.steps[stop - 1]
        turn, speed, acceleration = step.turn_rad, step.speed_rad_s, plan.acceleration_rad_s2
        if following != stop + 1:
            goal = plan.steps[(following - 1) % len(plan.steps)].q_rad
            turn = float(np.abs(np.subtract(goal, step.q_rad)).max())
            speed, acceleration = APPROACH_RAD_S, SLOW.joint_rad_s2
        total_s += float(move_duration_s(np.array(turn), speed, acceleration))
    return total_s


def _chosen_sampling(before: Before, todo: Sequence[int]) -> tuple[Sampling, Array]:
    """Return how a pose is sampled, as configured or chosen, and the standard deviation (6,) of its mean wrench."""
    sampling, sigma = _usual_sampling(before, todo)
    load = before.task.load
    if load is not None and not load.gripped:
        longer = load.sampling(sampling)
        before.cell.note(f"hanging load: {longer.average_s:g} s at each tilt, repeated while it swings by 5° or more")
        return longer, sigma / np.sqrt(longer.average_s / sampling.average_s)
    if before.plan.kind != "tool":
        return sampling, sigma
    before.cell.note(f"new tool: {_TOOL_AVERAGES:g} times this duration at each of the {len(before.plan.steps)} poses")
    return replace(sampling, average_s=_TOOL_AVERAGES * sampling.average_s), sigma / np.sqrt(_TOOL_AVERAGES)


def _usual_sampling(before: Before, todo: Sequence[int]) -> tuple[Sampling, Array]:
    cell, sampling = before.cell, before.config.sampling
    if not (sampling.noise_record_s and todo):
        variance = np.diag(mean_and_covariance(before.quiet.wrench).covariance)
        return sampling, np.sqrt(variance * LISTEN_S / sampling.average_s)
    cell.note(f"recording the sensor's noise for {sampling.noise_record_s:g} s: do not touch the arm")
    record = cell.listen(sampling.noise_record_s)
    chosen = averaging_time(
        record.wrench,
        len(record) / sampling.noise_record_s,
        target_force_N=_TARGET_N,
        target_torque_Nm=_TARGET_NM,
    )
    cell.note(chosen.words)
    return replace(sampling, average_s=chosen.seconds), chosen.sigma


def _list_poses(numbers: Sequence[int]) -> str:
    *most, last = map(str, numbers)
    return f"poses {', '.join(most)} and {last}" if most else f"pose {last}"
