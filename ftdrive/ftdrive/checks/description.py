"""Description of a cell by answers: the questions, the meaning and checks of the answers, and their draft file.

The terminal, options, draft and page of `ftdrive init` all use `QUESTIONS`; an answer is a string in all of them.
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
    "Above is +z, away from the mounting surface, even if the base hangs. Jog towards a wall to see its side."
)
_SILENT = "not read when this file was written"
_LOOK_S = 0.5


@dataclass(frozen=True, slots=True)
class CellQuestion:
    """A question about a cell."""

    key: str
    """Key of the configuration, such as "robot.host"."""
    label: str
    how: str
    """Form that the answer must have, such as its unit, as shown with the question."""
    read: Callable[[str, str], Any]
    """Returns the value of an answer, or of one of its rows, from the option, which messages name, and the text."""
    usual: str | None = None
    """Answer that Enter alone gives; "" leaves the key unset, and after None the question is asked again."""
    in_force: bool = False
    """Whether Enter alone gives the value that the environment or the user's file already sets."""
    repeats: bool = False
    choices: Sequence[str] = ()

    @property
    def option(self) -> str:
        """Option of `ftdrive init` for this question."""
        return RULES[self.key].option

    @property
    def name(self) -> str:
        """Name of the Python parameter that receives this option."""
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
    CellQuestion("sensor.height_mm", "Sensor height", "of its origin above the flange face, mm", _in(MM)),
    CellQuestion("sensor.mass_kg", "Sensor mass", "including the adapter, kg, from a scale or data sheet", _in(KG), ""),
    CellQuestion("tool.name", "Name of the tool", "results are stored under this name", _stripped, in_force=True),
    CellQuestion(
        TOOL,
        "Cylinder of sensor and tool",
        "from, to and diameter, mm from the flange face, such as 0:60:90; also x and y of its axis if it is not on the "
        "flange axis, such as 60:110:50:45:0 for a camera",
        rows_reader(3, 5),
        repeats=True,
    ),
    CellQuestion("tool.mass_kg", "Tool mass", "approximate mass below the sensor, kg", _in(KG), ""),
    CellQuestion(
        "workcell.mounting",
        "Mounting",
        "floor, wall, ceiling, or the tilt of the base towards -x in degrees",
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
    """Answers to `QUESTIONS`, as strings.

    `in_force` has the values of environment, user's file and defaults by key. With `simulate` the cell is emulated, and
    there are no questions about its devices.
    """

    def __init__(self, clock: Clock, in_force: Mapping[str, Any], *, simulate: bool = False) -> None:
        self.clock, self._in_force, self._simulate = clock, in_force, simulate
        self.texts: dict[str, list[str]] = {}
        """Answers by configuration key: a list with one string, or with one per row."""
        self.answered: set[str] = set()
        """Configuration keys whose question is answered."""
        self.reports: dict[str, str] = {}
        """What the devices report about themselves, by the key of their address."""
        self.places: list[str] = []
        """Addresses at which sensors were found; the number of one of them is a valid answer."""

    @property
    def questions(self) -> list[CellQuestion]:
        """Questions for this cell, without those that the robot itself answers."""
        known = {ROBOT, MODEL, SENSOR} if self._simulate else {MODEL} if ROBOT in self.reports else set()
        return [question for question in QUESTIONS if question.key not in known]

    @property
    def model(self) -> str | None:
        """Model of the arm; None if it is unknown."""
        return next(filter(None, self.texts.get(MODEL, [])), None)

    @property
    def without_shape(self) -> str:
        """Warning if the arm has no measured shape; empty if it has one, or if its model is unknown."""
        if self.model is None or model_named(self.model, controller_major=0) in SHAPES:
            return ""
        return f"the shape of the {self.model} is not measured, so no motion can be planned: use calibrate --manual"

    def usual(self, question: CellQuestion) -> str | None:
        """Return the default answer to a question; None if it has none."""
        if question.in_force and (value := self._in_force[question.key]) is not None:
            return f"{value:g}" if isinstance(value, float) else str(value)
        return question.usual

    def value(self, question: CellQuestion, text: str) -> Any:
        """Return the value of an answer or of one row, None for "unknown". Raises `ConfigError` if that is invalid."""
        if question.usual == "" and text.strip().lower() in ("", "none", "unknown"):
            return None
        if question.key == MODEL and ROBOT in self.reports:
            return text
        value = question.read(question.option, text)
        checked = check_value(question.option, question.key, [value] if question.repeats else value)
        return checked[0] if question.repeats else checked

    def judge(self, question: CellQuestion, text: str) -> None:
        """Raise `ConfigError` if an answer, or one row, is invalid, or if a wall or box contains the arm."""
        value = self.value(question, text)
        if question.key in (WALLS, BOXES) and value is not None:
            self._require_possible(question.key, (value,))

    def judge_rows(self, question: CellQuestion) -> None:
        """Raise `ConfigError` if the rows together are invalid, such as a tool that ends inside the sensor."""
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
        """Read the device at an address, or on a port or bus; store and return its report.

        `key` is `ROBOT` or `SENSOR`. Raises `DeviceError` if the device does not answer, and `UsageError` for an
        invalid address.
        """
        try:
            return self._look(key, text)
        except (OSError, UnicodeError) as error:
            raise ConfigError(f"'{text[:60]}' is not a valid address ({error}): correct it") from error

    def _look(self, key: str, text: str) -> str:
        if key == ROBOT:
            # Ignore the model that an earlier arm has reported.
            given = None if ROBOT in self.reports else self.model
            model, words = _identify_robot(text, given, self.clock)
            self.texts[MODEL] = [model]
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
        """Store an address that does not answer; discard the model that an earlier arm has reported."""
        self.texts[key] = [text]
        if self.reports.pop(key, None) is not None and key == ROBOT:
            self.answered.discard(MODEL)

    @property
    def missing(self) -> list[CellQuestion]:
        """Questions that have neither an answer nor a default answer."""
        return [item for item in self.questions if not self.texts.get(item.key) and self.usual(item) is None]

    def cell(self) -> CellConfig:
        """Return the described cell; raises `ConfigError` if an answer is missing or cannot be used."""
        for question in self.missing:
            label, how = question.label, question.how
            raise ConfigError(f"{question.option} is missing and has no default: {label}, {how}")
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
        """Return what the devices report about themselves, or that they are silent, by role: "robot" and "sensor"."""
        return {name: self.reports.get(key, _SILENT) for name, key in (("robot", ROBOT), ("sensor", SENSOR))}

    def file(self) -> str:
        """Return the text of the configuration file; raises `ConfigError` as `cell` does."""
        return cell_file(self.cell(), [f"{name.capitalize()}: {words}." for name, words in self.found().items()])

    def save(self, draft: Path) -> None:
        """Write the answers to a draft; replace an earlier draft."""
        saved = datetime.now().astimezone().isoformat(timespec="minutes")
        document = {"format": FORMAT, "saved": saved, "simulate": self._simulate}
        answers = {"texts": self.texts, "answered": sorted(self.answered), "reports": self.reports}
        partial = draft.with_name(f"{draft.name}.partial")
        partial.write_text(json.dumps({**document, **answers}, indent=1) + "\n", encoding="utf-8")
        partial.replace(draft)

    def load(self, draft: Path) -> None:
        """Read the answers of a draft; raises `ConfigError` if the file is not a draft."""
        document = _draft(draft)
        try:
            texts = dict(document["texts"])
            if document["simulate"] != self._simulate:
                # Addresses of an emulated cell are not valid for a real one, and vice versa.
                for key in (ROBOT, MODEL, SENSOR):
                    texts.pop(key, None)
            self.texts = {key: [*map(str, texts[key])] for key in BY_KEY if key in texts}
            self.answered = set(document["answered"]) & self.texts.keys()
            self.reports = {key: str(words) for key, words in document["reports"].items() if key in texts}
        except (KeyError, TypeError, ValueError, AttributeError) as error:
            raise ConfigError(f"{draft} is incomplete: delete it") from error


def saved_at(draft: Path) -> str:
    """Return when a draft was saved, such as "10:42", with the date unless today; `ConfigError` if unreadable."""
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
    """Return the model of the arm at an address, and its report; raises `DeviceError` if it does not answer."""
    with closing(build_arm(CellConfig(RobotConfig(host, model), SensorConfig(""), clock=clock))) as arm:
        arm.open()
        info, remote = arm.identify(), arm.in_remote_control()
    switch = "" if remote is None else f", remote control {'ON' if remote else 'OFF'}"
    return info.model, who(info) + switch


def _identify_sensor(url: str, clock: Clock) -> str:
    """Return report and rate of the sensor at an address; `DeviceError` if silent, `UsageError` if no address."""
    with build_sensor(CellConfig(RobotConfig(""), SensorConfig(url), clock=clock)) as sensor:
        info = sensor.identify()
        rate_Hz = len(sensor.collect(_LOOK_S).t_host_ns) / _LOOK_S
    return f"{who(info)}, {rate_Hz:.0f} Hz"
