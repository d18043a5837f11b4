"""Options shared by several commands, as `click` parameters, and the objects built from them."""

import importlib.util
import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from functools import wraps
from math import isfinite
from os import fsdecode
from pathlib import Path
from shlex import quote
from socket import gethostname
from typing import TYPE_CHECKING, Any, NamedTuple, TypeVar, cast, get_args

import click
from click.core import ParameterSource

from ftcalib import files
from ftcalib.files import parsed_json, require_new
from ftdrive.cell.config import CellConfig, Setting, cell_of, recorded_cell, settings
from ftdrive.cell.units import parse_numbers, rows
from ftdrive.errors import ConfigError, Declined
from ftdrivers.ur.control import CONTROL_SETTINGS

if TYPE_CHECKING:
    from ftcalib import CalibrationResult
    from ftdrive.stream.samples import Axes, Tracking, WrenchFrame
    from ftdrive.stream.stream import Stream
    from ftdrive.view.page import Page


F = TypeVar("F", bound=Callable[..., Any])


class Headed(click.Command):
    """A command whose help groups the options: `headings` maps each heading to the names of its options."""

    def __init__(self, *args: Any, headings: Mapping[str, str], **options: Any) -> None:
        super().__init__(*args, **options)
        self.headings = headings

    def format_options(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Write the options under their headings."""
        options = {name: one for one in self.get_params(ctx) for name in one.opts}
        for heading, names in self.headings.items():
            with formatter.section(heading):
                formatter.write_dl([options[name].get_help_record(ctx) or ("", "") for name in names.split()])


def _combined(*options: Callable[[F], F]) -> Callable[[F], F]:
    """Combine the decorators of several options, given in the order of the help, into one."""

    def added(command: F) -> F:
        for option in reversed(options):
            command = option(command)
        return command

    return added


PATH = click.Path(exists=True, path_type=Path)
FILE = click.Path(exists=True, dir_okay=False, path_type=Path)
FOLDER = click.Path(exists=True, file_okay=False, path_type=Path)
JSON = click.option("--json", "as_json", is_flag=True, help="Print one JSON object on stdout.")
ALL = click.option(
    "--all", "every", is_flag=True, help="Also print each finding, the residuals and what each sigma includes."
)
JSON_LINES = click.option(
    "--json", "as_json", is_flag=True, help="Print one JSON object per line: events, questions, the result."
)
MODEL = click.option(
    "--model", help="Model of the arm, for controllers that do not report it (CB3 before 3.12, e-Series before 5.6)."
)


CONTROL = click.option(
    "--control",
    type=click.Choice(CONTROL_SETTINGS),
    help="Control path that moves the arm.  [default: [robot] control, else auto]",
)


def runs_option(words: str = "Parent folder of the new run folder.") -> Callable[[F], F]:
    """Return the option --runs with the help text `words`."""
    folder = click.Path(file_okay=False, path_type=Path)
    return click.option("--runs", type=folder, default=Path("runs"), show_default=True, help=words)


def _known_sets(_context: click.Context, _parameter: click.Parameter, sets: str | None) -> str | None:
    if sets is not None:
        from ftcalib.poses.selection import set_names

        try:
            set_names(sets)
        except ValueError as error:
            raise ConfigError(str(error)) from error
    return sets


SETS = click.option(
    "--set",
    "sets",
    metavar="A+E",
    callback=_known_sets,
    help="Sets of orientations A to H of Yu's Fig. 6, such as A+E, instead of 24 poses.",
)
METHOD = click.option(
    "--method",
    metavar="METHOD",
    default="ml",
    show_default=True,
    help="Method of `ftdrive solve` for the poses; srom uses the 24 poses of its paper.",
)

YES = click.option(
    "--yes",
    is_flag=True,
    help="Answer the safety questions automatically, except for a first run or a move of the whole arm.",
)
CONFIG = click.option("--config", type=FILE, help="TOML file that describes the cell, instead of ./ftdrive.toml.")


@dataclass(frozen=True, slots=True)
class CellOptions:
    """Options that describe a cell. A run stores them, so that it can be resumed with the same values."""

    config: Path | None = None
    robot: str | None = None
    sensor: str | None = None
    tool: tuple[str, ...] = ()
    """Texts of the options --tool, each a cylinder around the tool or the sensor."""
    control: str | None = None
    model: str | None = None

    def to_dict(self) -> dict[str, Any]:
        """Return the options that run.json stores, so that a resumed run can use them."""
        kept = ("config", "robot", "sensor", "tool", "control")
        return {name: getattr(self, name) for name in kept} | {"config": self.config and str(self.config)}

    def _or_those(self, begun: Mapping[str, Any]) -> "CellOptions":
        """Return these options, completed with those that a run stored; a configuration file that is gone is unused."""
        config = Path(begun["config"]) if begun.get("config") else None
        return CellOptions(
            self.config or (config if config is not None and config.is_file() else None),
            self.robot or begun.get("robot"),
            self.sensor or begun.get("sensor"),
            self.tool or tuple(begun.get("tool", ())),
            self.control or begun.get("control"),
        )

    def settings(self) -> dict[str, Setting]:
        """Return each setting from options, else the environment, else a file; see `ftdrive.cell.config.settings`."""
        flags = {
            "robot.host": ("--robot", self.robot),
            "robot.model": ("--model", self.model),
            "sensor.url": ("--sensor", self.sensor),
            "tool.cylinders_mm": ("--tool", rows("--tool", self.tool, (3, 5))),
            "robot.control": ("--control", self.control),
        }
        return settings(self.config, flags)

    def cell(self, *, sensor_alone: bool = False) -> CellConfig:
        """Return the described cell. With `sensor_alone` and --sensor, a robot is optional; its host may be empty."""
        values = self.settings()
        needs_robot = not sensor_alone or self.sensor is None or values["robot.host"].value is not None
        return cell_of(values, devices=needs_robot)

    def sensor_alone(self) -> CellConfig:
        """Return a cell whose settings of the arm may be missing. Raises `ConfigError` if no sensor is given."""
        cell = cell_of(self.settings(), devices=False)
        if not cell.sensor.url:
            raise ConfigError("no sensor: give --sensor URL, or --simulate; see `ftdrive devices --probe PLACE`")
        return cell

    def cell_to_resume(self, folder: Path, header: Mapping[str, Any], say: Callable[[str], object]) -> CellConfig:
        """Return the cell for resuming a run, whose run.json is `header`; options given now replace those of the run.

        Configuration files and environment describe the present tool and surroundings; the session refuses to continue
        if they differ from those of the plan. If they describe none, those in run.json are used. `say` receives a
        sentence about which of these is used.
        """
        described = self._or_those(header.get("said", {}))
        found, before = described.settings(), recorded_cell(header["config"])
        undescribed = {"default", "not set", "--tool"}
        origins = {one.origin for key, one in found.items() if key.startswith(("tool.", "workcell."))} - undescribed
        if origins:
            say(f"Tool and surroundings are read from {', '.join(sorted(origins))}.")
            for key, value in (("robot.host", before.robot.host), ("sensor.url", before.sensor.url)):
                if found[key].value is None:
                    found[key] = Setting(value, str(folder))
            return cell_of(found)
        say("No file describes tool and surroundings: the settings of the run are used.")
        cylinders_mm = found["tool.cylinders_mm"].value or before.tool.cylinders_mm
        host, control = described.robot or before.robot.host, described.control or before.robot.control
        return replace(
            before,
            robot=replace(before.robot, host=host, control=control),
            sensor=replace(before.sensor, url=described.sensor or before.sensor.url),
            tool=replace(before.tool, cylinders_mm=cylinders_mm),
        )


def CELL(command: Callable[..., None]) -> Callable[..., None]:
    """Add the options --config, --robot and --sensor, and pass them to the command as `CellOptions`."""

    @wraps(command)
    def with_cell(config: Path | None, robot: str | None, sensor: str | None, **options: Any) -> None:
        command(described=CellOptions(config, robot, sensor), **options)

    sensor_help = "Address, such as ati-can://can0?bitrate=250000, bota:///dev/ttyUSB0 or robotiq-ft300://HOST."
    found = click.option("--sensor", metavar="URL", help=sensor_help)(with_cell)
    return CONFIG(click.option("--robot", metavar="HOST", help="Address of the controller, or ros2:/TOPIC.")(found))


EDITED = "that was edited by hand; every output then shows this"
FORCE = click.option("--force", is_flag=True, help=f"Apply a calibration {EDITED}.")

CALIBRATION = click.option(
    "--calibration",
    "path",
    metavar="PATH",
    type=PATH,
    help="Calibration to use: a calibration.json or its run folder. With --simulate the default is a new one.",
)


BAG_TOPICS = _combined(
    click.option("--wrench-topic", metavar="TOPIC", help="Topic of WrenchStamped in a ROS bag."),
    click.option(
        "--pose-topic",
        metavar="TOPIC",
        help="Topic of PoseStamped in a ROS bag, or tf?base=B&flange=F, or /joint_states?urdf=FILE&flange=F.",
    ),
)


class Number(click.FloatRange):
    """Type of an option: a finite number within a range. The type of `click` would accept nan."""

    name = "number"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> float:
        """Return the typed number. A number that is not finite or outside the range is a usage error."""
        number: float = super().convert(value, param, ctx)
        if not isfinite(number):
            self.fail(f"'{value}' is not a number.", param, ctx)
        return number


POSITIVE = Number(0, min_open=True)


def require_extra(extra: str, what: str, *modules: str) -> None:
    """Raise `ConfigError` if a package that `what` needs, one of `modules`, is missing; the message names the extra."""
    from ftdrivers.installation import missing_extra

    if missing := [name for name in modules if importlib.util.find_spec(name) is None]:
        raise ConfigError(missing_extra(what, missing[0], extra))


@dataclass(frozen=True, slots=True)
class ViewOptions:
    """Whether a command shows a page in the browser, and the address of the page."""

    view: bool
    address: str | None

    @property
    def wanted(self) -> bool:
        """Whether the command shows a page; an address implies it."""
        return self.view or self.address is not None

    def require(self, *, once: bool = False, allow_control: bool = False) -> None:
        """Raise `ConfigError` if `once` or `allow_control` contradict these options, or if the page lacks a package."""
        if once and self.wanted:
            raise ConfigError("--view cannot be combined with --once: leave one of the two out")
        if allow_control and not self.wanted:
            raise ConfigError("--allow-control is only for --view: add --view, or leave --allow-control out")
        if self.wanted:
            require_extra("viz", "--view", "uplot", "segno")

    @contextmanager
    def page(self, title: str) -> Iterator["Page | None"]:
        """Serve a browser page while the block runs, and print its address; without --view, yield None."""
        from ftdrive.servers.http_gate import host_and_port

        address = None
        if self.address is not None:
            address = host_and_port("--view-address", self.address, "0.0.0.0:8080")
        if not self.wanted:
            yield None
            return
        self.require()
        from ftdrive.terminal.console import print_page
        from ftdrive.view.site import announce_page, serve_page

        with serve_page(title, address) as page, announce_page(page, address, print_page):
            yield page


def view_options(command: F) -> F:
    """Add the options --view and --view-address, as one argument `view` of type `ViewOptions`."""

    @click.option("--view", is_flag=True, help="Show a page in the browser (needs ftdrive[viz]).")
    @click.option(
        "--view-address",
        metavar="HOST:PORT",
        help="Serve the page to other devices too, such as 0.0.0.0:8080 for a tablet; implies --view.",
    )
    @wraps(command)
    def with_view(view: bool, view_address: str | None, **options: Any) -> None:
        command(view=ViewOptions(view, view_address), **options)

    return cast("F", with_view)


class NewFile(click.Path):
    """Type of an option: a new file. A file that exists, or whose folder does not, is rejected before any work."""

    def __init__(self) -> None:
        super().__init__(dir_okay=False, path_type=Path)

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """Return the path. Raises `ConfigError` if the file exists or its folder does not."""
        path = Path(fsdecode(super().convert(value, param, ctx)))
        try:
            require_new(path)
        except OSError as error:
            raise ConfigError(f"{max(param.opts, key=len) if param else '--output'}: {error}") from error
        return path


def _check_drawable(_context: click.Context, _parameter: click.Parameter, png: Path | None) -> Path | None:
    if png is not None:
        require_extra("viz", "--png", "matplotlib")
    return png


PLAN_FILES = _combined(
    click.option("--output", type=NewFile(), help="Save the plan as a new JSON file."),
    click.option("--png", type=NewFile(), callback=_check_drawable, help="Save stick figures (needs ftdrive[viz])."),
)


def simulate(words: str = "Use an emulated cell; --sensor emulated://NAME selects its sensor.") -> Callable[[F], F]:
    """Return the option --simulate with the help text `words`."""
    return click.option("--simulate", is_flag=True, help=words)


EMULATED_SENSOR = click.option("--sensor", metavar="emulated://NAME", help="With --simulate: the emulated sensor.")


def check_simulate(simulate: bool, *, real: Mapping[str, object] = {}, emulated: Mapping[str, object] = {}) -> None:
    """Raise `ConfigError` for an option in `real` together with --simulate, or one in `emulated` without it.

    Both map options to their values; None, False or an empty value means that the option is not given.
    """
    if given := [option for option, value in (real if simulate else emulated).items() if value]:
        fix = "leave one of the two out" if simulate else "add --simulate, or leave it out"
        raise ConfigError(f"{given[0]} {'cannot be combined with' if simulate else 'is only for'} --simulate: {fix}")


class SourceOptions(NamedTuple):
    """Options, added by `SOURCE`, that choose cell and calibration for a compensated stream."""

    path: Path | None
    tool: str | None
    force: bool
    described: CellOptions
    simulate: bool

    def calibration(self) -> "CalibrationResult | None":
        """Read the calibration file, or with --simulate make a calibration in an emulated cell; else return None."""
        from ftdrive.runs.calibration import read_calibration
        from ftdrive.session.rehearsal import short_calibration
        from ftdrive.terminal.screen import open_operator

        if self.path is not None:
            return read_calibration(self.path, accept_edited=self.force)
        return short_calibration(open_operator(), self.described.sensor) if self.simulate else None

    def stream(
        self, cell: CellConfig | None, calibration: "CalibrationResult | None", tool: str | None, **options: Any
    ) -> "Stream":
        """Return the stream of `cell`, or without one of an emulated cell, still closed; `tool` replaces a calibration.

        Raises `ConfigError` if there is neither a calibration nor a tool. `options` are passed to `open_stream`.
        """
        from ftdrive.library import open_stream
        from ftdrive.session.rehearsal import station_of

        # a new emulated cell for each stream, because it ends with its stream
        emulated = station_of(calibration, self.described.sensor) if cell is None and calibration is not None else None
        if (place := cell or emulated) is None or not (tool or calibration):
            raise ConfigError(
                "no calibration: give --calibration PATH or --tool NAME, or --simulate; `ftdrive history` lists "
                "calibrations, `ftdrive live --raw` needs none"
            )
        chosen: dict[str, Any] = {"tool": tool} if tool else {"calibration": calibration}
        name = "temporary calibration" if self.path is None else str(self.path)
        return open_stream(place, **chosen, name=name, force=self.force, **options)

    def open(
        self, stack: ExitStack, frame: "WrenchFrame", track: "Tracking" = "off", stages: Mapping[str, Any] = {}
    ) -> "Stream":
        """Open the chosen stream with `stages`, to be closed with `stack`; print its calibration and warnings."""
        from ftdrive.terminal.console import messages

        calibration = self.calibration()
        cell = None if self.simulate or (calibration is None and self.tool is None) else self.described.cell()
        stream = stack.enter_context(self.stream(cell, calibration, self.tool, frame=frame, track=track))
        stream.stages = replace(stream.stages, **stages)
        if self.tool is not None:
            messages.print(f" {self.tool}: {stream.info.calibration_name}")
        messages.print(f" {stream.info.calibration_state}")
        for words in stream.warnings:
            messages.print(f" {words}")
        return stream

    def require_alone(self, others: Mapping[str, object]) -> None:
        """Raise `ConfigError` if --raw (a sensor alone) excludes a given option, one of these or of `others`."""
        own = {"--calibration": self.path, "--tool": self.tool, "--robot": self.described.robot}
        if given := [option for option, value in {**own, **others}.items() if value]:
            raise ConfigError(
                f"{given[0]} cannot be combined with --raw, which shows a sensor alone: leave one of the two out"
            )

    def open_log(
        self, stream: "Stream", stack: ExitStack, say: Callable[[str], object]
    ) -> Callable[[Mapping[str, files.JSON]], None]:
        """Return a function that logs weighings until `stack` closes; for a temporary calibration it does nothing.

        `say` receives sentences for the operator, from any thread.
        """
        from ftdrive.runs.calibration import EMULATED
        from ftdrive.store import store_url
        from ftdrive.store.weighing_log import WeighingLog

        if self.simulate and self.path is None:
            return lambda _: None
        info, cell = stream.info, stream.cell
        origin: dict[str, files.JSON] = {
            "tool": (info.calibration.provenance.get("setup") or {}).get("tool") or info.tool,
            "calibration_id": info.calibration.id,
            "arm_serial": info.arm.serial,
            "sensor_serial": info.sensor.serial,
            "robot_host": cell.robot.host,
            "emulated": EMULATED in info.marks,
            "computer": gethostname(),
        }
        log = WeighingLog(origin, store_url() if self.simulate else cell.store.url, say)
        stack.callback(log.close)
        return log.keep


def SOURCE(command: Callable[..., None]) -> Callable[..., None]:
    """Add the options for the cell and the calibration, and pass them to the command as one `SourceOptions`."""

    @wraps(command)
    def with_source(**options: Any) -> None:
        source = SourceOptions(*(options.pop(name) for name in SourceOptions._fields))
        described = source.described
        real = {"--tool": source.tool, "--config": described.config, "--robot": described.robot}
        check_simulate(source.simulate, real=real)
        if source.path is not None and source.tool is not None:
            raise ConfigError("--calibration and --tool are mutually exclusive: leave one of them out")
        command(source=source, **options)

    force = f"Apply a calibration of another arm, sensor or mount, or one {EDITED}."
    tool = "Use the newest accepted calibration of this tool in this cell."
    words = "Use the emulated cell of the calibration, or one with --sensor emulated://NAME."
    found: Callable[..., None] = simulate(words)(with_source)
    found = click.option("--force", is_flag=True, help=force)(CELL(found))
    return CALIBRATION(click.option("--tool", metavar="NAME", help=tool)(found))


TRACK = click.option(
    "--track",
    type=click.Choice(["off", "show", "apply"]),
    default="off",
    show_default=True,
    help="Track bias and held part while the arm works; only apply corrects the wrench.",
)


def frame_options(axes: "Axes", about: str) -> Callable[[F], F]:
    """Return the options --axes and --about, passed as one argument `frame`, a `WrenchFrame`, with these defaults."""
    point = "Reference point of the torque: sensor, flange, tcp, or x,y,z in m from the flange in its axes."
    choice = click.Choice(["sensor", "flange", "base", "tcp"])

    def added(command: F) -> F:
        @click.option("--axes", type=choice, default=axes, show_default=True, help="Axes of the wrench.")
        @click.option("--about", default=about, show_default=True, metavar="POINT", help=point)
        @wraps(command)
        def with_frame(axes: "Axes", about: str, **options: Any) -> None:
            command(frame=_wrench_frame(axes, about), **options)

        return cast("F", with_frame)

    return added


def _wrench_frame(axes: "Axes", about: str) -> "WrenchFrame":
    from ftdrive.stream.samples import Point, WrenchFrame

    if about in get_args(Point):
        return WrenchFrame(axes, cast("Point", about))
    x, y, z = parse_numbers("--about", about, ",", [3])
    return WrenchFrame(axes, (x, y, z))


FRAME = frame_options("sensor", "sensor")


def _checked_stages(_context: click.Context, _parameter: click.Parameter, text: str) -> dict[str, Any]:
    from ftdrive.servers.parameters import STAGE_TEXTS, checked_value

    found = {}
    for name, _, value in (part.partition("=") for part in filter(None, text.split(","))):
        if name not in STAGE_TEXTS:
            raise ConfigError(f"--stages has no setting '{name}': give NAME=VALUE with one of {', '.join(STAGE_TEXTS)}")
        try:
            found[name] = checked_value(name, parsed_json(value))
        except ValueError:  # a value that is no JSON is a text
            found[name] = checked_value(name, value)
    return found


STAGES = click.option(
    "--stages",
    metavar="NAME=VALUE[,...]",
    default="",
    callback=_checked_stages,
    help="Initial settings of the stages, such as lowpass_Hz=20,bias=false.",
)
STORE = click.option("--store", "url", metavar="URL", help="Database to use, instead of [store] url.")


@contextmanager
def declined_aborts() -> Iterator[None]:
    """If the operator declines in the block, print the reason and abort the command."""
    from ftdrive.terminal.console import messages

    try:
        yield
    except Declined as error:
        messages.print(str(error))
        raise click.Abort from error


def write_json(value: Mapping[str, Any]) -> None:
    """Write one JSON object to stdout, on one line."""
    click.echo(json.dumps(value))


SOLVED_WITH = _combined(
    click.option(
        "--orientation",
        type=click.Choice(["R_base_flange", "R_flange_base"]),
        default="R_base_flange",
        show_default=True,
        help="Rotation in a table, also in --test: from flange to base coordinates, or the inverse (as in the papers).",
    ),
    click.option(
        "--drift",
        type=click.Choice(["auto", "none", "linear", "random-walk"]),
        default="auto",
        show_default=True,
        help="Model of the bias drift; rows without times are taken as equally spaced.",
    ),
    click.option("--mass-kg", metavar="KG", type=POSITIVE, help="Known mass below the sensor."),
    click.option("--level-deg", metavar="DEG", type=Number(0, 180), help="The base is level within DEG (one sigma)."),
    click.option("--mounting-deg", metavar="RX,RY,RZ", help="Known rotation vector of the sensor in the flange."),
    click.option(
        "--up", metavar="X,Y,Z", help="Up direction in base axes, such as 0,0,1 on a floor; declares the mounting."
    ),
)
_OF_TABLE = _combined(
    click.option(
        "--columns",
        metavar="NAMES",
        help='Columns of a table by standard name, such as "t=Time [ms],fx=Force X", or a TOML file with [columns].',
    ),
    click.option("--rate", metavar="HZ", type=POSITIVE, help="Sampling rate of a table without times."),
    click.option(
        "--euler", metavar="ORDER", help="Order of three angles: rpy, ABC, WPR, OAT, ZYX (tool axes), xyz (base axes)."
    ),
    click.option("--tcp", metavar="X,Y,Z,RX,RY,RZ", help="TCP in the flange, m and rad, if the poses are TCP poses."),
    click.option(
        "--wrench-frame",
        type=click.Choice(["sensor", "flange", "tcp", "base"]),
        help="Axes of the wrench; tcp and base are about the TCP.  [default: from the layout, mostly sensor]",
    ),
    click.option("--sign", type=click.Choice(["1", "-1"]), help="Use -1 for a sensor that reports the reaction."),
    click.option("--model", help="Model of the UR arm, such as UR5e, for joint angles."),
    click.option("--urdf", metavar="FILE", help="URDF of another arm, FILE?flange=LINK&base=LINK, for joint angles."),
)
TABLE_NAMES = ("columns", "rate", "euler", "tcp", "wrench_frame", "sign", "model", "urdf")


def TABLE(command: Callable[..., None]) -> Callable[..., None]:
    """Add the options of a table, and pass them to the command as `TableOptions`, or as None if none is given."""

    @wraps(command)
    def with_table(**options: Any) -> None:
        from ftdrive.runs.source import table_options

        given = {name: options.pop(name) for name in TABLE_NAMES}
        command(table=table_options(**given) if any(given.values()) else None, **options)

    return _OF_TABLE(with_table)


REPORTED = ("method", "orientation", "drift", "mass_kg", "level_deg", "mounting_deg", "up", *TABLE_NAMES)
"""Names of those options of `ftdrive solve` that `ftdrive report` has too."""


def typed_options(context: click.Context, names: Sequence[str] | None = None) -> tuple[str, ...]:
    """Return the options given on the command line, quoted for a shell; with `names`, only those."""
    words = list[str]()
    for one in context.command.params:
        is_given = one.name is not None and context.get_parameter_source(one.name) is not ParameterSource.DEFAULT
        if isinstance(one, click.Option) and is_given and (names is None or one.name in names):
            words += [one.opts[0]] if one.is_flag else [one.opts[0], quote(str(context.params[str(one.name)]))]
    return tuple(words)
