"""The page of `ftdrive init`: its questions as a form, beside the cell that the answers describe."""

import time
from collections.abc import Callable, Collection, Sequence
from contextlib import suppress
from html import escape
from itertools import count
from pathlib import Path
from queue import SimpleQueue
from typing import Any, Final

import numpy as np

from ftcalib.errors import UsageError
from ftdrive.cell.config import CellConfig, RobotConfig, SensorConfig, ToolConfig, WorkcellConfig
from ftdrive.cell.units import SIDES
from ftdrive.checks.description import (
    BASE_AXES,
    BOXES,
    MODEL,
    QUESTIONS,
    ROBOT,
    SENSOR,
    TOOL,
    WALLS,
    Description,
    Question,
)
from ftdrive.checks.discovery import places
from ftdrive.errors import ConfigError
from ftdrive.planning.planner import USUAL_POSTURE_RAD, certifier_as_described
from ftdrive.terminal.console import hanging, messages
from ftdrive.view.page import Page
from ftdrive.view.scene import DrawnArm, draw_surroundings, size_of
from ftdrivers.errors import DeviceError
from ftdrivers.ur.kinematics import model_named

_SECTIONS: Final = {"robot": "Robot", "sensor": "Sensor", "tool": "Tool", "workcell": "Surroundings"}
# Entries of the dropdowns that are no answer by themselves.
_OPEN, _SLANTING, _DEGREES = "choose", "slanting", "degrees"
_RED, _GREEN, _ORANGE, _PLAIN = "#e03131", "#2f9e44", "#e8590c", "inherit"
# Until a tool is described, the arm is drawn with this.
_NO_TOOL: Final = ((0.0, 5.0, 60.0),)
_ROWS: Final = {
    TOOL: ("Cylinder", "Cylinders of sensor and tool"),
    WALLS: ("Wall", "Walls and tables"),
    BOXES: ("Box", "Boxes"),
}
# The last words reach browsers before the server ends.
_FAREWELL_S: Final = 0.5


class InitPage:
    """Fills a page with the form, and fills in a description from it.

    Parameters
    ----------
    draft : Path
        Keeps the answers after each change.
    name : str
        Of the file that is to be written.
    """

    def __init__(self, page: Page, described: Description, draft: Path, name: str) -> None:
        self._page, self._described, self._draft, self._name = page, described, draft, name
        # Only the thread of `run` changes anything; the callbacks of browsers wait for nothing.
        self._todo: SimpleQueue[Callable[[], object]] = SimpleQueue()
        self._fields: list[_Field] = []
        self._found: dict[str, tuple[str, str]] = {}
        self._drawn: list[Any] = []
        self._saved: dict[str, list[str]] = {}
        self._drawn_for: Any = None
        self._near = ""
        self._is_written = False
        gui = page.gui
        # The robot may report its model, and another robot not.
        asked = described.questions
        self._questions = QUESTIONS if ROBOT in [one.key for one in asked] else asked
        for section, title in _SECTIONS.items():
            with gui.add_folder(title):
                for question in self._questions:
                    if question.key.startswith(f"{section}."):
                        (self._add_rows if question.repeats else self._add_field)(question)
                if section == "sensor" and self._questions is QUESTIONS:
                    self._on_click(gui.add_button("Look for robot and sensor"), self._look)
        self._words = gui.add_html("")
        self._write = gui.add_button(f"Write {name}", color="green")
        self._on_click(self._write, self._finish)

    def run(self) -> None:
        """Show and judge the answers until they are to be written."""
        self._read()
        self._saved = dict(self._described.texts)
        self._refresh()
        while not self._is_written:
            self._todo.get()()
            # What was typed meanwhile is judged together.
            while not self._todo.empty():
                self._todo.get()()
            self._refresh()
        self._words.content = _html(f"{self._name} is written, see the terminal. This page ends.", _GREEN)
        time.sleep(_FAREWELL_S)

    def _on_click(self, button: Any, act: Callable[[], object]) -> None:
        button.on_click(lambda _: self._todo.put(act))

    def _add_field(self, question: Question, label: str = "", text: str | None = None) -> "_Field":
        if text is None:
            text = self._described.texts.get(question.key, [self._described.usual(question) or ""])[0]
        found = places() if question.key == SENSOR else []
        note = f"; found here: {', '.join(found)}" if found else ""
        field = _Field(self._page, question, label or question.label, text, note)
        field.on_update(lambda _: self._todo.put(lambda: None))
        self._fields.append(field)
        return field

    def _add_rows(self, question: Question) -> None:
        gui, (one, several) = self._page.gui, _ROWS[question.key]
        with gui.add_folder(several) as folder:
            about = f"{BASE_AXES} Slanting: NX:NY:NZ:MM." if question.key == WALLS else question.how
            gui.add_html(_html(about[0].upper() + about[1:]))
            add = gui.add_button(f"Add {one.lower()}", order=1e9)
        numbers = count(1)

        def add_row(text: str) -> None:
            name = f"{one} {next(numbers)}"
            with folder:
                field = self._add_field(question, name, text)
                field.remove = gui.add_button(f"Remove {name.lower()}", color="gray")
                self._on_click(field.remove, lambda: self._remove(field))

        self._on_click(add, lambda: add_row(f"{next(iter(SIDES))} " if question.key == WALLS else ""))
        for text in self._described.texts.get(question.key, [""] if question.usual is None else []):
            add_row(text)

    def _remove(self, field: "_Field") -> None:
        self._fields.remove(field)
        field.take_away()

    def _refresh(self) -> None:
        """Judge all answers, show what is wrong with them, draw the cell and keep the draft."""
        self._read()
        with self._page.at_once():
            wrong = [field for field in self._fields if not self._judge(field)]
            problem = self._problem(wrong)
            words = (f"✘ {problem}", _RED) if problem else (f"✔ Complete: {self._name} can be written.", _GREEN)
            self._draw(wrong)
            self._words.content = _html(*words) + _html(self._near, _ORANGE)
            self._write.disabled = bool(problem)
        if self._described.texts != self._saved:
            open_ = {field.question.key for field in wrong} | ({ROBOT, SENSOR} - self._described.reports.keys())
            self._described.answered = self._described.texts.keys() - open_
            self._described.save(self._draft)
            self._saved = dict(self._described.texts)

    def _read(self) -> None:
        """Take the answers out of the fields; another address has reported nothing yet."""
        described = self._described
        for question in self._questions:
            if question.key == MODEL and ROBOT in described.reports:
                continue
            texts = [field.text for field in self._fields if field.question is question and field.text]
            if question.key in (ROBOT, SENSOR) and described.texts.get(question.key) != texts:
                self._found.pop(question.key, None)
                described.keep(question.key, texts[0] if texts else "")
            if texts:
                described.texts[question.key] = texts
            else:
                described.texts.pop(question.key, None)
        for field in self._fields:
            if field.question.key == MODEL:
                field.show_reported(described.model if ROBOT in described.reports else None)

    def _judge(self, field: "_Field") -> bool:
        """Show the words of a field; return whether it can be used, or is empty."""
        question, text = field.question, field.text
        try:
            if text:
                self._described.judge(question, text)
        except ConfigError as error:
            field.say(f"✘ {error}", _RED)
            return False
        words, colour = self._found.get(question.key, ("", _PLAIN))
        if question.key == MODEL and self._described.without_shape:
            words, colour = self._described.without_shape, _ORANGE
        field.say(words, colour)
        return True

    def _problem(self, wrong: Sequence["_Field"]) -> str:
        """Return why the file cannot be written yet; empty if it can."""
        described = self._described
        if wrong:
            return f"Correct what is red: {', '.join(field.label for field in wrong)}."
        try:
            described.judge_rows(next(one for one in QUESTIONS if one.key == TOOL))
            rows = [field.label for field in self._fields if field.question.repeats and not field.text]
            empty = [one.label for one in described.missing if not one.repeats]
            if empty or rows:
                return f"Still empty: {', '.join([*empty, *rows])}."
            described.cell()
        except ConfigError as error:
            return str(error)
        return ""

    def _look(self) -> None:
        """Read robot and sensor, and show what they report here and in the terminal."""
        self._read()
        for field in [one for one in self._fields if one.question.key in (ROBOT, SENSOR) and one.text]:
            key = field.question.key
            field.say("Reading …", _PLAIN)
            try:
                words = f"✔ {self._described.look(key, field.text)}"
                self._found[key] = words, _GREEN
                field.typed.value = self._described.texts[key][0]
            except (DeviceError, UsageError) as error:
                words = f"✘ {error}"
                self._found[key] = words, _ORANGE
                self._described.keep(key, field.text)
            messages.print(hanging(f"  {words[:2]}", words[2:]), soft_wrap=True)

    def _finish(self) -> None:
        self._refresh()
        self._is_written = not self._write.disabled

    def _draw(self, wrong: Collection["_Field"]) -> None:
        """Draw what can be read of the cell, red what is refused or in the way."""
        described = self._described
        values: dict[str, list[tuple[_Field, Any]]] = {TOOL: [], WALLS: [], BOXES: []}
        for field in self._fields:
            if field.question.key in values and field.text:
                with suppress(ConfigError):
                    values[field.question.key].append((field, described.value(field.question, field.text)))
        tool, walls, boxes = (tuple(value for _, value in rows) for rows in values.values())
        has_shape = described.model is not None and not described.without_shape
        workcell = WorkcellConfig(planes_mm=walls, boxes_mm=boxes)
        cell = CellConfig(RobotConfig(""), SensorConfig(""), ToolConfig(cylinders_mm=tool or _NO_TOOL), workcell)
        if self._drawn_for == (drawn_for := (cell, described.model, [field.label for field in wrong])):
            return
        self._drawn_for = drawn_for
        certifier = certifier_as_described(cell, described.model if has_shape else "ur5e")
        names = {f"plane {i}": field for i, (field, _) in enumerate(values[WALLS], start=2)}
        names |= {f"box {i}": field for i, (field, _) in enumerate(values[BOXES], start=1)}
        near = certifier.too_near(USUAL_POSTURE_RAD) if has_shape else []
        scene, size_m = self._page.scene, size_of(certifier)
        for one in self._drawn:
            one.remove()
        self._drawn = [scene.add_frame(name, show_axes=False) for name in ("/surroundings", "/arm")]
        bad = {body for pair in near for body in pair}
        draw_surroundings(scene, certifier.scene, size_m, bad | {one for one in names if names[one] in wrong})
        for name, at_m in (("+x", (0.25, 0.0, 0.0)), ("+y", (0.0, 0.25, 0.0))):
            scene.add_label(f"/base/{name}", name, position=at_m)
        self._page.look(np.array([0.0, 0.0, 0.2 * size_m]), 0.6 * size_m * np.array([1.0, 1.0, 0.8]))
        if has_shape:
            arm = DrawnArm(scene, certifier.arm)
            arm.show(USUAL_POSTURE_RAD)
            arm.accuse(bad)
        labels = {"plane 1": "the mounting surface"} | {name: field.label for name, field in names.items()}
        pairs = [
            f"{', '.join(dict.fromkeys(one for one, other in near if other == thing))} to {labels.get(thing, thing)}"
            for thing in dict.fromkeys(other for _, other in near)
        ]
        self._near = f"In its usual posture the arm is nearer than allowed: {'; '.join(pairs)}." if pairs else ""


class _Field:
    """One answer in the form: what is chosen, what is typed, and words about it below."""

    def __init__(self, page: Page, question: Question, label: str, text: str, note: str) -> None:
        self.question, self.label = question, label
        self.remove: Any = None
        # Rows have it once, above them.
        self._how = "" if question.repeats else f"{question.how}{note}"
        self._choice: Any = None
        self.typed: Any = None
        gui, key = page.gui, question.key
        if key == WALLS:
            side, _, typed = text.partition(" ")
            choice, text = (side, typed) if side in SIDES else (_SLANTING, text)
            self._choice = gui.add_dropdown(f"{label} at", (*SIDES, _SLANTING), initial_value=choice)
            label = "Distance"
        elif key == MODEL:
            text = model_named(text, controller_major=0) or text or _OPEN
            choices = dict.fromkeys((_OPEN, *question.choices, text))
            self._choice = gui.add_dropdown(label, tuple(choices), initial_value=text)
        elif question.choices:
            choice, text = (text, "") if text in question.choices else (_DEGREES, text)
            self._choice = gui.add_dropdown(label, (*question.choices, _DEGREES), initial_value=choice)
            label = "Degrees"
        if key != MODEL:
            self.typed = gui.add_text(label, text)
        self._inputs = [one for one in (self._choice, self.typed) if one is not None]
        self._words = gui.add_html("")

    @property
    def text(self) -> str:
        """The answer, as the terminal takes it."""
        typed = "" if self.typed is None else self.typed.value.strip()
        if self._choice is None or self._choice.value in (_OPEN, _SLANTING, _DEGREES):
            return typed
        if self.question.key == WALLS:
            return typed and f"{self._choice.value} {typed}"
        return str(self._choice.value)

    def on_update(self, act: Callable[[Any], object]) -> None:
        """Call back after each change."""
        for one in self._inputs:
            one.on_update(act)

    def say(self, words: str, colour: str) -> None:
        """Show words below; how to answer if there are none."""
        if self.question.choices and self.typed is not None:
            self.typed.visible = self._choice.value == _DEGREES
        self._words.content = _html(words or self._how, colour)

    def show_reported(self, model: str | None) -> None:
        """Choose the model that the robot has reported, which nothing else can replace."""
        self._choice.disabled = model is not None
        if model is not None:
            if model not in self._choice.options:
                self._choice.options = (model, *self._choice.options)
            self._choice.value = model

    def take_away(self) -> None:
        """Remove it from the form, a row."""
        for one in (*self._inputs, self._words, self.remove):
            one.remove()


def _html(words: str, colour: str = _PLAIN) -> str:
    style = f"margin:0 0.7em 0.5em;font-size:0.75em;color:{colour};opacity:{0.75 if colour == _PLAIN else 1}"
    return f'<p style="{style}">{escape(words)}</p>' if words else ""
