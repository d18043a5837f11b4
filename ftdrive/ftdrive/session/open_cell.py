"""A cell in a session: its open devices, how the session reports and asks, and its journal on disk."""

import logging
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass

from ftdrive.errors import Declined, SupervisorGone
from ftdrive.runs.run import IN_MOTION, Run
from ftdrive.session.events import Asked, Event, GuardTripped, Hazard, Key, Noted, Operator, Question, RunOpened
from ftdrive.session.guards import Limits
from ftdrivers.clock import Clock
from ftdrivers.errors import DeviceError
from ftdrivers.interfaces import ForceTorqueSensor, FtSamples, RobotArm

log = logging.getLogger(__name__)


class Journal:
    """Shows and records every event, one at a time, from any thread.

    With `yes` it gives the assumed answer of questions that have one; the operator answers the others.
    """

    def __init__(self, operator: Operator, *, yes: bool = False) -> None:
        self._operator, self._yes = operator, yes
        self._lock = threading.RLock()
        self._run: Run | None = None
        self._early: list[Event] = []
        self._is_seen = True
        self._absence_recorded = False

    def keep_in(self, run: Run) -> None:
        """Record in the run, starting with the events so far."""
        with self._lock:
            self._run = run
            for event in self._early:
                run.append_event(event.to_dict())
            self._early.clear()
        resume = "" if run.mode in IN_MOTION else run.resume_command
        self.show(RunOpened(folder=str(run.folder), resume=resume), sync=True)

    def show(self, event: Event, *, sync: bool = False) -> None:
        """Show and record an event. Raises `SupervisorGone` at the first one that cannot be seen any more."""
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
        # A pose that cannot be written raises.
        except OSError as error:
            log.warning("events.ndjson cannot be written: %s", error)

    def absence(self) -> str | None:
        """As `Operator.absence`."""
        return self._operator.absence()

    def require_operator(self) -> None:
        """Raise `SupervisorGone` if no operator follows the session any more."""
        if why := self.absence():
            raise SupervisorGone(why)

    @contextmanager
    def recording_absence(self) -> Iterator[None]:
        """Record a `SupervisorGone` of the block, unless its event is recorded already."""
        try:
            yield
        except SupervisorGone as gone:
            if not self._absence_recorded:
                with suppress(SupervisorGone):
                    self.show(GuardTripped(hazard=Hazard.SUPERVISOR_GONE, words=str(gone)), sync=True)
            raise

    def ask(self, question: Question) -> str:
        """Ask; record the answer and who gave it. Raises `SupervisorGone`, also where `--yes` would answer."""
        assumed = question.assumed if self._yes else None
        with self.recording_absence():  # the arm stands
            self.require_operator()
            answer = self._operator.ask(question) if assumed is None else assumed
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
        """Return the next key pressed."""
        return self._operator.pressed()


@dataclass(frozen=True, slots=True, eq=False)
class OpenCell:
    """Arm and sensor, open; the clock that times them, the journal, and the limits of the session."""

    arm: RobotArm
    sensor: ForceTorqueSensor
    clock: Clock
    journal: Journal
    limits: Limits

    def note(self, words: str, *, warning: bool = False) -> None:
        """Show a note."""
        self.journal.show(Noted(words=words, warning=warning))

    def listen(self, duration_s: float) -> FtSamples:
        """Collect samples of the resting sensor; reopen it once if it fails, as after a killed session."""
        try:
            return self.sensor.collect(duration_s)
        except DeviceError as error:
            self.note(f"{error}; trying once more", warning=True)
        self.sensor.close()
        self.sensor.open()
        return self.sensor.collect(duration_s)
