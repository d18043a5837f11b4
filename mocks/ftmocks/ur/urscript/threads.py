"""The threads of a URScript program, the names that they see, and exceptions that leave a block."""

from collections.abc import Generator
from dataclasses import dataclass

from ftmocks.ur.controller_program import Place
from ftmocks.ur.urscript.syntax import Function
from ftmocks.ur.urscript.values import Value

Run = Generator[None, None, Value]
"""A running computation of a program; each `next()` runs it for one control cycle."""


class Halt(Exception):
    """Exception with which the program ends itself (``halt``)."""


class Leave(Exception):
    """Exception with which ``break``, ``continue`` or ``return`` leaves its block."""

    def __init__(self, word: str, value: Value = None) -> None:
        self.word, self.value = word, value


class Thread:
    """A thread of a program: its name as owner of the arm, its computation, and its position in the text."""

    def __init__(self, name: str) -> None:
        self.name = name
        self.steps: Run | None = None
        self.place = Place()

    @property
    def is_done(self) -> bool:
        """Whether the thread has ended or was killed."""
        return self.steps is None

    def step(self) -> None:
        """Run one control cycle."""
        try:
            if self.steps is not None:
                next(self.steps)
        except StopIteration:
            self.steps = None

    def kill(self) -> None:
        """End the thread; an arm that it moves decelerates by itself."""
        steps, self.steps = self.steps, None
        if steps is not None:
            steps.close()


@dataclass
class Scope:
    """Scope of a statement: its thread, the variables of its function, and the functions that it can call."""

    thread: Thread
    function: Function
    outer: "Scope | None"
    variables: dict[str, Value]

    def find(self, name: str) -> "tuple[Function, Scope] | None":
        """Return the function with this name, and the scope in which it is defined."""
        if name in self.function.functions:
            return self.function.functions[name], self
        return self.outer.find(name) if self.outer else None
