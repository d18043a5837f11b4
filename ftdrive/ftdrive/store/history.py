"""Trends of bias and payload in a list of results, and warnings about age, verifications and temperature."""

from collections.abc import Iterator, Sequence
from datetime import datetime
from itertools import groupby
from typing import TYPE_CHECKING, Final

from ftdrive.runs.verification import VerificationRecord
from ftdrive.store.records import StoredResult

if TYPE_CHECKING:
    from ftdrive.store.trends import QuantityTrend

# A calibration gives a warning if it was neither made nor successfully verified within this number of days.
OLD_DAYS: Final = 30.0
OTHER_TEMPERATURE_K: Final = 10.0
# Smallest number of results of a tool for which trends are estimated.
_FEWEST = 3


def age_days(created_utc: str | None, now: datetime) -> float | None:
    """Return the number of days since a time; None if the time is unknown."""
    return None if created_utc is None else (now - datetime.fromisoformat(created_utc)).total_seconds() / 86400


def drifts(results: Sequence[StoredResult]) -> list["QuantityTrend"]:
    """Return the trends of bias and payload of each tool with three or more accepted results over at least 3 days."""
    long = [series for series in _series(results) if len(series) >= _FEWEST]
    if not long:  # avoid the import of numpy, which doubles the time of the command
        return []
    from ftdrive.store.trends import trends_of

    return [drift for series in long for drift in trends_of(series)]


def warnings(
    results: Sequence[StoredResult], verifications: Sequence[VerificationRecord], now: datetime
) -> Iterator[str]:
    """Yield warnings about each tool's newest calibration: old, verification failed, or another temperature."""
    for series in _series(results):
        newest = series[-1]
        what = f"{newest.tool}: the newest calibration, {newest.id[:6]},"
        checks = [check for check in verifications if check.calibration_id == newest.id]
        days = [age_days(time, now) for time in (newest.created_utc, *(c.created_utc for c in checks if c.passed))]
        age = min((day for day in days if day is not None), default=0.0)
        if checks and not checks[-1].passed:
            yield f"{what} failed its last verification ({checks[-1].reason or checks[-1].run}): calibrate again"
        elif age > OLD_DAYS:
            yield f"{what} was neither made nor verified in the last {age:.0f} days: verify it"
        last = checks[-1] if checks else series[-2] if len(series) > 1 else newest
        if newest.temperature_C is not None and last.temperature_C is not None:
            change_K = last.temperature_C - newest.temperature_C
            if abs(change_K) > OTHER_TEMPERATURE_K:
                words = f"{abs(change_K):.0f} K {'warmer' if change_K > 0 else 'colder'}"
                yield f"{what} was made at {newest.temperature_C:.0f} °C, {last.run} was {words}: verify it when warm"


def _series(results: Sequence[StoredResult]) -> Iterator[list[StoredResult]]:
    """Yield a list, oldest first, of the accepted results of each combination of tool, arm, sensor and mount."""

    def cell(result: StoredResult) -> tuple[str, ...]:
        return tuple(str(part) for part in (result.tool, result.arm_serial, result.sensor_serial, result.mount))

    accepted = [item for item in results if item.verdict != "rejected" and item.tool is not None and item.created_utc]
    accepted.sort(key=lambda item: (cell(item), item.created_utc))
    for _, series in groupby(accepted, cell):
        yield list(series)
