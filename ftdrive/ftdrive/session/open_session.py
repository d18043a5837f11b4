"""Objects that every mode of a session uses: the open cell, journal, task, judge, and record of the poses."""

import logging
import threading
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Final, Protocol

import numpy as np

from ftcalib import CalibrationResult
from ftcalib.model import Array
from ftcalib.result import Method
from ftcalib.routine import PoseRecord
from ftdrive.cell.config import CellConfig
from ftdrive.errors import ConfigError, Declined, SupervisorGone
from ftdrive.planning.geometry.certify import Certifier
from ftdrive.planning.plan import Plan
from ftdrive.runs.load import Load
from ftdrive.runs.run import IN_MOTION, Mode, Run
from ftdrive.session.events import (
    Asked,
    Compared,
    Estimated,
    Event,
    GuardTripped,
    Hazard,
    Key,
    Noted,
    Operator,
    PoseTaken,
    Question,
    RunOpened,
)
from ftdrive.session.guards import Guard, Limits, RangeGuard
from ftdrivers.clock import Clock
from ftdrivers.errors import DeviceError
from ftdrivers.interfaces import ForceTorqueSensor, FtSamples, RobotArm

log = logging.getLogger(__name__)

_BY_HAND: Final = ("manual", "listen", "passive")


@dataclass(frozen=True, slots=True)
class SessionOptions:
    """Options of a session, as the operator gave them."""

    runs: Path
    name: str = "calibrate"
    poses: int = 24
    sets: str | None = None
    """Sets of orientations, such as A+E, by the letters of Fig. 6 in Yu's paper; they replace `poses`."""
    method: Method = "ml"
    """Method that solves a calibration from its poses."""
    mode: Mode = "auto"
    """Mode of the session; with `resume`, "auto" means the mode of the resumed run."""
    dry_run: bool = False
    fast: bool = False
    """Move at the speeds of the plan if this arm has completed the plan slowly before."""
    plan: Path | None = None
    output: Path | None = None
    """New file in which the plan is saved as well; None if no such file is wanted."""
    png: Path | None = None
    """New PNG file in which the plan is drawn; None if no drawing is wanted."""
    watch: Callable[[Certifier, RangeGuard], Guard] | None = None
    """Called before the first question; returns a further guard, which only observes and never trips."""
    resume: Path | None = None
    redo: tuple[int, ...] = ()
    real: bool = True
    """Whether a real arm moves. An emulated cell needs no typed word and no slow first run."""
    questions: bool = True
    yes: bool = False
    """Answer the safety questions automatically, but never confirm the first motion of a new plan."""
    seconds: float = 20.0
    """Duration of a sweep at the planned speed, or maximum duration of a passive calibration."""
    description: Mapping[str, Any] = field(default_factory=dict)
    """Entries that are added to run.json."""

    @property
    def by_hand(self) -> bool:
        """Whether the operator or a program on the pendant moves the arm."""
        return self.mode in _BY_HAND

    def with_recorded_mode(self) -> "SessionOptions":
        """Return options with the mode of the resumed run; raises `ConfigError` for options that exclude each other."""
        begun = self.mode if self.resume is None else Run(self.resume).mode
        if self.resume is not None and begun in IN_MOTION:
            what = "a sweep" if begun == "sweep" else "a passive calibration"
            raise ConfigError(f"{self.resume} is {what}, which cannot be resumed: start again with --{begun}")
        if self.mode != "auto" and (begun in _BY_HAND) != self.by_hand:
            way = f"with --{begun}" if begun in _BY_HAND else "along a plan"
            raise ConfigError(f"{self.resume} was started {way}, which cannot be changed: leave out --{self.mode}")
        options = replace(self, mode=begun if self.mode == "auto" else self.mode)
        if options.redo and options.resume is None:
            raise ConfigError("--redo needs a run: name the run with --resume RUN")
        if not options.by_hand:
            return options
        given = {
            "--plan": options.plan,
            "--fast": options.fast,
            "--dry-run": options.dry_run,
            "--redo": options.redo,
            "--output": options.output,
            "--png": options.png,
        }
        if wrong := [name for name, value in given.items() if value]:
            raise ConfigError(f"with --{options.mode} ftdrive neither plans nor moves: leave out {' and '.join(wrong)}")
        return options


class Journal:
    """Shows and records every event, one at a time, from any thread; asks the operator.

    With `yes` the journal gives the assumed answer to a question; the operator answers questions that have none.
    """

    def __init__(self, operator: Operator, *, yes: bool = False) -> None:
        self._operator, self._yes = operator, yes
        self._lock = threading.RLock()
        self._run: Run | None = None
        self._early: list[Event] = []
        self._is_seen = True
        self._absence_recorded = False

    def keep_in(self, run: Run) -> None:
        """Record all events in the folder of this run from now on, and those that were shown before."""
        with self._lock:
            self._run = run
            for event in self._early:
                run.append_event(event.to_dict())
            self._early.clear()
        resume = "" if run.mode in IN_MOTION else run.resume_command
        self.show(RunOpened(folder=str(run.folder), resume=resume), sync=True)

    def show(self, event: Event, *, sync: bool = False) -> None:
        """Show and record an event. Raises `SupervisorGone` at the first event that the operator cannot see."""
        with self._lock:
            try:
                self._operator.show(event)
            except SupervisorGone:
                self._record(event, sync=sync)
                if self._is_seen:
                    self._is_seen = False
                    raise
            else:
                self._record(event, sync=sync)

    def _record(self, event: Event, *, sync: bool) -> None:
        self._absence_recorded |= isinstance(event, GuardTripped) and event.hazard == Hazard.SUPERVISOR_GONE
        if self._run is None:
            self._early.append(event)
            return
        try:
            self._run.append_event(event.to_dict(), sync=sync)
        # A lost event does not end the session; a pose that cannot be written does, in `Run.commit`.
        except OSError as error:
            log.warning("events.ndjson cannot be written: %s", error)

    def absence(self) -> str | None:
        """Return why no operator follows the session; None if one does."""
        return self._operator.absence()

    def require_operator(self) -> None:
        """Raise `SupervisorGone` if no operator follows the session."""
        if why := self.absence():
            raise SupervisorGone(why)

    @contextmanager
    def recording_absence(self) -> Iterator[None]:
        """Record a `SupervisorGone` that the block raises, unless it is recorded already."""
        try:
            yield
        except SupervisorGone as gone:
            if not self._absence_recorded:
                with suppress(SupervisorGone):
                    self.show(GuardTripped(hazard=Hazard.SUPERVISOR_GONE, words=str(gone)), sync=True)
            raise

    @contextmanager
    def reporting_early_end(self, run: Run) -> Iterator[None]:
        """If the block raises, show where the data of the run are; then raise the error again."""
        try:
            yield
        except BaseException:
            self.show(Noted(words=_describe_kept(run)), sync=True)
            raise

    def ask(self, question: Question) -> str:
        """Ask; record the answer and who gave it. Raises `SupervisorGone` without an operator, even with `--yes`."""
        assumed = question.assumed if self._yes else None
        with self.recording_absence():  # while the arm stands, no guard runs that would record the absence
            self.require_operator()
            try:
                answer = self._operator.ask(question) if assumed is None else assumed
            except Declined as declined:  # a viewer of the page may have stopped the session
                with self._lock:
                    self._record(Noted(words=str(declined), warning=True), sync=True)
                raise
        self.show(Asked(question=question.text, answer=answer, by="person" if assumed is None else "--yes"))
        return answer

    def require(self, text: str, *, assumed: bool) -> None:
        """Ask a question; raises `Declined` unless the answer is yes."""
        if self.ask(Question(text, assumed="yes" if assumed else None)) != "yes":
            raise Declined(f"not confirmed, nothing moves: {text}")

    @property
    def has_keys(self) -> bool:
        """Whether the operator has keys to press."""
        return self._operator.has_keys

    def pressed(self) -> Key | None:
        """Return the oldest pressed key that was not returned before; None if there is none."""
        return self._operator.pressed()

    @property
    def pressed_by(self) -> str:
        """Return who pressed the key that `pressed` returned last."""
        return self._operator.pressed_by


@dataclass(frozen=True, slots=True, eq=False)
class OpenCell:
    """The open arm and sensor, the cell's clock, the journal, and the limits of the guards."""

    arm: RobotArm
    sensor: ForceTorqueSensor
    clock: Clock
    journal: Journal
    limits: Limits

    def note(self, words: str, *, warning: bool = False) -> None:
        """Show and record a note for the operator."""
        self.journal.show(Noted(words=words, warning=warning))

    def listen(self, duration_s: float) -> FtSamples:
        """Collect samples while the arm rests; a sensor that fails, as after a killed session, is reopened once."""
        try:
            return self.sensor.collect(duration_s)
        except DeviceError as error:
            self.note(f"{error}; trying once more", warning=True)
        self.sensor.close()
        self.sensor.open()
        return self.sensor.collect(duration_s)


class Judge(Protocol):
    """Judges the poses taken so far, by a running fit or by comparison with a calibration."""

    @property
    def weighed_kg(self) -> float | None:
        """Mass that the sensor carries, kg; None while it is uncertain."""

    def add(self, record: PoseRecord) -> Estimated | Compared:
        """Add a pose, which replaces one with the same `stop`; return the new estimate, or the comparison."""

    def remove(self, stop: int) -> None:
        """Remove the pose at a stop before it is taken again; ignore a stop without a pose."""

    def predict(self, R_base_flange: Array) -> Array | None:
        """Wrench (6,), N and N·m, of a free tool at this orientation (3, 3); None while it is uncertain."""


class Task(Protocol):
    """The purpose of a session: which poses it takes, and how they are judged."""

    @property
    def command(self) -> str:
        """Name of the command, as run.json records it."""

    @property
    def cell(self) -> CellConfig:
        """The cell of the session."""

    @property
    def calibration(self) -> CalibrationResult | None:
        """Calibration with which the poses are compared; arm, sensor and mounting must be the same."""

    @property
    def warnings(self) -> tuple[str, ...]:
        """Warnings that are shown before the first pose."""

    @property
    def load(self) -> Load | None:
        """Weighed load on the tool, if any; the tool mass in `cell` includes it."""

    @property
    def goal(self) -> str:
        """Condition under which hand-guided poses suffice, as a clause without a full stop."""

    def plan(self, certifier: Certifier, q_rad: Array, poses: int) -> Plan:
        """Return a plan that starts near joint angles (6,). Raises `PlanRefused` if no suitable plan is found."""

    def judge(self, *, by_hand: bool) -> Judge:
        """Return a new judge of the poses; `by_hand` means that no plan chooses the poses."""

    def forecast(self, plan: Plan, certifier: Certifier, sigma: Array, /) -> str:
        """Describe the accuracy to expect if each pose's average has the sigmas `sigma` (6,); empty if unknown."""


@dataclass(frozen=True, slots=True, eq=False)
class OpenSession:
    """An open cell with the task and the options of the session."""

    cell: OpenCell
    task: Task
    options: SessionOptions
    resumed: Run | None
    """The run that is continued; None for a new run."""
    plan: Plan | None
    """The plan to follow; None if it is made later from the posture of the arm."""
    new_run: Callable[[], Run]
    """Creates the folder of a new run and returns the run."""


@dataclass(frozen=True, slots=True, eq=False)
class PoseBook:
    """Writes the poses of a session to its run, shows them and judges them."""

    cell: OpenCell
    run: Run
    judge: Judge
    down_base: Array
    """(3,) unit vector down, base axes, from the configured mounting."""

    def keep(self, record: PoseRecord, *, stops: int, settle_s: float, average_s: float) -> Estimated | Compared:
        """Write a pose to disk and show it; return the new estimate, or the comparison with a calibration."""
        # Each pose is on disk before the arm moves on: a crash costs only the pose in progress.
        record = self.run.commit(record)
        self.cell.journal.show(
            PoseTaken(
                stop=record.stop,
                stops=stops,
                number=record.pose.number,
                gravity_flange=record.before.R_base_flange.T @ self.down_base,
                mean=record.mean.mean,
                sigma=np.sqrt(np.diag(record.mean.covariance)),
                samples=len(record.samples.t_host_ns),
                settle_s=settle_s,
                average_s=average_s,
                attempts=record.attempts,
                steady=record.steady,
                temperature_C=self.cell.sensor.temperature_C(),
            ),
            sync=True,
        )
        return self.judge.add(record)


def _describe_kept(run: Run) -> str:
    if run.mode == "sweep":
        return f"sweep not completed: {run.folder} has its events but no recording"
    if run.mode == "passive":
        words = f"the recording so far is saved; solve it with\n{run.solve_command}"
        return words if run.in_motion else f"nothing was recorded in {run.folder}"
    words = f"{len(run.stops())} poses saved in {run.folder}; continue with\n{run.resume_command}"
    return words + (f"\nor solve them with\n{run.solve_command}" if run.stops() and run.command == "calibrate" else "")
