"""The whole terminal as lines of text, drawn ten times a second: what the screens of `live` and `weigh` share."""

import os
import select
import signal
import sys
import threading
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, redirect_stderr
from io import StringIO
from types import FrameType
from typing import TextIO
from urllib.parse import urlsplit

from rich.control import Control

from ftdrive.errors import SupervisorGone
from ftdrive.servers.http_gate import is_loopback
from ftdrive.terminal.console import CommandConsole, qr_code
from ftdrive.terminal.keyboard import Keyboard
from ftdrive.terminal.lines import FAINT, STRONG, Line
from ftdrive.terminal.supervisor import Supervisor

REFRESH_S = 0.1
# A write of more bytes could wait for a terminal that has room for some of them.
_CHUNK = 256


class Canvas(ABC):
    """A screen that covers the terminal until `q` or Ctrl-C.

    `address` is that of the page in the browser, whose QR code the key `v` shows; empty without a page.
    """

    is_over = False
    failure: BaseException | None = None
    """What has ended the reading."""
    cover: Sequence[Line] = ()
    """Shown instead of the drawing until a key is pressed."""
    entry: tuple[Callable[[str], object], str, str] | None = None
    """What takes the text that is typed in the last line, its hint, and the text so far."""

    def __init__(self, address: str = "") -> None:
        self._address = address
        self._drawn: list[Line] = []
        self._size = (0, 0)

    @abstractmethod
    def draw(self, width: int, height: int) -> Sequence[Line]:
        """Return the lines; those that are missing stay empty. What it raises ends the screen."""

    @abstractmethod
    def turns(self) -> Iterable[object]:
        """Read a stream turn after turn, until the screen `is_over`."""

    @abstractmethod
    def act(self, key: str) -> None:
        """Do what a key stands for."""

    def page(self) -> Line | None:
        """Return the address of the page in the browser and its key; None without a page."""
        return Line("─ ", FAINT).add(self._address).add("  v", STRONG).add(" QR code", FAINT) if self._address else None

    def lines(self, width: int, height: int) -> list[Line]:
        """Return what the terminal shows: `height` lines of `width` cells; raises what has ended the reading."""
        if self.failure is not None:
            raise self.failure
        shown = self.draw(width, height)
        lines = [Line().join(line).fit(width) for line in (self.cover or shown)[:height]]
        lines += [Line().to(width)] * (height - len(lines))
        if self.entry is not None:
            _, hint, text = self.entry
            # of a long text the end
            line = Line(" ").add(text[-max(width - 3, 0) :]).add(" ", "reverse")
            lines[-1:] = [line.add("" if text else hint, FAINT).fit(width)]
        return lines

    def press(self, key: str) -> None:
        """Do what a stroke of the keyboard stands for."""
        if self.entry is not None:
            take, hint, text = self.entry
            if len(key) == 1 or key == "backspace":
                self.entry = take, hint, text + key if len(key) == 1 else text[:-1]
            elif key in {"enter", "escape"}:
                self.entry = None
                if text and key == "enter":
                    take(text)
        elif self.cover:
            self.cover = ()
        elif key == "q":
            self.is_over = True
        elif key == "v" and self._address:
            is_ours = is_loopback(urlsplit(self._address).hostname or "")
            words = "of this computer only: a tablet needs --view-address" if is_ours else "who has it sees the page"
            code = [Line(" ").add(row, "white on black") for row in qr_code(self._address)]
            self.cover = [Line(f" {self._address}"), Line(f" {words}"), *code, Line(" Any key returns.")]
        else:
            self.act(key)

    def run(self, keys: TextIO | None = None, output: TextIO | None = None) -> None:
        """Show the screen until `q` or Ctrl-C, then restore the terminal and show what was printed on stderr meanwhile.

        Raises
        ------
        SupervisorGone
            The terminal was closed. Of SIGHUP and SIGTERM the handlers of before raise.
        """
        keys, output = keys or sys.stdin, output or sys.stderr
        supervisor = Supervisor(keys, output, "standard error")
        console = CommandConsole(file=output, highlight=False, markup=False, emoji=False)
        rest, fd, held = b"", output.fileno(), StringIO()
        with self._signals_end_it(), supervisor.writing(), ExitStack() as stack:
            stack.callback(output.flush)
            stack.callback(lambda: output.write(held.getvalue()))
            stack.enter_context(redirect_stderr(held))
            stack.enter_context(console.screen())
            keyboard = stack.enter_context(Keyboard(keys.fileno()))
            # the last, because a terminal that is blocked may keep the others waiting
            stack.enter_context(self.reading())
            while not self.is_over:
                rest = _sent(fd, rest or self._changes(console, fd))
                if why := supervisor.absence():
                    raise SupervisorGone(why)
                while (key := keyboard.stroke()) is not None:
                    self.press(key)

    @contextmanager
    def reading(self) -> Iterator[None]:
        """Read in another thread while the screen is shown, because drawing must not keep a stream waiting."""
        thread = threading.Thread(target=self._read, name="reading", daemon=True)
        thread.start()
        try:
            yield
        finally:
            self.is_over = True
            thread.join()

    def _read(self) -> None:
        try:
            for _ in self.turns():
                pass
        except BaseException as error:  # the main thread raises it
            self.failure = error

    @contextmanager
    def _signals_end_it(self) -> Iterator[None]:
        """Let signals end the screen, because what a handler raises could break the restoration of the terminal off.

        They are repeated afterwards, but for Ctrl-C, which ends the screen as `q` does.
        """
        received = list[int]()

        def end(number: int, _: FrameType | None) -> None:
            self.is_over = True
            received.append(number)

        with ExitStack() as handlers:
            for one in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
                if signal.getsignal(one) not in {signal.SIG_IGN, None}:
                    handlers.callback(signal.signal, one, signal.signal(one, end))
            yield
        for number in {*received} - {signal.SIGINT}:
            signal.raise_signal(number)

    def _changes(self, console: CommandConsole, fd: int) -> bytes:
        """Return what draws the lines that changed, or all of them on a terminal of another size."""
        size = os.get_terminal_size(fd)
        # a terminal that does not know its size
        width, height = size.columns or 80, size.lines or 24
        lines = self.lines(width, height)
        with console.capture() as captured:
            if (width, height) != self._size:
                self._size, self._drawn, console.width = (width, height), [], width
                console.control(Control.clear())
            for y, line in enumerate(lines):
                if y >= len(self._drawn) or line.parts != self._drawn[y].parts:
                    console.control(Control.move_to(0, y))
                    console.print(line.as_text(), end="")
        self._drawn = lines
        return captured.get().encode(console.encoding, "replace")


def _sent(fd: int, rest: bytes) -> bytes:
    """Send what the terminal takes until the next drawing is due, and return what is left: keys never wait for it."""
    due_s = time.monotonic() + REFRESH_S
    while rest and (left_s := due_s - time.monotonic()) > 0 and select.select([], [fd], [], left_s)[1]:
        rest = rest[os.write(fd, rest[:_CHUNK]) :]
    time.sleep(max(0.0, due_s - time.monotonic()))
    return rest
