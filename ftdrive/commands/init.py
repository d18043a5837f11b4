"""`ftdrive init`: from "robot and sensor are connected" to a file that describes the cell. Nothing moves."""

import sys
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

import click

from drivers.clock import REAL, Clock
from ftdrive.commands.common import JSON, MODEL, NewFile, check_simulate, rows, simulate, write_json

T = TypeVar("T")

Judge = Callable[[Any], None]
"""Raises `ConfigError` for a row, or for all rows, of an answer."""

_SILENT = "did not answer when this was written"


@click.command()
@click.option("--robot", metavar="HOST", help="Address of the controller.")
@MODEL
@click.option("--sensor", metavar="URL|PLACE", help="Its address, or what `ftdrive devices --probe` takes.")
@click.option("--height", metavar="MM", help="Of the sensor above the flange face. Measure it.")
@click.option("--sensor-mass", metavar="KG", help="Of sensor and adapter.")
@click.option("--tool-name", metavar="NAME", help="Of the tool.")
@click.option(
    "--tool",
    multiple=True,
    metavar="FROM:TO:DIAMETER[:X:Y]",
    help="A cylinder of what is mounted, the sensor too, in mm from the flange face. Repeatable.",
)
@click.option("--tool-mass", metavar="KG", help="Of what hangs on the sensor, about.")
@click.option("--mounting", help="floor, wall, ceiling, or degrees the base leans towards its -x: 90 is wall.")
@click.option("--plane", "planes", multiple=True, metavar="NX:NY:NZ:MM", help="A wall, base axes. Repeatable.")
@click.option("--box", "boxes", multiple=True, metavar="X:Y:Z:X:Y:Z", help="A block, two corners in mm. Repeatable.")
@click.option("--speed", metavar="DEG/S", help="Of the fastest joint.")
@click.option("-o", "--output", type=NewFile(), default="ftdrive.toml", show_default=True, help="A new file.")
@simulate("Robot and sensor are emulated, --sensor emulated://NAME is which; they end with this command.")
@click.option("--yes", is_flag=True, help="Ask nothing: take what is given here, and defaults where there are any.")
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
    """Describe a cell: ask what cannot be found out, look at robot and sensor, write ftdrive.toml.

    The arm is only read and nothing moves. A file that is there already is never overwritten. What must be measured has
    no default, and `measured = false` in the file stays until you change it.
    """
    from calib.files import write_new
    from drivers.ur.kinematics import model_named
    from ftdrive.cell.config import CellConfig, RobotConfig, SensorConfig, ToolConfig, WorkcellConfig, settings
    from ftdrive.cell.emulated import Station, sensor_name
    from ftdrive.cell.template import cell_file
    from ftdrive.planning.cell_plan import require_possible
    from ftdrive.planning.geometry.arm_model import SHAPES

    check_simulate(simulate, real={"--robot": robot})
    said = settings()
    clock: Clock = REAL
    with ExitStack() as stack:
        if simulate:
            station = stack.enter_context(Station(sensor_name(sensor), ["--time-scale", "1"]))
            robot, sensor, clock = station.cell.robot.host, station.cell.sensor.url, station.clock
        ask = Questions(yes)
        host, model, robot_told = _robot(ask, robot, said["robot.host"].value, model, clock)
        if model is not None and model_named(model, controller_major=0) not in SHAPES:
            _say(
                f"the shape of the {model} is not measured, so no motion can be planned: use calibrate --manual", "  ! "
            )
        url, sensor_told = _sensor(ask, sensor, said["sensor.url"].value, clock)
    height_mm = ask.number("Sensor height above the flange, mm (measure it)", "sensor.height_mm", "--height", height)
    sensor_kg = ask.number(
        "Sensor and adapter, kg (scale or datasheet; Enter: not known)",
        "sensor.mass_kg",
        "--sensor-mass",
        sensor_mass,
        "",
    )
    begun = CellConfig(RobotConfig(host, model), SensorConfig(url, height_mm=height_mm))
    name = ask.text("Name of the tool", "tool.name", "--tool-name", tool_name, said["tool.name"].value)
    cylinders = ask.rows(
        "What is mounted, first cylinder, sensor included: FROM:TO:DIAMETER in mm from the flange (such as 0:60:90)",
        "tool.cylinders_mm",
        "--tool",
        tool,
        (3, 5),
        needed=True,
        whole=lambda rows: require_possible(replace(begun, tool=ToolConfig(cylinders_mm=rows)), model),
    )
    tool_kg = ask.number("Tool, kg, about (Enter: not known)", "tool.mass_kg", "--tool-mass", tool_mass, "")
    workcell = WorkcellConfig(
        ask.text(
            "Mounting: floor, wall, ceiling or degrees",
            "workcell.mounting",
            "--mounting",
            mounting,
            said["workcell.mounting"].value,
        ),
        ask.rows(
            "First wall or table, NX:NY:NZ:MM; -1:0:0:-800 is 800 mm away towards +x",
            "workcell.planes_mm",
            "--plane",
            planes,
            (4,),
            each=lambda row: require_possible(replace(begun, workcell=WorkcellConfig(planes_mm=(row,))), model),
        ),
        ask.rows(
            "First block, two corners X:Y:Z:X:Y:Z in mm",
            "workcell.boxes_mm",
            "--box",
            boxes,
            (6,),
            each=lambda row: require_possible(replace(begun, workcell=WorkcellConfig(boxes_mm=(row,))), model),
        ),
    )
    usual = said["robot.speed_deg_s"].value
    speed_deg_s = ask.number("Speed of the fastest joint, deg/s", "robot.speed_deg_s", "--speed", speed, f"{usual:g}")
    cell = CellConfig(
        RobotConfig(host, model, speed_deg_s),
        SensorConfig(url, height_mm=height_mm, mass_kg=sensor_kg),
        ToolConfig(name, cylinders, tool_kg),
        workcell,
    )
    write_new(output, cell_file(cell, [f"Robot: {robot_told}.", f"Sensor: {sensor_told}."]))
    if as_json:
        told = {"file": str(output), "robot": robot_told, "sensor": sensor_told}
        write_json({"schema_version": 1, **told, "config": cell.to_dict()})
    if simulate:
        _say(f"Wrote {output}, to look at only: the emulated robot and sensor in it have ended with this command.")
        _say("Next: ftdrive doctor --simulate, then ftdrive plan --simulate")
    else:
        _say(f"Wrote {output}. Measure tool, planes and boxes, then set measured = true in it: nothing moves before.")
        _say("Next: ftdrive doctor, then ftdrive plan")


def _anything(_: Any) -> None:
    """Take every answer."""


class Questions:
    """Asks for what was not given as an option; with `--yes` nobody is asked."""

    def __init__(self, yes: bool) -> None:
        self._yes = yes

    @property
    def somebody_answers(self) -> bool:
        """Whether a question may be asked again in other words."""
        return not self._yes

    def ask(self, words: str, flag: str, given: str | None, usual: str | None, read: Callable[[str], T]) -> T:
        """Return what was given, or the answer; `usual` is what Enter and `--yes` say, None where they must not."""
        from ftdrive.errors import ConfigError
        from ftdrive.terminal.console import in_whole_words

        if given is None and self._yes:
            if usual is None:
                raise ConfigError(f"{flag} is missing and has no default: {words[0].lower()}{words[1:]}")
            given = usual
        if given is not None:
            return read(given)
        while True:
            shown = in_whole_words(f"{words} [{usual}]: " if usual else f"{words}: ", sys.stderr)
            try:
                answer = click.prompt(shown, default=usual, show_default=False, prompt_suffix="", err=True)
            except click.Abort as abort:
                click.echo(err=True)  # what is told next begins a line
                if isinstance(abort.__context__, EOFError):
                    raise ConfigError(f"nobody answered: give {flag}, or run it in a terminal") from abort
                raise
            try:
                return read(answer)
            except ConfigError as error:
                _say(str(error), "  ✘ ")

    def text(self, words: str, key: str, flag: str, given: str | None, usual: str | None = None) -> str:
        """Ask for a text."""
        from ftdrive.cell.config import checked

        return str(self.ask(words, flag, given, usual, lambda text: checked(flag, key, text)))

    def number(self, words: str, key: str, flag: str, given: str | None, usual: str | None = None) -> Any:
        """Ask for a number; None where the answer may be empty and is."""
        return self.ask(words, flag, given, usual, partial(_number, key, flag))

    def rows(
        self,
        words: str,
        key: str,
        flag: str,
        given: Sequence[str],
        counts: Sequence[int],
        *,
        needed: bool = False,
        each: Judge = _anything,
        whole: Judge = _anything,
    ) -> Any:
        """Ask for rows of numbers until an empty answer; at least one when `needed`. Each and all are judged."""
        from ftdrive.cell.config import checked

        found: list[Any] = []

        def read(text: str) -> Any:
            if not text:
                whole(tuple(found))
                return None
            row = checked(flag, key, rows(flag, [text], counts))[0]
            each(row)
            return row

        if given:
            found += map(read, given)
            whole(tuple(found))
            return tuple(found)
        if self._yes and not needed:
            return ()
        while True:
            if found:
                row = self.ask("  next (Enter: no more)", flag, None, "", read)
            else:
                row = self.ask(words if needed else f"{words} (Enter: none)", flag, None, None if needed else "", read)
            if row is None:
                return tuple(found)
            found.append(row)


def _number(key: str, flag: str, text: str) -> Any:
    from ftdrive.cell.config import checked

    if not text:
        return None
    try:
        value: Any = float(text)
    except ValueError:
        value = text
    return checked(flag, key, value)


def _robot(
    ask: Questions, given: str | None, usual: str | None, model: str | None, clock: Clock
) -> tuple[str, str | None, str]:
    """Host, model, and what the arm says of itself; a person may keep an address that does not answer."""
    from drivers.errors import DriverError
    from ftdrive.cell.config import checked
    from ftdrive.checks.discovery import look_at_robot

    if model is not None:
        checked("--model", "robot.model", model)
    host = ask.text("Robot address", "robot.host", "--robot", given, usual)
    while True:
        try:
            found, told = look_at_robot(host, model, clock)
        except DriverError as error:
            if not ask.somebody_answers:
                raise
            _say(str(error), "  ✘ ")
            other = ask.text("Another address, or Enter to keep it", "robot.host", "--robot", None, host)
            if other == host and model is not None:
                return host, model, _SILENT
            if other == host:
                model = ask.text("Model of the arm, such as ur5e", "robot.model", "--model", None)
            host = other
            continue
        _say(told, "  ✔ ")
        return host, found, told


def _sensor(ask: Questions, given: str | None, usual: str | None, clock: Clock) -> tuple[str, str]:
    """Address, and what the sensor says of itself; a person may keep an address that does not answer."""
    from drivers.errors import DriverError
    from ftdrive.checks.discovery import is_place, look_at_sensor, places, sensor_at
    from ftdrive.errors import ConfigError

    found = [] if given or not ask.somebody_answers else places()
    for number, place in enumerate(found, start=1):
        _say(f"  {number}) {place}")
    words = (
        "Sensor, a number (a port or bus is asked what is there) or its address"
        if found
        else "Sensor address, such as ati-can://can0?bitrate=250000"
    )
    text = ask.text(words, "sensor.url", "--sensor", given, usual or ("1" if found else None))
    failed: str | None = None
    while True:
        url = found[int(text) - 1] if text.isdecimal() and 0 < int(text) <= len(found) else text
        if url == failed:
            return url, _SILENT
        try:
            url = sensor_at(url) if is_place(url) else url
            told = look_at_sensor(url, clock)
        except (DriverError, ConfigError) as error:
            if not ask.somebody_answers:
                raise
            _say(str(error), "  ✘ ")
            failed = url if isinstance(error, DriverError) and not is_place(url) else None
            keep = ", or Enter to keep it" if failed else ""
            text = ask.text(f"Another address{keep}", "sensor.url", "--sensor", None, failed)
            continue
        _say(f"{url}: {told}", "  ✔ ")
        return url, told


def _say(words: str, head: str = "") -> None:
    from ftdrive.terminal.console import hanging, talk

    talk.print(hanging(head, words))
