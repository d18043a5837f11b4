"""cells.toml: the cells of a fleet, each with its configuration and how often it is verified.

    format = "ftdrive.cells/1"

    [cells.press-4]
    config = "press-4/ftdrive.toml"    # relative to this file
    verify_every_days = 7
    arm_serial = "20225500001"         # optional; default: [robot] serial of the configuration

A run belongs to a cell by the serial number of its arm if the cell has one, else by the address of its controller.
"""

import os
import re
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, Final

from ftdrive.cell.config import read_toml, settings
from ftdrive.errors import ConfigError
from ftdrive.store.records import StoredCell, StoredResult, StoredWeighings

FORMAT: Final = "ftdrive.cells/1"
_NAME = re.compile(r"[\w.-]{1,40}")
_KEYS = ("config", "verify_every_days", "arm_serial")
_OF_ONE_CELL = tuple(f"FTDRIVE_{section}_" for section in ("ROBOT", "SENSOR", "TOOL", "WORKCELL"))
MOST_DAYS: Final = 3650.0


def read_cells(path: Path) -> list[StoredCell]:
    """Read a cells.toml and the configurations that it names.

    Raises
    ------
    ConfigError
        With file, cell, key and what to do: no TOML, another format, an unknown key, a configuration that cannot be
        read or has no address of a controller, a variable of the environment that would replace it.
    OSError
        The file cannot be read.
    """
    refuse_variables()
    document = read_toml(path)
    if document.get("format") != FORMAT:
        found = repr(document.get("format")) if "format" in document else "missing"
        raise ConfigError(f'{path}: the format is {found}: write format = "{FORMAT}" into its first line')
    cells = document.get("cells")
    unknown = sorted(document.keys() - {"format", "cells"})
    if unknown or not isinstance(cells, Mapping) or not cells:
        what = f"the key {unknown[0]} is unknown" if unknown else "no cell is listed"
        raise ConfigError(f"{path}: {what}: write a table [cells.NAME] for each cell")
    return [_cell(path, name, table) for name, table in cells.items()]


def refuse_variables() -> None:
    """Raise `ConfigError` if a variable of the environment would replace a value of every cell."""
    if found := sorted(name for name in os.environ if name.startswith(_OF_ONE_CELL)):
        raise ConfigError(f"{found[0]} is set and would replace a value of every cell: unset it")


def refuse_ambiguous(cells: Iterable[StoredCell]) -> None:
    """Raise `ConfigError` if runs could belong to either of two cells."""
    seen = dict[tuple[str, str], str]()
    for cell in cells:
        key = ("arm_serial", cell.arm_serial) if cell.arm_serial else ("[robot] host", cell.robot_host or "")
        other = seen.setdefault(key, cell.name)
        if other != cell.name:
            fix = "remove one of them" if cell.arm_serial else "give each its arm_serial"
            raise ConfigError(
                f"the cells {other} and {cell.name} have the same {key[0]} {key[1]}, so a run could belong to "
                f"either: {fix}"
            )


class Owners:
    """Finds the cell of a result or weighing: by the serial number of the arm, else the address of the controller."""

    def __init__(self, cells: Iterable[StoredCell]) -> None:
        cells = tuple(cells)
        self._by_serial = {cell.arm_serial: cell.name for cell in cells if cell.arm_serial}
        self._by_host = {cell.robot_host: cell.name for cell in cells if cell.robot_host and not cell.arm_serial}

    def cell_of(self, result: StoredResult | StoredWeighings) -> str | None:
        """Return the name of the cell; None if no cell has this arm."""
        by_serial = self._by_serial.get(result.arm_serial) if result.arm_serial else None
        return by_serial or (self._by_host.get(result.robot_host) if result.robot_host else None)


def _cell(path: Path, name: str, table: Any) -> StoredCell:
    place = f"{path}: [cells.{name}]"
    if not _NAME.fullmatch(name):
        raise ConfigError(f"{place} is no name of a cell: use up to 40 letters, digits, '-', '_' and '.'")
    if not isinstance(table, Mapping):
        raise ConfigError(f'{place} is {table!r}: write a table with config = "…" and verify_every_days = 7')
    if unknown := sorted(table.keys() - set(_KEYS)):
        raise ConfigError(f"{place}: the key {unknown[0]} is unknown: the keys are {', '.join(_KEYS)}")
    config, days, serial = (table.get(key) for key in _KEYS)
    if not isinstance(config, str) or not config:
        raise ConfigError(f'{place} config is {config!r}: give the path of its ftdrive.toml, such as "{name}.toml"')
    if isinstance(days, bool) or not isinstance(days, int | float) or not 0 < days <= MOST_DAYS:  # nan is neither
        raise ConfigError(f"{place} verify_every_days is {days!r}: give the days between two verifications, such as 7")
    if serial is not None and not (isinstance(serial, str) and serial):
        raise ConfigError(f'{place} arm_serial is {serial!r}: give the serial number as text, such as "20225500001"')
    file = (path.parent / config).resolve()
    if not file.is_file():
        raise ConfigError(f"{place} config: {file} does not exist: `ftdrive init` writes one, or fix the path")
    found = settings(file)
    host = found["robot.host"].value
    if host is None:
        raise ConfigError(f"{place}: {file} has no [robot] host: write it there")
    return StoredCell(
        name=name,
        config=str(file),
        verify_every_days=float(days),
        arm_serial=serial or found["robot.serial"].value,
        robot_host=host,
        sensor_url=found["sensor.url"].value,
        tool=found["tool.name"].value,
    )
