"""What the store knows of a fleet: the newest accepted results of each cell, and the verifications of 90 days."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime, timedelta
from typing import Final, Self

import numpy as np

from calib.model import Array
from ftdrive.fleet.cells import Owners
from ftdrive.store.records import StoredCell, StoredResult, StoredVerification
from ftdrive.store.store import Store

WINDOW: Final = timedelta(days=90)
"""Of the verifications that are read. A drift of the bias shows within weeks, and the store is read every minute."""
NEWEST: Final = 3
"""Results of each tool of a cell that are read: the newest, and what it is compared with."""


@dataclass(frozen=True, slots=True, eq=False)
class BiasChanges:
    """Changes of the bias since a calibration, by n verifications; force first, N and N·m, sensor frame."""

    t_days: Array
    """(n,) since the calibration, ascending."""
    change: Array
    """(n, 6)"""
    sigma: Array
    """(n, 6) of the readings of each verification."""
    calibration_sigma: Array
    """(6,) of the calibration."""
    temperature_C: Array
    """(n,) nan where it is not known."""

    @property
    def in_sigmas(self) -> Array:
        """(n, 6) in sigmas of each verification."""
        return np.asarray(self.change / self.sigma)


@dataclass(frozen=True, slots=True, eq=False)
class Observed:
    """Results and verifications of a fleet."""

    cells: tuple[StoredCell, ...]
    results: Mapping[str, Sequence[StoredResult]]
    """The newest accepted results of each tool, by cell, the oldest first."""
    checks: Mapping[str, Sequence[StoredVerification]]
    """Verifications with a time, by calibration, the oldest first; none without, or older than `WINDOW`."""
    changes: Mapping[str, BiasChanges]
    """By calibration, where its verifications have them."""
    now: datetime

    @classmethod
    def read(cls, store: Store, now: datetime) -> Self:
        """Read the store; raises `BadStore`."""
        cells = tuple(store.cells())
        owners = Owners(cells)
        results: dict[str, list[StoredResult]] = {cell.name: [] for cell in cells}
        for one in store.newest_accepted(NEWEST):
            if (name := owners.cell_of(one)) is not None:
                results[name].append(one)
        checks = dict[str, list[StoredVerification]]()
        for check in store.verifications(since=now - WINDOW):
            if check.created_utc is not None:
                checks.setdefault(check.calibration_id, []).append(check)
        known = [one for found in results.values() for one in found if one.id in checks]
        changes = {one.id: found for one in known if (found := _changes(one, checks[one.id])) is not None}
        return cls(cells, results, checks, changes, now)

    def newest(self, cell: StoredCell) -> Iterator[StoredResult]:
        """Yield the newest result of each tool in use, in the order of their names.

        In use are the tool of the configuration, the one calibrated last, and each that was calibrated or verified
        within `WINDOW`.
        """
        by_tool = {one.tool: one for one in self.results[cell.name]}
        last = self.results[cell.name][-1:]
        for tool in sorted(by_tool, key=lambda one: one or ""):
            one = by_tool[tool]
            recent = self.now - when(one) < WINDOW or one.id in self.checks
            if recent or tool == cell.tool or one in last:
                yield one

    def is_cut(self, result: StoredResult) -> bool:
        """Whether a calibration may have verifications that are too old to be read."""
        return when(result) < self.now - WINDOW


def _changes(result: StoredResult, checks: Sequence[StoredVerification]) -> BiasChanges | None:
    """Return how the bias has changed since a calibration; None if no verification has this.

    A verification counts if it passed, or found that the bias has changed: another change, or a hand on the tool,
    spoils the estimate.
    """
    start = when(result)
    rows = [
        (when(one), one.bias_change, one.bias_change_sigma, one.calibration_sigma, one.temperature_C)
        for one in checks
        if (one.passed or one.change == "bias")
        and (one.bias_change and one.bias_change_sigma and one.calibration_sigma)
        and min(one.bias_change_sigma) > 0
    ]
    if not rows:
        return None
    times, change, sigma, common, temperature = zip(*rows, strict=True)
    days = np.array([(time - start).total_seconds() for time in times]) / 86400
    known = np.array([np.nan if one is None else one for one in temperature])
    return BiasChanges(days, np.array(change), np.array(sigma), np.median(np.array(common), axis=0), known)


def when(one: StoredResult | StoredVerification) -> datetime:
    """Return the time of a record that has one."""
    return datetime.fromisoformat(str(one.created_utc))
