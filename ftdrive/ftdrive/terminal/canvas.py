"""Full-screen display of text lines, drawn ten times per second; base of the `live` and `weigh` screens."""

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
# Number of bytes per write to the terminal; a longer write could block if the terminal accepts only a part.
_CHUNK = 256


class Canvas(ABC):
    """A screen that covers the terminal until `q` or Ctrl-C.

    The key `v` shows the `address` of the browser page as a QR code; the address is empty if there is no page.
    """

    is_over = False
    failure: BaseException | None = None
    """Error that ended the reading of the stream; None if there is none."""
    cover: Sequence[Line] = ()
    """Lines that are shown instead of what `draw` returns until a key is pressed, such as the help."""
    entry: tuple[Callable[[str], object], str, str] | None = None
    """A text field in the last line: the function that receives the text, the hint, and the text typed so far."""

    def __init__(self, address: str = "") -> None:
        self._address = address
        self._drawn: list[Line] = []
        self._size = (0, 0)

    @abstractmethod
    def draw(self, width: int, height: int) -> Sequence[Line]:
        """Return the lines to show, `height` or fewer; the others stay empty. An error in it ends the screen."""

    @abstractmethod
    def turns(self) -> Iterable[object]:
        """Iterate over turns, each of which reads the new data of the stream, until `is_over` is true."""

    @abstractmethod
    def act(self, key: str) -> None:
        """Perform the action of a key."""

    def page(self) -> Line | None:
        """Return a line with the address of the browser page and the key `v`; None without a page."""
        return Line("─ ", FAINT).add(self._address).add("  v", STRONG).add(" QR code", FAINT) if self._address else None

    def lines(self, width: int, height: int) -> list[Line]:
        """Return the `height` lines of `width` cells to show. Raises the error that ended the reading, if any."""
        if self.failure is not None:
            raise self.failure
        shown = self.draw(width, height)
        lines = [Line().join(line).fit(width) for line in (self.cover or shown)[:height]]
        lines += [Line().to(width)] * (height - len(lines))
        if self.entry is not None:
            _, hint, text = self.entry
            # show only the end of a text that is longer than the line
            line = Line(" ").add(text[-max(width - 3, 0) :]).add(" ", "reverse")
            lines[-1:] = [line.add("" if text else hint, FAINT).fit(width)]
        return lines

    def press(self, key: str) -> None:
        """Handle a keystroke."""
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
            words = "of this computer only: use --view-address" if is_ours else "anyone with it sees the page"
            code = [Line(" ").add(row, "white on black") for row in qr_code(self._address)]
            self.cover = [Line(f" {self._address}"), Line(f" {words}"), *code, Line(" Any key returns.")]
        else:
            self.act(key)

    def run(self, keys: TextIO | None = None, output: TextIO | None = None) -> None:
        """Show the screen until `q` or Ctrl-C, then restore the terminal and print what stderr received meanwhile.

        Raises
        ------
        SupervisorGone
            The terminal was closed. After SIGHUP and SIGTERM, the previous handlers may raise other errors.
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
            # start to read last, because a blocked terminal may delay the contexts above
            stack.enter_context(self.reading())
            while not self.is_over:
                rest = _send(fd, rest or self._changes(console, fd))
                if why := supervisor.absence():
                    raise SupervisorGone(why)
                while (key := keyboard.stroke()) is not None:
                    self.press(key)

    @contextmanager
    def reading(self) -> Iterator[None]:
        """Read the stream in another thread while the screen is shown, so that drawing does not delay the stream."""
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
        except BaseException as error:  # raised by the main thread in `lines`
            self.failure = error

    @contextmanager
    def _signals_end_it(self) -> Iterator[None]:
        """Let signals end the screen, because an exception in a handler could keep the terminal from being restored.

        The signals are raised again afterwards, except for that of Ctrl-C, which ends the screen like `q`.
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
        """Return the bytes that redraw the changed lines, or all lines if the terminal's size has changed."""
        size = os.get_terminal_size(fd)
        # use a default size, because some terminals report the size 0
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


def _send(fd: int, rest: bytes) -> bytes:
    """Write as many bytes as the terminal accepts until the next drawing is due; return those that are left."""
    due_s = time.monotonic() + REFRESH_S
    while rest and (left_s := due_s - time.monotonic()) > 0 and select.select([], [fd], [], left_s)[1]:
        rest = rest[os.write(fd, rest[:_CHUNK]) :]
    time.sleep(max(0.0, due_s - time.monotonic()))
    return rest
