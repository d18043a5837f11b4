"""The person beside the robot, as a session sees them: a terminal, a script in a test, or nobody."""

from dataclasses import dataclass
from enum import Enum
from typing import Protocol

from ftdrive.session.events import Event


class Key(Enum):
    """What a person can ask for at any time; the values are the keys of the live screen."""

    KEEP = "k"
    REDO = "r"
    SKIP = "s"
    PAUSE = "p"
    STOP = "q"


@dataclass(frozen=True, slots=True)
class Question:
    """A question that the session waits for."""

    text: str
    """Complete, with what the answers mean."""
    answers: tuple[str, ...] = ("yes", "no")
    """What may be answered; a single one must be typed in full and is never assumed."""
    assumed: str | None = None
    """What `--yes` answers in the place of a person; None when a person must."""


class Operator(Protocol):
    """Whoever runs the session."""

    def show(self, event: Event) -> None:
        """Show an event; returns at once."""

    def ask(self, question: Question) -> str:
        """Return one of the question's answers, waiting as long as it takes; raises `Declined` when there is nobody."""

    @property
    def has_keys(self) -> bool:
        """Whether `pressed` can ever tell one: nobody is told to press what is not heard."""

    def pressed(self) -> Key | None:
        """Take the oldest key that was pressed and not yet taken; returns at once."""
