"""Programs that clients upload: they are found in the received bytes, compiled and started.

The control script of ur_rtde is replaced by a state machine with its behaviour. Any other program is interpreted.
"""

import re
from dataclasses import dataclass
from typing import Any

from ftmocks.ur import script
from ftmocks.ur.controller_program import ControllerProgram, error_at
from ftmocks.ur.robot import Robot
from ftmocks.ur.urscript.program import Program
from ftmocks.ur.urscript.syntax import UrscriptSyntaxError


@dataclass(frozen=True)
class Upload:
    """Text of a program that a client has uploaded."""

    name: str
    text: str
    secondary: bool

    def register_offset(self, kind: str) -> int:
        """Return the first register of `kind` (int or float) that the control script uses: 0 or 24."""
        found = re.search(rf"# {kind} register offset\s*\n(\d+)", self.text)
        return int(found.group(1)) if found else 0

    def compiled(self, robot: Robot) -> ControllerProgram:
        """Return the program for a controller. Raises `UrscriptSyntaxError` if the text is not a valid program."""
        if self.name == script.NAME:
            return script.ControlScript(robot, self.register_offset("int"), self.register_offset("float"))
        return Program(robot, self.name, self.text)


def take_uploads(buffer: bytearray) -> list[Upload]:
    """Remove and return all complete programs from `buffer`.

    A program extends from ``def`` or ``sec`` to the first ``end`` in column 0. A line outside of such a block is a
    program too.
    """
    uploads: list[Upload] = []
    while True:
        text = buffer.decode("latin-1")  # one character per byte
        head = re.match(r"\s*(def|sec)\s+(\w+)\s*\([^)]*\)\s*:[^\n]*\n", text)
        if head:
            whole = re.compile(r"^end\b[^\n]*\n", re.MULTILINE).search(text, head.end())
            if whole is None:
                return uploads
            end, name, secondary = whole.end(), head.group(2), head.group(1) == "sec"
        else:
            end, name, secondary = text.find("\n") + 1, "statement", False
            if end == 0 or re.match(r"\s*(def|sec)\b[^\n]*$", text):
                return uploads
        if text[:end].strip() and not text[:end].lstrip().startswith("#"):
            uploads.append(Upload(name, text[:end], secondary))
        del buffer[:end]


def start_upload(robot: Robot, upload: Upload, *, by: str = "script port") -> bool:
    """Start a program of a client, which replaces the running one; return False if it is refused."""
    if upload.secondary:
        robot.note(by, f"secondary program {upload.name}", accepted=False, why="not interpreted")
        return False
    obstacle = robot.obstacle if robot.remote_control else "local control"
    try:
        program, detail = upload.compiled(robot), dict[str, Any]()
        if program.doubts:
            detail = {"doubts": program.doubts}
    except UrscriptSyntaxError as error:
        obstacle = obstacle or f"syntax error: {error}"
        program, detail = ControllerProgram(upload.name), error_at(error.place, error.report)
    return robot.start_soon(program, by=by, obstacle=obstacle, **detail)
