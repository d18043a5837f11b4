"""The operator of a session: a terminal, or a script in a test."""

from dataclasses import dataclass
from enum import Enum
from typing import Protocol

from ftdrive.session.events import Event


class Key(Enum):
    """Requests of the operator at any time; the values are the keys of the live screen."""

    KEEP = "k"
    REDO = "r"
    SKIP = "s"
    PAUSE = "p"
    STOP = "q"
    OTHER = ""
    """Any other key: Space, Enter, an arrow, Ctrl-D, Ctrl-Z. It stops an arm in motion."""


@dataclass(frozen=True, slots=True)
class Question:
    """A question that the session waits for."""

    text: str
    """The question, with the meaning of each answer."""
    answers: tuple[str, ...] = ("yes", "no")
    """Accepted answers; a single one must be typed in full."""
    assumed: str | None = None
    """Answer of `--yes`; None if the operator must answer."""


class Operator(Protocol):
    """The operator as the session sees them."""

    def show(self, event: Event) -> None:
        """Show an event; returns at once. Raises `SupervisorGone` if it cannot be seen any more."""

    def ask(self, question: Question) -> str:
        """Wait for one of the question's answers; raises `Declined` or `SupervisorGone` if no operator can answer."""

    def absence(self) -> str | None:
        """Return what shows that no operator follows the session any more, such as a closed terminal; else None.

        Any thread may call it; returns at once.
        """

    @property
    def has_keys(self) -> bool:
        """Whether keys are read; key hints are shown only then."""

    def pressed(self) -> Key | None:
        """Return the oldest key not yet returned, or None; returns at once."""
