"""Operators without a screen: JSON for scripts, plain lines for logs; what counts as an answer."""

import io
import json
import os
import pty
import select
import sys
import threading
from collections.abc import Callable

import pytest
from syrupy.assertion import SnapshotAssertion

from ftdrive.errors import Declined, exit_code
from ftdrive.session.events import (
    Asked,
    Checked,
    Event,
    GuardTripped,
    Noted,
    Operator,
    Question,
    RunOpened,
    State,
    StateChanged,
)
from ftdrive.terminal.operators import JsonOperator, PlainOperator, match_answer
from tests.unit.ftdrive.terminal.test_screen import estimated, pose

FREE = Question("Is the tool free?", assumed="yes")
MOVE = Question("Type MOVE to let the arm move", ("MOVE",))
STEP = Question("Next pose?", ("", "s", "r", "q"))
HELD = Question("What now?", ("resume", "skip", "back", "quit"))


POSE = pose(7, 5, attempts=2, steady=False)


@pytest.mark.parametrize(
    ("question", "typed", "answer"),
    [
        (FREE, "yes\n", "yes"),
        (FREE, "Y", "yes"),
        (FREE, " no ", "no"),
        (FREE, "", None),
        (FREE, "maybe", None),
        (MOVE, "MOVE\n", "MOVE"),
        (MOVE, "move", None),  # typed in full, as it stands
        (MOVE, "M", None),
        (MOVE, "", None),
        (STEP, "\n", ""),
        *((STEP, word, word[0].lower()) for word in ("s", "r", "q", "Skip", "redo", "quit")),
        *((HELD, word, word.lower()) for word in ("Resume", "skip", "back", "Quit")),
        (HELD, "q", "quit"),
        *((HELD, letter, None) for letter in "rsbp"),  # one letter moves no arm
        (STEP, "p", None),
        (FREE, "q", None),
    ],
)
def test_what_counts_as_an_answer(question: Question, typed: str, answer: str | None) -> None:
    assert match_answer(question, typed) == answer


def test_a_word_that_must_be_typed_can_be_refused() -> None:
    with pytest.raises(Declined, match="no, not MOVE"):
        match_answer(MOVE, "no")


def test_a_script_reads_events_and_answers_questions() -> None:
    stdin, stdout = io.StringIO("no idea\nMOVE\n"), io.StringIO()
    operator: Operator = JsonOperator(stdin=stdin, stdout=stdout)
    operator.show(StateChanged(state=State.MOVE, stop=1, stops=25, number=19))
    assert operator.ask(MOVE) == "MOVE"
    operator.show(estimated(cond_u1=float("inf")))
    operator.show(POSE)
    lines = [json.loads(line) for line in stdout.getvalue().splitlines()]
    assert [line["event"] for line in lines] == ["state-changed", "question", "question", "estimated", "pose-taken"]
    assert all(line["schema_version"] == 1 for line in lines)
    assert lines[1]["answers"] == ["MOVE"]
    assert lines[1]["error"] is None
    assert "'no idea'" in lines[2]["error"]
    assert lines[3]["cond_u1"] is None  # JSON has no infinity
    assert lines[3]["values"]["mass_kg"] == 1.187
    assert lines[4]["sigma"] == POSE.sigma.tolist()
    assert operator.pressed() is None
    assert not operator.has_keys


def json_operator(typed: str) -> Operator:
    return JsonOperator(stdin=io.StringIO(typed), stdout=io.StringIO())


def plain_operator(typed: str) -> Operator:
    return PlainOperator(stdin=io.StringIO(typed), stderr=io.StringIO())


@pytest.mark.parametrize("operator", [json_operator, plain_operator])
def test_the_end_of_the_input_is_no_consent(operator: Callable[..., Operator]) -> None:
    with pytest.raises(Declined, match="no answer to 'Type MOVE"):
        operator("").ask(MOVE)
    with pytest.raises(Declined):
        operator("maybe\n").ask(FREE)


def test_plain_lines_hold_what_a_log_needs(snapshot: SnapshotAssertion) -> None:
    stderr = io.StringIO()
    operator: Operator = PlainOperator(stdin=io.StringIO("what\nMOVE\n"), stderr=stderr)
    events: list[Event] = [
        StateChanged(state=State.PREFLIGHT),
        Checked(name="robot", passed=False, words="remote control is off: switch it on"),
        RunOpened(folder="runs/a", resume="ftdrive calibrate --resume runs/a"),
        StateChanged(state=State.SETTLE, stop=7, stops=25, number=5),
        POSE,
        estimated(),
        Noted(words="[bold] stays as it is", warning=True),
        GuardTripped(hazard=7, words="31 N: look at the tool"),
        StateChanged(state=State.HOLD, words="contact"),
    ]
    for event in events:
        operator.show(event)
    assert operator.ask(MOVE) == "MOVE"
    operator.show(Asked(question=MOVE.text, answer="MOVE", by="person"))  # stands there already
    operator.show(Asked(question=FREE.text, answer="yes", by="--yes"))  # never asked
    assert stderr.getvalue() == snapshot
    assert "\x1b" not in stderr.getvalue()


def test_what_was_typed_before_a_question_is_no_answer_to_it() -> None:
    person, program = pty.openpty()
    printed, answers = list[bytes](), list[str]()

    def read_until(words: bytes, times: int = 1) -> None:
        while b"".join(printed).count(words) < times:
            assert select.select([person], [], [], 10.0)[0], "nothing more is printed"
            printed.append(os.read(person, 4096))

    with os.fdopen(program, "r+b", buffering=0) as device:
        stdin = io.TextIOWrapper(io.BufferedReader(device), encoding="utf-8")
        stderr = io.TextIOWrapper(io.FileIO(program, "w", closefd=False), write_through=True)
        operator = PlainOperator(stdin=stdin, stderr=stderr)
        for question, answer in ((STEP, "s"), (FREE, "no"), (STEP, "")):
            printed.clear()
            os.write(person, b"\n\nyes\n")
            read_until(b"\n", 3)  # the terminal's echo: it has them all
            asking = threading.Thread(target=lambda asked: answers.append(operator.ask(asked)), args=(question,))
            asking.start()
            read_until(b"] ")
            os.write(person, answer.encode() + b"\n")
            asking.join(10.0)
            assert answers.pop() == answer
    os.close(person)


def test_a_terminal_that_cannot_discard_early_answers_gives_none(monkeypatch: pytest.MonkeyPatch) -> None:
    class Terminal(io.StringIO):
        def isatty(self) -> bool:
            return True

    monkeypatch.setitem(sys.modules, "termios", None)  # as on Windows
    typed = Terminal("MOVE\n")
    with pytest.raises(ModuleNotFoundError) as error:
        PlainOperator(stdin=typed, stderr=io.StringIO()).ask(Question("Type MOVE", ("MOVE",)))
    assert typed.tell() == 0
    assert exit_code(error.value) == 2
