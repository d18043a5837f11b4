"""Sends every event of a session to the operator and to the run folder."""

import logging
import threading

from ftdrive.errors import Declined
from ftdrive.runs.run import Run
from ftdrive.session.events import Asked, Event, RunOpened
from ftdrive.session.operator import Key, Operator, Question

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

    def keep_in(self, run: Run) -> None:
        """Record in the run, starting with the events so far."""
        with self._lock:
            self._run = run
            for event in self._early:
                run.append_event(event.to_dict())
            self._early.clear()
        self.show(RunOpened(folder=str(run.folder), resume=run.resume_command), sync=True)

    def show(self, event: Event, *, sync: bool = False) -> None:
        """Show and record an event."""
        with self._lock:
            self._operator.show(event)
            if self._run is None:
                self._early.append(event)
                return
            try:
                self._run.append_event(event.to_dict(), sync=sync)
            except OSError as error:  # a pose that cannot be written raises
                log.warning("events.ndjson cannot be written: %s", error)

    def ask(self, question: Question) -> str:
        """Ask; record the answer and who gave it."""
        assumed = question.assumed if self._yes else None
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
