"""Programs of the controller, and their errors."""

from typing import Any, NamedTuple


class Place(NamedTuple):
    """A position in the text of a program: line and column, both counted from 1."""

    line: int = 1
    column: int = 1


class ScriptError(Exception):
    """A run-time error, which ends the program."""


class ControllerProgram:
    """A program on the controller. This base class is a program of the pendant that loops until it is stopped."""

    reads_registers = False
    """Whether the program executes the commands that a client writes into `COMMAND_REGISTERS`."""

    def __init__(self, name: str) -> None:
        self.name = name
        self.doubts: list[str] = []
        """Constructs in the text of the program that real controllers are reported to reject."""

    @property
    def place(self) -> Place:
        """Current position of the program in its text."""
        return Place()

    def step(self) -> bool:
        """Run one control cycle; return False if the program has ended."""
        return True

    def close(self) -> None:
        """End the program; a moving arm comes to rest."""


def error_at(place: Place, text: str) -> dict[str, Any]:
    """Return the fields of the event log for an error in a program."""
    return {"error": text, "line": place.line, "column": place.column}
