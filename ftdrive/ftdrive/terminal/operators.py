"""Operators without a screen: JSON for scripts, plain lines for logs, pipes and dumb terminals."""

import json
import sys
from collections.abc import Mapping, Sequence
from contextlib import suppress
from threading import Lock
from typing import Any, Final, TextIO

from ftdrive.errors import Declined
from ftdrive.session.events import SCHEMA_VERSION, Asked, Event, Key, Question
from ftdrive.terminal.supervisor import Supervisor
from ftdrive.terminal.text import in_whole_words
from ftdrive.words.session import SessionText
from ftdrive.words.text import TextLine, visible

# Short answers and the words for which they stand in every question. No word that moves an arm has a short form.
_SAME: Final = {"y": "yes", "n": "no", "q": "quit", "quit": "q", "skip": "s", "redo": "r"}


def match_answer(question: Question, typed: str) -> str | None:
    """Return the answer to a question that a typed text gives; None if the text is not an answer.

    If the question has only one answer, a word that must be typed exactly, "no" raises `Declined`.
    """
    typed = typed.strip()
    if typed in question.answers:
        return typed
    if len(question.answers) > 1:
        word = typed.lower()
        return next((one for one in (word, _SAME.get(word)) if one in question.answers), None)
    if typed.lower() in {"n", "no"}:
        raise Declined(f"the answer was no, not {question.answers[0]}")
    return None


def prompt(question: Question) -> str:
    """Return the text of a question, with the possible answers unless it already names the only one."""
    if len(question.answers) == 1 and question.answers[0] in question.text:
        return f"{question.text}: "
    return f"{question.text} [{'/'.join(answer or 'Enter' for answer in question.answers)}] "


def not_an_answer(question: Question, typed: str) -> str:
    """Return a message that a typed line is not an answer to the question, and what to type instead."""
    word = typed.strip()
    named = [answer for answer in question.answers if answer]
    if len(question.answers) == 1 and word.lower() == named[0].lower():
        return f"'{word}' is not {named[0]}: type it in capital letters, or no."
    other = [f"'{answer}'" for answer in named] + ["Enter"] * ("" in question.answers)
    choice = " or ".join(filter(None, [", ".join(other[:-1]), other[-1]]))
    full = [answer for answer in named if word and len(word) < len(answer) and answer.startswith(word.lower())]
    return f"'{word}' is not an answer here: type {full[0] + ' in full' if len(full) == 1 else choice}."


def read_answer(supervisor: Supervisor, question: Question) -> str:
    """Read the line that answers a question. Raises the errors of `Supervisor.read_line`."""
    return supervisor.read_line(
        f"no answer to '{prompt(question).strip()}': run the command in a terminal, or answer on standard input"
    )


class _Keyless:
    has_keys = False
    pressed_by = "the operator"
    supervisor: Supervisor

    def absence(self) -> str | None:
        return self.supervisor.absence()

    def pressed(self) -> Key | None:
        return None


class JsonOperator(_Keyless):
    """Operator for scripts: writes each event and question to stdout as a line of JSON, and reads answers from stdin.

    A question is the object `{"event": "question", "text", "answers", "error"}`. The next line of stdin is its answer.
    `error` is the reason for rejecting the previous line, or null.
    """

    def __init__(self, *, stdin: TextIO | None = None, stdout: TextIO | None = None) -> None:
        self._stdout = stdout or sys.stdout
        self.supervisor = Supervisor(stdin or sys.stdin, self._stdout, "standard output")
        self._lock = Lock()

    def show(self, event: Event) -> None:
        """Write an event as a line of JSON."""
        self._write(event.to_dict())

    def ask(self, question: Question) -> str:
        """Return the answer read from stdin. Raises `Declined` at the end of stdin."""
        self.supervisor.expect_answer()
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
            typed = read_answer(self.supervisor, question)
            if (answer := match_answer(question, typed)) is not None:
                return answer
            error = not_an_answer(question, typed)

    def _write(self, value: Mapping[str, Any]) -> None:
        line = json.dumps(value, allow_nan=False) + "\n"
        with self._lock, self.supervisor.writing():
            self._stdout.write(visible(line))
            self._stdout.flush()


class PlainOperator(_Keyless):
    """Operator to whom plain lines are written on stderr, without colours or keys; for `verbose`, see `SessionText`.

    With `quiet`, lines are printed only before the next question, which may refer to them.
    """

    def __init__(
        self, *, stdin: TextIO | None = None, stderr: TextIO | None = None, quiet: bool = False, verbose: bool = False
    ) -> None:
        self._stdin, self._stderr = stdin or sys.stdin, stderr or sys.stderr
        self.supervisor = Supervisor(self._stdin, self._stderr, "standard error")
        self._text = SessionText(verbose=verbose)
        self._quiet, self._withheld = quiet, list[TextLine]()
        self._lock = Lock()
        self._asked = ""

    def show(self, event: Event) -> None:
        """Write the lines of text about an event."""
        if isinstance(event, Asked) and event.question == self._asked:
            # nothing to write, because `ask` has already printed question and answer
            return
        self._write_lines(self._text.lines(event))

    def ask(self, question: Question) -> str:
        """Return the answer from stdin; a terminal's earlier input is discarded. The end of stdin raises `Declined`."""
        self.supervisor.expect_answer()
        self._asked = question.text
        self.finish()
        quiet, self._quiet, withheld, self._withheld = self._quiet, False, self._withheld, []
        self._write_lines(withheld)
        self._quiet = quiet
        # discard input typed before the question, which might confirm a motion that had not been shown yet
        if self._stdin.isatty():
            # the import fails on Windows, where early input cannot be discarded, so no answer is read
            import termios

            # ignore the error of a closed terminal, because reading the answer raises it
            with suppress(termios.error):
                termios.tcflush(self._stdin.fileno(), termios.TCIFLUSH)
        while True:
            self._write(prompt(question))
            try:
                typed = read_answer(self.supervisor, question)
            except (KeyboardInterrupt, Declined):
                # end the line of the prompt before the next message
                self._write("\n")
                raise
            if not self._stdin.isatty():
                self._write(typed)
            if (answer := match_answer(question, typed)) is not None:
                return answer
            self._write(not_an_answer(question, typed) + "\n")

    def finish(self) -> None:
        """Write the line of passed checks that is still held back because further checks may join it."""
        self._write_lines(self._text.pending())

    def _write_lines(self, lines: Sequence[TextLine]) -> None:
        if self._quiet:
            self._withheld += lines
            return
        for line in lines:
            self._write(f"{line.head}{line.words}\n", line.head)

    def _write(self, text: str, head: str = "") -> None:
        with self._lock, self.supervisor.writing():
            self._stderr.write(in_whole_words(text, self._stderr, head))
            self._stderr.flush()
