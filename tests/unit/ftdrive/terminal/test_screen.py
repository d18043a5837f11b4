"""The live screen: all that is needed at 80x24, nothing that wraps, keys, questions, and the terminal as it was."""

import io
import os
import pty
import select
import subprocess
import sys
import termios
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from itertools import count
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from rich.cells import cell_len
from rich.console import Console
from syrupy.assertion import SnapshotAssertion

from ftdrive.session.events import (
    Checked,
    Compared,
    Estimated,
    Event,
    GuardTripped,
    Key,
    Noted,
    PoseTaken,
    Question,
    RunOpened,
    State,
    StateChanged,
)
from ftdrive.terminal.keyboard import Keyboard
from ftdrive.terminal.screen import Screen, draw_session
from ftdrive.words.session import SessionView
from tests.wire.waiting import wait_until

RESUME = "ftdrive calibrate --resume runs/2026-11-20T211503Z-gripper_a"
VALUES: dict[str, Any] = {
    "mass_kg": 1.187,
    "p_sensor_com_m": np.array([0.0123, -0.0041, 0.0618]),
    "force_bias_N": np.array([-3.21, 7.90, -112.04]),
    "torque_bias_Nm": np.array([0.12, -0.08, 0.03]),
    "R_flange_sensor": np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]),
    "tilt_alpha_rad": np.radians(1.8),
    "tilt_beta_rad": np.radians(-0.4),
}
SIGMA: dict[str, Any] = {
    "mass_kg": 0.0011,
    "p_sensor_com_m": np.full(3, 0.0002),
    "force_bias_N": np.full(3, 0.021),
    "torque_bias_Nm": np.full(3, 0.001),
    "R_flange_sensor": np.full(3, np.radians(0.1)),
    "tilt_alpha_rad": np.radians(0.06),
    "tilt_beta_rad": np.radians(0.05),
}
HINT = "point the middle between the tool's -x, -y and -z axes down: tilt it about its own x axis by -45°"


def pose(stop: int, number: int, **changes: Any) -> PoseTaken:
    fields: dict[str, Any] = {
        "stop": stop,
        "stops": 25,
        "number": number,
        "gravity_flange": np.array([0.0, -1.0, 0.0]),
        "mean": np.zeros(6),
        "sigma": np.repeat([0.031, 0.0012], 3),
        "samples": 2000,
        "settle_s": 0.9,
        "average_s": 2.0,
        "attempts": 1,
        "steady": True,
    }
    return PoseTaken(**(fields | changes))


def estimated(**changes: Any) -> Estimated:
    fields: dict[str, Any] = {
        "poses": 6,
        "values": VALUES,
        "sigma": SIGMA,
        "residual_sigma": 1.4,
        "residual_force_N": 0.062,
        "faces": (1, 0, 2, 3, 0, 12),
        "cond9": 5.14,
        "cond_u1": 12.0,
        "empty_cap_deg": 95.0,
        "light": "amber",
        "hint": HINT,
    }
    return Estimated(**(fields | changes))


def view(*events: Event, command: str = "calibrate") -> SessionView:
    found = SessionView(command)
    for second, event in enumerate(events):
        found.update(event, float(second))
    return found


MIDDLE: tuple[Event, ...] = (
    RunOpened(folder="runs/2026-11-20T211503Z-gripper_a", resume=RESUME),
    *(pose(stop, number) for stop, number in enumerate((1, 19, 12, 8, 16, 14), start=1)),
    estimated(),
    StateChanged(state=State.SETTLE, stop=7, stops=25, number=5),
)


NONE_YET: dict[str, Any] = {"values": {}, "sigma": {}, "residual_sigma": None, "residual_force_N": None}
FORCE = np.array([0.3, 0, 0.01, 3e-20, 0, 0])
FORCE_SIGMA = np.array([6e-4, 6e-4, 6e-4, 2e-21, 0, 3e-12])
DRIFTED = np.array([0.5, 0, 0, 0, 0, 0])
LONG = "/home/operator/" + "deep/" * 20 + "2026-11-20T211503Z-gripper_a"
CONTACT = "a force of 77 N where a free tool gives 3 N"


def drifting(change: Any, sigma: Any) -> Estimated:
    return estimated(values=VALUES | {"drift": change}, sigma=SIGMA | {"drift": sigma})


def verified() -> Iterator[Event]:
    for stop, number, off in ((1, 103, 1.0), (2, 101, 20.0)):
        yield pose(stop, number, stops=3)
        residual, sigma = np.repeat([0.03 * off, 0.001 * off], 3), np.repeat([0.03, 0.001], 3)
        yield Compared(stop=stop, number=number, residual=residual, sigma=sigma, poses=stop, light="amber")


SCREENS: dict[str, tuple[Event, ...]] = {
    "middle": (*MIDDLE, Noted(words="R12 was repeated", warning=True)),
    "first-pose": (
        *(MIDDLE[0], pose(1, 1), estimated(**NONE_YET, cond9=np.inf, cond_u1=np.inf, light="red")),
        StateChanged(state=State.SAMPLE, stop=3, stops=25),
    ),
    "hand-guided": (MIDDLE[0], StateChanged(state=State.SAMPLE, stop=3)),
    "out-of-line": (*MIDDLE, pose(7, 5, steady=False, attempts=3), estimated(residual_sigma=31.0)),
    "again-drifted": (pose(1, 19), pose(2, 5), pose(3, 19, mean=DRIFTED)),
    "drift": (*MIDDLE, drifting(np.full(6, 0.3), np.full(6, 0.02))),
    "drift-perhaps": (*MIDDLE, drifting(FORCE / 200, FORCE_SIGMA)),
    "held": (
        *(*MIDDLE, GuardTripped(hazard=14, words=CONTACT)),
        *(StateChanged(state=state, words=CONTACT) for state in (State.STOP, State.HOLD)),
    ),
    "paused": (*MIDDLE, StateChanged(state=State.HOLD, words="paused by a person")),
    "long-path": (RunOpened(folder=LONG, resume=f"ftdrive calibrate --resume {LONG}"),),
    "verify": tuple(verified()),
}


def drawn(found: SessionView, *, width: int = 80, height: int = 24, now_s: float = 9.0) -> list[str]:
    console = Console(width=width, height=height, file=io.StringIO(), color_system=None, force_terminal=False)
    console.print(draw_session(found, now_s, width=width, height=height))
    file = console.file
    assert isinstance(file, io.StringIO)
    return [line.rstrip() for line in file.getvalue().splitlines()]


@pytest.mark.parametrize("name", SCREENS)
def test_a_screen_of_80_by_24(name: str, snapshot: SnapshotAssertion) -> None:
    found = view(*SCREENS[name], command="verify" if name == "verify" else "calibrate")
    lines = drawn(found, now_s=30.0)
    assert len(lines) <= 23
    assert max(map(len, lines)) <= 80
    assert "\n".join(lines) == snapshot


@pytest.mark.parametrize(("width", "height"), [(80, 24), (40, 15), (132, 50), (20, 8)])
def test_nothing_wraps_and_what_matters_most_stays(width: int, height: int) -> None:
    found = view(*MIDDLE, GuardTripped(hazard=7, words="a force of 31 N where a free tool gives 3 N: " * 4))
    lines = drawn(found, width=width, height=height)
    assert len(lines) < height
    assert max(cell_len(line) for line in lines) <= width
    text = "\n".join(lines)
    for needed in ("pose 7/25", " r  redo", "gripper_a", "kept in"):
        assert needed in text
    if height > 12 and width > 20:
        assert "AMBER" in text
        assert "mass kg" in text
        assert "0.0011" in text or width < 50


@contextmanager
def terminal(rows: int = 24, columns: int = 80) -> Iterator[tuple[int, int]]:
    person, program = pty.openpty()
    termios.tcsetwinsize(program, (rows, columns))
    try:
        yield person, program
    finally:
        os.close(program)
        os.close(person)


class Shown:
    def __init__(self, person: int) -> None:
        self.text = ""
        # its own descriptor: another test could get the number of a closed one
        self._person = os.dup(person)
        threading.Thread(target=self._read, daemon=True).start()

    def _read(self) -> None:
        try:
            while more := os.read(self._person, 65536):
                self.text += more.decode(errors="replace")
        except OSError:
            os.close(self._person)  # the terminal was closed


def type_every(seconds: float, monkeypatch: pytest.MonkeyPatch) -> None:
    """Let the keyboard see this time between two strokes."""
    monkeypatch.setattr("ftdrive.terminal.keyboard.time", SimpleNamespace(monotonic=count(0, seconds).__next__))


def test_keys_arrive_without_enter_and_all_others_as_another_key(monkeypatch: pytest.MonkeyPatch) -> None:
    type_every(10.0, monkeypatch)
    with terminal() as (person, program), Keyboard(program) as keyboard:
        for letter, key in zip(b"krspq", (Key.KEEP, Key.REDO, Key.SKIP, Key.PAUSE, Key.STOP), strict=True):
            os.write(person, bytes([letter]))
            wait_until(lambda: keyboard.waiting)
            assert keyboard.pressed() is key
        # F4, keypad 1, shift-F5, up, escape; Space, Enter, Ctrl-D, Ctrl-Z, Ctrl-\, Ctrl-S, Ctrl-Q; letters
        for other in (
            b"\x1bOS",
            b"\x1bOq",
            b"\x1b[15;2~",
            b"\x1b[A",
            b"\x1b",
            *(b" \n\x04\x1a\x1c\x13\x11x1"[i : i + 1] for i in range(9)),
        ):
            os.write(person, other)
            wait_until(lambda: keyboard.waiting)
            assert keyboard.pressed() is Key.OTHER
        os.write(person, b"Q")
        wait_until(lambda: keyboard.waiting)
        assert keyboard.waiting == (Key.STOP,)


@pytest.mark.parametrize(
    ("strokes", "heard"),
    [
        (("y", "e", "s"), [Key.OTHER] * 3),
        (("s\n",), [Key.OTHER]),
        (("rs",), [Key.OTHER]),
        (("s", "s", "s"), [Key.SKIP]),  # held down
        (("s", "k", "i", "p"), [Key.SKIP, Key.OTHER, Key.OTHER, Key.PAUSE]),  # the first came alone
        (("resume, please\n",), [Key.PAUSE]),
    ],
)
def test_letters_of_a_word_are_no_keys_but_those_that_stop(
    strokes: tuple[str, ...], heard: list[Key], monkeypatch: pytest.MonkeyPatch
) -> None:
    type_every(0.0, monkeypatch)
    with terminal() as (person, program), Keyboard(program) as keyboard:
        for stroke in strokes:
            os.write(person, stroke.encode())
            wait_until(lambda: not select.select([program], [], [], 0)[0])
        os.write(person, b"q")  # heard in a word too
        wait_until(lambda: Key.STOP in keyboard.waiting)
        assert list(keyboard.waiting) == [*heard, Key.STOP]


def test_the_terminal_is_restored_after_success_failure_and_while_suspended() -> None:
    with terminal() as (_, program):
        before = termios.tcgetattr(program)
        with Keyboard(program) as keyboard:
            assert not termios.tcgetattr(program)[3] & (termios.ICANON | termios.ECHO)
            assert termios.tcgetattr(program)[3] & termios.ISIG  # Ctrl-C stays a signal
            with keyboard.suspended():
                assert termios.tcgetattr(program) == before
            assert not termios.tcgetattr(program)[3] & termios.ICANON
        assert termios.tcgetattr(program) == before
        with pytest.raises(ZeroDivisionError), Keyboard(program):
            raise ZeroDivisionError
        assert termios.tcgetattr(program) == before
        with pytest.raises(ZeroDivisionError), Keyboard(program) as keyboard, keyboard.suspended():
            raise ZeroDivisionError
        assert termios.tcgetattr(program) == before
    assert not [thread for thread in threading.enumerate() if thread.name == "keyboard"]


def test_keys_pressed_before_a_question_do_not_answer_it() -> None:
    with terminal() as (person, program), Keyboard(program) as keyboard:
        os.write(person, b"q")
        wait_until(lambda: keyboard.waiting)
        with keyboard.suspended():
            assert keyboard.pressed() is None
        assert keyboard.pressed() is None
        os.write(person, b"p")
        wait_until(lambda: keyboard.waiting == (Key.PAUSE,))


@contextmanager
def screen(person: int, program: int) -> Iterator[tuple[Screen, Shown]]:
    with (
        open(program, "w", encoding="utf-8", closefd=False) as file,
        open(program, encoding="utf-8", closefd=False) as stdin,
    ):
        console = Console(file=file, force_terminal=True, width=80, height=24, color_system=None)
        with Screen(console, Keyboard(program), stdin=stdin, verbose=True) as found:
            yield found, Shown(person)


@pytest.mark.slow
def test_the_screen_draws_asks_and_goes_on() -> None:
    with terminal() as (person, program):
        before = termios.tcgetattr(program)
        with screen(person, program) as (operator, shown):
            for event in MIDDLE:
                operator.show(event)
            wait_until(lambda: "SETTLE" in shown.text and RESUME in shown.text)
            assert "6/25 R14: settled 0.9 s" in shown.text  # above the frame, to stay
            answers: list[str] = []
            asking = threading.Thread(target=lambda: answers.append(operator.ask(Question("Go? Type MOVE", ("MOVE",)))))
            asking.start()
            wait_until(lambda: "Go? Type MOVE: " in shown.text)
            assert termios.tcgetattr(program)[3] & termios.ECHO
            os.write(person, b"move\n")
            wait_until(lambda: "'move' is not MOVE: type it in capital letters" in shown.text)
            os.write(person, b"MOVE\n")
            asking.join(10)
            assert answers == ["MOVE"]
            wait_until(lambda: not termios.tcgetattr(program)[3] & termios.ECHO)
            wait_until(lambda: "ftdrive calibrate" in shown.text.partition("\x1b[J")[2])
            erased, drawn_again = shown.text.split("\x1b[J")
            used = len(drawn(view(*MIDDLE))) + 3  # the question twice, and a line about the wrong answer
            assert erased.endswith(f"\x1b[{used}F")
            assert "\x1b[1A" not in drawn_again.split("ftdrive calibrate")[0]  # what stands above stays
            os.write(person, b"p")
            wait_until(lambda: "PAUSE asked" in shown.text)
            assert operator.pressed() is Key.PAUSE
            assert operator.pressed() is None
        assert termios.tcgetattr(program) == before
        wait_until(lambda: shown.text.count("\x1b[?25l") == shown.text.count("\x1b[?25h"))  # the cursor is back


def test_a_long_finding_goes_on_under_its_text() -> None:
    console = Console(file=(file := io.StringIO()), width=40, force_terminal=True, color_system=None)
    words = "the controller carries 0.50 kg; nothing in [tool] to compare it with"
    with Screen(console, stdin=io.StringIO(), verbose=True) as operator:
        operator.show(Checked(name="payload", passed=True, words=words))
    printed = file.getvalue()
    begins = printed.index(" ✔ payload:")
    lines = [line.rstrip() for line in printed[begins : printed.index("with", begins) + 4].splitlines()]
    assert lines[0] == " ✔ payload: the controller carries 0.50"
    assert all(line.startswith(" " * 3) and len(line) <= 40 for line in lines[1:])
    assert " ".join(" ".join(lines).split()) == f"✔ payload: {words}"


PROGRAM = """
import signal, sys, time
from ftdrive.terminal.screen import open_operator
from ftdrive.session.events import Noted
signal.signal(signal.SIGTERM, signal.default_int_handler)
try:
    with open_operator() as operator:
        operator.show(Noted(words=type(operator).__name__ + " is here"))
        while True:
            time.sleep(0.1)  # a signal just before a sleep does not end it
except KeyboardInterrupt:
    print("interrupted", file=sys.stderr)
    sys.exit(130)
"""


@pytest.mark.slow
@pytest.mark.parametrize(
    ("how", "environment", "kind"),
    [("SIGTERM", {"NO_COLOR": "1"}, "Screen"), ("Ctrl-C", {"TERM": "dumb"}, "PlainOperator")],
)
def test_ctrl_c_and_sigterm_end_the_program_and_restore_the_terminal(
    how: str, environment: dict[str, str], kind: str
) -> None:
    with terminal() as (person, program):
        before = termios.tcgetattr(program)
        shown = Shown(person)
        child = subprocess.Popen(
            [
                sys.executable,
                "-c",
                f"import os; os.setsid(); __import__('fcntl').ioctl(0, {termios.TIOCSCTTY}, 0)" + PROGRAM,
            ],
            stdin=program,
            stdout=program,
            stderr=program,
            cwd=Path(__file__).parents[3],
            env={**os.environ, "TERM": "xterm-256color", **environment},
        )
        try:
            wait_until(lambda: f"{kind} is here" in shown.text, 30)
            if kind == "Screen":
                wait_until(lambda: not termios.tcgetattr(program)[3] & termios.ICANON)
            if how == "Ctrl-C":
                os.write(person, b"\x03")
            else:
                child.terminate()
            assert child.wait(20) == 130
            wait_until(lambda: "interrupted" in shown.text)
            assert termios.tcgetattr(program) == before
            if "NO_COLOR" in environment:
                assert not any(f"\x1b[{colour}" in shown.text for colour in ("31m", "32m", "33m", "36m", "1;3"))
            if environment.get("TERM") == "dumb":
                assert "\x1b" not in shown.text
        finally:
            child.kill()
            child.wait()
