"""A session along a plan: shown, confirmed, approached, driven; and the register of plans driven to their end."""

import json
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import replace
from datetime import UTC, datetime
from functools import partial
from itertools import pairwise
from typing import Final

import numpy as np

from ftcalib.data.dwell_mean import LEAST_SAMPLES, averaging_time, mean_and_covariance, noise_level
from ftcalib.files import read_file
from ftcalib.model import Array
from ftcalib.rounding import to_place_of
from ftcalib.sampling import Sampling
from ftdrive.cell.config import user_folder
from ftdrive.errors import SupervisorGone
from ftdrive.planning.approach import Approach, plan_approach
from ftdrive.planning.geometry.arm_model import STRING_M, WEIGHT_HEIGHT_M, WEIGHT_RADIUS_M
from ftdrive.planning.geometry.certify import Certifier
from ftdrive.planning.motion import arm_moves, move_duration_s
from ftdrive.planning.plan import Plan, turns_in_words, way_in_words
from ftdrive.planning.planner import certifier_for, speeds_of
from ftdrive.runs.load import Load
from ftdrive.runs.run import Run
from ftdrive.session import guards
from ftdrive.session.events import GuardTripped, Planned, Question, rms_sigma
from ftdrive.session.open_session import Judge, PoseBook, Session
from ftdrive.session.options import SessionOptions
from ftdrive.session.preflight import AGAIN, CHECKS, IN_CONTROL, LISTEN_S, Before, check
from ftdrive.session.sweep import FreeTool, SweepTour, choose_sweep_speed
from ftdrive.session.tour import APPROACH_RAD_S, SLOW, GuardedCell, Tour
from ftdrive.session.watchdog import Watcher
from ftdrivers.interfaces import NOT_REPORTED
from ftdrivers.ur.kinematics import kinematics_of

FORMAT = "ftdrive.completed/1"
# In the state folder of the user.
_COMPLETED = "completed.ndjson"


def has_completed(arm_serial: str, plan_sha256: str) -> bool:
    """Whether this arm has driven this plan to its end before; unreadable lines are ignored.

    False for an arm that reports no serial number, because it may be another one.
    """
    path = user_folder("state") / _COMPLETED
    if arm_serial == NOT_REPORTED or not path.is_file():
        return False
    wanted = {"format": FORMAT, "arm": arm_serial, "plan": plan_sha256}
    return any(wanted.items() <= _read(line).items() for line in read_file(path).decode(errors="replace").splitlines())


def remember_completed(arm_serial: str, plan_sha256: str) -> None:
    """Record that one session drove every move of the plan, slowly, and took every pose."""
    path = user_folder("state") / _COMPLETED
    path.parent.mkdir(parents=True, exist_ok=True)
    line = {"format": FORMAT, "arm": arm_serial, "plan": plan_sha256, "utc": datetime.now(UTC).isoformat()}
    with path.open("a", encoding="utf-8") as file:
        file.write(json.dumps(line) + "\n")


def _read(line: str) -> dict[str, object]:
    try:
        found = json.loads(line)
    except ValueError:
        return {}
    return found if isinstance(found, dict) else {}


class _SafetyQuestions:
    """Asks for a free tool, free room, the emergency stop, and reduced mode; raises `Declined` unless all are yes."""

    def __init__(self, before: Before) -> None:
        self._arm, self._journal = before.cell.arm, before.cell.journal
        self._plan, self._load = before.plan, before.load
        self._reduced = False  # whether the operator has confirmed the reduced mode that is active

    def ask(self, way_rad: Array, *, assumed: bool) -> None:
        """Ask everything before the arm moves along `way_rad` (k, 6); with `assumed`, `--yes` may answer."""
        room = "" if self._plan.arm_rests else ", and the space of the whole arm, which moves too,"
        if arm_moves(way_rad):
            room = f", and the space of the whole arm, which moves in the approach ({turns_in_words(way_rad)}),"
        for text in (
            *_load_questions(self._load),
            "Is the tool free: no contact, no workpiece, no fluid, cables slack? Is the base bolted?",
            f"Is the space {self._plan.ball_in_words()} (the wrist){room} free of obstacles and people?",
            "Is the emergency stop in reach, and tested?",
        ):
            self._journal.require(text, assumed=assumed)
        self.ask_reduced(assumed=assumed)

    def ask_reduced(self, *, assumed: bool) -> None:
        """Ask whether reduced mode is intended, once as long as it lasts."""
        reduced = self._arm.status().safety_mode == "reduced"
        if reduced and not self._reduced:
            self._journal.require("The controller is in reduced mode. Is that intended?", assumed=assumed)
        self._reduced = reduced


def _load_questions(load: Load | None) -> list[str]:
    if load is None:
        return []
    if load.gripped:
        return [
            f"Does the gripper hold {load.mass_kg:g} kg firmly, and does [tool] cylinders_mm describe that load too?"
        ]
    return [
        f"A weight of {load.mass_kg:g} kg at {load.name} moves with the arm in the tour: a hazard. Is nothing and no "
        f"one below and beside it, its string at most {1e3 * STRING_M:.0f} mm long, the weight at most "
        f"{2e3 * WEIGHT_RADIUS_M:.0f} mm wide and {1e3 * WEIGHT_HEIGHT_M:.0f} mm high?"
    ]


# Joints 1 to 3 are rounded to this grid before planning, so that the same posture gives the same plan and hash.
_GRID_RAD: Final = float(np.radians(0.1))
# Target sigma of one average: it gives 0.02 N of bias from 24 poses.
_TARGET_N, _TARGET_NM = 0.057, 0.0035
# Length of an average of a new tool in that of other tours: its four poses then show as much as eight.
# Drift within a pose counts twice as long, but four long poses are as good as six with two moves less.
_TOOL_AVERAGES: Final = 2.0
_HEAVIEST_KG: Final = {"UR3e": 3.0, "UR5e": 5.0, "UR7e": 7.5, "UR10e": 12.5, "UR12e": 12.5, "UR16e": 16.0, "UR20": 20.0}
_HEAVIEST_OF_ALL_KG: Final = 30.0
# The load of a sweep where [tool] mass_kg is not set.
_HEAVIEST_SWEPT_KG: Final = 5.0
_NO_SERIAL: Final = (
    "the controller reports no serial number, so a completed plan cannot be assigned to an arm: newer PolyScope "
    "versions report it"
)


def take_along_plan(session: Session) -> Run | None:
    """Take the poses of a plan, or of one that is made where the arm stands; None after a dry run."""
    return _AlongPlan(session).take()


class _AlongPlan:
    def __init__(self, session: Session) -> None:
        self._session, self.cell, self.task, self.options = session, session.cell, session.task, session.options
        self._onlookers: tuple[guards.Guard, ...] = ()

    def take(self) -> Run | None:
        """As `take_along_plan`. A dry run never takes control of the arm."""
        cell, dry_run, plan = self.cell, self.options.dry_run, self._session.plan
        certifier = self._certifier()
        if plan is None:
            q = np.round(cell.arm.state().q_rad / _GRID_RAD) * _GRID_RAD
            plan = self.task.plan(certifier, q, self.options.poses)
        elif plan is not (own := plan.of_arm(certifier)):
            cell.note("the plan was made with other kinematics: its moves are proven again with those of this arm")
            plan = own
        records = [] if self._session.resumed is None else self._session.resumed.records()
        kept = [record for record in records if record.stop not in self.options.redo]
        taken = {record.stop for record in kept}
        todo = [stop for stop in plan.stops if stop not in taken]
        judge = self.task.judge(by_hand=False)
        for record in kept:
            cell.journal.show(judge.add(record))
        before = self._look(certifier, plan, todo)
        check(before, CHECKS)
        if dry_run:
            cell.note("the controller's safety limits are not checked: only a program on the controller can query them")
        else:
            # Control of the arm is taken last, when all other checks have passed.
            cell.arm.open(control=True)
            if path := cell.arm.identify().facts.get("control"):
                cell.note(f"control path {path.value}")
            check(before, IN_CONTROL)
        driven = self._choose_pace(before, todo, taken=len(taken))
        if not dry_run:
            return self._tour(before, driven, todo, judge)
        if self._onlookers:
            cell.journal.ask(Question("The page shows the plan until you press Enter", ("",)))
        return None

    @property
    def _serial(self) -> str:
        return self.cell.arm.identify().serial

    def _certifier(self) -> Certifier:
        arm = self.cell.arm
        if not self.options.dry_run and arm.status().tcp_offset is None:
            # An old controller reports no poses before.
            arm.open(control=True)
        info = arm.identify()
        load = self.options.load
        hook_m = None if load is None else load.p_flange_m
        return certifier_for(self.task.cell, info.model, kinematics_of(info), hook_m)

    def _look(self, certifier: Certifier, plan: Plan, todo: Sequence[int]) -> Before:
        """Plan the approach to the first pose that is left, listen to the resting sensor, and show every motion."""
        cell, options, nodes_rad = self.cell, self.options, plan.nodes_rad
        goal = nodes_rad[(todo[0] - 1) % len(nodes_rad) if todo else 0]
        before = Before(
            cell=cell,
            config=self.task.cell,
            certifier=certifier,
            plan=plan,
            approach=plan_approach(certifier.without_load, cell.arm.state().q_rad, goal, SLOW),
            runs=options.runs,
            known=not options.real or has_completed(self._serial, plan.sha256),
            quiet=cell.listen(LISTEN_S),
            resumed=self._session.resumed is not None,
            load=options.load,
        )
        _show_plan(before, options)
        if options.watch is not None:
            self._onlookers = (options.watch(certifier, _range_guard(before)),)
        return before

    def _choose_pace(self, before: Before, todo: Sequence[int], *, taken: int) -> Before:
        """Choose speeds and sampling; show the accuracy to expect with this sensor's noise, and the duration."""
        cell, plan = self.cell, before.plan
        if plan.sweep is not None:
            return choose_sweep_speed(before, slow=self.options.real and not before.known)
        sampling, sigma = _chosen_sampling(before, todo)
        force_N, torque_Nm = rms_sigma(sigma)
        noise = f"sigma of {sampling.average_s:g} s averages: {force_N:.2g} N, {to_place_of(torque_Nm, torque_Nm)} N·m"
        cell.note("; ".join(filter(None, (noise, self.task.forecast(plan, before.certifier, sigma)))))
        slow = self.options.real and not (self.options.fast and before.known)
        if self.options.fast and slow:
            why = f": {_NO_SERIAL}" if self._serial == NOT_REPORTED else ""
            cell.note(f"{'every' if why else 'the first'} run of a plan is slow{why}", warning=True)
        speeds = speeds_of(self.task.cell)
        driven = plan.limited(before.certifier, speeds.limited(SLOW) if slow else speeds)
        total_s = moves_s(driven, todo, before.approach) + len(todo) * (sampling.average_s + 0.6)
        cell.note(
            f"{len(todo)} stops left, at most {np.degrees(driven.top_speed_rad_s):.0f} °/s: "
            f"about {total_s / 60:.1f} min{f'; {taken} poses taken before' if taken else ''}"
        )
        return replace(before, plan=driven, config=replace(before.config, sampling=sampling))

    def _tour(self, before: Before, driven: Before, todo: Sequence[int], judge: Judge) -> Run:
        """Ask the safety questions, then visit every pose that is left; each is on disk before the next move.

        `driven` has the speeds and the sampling of this session; later checks repeat those of `before`.
        """
        cell, options, way = self.cell, self.options, before.approach.way_rad
        load = _range_guard(before)
        learner = None
        if options.mode == "sweep":  # no pose shows what the tool weighs while it moves
            learner = FreeTool(before.certifier.scene.down_base, self.task.cell.tool.mass_kg or _HEAVIEST_SWEPT_KG)
        quiet_std = _quiet_std(driven)
        contact = self._contact_guard(driven, quiet_std, judge.predict if learner is None else learner.predict)
        rows = (
            guards.SupervisorGuard(cell.journal.absence),
            guards.SafetyGuard(),
            guards.PathGuard(cell.limits),
            guards.SensorGuard(cell.limits),
            load,
            contact,
            guards.ModelGuard(cell.limits, before.certifier),
            guards.SettingsGuard(),
            guards.StallGuard(cell.limits),
            guards.SliderGuard(),
            *(() if learner is None else (learner,)),  # it learns what the other guards let pass
            *self._onlookers,
        )

        def on_trip(trip: guards.Tripped) -> None:
            with suppress(SupervisorGone):  # it is recorded all the same, and the tour asks the operator next
                cell.journal.show(GuardTripped(hazard=trip.hazard, words=str(trip)))

        watcher = Watcher(cell, rows, on_trip)
        questions = _SafetyQuestions(before)
        recheck = partial(self._recheck, before, questions)
        with watcher:  # sees an emergency stop at a question too
            if options.questions and todo:
                if before.certifier.arm.hung is not None:
                    words = "Is the weight off the tool? It is hung when the arm stands at its first pose."
                    cell.journal.require(words, assumed=before.known and not options.real)
                questions.ask(way, assumed=before.known and not arm_moves(way))  # one with base or elbow is new
            run = self._session.resumed or self._keep_plan(before.plan)
            book = PoseBook(cell, run, judge, before.certifier.scene.down_base)
            guarded = GuardedCell(cell, watcher, contact=contact, load=load, recheck=recheck)
            tour = (SweepTour if driven.plan.sweep else Tour)(guarded, driven, quiet_std, book, options)
            with cell.journal.reporting_early_end(run):
                tour.run(todo)
        if todo and not before.known:
            self._judge_completed(before.plan, run, tour.undriven)
        return run

    def _contact_guard(
        self, driven: Before, quiet_std: Array, predict: Callable[[Array], Array | None]
    ) -> guards.ContactGuard:
        arm = driven.certifier.arm
        heaviest_kg = self.task.cell.tool.mass_kg or _HEAVIEST_KG.get(arm.name, _HEAVIEST_OF_ALL_KG)
        reach_m = max(float(np.hypot(part.to_m, part.reach_m)) for part in arm.tool)
        acceleration_rad_s2 = driven.plan.acceleration_rad_s2
        return guards.ContactGuard(self.cell.limits, heaviest_kg, reach_m, acceleration_rad_s2, quiet_std, predict)

    def _keep_plan(self, plan: Plan) -> Run:
        run = self._session.new_run()
        plan.save(run.plan_path)
        self.cell.journal.keep_in(run)
        return run

    def _recheck(self, before: Before, questions: _SafetyQuestions, asks: bool) -> None:
        """Repeat the checks after a stop; with `asks`, all the safety questions too."""
        q = self.cell.arm.state().q_rad
        # The next approach is checked when its goal is known.
        stays = plan_approach(before.certifier, q, q, SLOW)
        quiet = self.cell.listen(LISTEN_S)
        check(replace(before, quiet=quiet, approach=stays, known=True, resumed=True), AGAIN)
        if not self.options.questions:
            return
        if asks:
            questions.ask(stays.way_rad, assumed=False)
        else:
            questions.ask_reduced(assumed=False)

    def _judge_completed(self, plan: Plan, run: Run, undriven: Sequence[int]) -> None:
        """Record that the plan was driven to its end, slowly, or show why it does not count."""
        if undriven or (plan.sweep is None and len(run.stops()) <= len(plan.steps)):
            why = "a plan counts as completed when one session takes every pose and drives every move of it; "
            why += f"moves replaced: from {_poses(undriven)} on" if undriven else "poses are missing"
        elif self._serial == NOT_REPORTED:
            why = _NO_SERIAL
        else:
            remember_completed(self._serial, plan.sha256)
            return
        self.cell.note(f"the next run of this plan is slow again and needs the typed word: {why}")


def _range_guard(before: Before) -> guards.RangeGuard:
    return guards.RangeGuard(before.cell.limits, before.sensor_range, before.sensor_zero)


def _quiet_std(driven: Before) -> Array:
    """Return the standard deviation (6,) of the samples of the resting sensor, as in an average of a pose."""
    share = 0.5 if driven.plan.sweep else min(1.0, driven.config.sampling.average_s / LISTEN_S)
    return noise_level(driven.quiet.wrench, max(LEAST_SAMPLES, int(len(driven.quiet) * share)))


def _show_plan(before: Before, options: SessionOptions) -> None:
    cell, plan, way = before.cell, before.plan, before.approach.way_rad
    words = "The arm stands at the first pose."
    if len(way):
        words = f"Approach to the first pose: {way_in_words(way, before.approach.clearance_m)}."
    cell.journal.show(
        Planned(plan=plan, way_rad=way, way_words=words, stop_words=plan.stop_in_words(before.config.robot))
    )
    if options.output is not None:
        plan.save(options.output)
        cell.note(f"plan saved as {options.output}")
    if options.png is not None:
        from ftdrive.planning.drawing import draw

        draw(plan, before.certifier, options.png, way)
        cell.note(f"plan drawn in {options.png}")


def moves_s(plan: Plan, todo: Sequence[int], approach: Approach) -> float:
    """Return the time of all moves at the plan's speeds: the approach to the first of these stops, then to the rest.

    Stops count from 1. Where some are left out between two, there is an approach too, counted as a straight move.
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
    """Return how each pose is averaged, and (6,) one sigma of such an average.

    The duration is configured, or chosen from a record of the sensor's noise. The few poses of a new tool take longer.
    """
    sampling, sigma = _usual_sampling(before, todo)
    if before.load is not None and not before.load.gripped:
        longer = before.load.sampling(sampling)
        before.cell.note(f"a hanging load: {longer.average_s:g} s at each tilt, repeated while it swings by 5° or more")
        return longer, sigma / np.sqrt(longer.average_s / sampling.average_s)
    if before.plan.kind != "tool":
        return sampling, sigma
    before.cell.note(f"a new tool: {_TOOL_AVERAGES:g} times that average at each of its {len(before.plan.steps)} poses")
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


def _poses(numbers: Sequence[int]) -> str:
    *most, last = map(str, numbers)
    return f"poses {', '.join(most)} and {last}" if most else f"pose {last}"
