"""A whole session: open the cell, then look, check, predict and tour. A calibration is then solved and saved."""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import closing, contextmanager, suppress
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any, Final

import numpy as np

from ftcalib.data.averaging_time import averaging_time
from ftcalib.data.dwell_mean import LEAST_SAMPLES, mean_and_covariance, noise_level
from ftcalib.model import Array
from ftcalib.routine import PoseRecord, Sampling
from ftdrive.cell.config import CellConfig
from ftdrive.cell.devices import build_arm, build_sensor
from ftdrive.errors import ConfigError, Declined, NotAccepted
from ftdrive.planning.approach import arm_moves, plan_approach
from ftdrive.planning.cell_plan import certifier_for, speeds_of
from ftdrive.planning.geometry.certify import Certifier
from ftdrive.planning.geometry.scene import down_of
from ftdrive.planning.motion import slower
from ftdrive.planning.plan import Plan
from ftdrive.planning.search.constant_tour import constant_tour
from ftdrive.planning.show.words import way_in_words
from ftdrive.runs.outcome import Outcome, solve_and_save
from ftdrive.runs.run import Mode, Run
from ftdrive.session import preflight
from ftdrive.session.completed_plans import has_completed, remember_completed
from ftdrive.session.events import GuardTripped, Noted, Planned, State, StateChanged
from ftdrive.session.forecast import at_most, moves_s
from ftdrive.session.guards import (
    ContactGuard,
    Guard,
    Limits,
    ModelGuard,
    PathGuard,
    RangeGuard,
    SafetyGuard,
    SensorGuard,
    SettingsGuard,
    StallGuard,
    Tripped,
)
from ftdrive.session.hand_guided import Recorder, collect_manually
from ftdrive.session.identity import require_same_devices
from ftdrive.session.journal import Journal
from ftdrive.session.live_fit import Judge
from ftdrive.session.operator import Operator
from ftdrive.session.recovery import GuardedCell, Recovery
from ftdrive.session.safety_questions import SafetyQuestions
from ftdrive.session.task import Task
from ftdrive.session.tour import SLOW, Measuring, Pace, Tour
from ftdrive.session.watchdog import Watcher
from ftdrivers.errors import DriverError
from ftdrivers.interfaces import NOT_REPORTED, ForceTorqueSensor, FtSamples, RobotArm

_GRID_RAD: Final = float(np.radians(0.1))
"""Joints 1 to 3 are rounded to this grid before planning, so that the same posture gives the same plan and hash."""
_TARGET_N, _TARGET_NM = 0.057, 0.0035
"""Target sigma of one average: it gives 0.02 N of bias from 24 poses."""
_BY_HAND: Final = ("manual", "listen")
_HEAVIEST_KG: Final = {"UR3e": 3.0, "UR5e": 5.0, "UR7e": 7.5, "UR10e": 12.5, "UR12e": 12.5, "UR16e": 16.0, "UR20": 20.0}
_HEAVIEST_OF_ALL_KG: Final = 30.0
_NO_SERIAL: Final = (
    "the controller reports no serial number, so a completed plan cannot be assigned to an arm: newer PolyScope "
    "versions report it"
)


@dataclass(frozen=True, slots=True)
class SessionOptions:
    """Options of a session, as the operator gave them."""

    runs: Path
    name: str = "calibrate"
    poses: int = 24
    mode: Mode = "auto"
    """With `resume`, "auto" means the mode of that run."""
    dry_run: bool = False
    fast: bool = False
    """Move at the plan's speeds if it has run to its end slowly before."""
    plan: Path | None = None
    output: Path | None = None
    """Save the plan as a new file."""
    png: Path | None = None
    """Draw it."""
    view: bool = False
    """Show it in the browser until the operator answers."""
    resume: Path | None = None
    redo: tuple[int, ...] = ()
    real: bool = True
    """Whether a real arm moves. An emulated cell needs no typed word and no slow first run."""
    questions: bool = True
    yes: bool = False
    """Answer the safety questions automatically, never the first motion."""
    description: Mapping[str, Any] = field(default_factory=dict)
    """Goes into run.json."""


def calibrate(
    cell: CellConfig, operator: Operator, options: SessionOptions, limits: Limits | None = None
) -> Outcome | None:
    """Guide the operator through a calibration; None after a dry run. Raises as `take_poses`."""
    run = take_poses(cell, operator, options, Task(), limits)
    return None if run is None else solve_and_save(run)


def take_poses(
    cell: CellConfig, operator: Operator, options: SessionOptions, task: Task, limits: Limits | None = None
) -> Run | None:
    """Guide the operator through the poses of a task; None after a dry run.

    Raises
    ------
    Declined
        The operator ended it.
    NotAccepted, PlanRefused, ConfigError
        The session refuses to start.
    DriverError, OSError
        The session failed; the poses taken are in the run, which can be resumed.
    """
    limits = limits or Limits.of(cell.clock)
    journal = Journal(operator, yes=options.yes)
    journal.show(StateChanged(state=State.IDLE))
    options = with_recorded_mode(options)
    by_hand = options.mode in _BY_HAND
    run = None if options.resume is None else Run(options.resume, cell.clock)
    if run is not None and run.command != task.command:
        raise ConfigError(f"{run.folder} was not made by {task.command}: continue it with {run.resume_command}")
    plan = None if by_hand else _plan_on_disk(options, run)
    device, driver = build_sensor(cell), build_arm(cell)
    if run is not None:
        journal.keep_in(run)
    with device as sensor, closing(driver) as arm, preflight.awake() as kept_awake:
        arm.open()
        journal.show(StateChanged(state=State.PREFLIGHT))
        if not by_hand:
            preflight.require_no_program(arm, cell.clock, limits)
            if options.real and not options.dry_run:
                journal.show(Noted(words=kept_awake))
        connected = {"arm": arm.identify(), "sensor": sensor.identify()}
        for words in task.require(connected, cell.sensor.mount):
            journal.show(Noted(words=words, warning=True))
        devices = {role: asdict(device) for role, device in connected.items()}
        session = _Session(cell, arm, sensor, journal, options, task, limits, run, devices)
        run = _by_hand(session) if by_hand else _along_a_plan(session, *_certified_plan(session, plan))
    if run is None:
        return None
    if not run.stops():
        raise Declined(f"ended before the first pose: {run.folder} has no pose to solve")
    journal.show(StateChanged(state=State.REPORT))
    return run


def with_recorded_mode(options: SessionOptions) -> SessionOptions:
    """Return options with the mode of the resumed run; raises `ConfigError` for options that exclude each other."""
    begun = options.mode if options.resume is None else Run(options.resume).header().get("mode", "auto")
    if options.mode != "auto" and (begun in _BY_HAND) != (options.mode in _BY_HAND):
        way = f"with --{begun}" if begun in _BY_HAND else "along a plan"
        raise ConfigError(f"{options.resume} was started {way} and only continues so: leave out --{options.mode}")
    options = replace(options, mode=begun if options.mode == "auto" else options.mode)
    if options.redo and options.resume is None:
        raise ConfigError("--redo needs a run: name the run with --resume RUN")
    if options.mode not in _BY_HAND:
        return options
    no_motion = {
        "--plan": options.plan is not None,
        "--fast": options.fast,
        "--dry-run": options.dry_run,
        "--redo": bool(options.redo),
        "--output": options.output is not None,
        "--png": options.png is not None,
        "--view": options.view,
    }
    if wrong := [name for name, given in no_motion.items() if given]:
        raise ConfigError(f"with --{options.mode} ftdrive neither plans nor moves: leave out {' and '.join(wrong)}")
    return options


def _plan_on_disk(options: SessionOptions, run: Run | None) -> Plan | None:
    """Load the plan of the resumed run, or the given one; raises `ConfigError` if it lacks a pose of `redo`."""
    if run is None:
        return None if options.plan is None else Plan.load(options.plan)
    plan = Plan.load(run.plan_path)
    stops = len(plan.steps) + 1
    if wrong := sorted(stop for stop in options.redo if not 1 <= stop <= stops):
        raise ConfigError(f"pose {wrong[0]} cannot be taken again: the run has poses 1 to {stops}")
    return plan


def _certified_plan(session: "_Session", plan: Plan | None) -> tuple[Certifier, Plan]:
    """Describe the cell to a certifier; without a plan, make one where the arm stands."""
    cell, arm, options = session.cell, session.arm, session.options
    if not options.dry_run and arm.status().tcp_offset is None:
        arm.open(control=True)  # an old controller reports no poses before
    certifier = certifier_for(cell, arm.identify().model)
    if plan is not None:
        return certifier, plan
    q = np.round(arm.state().q_rad / _GRID_RAD) * _GRID_RAD
    with suppress(ConfigError):  # the planner reports it, with what to do
        q[3:5] = constant_tour(q)[0, 3:5]  # joint 6 keeps its turn: it shows how the cable is wound
    return certifier, session.task.plan(cell, certifier, q, options.poses)


@dataclass(frozen=True, slots=True, eq=False)
class _Session:
    """Open devices, options and limits of a session."""

    cell: CellConfig
    arm: RobotArm
    sensor: ForceTorqueSensor
    journal: Journal
    options: SessionOptions
    task: Task
    limits: Limits
    run: Run | None
    """The run that is resumed."""
    devices: Mapping[str, Any]
    """Identities of arm and sensor."""

    @property
    def serial(self) -> str:
        """Of the arm."""
        return str(self.devices["arm"]["serial"])

    def note(self, words: str, *, warning: bool = False) -> None:
        self.journal.show(Noted(words=words, warning=warning))

    def new_run(self) -> Run:
        """Create the run folder."""
        options = self.options
        description = {"command": self.task.command, **_description(self.cell, self.devices, options)}
        return Run.create(options.runs, options.name, description, self.cell.clock)

    def listen(self, duration_s: float) -> FtSamples:
        """Collect samples of the resting sensor; reopen it once if it fails, as after a killed session."""
        try:
            return self.sensor.collect(duration_s)
        except DriverError as error:
            self.note(f"{error}; trying once more", warning=True)
        self.sensor.close()
        self.sensor.open()
        return self.sensor.collect(duration_s)


@dataclass(frozen=True, slots=True, eq=False)
class _Looked:
    """First stage: which poses are left, how the arm reaches the first of them, what the resting sensor reports."""

    session: _Session
    before: preflight.Before
    stands_rad: Array
    """(6,) posture of the arm."""
    todo: Sequence[int]
    """Stops left to take."""
    taken: int
    """Poses taken before."""
    judge: Judge

    @property
    def slow(self) -> bool:
        """Whether the arm moves at the speed of a first run."""
        options = self.session.options
        return options.real and not (options.fast and self.before.known)


@dataclass(frozen=True, slots=True, eq=False)
class _Predicted:
    """Second stage: how fast the plan is driven, how long each average takes."""

    looked: _Looked
    driven: Plan
    """The plan with the speeds of this session."""
    sampling: Sampling


def _along_a_plan(session: _Session, certifier: Certifier, plan: Plan) -> Run | None:
    """Take the arm along a plan; None after a dry run, which never takes control of the arm."""
    dry_run, arm = session.options.dry_run, session.arm
    looked = _look(session, certifier, plan)
    _check(session.journal, looked.before, preflight.CHECKS)
    if dry_run:
        session.note("the controller's safety limits are not checked: only a program on the controller can query them")
    else:
        arm.open(control=True)
        if path := arm.identify().facts.get("control"):
            session.note(f"control path {path.value}")
        _check(session.journal, looked.before, preflight.IN_CONTROL)
    predicted = _predict(looked)
    if dry_run:
        return None
    run, undriven = _tour(predicted)
    if looked.todo and not looked.before.known:
        _judge_completed(looked, run, undriven)
    return run


def _look(session: _Session, certifier: Certifier, plan: Plan) -> _Looked:
    """Find what is left to take, plan the approach, listen to the resting sensor; show all of it."""
    cell, arm, options = session.cell, session.arm, session.options
    judge = session.task.judge(cell, certifier.scene.down_base, by_hand=False)
    q = arm.state().q_rad
    todo, taken = _what_is_left(session, plan)
    for record in taken:
        session.journal.show(judge.add(record))
    first = todo[0] - 1 if todo else 0
    goal = np.array(plan.steps[first % len(plan.steps)].q_rad)
    before = preflight.Before(
        cell=cell,
        arm=arm,
        sensor=session.sensor,
        certifier=certifier,
        plan=plan,
        approach=plan_approach(certifier, q, goal, SLOW),
        runs=options.runs,
        known=not options.real or has_completed(session.serial, plan.sha256),
        quiet=session.listen(preflight.LISTEN_S),
        resumed=session.run is not None,
        limits=session.limits,
        sensor_range=_range_of(session.sensor),
    )
    _show(session, before)
    return _Looked(session, before, q, todo, len(taken), judge)


def _what_is_left(session: _Session, plan: Plan) -> tuple[list[int], list[PoseRecord]]:
    """Return the stops to take, and the records that are kept."""
    stops, run = range(1, len(plan.steps) + 2), session.run
    if run is None:
        return list(stops), []
    require_same_devices(run, session.cell.sensor, session.arm, session.sensor)
    kept = [record for record in run.records() if record.stop not in session.options.redo]
    have = {record.stop for record in kept}
    return [stop for stop in stops if stop not in have], kept


def _show(session: _Session, before: preflight.Before) -> None:
    """Show every motion to come: in words, and as the options ask in files and in the browser."""
    options, plan, way = session.options, before.plan, before.approach.way_rad
    words = "The arm stands at the first pose."
    if len(way):
        near = way_in_words(way, before.approach.clearance_m)
        words = f"Approach to the first pose: {near}."
    session.journal.show(Planned(plan=plan, way_rad=way, way_words=words))
    if options.output is not None:
        plan.save(options.output)
        session.note(f"plan saved as {options.output}")
    if options.png is not None:
        from ftdrive.planning.show.picture import draw

        draw(plan, before.certifier, options.png, way)
        session.note(f"plan drawn in {options.png}")
    if options.view:
        from ftdrive.planning.show.view import open_in_browser, shown

        with shown(plan, before.certifier, way) as url:
            open_in_browser(url)
            session.journal.require(f"The plan is shown at {url} until you answer. Go on?", assumed=False)


def _check(journal: Journal, before: preflight.Before, rows: Sequence[preflight.Row]) -> None:
    """Show what each check finds; raises `NotAccepted` if one failed."""
    failed = []
    for row in rows:
        found = row(before)
        journal.show(found)
        if not found.passed:
            failed.append(f"{found.name}: {found.words}")
    if failed:
        raise NotAccepted("nothing moves: " + "; ".join(failed))


def _predict(looked: _Looked) -> _Predicted:
    """Choose how long to average; show the accuracy to expect with this sensor's noise, and the duration."""
    session, before = looked.session, looked.before
    sampling, noise = _chosen_sampling(looked)
    cell, average_s, real = session.cell, sampling.average_s, session.options.real
    session.note(session.task.forecast(cell, before.certifier, before.plan, average_s, noise, real=real))
    if session.options.fast and looked.slow:
        why = f": {_NO_SERIAL}" if session.serial == NOT_REPORTED else ""
        session.note(f"{'every' if why else 'the first'} run of a plan is slow{why}", warning=True)
    speeds = speeds_of(session.cell)
    driven = at_most(before.plan, before.certifier, slower(speeds, SLOW) if looked.slow else speeds)
    fastest_rad_s = max(step.speed_rad_s for step in driven.steps)
    total_s = moves_s(driven, looked.todo, looked.stands_rad, before.approach)
    total_s += len(looked.todo) * (average_s + 0.6)
    session.note(
        f"{len(looked.todo)} stops left, at most {np.degrees(fastest_rad_s):.0f}°/s: about {total_s / 60:.1f} min; "
        f"{looked.taken} poses taken before"
    )
    return _Predicted(looked, driven, sampling)


def _chosen_sampling(looked: _Looked) -> tuple[Sampling, Array]:
    """Return how each pose is averaged, and (6,) one sigma of such an average.

    The duration is configured, or chosen from a record of the sensor's noise.
    """
    session, sampling = looked.session, looked.session.cell.sampling
    if not (sampling.noise_record_s and looked.todo):
        variance = np.diag(mean_and_covariance(looked.before.quiet.wrench).covariance)
        return sampling, np.sqrt(variance * preflight.LISTEN_S / sampling.average_s)
    session.note(f"recording the sensor's noise for {sampling.noise_record_s:g} s: do not touch the arm")
    record = session.listen(sampling.noise_record_s)
    chosen = averaging_time(
        record.wrench,
        len(record) / sampling.noise_record_s,
        target_force_N=_TARGET_N,
        target_torque_Nm=_TARGET_NM,
    )
    session.note(chosen.words)
    return replace(sampling, average_s=chosen.seconds), chosen.sigma


def _tour(predicted: _Predicted) -> tuple[Run, list[int]]:
    """Ask the safety questions, then visit every pose that is left; each is on disk before the next move.

    Returns the run, and the poses of `Tour.undriven`.
    """
    looked, session, before = predicted.looked, predicted.looked.session, predicted.looked.before
    journal, options, limits = session.journal, session.options, session.limits
    quiet = before.quiet.wrench
    window = int(len(quiet) * min(1.0, predicted.sampling.average_s / preflight.LISTEN_S))
    quiet_std = noise_level(quiet, max(LEAST_SAMPLES, window))
    load = RangeGuard(limits, before.sensor_range)
    contact = _contact_guard(predicted, quiet_std)
    rows: Sequence[Guard] = (
        SafetyGuard(),
        PathGuard(limits),
        SensorGuard(limits),
        load,
        contact,
        ModelGuard(limits, before.certifier),
        SettingsGuard(),
        StallGuard(limits),
    )

    def on_trip(trip: Tripped) -> None:
        journal.show(GuardTripped(hazard=trip.hazard, words=str(trip)))

    watcher = Watcher(session.arm, session.sensor, rows, on_trip, clock=session.cell.clock, limits=limits)
    with watcher:  # sees an emergency stop at a question too
        questions = SafetyQuestions(session.arm, journal, before.plan)
        way = before.approach.way_rad
        if options.questions and looked.todo:
            questions.ask(
                way, assumed=before.known and not arm_moves(way)
            )  # an approach with base, shoulder or elbow is new
        run = session.run or _run_of(looked)
        cell = GuardedCell(session.arm, session.sensor, journal, watcher)
        tour = Tour(
            cell,
            predicted.driven,
            before.certifier,
            run,
            looked.judge,
            Recovery(cell, contact, partial(_recheck, looked, questions)),
            Measuring(predicted.sampling, quiet_std, load, session.cell.sensor.mass_kg),
            Pace(options.mode == "step", trusted=before.known, asks=options.questions, yes=options.yes),
        )
        with _kept(journal, run):
            tour.run(looked.todo)
    return run, tour.undriven


def _contact_guard(predicted: _Predicted, quiet_std: Array) -> ContactGuard:
    looked, session, arm = predicted.looked, predicted.looked.session, predicted.looked.before.certifier.arm
    heaviest_kg = session.cell.tool.mass_kg or _HEAVIEST_KG.get(arm.name, _HEAVIEST_OF_ALL_KG)
    reach_m = max(float(np.hypot(part.to_m, part.reach_m)) for part in arm.tool)
    acceleration_rad_s2 = predicted.driven.acceleration_rad_s2
    return ContactGuard(session.limits, heaviest_kg, reach_m, acceleration_rad_s2, quiet_std, looked.judge.predict)


def _run_of(looked: _Looked) -> Run:
    """Create the run, with the plan in it."""
    run = looked.session.new_run()
    looked.before.plan.save(run.plan_path)
    looked.session.journal.keep_in(run)
    return run


def _recheck(looked: _Looked, questions: SafetyQuestions, asks: bool) -> None:
    """Repeat the checks after a stop; with `asks`, all the safety questions too."""
    session, before = looked.session, looked.before
    q = session.arm.state().q_rad
    stays = plan_approach(before.certifier, q, q, SLOW)  # the next approach is checked when its goal is known
    quiet = session.listen(preflight.LISTEN_S)
    again = replace(before, quiet=quiet, approach=stays, known=True, resumed=True)
    _check(session.journal, again, preflight.AGAIN)
    if not session.options.questions:
        return
    if asks:
        questions.ask(stays.way_rad, assumed=False)
    else:
        questions.ask_reduced(assumed=False)


def _judge_completed(looked: _Looked, run: Run, undriven: Sequence[int]) -> None:
    """Record that the plan was driven to its end, slowly, or show why it does not count."""
    plan, serial = looked.before.plan, looked.session.serial
    if undriven or len(run.stops()) <= len(plan.steps):
        why = "a plan counts as completed when one session takes every pose and drives every move of it; "
        why += f"moves replaced: from {_poses(undriven)} on" if undriven else "poses are missing"
    elif serial == NOT_REPORTED:
        why = _NO_SERIAL
    else:
        remember_completed(serial, plan.sha256)
        return
    looked.session.note(f"the next run of this plan is slow again and needs the typed word: {why}")


def _poses(numbers: Sequence[int]) -> str:
    *most, last = map(str, numbers)
    return f"poses {', '.join(most)} and {last}" if most else f"pose {last}"


def _range_of(sensor: ForceTorqueSensor) -> Array | None:
    """Largest wrench (6,) of the sensor, as far as its driver knows."""
    fact = sensor.identify().facts.get("range")
    return None if fact is None else np.asarray(fact.value, dtype=np.float64)


@contextmanager
def _kept(journal: Journal, run: Run) -> Iterator[None]:
    """Show where the poses are when a session ends early."""
    try:
        yield
    except BaseException:
        words = f"{len(run.stops())} poses saved in {run.folder}; continue with {run.resume_command}"
        words += f", or solve them with {run.solve_command}" if run.stops() and run.command == "calibrate" else ""
        journal.show(Noted(words=words), sync=True)
        raise


def _by_hand(session: _Session) -> Run:
    """Collect poses without any motion command: the operator moves the arm, or a program on the pendant does."""
    cell, journal, run, earlier = session.cell, session.journal, session.run, list[PoseRecord]()
    if run is None:
        run = session.new_run()
        journal.keep_in(run)
    else:
        require_same_devices(run, cell.sensor, session.arm, session.sensor)
        earlier = run.records()
    down_base = down_of(cell.workcell.mounting)
    judge = session.task.judge(cell, down_base, by_hand=True)
    with _kept(journal, run):
        collect_manually(
            session.arm,
            session.sensor,
            cell.sampling,
            journal,
            Recorder(judge.add, run.commit, earlier, session.task.goal),
            clock=cell.clock,
            down_base=down_base,
            listen=session.options.mode == "listen",
        )
    return run


def _description(cell: CellConfig, devices: Mapping[str, Any], options: SessionOptions) -> dict[str, Any]:
    return {"config": cell.to_dict(), "devices": dict(devices), "mode": options.mode, **options.description}
