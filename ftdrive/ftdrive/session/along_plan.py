"""A session along a plan: planning, checks, questions and guards; and the register of completed plans."""

import json
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import replace
from datetime import UTC, datetime
from functools import partial
from typing import Final

import numpy as np

from ftcalib.files import read_file
from ftcalib.model import Array
from ftdrive.cell.config import user_folder
from ftdrive.errors import SupervisorGone
from ftdrive.planning.approach import plan_approach
from ftdrive.planning.geometry.certify import Certifier
from ftdrive.planning.motion import arm_moves
from ftdrive.planning.plan import Plan, turns_in_words, way_in_words
from ftdrive.planning.planner import certifier_for
from ftdrive.runs.run import Run
from ftdrive.session import guards
from ftdrive.session.drive import SLOW, GuardedCell
from ftdrive.session.events import GuardTripped, Planned, Question
from ftdrive.session.open_session import OpenSession, PoseBook, SessionOptions
from ftdrive.session.preflight import AGAIN, CHECKS, IN_CONTROL, LISTEN_S, Before, run_checks
from ftdrive.session.watchdog import Watcher
from ftdrivers.interfaces import NOT_REPORTED
from ftdrivers.ur.kinematics import kinematics_of

FORMAT = "ftdrive.completed/1"
# File of completed plans in the user's state folder.
_COMPLETED = "completed.ndjson"


def has_completed(arm_serial: str, plan_sha256: str) -> bool:
    """Return whether this arm completed this plan before; always False if the arm reports no serial number."""
    path = user_folder("state") / _COMPLETED
    if arm_serial == NOT_REPORTED or not path.is_file():
        return False
    wanted = {"format": FORMAT, "arm": arm_serial, "plan": plan_sha256}
    return any(
        wanted.items() <= _parse_entry(line).items() for line in read_file(path).decode(errors="replace").splitlines()
    )


def remember_completed(arm_serial: str, plan_sha256: str) -> None:
    """Record in the user's state folder that this arm completed this plan: every move and pose in one slow session."""
    path = user_folder("state") / _COMPLETED
    path.parent.mkdir(parents=True, exist_ok=True)
    line = {"format": FORMAT, "arm": arm_serial, "plan": plan_sha256, "utc": datetime.now(UTC).isoformat()}
    with path.open("a", encoding="utf-8") as file:
        file.write(json.dumps(line) + "\n")


def _parse_entry(line: str) -> dict[str, object]:
    try:
        found = json.loads(line)
    except ValueError:
        return {}
    return found if isinstance(found, dict) else {}


class _SafetyQuestions:
    """Asks about free tool, free space, emergency stop and reduced mode; raises `Declined` if one is not confirmed."""

    def __init__(self, before: Before) -> None:
        self._arm, self._journal = before.cell.arm, before.cell.journal
        self._plan, self._load = before.plan, before.task.load
        self._reduced = False  # whether the operator has confirmed that reduced mode is active

    def ask(self, way_rad: Array, *, assumed: bool) -> None:
        """Ask all safety questions before the arm moves along `way_rad` (k, 6); with `assumed`, `--yes` may answer."""
        room = "" if self._plan.arm_rests else ", and the space around the whole arm, which moves too,"
        if arm_moves(way_rad):
            room = f", and the space around the whole arm, which moves in the approach ({turns_in_words(way_rad)}),"
        for text in (
            *(() if self._load is None else self._load.questions),
            "Is the tool free: no contact, no workpiece, no fluid, cables slack? Is the base bolted?",
            f"Is the space {self._plan.ball_in_words()} (the wrist){room} free of obstacles and people?",
            "Is the emergency stop within reach, and tested?",
        ):
            self._journal.require(text, assumed=assumed)
        self.ask_reduced(assumed=assumed)

    def ask_reduced(self, *, assumed: bool) -> None:
        """Ask whether reduced mode is intended, once per change to reduced mode."""
        reduced = self._arm.status().safety_mode == "reduced"
        if reduced and not self._reduced:
            self._journal.require("The controller is in reduced mode. Is that intended?", assumed=assumed)
        self._reduced = reduced


# Joints 1 to 3 are rounded to this grid before planning, so that the same posture gives the same plan and hash.
_GRID_RAD: Final = float(np.radians(0.1))
_HEAVIEST_KG: Final = {"UR3e": 3.0, "UR5e": 5.0, "UR7e": 7.5, "UR10e": 12.5, "UR12e": 12.5, "UR16e": 16.0, "UR20": 20.0}
_HEAVIEST_OF_ALL_KG: Final = 30.0
NO_SERIAL: Final = (
    "the controller reports no serial number, so a completed plan cannot be assigned to this arm; newer PolyScope "
    "versions report one"
)


class AlongPlan:
    """A session along a plan: makes, checks and shows the plan; then guards the arm while it moves.

    Parameters
    ----------
    session : OpenSession
    planned : callable
        Makes the plan from joint angles (6,) if none is on disk.

    Raises
    ------
    NotAccepted
        A preflight check failed: nothing moves. A dry run never takes control of the arm.
    """

    def __init__(self, session: OpenSession, planned: Callable[[Certifier, Array], Plan]) -> None:
        self._session, self.cell, self.task, self.options = session, session.cell, session.task, session.options
        self._onlookers: tuple[guards.Guard, ...] = ()
        cell, plan = self.cell, session.plan
        certifier = self._certifier()
        if plan is None:
            plan = planned(certifier, np.round(cell.arm.state().q_rad / _GRID_RAD) * _GRID_RAD)
        elif plan is not (own := plan.of_arm(certifier)):
            cell.note("the plan was made with other kinematics: its moves are now proven with those of this arm")
            plan = own
        records = [] if session.resumed is None else session.resumed.records()
        kept = {record.stop: record for record in records if record.stop not in self.options.redo}
        self.taken = len(kept)
        """Number of poses of the resumed run that are not taken again; 0 in a new run."""
        self.todo = [stop for stop in plan.stops if stop not in kept]
        """Numbers of the stops, from 1, that this session still has to take, in order."""
        self.judge = self.task.judge(by_hand=False)
        for record in kept.values():
            cell.journal.show(self.judge.add(record))
        self.before = self._look(certifier, plan)
        """Input of the preflight checks; its plan still has the planned speeds, not those chosen for this session."""
        run_checks(self.before, CHECKS)
        if self.options.dry_run:
            cell.note("the controller's safety limits are not checked: only a program on the controller can do that")
            return
        # Take control of the arm only when all other checks have passed.
        cell.arm.open(control=True)
        if path := cell.arm.identify().facts.get("control"):
            cell.note(f"control path {path.value}")
        run_checks(self.before, IN_CONTROL)

    @property
    def serial(self) -> str:
        """Serial number of the arm; empty if the controller does not report it."""
        serial = self.cell.arm.identify().serial
        return "" if serial == NOT_REPORTED else serial

    def _certifier(self) -> Certifier:
        arm, load = self.cell.arm, self.task.load
        if not self.options.dry_run and arm.status().tcp_offset is None:
            # An old controller reports its TCP, and with it the flange pose, only to a program that runs on it.
            arm.open(control=True)
        info, hook_m = arm.identify(), None if load is None else load.p_flange_m
        return certifier_for(self.task.cell, info.model, kinematics_of(info), hook_m)

    def _look(self, certifier: Certifier, plan: Plan) -> Before:
        """Plan the approach to the first remaining pose, read the resting sensor, and show all motion."""
        cell, options, todo, nodes_rad = self.cell, self.options, self.todo, plan.nodes_rad
        goal = nodes_rad[(todo[0] - 1) % len(nodes_rad) if todo else 0]
        before = Before(
            cell=cell,
            config=self.task.cell,
            certifier=certifier,
            plan=plan,
            approach=plan_approach(certifier.without_load, cell.arm.state().q_rad, goal, SLOW),
            runs=options.runs,
            known=not options.real or has_completed(cell.arm.identify().serial, plan.sha256),
            quiet=cell.listen(LISTEN_S),
            resumed=self._session.resumed is not None,
            task=self.task,
        )
        _show_plan(before, options)
        if options.watch is not None:
            self._onlookers = (options.watch(certifier, _range_guard(before)),)
        return before

    def end_dry_run(self) -> None:
        """Keep the plan page open until the operator presses Enter."""
        if self._onlookers:
            self.cell.journal.ask(Question("The page shows the plan until you press Enter", ("",)))

    @contextmanager
    def guarding(
        self,
        driven: Before,
        quiet_std: Array,
        predict: Callable[[Array], Array | None],
        *onlookers: guards.Guard,
    ) -> Iterator[tuple[GuardedCell, PoseBook]]:
        """Ask the safety questions, then guard the cell during the block; yield the guarded cell and the pose book.

        `driven` has the speeds and the sampling of this session. `quiet_std` (6,) is the standard deviation of the
        resting sensor's samples, and `predict` is as in `Judge`. The `onlookers`, guards too, are called last.
        """
        cell, options, before, way = self.cell, self.options, self.before, self.before.approach.way_rad
        load = _range_guard(before)
        contact = self._contact_guard(driven, quiet_std, predict)
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
            *onlookers,
            *self._onlookers,
        )

        def on_trip(trip: guards.Tripped) -> None:
            with suppress(SupervisorGone):  # the event is recorded all the same, and the drive then asks the operator
                cell.journal.show(GuardTripped(hazard=trip.hazard, words=str(trip)))

        watcher = Watcher(cell, rows, on_trip)
        questions = _SafetyQuestions(before)
        recheck = partial(self._recheck, questions)
        with watcher:  # the watcher also sees an emergency stop during a question
            if options.questions and self.todo:
                if before.certifier.arm.hung is not None:
                    words = "Is the weight off the tool? Hang it only when the arm is at the first pose."
                    cell.journal.require(words, assumed=before.known and not options.real)
                questions.ask(way, assumed=before.known and not arm_moves(way))  # this approach has never been driven
            run = self._session.resumed or self._keep_plan()
            book = PoseBook(cell, run, self.judge, before.certifier.scene.down_base)
            guarded = GuardedCell(cell, watcher, contact=contact, load=load, recheck=recheck)
            with cell.journal.reporting_early_end(run):
                yield guarded, book

    def _contact_guard(
        self, driven: Before, quiet_std: Array, predict: Callable[[Array], Array | None]
    ) -> guards.ContactGuard:
        arm = driven.certifier.arm
        heaviest_kg = self.task.cell.tool.mass_kg or _HEAVIEST_KG.get(arm.name, _HEAVIEST_OF_ALL_KG)
        reach_m = max(float(np.hypot(part.to_m, part.reach_m)) for part in arm.tool)
        acceleration_rad_s2 = driven.plan.acceleration_rad_s2
        return guards.ContactGuard(self.cell.limits, heaviest_kg, reach_m, acceleration_rad_s2, quiet_std, predict)

    def _keep_plan(self) -> Run:
        run = self._session.new_run()
        self.before.plan.save(run.plan_path)
        self.cell.journal.keep_in(run)
        return run

    def _recheck(self, questions: _SafetyQuestions, asks: bool) -> None:
        """Repeat the preflight checks after a stop, and if `asks` is true also all safety questions."""
        before, q = self.before, self.cell.arm.state().q_rad
        # The next approach is checked later, when its goal is known.
        stays = plan_approach(before.certifier, q, q, SLOW)
        quiet = self.cell.listen(LISTEN_S)
        run_checks(replace(before, quiet=quiet, approach=stays, known=True, resumed=True), AGAIN)
        if not self.options.questions:
            return
        if asks:
            questions.ask(stays.way_rad, assumed=False)
        else:
            questions.ask_reduced(assumed=False)

    def judge_completed(self, missing: str = "") -> None:
        """Record that this arm completed the plan, or show why not; `missing` describes missing poses or moves."""
        if not self.todo or self.before.known:
            return
        if missing:
            why = f"a plan is completed when one session takes every pose and makes every planned move; {missing}"
        elif not self.serial:
            why = NO_SERIAL
        else:
            remember_completed(self.serial, self.before.plan.sha256)
            return
        self.cell.note(f"plan not completed, so its next run is slow again and needs the typed word: {why}")


def _range_guard(before: Before) -> guards.RangeGuard:
    return guards.RangeGuard(before.cell.limits, before.sensor_range, before.sensor_zero)


def _show_plan(before: Before, options: SessionOptions) -> None:
    cell, plan, way = before.cell, before.plan, before.approach.way_rad
    words = "The arm is at the first pose."
    if len(way):
        words = f"Approach to the first pose: {way_in_words(way, before.approach.clearance_m)}."
    cell.journal.show(
        Planned(plan=plan, way_rad=way, way_words=words, stop_words=plan.stop_in_words(before.config.robot))
    )
    if options.output is not None:
        plan.save(options.output)
        cell.note(f"plan saved as {options.output}")
    if options.png is not None:
        from ftdrive.planning.drawing import draw_plan

        draw_plan(plan, before.certifier, options.png, way)
        cell.note(f"plan drawn in {options.png}")
