"""Bytes received with wrong parity, as POSIX marks them.

Ref: POSIX.1-2024, Base Definitions, 11.2.2 Input Modes. With INPCK and PARMRK set and IGNPAR clear, a byte X received
with wrong parity or framing arrives as FF 00 X, and a valid FF as FF FF. pyserial clears both flags whenever it
configures a port, so the system then delivers damaged bytes unmarked.
"""

import re
import sys
import termios
from typing import Final

import serial


def ask_for_marks(port: serial.Serial | int) -> bool:
    """Let the system mark damaged bytes; return whether it can. Drops earlier bytes, which have no marks."""
    if sys.platform != "linux":  # setting flags may undo pyserial's unusual bit rates there
        return False
    settings = termios.tcgetattr(port)
    # with BRKINT a break, which is a framing error, would empty the input silently
    settings[0] = settings[0] & ~(termios.IGNPAR | termios.BRKINT) | termios.INPCK | termios.PARMRK
    termios.tcsetattr(port, termios.TCSANOW, settings)
    termios.tcflush(port, termios.TCIFLUSH)
    return True


def marks_asked_for(port: serial.Serial | int) -> bool:
    """Return whether the reader of this terminal undoes marks; works on both sides of a pseudo-terminal."""
    # INPCK alone: a far side that makes the marks itself has cleared PARMRK
    return sys.platform == "linux" and bool(termios.tcgetattr(port)[0] & termios.INPCK)


def leave_marks_to_far_side(port: serial.Serial | int) -> None:
    """Let the system pass bytes unchanged, because the far side makes the marks itself."""
    if sys.platform == "linux":
        settings = termios.tcgetattr(port)
        settings[0] &= ~termios.PARMRK
        termios.tcsetattr(port, termios.TCSANOW, settings)


_PLAIN: Final = re.compile(rb"(?:[^\xff]+|\xff\xff)+")
_MARKED: Final = re.compile(rb"\xff(?:\0.|(?=[^\0]))", re.DOTALL)
"""FF 00 X, or an FF whose second FF is lost, which counts as damaged."""


class Unmarker:
    """Restores the bytes on the line from marked bytes, however reads divide them."""

    def __init__(self) -> None:
        self._cut = b""
        """The beginning of a mark or of a doubled FF whose rest has not arrived."""

    def undo(self, data: bytes) -> tuple[bytes, list[int]]:
        """Return the true bytes, and the places of those received with wrong parity or framing."""
        data = self._cut + data
        true, damaged, at = bytearray(), list[int](), 0
        while at < len(data):
            if plain := _PLAIN.match(data, at):
                true += plain[0].replace(b"\xff\xff", b"\xff")
                at = plain.end()
            elif marked := _MARKED.match(data, at):
                damaged.append(len(true))
                true.append(marked[0][-1])
                at = marked.end()
            else:
                break
        self._cut = data[at:]
        return bytes(true), damaged

    def forget(self) -> None:
        """Restart, because the rest of a cut mark was dropped."""
        self._cut = b""
