"""Sensors of one model whose bias follows their temperature.

Within the verifications of one calibration, a component of the bias is d = a + b t + c T + e, with the time t, so that
seasons and drift do not count, and the temperature T of the sensor. The calibrations of one sensor share c.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Final

import numpy as np
from scipy.special import chdtrc as chi2_sf
from scipy.special import fdtrc as f_sf

from ftcalib.model import Array
from ftdrive.fleet.observed import BiasChanges, Observed
from ftdrive.fleet.state import FleetFinding
from ftdrive.fleet.words import listed
from ftdrive.report.words import rounded

SURE: Final = 1e-5
"""Largest p-value of one component of one sensor: in one of 80 fleets of 200 sensors one follows by chance, and two are
needed."""
FEWEST: Final = 8
"""Verifications of a calibration."""
LEAST_K: Final = 3.0
"""Between the coldest and the warmest verification of a calibration."""
_UNITS = ("N", "N·m")


@dataclass(slots=True, eq=False)
class _Sums:
    """Sums over the calibrations of one sensor, (6,) each, and its cells."""

    cells: set[str]
    xx: Array
    xy: Array
    yy: Array
    dof: int = 0


def temperature_findings(observed: Observed) -> Iterator[FleetFinding]:
    """Yield the models of which two sensors or more follow their temperature."""
    models = dict[str, dict[str, _Sums]]()
    for cell in observed.cells:
        for result in observed.results[cell.name]:
            changes = observed.changes.get(result.id)
            if changes is not None and result.sensor_model and result.sensor_serial:
                _add(models.setdefault(result.sensor_model, {}), result.sensor_serial, cell.name, changes)
    for model, sensors in sorted(models.items()):
        yield from _finding(model, sensors)


def _add(sensors: dict[str, _Sums], serial: str, cell: str, changes: BiasChanges) -> None:
    known = np.isfinite(changes.temperature_C)
    T = changes.temperature_C[known]
    if len(T) < FEWEST or np.ptp(T) < LEAST_K:
        return
    found = sensors.setdefault(serial, _Sums(set(), np.zeros(6), np.zeros(6), np.zeros(6)))
    found.cells.add(cell)
    found.dof += len(T) - 3
    weight = 1 / changes.sigma[known].T  # (6, n)
    base = np.stack([np.ones_like(T), changes.t_days[known] - changes.t_days[known].mean()], axis=1)
    Q, _ = np.linalg.qr(weight[..., None] * base)  # (6, n, 2)
    x, y = (
        part - (Q @ (Q.swapaxes(1, 2) @ part[..., None]))[..., 0]
        for part in (weight * T, weight * changes.change[known].T)
    )
    found.xx += np.sum(x * x, axis=1)
    found.xy += np.sum(x * y, axis=1)
    found.yy += np.sum(y * y, axis=1)


def _finding(model: str, sensors: Mapping[str, _Sums]) -> Iterator[FleetFinding]:
    following = {serial: sums for serial, sums in sorted(sensors.items()) if _p_values(sums).min() < SURE}
    if len(following) < 2:
        return
    cells = tuple(sorted({cell for sums in following.values() for cell in sums.cells}))
    slopes = np.max([np.where(_p_values(one) < SURE, abs(one.xy / one.xx), 0.0) for one in following.values()], axis=0)
    largest = zip((slopes[:3].max(), slopes[3:].max()), _UNITS, strict=True)
    size = " and ".join(f"{rounded(float(slope), 2)} {unit}" for slope, unit in largest if slope)
    yield FleetFinding(
        "temperature",
        cells,
        f"The bias of {len(following)} of {len(sensors)} sensors {model} follows their temperature, by up to "
        f"{size} a kelvin (in {listed(cells)}): let them warm up before a calibration, and tare them at "
        "the temperature of the work",
    )


def _p_values(sums: _Sums) -> Array:
    """Return p of each component (6,): the larger of those against the stated sigmas and against the scatter."""
    usable = sums.xx > 0
    chi2 = np.where(usable, sums.xy**2 / np.where(usable, sums.xx, 1.0), 0.0)
    rest = np.maximum(sums.yy - chi2, 1e-12) / sums.dof
    return np.maximum(chi2_sf(1, chi2), f_sf(1, sums.dof, chi2 / rest))
