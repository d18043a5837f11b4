"""`ftdrive config`: show the configuration in use, and the origin of each value."""

import sys
from dataclasses import replace
from pathlib import Path
from shutil import get_terminal_size
from typing import Any

import click

from ftdrive.cell.config import RULES, WIDTH, document, settings, without_password
from ftdrive.cell.emulated import Station
from ftdrive.commands.options import EMULATED_SENSOR, FILE, JSON, check_simulate, simulate, write_json
from ftdrive.terminal.text import Group, echo


@click.group(cls=Group)
def config() -> None:
    """Show the configuration. `ftdrive init` writes it; a variable such as FTDRIVE_ROBOT_HOST sets any key."""


@config.command("show")
@click.option("--config", "path", type=FILE, help="Show this TOML file instead of ./ftdrive.toml.")
@click.option("--origin", is_flag=True, help="Print the origin of each value instead of its meaning.")
@simulate("Show the configuration of an emulated cell. Its addresses are valid until this command ends.")
@EMULATED_SENSOR
@JSON
def config_show(path: Path | None, origin: bool, simulate: bool, sensor: str | None, as_json: bool) -> None:
    """Print the configuration in use as a TOML file, without passwords.

    Order of precedence: options of a command, environment variables, ./ftdrive.toml, the user's file, defaults.
    """
    check_simulate(simulate, real={"--config": path}, emulated={"--sensor": sensor})
    if simulate:
        with Station.of(None, sensor) as station:
            found = settings(cell=station.cell)
    else:
        found = settings(path)
    if (store := found["store.url"]).value is not None:
        found["store.url"] = replace(store, value=without_password(store.value))
    if as_json:
        values: dict[str, dict[str, Any]] = {}
        origins: dict[str, dict[str, str]] = {}
        for name, setting in found.items():
            section, key = name.split(".")
            values.setdefault(section, {})[key] = setting.value
            origins.setdefault(section, {})[key] = setting.origin
        write_json({"schema_version": 1, "config": values} | ({"origin": origins} if origin else {}))
        return
    comment = (lambda key: found[key].origin) if origin else (lambda key: RULES[key].description)
    values_by_key = {key: setting.value for key, setting in found.items()}
    width = min(WIDTH, get_terminal_size().columns) if sys.stdout.isatty() else WIDTH
    echo(document(values_by_key, comment, width=width), nl=False, fold=False)
