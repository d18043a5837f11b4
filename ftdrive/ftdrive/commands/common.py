"""What several commands share: options, JSON on stdout."""

import importlib.util
import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import wraps
from math import isfinite
from os import fsdecode
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any, NamedTuple, TypeVar, cast, get_args

import click

from ftcalib.files import require_new
from ftdrive.cli import in_a_sentence
from ftdrive.errors import BadStore, ConfigError, Declined, NotAccepted
from ftdrive.terminal.text import echo, in_one_line
from ftdrivers.ur.control import CONTROL_SETTINGS

if TYPE_CHECKING:
    from ftcalib import CalibrationResult
    from ftdrive.cell.config import CellConfig, Setting
    from ftdrive.cell.emulated import Station
    from ftdrive.live.samples import Axes, WrenchFrame
    from ftdrive.runs.source import Outcome
    from ftdrive.session.events import Operator
    from ftdrive.session.options import SessionOptions
    from ftdrive.store.store import Store
    from ftdrive.view.page import Page


F = TypeVar("F", bound=Callable[..., Any])

FILE = click.Path(exists=True, dir_okay=False, path_type=Path)
FOLDER = click.Path(exists=True, file_okay=False, path_type=Path)
JSON = click.option("--json", "as_json", is_flag=True, help="Print one JSON object on stdout.")
MODEL = click.option(
    "--model", help="Model of the arm, for controllers that do not report it (CB3 before 3.12, e-Series before 5.6)."
)


CONTROL = click.option(
    "--control",
    type=click.Choice(CONTROL_SETTINGS),
    help="What moves the arm.  [default: [robot] control, else auto]",
)


def runs(words: str = "Parent folder of the new run folder.") -> Callable[[F], F]:
    """Make the option --runs."""
    folder = click.Path(file_okay=False, path_type=Path)
    return click.option("--runs", type=folder, default=Path("runs"), show_default=True, help=words)


def _known_sets(_context: click.Context, _parameter: click.Parameter, sets: str | None) -> str | None:
    """Refuse unknown sets before a device is opened."""
    if sets is not None:
        from ftcalib.poses.selection import names_of

        try:
            names_of(sets)
        except ValueError as error:
            raise ConfigError(str(error)) from error
    return sets


SETS = click.option(
    "--set",
    "sets",
    metavar="A+E",
    callback=_known_sets,
    help="Sets A to H of orientations of Yu's Fig. 6, such as A+E, instead of 24 poses.",
)
METHOD = click.option(
    "--method",
    metavar="METHOD",
    default="ml",
    show_default=True,
    help="Method that solves the poses, one of `ftdrive solve`; srom takes the 24 poses of its paper.",
)

YES = click.option(
    "--yes",
    is_flag=True,
    help="Answer the safety questions automatically; never a first run, nor a move of the whole arm.",
)
CONFIG = click.option("--config", type=FILE, help="TOML file that describes the cell, instead of ./ftdrive.toml.")


@dataclass(frozen=True, slots=True)
class CellOptions:
    """Options that describe a cell. A run keeps them, so that it is resumed with the same values."""

    config: Path | None = None
    robot: str | None = None
    sensor: str | None = None
    tool: tuple[str, ...] = ()
    """Cylinders."""
    control: str | None = None
    model: str | None = None

    def to_dict(self) -> dict[str, Any]:
        """Return what run.json keeps of them."""
        kept = ("config", "robot", "sensor", "tool", "control")
        return {name: getattr(self, name) for name in kept} | {"config": self.config and str(self.config)}

    def or_those(self, begun: Mapping[str, Any]) -> "CellOptions":
        """Return them with those of a run, from `to_dict`, where none is given; a lost file of the run is left out."""
        config = Path(begun["config"]) if begun.get("config") else None
        return CellOptions(
            self.config or (config if config is not None and config.is_file() else None),
            self.robot or begun.get("robot"),
            self.sensor or begun.get("sensor"),
            self.tool or tuple(begun.get("tool", ())),
            self.control or begun.get("control"),
        )

    def settings(self) -> dict[str, "Setting"]:
        """Return options, environment and files, in this order of precedence; see `cell.config.settings`."""
        from ftdrive.cell.config import settings

        flags = {
            "robot.host": ("--robot", self.robot),
            "robot.model": ("--model", self.model),
            "sensor.url": ("--sensor", self.sensor),
            "tool.cylinders_mm": ("--tool", rows("--tool", self.tool, (3, 5))),
            "robot.control": ("--control", self.control),
        }
        return settings(self.config, flags)

    def cell(self, *, sensor_alone: bool = False) -> "CellConfig":
        """Return the cell. With `sensor_alone`, a `sensor` needs no robot: its host is empty where none is set."""
        from ftdrive.cell.config import cell_of

        values = self.settings()
        needs_robot = not sensor_alone or self.sensor is None or values["robot.host"].value is not None
        return cell_of(values, devices=needs_robot)


def CELL(command: Callable[..., None]) -> Callable[..., None]:
    """Add the options --config, --robot and --sensor, and pass them to the command as `CellOptions`."""

    @wraps(command)
    def with_cell(config: Path | None, robot: str | None, sensor: str | None, **options: Any) -> None:
        command(described=CellOptions(config, robot, sensor), **options)

    sensor_help = "Address, such as ati-can://can0?bitrate=250000, bota:///dev/ttyUSB0 or robotiq-ft300://HOST."
    found = click.option("--sensor", metavar="URL", help=sensor_help)(with_cell)
    return CONFIG(click.option("--robot", metavar="HOST", help="Address of the controller, or ros2:/TOPIC.")(found))


EDITED = "that was edited by hand; every output then says so"
FORCE = click.option("--force", is_flag=True, help=f"Apply a calibration {EDITED}.")

CALIBRATION = click.option(
    "--calibration",
    "path",
    metavar="PATH",
    type=click.Path(exists=True, path_type=Path),
    help="A calibration.json or its run folder. With --simulate the default is a new one.",
)


def BAG_TOPICS(command: F) -> F:
    """Add the options --wrench-topic and --pose-topic, which `recording.foreign.read_bag` takes."""
    poses = "Of a bag of ROS: topic of PoseStamped, tf?base=B&flange=F, or /joint_states?urdf=FILE&flange=F."
    command = click.option("--pose-topic", metavar="TOPIC", help=poses)(command)
    return click.option("--wrench-topic", metavar="TOPIC", help="Of a bag of ROS: topic of WrenchStamped.")(command)


class Number(click.FloatRange):
    """A finite number within a range; `click` alone accepts nan."""

    name = "number"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> float:
        """Return the number."""
        number: float = super().convert(value, param, ctx)
        if not isfinite(number):
            self.fail(f"'{value}' is not a number.", param, ctx)
        return number


def require_extra(extra: str, what: str, *modules: str) -> None:
    """Raise `ConfigError` before any work if a package of an extra is not installed.

    Parameters
    ----------
    extra : str
    what : str
        What needs it, such as "--png".
    modules : str
        That it brings.
    """
    from ftdrivers.installation import missing_extra

    if missing := [name for name in modules if importlib.util.find_spec(name) is None]:
        raise ConfigError(missing_extra(what, missing[0], extra))


@dataclass(frozen=True, slots=True)
class ViewOptions:
    """Whether a command has a page in the browser, and where it is served."""

    view: bool
    address: str | None

    @property
    def wanted(self) -> bool:
        """Whether there is one: an address implies it."""
        return self.view or self.address is not None

    def require(self) -> None:
        """Raise `ConfigError` if a page is wanted and a package of it is missing."""
        if self.wanted:
            require_extra("viz", "--view", "uplot", "segno")

    @contextmanager
    def page(self, title: str) -> Iterator["Page | None"]:
        """Serve a page while the block runs, and print its address; None where it is not wanted."""
        from ftdrive.http_gate import host_and_port

        address = None
        if self.address is not None:
            address = host_and_port("--view-address", self.address, "0.0.0.0:8080")
        if not self.wanted:
            yield None
            return
        self.require()
        from ftdrive.view.site import announced, serve

        with serve(title, address) as page, announced(page, address):
            yield page


@contextmanager
def on_page(
    page: "Page | None", operator: "Operator", options: "SessionOptions", command: str = "calibrate"
) -> Iterator[tuple["Operator", "SessionOptions"]]:
    """Show a session on a page while the block runs, if there is one; yields the operator and options to use.

    If the block raises, the page shows what the terminal prints about it.
    """
    if page is None:
        yield operator, options
        return
    from ftdrive.view.parts import BAD
    from ftdrive.view.session_page import SessionPage, conclude

    shown = SessionPage(page, operator, command)
    try:
        with shown:
            yield shown, replace(options, watch=shown.watch)
    except BaseException as error:
        head, _, words = _last_line(error).partition(": ")
        conclude(page, head[:1].upper() + head[1:], words, *shown.kept, tone=BAD)
        raise


def _last_line(error: BaseException) -> str:
    """Return the line that the terminal prints when an error ends a session."""
    if isinstance(error, Declined):
        return str(error)
    return "interrupted" if isinstance(error, KeyboardInterrupt) else f"error: {in_one_line(in_a_sentence(error))}"


def view_options(command: F) -> F:
    """Add the options --view and --view-address, as one argument `view` of type `ViewOptions`."""

    @click.option("--view", is_flag=True, help="Show it in the browser (needs ftdrive[viz]).")
    @click.option(
        "--view-address",
        metavar="HOST:PORT",
        help="Serve that page to other devices too, such as 0.0.0.0:8080 for a tablet; implies --view.",
    )
    @wraps(command)
    def with_view(view: bool, view_address: str | None, **options: Any) -> None:
        command(view=ViewOptions(view, view_address), **options)

    return cast("F", with_view)


def require_viz(png: Path | None) -> None:
    """Raise `ConfigError` if a picture is wanted and its package is missing."""
    if png is not None:
        require_extra("viz", "--png", "matplotlib")


class NewFile(click.Path):
    """A file that a command creates. It is rejected before any work if it exists or its folder does not."""

    def __init__(self) -> None:
        super().__init__(dir_okay=False, path_type=Path)

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """Return the path; raises `ConfigError`."""
        path = Path(fsdecode(super().convert(value, param, ctx)))
        try:
            require_new(path)
        except OSError as error:
            raise ConfigError(f"{max(param.opts, key=len) if param else '--output'}: {error}") from error
        return path


def simulate(words: str = "Use an emulated cell; --sensor emulated://NAME chooses its sensor.") -> Callable[[F], F]:
    """Make the option --simulate, which every command accepts."""
    return click.option("--simulate", is_flag=True, help=words)


EMULATED_SENSOR = click.option("--sensor", metavar="emulated://NAME", help="With --simulate: the emulated sensor.")


def check_simulate(simulate: bool, *, real: Mapping[str, object] = {}, emulated: Mapping[str, object] = {}) -> None:
    """Raise `ConfigError` for an option that would be ignored.

    Parameters
    ----------
    real, emulated : mapping
        Values by option that require a real cell, and that require --simulate. None, False and empty mean not given.
    """
    if given := [option for option, value in (real if simulate else emulated).items() if value]:
        fix = "leave one of the two out" if simulate else "add --simulate, or leave it out"
        raise ConfigError(f"{given[0]} {'does not go with' if simulate else 'goes only with'} --simulate: {fix}")


class Source(NamedTuple):
    """The cell and the calibration of a compensated stream, as the options of `SOURCE` name them."""

    path: Path | None
    tool: str | None
    force: bool
    described: CellOptions
    simulate: bool

    def check(self) -> None:
        """Raise `ConfigError` for options that exclude one another."""
        real = {"--tool": self.tool, "--config": self.described.config, "--robot": self.described.robot}
        check_simulate(self.simulate, real=real)
        if self.path is not None and self.tool is not None:
            raise ConfigError("--calibration and --tool exclude one another: leave one of them out")


def SOURCE(command: Callable[..., None]) -> Callable[..., None]:
    """Add the options that name cell and calibration, and pass them to the command as one `Source`."""

    @wraps(command)
    def with_source(**options: Any) -> None:
        source = Source(*(options.pop(name) for name in Source._fields))
        source.check()
        command(source=source, **options)

    force = f"Apply a calibration of another arm, sensor or mount, or one {EDITED}."
    tool = "Newest accepted calibration of this tool on this cell."
    words = "Use the emulated cell of the calibration, or one with --sensor emulated://NAME."
    found: Callable[..., None] = simulate(words)(with_source)
    found = click.option("--force", is_flag=True, help=force)(CELL(found))
    return CALIBRATION(click.option("--tool", metavar="NAME", help=tool)(found))


TRACK = click.option(
    "--track",
    type=click.Choice(["off", "show", "apply"]),
    default="off",
    show_default=True,
    help="Follow bias and held part while the arm works; only apply corrects the wrench.",
)


def numbers(option: str, text: str, separator: str, counts: Sequence[int]) -> list[float]:
    """Read the numbers in the value of an option; raises `ConfigError` unless their count is one of `counts`."""
    try:
        values = [float(part) for part in text.split(separator)]
    except ValueError:
        values = []
    if len(values) not in counts or not all(map(isfinite, values)):
        wanted = " or ".join(map(str, counts))
        raise ConfigError(f"{option} is '{text}': give {wanted} numbers separated by '{separator}'")
    return values


def rows(option: str, texts: Sequence[str], counts: Sequence[int]) -> list[list[float]] | None:
    """Read a repeatable option, numbers separated by colons; None if it was not given."""
    return [numbers(option, text, ":", counts) for text in texts] or None


def frame_options(axes: "Axes", about: str) -> Callable[[F], F]:
    """Make the options --axes and --about, which `read_frame` takes, with their defaults."""
    point = "Reference point of the torque: sensor, flange, tcp, or x,y,z in m from the flange along its axes."
    about_option = click.option("--about", default=about, show_default=True, metavar="POINT", help=point)
    choice = click.Choice(["sensor", "flange", "base", "tcp"])
    axes_option = click.option("--axes", type=choice, default=axes, show_default=True, help="Axes of the wrench.")
    return lambda command: axes_option(about_option(command))


FRAME = frame_options("sensor", "sensor")


def read_frame(axes: "Axes", about: str) -> "WrenchFrame":
    """Return axes and reference point from the options; raises `ConfigError`."""
    from ftdrive.live.samples import Point, WrenchFrame

    if about in get_args(Point):
        return WrenchFrame(axes, cast("Point", about))
    x, y, z = numbers("--about", about, ",", [3])
    return WrenchFrame(axes, (x, y, z))


@contextmanager
def declined_aborts() -> Iterator[None]:
    """Print why the operator ended a session, and abort the command."""
    from ftdrive.terminal.console import messages

    try:
        yield
    except Declined as error:
        messages.print(str(error))
        raise click.Abort from error


def write_json(value: Mapping[str, Any]) -> None:
    """Write one JSON object to stdout, on one line."""
    echo(json.dumps(value), fold=False)


def index_run(folder: Path, cell: "CellConfig | None" = None) -> None:
    """Add a run to the store, and the runs beside it that it lacks; if that fails, print one sentence.

    The run folder is complete without the store, and the next call adds it. Without a real cell the store is that of
    environment and files.
    """
    from ftdrive.store.store import Store
    from ftdrive.terminal.console import messages

    try:
        Store(store_url() if cell is None else cell.store.url).index(folder.resolve().parent)
    except (BadStore, ConfigError, OSError) as error:
        messages.print(f" The run is saved but not in the history yet, because {error}.")


STORE = click.option("--store", "url", metavar="URL", help="Database to use, instead of [store] url.")


def open_store(url: str | None) -> "Store":
    """Return the store of the option --store, else that of environment and files."""
    from ftdrive.store.store import Store

    return Store(url or store_url())


def store_url(config: Path | None = None) -> str | None:
    """Return [store] url from environment and files; None is the user's store."""
    from ftdrive.cell.config import settings

    url: str | None = settings(config)["store.url"].value
    return url


def stop_unless_accepted(result: "CalibrationResult", *, to_be_saved: bool = False) -> None:
    """Raise `NotAccepted` for a rejected result that was shown; it mentions the missing file if one was requested."""
    if result.verdict == "rejected":
        unsaved = " and was not saved" if to_be_saved else ""
        codes = ", ".join(one.code for one in result.findings if one.severity != "note")
        raise NotAccepted(f"the result is rejected{unsaved}: its findings say what to fix ({codes})")


def stop_unless(passed: bool, words: str) -> None:
    """Raise `NotAccepted` with these words unless a check has passed."""
    if not passed:
        raise NotAccepted(words)


def rehearse(station: "Station", runs: Path, name: str, *, kept: bool = True, **options: Any) -> "Outcome":
    """Calibrate an emulated cell as `ftdrive.session.rehearsal.rehearse` does, and show it."""
    from ftdrive.session import rehearsal
    from ftdrive.terminal.screen import open_operator

    with open_operator() as operator:
        return rehearsal.rehearse(station, runs, name, operator, kept=kept, **options)


def start_mover(station: "Station", options: "SessionOptions") -> None:
    """Let the emulated cell move its arm, in a mode in which the session does not move it."""
    from ftdrive.cell.emulated import MOVED_BY
    from ftdrive.terminal.console import messages

    if mover := MOVED_BY.get(options.with_recorded_mode().mode):
        request, words = mover
        station.control(**request)
        messages.print(f"The cell is emulated: {words}.")


@contextmanager
def rehearsed_run(sensor: str | None, **options: Any) -> Iterator[Path]:
    """Make a short run of an emulated cell; yields its folder, which is deleted afterwards.

    Parameters
    ----------
    sensor : str, optional
        As `sensor_name` takes it.
    options
        As of `SessionOptions`.
    """
    from ftdrive.cell.emulated import Station

    with TemporaryDirectory(prefix="ftdrive-") as runs:
        with Station.of(None, sensor) as station:
            outcome = rehearse(station, Path(runs), "simulated", kept=False, **options)
        yield outcome.run.folder
