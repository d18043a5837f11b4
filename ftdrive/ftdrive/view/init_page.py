"""The page of `ftdrive init`: its questions as a form, next to a view of the described cell."""

from collections.abc import Callable, Collection
from dataclasses import dataclass
from functools import partial
from itertools import count
from pathlib import Path
from queue import SimpleQueue
from threading import Thread
from typing import Any, Final

import numpy as np

from ftcalib.errors import UsageError
from ftdrive.cell.config import CellConfig, RobotConfig, SensorConfig, ToolConfig, WorkcellConfig
from ftdrive.cell.units import SIDES
from ftdrive.checks.description import BASE_AXES, BOXES, BY_KEY, MODEL, ROBOT, SENSOR, TOOL, WALLS, Description
from ftdrive.checks.discovery import places
from ftdrive.errors import ConfigError
from ftdrive.planning.planner import USUAL_POSTURE_RAD, certifier_for
from ftdrive.view.page import Page
from ftdrive.view.parts import ASK, BAD, GOOD, QUIET, WARN, Part, button, choice, controls, lines, text_field
from ftdrive.view.scene import arm_parts, camera, label, legend, size_of, surroundings
from ftdrivers.errors import DeviceError
from ftdrivers.ur.kinematics import model_named

_ROWS: Final = {TOOL: ("Cylinder", "Cylinders"), WALLS: ("Wall", "Walls and tables"), BOXES: ("Box", "Boxes")}
# Parts of the form in order: sections of the configuration, and questions with several answers, such as walls.
_PARTS: Final = ("robot", "sensor", "tool", TOOL, "workcell", WALLS, BOXES)
# Largest number of answers to one question, and of viewers' actions that are queued while a device is read.
_MOST_ROWS, _MOST_USES = 30, 100
# Entry of each drop-down list after which a value must be typed.
_TYPED: Final = {WALLS: "slanting", MODEL: "choose", "workcell.mounting": "degrees"}
# Tool drawn on the arm until a tool is described.
_NO_TOOL: Final = ((0.0, 5.0, 60.0),)
_LEGEND: Final = legend(
    ("arm", "body", "arm in its usual posture"),
    ("tool", "body", "sensor and tool"),
    ("obstacle", "body", "mounting surface, walls, boxes"),
    ("bad", "body", "too close, or to be corrected"),
)


@dataclass(eq=False, slots=True)
class _Field:
    key: str
    name: str
    label: str
    typed: str
    choice: str = ""
    options: Collection[str] = ()
    value: Any = None
    said: tuple[str, str] = ("", QUIET)

    @property
    def text(self) -> str:
        """The answer in the field's controls, as it would be typed in the terminal."""
        typed = self.typed.strip()
        chosen = typed and f"{self.choice} {typed}" if self.key == WALLS else self.choice
        return typed if self.choice in ("", _TYPED.get(self.key)) else chosen

    def controls(self) -> list[Part]:
        """Return the controls of the field: a drop-down list or text field or both, and a button to remove it."""
        found, is_wall = [], self.key == WALLS
        if self.options:
            found += [choice(f"{self.name} choice", self.label + " at" * is_wall, self.choice, self.options)]
        if is_wall or self.choice in ("", "degrees"):
            words = "Distance" if is_wall else "Degrees" if self.options else self.label
            found += [text_field(self.name, words, self.typed)]
        found[-1] |= dict(zip(("words", "tone"), self.said, strict=True))
        return found + [button(f"{self.name} remove", f"Remove {self.label.lower()}")] * BY_KEY[self.key].repeats


class InitPage:
    """Fills a page with the form of `ftdrive init`, and a description with the answers, stored in `draft` at changes.

    `say` receives what a device reports, and a mark for the start of the line.
    """

    def __init__(
        self, page: Page, described: Description, draft: Path, name: str, say: Callable[[str, str], object]
    ) -> None:
        self._page, self._described, self._draft, self._name, self._say = page, described, draft, name, say
        # viewers' actions from the server thread wait here, because only the thread of `run` changes the form
        self._todo: SimpleQueue[Callable[[], object]] = SimpleQueue()
        self._asked: dict[str, None] = {}
        self._fields: dict[str, _Field] = {}
        self._numbers = {key: count(1) for key in _ROWS}
        self._found = {key: (f"✔ {words}", GOOD) for key, words in described.reports.items()}
        self._drawn: dict[str, Part | None] = {}
        for key, question in BY_KEY.items():
            usual = described.usual(question)
            for text in described.texts.get(key, [] if question.repeats and usual == "" else [usual or ""]):
                self._add(key, text)
            self._on(f"{key} add", partial(self._add, key))
        for use in ("look", "write"):
            self._on(use, partial(self._asked.setdefault, use))
        self._read()
        self._saved = dict(described.texts)

    # ignore overflow, because numbers that overflow are judged invalid
    @np.errstate(all="ignore")
    def run(self) -> None:
        """Show the answers and whether they are valid, until a viewer presses Write and all are."""
        while not self._refresh() or "write" not in self._asked:
            if "look" in self._asked:
                self._look()
                self._refresh()
            self._asked.clear()
            # take all actions that waited, so that their answers are judged at once
            for _ in range(max(1, self._todo.qsize())):
                self._todo.get()()

    def conclude(self, *words: str) -> None:
        """Show at the top of the page and in place of the Write button that the file has been written."""
        written = lines(*words, head="Written", tone=GOOD)
        self._page.put({"result": written, "form/words": written, "form/write": None})

    def _on(self, name: str, act: Callable[[Any], object]) -> None:
        def put(_: str, value: object) -> None:
            if self._todo.qsize() >= _MOST_USES:
                raise ValueError("the form is busy: try again")
            self._todo.put(partial(act, value))

        self._page.on(name, put)

    def _add(self, key: str, text: str | None = None) -> None:
        number = f" {next(self._numbers[key])}" if key in _ROWS else ""
        name, label, text = f"{key}{number}", _ROWS.get(key, [BY_KEY[key].label])[0] + number, text or ""
        options, choice, typed = (*BY_KEY[key].choices,), model_named(text, controller_major=0) or text, ""
        if key == WALLS:
            options, (choice, _, typed) = tuple(SIDES), (text or "+x ").partition(" ")
        if choice not in options:
            choice, typed = _TYPED.get(key, ""), text * (key != MODEL)
        options += (_TYPED[key],) if options else ()
        self._fields[name] = field = _Field(key, name, label, typed, choice, options)
        self._on(name, partial(setattr, field, "typed"))
        self._on(f"{name} choice", partial(setattr, field, "choice"))
        self._on(f"{name} remove", partial(self._fields.pop, name))

    def _refresh(self) -> bool:
        described, near = self._described, ""
        self._read()
        wrong = [field for field in self._fields.values() if not self._judge(field)]
        words = lines(f"✔ Complete: {self._name} can be written.", tone=GOOD)
        try:
            near = self._draw(wrong)
            self._require_complete(wrong)
        except ConfigError as error:
            words = lines(f"✘ {error}", tone=BAD)
        write = button("write", f"Write {self._name}", tone="good", disabled=words["tone"] == BAD)
        parts = {f"form/{part}": self._part(part) for part in _PARTS}
        parts |= {"form/words": words, "form/write": controls(write), "state": lines(near, tone=WARN) if near else None}
        self._page.put(parts)
        if described.texts != self._saved:
            open_ = {field.key for field in wrong} | ({ROBOT, SENSOR} - described.reports.keys())
            described.answered = described.texts.keys() - open_
            described.save(self._draft)
            self._saved = dict(described.texts)
        return bool(words["tone"] == GOOD)

    def _part(self, part: str) -> Part | None:
        asked = {one.key: one.key if one.repeats else one.key.split(".")[0] for one in self._described.questions}
        fields = [field for field in self._fields.values() if asked.get(field.key) == part]
        shown, head, note = [control for field in fields for control in field.controls()], part.capitalize(), ""
        if part in _ROWS:
            one, head = _ROWS[part]
            axes = f" {BASE_AXES} Slanting: NX:NY:NZ:MM." * (part == WALLS)
            note = f"{BY_KEY[part].label}: {BY_KEY[part].how}.{axes}"
            shown += [button(f"{part} add", f"Add {one.lower()}", disabled=len(fields) >= _MOST_ROWS)]
        elif asked.get(SENSOR) == part:
            shown += [button("look", "Look for robot and sensor")]
            note = f"Found here: {', '.join(found)}." if (found := places()) else ""
        return controls(*shown, head=head, note=note) if shown else None

    def _read(self) -> None:
        described = self._described
        for key, question in BY_KEY.items():
            texts = [field.text for field in self._fields.values() if field.key == key and field.text]
            if question in described.questions and described.texts.get(key, []) != texts:
                if key in (ROBOT, SENSOR):
                    self._found.pop(key, None)
                    described.keep(key, texts[0] if texts else "")
                described.texts.pop(key, None)
                described.texts |= {key: texts} if texts else {}

    def _judge(self, field: _Field) -> bool:
        described, question = self._described, BY_KEY[field.key]
        said = self._found.get(field.key, ("" if question.repeats else question.how, QUIET))
        field.value = None
        try:
            if field.text:
                field.value = described.value(question, field.text)
                described.judge(question, field.text)
        except ConfigError as error:
            said = f"✘ {error}", BAD
        field.said = said
        return said[1] != BAD

    def _require_complete(self, wrong: Collection[_Field]) -> None:
        if wrong:
            raise ConfigError(f"Correct the red fields: {', '.join(field.label for field in wrong)}.")
        self._described.judge_rows(BY_KEY[TOOL])
        empty = [one.label for one in self._described.missing if not one.repeats]
        empty += [field.label for field in self._fields.values() if field.key in _ROWS and not field.text]
        if empty:
            raise ConfigError(f"Fill in the empty fields: {', '.join(empty)}.")
        self._described.cell()

    def _look(self) -> None:
        for field in [one for one in self._fields.values() if one.name in (ROBOT, SENSOR) and one.text]:
            self._page.put({"form/words": lines(f"Reading {field.text} …", tone=ASK)})
            # read in a thread, because Ctrl-C interrupts this wait, but not a host name lookup, which may take 10 s
            ended: SimpleQueue[Exception | None] = SimpleQueue()
            Thread(target=self._look_at, args=(field, ended.put), daemon=True).start()
            if (error := ended.get()) is not None:
                raise error
            words = self._found[field.name][0]
            self._say(words[2:], f"  {words[:2]}")

    def _look_at(self, field: _Field, end: Callable[[Exception | None], object]) -> None:
        """Read the device at the address in a field, then call `end` with an unexpected error, or with None."""
        failure = None
        try:
            self._found[field.name] = f"✔ {self._described.look(field.name, field.text)}", GOOD
            field.typed = self._described.texts[field.name][0]
        except (DeviceError, UsageError) as error:
            self._found[field.name] = f"✘ {error}", WARN
            self._described.keep(field.name, field.text)
        except Exception as error:
            failure = error
        end(failure)

    def _draw(self, wrong: Collection[_Field]) -> str:
        """Draw the cell, invalid and too close parts in red; return a text about what is too close to the arm."""
        rows = {key: [one for one in self._fields.values() if one.key == key and one.value] for key in _ROWS}
        tool, planes, boxes = (tuple(field.value for field in rows[key]) for key in _ROWS)
        workcell = WorkcellConfig(planes_mm=planes, boxes_mm=boxes)
        cell = CellConfig(RobotConfig(""), SensorConfig(""), ToolConfig(cylinders_mm=tool or _NO_TOOL), workcell)
        model = None if self._described.without_shape else self._described.model
        certifier = certifier_for(cell, model or "ur5e", must_be_possible=False)
        found, size_m = certifier.too_near(USUAL_POSTURE_RAD) if model else [], size_of(certifier)
        names = {f"plane {i}": field for i, field in enumerate(rows[WALLS], start=2)}
        names |= {f"box {i}": field for i, field in enumerate(rows[BOXES], start=1)}
        bad = {body for pair in found for body in pair}
        parts = surroundings(certifier.scene, size_m, bad | {name for name, field in names.items() if field in wrong})
        for name, field in names.items():
            parts[f"scene/name of {name}"] = label(field.label, (parts[f"scene/{name}"] or {})["at"])
        parts["scene/camera"] = camera((0, 0, 0.2 * size_m), size_m * np.array([0.9, 0.9, 0.9]))
        parts |= {"scene/legend": _LEGEND} | arm_parts(certifier.arm, USUAL_POSTURE_RAD if model else None, bad=bad)
        self._page.put(dict.fromkeys(self._drawn) | parts)
        self._drawn = parts
        labels = {"plane 1": "the mounting surface"} | {name: field.label for name, field in names.items()}
        near = {other: ", ".join(dict.fromkeys(one for one, thing in found if thing == other)) for _, other in found}
        pairs = "; ".join(f"{ones} to {labels.get(other, other)}" for other, ones in near.items())
        words = f"In its usual posture the arm is closer than allowed: {pairs}."
        return words if pairs else self._described.without_shape
