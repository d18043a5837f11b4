"""The page of `ftdrive init`: its questions as a form, beside the cell that the answers describe."""

import time
from collections.abc import Callable, Collection, Sequence
from contextlib import suppress
from html import escape
from itertools import groupby
from pathlib import Path
from queue import Empty, SimpleQueue
from typing import TYPE_CHECKING, Any, Final

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
from ftdrive.planning.geometry.arm_model import height_above, separation_from_box
from ftdrive.planning.geometry.certify import Certifier
from ftdrive.planning.planner import USUAL_POSTURE_RAD, certifier_as_described
from ftdrive.terminal.console import hanging, messages
from ftdrive.view.page import Page
from ftdrive.view.scene import DrawnArm, draw_surroundings, size_of
from ftdrivers.errors import DeviceError

if TYPE_CHECKING:
    from viser import GuiApi

_SECTIONS: Final = {"robot": "Robot", "sensor": "Sensor", "tool": "Tool", "workcell": "Surroundings"}
# Entries of the dropdowns that are no answer by themselves.
_OPEN, _SLANTING, _DEGREES = "choose", "slanting", "degrees"
_RED, _GREEN, _ORANGE, _PLAIN = "#e03131", "#2f9e44", "#e8590c", "inherit"
# Until a tool is described, the arm is drawn with this.
_NO_TOOL: Final = ((0.0, 5.0, 60.0),)
_LAST: Final = 1e9
_PERIOD_S: Final = 0.05
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
        self._saved = dict(described.texts)
        self._is_written = False
        gui = page.gui
        for section, questions in groupby(
            sorted(described.questions, key=lambda one: [*_SECTIONS].index(one.key.split(".")[0])),
            lambda one: one.key.split(".")[0],
        ):
            with gui.add_folder(_SECTIONS[section]):
                for question in questions:
                    if question.repeats:
                        self._add_rows(question)
                    else:
                        self._add_field(question)
                if section == "sensor" and SENSOR in [one.key for one in described.questions]:
                    self._on_click(gui.add_button("Look for robot and sensor"), self._look)
        self._words = gui.add_html("")
        self._write = gui.add_button(f"Write {name}", color="green")
        self._on_click(self._write, self._finish)

    def run(self) -> None:
        """Show and judge the answers until they are to be written."""
        self._refresh()
        while not self._is_written:
            with suppress(Empty):
                self._todo.get(timeout=_PERIOD_S)()
                while True:
                    self._todo.get_nowait()()
            if self._changed:
                self._refresh()
        self._words.content = _html(f"{self._name} is written, see the terminal. This page ends.", _GREEN)
        time.sleep(_FAREWELL_S)

    # The form. -----------------------------------------------------------------------------------------------------

    def _on_click(self, button: Any, act: Callable[[], object]) -> None:
        button.on_click(lambda _: self._todo.put(act))

    def _add_field(self, question: Question, label: str = "", text: str | None = None) -> "_Field":
        if text is None:
            text = self._described.texts.get(question.key, [self._described.usual(question) or ""])[0]
        note = ""
        if question.key == SENSOR and (found := places()):
            note = f"; found here: {', '.join(found)}"
        field = _Field(self._page.gui, question, label or question.label, text, note)
        field.on_update(lambda _: self._todo.put(self._mark))
        self._fields.append(field)
        return field

    def _add_rows(self, question: Question) -> None:
        gui = self._page.gui
        with gui.add_folder(_PLURALS[question.key]) as folder:
            about = f"{BASE_AXES} Slanting: NX:NY:NZ:MM." if question.key == WALLS else question.how
            gui.add_html(_html(about[0].upper() + about[1:]))
            add = gui.add_button(f"Add {_SINGULARS[question.key].lower()}", order=_LAST)
        numbers = iter(range(1, 10**6))

        def add_row(text: str) -> None:
            name = f"{_SINGULARS[question.key]} {next(numbers)}"
            with folder:
                field = self._add_field(question, name, text)
                field.remove = gui.add_button(f"Remove {name.lower()}", color="gray")
                self._on_click(field.remove, lambda: self._remove(field))
            self._mark()

        self._on_click(add, lambda: add_row(f"{next(iter(SIDES))} " if question.key == WALLS else ""))
        for text in self._described.texts.get(question.key, [""] if question.usual is None else []):
            add_row(text)

    def _remove(self, field: "_Field") -> None:
        self._fields.remove(field)
        field.take_away()
        self._mark()

    # What an answer does. ------------------------------------------------------------------------------------------

    _changed = True

    def _mark(self) -> None:
        self._changed = True

    def _refresh(self) -> None:
        """Judge all answers, show what is wrong with them, draw the cell and keep the draft."""
        self._changed = False
        self._read()
        with self._page.at_once():
            wrong = [field for field in self._fields if not self._judge(field)]
            problem = self._problem(wrong)
            words = (
                _html(f"✘ {problem}", _RED) if problem else _html(f"✔ Complete: {self._name} can be written.", _GREEN)
            )
            near = self._draw(wrong)
            self._words.content = words + (_html(near, _ORANGE) if near else "")
            self._write.disabled = bool(problem)
        if self._described.texts != self._saved:
            right = {field.question.key for field in self._fields} - {field.question.key for field in wrong}
            self._described.answered = {
                key
                for key in right & self._described.texts.keys()
                if key not in (ROBOT, SENSOR) or key in self._described.reports
            }
            self._described.save(self._draft)
            self._saved = dict(self._described.texts)

    def _read(self) -> None:
        """Take the answers out of the fields; another address has reported nothing yet."""
        described = self._described
        for question in described.questions:
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
        if question.key == MODEL and not words:
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
        for field in self._fields:
            key = field.question.key
            if key not in (ROBOT, SENSOR) or not field.text:
                continue
            field.say("Reading …", _PLAIN)
            try:
                words = f"✔ {self._described.look(key, field.text)}"
                self._found[key] = words, _GREEN
                field.type(self._described.texts[key][0])
            except (DeviceError, UsageError) as error:
                words = f"✘ {error}"
                self._found[key] = words, _ORANGE
            messages.print(hanging(f"  {words[:2]}", words[2:]), soft_wrap=True)
        self._mark()

    def _finish(self) -> None:
        self._refresh()
        self._is_written = not self._write.disabled

    # The scene. ----------------------------------------------------------------------------------------------------

    def _draw(self, wrong: Collection["_Field"]) -> str:
        """Draw what can be read of the cell, red what is refused or in the way; return what is in the way, in words."""
        described = self._described
        values: dict[str, list[tuple[_Field, Any]]] = {TOOL: [], WALLS: [], BOXES: []}
        for field in self._fields:
            if field.question.key in values and field.text:
                with suppress(ConfigError):
                    values[field.question.key].append((field, described.value(field.question, field.text)))
        tool, walls, boxes = ([value for _, value in rows] for rows in values.values())
        has_shape = described.model is not None and not described.without_shape
        workcell = WorkcellConfig(planes_mm=tuple(walls), boxes_mm=tuple(boxes))
        cell = CellConfig(RobotConfig(""), SensorConfig(""), ToolConfig(cylinders_mm=tuple(tool) or _NO_TOOL), workcell)
        certifier = certifier_as_described(cell, described.model if has_shape else "ur5e")
        things = {f"plane {i}": field for i, (field, _) in enumerate(values[WALLS], start=2)}
        things |= {f"box {i}": field for i, (field, _) in enumerate(values[BOXES], start=1)}
        near = in_the_way(certifier) if has_shape else {}
        scene = self._page.scene
        for one in self._drawn:
            one.remove()
        self._drawn = [scene.add_frame(name, show_axes=False) for name in ("/surroundings", "/arm")]
        bad = {name for name, field in things.items() if field in wrong} | near.keys()
        draw_surroundings(scene, certifier.scene, size_of(certifier), bad)
        if not has_shape:
            return ""
        arm = DrawnArm(scene, certifier.arm)
        arm.show(USUAL_POSTURE_RAD)
        arm.accuse({body for bodies in near.values() for body in bodies})
        size_m = size_of(certifier)
        self._page.look(np.array([0.0, 0.0, 0.2 * size_m]), 0.6 * size_m * np.array([1.0, 1.0, 0.8]))
        words = [
            f"{', '.join(bodies)}: nearer than allowed to {things[name].label if name in things else name}"
            for name, bodies in near.items()
        ]
        return f"In the usual posture, the arm is in the way: {'; '.join(words)}." if words else ""


_SINGULARS: Final = {TOOL: "Cylinder", WALLS: "Wall", BOXES: "Box"}
_PLURALS: Final = {TOOL: "Cylinders of sensor and tool", WALLS: "Walls and tables", BOXES: "Boxes"}


def in_the_way(certifier: Certifier) -> dict[str, list[str]]:
    """Return the bodies of an arm in its usual posture that are nearer to planes, boxes or each other than allowed.

    By what they are near to: "plane 1" is the mounting surface, and "the arm itself" comes last.
    """
    arm, margin_m = certifier.arm, certifier.margins.scene_m
    n = len(arm.names)
    bodies = arm.bodies(USUAL_POSTURE_RAD.reshape(1, 6)).at(np.zeros(n, dtype=np.intp), np.arange(n))
    distances_m = {
        f"plane {i}": height_above(bodies, np.array(plane.normal), plane.offset_m)
        for i, plane in enumerate(certifier.scene.planes, start=1)
    } | {
        f"box {i}": separation_from_box(bodies, np.array(box.low_m), np.array(box.high_m), np.full(n, margin_m))
        for i, box in enumerate(certifier.scene.boxes, start=1)
    }
    found = {
        name: [arm.names[i] for i in np.flatnonzero((distance_m < margin_m) & (arm.moved_by > 0))]
        for name, distance_m in distances_m.items()
    }
    alone = certifier.certify(USUAL_POSTURE_RAD, USUAL_POSTURE_RAD)
    if alone.self_clearance_m[0] < certifier.margins.self_m:
        found["the arm itself"] = [body for body in alone.limited_by[0].split(" - ") if body in arm.names]
    return {name: near for name, near in found.items() if near}


class _Field:
    """One answer in the form: what is chosen, what is typed, and words about it below."""

    def __init__(self, gui: "GuiApi", question: Question, label: str, text: str, note: str) -> None:
        self.question, self.label = question, label
        self.remove: Any = None
        self._how = f"{question.how}{note}"
        self._choice: Any = None
        self._typed: Any = None
        key = question.key
        if key == WALLS:
            side, _, typed = text.partition(" ")
            choice, text = (side, typed) if side in SIDES else (_SLANTING, text)
            self._choice = gui.add_dropdown(f"{label} at", (*SIDES, _SLANTING), initial_value=choice)
            label = "Distance"
        elif question.choices:
            known = text in question.choices
            other = _OPEN if key == MODEL else _DEGREES
            self._choice = gui.add_dropdown(label, (*question.choices, other), initial_value=text if known else other)
            label, text = "Degrees", "" if known else text
        if key != MODEL:
            self._typed = gui.add_text(label, text)
        self._words = gui.add_html(_html(self._how))
        self._hide_unused()

    def _hide_unused(self) -> None:
        if self.question.choices and self._typed is not None:
            self._typed.visible = self._choice.value == _DEGREES

    @property
    def text(self) -> str:
        """The answer, as the terminal takes it."""
        typed = "" if self._typed is None else self._typed.value.strip()
        if self._choice is None or self._choice.value in (_OPEN, _SLANTING, _DEGREES):
            return typed
        return f"{self._choice.value} {typed}".strip() if self.question.key == WALLS else self._choice.value

    def on_update(self, act: Callable[[Any], object]) -> None:
        """Call back after each change."""
        for one in (self._choice, self._typed):
            if one is not None:
                one.on_update(act)

    def say(self, words: str, colour: str) -> None:
        """Show words below; how to answer if there are none."""
        self._hide_unused()
        self._words.content = _html(words or self._how, colour)

    def type(self, text: str) -> None:
        """Fill in an address."""
        self._typed.value = text

    def show_reported(self, model: str | None) -> None:
        """Choose the model that the robot has reported, which nothing else can replace."""
        self._choice.disabled = model is not None
        if model is not None:
            if model not in self._choice.options:
                self._choice.options = (model, *self._choice.options)
            self._choice.value = model

    def take_away(self) -> None:
        """Remove it from the form."""
        for one in (self._choice, self._typed, self._words, self.remove):
            if one is not None:
                one.remove()


def _html(words: str, colour: str = _PLAIN) -> str:
    return f'<p style="margin:0 0.5em 0.5em;font-size:0.8em;color:{colour}">{escape(words)}</p>'
