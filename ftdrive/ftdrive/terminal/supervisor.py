"""Checks, on a session's streams and terminal, whether an operator or a program in their place still follows it."""

import os
import select
import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import IO, Any, Final, Self, TextIO

from ftdrive.errors import Declined, SupervisorGone

# While an answer is awaited, this is the period, ms, of the checks whether the operator is still there.
_LOOK_MS: Final = 50


class Supervisor:
    """Watches whether the other ends of a session's streams still exist. Only `read_line` reads, and only one line.

    Inside a `with` block, a hang-up of the terminal (SIGHUP) is detected too, unless it is ignored, as with `nohup`.
    The end of the input counts only if its writer was connected when a question was asked, because a file or pipe with
    prepared answers may end before. `name` is the name of the output in messages.
    """

    def __init__(self, stdin: TextIO, output: IO[str], name: str) -> None:
        self._stdin, self._input, self._output, self._name = stdin, _descriptor(stdin), _descriptor(output), name
        self._terminals = [fd for fd in (self._input, self._output) if fd is not None and os.isatty(fd)]
        # whether a writer of answers was connected to the input when a question was asked
        self._answers = False
        self._hung_up = False
        self._handler_before: Any = None

    def __enter__(self) -> Self:
        if hasattr(signal, "SIGHUP") and threading.current_thread() is threading.main_thread():
            before = signal.getsignal(signal.SIGHUP)
            if before not in {signal.SIG_IGN, None}:
                self._handler_before = signal.signal(signal.SIGHUP, self._hang_up)
        return self

    def __exit__(self, *_: object) -> None:
        before, self._handler_before = self._handler_before, None
        if before is not None:
            signal.signal(signal.SIGHUP, before)

    def _hang_up(self, *_: object) -> None:
        self._hung_up = True

    def absence(self) -> str | None:
        """Return why no operator follows the session any more, such as a closed terminal; None if one may follow it."""
        if self._hung_up or any(map(_is_closed, self._terminals)):
            return "the terminal was closed"
        if self._output is not None and _is_closed(self._output):
            return f"the reader of {self._name} has ended"
        # The end of the input counts only after a question, because `printf 'yes' | ftdrive calibrate` ends at once.
        if self._answers and self._input is not None and _is_closed(self._input, reading=True):
            return "standard input, from which answers come, was closed"
        return None

    @contextmanager
    def writing(self) -> Iterator[None]:
        """If writing in the block fails because the reader of the output has ended, raise `SupervisorGone` instead."""
        try:
            yield
        except OSError as error:
            if why := self.absence():
                raise SupervisorGone(why) from error
            raise

    def expect_answer(self) -> None:
        """Record whether the writer of the answers is connected; call this before a question is shown."""
        if self._input is not None and self._input not in self._terminals:
            self._answers |= hasattr(select, "poll") and not _is_closed(self._input, reading=True)

    def read_line(self, unanswered: str) -> str:
        """Read a line. At the end of the input, raises `SupervisorGone` if `absence` gives a reason, or `Declined`."""
        fd = self._input
        if fd is None or not hasattr(select, "poll"):
            line = self._stdin.readline()
        else:
            self.expect_answer()
            # byte by byte, so that nothing after the line is read and the end of the input is detected
            line = self._read_bytes(fd).decode(self._stdin.encoding or "utf-8", errors="replace")
        if not line:
            if why := self.absence():
                raise SupervisorGone(why)
            raise Declined(unanswered)
        return line

    def _read_bytes(self, fd: int) -> bytes:
        """Read a line byte by byte, as a shell does, so that what follows stays in the stream."""
        poller, line = select.poll(), b""
        poller.register(fd, select.POLLIN)
        while not line.endswith(b"\n"):
            while not poller.poll(_LOOK_MS):
                if why := self.absence():
                    raise SupervisorGone(why)
            try:
                byte = os.read(fd, 1)
            except OSError:
                if fd not in self._terminals:
                    raise
                byte = b""  # the terminal is closed
            if not byte:
                break
            line += byte
        return line


def _descriptor(stream: IO[str]) -> int | None:
    try:
        return stream.fileno()
    except (OSError, ValueError):
        return None


def _is_closed(fd: int, *, reading: bool = False) -> bool:
    """Whether the other end of a pipe, socket or terminal is closed; False for a file. Reads nothing."""
    if not hasattr(select, "poll"):  # Windows
        return False
    poller = select.poll()
    # A socket reports POLLRDHUP when the other end stops sending; a terminal or a pipe reports POLLHUP.
    half_closed = getattr(select, "POLLRDHUP", 0) if reading else 0
    poller.register(fd, half_closed)
    return any(events & (select.POLLERR | select.POLLHUP | half_closed) for _, events in poller.poll(0))
