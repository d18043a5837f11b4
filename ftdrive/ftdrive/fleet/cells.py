"""The cells of a fleet with their configurations and verification intervals, and their records in the store.

    format = "ftdrive.cells/1"

    [cells.press-4]
    config = "press-4/ftdrive.toml"    # relative to this file
    verify_every_days = 7
    arm_serial = "20225500001"         # optional; default: [robot] serial of the configuration

A run belongs to the cell with the serial number of its arm or, if a cell has none, with the address of its controller.
"""

import os
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime, timedelta
from pathlib import Path
from typing import Any, Final, Self

import numpy as np
from numpy.typing import NDArray

from ftdrive.cell.config import read_toml, settings
from ftdrive.errors import ConfigError
from ftdrive.runs.verification import VerificationRecord
from ftdrive.runs.weighings import WeighingDay
from ftdrive.store.records import StoredCell, StoredResult
from ftdrive.store.store import Store

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
        The file is not TOML, has another format or an unknown key, a configuration cannot be read or lacks the address
        of the controller, or an environment variable would replace it. The message names file, cell, key and remedy.
    OSError
        The file cannot be read.
    """
    refuse_variables()
    document = read_toml(path)
    if document.get("format") != FORMAT:
        version = repr(document.get("format")) if "format" in document else "missing"
        raise ConfigError(f'{path}: the format is {version}: write format = "{FORMAT}" into its first line')
    cells = document.get("cells")
    unknown = sorted(document.keys() - {"format", "cells"})
    if unknown or not isinstance(cells, Mapping) or not cells:
        what = f"the key {unknown[0]} is unknown" if unknown else "no cell is listed"
        raise ConfigError(f"{path}: {what}: write a table [cells.NAME] for each cell")
    return [_parse_cell(path, name, table) for name, table in cells.items()]


def refuse_variables() -> None:
    """Raise `ConfigError` if an environment variable would replace a value in every cell."""
    if names := sorted(name for name in os.environ if name.startswith(_OF_ONE_CELL)):
        raise ConfigError(f"{names[0]} is set and would replace a value of every cell: unset it")


def refuse_ambiguous(cells: Iterable[StoredCell]) -> None:
    """Raise `ConfigError` if a run could belong to two cells."""
    seen = dict[tuple[str, str], str]()
    for cell in cells:
        key = ("arm_serial", cell.arm_serial) if cell.arm_serial else ("[robot] host", cell.robot_host or "")
        other = seen.setdefault(key, cell.name)
        if other != cell.name:
            fix = "remove one of the cells" if cell.arm_serial else "set arm_serial in each cell"
            raise ConfigError(
                f"the cells {other} and {cell.name} have the same {key[0]} {key[1]}, so a run could belong to "
                f"either: {fix}"
            )


class Owners:
    """Assigns results and weighings to cells, by serial number of the arm or by address of the controller."""

    def __init__(self, cells: Iterable[StoredCell]) -> None:
        cells = tuple(cells)
        self._by_serial = {cell.arm_serial: cell.name for cell in cells if cell.arm_serial}
        self._by_host = {cell.robot_host: cell.name for cell in cells if cell.robot_host and not cell.arm_serial}

    def cell_of(self, result: StoredResult | WeighingDay) -> str | None:
        """Return the name of the cell to which a result or weighing day belongs; None if no cell has its arm."""
        by_serial = self._by_serial.get(result.arm_serial) if result.arm_serial else None
        return by_serial or (self._by_host.get(result.robot_host) if result.robot_host else None)


def _parse_cell(path: Path, name: str, table: Any) -> StoredCell:
    place = f"{path}: [cells.{name}]"
    if not _NAME.fullmatch(name):
        raise ConfigError(f"{place} is not a valid cell name: use up to 40 letters, digits, '-', '_' and '.'")
    if not isinstance(table, Mapping):
        raise ConfigError(f'{place} is {table!r}: write a table with config = "…" and verify_every_days = 7')
    if unknown := sorted(table.keys() - set(_KEYS)):
        raise ConfigError(f"{place}: the key {unknown[0]} is unknown: the keys are {', '.join(_KEYS)}")
    config, days, serial = (table.get(key) for key in _KEYS)
    if not isinstance(config, str) or not config:
        raise ConfigError(f'{place} config is {config!r}: give the path of its ftdrive.toml, such as "{name}.toml"')
    if isinstance(days, bool) or not isinstance(days, int | float) or not 0 < days <= MOST_DAYS:  # NaN fails
        raise ConfigError(f"{place} verify_every_days is {days!r}: give a number of days, such as 7")
    if serial is not None and not (isinstance(serial, str) and serial):
        raise ConfigError(f'{place} arm_serial is {serial!r}: give it as a string, such as "20225500001"')
    file = (path.parent / config).resolve()
    if not file.is_file():
        raise ConfigError(f"{place} config: {file} does not exist: correct the path, or write it with `ftdrive init`")
    found = settings(file)
    host = found["robot.host"].value
    if host is None:
        raise ConfigError(f"{place}: {file} has no [robot] host: add it there")
    return StoredCell(
        name=name,
        config=str(file),
        verify_every_days=float(days),
        arm_serial=serial or found["robot.serial"].value,
        robot_host=host,
        sensor_url=found["sensor.url"].value,
        tool=found["tool.name"].value,
    )


# Verifications older than this are not read. A drift of the bias appears within weeks; after a year, reading all would
# take four times as long and would detect no drift earlier.
WINDOW: Final = timedelta(days=90)
# Of each tool this many of the newest results are read, so that reading takes no longer as the fleet ages.
NEWEST: Final = 3


# Array of one record per verification: days since the calibration, change of the bias (N and N·m), temperature, sigmas.
Changes = NDArray[np.void]
_COLUMNS: Final = np.dtype(
    [
        ("t_days", float),
        ("temperature_C", float),  # nan if unknown
        ("change", float, 6),
        ("sigma", float, 6),  # from the readings of this verification
        ("calibration_sigma", float, 6),  # from the calibration, common to all verifications
    ]
)


@dataclass(frozen=True, slots=True, eq=False)
class Observed:
    """Results, verifications and weighings of a fleet, as read from its store at one time."""

    cells: tuple[StoredCell, ...]
    results: Mapping[str, Sequence[StoredResult]]
    """The newest accepted results of each tool, by name of the cell, oldest first."""
    checks: Mapping[str, Sequence[VerificationRecord]]
    """Verifications of the last `WINDOW` by id of their calibration, oldest first."""
    changes: Mapping[str, Changes]
    """Changes of the bias by id of the calibration, if verifications of it have estimated any."""
    weighings: Mapping[tuple[str | None, str | None, bool], WeighingDay]
    """The last weighing day by cell, tool, and whether the cell was emulated."""
    now: datetime

    @classmethod
    def read(cls, store: Store, now: datetime) -> Self:
        """Read what a store contains about the fleet; raises `BadStore` if it cannot be read."""
        cells, newest, recent, weighings = store.fleet(NEWEST, now - WINDOW)
        owners = Owners(cells)
        results: dict[str, list[StoredResult]] = {cell.name: [] for cell in cells}
        for result in newest:
            if (name := owners.cell_of(result)) is not None:
                results[name].append(result)
        checks = dict[str, list[VerificationRecord]]()
        for check in recent:
            checks.setdefault(check.calibration_id, []).append(check)
        checked = [result for of_cell in results.values() for result in of_cell if result.id in checks]
        changes = {item.id: rows for item in checked if (rows := _bias_changes(item, checks[item.id])) is not None}
        last = {(owners.cell_of(day), day.tool, day.emulated): day for day in weighings}
        return cls(tuple(cells), results, checks, changes, last, now)

    def newest(self, cell: StoredCell) -> Iterator[StoredResult]:
        """Yield the newest result of each tool in use, sorted by tool name.

        Tools in use are the configured tool, the tool calibrated last, and every tool that was calibrated or verified
        within `WINDOW`.
        """
        by_tool = {one.tool: one for one in self.results[cell.name]}
        last = self.results[cell.name][-1:]
        for tool in sorted(by_tool, key=lambda one: one or ""):
            one = by_tool[tool]
            recent = self.now - when(one) < WINDOW or one.id in self.checks
            if recent or tool == cell.tool or one in last:
                yield one


def _bias_changes(result: StoredResult, checks: Sequence[VerificationRecord]) -> Changes | None:
    """Return the changes of the bias since a calibration by verification; None if none has estimated any."""
    start = when(result)
    rows = [
        ((when(check) - start).total_seconds() / 86400, check.temperature_C, *change, *sigma, *common)
        for check in checks
        if check.shows_bias and (change := check.bias_change)
        if (sigma := check.bias_change_sigma) and (common := check.calibration_sigma)
    ]
    changes = np.array(rows, np.float64).reshape(-1, 20).view(_COLUMNS)[:, 0]  # None becomes nan
    changes = changes[changes["sigma"].min(axis=1, initial=np.inf) > 0]
    return changes if len(changes) else None


def when(record: StoredResult | VerificationRecord) -> datetime:
    """Return the time at which a result or a verification was made; the record must contain it."""
    return datetime.fromisoformat(str(record.created_utc))
