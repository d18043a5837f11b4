"""Runs `ftdrive` as `python -m ftdrive` does, on the clock of an emulated cell that somebody else has started.

python tests/system/cell_time.py CLOCK ARGUMENTS...

A configuration file describes a cell as if it were real, and a real cell keeps the computer's time. CLOCK is the path
that the emulated cell has announced.
"""

import sys
from collections.abc import Callable
from dataclasses import replace
from functools import wraps
from typing import Any

from ftdrive import cli
from ftdrive.cell import config
from ftdrive.cell.emulated_clock import EmulatedClock


def keep_time_of(path: str, put: Callable[[object, str, object], None] = setattr) -> None:
    """Have every cell that is read in this process keep the time of that station."""
    clock = EmulatedClock(path)

    def keeping(read: Callable[..., config.CellConfig]) -> Callable[..., config.CellConfig]:
        @wraps(read)
        def cell(*arguments: Any, **options: Any) -> config.CellConfig:
            return replace(read(*arguments, **options), clock=clock)

        return cell

    for read in (config.cell_of, config.recorded_cell):
        put(config, read.__name__, keeping(read))


if __name__ == "__main__":
    keep_time_of(sys.argv.pop(1))
    raise SystemExit(cli.main())
