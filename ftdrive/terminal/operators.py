"""Operators without a screen: a script that reads JSON, and plain lines for a log, a pipe or a dumb terminal."""

import json
import sys
import termios
from collections.abc import Mapping
from contextlib import suppress
from threading import Lock
from typing import Any, TextIO

import numpy as np

from ftdrive.errors import Declined
from ftdrive.planning.show.words import plan_in_words
from ftdrive.session.events import (
    SCHEMA_VERSION,
    Asked,
    Checked,
    Estimated,
    Event,
    GuardTripped,
    Noted,
    Planned,
    PoseTaken,
    RunOpened,
    State,
    StateChanged,
)
from ftdrive.session.operator import Key, Question
from ftdrive.terminal.console import in_whole_words


def match(question: Question, typed: str) -> str | None:
    """Find the answer that was typed; None for no answer.

    In full, but for y and n; a word that must be typed exactly can be refused with no, which raises `Declined`.
    """
    typed = typed.strip()
    if typed in question.answers:
        return typed
    if len(question.answers) > 1:
        meant = {"y": "yes", "n": "no"}.get(typed.lower(), typed.lower())
        return meant if meant in question.answers else None
    if typed.lower() in {"n", "no"}:
        raise Declined(f"the answer was no: {question.text}")
    return None


def prompt(question: Question) -> str:
    """Say the question, and what may be typed where it does not say so itself."""
    if len(question.answers) == 1 and question.answers[0] in question.text:
        return f"{question.text}: "
    return f"{question.text} [{'/'.join(answer or 'Enter' for answer in question.answers)}] "


def read_line(stdin: TextIO, question: Question) -> str:
    """Read one line; raises `Declined` where there is no more."""
    line = stdin.readline()
    if not line:
        raise Declined(
            f"nobody answered '{prompt(question).strip()}': run it in a terminal, or put the answer on standard input"
        )
    return line


class JsonOperator:
    """One JSON object a line on stdout: every event, and every question before it is answered from stdin.

    A question is told as `{"event": "question", "text", "answers", "error"}`; the next line of stdin is its answer,
    `error` says why the last one was none.
    """

    def __init__(self, *, stdin: TextIO | None = None, stdout: TextIO | None = None) -> None:
        self._stdin, self._stdout = stdin or sys.stdin, stdout or sys.stdout
        self._lock = Lock()

    def show(self, event: Event) -> None:
        """Write the event."""
        self._write(event.to_dict())

    def ask(self, question: Question) -> str:
        """Answer from stdin; raises `Declined` at its end."""
        error = None
        while True:
            self._write(
                {
                    "schema_version": SCHEMA_VERSION,
                    "event": "question",
                    "text": question.text,
                    "answers": list(question.answers),
                    "error": error,
                }
            )
            typed = read_line(self._stdin, question)
            if (answer := match(question, typed)) is not None:
                return answer
            error = f"'{typed.strip()}' is none of the answers"

    @property
    def has_keys(self) -> bool:
        """Tell that there are none."""
        return False

    def pressed(self) -> Key | None:
        """Nothing: a script stops a session with SIGINT."""
        return None

    def _write(self, value: Mapping[str, Any]) -> None:
        line = json.dumps(value, allow_nan=False) + "\n"
        with self._lock:
            self._stdout.write(line)
            self._stdout.flush()


class PlainOperator:
    """One line for everything worth reading later, without colour and without keys.

    Parameters
    ----------
    quiet : bool
        Tell things only when a question follows, which they may be about.
    """

    def __init__(self, *, stdin: TextIO | None = None, stderr: TextIO | None = None, quiet: bool = False) -> None:
        self._stdin, self._stderr = stdin or sys.stdin, stderr or sys.stderr
        self._quiet, self._untold = quiet, list[tuple[str, str]]()
        self._lock = Lock()
        self._asked = ""

    def show(self, event: Event) -> None:
        """Write the event in words, if it is worth a line."""
        if isinstance(event, Asked) and event.question == self._asked:
            return  # stands there already
        head, words = head_and_words(event)
        if not words:
            return
        if self._quiet:
            self._untold.append((head, words))
        else:
            self._write(f"{head}{words}\n", head)

    def ask(self, question: Question) -> str:
        """Answer from stdin; raises `Declined` at its end. What was typed before, at a terminal, is no answer."""
        self._asked = question.text
        untold, self._untold = self._untold, []
        for head, words in untold:
            self._write(f"{head}{words}\n", head)
        if self._stdin.isatty():
            with suppress(termios.error):  # a terminal that was closed: reading says so
                termios.tcflush(self._stdin.fileno(), termios.TCIFLUSH)
        while True:
            self._write(prompt(question))
            try:
                typed = read_line(self._stdin, question)
            except (KeyboardInterrupt, Declined):
                self._write("\n")  # what is told next begins a line
                raise
            if not self._stdin.isatty():
                self._write(typed)
            if (answer := match(question, typed)) is not None:
                return answer
            self._write(f"'{typed.strip()}' is none of the answers.\n")

    @property
    def has_keys(self) -> bool:
        """Tell that there are none."""
        return False

    def pressed(self) -> Key | None:
        """Nothing: Ctrl-C stops a session."""
        return None

    def _write(self, text: str, head: str = "") -> None:
        with self._lock:
            self._stderr.write(in_whole_words(text, self._stderr, head))
            self._stderr.flush()


def in_words(event: Event) -> str:
    """Say an event, a plan in many lines, all else in one; nothing for those that only a screen can show."""
    return "".join(head_and_words(event))


def head_and_words(event: Event) -> tuple[str, str]:
    """Say an event: the mark it begins with, behind which its words go on, and the words."""
    match event:
        case RunOpened():
            return "", f"kept in {event.folder}; to continue after a stop: {event.resume}"
        case StateChanged(state=State.HOLD):  # has all that STOP said
            return "", f"{event.state.upper()}: {event.words}"
        case StateChanged(state=State.PREFLIGHT | State.APPROACH | State.CLOSE):
            return "", f"{event.state}{': ' if event.words else ''}{event.words}"
        case Checked():
            return "ok   " if event.passed else "FAIL ", f"{event.name}: {event.words}"
        case Planned():
            return "", f"{plan_in_words(event.plan)}\n{event.way_words}"
        case Noted():
            return "! " if event.warning else "", event.words
        case PoseTaken():
            return "", pose_in_words(event)
        case Estimated():
            return "  ", estimate_in_words(event)
        case GuardTripped():
            return "", f"STOPPED by guard {event.hazard}: {event.words}"
        case Asked():
            return "", f"{event.question} {event.answer}{' (--yes)' if event.by == '--yes' else ''}"
        case _:
            return "", ""


def pose_in_words(event: PoseTaken) -> str:
    """Say how a pose was taken."""
    force_N, torque_Nm = rms_sigma(event)
    words = (
        f"{event.stop}/{event.stops} R{event.number:02d}: settled {event.settle_s:.1f} s, {event.samples} samples in "
        f"{event.average_s:.1f} s, sigma {force_N:.2g} N {torque_Nm:.2g} N·m"
    )
    if event.attempts > 1:
        words += f", {event.attempts} attempts"
    return words if event.steady else words + ", NOT STEADY"


def estimate_in_words(event: Estimated) -> str:
    """Say where the calibration stands."""
    words = f"coverage {event.light}"
    if "mass_kg" in event.values:
        words += f", mass {event.values['mass_kg']:.4f} ± {event.sigma['mass_kg']:.4f} kg"
    if event.residual_sigma is not None and event.residual_force_N is not None:
        words += f", {event.residual_force_N:.3f} N from the fit before, {event.residual_sigma:.1f} sigma"
    return f"{words}; helps most: {event.hint}" if event.hint else words


def rms_sigma(event: PoseTaken) -> tuple[float, float]:
    """Standard deviation of one axis of the mean: force, N, and torque, N·m."""
    variance = np.square(event.sigma)
    return float(np.sqrt(variance[:3].mean())), float(np.sqrt(variance[3:].mean()))
