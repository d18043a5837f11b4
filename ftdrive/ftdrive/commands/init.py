"""`ftdrive init`: ask for a description of the cell, and write it to a file. Nothing moves."""

import sys
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from shlex import quote
from typing import TYPE_CHECKING, Any

import click

from ftcalib.errors import UsageError
from ftdrive.commands.common import (
    JSON,
    MODEL,
    NewFile,
    ViewOptions,
    check_simulate,
    simulate,
    view_options,
    write_json,
)
from ftdrive.errors import ConfigError
from ftdrive.terminal.text import echo, in_whole_words, visible
from ftdrivers.errors import DeviceError

if TYPE_CHECKING:
    from ftdrive.checks.description import Description, Question


@click.command()
@click.option("--robot", metavar="HOST", help="Address of the controller.")
@MODEL
@click.option(
    "--sensor", metavar="URL|PLACE", help="Address of the sensor, or a place that `ftdrive devices --probe` takes."
)
@click.option("--height", metavar="MM", help="Height of the sensor above the flange face. Measure it.")
@click.option("--sensor-mass", metavar="KG", help="Mass of sensor and adapter.")
@click.option("--tool-name", metavar="NAME", help="Name of the tool.")
@click.option(
    "--tool",
    multiple=True,
    metavar="FROM:TO:DIAMETER[:X:Y]",
    help="A cylinder of what is mounted, the sensor too, in mm from the flange face. Repeatable.",
)
@click.option("--tool-mass", metavar="KG", help="Approximate mass of what hangs on the sensor.")
@click.option(
    "--mounting",
    help="Mounting of the base: floor, wall, ceiling, or degrees the base leans towards its -x: 90 is wall.",
)
@click.option(
    "--plane",
    multiple=True,
    metavar="SIDE:MM|NX:NY:NZ:MM",
    help="A wall: its side (+x, -x, +y, -y, above, below) and distance from the base, or a normal and where it lies: "
    "the arm stays where N·p >= MM, base axes. Repeatable.",
)
@click.option("--box", multiple=True, metavar="X:Y:Z:X:Y:Z", help="A block: two corners in mm, base axes. Repeatable.")
@click.option("--speed", metavar="DEG/S", help="Speed of the fastest joint.")
@click.option(
    "-o",
    "--output",
    type=NewFile(),
    default="ftdrive.toml",
    show_default=True,
    help="Save the configuration as this new file.",
)
@view_options
@simulate("Robot and sensor are emulated, and end with this command; --sensor emulated://NAME chooses the sensor.")
@click.option("--yes", is_flag=True, help="Ask nothing: take the options and the defaults.")
@JSON
def init(
    output: Path,
    simulate: bool,
    yes: bool,
    view: ViewOptions,
    as_json: bool,
    **given: Any,
) -> None:
    """Describe a cell: read robot and sensor, ask for the rest, write ftdrive.toml.

    The arm is only read and nothing moves. An existing file is never overwritten. Values that must be measured have no
    default, and `measured = false` stays in the file until you change it. Lengths are in mm and masses in kg, or have
    their unit. With --view the questions are a form in the browser, beside the cell as it is described.
    """
    from ftcalib.files import write_new
    from ftdrive.cell.config import clock_in_force, settings
    from ftdrive.cell.emulated import EMULATED, Station, sensor_name
    from ftdrive.checks.description import ROBOT, SENSOR, Description, draft_of
    from ftdrive.terminal.console import beside, messages

    if yes and view.wanted:
        raise ConfigError("--yes and --view exclude one another: leave one of them out")
    check_simulate(simulate, real={"--robot": given["robot"]})
    in_force = {key: setting.value for key, setting in settings().items()}
    described, draft = Description(clock_in_force(), in_force, simulate=simulate), draft_of(output)
    again = "ftdrive init" + ("" if str(output) == "ftdrive.toml" else f" -o {quote(str(output))}")
    interview = _Interview(described, None if yes else draft, again + " --simulate" * simulate)
    with view.page(f"ftdrive init, {output}") as page:
        interview.take_draft(asked=page is None)
        if simulate:
            emulated = sensor_name(given.pop("sensor"))
            with Station(emulated, ["--time-scale", "1"]) as station:
                described.clock = station.clock
                interview.look(ROBOT, station.cell.robot.host)
                interview.look(SENSOR, station.cell.sensor.url)
            # The addresses of the station end with it.
            described.texts |= {ROBOT: ["emulated"], SENSOR: [EMULATED + emulated]}
        interview.take_options(given)
        if page is None:
            interview.run()
        else:
            from ftdrive.view.init_page import InitPage

            messages.print(f"Fill in the form there. Ctrl-C ends, and {draft} keeps the answers.")
            InitPage(page, described, draft, output.name).run()
        cell = described.cell()
        write_new(output, described.file())
        words, end = ". Measure tool, planes and boxes, then set measured = true in it: nothing moves before.", ""
        if simulate:
            words, end = " for an emulated cell: commands with --simulate use it, all others refuse it.", " --simulate"
        if page is not None:
            from ftdrive.view.parts import GOOD, lines

            # at the top, and where Write was pressed
            written = lines(f"Wrote {output}{words}", f"Next: ftdrive doctor{end}", head="Written", tone=GOOD)
            page.put({"result": written, "form/words": written, "form/write": None})
    draft.unlink(missing_ok=True)
    if as_json:
        write_json({"schema_version": 1, "file": str(output), **described.found(), "config": cell.to_dict()})
    beside(as_json).print(f"Wrote {output}{words}")
    messages.print_next(f"ftdrive doctor{end}", f"ftdrive plan{end}")


class _Back(Exception):
    """The operator wants the question before."""


class _Interview:
    """Asks in the terminal for what is not answered yet; `draft` is None with --yes, which takes the usual answers."""

    def __init__(self, described: "Description", draft: Path | None, again: str) -> None:
        self._described, self._draft, self._again = described, draft, again
        self._addresses: dict[str, str] = {}

    def take_draft(self, *, asked: bool) -> None:
        """Take the answers of a draft; if `asked`, only after a yes."""
        from ftdrive.checks.description import saved_at

        if self._draft is None or not self._draft.exists():
            return
        when = saved_at(self._draft)
        if asked and not self._agrees(f"Go on with the answers of {when}? [yes/no]: "):
            self._draft.unlink()
            return
        self._described.load(self._draft)
        if not asked:
            _say(f"The answers of {when} are filled in from {self._draft}. Delete it to begin without them.")

    def take_options(self, given: dict[str, Any]) -> None:
        """Take the answers that options give; raises `ConfigError` for those that cannot be used."""
        from ftdrive.checks.description import QUESTIONS, ROBOT, SENSOR

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
        """Read a device, and print what it reports; raises as `Description.look`."""
        _say(self._described.look(key, text), "  ✔ ")

    def run(self) -> None:
        """Ask until everything is answered, and confirmed in a summary."""
        if self._draft is not None:
            _say("Numbers may have a unit, such as 3.3 cm or 450 g. Enter 'back' for the question before.")
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

    def _answer(self, question: "Question") -> None:
        from ftdrive.checks.description import MODEL, ROBOT, SENSOR

        described, key = self._described, question.key
        if key in (ROBOT, SENSOR):
            self._find(question)
        elif question.repeats:
            self._answer_rows(question)
        else:
            usual = self._former(question)
            words = f"{question.label}, {question.how}" + " (Enter: unknown)" * (usual == "")
            described.texts[key] = [self._ask(question, words, usual, lambda text: described.judge(question, text))]
        if key in (ROBOT, MODEL) and described.without_shape:
            _say(described.without_shape, "  ! ")

    def _former(self, question: "Question") -> str | None:
        texts = self._described.texts.get(question.key)
        return texts[0] if texts else self._described.usual(question)

    def _answer_rows(self, question: "Question") -> None:
        """Ask for rows until an empty answer; "back" removes the last one."""
        from ftdrive.checks.description import BASE_AXES, WALLS

        described = self._described
        rows = described.texts.setdefault(question.key, [])
        if question.key == WALLS and self._draft is not None:
            _say(BASE_AXES)
        for row in rows:
            _say(row, "  = ")

        def accept(text: str) -> None:
            if text:
                described.judge(question, text)
            else:
                described.judge_rows(question)

        while True:
            words = "  next (Enter: no more)" if rows else f"{question.label}, {question.how}"
            usual = "" if rows else question.usual
            words += " (Enter: none)" * (usual == "" and not rows)
            try:
                text = self._ask(question, words, usual, accept).strip()
            except _Back:
                if not rows:
                    raise
                _say(f"removed {rows.pop()}", "  = ")
                continue
            if not text:
                return
            rows.append(text)
            self._save()

    def _find(self, question: "Question") -> None:
        """Ask for the address of a device until one answers; the operator may keep one that does not."""
        from ftdrive.checks.description import SENSOR
        from ftdrive.checks.discovery import is_place, places

        described, key = self._described, question.key
        text = self._addresses.pop(key, None)
        usual = self._former(question)
        words = f"{question.label}, {question.how}"
        if key == SENSOR and text is None and self._draft is not None:
            described.places = places()
            for i, place in enumerate(described.places, start=1):
                _say(f"  {i}) {place}")
            if described.places:
                words, usual = f"{question.label}: a number, a URL, or a port to probe", usual or "1"
        failed: str | None = None
        while True:
            if text is None:
                text = self._ask(question, words, usual, lambda answer: described.judge(question, answer))
            if text == failed:
                described.keep(key, text)
                return
            try:
                self.look(key, text)
            except (DeviceError, UsageError) as error:
                if self._draft is None:
                    raise
                _say(str(error), "  ✘ ")
                keeps = isinstance(error, DeviceError) and not (key == SENSOR and is_place(text))
                failed = usual = text if keeps else None
            else:
                return
            words = "Another address, or Enter to keep it" if keeps else "Another address"
            text = None

    def _confirmed(self) -> bool:
        """Show all answers; return whether they are to be written, False after a number, whose question is open again.

        Raises `_Back` if the last question is to be asked again.
        """
        from ftdrive.checks.description import ROBOT, SENSOR

        described = self._described
        questions = described.questions
        for i, one in enumerate(questions, start=1):
            texts = "; ".join(filter(None, described.texts.get(one.key, [])))
            report = described.reports.get(one.key, "not read") if one.key in (ROBOT, SENSOR) else ""
            _say(f"{texts or 'none'}{report and f' ({report})'}", f"{i:>3}) {one.label}: ")
        while True:
            answer = self._prompt("Enter writes the file, a number changes that answer: ", "", "the summary").strip()
            if not answer:
                try:
                    described.cell()
                except ConfigError as error:
                    _say(str(error), "  ✘ ")
                else:
                    return True
            elif answer.isdecimal() and 0 < int(answer) <= len(questions):
                described.answered.discard(questions[int(answer) - 1].key)
                return False
            else:
                _say(f"'{answer}' is not a number of 1 to {len(questions)}", "  ✘ ")

    def _ask(self, question: "Question", words: str, usual: str | None, accept: Callable[[str], None]) -> str:
        """Return the answer to a question, asked again until it is accepted; Enter and --yes take `usual`."""
        if self._draft is None:
            if usual is None:
                raise ConfigError(f"{question.option} is missing and has no default: {words[0].lower()}{words[1:]}")
            accept(usual)
            return usual
        while True:
            answer = self._prompt(f"{words} [{usual}]: " if usual else f"{words}: ", usual, question.option)
            try:
                accept(answer)
            except ConfigError as error:
                _say(str(error), "  ✘ ")
            else:
                return answer

    def _agrees(self, words: str) -> bool:
        while True:
            with suppress(_Back):
                if (answer := self._prompt(words, None, "an answer").strip().lower()) in ("yes", "no"):
                    return answer == "yes"
            _say("Enter yes or no.", "  ✘ ")

    def _prompt(self, words: str, usual: str | None, what: str) -> str:
        """Ask once; raises `_Back`, `ConfigError` at the end of the input, and `click.Abort` after Ctrl-C."""
        shown = in_whole_words(words, sys.stderr)
        try:
            answer: str = click.prompt(visible(shown), default=usual, show_default=False, prompt_suffix="", err=True)
        except click.Abort as abort:
            # The next message begins a line.
            echo(err=True)
            kept = ""
            if self._draft is not None and self._draft.exists():
                kept = f"the answers so far are kept in {self._draft}, go on with them:\n{self._again}"
            if isinstance(abort.__context__, EOFError):
                raise ConfigError(f"the input ended before {what} was given" + (kept and f"; {kept}")) from abort
            if kept:
                _say(kept[0].upper() + kept[1:], "  ! ")
            raise
        if answer.strip().lower() == "back":
            raise _Back
        return answer


def _say(words: str, head: str = "") -> None:
    from ftdrive.terminal.console import hanging, messages

    messages.print(hanging(head, words), soft_wrap=True)
