"""The questions of `ftdrive init` in a terminal; only values that are not known yet are asked."""

import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import click

from ftcalib.errors import UsageError
from ftdrive.checks.description import (
    BASE_AXES,
    MODEL,
    QUESTIONS,
    ROBOT,
    SENSOR,
    WALLS,
    CellQuestion,
    Description,
    saved_at,
)
from ftdrive.checks.discovery import is_place, places
from ftdrive.errors import ConfigError
from ftdrive.terminal.console import indented, messages
from ftdrive.terminal.text import echo, in_whole_words
from ftdrive.words.text import visible
from ftdrivers.errors import DeviceError


class _Back(Exception):
    pass


class Interview:
    """Asks in the terminal for what a cell's description lacks. `draft` stores answers; with --yes, it is None."""

    def __init__(self, described: Description, draft: Path | None, again: str) -> None:
        self._described, self._draft, self._again = described, draft, again
        self._addresses: dict[str, str] = {}

    def take_draft(self, *, asked: bool) -> None:
        """Use the answers that an earlier call saved in the draft; with `asked`, only if the user confirms."""
        if self._draft is None or not self._draft.exists():
            return
        when = saved_at(self._draft)
        if asked:
            words = f"Continue with the answers from {when}? [yes/no]: "
            if self._until(words, None, "an answer", _yes_or_no, back=False).strip().lower() == "no":
                self._draft.unlink()
                return
        self._described.load(self._draft)
        if not asked:
            say(f"The answers of {when} are filled in from {self._draft}. Delete the file to start without them.")

    def take_options(self, given: dict[str, Any]) -> None:
        """Use the answers given as options of the command. An invalid answer raises `ConfigError`."""
        for question in QUESTIONS:
            if not (option := given.get(question.name)):
                continue
            texts = list(option) if question.repeats else [option]
            for text in texts:
                self._described.judge(question, text)
            self._described.texts[question.key] = texts
            if question.key in (ROBOT, SENSOR):
                self._addresses[question.key] = option
                self._described.answered.discard(question.key)
                self._described.reports.pop(question.key, None)
            else:
                self._described.answered.add(question.key)

    def look(self, key: str, text: str) -> None:
        """Read the device at an address, and print what it reports. Raises the errors of `Description.look`."""
        say(self._described.look(key, text), "  ✔ ")

    def run(self) -> None:
        """Ask until all questions are answered and the user has confirmed the list of answers."""
        if self._draft is not None:
            say("Numbers may have a unit, such as 3.3 cm or 450 g. Enter 'back' for the previous question.")
        while True:
            questions = self._described.questions
            at = next((i for i, one in enumerate(questions) if one.key not in self._described.answered), len(questions))
            try:
                if at == len(questions):
                    if self._draft is None or self._confirmed():
                        return
                    continue
                self._answer(questions[at])
                self._described.answered.add(questions[at].key)
                self._save()
            except _Back:
                self._described.answered.discard(questions[max(0, at - 1)].key)

    def _save(self) -> None:
        if self._draft is not None:
            self._described.save(self._draft)

    def _answer(self, question: CellQuestion) -> None:
        described, key = self._described, question.key
        if key in (ROBOT, SENSOR):
            self._find(question)
        elif question.repeats:
            self._answer_rows(question)
        else:
            usual = self._former(question)
            words = f"{question.label}, {question.how}" + " (Enter: unknown)" * (usual == "")
            described.texts[key] = [self._ask(question, words, usual)]
        if key in (ROBOT, MODEL) and described.without_shape:
            say(described.without_shape, "  ! ")

    def _former(self, question: CellQuestion) -> str | None:
        texts = self._described.texts.get(question.key)
        return texts[0] if texts else self._described.usual(question)

    def _answer_rows(self, question: CellQuestion) -> None:
        """Ask a question with several answers, such as boxes, until an empty one; "back" removes the last."""
        described = self._described
        rows = described.texts.setdefault(question.key, [])
        if question.key == WALLS and self._draft is not None:
            say(BASE_AXES)
        for row in rows:
            say(row, "  = ")
        while True:
            words = "  next (Enter: no more)" if rows else f"{question.label}, {question.how}"
            usual = "" if rows else question.usual
            words += " (Enter: none)" * (usual == "" and not rows)
            try:
                text = self._ask(question, words, usual).strip()
            except _Back:
                if not rows:
                    raise
                say(f"removed {rows.pop()}", "  = ")
                continue
            if not text:
                return
            rows.append(text)
            self._save()

    def _find(self, question: CellQuestion) -> None:
        """Ask for the address of a device until one answers; the operator may keep an address that does not answer."""
        described, key = self._described, question.key
        text = self._addresses.pop(key, None)
        usual = self._former(question)
        words = f"{question.label}, {question.how}"
        if key == SENSOR and text is None and self._draft is not None:
            described.places = places()
            for i, place in enumerate(described.places, start=1):
                say(f"  {i}) {place}")
            if described.places:
                words, usual = f"{question.label}: a number, a URL, or a port to probe", usual or "1"
        failed: str | None = None
        while True:
            if text is None:
                text = self._ask(question, words, usual)
            if text == failed:
                described.keep(key, text)
                return
            try:
                self.look(key, text)
            except (DeviceError, UsageError) as error:
                if self._draft is None:
                    raise
                say(str(error), "  ✘ ")
                keeps = isinstance(error, DeviceError) and not (key == SENSOR and is_place(text))
                failed = usual = text if keeps else None
            else:
                return
            words = "Another address, or Enter to keep it" if keeps else "Another address"
            text = None

    def _confirmed(self) -> bool:
        """Show all answers. Return True to write them, and False to ask the question again whose number was typed.

        Raises `_Back` if "back" was typed, to repeat the last question.
        """
        described = self._described
        questions = described.questions
        for i, one in enumerate(questions, start=1):
            texts = "; ".join(filter(None, described.texts.get(one.key, [])))
            report = described.reports.get(one.key, "not read") if one.key in (ROBOT, SENSOR) else ""
            say(f"{texts or 'none'}{report and f' ({report})'}", f"{i:>3}) {one.label}: ")

        def accept(answer: str) -> None:
            if not answer.strip():
                described.cell()
            elif not (answer.strip().isdecimal() and 0 < int(answer) <= len(questions)):
                raise ConfigError(f"'{answer.strip()}' is not a number of 1 to {len(questions)}")

        words = "Enter writes the file, a number changes that answer: "
        if number := self._until(words, "", "the summary", accept).strip():
            described.answered.discard(questions[int(number) - 1].key)
        return not number

    def _ask(self, question: CellQuestion, words: str, usual: str | None) -> str:
        """Return a valid answer; "" ends the answers of a question with several. Enter and --yes give `usual`."""

        def accept(text: str) -> None:
            if question.repeats and not text:
                self._described.judge_rows(question)
            else:
                self._described.judge(question, text)

        if self._draft is None:
            if usual is None:
                raise ConfigError(f"{question.option} is missing and has no default: {words[0].lower()}{words[1:]}")
            accept(usual)
            return usual
        words = f"{words} [{usual}]: " if usual else f"{words}: "
        return self._until(words, usual, question.option, accept)

    def _until(
        self, words: str, usual: str | None, what: str, accept: Callable[[str], None], *, back: bool = True
    ) -> str:
        """Ask until `accept` raises no error for the answer. Raises the errors of `_prompt`, and `_Back` for "back"."""
        while True:
            answer = self._prompt(words, usual, what)
            if back and answer.strip().lower() == "back":
                raise _Back
            try:
                accept(answer)
            except ConfigError as error:
                say(str(error), "  ✘ ")
            else:
                return answer

    def _prompt(self, words: str, usual: str | None, what: str) -> str:
        """Read one answer. Raises `ConfigError` at the end of the input, and `click.Abort` after Ctrl-C."""
        shown = in_whole_words(words, sys.stderr)
        try:
            return str(click.prompt(visible(shown), default=usual, show_default=False, prompt_suffix="", err=True))
        except click.Abort as abort:
            # end the line of the prompt before the next message
            echo(err=True)
            kept = ""
            if self._draft is not None and self._draft.exists():
                kept = f"the answers so far are kept in {self._draft}; continue with\n{self._again}"
            if isinstance(abort.__context__, EOFError):
                raise ConfigError(f"the input ended before {what} was given" + (kept and f"; {kept}")) from abort
            if kept:
                say(kept[0].upper() + kept[1:], "  ! ")
            raise


def _yes_or_no(answer: str) -> None:
    if answer.strip().lower() not in ("yes", "no"):
        raise ConfigError("Enter yes or no.")


def say(words: str, head: str = "") -> None:
    """Print `head` and `words` on stderr; if the text needs several lines, later ones start below the first word."""
    messages.print(indented(head, words), soft_wrap=True)
