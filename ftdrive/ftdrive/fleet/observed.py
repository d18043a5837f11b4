"""What the store knows of a fleet: the newest accepted results of each cell, and the verifications of 90 days."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime, timedelta
from typing import Final, Self

import numpy as np

from ftcalib.model import Array
from ftdrive.fleet.cells import Owners
from ftdrive.store.records import BriefVerification, StoredCell, StoredResult, StoredVerification, StoredWeighings
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
    checks: Mapping[str, Sequence[BriefVerification]]
    """Verifications by calibration, the oldest first; none without a time, or older than `WINDOW`."""
    changes: Mapping[str, BiasChanges]
    """By calibration, where its verifications have them."""
    weighings: Mapping[tuple[str | None, str | None, bool], StoredWeighings]
    """The last weighing by cell and tool, and whether the cell was emulated."""
    now: datetime

    @classmethod
    def read(cls, store: Store, now: datetime) -> Self:
        """Read the store; raises `BadStore`."""
        cells, newest, recent, weighings = store.fleet(NEWEST, now - WINDOW)
        owners = Owners(cells)
        results: dict[str, list[StoredResult]] = {cell.name: [] for cell in cells}
        for one in newest:
            if (name := owners.cell_of(one)) is not None:
                results[name].append(one)
        checks = dict[str, list[BriefVerification]]()
        for check in recent:
            checks.setdefault(check.calibration_id, []).append(check)
        known = [one for found in results.values() for one in found if one.id in checks]
        changes = {one.id: found for one in known if (found := _changes(one, checks[one.id])) is not None}
        last = {(owners.cell_of(one), one.tool, one.emulated): one for one in weighings}
        return cls(tuple(cells), results, checks, changes, last, now)

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


def _changes(result: StoredResult, checks: Sequence[BriefVerification]) -> BiasChanges | None:
    """Return how the bias has changed since a calibration; None if no verification has this.

    A verification counts if it passed, or found that the bias has changed: another change, or a hand on the tool,
    spoils the estimate.
    """
    used = [one for one in checks if (one.passed or one.change == "bias") and None not in one.bias]
    bias = np.array([one.bias for one in used], dtype=np.float64).reshape(-1, 18)
    measured = bias[:, 6:12].min(axis=1, initial=np.inf) > 0
    if not measured.any():
        return None
    start = when(result)
    days = np.array([(when(one) - start).total_seconds() for one in used]) / 86400
    known = np.array([one.temperature_C for one in used], dtype=np.float64)  # None becomes nan
    change, sigma, common = np.split(bias[measured], 3, axis=1)
    return BiasChanges(days[measured], change, sigma, np.median(common, axis=0), known[measured])


def when(one: StoredResult | StoredVerification | BriefVerification) -> datetime:
    """Return the time of a record that has one."""
    return datetime.fromisoformat(str(one.created_utc))
