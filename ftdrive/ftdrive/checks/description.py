"""The description of a cell: the questions, what an answer means, how it is judged, and the draft of the answers.

Terminal, options, draft and page of `ftdrive init` are all made of `QUESTIONS`, and an answer is a text in all of them.
"""

import json
from collections.abc import Callable, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Any, Final

from ftcalib.files import check_format, read_object
from ftdrive.cell.config import RULES, SECTIONS, CellConfig, RobotConfig, SensorConfig, cell_file, check_value
from ftdrive.cell.devices import build_arm, build_sensor
from ftdrive.cell.units import DEG_S, KG, MM, parse_quantity, rows_reader, wall
from ftdrive.checks.check import who
from ftdrive.checks.discovery import is_place, sensor_at
from ftdrive.errors import ConfigError
from ftdrive.planning.geometry.arm_model import SHAPES
from ftdrive.planning.planner import require_possible
from ftdrivers.clock import Clock
from ftdrivers.ur.kinematics import MODELS, model_named

FORMAT: Final = "ftdrive.draft/1"
ROBOT, MODEL, SENSOR, TOOL, WALLS, BOXES = (
    "robot.host",
    "robot.model",
    "sensor.url",
    "tool.cylinders_mm",
    "workcell.planes_mm",
    "workcell.boxes_mm",
)
BASE_AXES: Final = (
    "Sides are along the base axes of the pendant (Move, feature Base): on a UR the cable leaves the base towards +y. "
    "Above is +z, away from the mounting surface, also where the base hangs. Jog towards a wall to see its side."
)
_SILENT = "not read when this was written"
_LOOK_S = 0.5


@dataclass(frozen=True, slots=True)
class CellQuestion:
    """One question about a cell."""

    key: str
    """Of the configuration, such as "robot.host"."""
    label: str
    how: str
    """How it is answered."""
    read: Callable[[str, str], Any]
    """Returns the value of a text, one row of it where it repeats; takes the option too, for messages."""
    usual: str | None = None
    """The answer of Enter; "" leaves the key unset, None asks again."""
    in_force: bool = False
    """Whether a value of environment or user's file is the usual answer."""
    repeats: bool = False
    choices: Sequence[str] = ()

    @property
    def option(self) -> str:
        """The option of `ftdrive init`."""
        return RULES[self.key].option

    @property
    def name(self) -> str:
        """The parameter of that option."""
        return self.option[2:].replace("-", "_")


def _stripped(_: str, text: str) -> str:
    return text.strip()


def _in(units: Mapping[str, str]) -> Callable[[str, str], float]:
    return lambda option, text: parse_quantity(option, text, units)


QUESTIONS: Final = (
    CellQuestion(ROBOT, "Robot address", "name or IPv4 address of the controller", _stripped, in_force=True),
    CellQuestion(MODEL, "Model of the arm", "such as ur5e", _stripped, in_force=True, choices=tuple(MODELS)),
    CellQuestion(
        SENSOR, "Sensor address", "a URL such as ati-can://can0?bitrate=250000, or a port", _stripped, in_force=True
    ),
    CellQuestion("sensor.height_mm", "Sensor height", "above the flange face, mm, measure it", _in(MM)),
    CellQuestion("sensor.mass_kg", "Sensor mass", "with its adapter, kg, from scale or data sheet", _in(KG), ""),
    CellQuestion("tool.name", "Name of the tool", "results are found by it", _stripped, in_force=True),
    CellQuestion(
        TOOL,
        "Cylinder of sensor and tool",
        "from, to and diameter, mm from the flange face, such as 0:60:90; then x and y of its axis, if it is beside "
        "the flange's, such as 60:110:50:45:0 for a camera",
        rows_reader(3, 5),
        repeats=True,
    ),
    CellQuestion("tool.mass_kg", "Tool mass", "of what hangs on the sensor, kg, about", _in(KG), ""),
    CellQuestion(
        "workcell.mounting",
        "Mounting",
        "floor, wall, ceiling, or degrees that the base leans to its -x",
        _stripped,
        "floor",
        in_force=True,
        choices=("floor", "wall", "ceiling"),
    ),
    CellQuestion(WALLS, "Wall or table", "side and distance from the base, such as +x 800 mm", wall, "", repeats=True),
    CellQuestion(BOXES, "Box", "two opposite corners X:Y:Z:X:Y:Z, mm, base axes", rows_reader(6), "", repeats=True),
    CellQuestion("robot.speed_deg_s", "Speed", "of the fastest joint, deg/s", _in(DEG_S), in_force=True),
)
BY_KEY: Final = {question.key: question for question in QUESTIONS}


class Description:
    """Answers, as texts, to `QUESTIONS`.

    `in_force` has values by key of environment and user's file, and the defaults. With `simulate` the cell is emulated,
    and no question is about its devices.
    """

    def __init__(self, clock: Clock, in_force: Mapping[str, Any], *, simulate: bool = False) -> None:
        self.clock, self._in_force, self._simulate = clock, in_force, simulate
        self.texts: dict[str, list[str]] = {}
        """Answers by key: one text, or one for each row."""
        self.answered: set[str] = set()
        """Keys that need no question."""
        self.reports: dict[str, str] = {}
        """What devices report about themselves, by the key of their address."""
        self.places: list[str] = []
        """Where a sensor was found; its number is an answer."""

    @property
    def questions(self) -> list[CellQuestion]:
        """Questions that this cell needs: none for what the robot reports."""
        known = {ROBOT, MODEL, SENSOR} if self._simulate else {MODEL} if ROBOT in self.reports else set()
        return [question for question in QUESTIONS if question.key not in known]

    @property
    def model(self) -> str | None:
        """Model of the arm, where it is known."""
        return next(filter(None, self.texts.get(MODEL, [])), None)

    @property
    def without_shape(self) -> str:
        """What follows if the arm has no measured shape; empty if it has one, or is not known."""
        if self.model is None or model_named(self.model, controller_major=0) in SHAPES:
            return ""
        return f"the {self.model} has no measured shape, so no motion can be planned: use calibrate --manual"

    def usual(self, question: CellQuestion) -> str | None:
        """Return the answer to a question that is left open; None if it must be answered."""
        if question.in_force and (value := self._in_force[question.key]) is not None:
            return f"{value:g}" if isinstance(value, float) else str(value)
        return question.usual

    def value(self, question: CellQuestion, text: str) -> Any:
        """Return what one answer means, or one row; None for "unknown". Raises `ConfigError` for a text of no use."""
        if question.usual == "" and text.strip().lower() in ("", "none", "unknown"):
            return None
        if question.key == MODEL and ROBOT in self.reports:
            return text
        value = question.read(question.option, text)
        checked = check_value(question.option, question.key, [value] if question.repeats else value)
        return checked[0] if question.repeats else checked

    def judge(self, question: CellQuestion, text: str) -> None:
        """Raise `ConfigError` unless an answer, or one row, can be used; a wall or box must leave the arm its room."""
        value = self.value(question, text)
        if question.key in (WALLS, BOXES) and value is not None:
            self._require_possible(question.key, (value,))

    def judge_rows(self, question: CellQuestion) -> None:
        """Raise `ConfigError` unless all rows together can be used; the tool must not end before its sensor."""
        self._require_possible(question.key, self._rows(question))

    def _rows(self, question: CellQuestion) -> tuple[Any, ...]:
        values = (self.value(question, text) for text in self.texts.get(question.key, []))
        return tuple(value for value in values if value is not None)

    def _require_possible(self, key: str, rows: Sequence[Sequence[float]]) -> None:
        section, name = key.split(".")
        height = BY_KEY["sensor.height_mm"]
        texts = self.texts.get(height.key) if key == TOOL else None
        sensor = SensorConfig("", height_mm=self.value(height, texts[0]) if texts else None)
        kind = SECTIONS[section]
        require_possible(CellConfig(RobotConfig(""), sensor, **{section: kind(**{name: rows})}), self.model)

    def look(self, key: str, text: str) -> str:
        """Read the device at an address or place, keep what it reports, and return that in words.

        `key` is `ROBOT` or `SENSOR`. Raises `DeviceError` if it does not answer, and `UsageError` for what can be no
        address.
        """
        try:
            return self._look(key, text)
        except (OSError, UnicodeError) as error:
            raise ConfigError(f"'{text[:60]}' cannot be an address ({error}): correct it") from error

    def _look(self, key: str, text: str) -> str:
        if key == ROBOT:
            # What another arm has reported is not the model of this one.
            given = None if ROBOT in self.reports else self.model
            found, words = _identify_robot(text, given, self.clock)
            self.texts[MODEL] = [found]
            self.answered.add(MODEL)
            shown = words
        else:
            if text.isdecimal() and 0 < int(text) <= len(self.places):
                text = self.places[int(text) - 1]
            text = sensor_at(text, self.clock) if is_place(text) else text
            words = _identify_sensor(text, self.clock)
            shown = f"{text}: {words}"
        self.texts[key], self.reports[key] = [text], words
        return shown

    def keep(self, key: str, text: str) -> None:
        """Keep an address that does not answer; the model that another arm has reported is asked for."""
        self.texts[key] = [text]
        if self.reports.pop(key, None) is not None and key == ROBOT:
            self.answered.discard(MODEL)

    @property
    def missing(self) -> list[CellQuestion]:
        """Questions that must be answered, and are not."""
        return [one for one in self.questions if not self.texts.get(one.key) and self.usual(one) is None]

    def cell(self) -> CellConfig:
        """Return the described cell; raises `ConfigError` if an answer is missing or cannot be used."""
        for one in self.missing:
            raise ConfigError(f"{one.option} is missing and has no default: {one.label}, {one.how}")
        values: dict[str, dict[str, Any]] = {"robot": {"simulate": self._simulate}, "sensor": {}}
        for question in QUESTIONS:
            section, name = question.key.split(".")
            texts = self.texts.get(question.key, [])
            if question.repeats:
                value: Any = self._rows(question)
            else:
                value = self.value(question, texts[0] if texts else self.usual(question) or "")
            values.setdefault(section, {})[name] = value
        cell = CellConfig(**{section: SECTIONS[section](**content) for section, content in values.items()})
        require_possible(cell, cell.robot.model)
        return cell

    def found(self) -> dict[str, str]:
        """Return what robot and sensor have reported, in words."""
        return {name: self.reports.get(key, _SILENT) for name, key in (("robot", ROBOT), ("sensor", SENSOR))}

    def file(self) -> str:
        """Return the configuration file; raises as `cell`."""
        return cell_file(self.cell(), [f"{name.capitalize()}: {words}." for name, words in self.found().items()])

    def save(self, draft: Path) -> None:
        """Write the answers to a draft, over the former one."""
        saved = datetime.now().astimezone().isoformat(timespec="minutes")
        document = {"format": FORMAT, "saved": saved, "simulate": self._simulate}
        answers = {"texts": self.texts, "answered": sorted(self.answered), "reports": self.reports}
        partial = draft.with_name(f"{draft.name}.partial")
        partial.write_text(json.dumps({**document, **answers}, indent=1) + "\n", encoding="utf-8")
        partial.replace(draft)

    def load(self, draft: Path) -> None:
        """Take the answers of a draft; raises `ConfigError` if it is none."""
        document = _draft(draft)
        try:
            texts = dict(document["texts"])
            if document["simulate"] != self._simulate:
                # An emulated cell has no address for a real one.
                for key in (ROBOT, MODEL, SENSOR):
                    texts.pop(key, None)
            self.texts = {key: [*map(str, texts[key])] for key in BY_KEY if key in texts}
            self.answered = set(document["answered"]) & self.texts.keys()
            self.reports = {key: str(words) for key, words in document["reports"].items() if key in texts}
        except (KeyError, TypeError, ValueError, AttributeError) as error:
            raise ConfigError(f"{draft} is incomplete: delete it") from error


def saved_at(draft: Path) -> str:
    """Return when a draft was saved, such as "10:42", with its day unless it is today; raises `ConfigError`."""
    try:
        saved = datetime.fromisoformat(_draft(draft)["saved"])
    except (KeyError, TypeError, ValueError) as error:
        raise ConfigError(f"{draft} is incomplete: delete it") from error
    return f"{saved:%H:%M}" if saved.date() == datetime.now().date() else f"{saved:%Y-%m-%d %H:%M}"


def _draft(draft: Path) -> dict[str, Any]:
    try:
        document = read_object(draft, ConfigError)
        check_format(document, FORMAT, ConfigError)
    except ConfigError as error:
        raise ConfigError(f"{draft} is not a draft of answers: {error}; delete it") from error
    return document


def _identify_robot(host: str, model: str | None, clock: Clock) -> tuple[str, str]:
    """Return the model of the arm at an address, and in words what it reports; raises `DeviceError`."""
    with closing(build_arm(CellConfig(RobotConfig(host, model), SensorConfig(""), clock=clock))) as arm:
        arm.open()
        info, remote = arm.identify(), arm.in_remote_control()
    switch = "" if remote is None else f", remote control {'ON' if remote else 'OFF'}"
    return info.model, who(info) + switch


def _identify_sensor(url: str, clock: Clock) -> str:
    """Return in words which sensor is at an address, and its rate; raises `DeviceError` or `UsageError`."""
    with build_sensor(CellConfig(RobotConfig(""), SensorConfig(url), clock=clock)) as sensor:
        info = sensor.identify()
        rate_Hz = len(sensor.collect(_LOOK_S).t_host_ns) / _LOOK_S
    return f"{who(info)}, {rate_Hz:.0f} Hz"
