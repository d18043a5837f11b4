"""What several commands share: options, JSON on stdout."""

import json
from collections.abc import Callable, Mapping, Sequence
from os import fsdecode
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import click

if TYPE_CHECKING:
    from calib import CalibrationResult
    from ftdrive.cell.config import CellConfig

F = TypeVar("F", bound=Callable[..., Any])

JSON = click.option("--json", "as_json", is_flag=True, help="One JSON object on stdout.")


MODEL = click.option(
    "--model", help="Of the arm, where the controller does not tell it (CB3 before 3.12, e-Series before 5.6)."
)


def runs(words: str = "Folder in which the run's own folder is made.") -> Callable[[F], F]:
    """Make the option --runs."""
    kind = click.Path(file_okay=False, path_type=Path)
    return click.option("--runs", type=kind, default=Path("runs"), show_default=True, help=words)


CONFIG = click.option(
    "--config",
    type=click.Path(exists=True, dir_okay=False, path_type=Path),
    help="The cell, in TOML, in place of ftdrive.toml here.",
)


def CELL(command: F) -> F:
    """Add the options --config, --robot and --sensor, which say what `read_cell` reads."""
    sensor_help = "Such as ati-can://can0?bitrate=250000 or ati-serial:///dev/ttyUSB0."
    command = click.option("--sensor", metavar="URL", help=sensor_help)(command)
    return CONFIG(click.option("--robot", metavar="HOST", help="Address of the controller.")(command))


class Number(click.FloatRange):
    """A number of a range. `click` takes nan for one of any range."""

    name = "number"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> float:
        """Return the number."""
        from math import isfinite

        number: float = super().convert(value, param, ctx)
        if not isfinite(number):
            self.fail(f"'{value}' is not a number.", param, ctx)
        return number


class NewFile(click.Path):
    """A file that a command makes: refused before any work where one is there already, or where its folder is not."""

    def __init__(self) -> None:
        super().__init__(dir_okay=False, path_type=Path)

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """Return the path; raises `ConfigError`."""
        from calib.files import require_new
        from ftdrive.errors import ConfigError

        path = Path(fsdecode(super().convert(value, param, ctx)))
        try:
            require_new(path)
        except OSError as error:
            raise ConfigError(f"{max(param.opts, key=len) if param else '--output'}: {error}") from error
        return path


def simulate(words: str = "An emulated cell; --sensor emulated://NAME chooses its sensor.") -> Callable[[F], F]:
    """Make the option --simulate, which every command has."""
    return click.option("--simulate", is_flag=True, help=words)


EMULATED_SENSOR = click.option("--sensor", metavar="emulated://NAME", help="With --simulate: the sensor it has.")


def check_simulate(simulate: bool, *, real: Mapping[str, object] = {}, emulated: Mapping[str, object] = {}) -> None:
    """Raise `ConfigError` for an option, by name, that would be ignored.

    Parameters
    ----------
    real, emulated : mapping
        What goes only without, and only with --simulate; None, False and nothing at all were not given.
    """
    from ftdrive.errors import ConfigError

    if said := [option for option, value in (real if simulate else emulated).items() if value]:
        cure = "leave one of the two out" if simulate else "add --simulate, or leave it out"
        raise ConfigError(f"{said[0]} {'does not go with' if simulate else 'goes only with'} --simulate: {cure}")


def numbers(option: str, text: str, separator: str, counts: Sequence[int]) -> list[float]:
    """Read the numbers in the value of an option; raises `ConfigError` unless there are as many as asked for."""
    from math import isfinite

    from ftdrive.errors import ConfigError

    try:
        values = [float(part) for part in text.split(separator)]
    except ValueError:
        values = []
    if len(values) not in counts or not all(map(isfinite, values)):
        wanted = " or ".join(map(str, counts))
        raise ConfigError(f"{option} is '{text}': give {wanted} numbers separated by '{separator}'")
    return values


def rows(option: str, texts: Sequence[str], counts: Sequence[int]) -> list[list[float]] | None:
    """Read an option that may be repeated, numbers separated by colons; None where it was not given."""
    return [numbers(option, text, ":", counts) for text in texts] or None


def write_json(value: Mapping[str, Any]) -> None:
    """Write one JSON object to stdout, on one line."""
    click.echo(json.dumps(value))


def read_cell(config: Path | None, robot: str | None, sensor: str | None, *, model: str | None = None) -> "CellConfig":
    """Take the cell from options, environment and files, in this order of precedence."""
    from ftdrive.cell.config import load

    flags = {"robot.host": ("--robot", robot), "robot.model": ("--model", model), "sensor.url": ("--sensor", sensor)}
    return load(config, flags)


def stop_unless_accepted(result: "CalibrationResult", *, to_be_saved: bool = False) -> None:
    """Raise `NotAccepted` for a rejected result, which says so where somebody waits for its file."""
    from ftdrive.errors import NotAccepted

    if result.verdict == "rejected":
        unsaved = " and was not saved" if to_be_saved else ""
        raise NotAccepted(f"the result is rejected{unsaved}: {'; '.join(result.reasons)}")
