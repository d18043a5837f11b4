"""How the bias of each sensor follows its temperature, from the calibrations and verifications of the store."""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from datetime import datetime
from typing import Any, NamedTuple

import numpy as np

from ftcalib.after.series import BiasTemperature, bias_temperature
from ftcalib.model import BIASES, Array
from ftcalib.rounding import with_sigma
from ftdrive.store.records import StoredResult, StoredVerification

_UNITS = ("N", "N·m")


@dataclass(frozen=True, slots=True, eq=False)
class SensorTemperature:
    """The bias of one sensor in one mounting against its temperature."""

    sensor_serial: str
    arm_serial: str | None
    mount: str | None
    fit: BiasTemperature

    def to_dict(self) -> dict[str, Any]:
        """Return the fields as JSON."""
        fit = self.fit
        return {
            "sensor_serial": self.sensor_serial,
            "arm_serial": self.arm_serial,
            "mount": self.mount,
            "slope_per_K": fit.slope.tolist(),
            "sigma_per_K": fit.sigma.tolist(),
            "n": fit.n,
            "coldest_C": fit.coldest_C,
            "warmest_C": fit.warmest_C,
            "left_out_error": fit.error.tolist(),
            "left_out_error_without": fit.error_without.tolist(),
            "p_value": fit.p_value.tolist(),
            "applied": list(fit.predicts),
        }

    def lines(self) -> Iterator[str]:
        """Yield one line for the force and one for the torque."""
        fit = self.fit
        for k, (quantity, unit) in enumerate(zip(("force bias", "torque bias"), _UNITS, strict=True)):
            part = slice(3 * k, 3 * k + 3)
            slopes = ", ".join(
                with_sigma(slope, sigma, "+") for slope, sigma in zip(fit.slope[part], fit.sigma[part], strict=True)
            )
            use = "applied by --tool" if fit.predicts[k] else "not applied"
            yield (
                f"temperature, {self.sensor_serial}, {quantity}: {slopes} {unit}/K (1 sigma, {fit.n} runs, "
                f"{fit.coldest_C:.0f} to {fit.warmest_C:.0f} °C); runs left out differ by {fit.error[k]:.2g} {unit} "
                f"with it, {fit.error_without[k]:.2g} {unit} without: {use}"
            )


class _Run(NamedTuple):
    created_utc: str
    temperature_C: float
    bias: Array
    sigma: Array


def temperatures(
    results: Iterable[StoredResult], verifications: Sequence[StoredVerification]
) -> list[SensorTemperature]:
    """Fit each sensor on each arm and mount that has runs enough.

    A verification counts if it passed, or found that the bias has changed: another change, or a hand on the tool,
    spoils the estimate of the bias.
    """
    runs = dict[tuple[str, str | None, str | None], list[_Run]]()
    made = dict[str, tuple[list[_Run], StoredResult]]()
    for one in results:
        if one.verdict == "rejected" or one.sensor_serial is None or one.emulated:
            continue
        found = runs.setdefault((one.sensor_serial, one.arm_serial, one.mount), [])
        made[one.id] = found, one
        if one.update in (None, "tool") and one.created_utc is not None and one.temperature_C is not None:
            sigma = np.sqrt(np.diag(one.covariance)[BIASES])
            found.append(_Run(one.created_utc, one.temperature_C, one.parameters.bias, sigma))
    for check in verifications:
        if check.calibration_id not in made or not (check.passed or check.change == "bias"):
            continue
        found, calibration = made[check.calibration_id]
        change, sigma_6 = check.bias_change, check.bias_change_sigma
        if change is None or sigma_6 is None or check.created_utc is None or check.temperature_C is None:
            continue
        found.append(
            _Run(check.created_utc, check.temperature_C, calibration.parameters.bias + change, np.array(sigma_6))
        )
    return [
        SensorTemperature(serial, arm, mount, fit)
        for (serial, arm, mount), found in runs.items()
        if (fit := _fit(sorted(found, key=lambda run: run.created_utc))) is not None
    ]


def _fit(runs: Sequence[_Run]) -> BiasTemperature | None:
    if not runs:
        return None
    first = datetime.fromisoformat(runs[0].created_utc)
    days = [(datetime.fromisoformat(run.created_utc) - first).total_seconds() / 86400 for run in runs]
    columns = (np.array([run[k] for run in runs]) for k in (1, 2, 3))
    return bias_temperature(np.array(days), *columns)
