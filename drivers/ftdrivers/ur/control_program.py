"""Our program on the controller, as the driver sees it: its text, its registers, its commands and what it reports.

`program.script` describes the registers; tests compare both. Its constructs are those of programs that are known to run
on controllers: docs/reference/urscript-constructs.md.

Ref: Universal Robots, URScript manual, "Real-Time Data Exchange (RTDE) Guide".
Checked on hardware: no.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from importlib.resources import files
from types import MappingProxyType
from typing import Any, Final, Self

NAME: Final = "ftdrive_control"
"""Of the program on the controller."""
INPUTS: Final = MappingProxyType(
    {f"input_int_register_{k}": "INT32" for k in range(32, 36)}
    | {f"input_double_register_{k}": "DOUBLE" for k in range(24, 34)}
)
"""Heartbeat, token, sequence number, command; numbers of the command."""
OUTPUTS: Final = MappingProxyType(
    {"timestamp": "DOUBLE"}
    | {f"output_int_register_{k}": "INT32" for k in range(32, 36)}
    | {f"output_double_register_{k}": "DOUBLE" for k in range(24, 30)}
)
"""The controller's time; token, state, sequence number and answer of the last command; the TCP."""
NUMBERS: Final = 10
"""Of a command, at most."""
COMMANDS: Final = MappingProxyType(
    {
        "move": 1,
        "stop": 2,
        "within_safety_limits": 3,
        "tcp_offset": 4,
        "set_payload": 5,
        "set_gravity": 6,
        "quit": 7,
        "wave": 8,
        "sweep": 9,
    }
)
"""By the names of `control_child.Calls`, which has no sweep."""
MOVING: Final = ("move", "sweep")
"""Commands that begin a motion."""
_MOVING: Final = 2
_NO_HEARTBEAT: Final = -2


@dataclass(frozen=True, slots=True)
class Report:
    """What the program has written into its output registers."""

    token: int = 0
    state: int = 0
    sequence: int = 0
    answer: int = 0
    tcp_offset: tuple[float, ...] = ()

    @classmethod
    def of(cls, numbers: Sequence[Any]) -> Self:
        """Read the values of `OUTPUTS` after the first."""
        token, state, sequence, answer, *tcp_offset = numbers
        return cls(token, state, sequence, answer, tuple(tcp_offset))

    @property
    def moves(self) -> bool:
        """Whether the program is carrying out a move."""
        return self.state == _MOVING

    @property
    def has_ended(self) -> bool:
        """Whether it has ended by itself."""
        return self.state < 0

    @property
    def missed_heartbeat(self) -> bool:
        """Whether it has ended because no heartbeat came."""
        return self.state == _NO_HEARTBEAT


def without_comments(text: str) -> str:
    """Return a program without its lines of comment and empty lines, as UR's client library sends it too."""
    return "".join(f"{line}\n" for line in text.splitlines() if line.strip() and not line.lstrip().startswith("#"))


def program_text(token: int, version: Sequence[int], stop_rad_s2: float) -> str:
    """Return the program for one session on a controller of this version, with the deceleration of its stops."""
    com, inertia = (", ".join(f"ft_number({k})" for k in numbers) for numbers in (range(1, 4), range(4, 10)))
    payload = f"set_payload(ft_number(0), [{com}])"
    if tuple(version[:2]) >= (5, 10):
        payload = f"set_target_payload(ft_number(0), [{com}], [{inertia}])"
    text = without_comments(files("ftdrivers.ur").joinpath("program.script").read_text("ascii"))
    fields = {"$TOKEN": str(token), "$DECELERATION": f"{stop_rad_s2:.4f}", "$SET_PAYLOAD": payload}
    for field, value in fields.items():
        text = text.replace(field, value)
    return text
