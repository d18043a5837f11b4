"""`ftdrive config`: what counts, and where it comes from."""

from pathlib import Path
from typing import Any

import click

from ftdrive.commands.common import EMULATED_SENSOR, JSON, check_simulate, simulate, write_json


@click.group()
def config() -> None:
    """Show the configuration. `ftdrive init` writes one; any key may be set by its variable, FTDRIVE_ROBOT_HOST."""


@config.command()
@click.option(
    "--config",
    "path",
    type=click.Path(exists=True, dir_okay=False, path_type=Path),
    help="In place of ftdrive.toml here.",
)
@click.option("--origin", is_flag=True, help="Where each value comes from.")
@simulate("Show that of an emulated cell, whose addresses end with this command.")
@EMULATED_SENSOR
@JSON
def show(path: Path | None, origin: bool, simulate: bool, sensor: str | None, as_json: bool) -> None:
    """Print the configuration that counts, as a file that could be used in its place.

    An option of a command comes first, then the environment, then ftdrive.toml here, then the user's file, then the
    default.
    """
    from ftdrive.cell.config import FORMAT, as_toml, settings

    check_simulate(simulate, real={"--config": path}, emulated={"--sensor": sensor})
    if simulate:
        from ftdrive.cell.emulated import Station, sensor_name

        with Station(sensor_name(sensor)) as station:
            found = settings(cell=station.cell)
    else:
        found = settings(path)
    if as_json:
        values: dict[str, dict[str, Any]] = {}
        origins: dict[str, dict[str, str]] = {}
        for name, setting in found.items():
            section, key = name.split(".")
            values.setdefault(section, {})[key] = setting.value
            origins.setdefault(section, {})[key] = setting.origin
        write_json({"schema_version": 1, "config": values} | ({"origin": origins} if origin else {}))
        return
    lines, section = [f'format = "{FORMAT}"'], ""
    for name, setting in found.items():
        if name.split(".")[0] != section:
            section = name.split(".")[0]
            lines += ["", f"[{section}]"]
        key = name.split(".")[1]
        line = f"# {key} =" if setting.value is None else f"{key} = {as_toml(setting.value)}"
        lines.append(f"{line:<40} # {setting.origin}" if origin else line)
    click.echo("\n".join(lines))
