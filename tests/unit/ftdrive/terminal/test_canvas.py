"""What the screens of `live` and `weigh` share, on a pseudo-terminal: lines, keys, and every way out."""

import os
import select
import signal
import sys
import termios
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import nullcontext

import pytest

from ftdrive.terminal.canvas import Canvas
from ftdrive.terminal.lines import Line
from tests.unit.ftdrive.terminal.test_screen import Shown, terminal
from tests.wire.waiting import wait_until

LEFT = "\x1b[?1049l\x1b[?25h"
"""The screen of before, and its cursor."""


class Counting(Canvas):
    """Says how often it was drawn, and what it has heard; `fills` is what the other lines have."""

    drawn = 0
    is_reading = False

    def __init__(self, address: str = "", fills: Callable[[int], str] = lambda _: "always the same") -> None:
        super().__init__(address)
        self.fills, self.heard = fills, list[str]()

    def draw(self, width: int, height: int) -> list[Line]:
        self.drawn += 1
        return [Line(f"drawn {self.drawn}"), Line(f"for {width} x {height}"), *[Line(self.fills(width))] * 50]

    def act(self, key: str) -> None:
        self.heard.append(key)

    def turns(self) -> Iterator[None]:
        self.is_reading = True
        while not self.is_over:
            time.sleep(0.001)
            yield
        self.is_reading = False


def run(canvas: Canvas, does: Callable[[int, int], Shown], size: tuple[int, int] = (4, 80)) -> str:
    """Run a screen while `does` is what the person does; return what the terminal got, which is left as it was."""
    shown: list[Shown] = []
    with (
        terminal(*size) as (person, program),
        open(program, "w", closefd=False) as output,
        open(program, closefd=False) as keys,
    ):
        before = termios.tcgetattr(program)
        thread = threading.Thread(target=lambda: shown.append(does(person, program)))
        thread.start()
        try:
            canvas.run(keys, output)
        finally:
            thread.join()
            print("the end", file=output, flush=True)
            wait_until(lambda: LEFT in shown[0].text and "the end" in shown[0].text)
            assert termios.tcgetattr(program) == before
        return shown[0].text


@pytest.fixture(autouse=True)
def as_the_command_line(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    monkeypatch.setenv("TERM", "xterm")
    monkeypatch.setenv("COLUMNS", "8")  # of a shell that exports its width at the start
    before = signal.signal(signal.SIGTERM, signal.default_int_handler)
    yield
    signal.signal(signal.SIGTERM, before)


@pytest.mark.slow
def test_lines_that_changed_are_sent_until_q_and_then_what_was_printed() -> None:
    def does(person: int, program: int) -> Shown:
        shown = Shown(person)
        wait_until(lambda: "drawn 5" in shown.text)
        sys.stderr.write("a warning")
        termios.tcsetwinsize(program, (3, 40))
        wait_until(lambda: "for 40 x 3" in shown.text)
        os.write(person, b"xq")
        return shown

    text = run(canvas := Counting(), does)
    first, again = text.split("\x1b[2J")[1:]
    assert (canvas.heard, first.count("always the same"), again.count("always the same")) == (["x"], 2, 1)
    assert first.count("\x1b[1;1H") >= 5
    assert text.index("a warning") > text.index(LEFT)


@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_signals_end_it_and_only_ctrl_c_does_as_q(number: signal.Signals) -> None:
    def does(person: int, _: int) -> Shown:
        wait_until(lambda: canvas.drawn > 2)
        os.kill(os.getpid(), number)
        return Shown(person)

    handler, canvas = signal.getsignal(number), Counting()
    with pytest.raises(KeyboardInterrupt) if number == signal.SIGTERM else nullcontext():
        run(canvas, does)
    assert signal.getsignal(number) is handler


def test_an_error_of_the_drawing_is_raised_on_the_screen_of_before() -> None:
    with pytest.raises(ZeroDivisionError):
        run(Counting(fills=lambda _: f"{1 / 0}"), lambda person, _: Shown(person))


def test_a_terminal_that_takes_nothing_keeps_neither_a_signal_nor_a_recording_waiting() -> None:
    def does(person: int, program: int) -> Shown:
        wait_until(lambda: canvas.drawn and not select.select([], [program], [], 0)[1])
        os.kill(os.getpid(), signal.SIGTERM)
        wait_until(lambda: not canvas.is_reading)
        return Shown(person)

    canvas = Counting(fills=lambda width: os.urandom(width // 2).hex())
    with pytest.raises(KeyboardInterrupt):
        run(canvas, does, (50, 200))
