"""A whole session: open the cell, plan, check, show, ask, move and average, solve, save."""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import closing, contextmanager, suppress
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from calib.data.averaging_time import averaging_time
from calib.data.dwell_mean import LEAST_SAMPLES, mean_and_covariance, noise_level
from calib.routine import PoseRecord, Sampling
from drivers.errors import DriverError
from drivers.interfaces import NOT_REPORTED, DeviceInfo, ForceTorqueSensor, FtSamples, RobotArm
from ftdrive.cell.config import CellConfig
from ftdrive.cell.devices import build_arm, build_sensor
from ftdrive.errors import ConfigError, Declined, NotAccepted
from ftdrive.planning.approach import arm_moves, plan_approach
from ftdrive.planning.cell_plan import certifier_for, plan_for, speeds_of
from ftdrive.planning.geometry.scene import down_of
from ftdrive.planning.motion import slower
from ftdrive.planning.plan import Plan
from ftdrive.planning.search.constant_tour import constant_tour
from ftdrive.planning.show.words import point_in_words, turns_in_words, way_in_words
from ftdrive.runs.outcome import Outcome, solve_and_save
from ftdrive.runs.run import Mode, Run
from ftdrive.session import preflight
from ftdrive.session.completed import has_completed, remember_completed
from ftdrive.session.events import GuardTripped, Noted, Planned, State, StateChanged
from ftdrive.session.forecast import at_most, moves_s, prediction
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
from ftdrive.session.hand_guided import collect_manually
from ftdrive.session.identity import require_same_devices
from ftdrive.session.journal import Journal
from ftdrive.session.live_fit import Running
from ftdrive.session.operator import Operator
from ftdrive.session.recovery import Recovery
from ftdrive.session.tour import SLOW, Pace, Tour
from ftdrive.session.watchdog import Watcher

Array = NDArray[np.float64]

_GRID_RAD: Final = float(np.radians(0.1))
"""Plans are made where joints 1 to 3 stand, to this grid: the same place gives the same plan, and hash, again."""
_TARGET_N, _TARGET_NM = 0.057, 0.0035
"""Of one average: 0.02 N of bias from 24 poses."""
_BY_HAND: Final = ("manual", "listen")
_HEAVIEST_KG: Final = {"UR3e": 3.0, "UR5e": 5.0, "UR7e": 7.5, "UR10e": 12.5, "UR12e": 12.5, "UR16e": 16.0, "UR20": 20.0}
_HEAVIEST_OF_ALL_KG: Final = 30.0
_NO_SERIAL: Final = (
    "the controller tells no serial number, so nobody knows which arm has run a plan to its end (a younger PolyScope "
    "tells it)"
)


@dataclass(frozen=True, slots=True)
class Options:
    """What a person asked for."""

    runs: Path
    name: str = "calibrate"
    poses: int = 24
    mode: Mode = "auto"
    """A run that is resumed keeps to its own where nothing else is said."""
    dry_run: bool = False
    fast: bool = False
    """At the plan's speeds, once it has run to its end slowly."""
    plan: Path | None = None
    output: Path | None = None
    """Save the plan as a new file."""
    png: Path | None = None
    """Draw it."""
    view: bool = False
    """Show it in the browser, until a person has seen it."""
    resume: Path | None = None
    redo: tuple[int, ...] = ()
    real: bool = True
    """Something real moves. An emulated cell needs no typed word and no slow first run."""
    questions: bool = True
    yes: bool = False
    """Nobody is asked what a question assumes."""
    description: Mapping[str, Any] = field(default_factory=dict)
    """Goes into run.json."""


def calibrate(cell: CellConfig, operator: Operator, options: Options, limits: Limits | None = None) -> Outcome | None:
    """Lead a person through a calibration; None after a dry run.

    Raises
    ------
    Declined
        A person ended it.
    NotAccepted, PlanRefused, ConfigError
        It may not begin.
    DriverError, OSError
        It was broken off; what was taken stands in the run, which can be resumed.
    """
    limits = limits or (Limits.emulated() if cell.clock.emulated else Limits())
    journal = Journal(operator, yes=options.yes)
    journal.show(StateChanged(state=State.IDLE))
    options = as_begun(options)
    by_hand = options.mode in _BY_HAND
    plan = None if by_hand else _plan_on_disk(options)
    device, driver = build_sensor(cell), build_arm(cell)
    if options.resume is not None:
        journal.keep_in(Run(options.resume))
    with device as sensor, closing(driver) as arm, preflight.awake() as kept_awake:
        arm.open()
        journal.show(StateChanged(state=State.PREFLIGHT))
        if not by_hand:
            preflight.require_no_program(arm, cell.clock, limits)
        devices = {"arm": asdict(arm.identify()), "sensor": asdict(sensor.identify())}
        if by_hand:
            run = _by_hand(cell, arm, sensor, journal, options, devices)
        else:
            journal.show(Noted(words=kept_awake))
            if not options.dry_run and arm.status().tcp_offset is None:
                arm.open(control=True)  # an old controller tells no poses before
            begun = _Begun(cell, arm, sensor, journal, options, plan, limits)
            begun.look()
            begun.check(preflight.CHECKS)
            if options.dry_run:
                journal.show(
                    Noted(words="the controller's own safety limits are not asked for: only a program on it could")
                )
            else:
                arm.open(control=True)
                begun.check(preflight.IN_CONTROL)
            begun.predict()
            if options.dry_run:
                return None
            run = begun.tour(devices)
    if not run.stops():
        raise Declined(f"ended before the first pose: {run.folder} holds nothing to solve")
    journal.show(StateChanged(state=State.REPORT))
    return solve_and_save(run)


def as_begun(options: Options) -> Options:
    """Give a run that is resumed the mode it was begun in; raises `ConfigError` for options that do not go together."""
    begun = options.mode if options.resume is None else Run(options.resume).header().get("mode", "auto")
    if options.mode != "auto" and (begun in _BY_HAND) != (options.mode in _BY_HAND):
        way = f"with --{begun}" if begun in _BY_HAND else "along a plan"
        raise ConfigError(f"{options.resume} was begun {way} and can only go on like that: leave out --{options.mode}")
    options = replace(options, mode=begun if options.mode == "auto" else options.mode)
    if options.redo and options.resume is None:
        raise ConfigError("--redo takes poses of a run again: name the run with --resume RUN")
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
        raise ConfigError(f"with --{options.mode} ftdrive plans and moves nothing: leave out {' and '.join(wrong)}")
    return options


def _plan_on_disk(options: Options) -> Plan | None:
    """Load the plan of the run that is resumed, or the one that is named; raises `ConfigError` for poses it has not."""
    if options.resume is None:
        return None if options.plan is None else Plan.load(options.plan)
    plan = Plan.load(Run(options.resume).plan_path)
    stops = len(plan.steps) + 1
    if wrong := sorted(stop for stop in options.redo if not 1 <= stop <= stops):
        raise ConfigError(f"pose {wrong[0]} cannot be taken again: the run has poses 1 to {stops}")
    return plan


class _Begun:
    """A session along a plan: it looks, checks, predicts, then tours. It never takes control: `calibrate` does."""

    def __init__(
        self,
        cell: CellConfig,
        arm: RobotArm,
        sensor: ForceTorqueSensor,
        journal: Journal,
        options: Options,
        plan: Plan | None,
        limits: Limits,
    ) -> None:
        self._cell, self._arm, self._sensor, self._journal, self._options = cell, arm, sensor, journal, options
        self._limits = limits
        self._reduced = False  # as a person has said it should be
        info: DeviceInfo = arm.identify()
        self._certifier = certifier_for(cell, info.model)
        self._old = None if options.resume is None else Run(options.resume, cell.clock)
        self._plan = plan or self._planned()
        document = self._plan.to_dict()
        self._key = (info.serial, str(document["sha256"]))
        self._known = not options.real or has_completed(*self._key)
        speeds = slower(speeds_of(cell), SLOW) if self._slow else speeds_of(cell)
        self._driven = at_most(self._plan, self._certifier, speeds)
        down_base = self._certifier.scene.down_base
        self._running = Running(g_m_s2=cell.site.g_m_s2, down_base=down_base, advise=False)

    def look(self) -> None:
        """See what is left to take, how the arm gets there and what the resting sensor says; show it."""
        cell, arm, sensor, options, limits = self._cell, self._arm, self._sensor, self._options, self._limits
        q = self._stands_rad = arm.state().q_rad
        self._todo, self._taken = self._what_is_left()
        for record in self._taken:
            self._journal.show(self._running.add(record))
        first = self._todo[0] - 1 if self._todo else 0
        goal = np.array(self._plan.steps[first % len(self._plan.steps)].q_rad)
        self._before = preflight.Before(
            cell=cell,
            arm=arm,
            sensor=sensor,
            certifier=self._certifier,
            plan=self._plan,
            approach=plan_approach(self._certifier, q, goal, SLOW),
            runs=options.runs,
            known=self._known,
            quiet=self._listen(preflight.LISTEN_S),
            resumed=self._old is not None,
            limits=limits,
            sensor_range=_range_of(sensor),
        )
        self._way = self._before.approach.way_rad
        self._show()

    def _planned(self) -> Plan:
        """Make a plan where the arm stands."""
        q = np.round(self._arm.state().q_rad / _GRID_RAD) * _GRID_RAD
        with suppress(ConfigError):  # the planner says what to do about it
            q[3:5] = constant_tour(q)[0, 3:5]  # wherever the wrist was left; joint 6 tells how the cable is wound
        return plan_for(self._cell, self._certifier, q, self._options.poses)

    def _what_is_left(self) -> tuple[list[int], list[PoseRecord]]:
        """Stops to take, and records that stand."""
        stops = range(1, len(self._plan.steps) + 2)
        if self._old is None:
            return list(stops), []
        require_same_devices(self._old, self._cell, self._arm, self._sensor)
        kept = [record for record in self._old.records() if record.stop not in self._options.redo]
        have = {record.stop for record in kept}
        return [stop for stop in stops if stop not in have], kept

    def _listen(self, duration_s: float) -> FtSamples:
        """Take samples of the resting sensor; one that fails, as after a killed session, is opened once more."""
        try:
            return self._sensor.collect(duration_s)
        except DriverError as error:
            self._journal.show(Noted(words=f"{error}; trying once more", warning=True))
        self._sensor.close()
        self._sensor.open()
        return self._sensor.collect(duration_s)

    def check(self, checks: Sequence[preflight.Row]) -> None:
        """Tell what each finds; raise `NotAccepted` when one failed."""
        failed = []
        for check in checks:
            found = check(self._before)
            self._journal.show(found)
            if not found.passed:
                failed.append(f"{found.name}: {found.words}")
        if failed:
            raise NotAccepted("nothing moves: " + "; ".join(failed))

    def _chosen_sampling(self) -> tuple[Sampling, Array]:
        """How long to average, as configured or as the noise of a record asks; (6,) one sigma of such an average."""
        sampling = self._cell.sampling
        if not (sampling.noise_record_s and self._todo):
            variance = np.diag(mean_and_covariance(self._before.quiet.wrench).covariance)
            return sampling, np.sqrt(variance * preflight.LISTEN_S / sampling.average_s)
        self._journal.show(
            Noted(words=f"listening to the sensor for {sampling.noise_record_s:g} s; do not touch the arm")
        )
        record = self._listen(sampling.noise_record_s)
        chosen = averaging_time(
            record.wrench,
            len(record) / sampling.noise_record_s,
            target_force_N=_TARGET_N,
            target_torque_Nm=_TARGET_NM,
        )
        self._journal.show(Noted(words=chosen.words))
        return replace(sampling, average_s=chosen.seconds), chosen.sigma

    def _show(self) -> None:
        """Show every motion to come: in words, and as the options ask in files and in the browser."""
        options, plan, way = self._options, self._plan, self._way
        words = "The arm stands at the first pose to be taken."
        if len(way):
            near = way_in_words(way, self._before.approach.clearance_m)
            words = f"The way to the first pose to be taken, from where the arm stands: {near}."
        self._journal.show(Planned(plan=plan, way_rad=way, way_words=words))
        if options.output is not None:
            plan.save(options.output)
            self._journal.show(Noted(words=f"the plan is saved as {options.output}"))
        if options.png is not None:
            from ftdrive.planning.show.picture import draw

            draw(plan, self._certifier, options.png, way)
            self._journal.show(Noted(words=f"the plan is drawn in {options.png}"))
        if options.view:
            from ftdrive.planning.show.view import open_in_browser, shown

            with shown(plan, self._certifier, way) as url:
                open_in_browser(url)
                self._journal.require(f"The plan is shown at {url} until you answer. Go on?", assumed=False)

    def predict(self) -> None:
        """Choose how long to average; tell what the plan is worth with this sensor's noise, and how long it takes."""
        self._sampling, noise = self._chosen_sampling()
        mass_kg, average_s = self._cell.tool.mass_kg, self._sampling.average_s
        self._journal.show(Noted(words=prediction(self._plan, self._certifier, mass_kg, average_s, noise)))
        if self._options.fast and self._slow:
            why = f": {_NO_SERIAL}" if self._key[0] == NOT_REPORTED else ""
            words = f"{'every' if why else 'the first'} run of a plan is slow, whatever was asked{why}"
            self._journal.show(Noted(words=words, warning=True))
        fastest_rad_s = max(step.speed_rad_s for step in self._driven.steps)
        total_s = moves_s(self._driven, self._todo, self._stands_rad, self._before.approach)
        total_s += len(self._todo) * (average_s + 0.6)
        self._journal.show(
            Noted(
                words=f"stops to come: {len(self._todo)}, at most {np.degrees(fastest_rad_s):.0f}°/s: about "
                f"{total_s / 60:.1f} min; {len(self._taken)} poses are there already"
            )
        )

    @property
    def _slow(self) -> bool:
        return self._options.real and not (self._options.fast and self._known)

    @property
    def _pace(self) -> Pace:
        options = self._options
        return Pace(
            step=options.mode == "step",
            trusted=self._known,
            asks=options.questions,
            yes=options.yes,
        )

    def tour(self, devices: Mapping[str, Any]) -> Run:
        """Ask, move, keep."""
        journal, plan, cell = self._journal, self._driven, self._cell
        quiet = self._before.quiet.wrench
        window = int(len(quiet) * min(1.0, self._sampling.average_s / preflight.LISTEN_S))
        quiet_std = noise_level(quiet, max(LEAST_SAMPLES, window))
        name = self._certifier.arm.name
        heaviest_kg = cell.tool.mass_kg or _HEAVIEST_KG.get(name, _HEAVIEST_OF_ALL_KG)
        reach_m = max(float(np.hypot(part.to_m, part.reach_m)) for part in self._certifier.arm.tool)
        load = RangeGuard(self._limits, self._before.sensor_range)
        contact = ContactGuard(
            self._limits, heaviest_kg, reach_m, plan.acceleration_rad_s2, quiet_std, self._running.predict
        )
        rows: Sequence[Guard] = (
            SafetyGuard(),
            PathGuard(self._limits),
            SensorGuard(self._limits),
            load,
            contact,
            ModelGuard(self._limits, self._certifier),
            SettingsGuard(),
            StallGuard(self._limits),
        )

        def on_trip(trip: Tripped) -> None:
            journal.show(GuardTripped(hazard=trip.hazard, words=str(trip)))

        watcher = Watcher(self._arm, self._sensor, rows, on_trip, clock=cell.clock, limits=self._limits)
        with watcher:  # an emergency stop at a question counts too
            if self._options.questions and self._todo:
                self._ask(assumed=self._known and not arm_moves(self._way))  # nobody has seen a way of the arm
            run = self._run(devices)
            tour = Tour(
                self._arm,
                self._sensor,
                self._certifier,
                plan,
                run,
                journal,
                self._running,
                watcher,
                recovery=Recovery(self._arm, self._sensor, journal, watcher, contact, self._recheck),
                load=load,
                sampling=self._sampling,
                pace=self._pace,
                quiet_std=quiet_std,
                sensor_kg=cell.sensor.mass_kg,
            )
            with _kept(journal, run):
                tour.run(self._todo)
        if self._todo and not self._known:
            self._judge_completed(run, tour.undriven)
        return run

    def _judge_completed(self, run: Run, undriven: Sequence[int]) -> None:
        """Note that the plan has run to its end, slowly, or say why this does not count."""
        if undriven or len(run.stops()) <= len(self._plan.steps):
            why = "a plan counts as run to its end when one session takes every pose and drives every move along it; "
            why += f"not driven so: from {_poses(undriven)} on" if undriven else "poses are missing"
        elif self._key[0] == NOT_REPORTED:
            why = _NO_SERIAL
        else:
            remember_completed(*self._key)
            return
        self._journal.show(
            Noted(words=f"the next run of this plan is slow again and begins with the typed word: {why}")
        )

    def _recheck(self, asks: bool) -> None:
        """Do the checks again after a stop; with `asks`, all of the preflight: the questions again too."""
        q = self._arm.state().q_rad
        stays = plan_approach(self._certifier, q, q, SLOW)  # the way on is judged by itself, once it is known where to
        quiet = self._listen(preflight.LISTEN_S)
        self._before = replace(self._before, quiet=quiet, approach=stays, known=True, resumed=True)
        self._way = stays.way_rad
        self.check(preflight.AGAIN)
        if not self._options.questions:
            return
        if asks:
            self._ask(assumed=False)
        else:
            self._ask_reduced(assumed=False)

    def _ask(self, *, assumed: bool) -> None:
        room = "" if self._plan.arm_rests else ", and the room of the whole arm, which moves too,"
        if arm_moves(self._way):
            room = f", and the room of the whole arm, which moves on its way there too ({turns_in_words(self._way)}),"
        for text in (
            "Is the tool free: nothing touches it, nothing is held, no fluid, cables slack, the base bolted?",
            f"Is the ball of {self._plan.ball_m:.2f} m around {point_in_words(self._plan)} (the wrist){room} free, "
            "of people too?",
            "Is the emergency stop in reach, and tested?",
        ):
            self._journal.require(text, assumed=assumed)
        self._ask_reduced(assumed=assumed)

    def _ask_reduced(self, *, assumed: bool) -> None:
        """Ask whether reduced mode is meant, once as long as it lasts."""
        reduced = self._arm.status().safety_mode == "reduced"
        if reduced and not self._reduced:
            self._journal.require("The controller is in reduced mode. Is that as it should be?", assumed=assumed)
        self._reduced = reduced

    def _run(self, devices: Mapping[str, Any]) -> Run:
        if self._old is not None:
            return self._old
        options, clock = self._options, self._cell.clock
        run = Run.create(options.runs, options.name, _description(self._cell, devices, options), clock)
        self._plan.save(run.plan_path)
        self._journal.keep_in(run)
        return run


def _poses(numbers: Sequence[int]) -> str:
    *most, last = map(str, numbers)
    return f"poses {', '.join(most)} and {last}" if most else f"pose {last}"


def _range_of(sensor: ForceTorqueSensor) -> Array | None:
    """Largest wrench (6,) of the sensor, as far as its driver knows."""
    fact = sensor.identify().facts.get("range")
    return None if fact is None else np.asarray(fact.value, dtype=np.float64)


@contextmanager
def _kept(journal: Journal, run: Run) -> Iterator[None]:
    """Say where the poses are when a session ends before its time."""
    try:
        yield
    except BaseException:
        words = f"{len(run.stops())} poses are kept in {run.folder}; go on with {run.resume_command}"
        words += f", or solve them with {run.solve_command}" if run.stops() else ""
        journal.show(Noted(words=words), sync=True)
        raise


def _by_hand(
    cell: CellConfig,
    arm: RobotArm,
    sensor: ForceTorqueSensor,
    journal: Journal,
    options: Options,
    devices: Mapping[str, Any],
) -> Run:
    """No motion command at all: a person moves the arm, or a program on the pendant does."""
    if options.resume is None:
        run, earlier = Run.create(options.runs, options.name, _description(cell, devices, options), cell.clock), []
        journal.keep_in(run)
    else:
        run = Run(options.resume, cell.clock)
        require_same_devices(run, cell, arm, sensor)
        earlier = run.records()
    down_base, listen = down_of(cell.workcell.mounting), options.mode == "listen"
    running = Running(g_m_s2=cell.site.g_m_s2, down_base=down_base)
    with _kept(journal, run):
        collect_manually(
            arm,
            sensor,
            cell.sampling,
            journal,
            running.add,
            run.commit,
            clock=cell.clock,
            down_base=down_base,
            listen=listen,
            earlier=earlier,
        )
    return run


def _description(cell: CellConfig, devices: Mapping[str, Any], options: Options) -> dict[str, Any]:
    return {"config": cell.to_dict(), "devices": dict(devices), "mode": options.mode, **options.description}
