"""What a list of results says: trends of bias and payload, ages, failed verifications, temperatures."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from datetime import datetime
from itertools import groupby
from typing import Any, Final

import numpy as np

from ftcalib.extras.trend import FEWEST, Trend, trend
from ftcalib.model import PARAMETER_NAMES, Array
from ftcalib.rounding import with_sigma
from ftdrive.store.records import StoredResult, StoredVerification

SIGNIFICANT: Final = 0.01
"""Largest p-value of a trend that counts."""
OLD_DAYS: Final = 30.0
"""A calibration that was neither made nor verified for so long should be verified."""
OTHER_TEMPERATURE_K: Final = 10.0
SHORTEST_DAYS: Final = 3.0
"""Results within fewer days have no trend: a change per 30 days would be extrapolated too far."""

_MONTH_DAYS = 30.0
_VECTORS: Final = {
    "force bias": ("force_bias_N", "N", 1.0),
    "torque bias": ("torque_bias_Nm", "N·m", 1.0),
    "centre of mass": ("p_sensor_com_m", "mm", 1e3),
}


@dataclass(frozen=True, slots=True, eq=False)
class QuantityTrend:
    """Linear change of one quantity over the results of one tool on one sensor, arm and mount."""

    tool: str
    sensor_serial: str | None
    quantity: str
    unit: str
    trend: Trend
    """Per 30 days, in `unit`."""

    @property
    def is_significant(self) -> bool:
        """Whether chance explains it in less than one case of 100."""
        return self.trend.p_value < SIGNIFICANT

    def to_dict(self) -> dict[str, Any]:
        """Return the fields as JSON."""
        return {
            "tool": self.tool,
            "sensor_serial": self.sensor_serial,
            "quantity": self.quantity,
            "unit": f"{self.unit} per 30 days",
            "slope": self.trend.slope.tolist(),
            "sigma": self.trend.sigma.tolist(),
            "p_value": self.trend.p_value,
            "n": self.trend.n,
            "significant": self.is_significant,
        }

    def __str__(self) -> str:
        pairs = zip(self.trend.slope, self.trend.sigma, strict=True)
        numbers = ", ".join(with_sigma(slope, sigma, "+") for slope, sigma in pairs)
        verdict = "significant" if self.is_significant else "not significant"
        return (
            f"{self.tool}, {self.quantity}: {numbers} {self.unit} per 30 days (1 sigma, {self.trend.n} results), "
            f"{verdict} (p = {self.trend.p_value:.2g})"
        )


def age_days(created_utc: str | None, now: datetime) -> float | None:
    """Return the days since a time; None where the time is unknown."""
    return None if created_utc is None else (now - datetime.fromisoformat(created_utc)).total_seconds() / 86400


def drifts(results: Sequence[StoredResult]) -> list[QuantityTrend]:
    """Fit the trends of each tool with three results or more over three days; a rejected result does not count."""
    found = []
    for series in _series(results):
        for quantity, unit, rows in _quantities(series):
            days = {row[0] for row in rows}
            if len(days) < FEWEST or max(days) - min(days) < SHORTEST_DAYS:
                continue
            t, values, covariance = (np.array(column) for column in zip(*rows, strict=True))
            drift = trend(t / _MONTH_DAYS, values, covariance)
            found.append(QuantityTrend(str(series[0].tool), series[0].sensor_serial, quantity, unit, drift))
    return found


def warnings(
    results: Sequence[StoredResult], verifications: Sequence[StoredVerification], now: datetime
) -> Iterator[str]:
    """Yield what to do about the newest calibration of each tool: old, failed, or at another temperature."""
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
    """Yield the accepted results of each tool on each arm, sensor and mount, the oldest first."""

    def cell(one: StoredResult) -> tuple[str, ...]:
        return tuple(str(part) for part in (one.tool, one.arm_serial, one.sensor_serial, one.mount))

    accepted = [one for one in results if one.verdict != "rejected" and one.tool is not None and one.created_utc]
    accepted.sort(key=lambda one: (cell(one), one.created_utc))
    for _, series in groupby(accepted, cell):
        yield list(series)


def _quantities(series: Sequence[StoredResult]) -> Iterator[tuple[str, str, list[tuple[float, Array, Array]]]]:
    """Yield each quantity with its unit, and (days, value, covariance) of the results that have estimated it.

    A value that equals an earlier one was copied by an update; one without variance was taken as known.
    """
    first = datetime.fromisoformat(str(series[0].created_utc))
    days = [(datetime.fromisoformat(str(one.created_utc)) - first).total_seconds() / 86400 for one in series]
    for quantity, (name, unit, scale) in _VECTORS.items():
        rows = slice(PARAMETER_NAMES.index(f"{name}.x"), PARAMETER_NAMES.index(f"{name}.z") + 1)
        values = [scale * getattr(one.parameters, name) for one in series]
        covariances = [scale**2 * one.covariance[rows, rows] for one in series]
        yield quantity, unit, _estimated(days, values, covariances)
    masses = [np.array([one.mass_kg]) for one in series]
    yield "mass", "kg", _estimated(days, masses, [np.array([[one.mass_sigma_kg**2]]) for one in series])


def _estimated(
    days: Sequence[float], values: Sequence[Array], covariances: Sequence[Array]
) -> list[tuple[float, Array, Array]]:
    kept = list[tuple[float, Array, Array]]()
    for day, value, covariance in zip(days, values, covariances, strict=True):
        copied = any(np.array_equal(value, earlier) for _, earlier, _ in kept)
        if not copied and np.linalg.eigvalsh(covariance)[0] > 1e-12 * np.trace(covariance) > 0:
            kept.append((day, value, covariance))
    return kept
