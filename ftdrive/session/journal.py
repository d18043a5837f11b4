"""Where the session talks to the person and keeps its diary."""

import logging
import threading

from ftdrive.errors import Declined
from ftdrive.runs.run import Run
from ftdrive.session.events import Asked, Event, RunOpened
from ftdrive.session.operator import Key, Operator, Question

log = logging.getLogger(__name__)


class Journal:
    """The person, and the diary: every event goes to both, from any thread, one at a time.

    Parameters
    ----------
    yes : bool
        Take what questions assume, where they assume something; the person is asked the others.
    """

    def __init__(self, operator: Operator, *, yes: bool = False) -> None:
        self._operator, self._yes = operator, yes
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
        self.show(RunOpened(folder=str(run.folder), resume=run.resume_command), sync=True)

    def show(self, event: Event, *, sync: bool = False) -> None:
        """Show and keep an event."""
        with self._lock:
            self._operator.show(event)
            if self._run is None:
                self._early.append(event)
                return
            try:
                self._run.append_event(event.to_dict(), sync=sync)
            except OSError as error:  # the poses' own files say so where it matters
                log.warning("events.ndjson cannot be written: %s", error)

    def ask(self, question: Question) -> str:
        """Ask, and keep the answer, and who gave it."""
        assumed = question.assumed if self._yes else None
        answer = self._operator.ask(question) if assumed is None else assumed
        self.show(Asked(question=question.text, answer=answer, by="person" if assumed is None else "--yes"))
        return answer

    def require(self, text: str, *, assumed: bool) -> None:
        """Ask a question that only yes answers; raises `Declined`."""
        if self.ask(Question(text, assumed="yes" if assumed else None)) != "yes":
            raise Declined(f"not confirmed, nothing moves on: {text}")

    @property
    def has_keys(self) -> bool:
        """Whether the person has keys to press."""
        return self._operator.has_keys

    def pressed(self) -> Key | None:
        """Take a key."""
        return self._operator.pressed()
