"""Comparison of all methods on the same data."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import get_args

import numpy as np
from numpy.typing import NDArray

from ftcalib.data.dataset import CalibrationDataset
from ftcalib.errors import BadDataset, NotObservable
from ftcalib.files import JSON
from ftcalib.known import Known
from ftcalib.likelihood.session import Drift
from ftcalib.model import STANDARD_GRAVITY_M_S2, Array, Parameters, angle_between, predict
from ftcalib.published.methods import PUBLISHED
from ftcalib.result import CalibrationResult, Method
from ftcalib.setup import NOTHING, Setup
from ftcalib.solver import estimator_of, solve

_MOST_FOLDS = 50
"""Largest number of folds: more poses are left out in groups."""


@dataclass(frozen=True, slots=True, eq=False)
class Compared:
    """Result of one method, or the reason why it has none."""

    method: Method
    reason: str | None = None
    parameters: Parameters | None = None
    mass_kg: float = np.nan
    rotation_difference_rad: float = np.nan
    """Angle to the mounting that the default method estimates."""
    force_rms_N: float = np.nan
    torque_rms_Nm: float = np.nan
    cv_force_rms_N: float = np.nan
    """Cross-validated: each pose predicted from all others; NaN if the method needs every pose."""
    cv_torque_rms_Nm: float = np.nan

    def to_dict(self) -> dict[str, JSON]:
        """Return the JSON object that `ftdrive solve --method all --json` prints for a method."""
        if self.parameters is None:
            return {"method": self.method, "reason": self.reason}
        cross_validated = (self.cv_force_rms_N, self.cv_torque_rms_Nm)
        force, torque = (None if np.isnan(rms) else rms for rms in cross_validated)
        return {
            "method": self.method,
            "mass_kg": self.mass_kg,
            "p_sensor_com_m": self.parameters.p_sensor_com_m.tolist(),
            "force_bias_N": self.parameters.force_bias_N.tolist(),
            "torque_bias_Nm": self.parameters.torque_bias_Nm.tolist(),
            "gravity_force_base_N": self.parameters.gravity_force_base_N.tolist(),
            "R_flange_sensor": self.parameters.R_flange_sensor.tolist(),
            "rotation_difference_rad": self.rotation_difference_rad,
            "residual": {"force_rms_N": self.force_rms_N, "torque_rms_Nm": self.torque_rms_Nm},
            "cross_validated": {"force_rms_N": force, "torque_rms_Nm": torque},
        }


def compare(
    dataset: CalibrationDataset,
    *,
    drift: Drift = "auto",
    known: Known | None = None,
    g_m_s2: float = STANDARD_GRAVITY_M_S2,
    setup: Setup = NOTHING,
    default: CalibrationResult | None = None,
) -> list[Compared]:
    """Run all methods; a method that cannot use these data gives a reason instead.

    Parameters
    ----------
    dataset : CalibrationDataset
    drift, known, g_m_s2, setup
        As for `solve`. The published methods that need gravity take it from `known`, or assume a level base.
    default : CalibrationResult, optional
        What the default method has found with all of these, if that is known already.

    Raises
    ------
    NotObservable
        The default method cannot use these data.

    Examples
    --------
    >>> import ftdrive
    >>> compared = ftdrive.compare(ftdrive.read_dataset("poses.csv"))
    >>> compared[0].method, round(compared[0].mass_kg, 3)
    ('ml', 1.235)
    """
    if default is None:
        default = solve(dataset, "ml", drift=drift, known=known, g_m_s2=g_m_s2, setup=setup)
    compared = []
    for method in get_args(Method):
        try:
            if method == "ml":
                found = _fitted(default)
            elif method in PUBLISHED:
                found = _published(dataset, method, known, g_m_s2, setup)
            else:
                found = _fitted(solve(dataset, method, drift=drift, known=known, g_m_s2=g_m_s2, setup=setup))
        except (NotObservable, BadDataset) as error:
            compared.append(Compared(method, str(error)))
            continue
        parameters, cv_force, cv_torque = found
        force, torque = _rms(dataset.wrench - predict(parameters, dataset.R_base_flange))
        angle_rad = float(angle_between(parameters.R_flange_sensor, default.R_flange_sensor))
        mass_kg = float(np.linalg.norm(parameters.gravity_force_base_N)) / g_m_s2
        compared.append(Compared(method, None, parameters, mass_kg, angle_rad, force, torque, cv_force, cv_torque))
    return compared


def _fitted(result: CalibrationResult) -> tuple[Parameters, float, float]:
    return result.parameters, result.quality["loo_force_rms_N"], result.quality["loo_torque_rms_Nm"]


def _published(
    dataset: CalibrationDataset, method: Method, known: Known | None, g_m_s2: float, setup: Setup
) -> tuple[Parameters, float, float]:
    R_base_flange, wrench = dataset.R_base_flange, dataset.wrench
    parameters = estimator_of(method, R_base_flange, known, g_m_s2, setup)(wrench)
    left_out = np.empty_like(wrench)
    try:
        for out in _folds(len(wrench)):
            without = estimator_of(method, R_base_flange[~out], known, g_m_s2, setup)(wrench[~out])
            left_out[out] = wrench[out] - predict(without, R_base_flange[out])
    except NotObservable:
        return parameters, np.nan, np.nan
    return parameters, *_rms(left_out)


def _folds(n: int) -> Iterator[NDArray[np.bool_]]:
    folds = min(n, _MOST_FOLDS)
    for fold in range(folds):
        yield np.arange(n) % folds == fold


def _rms(residuals: Array) -> tuple[float, float]:
    force, torque = (np.sqrt(np.mean(np.sum(part**2, axis=1))) for part in (residuals[:, :3], residuals[:, 3:]))
    return float(force), float(torque)
