"""Trends of bias and payload over the results of a tool, and the dependence of a sensor's bias on temperature."""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from datetime import datetime
from itertools import pairwise
from typing import Any, Final, NamedTuple

import numpy as np

from ftcalib.after.series import FEWEST_ESTIMATES, BiasTemperature, Trend, bias_temperature, trend
from ftcalib.model import BIASES, PARAMETER_NAMES, Array
from ftcalib.rounding import with_sigma
from ftdrive.runs.verification import VerificationRecord
from ftdrive.store.records import StoredResult

# Significance level: a trend with a p-value below this is significant.
SIGNIFICANT: Final = 0.01
# Shortest time span of results for a trend, because its unit is the change per 30 days, a long extrapolation.
SHORTEST_DAYS: Final = 3.0

_MONTH_DAYS = 30.0
# The bias change in one hour is estimated from pairs of runs this far apart, h, and from at least this many pairs.
_NEAR_H: Final = (0.25, 6.0)
_FEWEST_PAIRS: Final = 3
# Median of the chi-squared distribution with one degree of freedom.
_MEDIAN: Final = 0.4549
_VECTORS: Final = {
    "force bias": ("force_bias_N", "N", 1.0),
    "torque bias": ("torque_bias_Nm", "N·m", 1.0),
    "centre of mass": ("p_sensor_com_m", "mm", 1e3),
}


@dataclass(frozen=True, slots=True, eq=False)
class QuantityTrend:
    """Linear trend of a quantity, such as the bias, over the results for one tool on one sensor, arm and mount."""

    tool: str
    sensor_serial: str | None
    quantity: str
    unit: str
    trend: Trend
    """The fitted change per 30 days, in `unit`."""

    @property
    def is_significant(self) -> bool:
        """Whether the p-value of the trend is below 0.01."""
        return self.trend.p_value < SIGNIFICANT

    def to_dict(self) -> dict[str, Any]:
        """Return the trend as JSON."""
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


def trends_of(series: Sequence[StoredResult]) -> Iterator[QuantityTrend]:
    """Yield the trends over a series of results, sorted by time, for one tool on one arm, sensor and mount."""
    for quantity, unit, rows in _quantities(series):
        days = {row[0] for row in rows}
        if len(days) < FEWEST_ESTIMATES or max(days) - min(days) < SHORTEST_DAYS:
            continue
        t, values, covariance = (np.array(column) for column in zip(*rows, strict=True))
        drift = trend(t / _MONTH_DAYS, values, covariance)
        yield QuantityTrend(str(series[0].tool), series[0].sensor_serial, quantity, unit, drift)


def _quantities(series: Sequence[StoredResult]) -> Iterator[tuple[str, str, list[tuple[float, Array, Array]]]]:
    """Yield each quantity with its unit, and (days since the first result, value, covariance) per result.

    Results that do not estimate the quantity are left out: an update copied an earlier value, or the value was given.
    """
    first = datetime.fromisoformat(str(series[0].created_utc))
    days = [(datetime.fromisoformat(str(result.created_utc)) - first).total_seconds() / 86400 for result in series]
    for quantity, (name, unit, scale) in _VECTORS.items():
        rows = slice(PARAMETER_NAMES.index(f"{name}.x"), PARAMETER_NAMES.index(f"{name}.z") + 1)
        values = [scale * getattr(result.parameters, name) for result in series]
        covariances = [scale**2 * result.covariance[rows, rows] for result in series]
        yield quantity, unit, _estimated(days, values, covariances)
    masses = [np.array([result.mass_kg]) for result in series]
    yield "mass", "kg", _estimated(days, masses, [np.array([[result.mass_sigma_kg**2]]) for result in series])


def _estimated(
    days: Sequence[float], values: Sequence[Array], covariances: Sequence[Array]
) -> list[tuple[float, Array, Array]]:
    rows = list[tuple[float, Array, Array]]()
    for day, value, covariance in zip(days, values, covariances, strict=True):
        copied = any(np.array_equal(value, earlier) for _, earlier, _ in rows)
        if not copied and np.linalg.eigvalsh(covariance)[0] > 1e-12 * np.trace(covariance) > 0:
            rows.append((day, value, covariance))
    return rows


# Serial numbers of sensor and arm, and the mount, to which a bias belongs.
Mounted = tuple[str, str | None, str | None]


class _Run(NamedTuple):
    created_utc: datetime
    tool: str | None
    temperature_C: float | None
    bias: Array
    sigma: Array


def sensor_biases(
    results: Iterable[StoredResult], verifications: Sequence[VerificationRecord]
) -> dict[Mounted, tuple[BiasTemperature | None, Array | None]]:
    """Return for each sensor the bias's temperature dependence and its change in one hour; None for too few data.

    The change is the standard deviation (6,), N and N·m, of a random walk, from at least three pairs of successive runs
    with one tool that are 15 min to 6 h apart. The estimate is a median over pairs and axes, separately for force and
    torque, so that single jumps of the bias, as from a moved cable, hardly change it.
    """
    runs = _runs(results, verifications)
    return {mounted: (_temperature(series), _hour_change(series)) for mounted, series in runs.items()}


def _temperature(runs: Sequence[_Run]) -> BiasTemperature | None:
    known = [run for run in runs if run.temperature_C is not None]
    days = [(run.created_utc - known[0].created_utc).total_seconds() / 86400 for run in known]
    columns = (np.array([getattr(run, name) for run in known]) for name in ("temperature_C", "bias", "sigma"))
    return bias_temperature(np.array(days), *columns) if known else None


def _hour_change(runs: Sequence[_Run]) -> Array | None:
    squares, noise = list[Array](), list[Array]()
    for before, after in pairwise(runs):
        hours = (after.created_utc - before.created_utc).total_seconds() / 3600
        if before.tool == after.tool and _NEAR_H[0] <= hours <= _NEAR_H[1]:
            squares.append((after.bias - before.bias) ** 2 / hours)
            noise.append((before.sigma**2 + after.sigma**2) / hours)
    if len(squares) < _FEWEST_PAIRS:
        return None
    usual, known = (np.median(np.reshape(part, (-1, 2, 3)), axis=(0, 2)) for part in (squares, noise))
    return np.repeat(np.sqrt(np.maximum(usual / _MEDIAN - known, 0.0)), 3)


def _runs(results: Iterable[StoredResult], verifications: Sequence[VerificationRecord]) -> dict[Mounted, list[_Run]]:
    """Return for each sensor the estimates of its bias by calibrations and verifications, the oldest first."""
    runs = dict[Mounted, list[_Run]]()
    made = dict[str, tuple[list[_Run], StoredResult]]()
    for result in results:
        if result.verdict == "rejected" or result.sensor_serial is None or result.emulated:
            continue
        series = runs.setdefault((result.sensor_serial, result.arm_serial, result.mount), [])
        made[result.id] = series, result
        if result.update in (None, "tool") and result.created_utc is not None:
            sigma = np.sqrt(np.diag(result.covariance)[BIASES])
            time = datetime.fromisoformat(result.created_utc)
            series.append(_Run(time, result.tool, result.temperature_C, result.parameters.bias, sigma))
    for check in verifications:
        if check.calibration_id not in made or not check.shows_bias:
            continue
        series, calibration = made[check.calibration_id]
        change, sigma_6 = check.bias_change, check.bias_change_sigma
        if change is None or sigma_6 is None or check.created_utc is None:
            continue
        bias = calibration.parameters.bias + change
        time = datetime.fromisoformat(check.created_utc)
        series.append(_Run(time, calibration.tool, check.temperature_C, bias, np.array(sigma_6)))
    return {mounted: sorted(series, key=lambda run: run.created_utc) for mounted, series in runs.items()}
