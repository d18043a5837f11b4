"""`ftdrive init`: ask for a description of the cell, and write it to a file. Nothing moves."""

import sys
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack, closing, suppress
from dataclasses import replace
from pathlib import Path
from shlex import quote
from typing import Any, TypeVar

import click

from ftdrive.commands.common import JSON, MODEL, NewFile, check_simulate, rows, simulate, write_json
from ftdrive.terminal.text import echo, visible
from ftdrivers.clock import Clock

T = TypeVar("T")

# Raises `ConfigError` for rows of an answer.
Judge = Callable[[Any], None]

# Options that may be repeated.
_ROWS = ("--tool", "--plane", "--box")
_SILENT = "did not answer when this was written"
_LOOK_S = 0.5


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
    "planes",
    multiple=True,
    metavar="NX:NY:NZ:MM",
    help="A wall: the arm stays where N·p >= MM, base axes. Repeatable.",
)
@click.option(
    "--box", "boxes", multiple=True, metavar="X:Y:Z:X:Y:Z", help="A block: two corners in mm, base axes. Repeatable."
)
@click.option("--speed", metavar="DEG/S", help="Speed of the fastest joint.")
@click.option(
    "-o",
    "--output",
    type=NewFile(),
    default="ftdrive.toml",
    show_default=True,
    help="Save the configuration as this new file.",
)
@simulate("Robot and sensor are emulated, and end with this command; --sensor emulated://NAME chooses the sensor.")
@click.option("--yes", is_flag=True, help="Ask nothing: take the options and the defaults.")
@JSON
def init(
    robot: str | None,
    model: str | None,
    sensor: str | None,
    height: str | None,
    sensor_mass: str | None,
    tool_name: str | None,
    tool: tuple[str, ...],
    tool_mass: str | None,
    mounting: str | None,
    planes: tuple[str, ...],
    boxes: tuple[str, ...],
    speed: str | None,
    output: Path,
    simulate: bool,
    yes: bool,
    as_json: bool,
) -> None:
    """Describe a cell: read robot and sensor, ask for the rest, write ftdrive.toml.

    The arm is only read and nothing moves. An existing file is never overwritten. Values that must be measured have no
    default, and `measured = false` stays in the file until you change it.
    """
    from ftcalib.files import write_new
    from ftdrive.cell.config import (
        CellConfig,
        RobotConfig,
        SensorConfig,
        ToolConfig,
        WorkcellConfig,
        cell_file,
        clock_in_force,
        settings,
    )
    from ftdrive.cell.emulated import EMULATED, Station, sensor_name
    from ftdrive.planning.geometry.arm_model import SHAPES
    from ftdrive.planning.planner import require_possible
    from ftdrive.terminal.console import beside, messages
    from ftdrivers.ur.kinematics import model_named

    check_simulate(simulate, real={"--robot": robot})
    defaults = {key: setting.value for key, setting in settings().items()}
    emulated = sensor_name(sensor) if simulate else ""
    with ExitStack() as stack:
        clock = clock_in_force()
        if simulate:
            station = stack.enter_context(Station(emulated, ["--time-scale", "1"]))
            robot, sensor, clock = station.cell.robot.host, station.cell.sensor.url, station.clock
        ask = _Questions(yes, defaults)
        ask.command += "" if str(output) == "ftdrive.toml" else f" -o {quote(str(output))}"
        ask.command += " --simulate" * simulate
        host, model, robot_words = _robot(ask, robot, model, clock)
        if model is not None and model_named(model, controller_major=0) not in SHAPES:
            _say(f"the {model} has no measured shape, so no motion can be planned: use calibrate --manual", "  ! ")
        url, sensor_words = _sensor(ask, sensor, clock)
    if simulate:  # its addresses have ended with it
        host, url = "emulated", EMULATED + emulated
    height_mm = ask.number("Sensor height above the flange, mm (measure it)", "sensor.height_mm", height)
    sensor_kg = ask.number(
        "Sensor and adapter, kg (scale or datasheet; Enter: unknown)", "sensor.mass_kg", sensor_mass, ""
    )
    begun = CellConfig(RobotConfig(host, model), SensorConfig(url, height_mm=height_mm))

    def require_tool(rows: Any) -> None:
        require_possible(replace(begun, tool=ToolConfig(cylinders_mm=rows)), model)

    def require_surroundings(**rows: Any) -> None:
        require_possible(replace(begun, workcell=WorkcellConfig(**rows)), model)

    tool_config = ToolConfig(
        ask.text("Name of the tool", "tool.name", tool_name),
        ask.rows(
            "First cylinder of sensor and tool: FROM:TO:DIAMETER in mm from the flange (such as 0:60:90)",
            "tool.cylinders_mm",
            tool,
            (3, 5),
            needed=True,
            whole=require_tool,
        ),
        ask.number("Tool, kg, about (Enter: unknown)", "tool.mass_kg", tool_mass, ""),
    )
    workcell = WorkcellConfig(
        ask.text(
            "Mounting: floor, wall, ceiling or degrees",
            "workcell.mounting",
            mounting,
            ask.defaults["workcell.mounting"] or "floor",
        ),
        ask.rows(
            "First wall or table, NX:NY:NZ:MM; -1:0:0:-800 is 800 mm away towards +x",
            "workcell.planes_mm",
            planes,
            (4,),
            each=lambda row: require_surroundings(planes_mm=(row,)),
        ),
        ask.rows(
            "First block, two corners X:Y:Z:X:Y:Z in mm",
            "workcell.boxes_mm",
            boxes,
            (6,),
            each=lambda row: require_surroundings(boxes_mm=(row,)),
        ),
    )
    usual = f"{defaults['robot.speed_deg_s']:g}"
    speed_deg_s = ask.number("Speed of the fastest joint, deg/s", "robot.speed_deg_s", speed, usual)
    cell = CellConfig(
        RobotConfig(host, model, speed_deg_s, simulate=simulate),
        SensorConfig(url, height_mm=height_mm, mass_kg=sensor_kg),
        tool_config,
        workcell,
    )
    write_new(output, cell_file(cell, [f"Robot: {robot_words}.", f"Sensor: {sensor_words}."]))
    if as_json:
        devices = {"robot": robot_words, "sensor": sensor_words}
        write_json({"schema_version": 1, "file": str(output), **devices, "config": cell.to_dict()})
    words, end = ". Measure tool, planes and boxes, then set measured = true in it: nothing moves before.", ""
    if simulate:
        words, end = " for an emulated cell: commands with --simulate use it, all others refuse it.", " --simulate"
    beside(as_json).print(f"Wrote {output}{words}")
    messages.print_next(f"ftdrive doctor{end}", f"ftdrive plan{end}")


class _Questions:
    """Asks for each key that is not given as an option; with `yes` it takes the defaults, by key."""

    def __init__(self, yes: bool, defaults: Mapping[str, Any]) -> None:
        self.interactive, self.defaults = not yes, defaults
        self.command = "ftdrive init"
        self.answers: dict[str, list[str]] = {}
        """By option, so that a command can repeat them."""

    def to_continue(self) -> str:
        """Return the command that goes on after these answers."""
        given = (f"{option} {quote(one)}" for option, answers in self.answers.items() for one in answers)
        return " ".join([self.command, *given])

    def ask(self, words: str, key: str, given: str | None, usual: str | None, read: Callable[[str], T]) -> T:
        """Return the option or the answer; `usual` is the answer of Enter and --yes, None where there is none."""
        from ftdrive.cell.config import RULES
        from ftdrive.errors import ConfigError
        from ftdrive.terminal.text import in_whole_words

        option = RULES[key].option
        if given is None and not self.interactive:
            if usual is None:
                raise ConfigError(f"{option} is missing and has no default: {words[0].lower()}{words[1:]}")
            given = usual
        if given is not None:
            value = read(given)
            self._keep(option, given)
            return value
        while True:
            shown = in_whole_words(f"{words} [{usual}]: " if usual else f"{words}: ", sys.stderr)
            try:
                answer = click.prompt(visible(shown), default=usual, show_default=False, prompt_suffix="", err=True)
            except click.Abort as abort:
                # The next message begins a line.
                echo(err=True)
                if isinstance(abort.__context__, EOFError):
                    raise ConfigError(
                        f"the input ended before {option} was given; the answers so far are kept in this command:\n"
                        f"{self.to_continue()}"
                    ) from abort
                _say(f"The answers so far are kept in this command:\n{self.to_continue()}", "  ! ")
                raise
            try:
                value = read(answer)
            except ConfigError as error:
                _say(str(error), "  ✘ ")
                continue
            self._keep(option, answer)
            return value

    def _keep(self, option: str, answer: str) -> None:
        if answer:
            self.answers[option] = [*self.answers.get(option, []), answer] if option in _ROWS else [answer]

    def text(self, words: str, key: str, given: str | None, usual: str | None = None) -> str:
        """Ask for a text; Enter takes `usual`, else the value in force."""
        return str(self.ask(words, key, given, usual or self.defaults[key], lambda text: _checked(key, text)))

    def number(self, words: str, key: str, given: str | None, usual: str | None = None) -> Any:
        """Ask for a number; None where the answer may be empty and is."""

        def read(text: str) -> Any:
            if not text:
                return None
            value: Any = text
            with suppress(ValueError):
                value = float(text)
            return _checked(key, value)

        return self.ask(words, key, given, usual, read)

    def rows(
        self,
        words: str,
        key: str,
        given: Sequence[str],
        counts: Sequence[int],
        *,
        needed: bool = False,
        each: Judge = lambda _: None,
        whole: Judge = lambda _: None,
    ) -> Any:
        """Ask for rows of numbers until an empty answer; at least one when `needed`. Each and all are judged."""
        from ftdrive.cell.config import RULES

        found: list[Any] = []

        def read(text: str) -> Any:
            if not text:
                whole(tuple(found))
                return None
            row = _checked(key, rows(RULES[key].option, [text], counts))[0]
            each(row)
            return row

        if given:
            found += map(read, given)
            whole(tuple(found))
            self.answers[RULES[key].option] = list(given)
            return tuple(found)
        if not (self.interactive or needed):
            return ()
        while True:
            if found:
                row = self.ask("  next (Enter: no more)", key, None, "", read)
            else:
                row = self.ask(words if needed else f"{words} (Enter: none)", key, None, None if needed else "", read)
            if row is None:
                return tuple(found)
            found.append(row)


def _checked(key: str, value: Any) -> Any:
    from ftdrive.cell.config import RULES, check_value

    return check_value(RULES[key].option, key, value)


def _robot(ask: _Questions, given: str | None, model: str | None, clock: Clock) -> tuple[str, str | None, str]:
    """Return host, model, and what the arm reports; the operator may keep an address that does not answer."""
    from ftdrivers.errors import DeviceError

    if model is not None:
        _checked("robot.model", model)
    host = ask.text("Robot address", "robot.host", given)
    while True:
        try:
            found, words = _identify_robot(host, model, clock)
        except DeviceError as error:
            if not ask.interactive:
                raise
            _say(str(error), "  ✘ ")
            other = ask.text("Another address, or Enter to keep it", "robot.host", None, host)
            if other == host and model is not None:
                return host, model, _SILENT
            if other == host:
                model = ask.text("Model of the arm, such as ur5e", "robot.model", None)
            host = other
            continue
        _say(words, "  ✔ ")
        return host, found, words


def _identify_robot(host: str, model: str | None, clock: Clock) -> tuple[str, str]:
    """Return the model of the arm at an address, and in words what it reports; raises `DeviceError`."""
    from ftdrive.cell.config import CellConfig, RobotConfig, SensorConfig
    from ftdrive.cell.devices import build_arm
    from ftdrive.checks.check import who

    with closing(build_arm(CellConfig(RobotConfig(host, model), SensorConfig(""), clock=clock))) as arm:
        arm.open()
        info, remote = arm.identify(), arm.in_remote_control()
    switch = "" if remote is None else f", remote control {'ON' if remote else 'OFF'}"
    return info.model, who(info) + switch


def _sensor(ask: _Questions, given: str | None, clock: Clock) -> tuple[str, str]:
    """Return address and what the sensor reports; the operator may keep an address that does not answer."""
    from ftcalib.errors import UsageError
    from ftdrive.checks.discovery import is_place, places, sensor_at
    from ftdrivers.errors import DeviceError

    found = [] if given or not ask.interactive else places()
    for number, place in enumerate(found, start=1):
        _say(f"  {number}) {place}")
    words = (
        "Sensor: choose a number, or enter a URL or a port to probe"
        if found
        else "Sensor address, such as ati-can://can0?bitrate=250000"
    )
    text = ask.text(words, "sensor.url", given, ask.defaults["sensor.url"] or ("1" if found else None))
    failed: str | None = None
    while True:
        url = found[int(text) - 1] if text.isdecimal() and 0 < int(text) <= len(found) else text
        if url == failed:
            return url, _SILENT
        try:
            url = sensor_at(url, clock) if is_place(url) else url
            report = _identify_sensor(url, clock)
        except (DeviceError, UsageError) as error:
            if not ask.interactive:
                raise
            _say(str(error), "  ✘ ")
            failed = url if isinstance(error, DeviceError) and not is_place(url) else None
            keep = ", or Enter to keep it" if failed else ""
            text = ask.text(f"Another address{keep}", "sensor.url", None, failed)
            continue
        _say(f"{url}: {report}", "  ✔ ")
        ask.answers["--sensor"] = [url]  # not the number of a place in a list
        return url, report


def _identify_sensor(url: str, clock: Clock) -> str:
    """Return in words which sensor is at an address, and its rate; raises `DeviceError` or `UsageError`."""
    from ftdrive.cell.config import CellConfig, RobotConfig, SensorConfig
    from ftdrive.cell.devices import build_sensor
    from ftdrive.checks.check import who

    with build_sensor(CellConfig(RobotConfig(""), SensorConfig(url), clock=clock)) as sensor:
        info = sensor.identify()
        rate_Hz = len(sensor.collect(_LOOK_S).t_host_ns) / _LOOK_S
    return f"{who(info)}, {rate_Hz:.0f} Hz"


def _say(words: str, head: str = "") -> None:
    from ftdrive.terminal.console import hanging, messages

    messages.print(hanging(head, words), soft_wrap=True)
