"""A program as the controller runs it, and its errors."""

from typing import Any, NamedTuple


class Place(NamedTuple):
    """Where in a program something stands: line and column, both from 1."""

    line: int = 1
    column: int = 1


class ScriptError(Exception):
    """A run-time error of the program; it ends."""


class ControllerProgram:
    """A program as the controller runs it. This one was loaded at the pendant, and loops there until it is stopped."""

    reads_registers = False
    """Whether it obeys the commands that a client writes into `COMMAND_REGISTERS`."""

    def __init__(self, name: str) -> None:
        self.name = name
        self.doubts: list[str] = []
        """What a controller is reported to reject in its text."""

    @property
    def place(self) -> Place:
        """Where it is in its text."""
        return Place()

    def step(self) -> bool:
        """Run one control cycle; return False when the program has ended."""
        return True

    def close(self) -> None:
        """End the program; a moving arm comes to rest."""


def error_at(place: Place, text: str) -> dict[str, Any]:
    """Return what the event log keeps of an error in a program."""
    return {"error": text, "line": place.line, "column": place.column}
